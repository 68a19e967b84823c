"""The page of a running world, as it is before anything has happened there."""

from __future__ import annotations

import math

import numpy as np

from mjx_revolve.inputs.user_code import short_name
from mjx_revolve.view.live.robot_catalogue import RobotCatalogue
from mjx_revolve.view.page_data import pack_water
from mjx_revolve.view.surroundings import bed_at
from mjx_revolve.view.viewer import fill_page

# Where robots are dropped at first, and how deep the page lets them be dropped. Choices [m].
_DEPTH, _DEEPEST = 1.0, 10.0
# Things around robots are drawn for robots of about this length: shipped ones have .3 to .5 m. The
# page is made before any robot is built [m].
_LENGTH = 0.45
_GRID = 2.0  # of the grid below the surface, where no bed is in sight [m]


def live_page(catalogue: RobotCatalogue, room: int) -> str:
    """The page.

    Args:
        catalogue: robots that may be dropped, and the world.
        room: how many may be in the water at once.

    Returns:
        The text of an HTML file. Its address must end in a slash: it requests `events`
        and `command` beside it.
    """
    world = catalogue.world
    bed = -math.inf
    if world.bed is not None:
        bed = float(bed_at(world.bed, np.zeros(1), np.zeros(1))[0])
    surface = float(world.surface_height)
    deepest = min(_DEEPEST, max(surface - bed, 0.2))
    depth = min(_DEPTH, 0.5 * deepest)
    floor = max(surface - depth - _GRID, bed)
    water = pack_water(world, np.array([[0.0, 0.0, surface - depth]]), floor)
    data = {
        **water,
        "floor": floor,
        "many": True,
        "size": _LENGTH,
        "room": room,
        "depth": round(depth, 2),
        "deepest": round(deepest, 2),
        "catalogue": [{"name": entry.name, "group": entry.group} for entry in catalogue.entries],
    }
    name = world.name.replace("_", " ")
    words = [name, f"{short_name(catalogue.mixed.config.controller.type)} brains", "live"]
    title = catalogue.title or "A running world"
    return fill_page("live", maker="live", title=title, subtitle=" \u00b7 ".join(words), data=data)
