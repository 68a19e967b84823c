"""Measures of a body at rest."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mjx_revolve.body.placement import Module

# Positions nearer than this count as equal [m]; a choice, far below a module's size.
_SAME_PLACE = 1e-3

UNITS: dict[str, str] = {
    **dict.fromkeys(
        ("num_modules", "num_bricks", "num_hinges", "num_sensors", "num_thrusters", "num_fins"),
        "modules",
    ),
    "mass": "kg",
    "volume": "m3",
    "box_volume": "m3",
    **dict.fromkeys(("extent_x", "extent_y", "extent_z", "length"), "m"),
    "absolute_size": "modules",
    "num_limbs": "modules",
    "limbs": "-",
    "chain_length": "modules",
    "extensiveness": "modules",
    "length_of_limbs": "-",
    "branching_modules_count": "modules",
    "branching": "-",
    "active_hinges_count": "modules",
    "joints": "-",
    "sensors": "-",
    "coverage": "-",
    "proportion": "-",
    "symmetry": "-",
    "vertical_symmetry": "-",
    **dict.fromkeys(("width", "height", "z_depth"), "cells"),
    "height_base_ratio": "-",
    "base_density": "-",
    "bottom_layer": "cells",
}
"""All measures that `describe` gives, in its order, with their units."""


def describe(modules: Sequence[Module], extent: np.ndarray) -> dict[str, float]:
    """Measures of a body, to compare robots and to spread them in quality-diversity searches.

    After Miras, Haasdijk, Glette and Eiben, "Search space analysis of evolvable robot
    morphologies", EvoApplications 2018, and Revolve's code (ci-group/revolve,
    `measure_body_3d.py`), with the limits that it uses. m is `absolute_size`, and a module's
    children do not count its sensors. `docs/measures.md` has Revolve's names beside these.

    Cells are those of Revolve's grid: the core has cell (0, 0, 0), and each module the cell next to
    its parent's in the direction in which it is attached (core frame, the nearest axis). A module
    of any size takes one cell; modules of a limb that bends back may share one.

    Differences from Revolve: our modules differ in size, so `coverage` compares volumes, and the
    symmetries compare types and positions at rest (to 1 mm) where Revolve compares cells. Sensors
    take no cells, as in its paper, and make no hinge active; its code counts them.

    Args:
        modules: of the robot, the core first, parents before their children.
        extent: `[3]` edges of its bounding box at rest [m].

    Returns:
        Units are in `UNITS`; shares lie between 0 and 1 with Revolve's modules (the most limbs are
        those of a core with four slots).

        - num_modules, num_bricks, num_hinges, num_sensors, num_thrusters, num_fins: counts (bricks:
          all rigid modules but core, sensors, thrusters and fins; fins: modules with a part under
          the drag law `lift_drag`);
        - mass, volume, box_volume: as the properties of a `Morphology`;
        - extent_x, extent_y, extent_z, length: bounding box at rest and its longest edge;
        - absolute_size: m, modules without sensors;
        - num_limbs: modules without children, core and sensors not counted;
        - limbs: num_limbs over the most that m modules can have: m - 1 below six, else
          2 floor((m - 6) / 3) + (m - 6) mod 3 + 4;
        - chain_length: modules on the longest way from the core to a tip, sensors included;
        - extensiveness: modules with one child, core not counted;
        - length_of_limbs: extensiveness over m - 2;
        - branching_modules_count: bricks and cores with all slots filled;
        - branching: branching_modules_count over floor((m - 2) / 3);
        - active_hinges_count: hinges that carry a module;
        - joints: active_hinges_count over m - 2;
        - sensors: sensors over slots that no other kind of module fills;
        - coverage: boxes' volumes over that of the bounding box;
        - proportion: shorter over longer of extent_x and extent_y;
        - symmetry: share of modules off the core's axis that have a mirror image, about the xz or
          the yz plane, whichever is more; 0 where none is off the axis;
        - vertical_symmetry: the same about the xy plane;
        - width, height, z_depth: cells from end to end along x, y and z, at least 1;
        - height_base_ratio: z_depth over the square root of width times height;
        - base_density: modules in the lowest layer of cells, core and sensors not counted, over
          width times height;
        - bottom_layer: z of that layer, 0 or less.
    """
    kinds = [module.kind for module in modules]
    parents = [module.parent for module in modules]
    cells = _cells(modules)
    children, depth = [0] * len(modules), [0] * len(modules)
    for i, parent in enumerate(parents):
        if i > 0:
            children[parent] += not kinds[i].sensor
            depth[i] = depth[parent] + 1
    body = [i for i, kind in enumerate(kinds) if not kind.sensor]
    limb = body[1:]
    hinges = [i for i, kind in enumerate(kinds) if kind.hinge is not None]
    thrusters = [kind.is_thruster for kind in kinds]
    fins = [kind.is_fin for kind in kinds]
    rigid = [i for i in body if kinds[i].hinge is None]
    bricks = [i for i in rigid if i > 0 and not thrusters[i] and not fins[i]]
    size, sensors = len(body), len(modules) - len(body)
    tips = sum(children[i] == 0 for i in limb)
    single = sum(children[i] == 1 for i in limb)
    full = sum(0 < len(kinds[i].slots) == children[i] for i in rigid)
    free = sum(len(kinds[i].slots) - children[i] for i in body)
    working = sum(children[i] > 0 for i in hinges)
    most_tips = size - 1 if size < 6 else 2 * ((size - 6) // 3) + (size - 6) % 3 + 4
    box_volume = sum(kind.box_volume for kind in kinds)
    low, high = ([end(cells[i][axis] for i in body) for axis in range(3)] for end in (min, max))
    width, height, layers = (b - a + 1 for a, b in zip(low, high, strict=True))
    lowest = sum(cells[i][2] == low[2] for i in limb)
    mirrored = _mirrored([modules[i] for i in body])
    x, y, z = map(float, extent)
    return {
        "num_modules": float(len(modules)),
        "num_bricks": float(len(bricks)),
        "num_hinges": float(len(hinges)),
        "num_sensors": float(sensors),
        "num_thrusters": float(sum(thrusters)),
        "num_fins": float(sum(fins)),
        "mass": sum(kind.mass for kind in kinds),
        "volume": sum(kind.volume for kind in kinds),
        "box_volume": box_volume,
        "extent_x": x,
        "extent_y": y,
        "extent_z": z,
        "length": max(x, y, z),
        "absolute_size": float(size),
        "num_limbs": float(tips),
        "limbs": _ratio(tips, most_tips),
        "chain_length": float(max(depth)),
        "extensiveness": float(single),
        "length_of_limbs": _ratio(single, size - 2),
        "branching_modules_count": float(full),
        "branching": _ratio(full, (size - 2) // 3),
        "active_hinges_count": float(working),
        "joints": _ratio(working, size - 2),
        "sensors": _ratio(sensors, free),
        "coverage": box_volume / (x * y * z),
        "proportion": min(x, y) / max(x, y),
        "symmetry": max(mirrored[:2]),
        "vertical_symmetry": mirrored[2],
        "width": float(width),
        "height": float(height),
        "z_depth": float(layers),
        "height_base_ratio": layers / math.sqrt(width * height),
        "base_density": lowest / (width * height),
        "bottom_layer": float(low[2]),
    }


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole > 0 else 0.0


def _cells(modules: Sequence[Module]) -> list[list[int]]:
    """The cell of each module in Revolve's grid, (x, y, z)."""
    outward = [(0.0, 0.0, 0.0) if m.kind.mount is None else m.kind.mount.outward for m in modules]
    turns = np.array([module.rotation for module in modules])
    way = np.einsum("mij,mj->mi", turns, np.array(outward))
    axes = np.abs(way).argmax(1).tolist()
    cells = [[0, 0, 0]]
    for i in range(1, len(modules)):
        cells.append(cells[modules[i].parent].copy())
        cells[i][axes[i]] += 1 if way[i, axes[i]] > 0 else -1
    return cells


def _mirrored(modules: Sequence[Module]) -> list[float]:
    """Shares of modules off the yz, the xz and the xy plane that have a mirror image there."""
    position = np.array([m.position for m in modules]).T
    number: dict[str, int] = {}
    kind = np.array([number.setdefault(m.type, len(number)) for m in modules])
    alike = kind[:, None] == kind
    here, there = position[:, :, None], position[:, None, :]
    x, y, z = np.abs(here - there) < _SAME_PLACE
    mirror = np.abs(here + there) < _SAME_PLACE
    off = np.abs(position) > _SAME_PLACE
    image = np.stack([mirror[0] & y & z, mirror[1] & x & z, mirror[2] & x & y]) & alike
    found = (image.any(2) & off).sum(1).tolist()
    return [_ratio(*pair) for pair in zip(found, off.sum(1).tolist(), strict=True)]
