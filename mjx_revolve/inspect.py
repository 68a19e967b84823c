"""Command line: what a morphology file holds, what it weighs in air and in water, how it looks.

``python -m mjx_revolve.inspect spider.yaml --picture spider.png``
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence

import numpy as np

from mjx_revolve.body.catalogue import MODULES, load_modules
from mjx_revolve.body.module_types import check_number
from mjx_revolve.body.morphology import Morphology, load_morphology
from mjx_revolve.inputs.commands import Parser, read_path, run_command

# Fresh water at 15 °C, the thesis's value [kg/m³].
_DENSITY = 999.1026
_GRAVITY = 9.81  # m/s²

# Of the descriptors that have one.
_UNITS = {"mass": "kg", "volume": "m3", "box_volume": "m3"}
_UNITS |= dict.fromkeys(("extent_x", "extent_y", "extent_z", "length"), "m")


def _align(rows: Sequence[Sequence[str]], left: Sequence[int]) -> list[str]:
    """Lines of a table whose columns `left` are set to the left, the others to the right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
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
        ["", "", "", "", "", "[deg]", "[m]", "[m]", "[m]", "[kg]", "[cm3]"],
    ]
    for k, module in enumerate(morphology.modules):
        has_parent = module.parent >= 0
        rows.append(
            [
                str(k),
                module.name,
                module.type,
                str(module.parent) if has_parent else "-",
                str(module.slot) if has_parent else "-",
                f"{module.orientation:g}" if has_parent else "-",
                *(f"{value + 0.0:.5f}" for value in _rounded(module.position)),
                f"{module.kind.mass:.4f}",
                f"{1e6 * module.kind.volume:.3f}",
            ]
        )
    return _align(rows, left=(1, 2))


def thruster_table(morphology: Morphology) -> list[str]:
    """The thrusters of a morphology at rest as lines of an aligned table; none: no lines.

    Where each pushes, which way (core frame), its thrust at both ends of its command's range, its
    lag and its torque ratio.
    """
    rows = [
        ["#", "thruster", "x", "y", "z", "axis x", "y", "z", "astern", "ahead", "lag", "torque"],
        ["", "", "[m]", "[m]", "[m]", "[-]", "[-]", "[-]", "[N]", "[N]", "[s]", "[m]"],
    ]
    for index, k in morphology.thrusters:
        module = morphology.modules[index]
        part = module.kind.parts[k]
        thruster = part.thruster
        assert thruster is not None
        local = np.add(part.position, thruster.position)
        low, high = thruster.range
        rows.append(
            [
                str(index),
                module.name,
                *(f"{x:.5f}" for x in _rounded(module.position + module.rotation @ local)),
                *(f"{x:.3g}" for x in _rounded(module.rotation @ thruster.axis)),
                f"{thruster.thrust_at(low):.4g}",
                f"{thruster.thrust_at(high):.4g}",
                f"{thruster.time_constant:g}",
                f"{thruster.torque_ratio:g}",
            ]
        )
    return _align(rows, left=(1,)) if len(rows) > 2 else []


def _rounded(values: Iterable[float]) -> list[float]:
    """Values to five places, without the minus of a rounded zero."""
    return [round(float(value), 5) + 0.0 for value in values]


