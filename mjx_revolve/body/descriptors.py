"""Measures of a body at rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjx_revolve.body.placement import Module

# Positions nearer than this are the same place [m]; a choice, far below a module's size.
_SAME_PLACE = 1e-3


def describe(modules: Sequence[Module], extent: np.ndarray) -> dict[str, float]:
    """Measures of a body, to compare robots and to spread them in quality-diversity searches.

    After Miras, Haasdijk, Glette and Eiben, "Search space analysis of evolvable robot
    morphologies", EvoApplications 2018, with the limits that Revolve uses; m is the number of
    modules without sensors, and a module's children do not count its sensors. With the catalogue's
    modules, `branching`, `limbs`, `length_of_limbs`, `joints`, `sensors`, `proportion` and
    `symmetry` lie between 0 and 1. Two measures differ from theirs, which count cells of a grid:
    our modules differ in size, so `coverage` compares volumes, and `symmetry` compares types and
    positions at rest (to 1 mm).

    Args:
        modules: of the robot, the core first, parents before their children.
        extent: `[3]` edges of its bounding box at rest [m].

    Returns:
        - num_modules, num_bricks, num_hinges, num_sensors, num_thrusters, num_fins: counts (bricks:
          all that is rigid and is neither core, sensor, thruster nor fin; fins: modules with a part
          whose drag is that of a plate with lift);
        - mass [kg], volume [m³], box_volume [m³]: as the properties of a `Morphology`;
        - extent_x, extent_y, extent_z, length [m]: bounding box at rest and its longest edge;
        - num_limbs: modules without children, core and sensors not counted;
        - limbs: num_limbs over the most that m modules can have;
        - chain_length: modules on the longest way from the core to a tip, sensors included;
        - length_of_limbs: modules with one child, core not counted, over m - 2;
        - branching: bricks and cores whose slots are all filled, over floor((m - 2) / 3);
        - joints: hinges that carry something, over m - 2;
        - sensors: sensors over slots that no other kind of module fills;
        - coverage: boxes' volumes over that of the bounding box;
        - proportion: shorter over longer of extent_x and extent_y;
        - symmetry: share of modules off the core's axis that have a mirror image, about the xz or
          the yz plane, whichever is more; 0 where none is off the axis.
    """
    children = [0] * len(modules)
    depth = [0] * len(modules)
    for i, module in enumerate(modules):
        if i > 0:
            children[module.parent] += not module.kind.sensor
            depth[i] = depth[module.parent] + 1
    body = [i for i, module in enumerate(modules) if not module.kind.sensor]
    limb = [i for i in body if i > 0]
    rigid = [i for i in body if modules[i].kind.hinge is None]
    size = len(body)
    hinges = [i for i, module in enumerate(modules) if module.kind.hinge is not None]
    sensors = len(modules) - size
    thrusters = [module.kind.is_thruster for module in modules]
    fins = [module.kind.is_fin for module in modules]
    bricks = [i for i in rigid if i > 0 and not thrusters[i] and not fins[i]]
    tips = sum(children[i] == 0 for i in limb)
    full = sum(0 < len(modules[i].kind.slots) == children[i] for i in rigid)
    free = sum(len(modules[i].kind.slots) - children[i] for i in body)
    working = sum(children[i] > 0 for i in hinges)
    most_tips = size - 1 if size < 6 else 2 * ((size - 6) // 3) + (size - 6) % 3 + 4
    box_volume = sum(module.kind.box_volume for module in modules)
    return {
        "num_modules": float(len(modules)),
        "num_bricks": float(len(bricks)),
        "num_hinges": float(len(hinges)),
        "num_sensors": float(sensors),
        "num_thrusters": float(sum(thrusters)),
        "num_fins": float(sum(fins)),
        "mass": sum(module.kind.mass for module in modules),
        "volume": sum(module.kind.volume for module in modules),
        "box_volume": box_volume,
        "extent_x": float(extent[0]),
        "extent_y": float(extent[1]),
        "extent_z": float(extent[2]),
        "length": float(extent.max()),
        "num_limbs": float(tips),
        "limbs": _ratio(tips, most_tips),
        "chain_length": float(max(depth)),
        "length_of_limbs": _ratio(sum(children[i] == 1 for i in limb), size - 2),
        "branching": _ratio(full, (size - 2) // 3),
        "joints": _ratio(working, size - 2),
        "sensors": _ratio(sensors, free),
        "coverage": box_volume / float(extent.prod()),
        "proportion": float(min(extent[:2]) / max(extent[:2])),
        "symmetry": _symmetry([modules[i] for i in body]),
    }


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole > 0 else 0.0


def _symmetry(modules: list[Module]) -> float:
    """The larger share of modules with a mirror image, about the yz and the xz plane."""
    position = np.array([m.position for m in modules])
    kind = np.array([m.type for m in modules])
    best = 0.0
    for axis in (0, 1):
        mirror = position * np.where(np.arange(3) == axis, -1.0, 1.0)
        close = np.abs(mirror[:, None] - position[None]).max(-1) < _SAME_PLACE
        has_image = (close & (kind[:, None] == kind[None])).any(1)
        off = np.abs(position[:, axis]) > _SAME_PLACE
        best = max(best, _ratio(int((has_image & off).sum()), int(off.sum())))
    return best
