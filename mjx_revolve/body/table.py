"""A morphology as text: its modules and thrusters as tables, its weights and its descriptors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from mjx_revolve.body.descriptors import UNITS
from mjx_revolve.body.morphology import Morphology


def align(rows: Sequence[Sequence[str]], left: Sequence[int] = (0,)) -> list[str]:
    """Lines of a table.

    Args:
        rows: cells; as many in each.
        left: columns that are set to the left; the others are set to the right.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if k in left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def module_table(morphology: Morphology) -> list[str]:
    """The modules of a morphology as lines of an aligned table, units in the header."""
    rows = [
        ["#", "name", "type", "parent", "slot", "turn", "x", "y", "z", "mass", "volume"],
        ["", "", "", "", "", "(deg)", "(m)", "(m)", "(m)", "(kg)", "(cm³)"],
    ]
    for k, module in enumerate(morphology.modules):
        place = [str(module.parent), str(module.slot), f"{module.orientation:g}"]
        place = place if module.parent >= 0 else ["-"] * 3
        amounts = f"{module.kind.mass:.4f}", f"{1e6 * module.kind.volume:.3f}"
        here = _meters(module.position)
        rows.append([str(k), module.name, module.type, *place, *here, *amounts])
    return align(rows, left=(1, 2))


def thruster_table(morphology: Morphology) -> list[str]:
    """The thrusters of a morphology at rest as lines of an aligned table; none: no lines.

    Position and direction (core frame), thrust at both ends of its command's range, lag and torque
    ratio.
    """
    rows = [
        ["#", "thruster", "x", "y", "z", "axis x", "y", "z", "astern", "ahead", "lag", "torque"],
        ["", "", "(m)", "(m)", "(m)", "", "", "", "(N)", "(N)", "(s)", "(m)"],
    ]
    for index, k in morphology.thrusters:
        module = morphology.modules[index]
        part = module.kind.parts[k]
        thruster = part.thruster
        assert thruster is not None
        local = np.add(part.position, thruster.position)
        here = _meters(module.position + module.rotation @ local)
        axis = (f"{round(x, 5):z.3g}" for x in module.rotation @ thruster.axis)
        thrusts = (f"{thruster.thrust_at(command):.4g}" for command in thruster.range)
        lag, torque = f"{thruster.time_constant:g}", f"{thruster.torque_ratio:g}"
        rows.append([str(index), module.name, *here, *axis, *thrusts, lag, torque])
    return align(rows, left=(1,)) if len(rows) > 2 else []


def summary(morphology: Morphology, density: float, gravity: float) -> list[str]:
    """Totals, weights and descriptors of a morphology as aligned lines.

    Args:
        morphology: what to describe.
        density: of the water [kg/m³].
        gravity: [m/s²].
    """
    mass, volume = morphology.mass, morphology.volume
    lifted = sum(part.lifted_volume for m in morphology.modules for part in m.kind.parts)
    weight, buoyancy = mass * gravity, density * lifted * gravity
    relative = mass / (density * lifted) if lifted > 0.0 else math.inf
    net = weight - buoyancy
    verdict = "sinks" if net > 0 else "floats"
    verdict = "neutral" if abs(net) <= 1e-9 * weight else verdict
    rows = [
        ("modules", f"{morphology.num_modules}", ""),
        ("hinges", f"{morphology.num_hinges}", ""),
        ("thrusters", f"{morphology.num_thrusters}", ""),
        ("fins", f"{morphology.num_fins}", ""),
        ("mass", f"{mass:.6g}", "kg"),
        ("volume (displaced)", f"{1e6 * volume:.6g}", "cm³"),
        ("volume of the boxes", f"{1e6 * morphology.box_volume:.6g}", "cm³"),
        ("extent at rest", " x ".join(f"{edge:.4f}" for edge in morphology.extent), "m"),
        ("centre of mass at rest", " ".join(_meters(morphology.center_of_mass)), "m"),
        ("centre of volume at rest", " ".join(_meters(morphology.center_of_volume)), "m"),
        ("weight in air", f"{weight:.4f}", "N"),
        (f"buoyancy in water of {density:g} kg/m³", f"{buoyancy:.4f}", "N"),
        ("net weight in water", f"{net:z.4f}", f"N ({verdict})"),
        ("relative density", f"{relative:.5f}", "mass / mass of displaced water"),
    ]
    rows += [
        ("overlap at rest", f"{first} and {second}", "") for first, second in morphology.overlaps
    ]
    descriptors = [
        (f"  {key}", f"{value:.6g}", UNITS[key]) for key, value in morphology.descriptors.items()
    ]
    return [*align(rows, left=(0, 2)), "", "descriptors", *align(descriptors, left=(0, 2))]


def _meters(values: Iterable[float]) -> list[str]:
    """Coordinates to five places, without the minus of a rounded zero."""
    return [f"{value:z.5f}" for value in values]