def summary(
    morphology: Morphology, density: float = _DENSITY, gravity: float = _GRAVITY
) -> list[str]:
    """Totals, weights and descriptors of a morphology as aligned lines.

    Args:
        morphology: what to describe.
        density: of the water [kg/m³].
        gravity: [m/s²].
    """
    mass, volume = morphology.mass, morphology.volume
    weight, buoyancy = mass * gravity, density * volume * gravity
    relative = mass / (density * volume) if volume > 0.0 else math.inf
    net = weight - buoyancy
    verdict = "sinks" if net > 0 else "floats"
    verdict = "neutral" if abs(net) <= 1e-9 * weight else verdict
    extent = " x ".join(f"{value:.4f}" for value in morphology.extent)
    rows = [
        ("modules", f"{morphology.num_modules}", ""),
        ("hinges", f"{morphology.num_hinges}", ""),
        ("thrusters", f"{morphology.num_thrusters}", ""),
        ("fins", f"{morphology.num_fins}", ""),
        ("mass", f"{mass:.6g}", "kg"),
        ("volume (displaced)", f"{1e6 * volume:.6g}", "cm3"),
        ("volume of the boxes", f"{1e6 * morphology.box_volume:.6g}", "cm3"),
        ("extent at rest", extent, "m"),
        ("centre of mass at rest", _place(morphology.center_of_mass), "m"),
        ("centre of volume at rest", _place(morphology.center_of_volume), "m"),
        ("weight in air", f"{weight:.4f}", "N"),
        (f"buoyancy in water of {density:g} kg/m3", f"{buoyancy:.4f}", "N"),
        ("net weight in water", f"{net:.4f}", f"N ({verdict})"),
        ("relative density", f"{relative:.5f}", "mass / mass of displaced water"),
    ]
    rows += [
        ("overlap at rest", f"{first} and {second}", "") for first, second in morphology.overlaps
    ]
    lines = _columns(rows)
    lines += ["", "descriptors"]
    lines += _columns(
        [
            (f"  {key}", f"{value:.6g}", _UNITS.get(key, ""))
            for key, value in morphology.descriptors.items()
        ]
    )
    return lines


def _place(values: Iterable[float]) -> str:
    return " ".join(f"{value:.5f}" for value in _rounded(values))


def _columns(rows: Sequence[tuple[str, str, str]]) -> list[str]:
    """Lines of name, value and unit, with names and values aligned."""
    name, value = (max(len(row[k]) for row in rows) for k in (0, 1))
    return [f"{row[0]:<{name}}  {row[1]:>{value}}  {row[2]}".rstrip() for row in rows]


def _quantity(text: str, name: str, unit: str) -> float:
    """A positive number given as an option."""
    try:
        value: float | str = float(text)
    except ValueError:
        value = text
    return check_number(value, f"--{name}", unit, above=True)


def main(argv: list[str] | None = None) -> int:
    """Prints what a morphology file holds; with `--picture`, draws it.

    Args:
        argv: the arguments; None: those of the process.

    Returns:
        0.

    Raises:
        InputError: an argument or a file is wrong.
    """
    parser = Parser(
        prog="python -m mjx_revolve.inspect",
        description="Show the modules, weights and descriptors of a morphology.",
    )
    parser.add_argument("file", type=read_path, help="morphology YAML")
    parser.add_argument("--picture", type=read_path, metavar="OUT.png", help="draw it as well")
    parser.add_argument(
        "--density", default=str(_DENSITY), help="of the water [kg/m3] (default %(default)s)"
    )
    parser.add_argument("--gravity", default=str(_GRAVITY), help="[m/s2] (default %(default)s)")
    parser.add_argument(
        "--modules", type=read_path, metavar="MY.yaml", help="module types of your own"
    )
    parser.add_argument(
        "--allow-overlap", action="store_true", help="accept modules that reach into each other"
    )
    arguments = parser.parse_args(argv)
    density = _quantity(arguments.density, "density", "kg/m3")
    gravity = _quantity(arguments.gravity, "gravity", "m/s2")
    modules = MODULES
    if arguments.modules is not None:
        modules = MODULES | load_modules(arguments.modules)
    morphology = load_morphology(
        arguments.file, modules=modules, allow_overlap=arguments.allow_overlap
    )
    if arguments.picture is not None:
        # Matplotlib takes a second to import: only for those who ask for a picture.
        from mjx_revolve.view.pictures import draw_morphology

        draw_morphology(morphology, arguments.picture)
    print(f"{arguments.file}: {morphology.name}")
    print()
    for table in (module_table(morphology), thruster_table(morphology)):
        if table:
            print("\n".join(table))
            print()
    print("\n".join(summary(morphology, density, gravity)))
    if arguments.picture is not None:
        print(f"\npicture: {arguments.picture}")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
