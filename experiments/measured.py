"""Our water beside what others have measured: tables and pictures, nothing tuned.

``python -m experiments.measured [--quick] [--out DIR]``

Bodies and numbers are published ones (`measured.yaml`, `measured_data.py`); `measured_cases.py`
asks the engine for the same. `docs/measured.md` discusses the result.
"""

from __future__ import annotations

import csv
import io
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.common import check_whole, make_folder, make_parser, write_results
from mjx_revolve.body.table import align
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.files import short_path, write_atomic
from mjx_revolve.view.plots import WIDE, in_style, new_figure

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from experiments.measured_cases import Found, Row

HEADINGS = ("case", "quantity", "measured", "ours", "ours / measured", "unit")
_GREY = "#6b7680"


def table(rows: Sequence[Row]) -> list[tuple[str, ...]]:
    """The table's rows, headings first."""
    cells = [
        (r.case, r.what, f"{r.measured:.3g}", f"{r.ours:.3g}", f"{r.ratio:.2f}", r.unit)
        for r in rows
    ]
    return [HEADINGS, *cells]


def group(
    rows: Sequence[Row], by_law: Mapping[str, Mapping[str, float]]
) -> dict[str, list[dict[str, Any]]]:
    """Rows by case as the results file has them, with what other laws give of the same."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        others = {law: ours.get(row.what) for law, ours in by_law.items()}
        entry = asdict(row) | others | {"name": row.what, "ratio": row.ratio}
        found.setdefault(row.case, []).append(entry)
    return found


def _pair() -> tuple[Any, Any, Any]:
    """A figure with two axes beside each other."""
    figure = new_figure(WIDE, 3.6)
    left, right = figure.subplots(1, 2)
    return figure, left, right


def _finish(*all_axes: Any, legends: bool = True) -> None:
    for axes in all_axes:
        if legends and axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=8)


@in_style
def draw_drag(steady: Found, oscillating: Found, faces: Found) -> Any:
    """C_d of bodies in a steady flow, and of a plate in an oscillating one."""
    from experiments.measured_data import plate_drag, plate_drag_at_bilge
    from mjx_revolve.view.plots import COLORS

    figure, left, right = _pair()
    place = np.arange(len(steady.rows))[::-1]
    left.barh(place + 0.2, [r.measured for r in steady.rows], 0.36, color=_GREY, label="measured")
    left.barh(place - 0.2, [r.ours for r in steady.rows], 0.36, color=COLORS[0], label="ours")
    left.set_yticks(place, [r.what for r in steady.rows], fontsize=8)
    left.set_xlabel("C_d on the frontal area", fontsize=9)
    left.set_title("steady drag")
    number, ours = oscillating.lines["cross_flow"]
    fine = np.geomspace(number[0], number[-1], 100)
    right.plot(fine, [plate_drag(x) for x in fine], color=_GREY, label="measured (fit)")
    bilge = [plate_drag_at_bilge(x) for x in fine]
    right.plot(fine, bilge, color=_GREY, linestyle=":", label="measured (bilge keels)")
    right.plot(number, ours, "o-", color=COLORS[0], label="ours", markersize=4)
    right.plot(*faces.lines["faces"], "s-", color=COLORS[1], markersize=4,
               label="drag: faces")  # fmt: skip
    right.axvspan(5, 15, color=COLORS[4], alpha=0.12, linewidth=0)
    right.text(8.6, 0.15, "limbs", fontsize=8, ha="center", color="#8a6000")
    right.set_xscale("log")
    right.set_xticks([3, 5, 10, 30, 100], ["3", "5", "10", "30", "100"])
    right.minorticks_off()
    right.set_ylim(0, None)
    right.set_xlabel("Keulegan-Carpenter number U T / b", fontsize=9)
    right.set_ylabel("C_d", fontsize=9)
    right.set_title("a plate across an oscillating flow")
    _finish(left, right)
    left.grid(visible=False, axis="y")
    return figure


@in_style
def draw_swimmers(glide: Found, swum: Found) -> Any:
    """Speeds of chains that swim, ours over measured; and a chain that glides."""
    from experiments.measured_data import AMPHIBOT_GLIDE
    from mjx_revolve.view.plots import COLORS

    figure, left, right = _pair()
    for case, mark in (("lamprey robot", "o"), ("AmphiBot", "s")):
        rows = [r for r in swum.rows if r.case == case]
        left.plot([r.measured for r in rows], [r.ours for r in rows], mark, color=COLORS[0],
                  markersize=5, label=case)  # fmt: skip
    left.plot([0, 0.7], [0, 0.7], color=_GREY, linewidth=1, label="as measured")
    left.set_xlabel("speed measured (m/s)", fontsize=9)
    left.set_ylabel("ours (m/s)", fontsize=9)
    left.set_title("robots that swim by their joints")
    for color, what, scale, unit in (
        (COLORS[0], "way", 100, "cm"),
        (COLORS[1], "rotation", -1, "°"),
    ):
        time, ours = glide.lines[what]
        theirs = scale * np.array(getattr(AMPHIBOT_GLIDE, what))
        right.plot(AMPHIBOT_GLIDE.time, theirs, "o", color=color, markersize=4.5,
                   label=f"measured, {what} ({unit})")  # fmt: skip
        right.plot(time, scale * ours, color=color, label=f"ours, {what} ({unit})")
    right.set_xlabel("time (s)", fontsize=9)
    right.set_ylabel("way (cm), rotation clockwise (°)", fontsize=9)
    right.set_title("AmphiBot glides, joints frozen")
    _finish(left, right)
    return figure


@in_style
def draw_polars(found: Found) -> Any:
    """Lift and drag coefficients of plates over their angle of attack."""
    from experiments.measured_data import POLARS
    from mjx_revolve.view.plots import COLORS

    figure, left, right = _pair()
    for axes, what in ((left, "lift"), (right, "drag")):
        for color, mark, polar in zip((COLORS[0], COLORS[1]), "os", POLARS, strict=True):
            angle, ours = found.lines[polar.module, what]
            shown = angle <= 45
            name = f"aspect ratio {polar.aspect:g}"
            axes.plot(angle[shown], ours[shown], color=color, label=f"ours, {name}")
            axes.plot(polar.angle, getattr(polar, what), mark, color=color, markersize=4.5,
                      label=f"measured, {name}")  # fmt: skip
        axes.set_xlabel("angle of attack (deg)", fontsize=9)
        axes.set_ylabel(f"C_{what[0]}", fontsize=9)
        axes.set_title(f"{what} of flat plates")
    _finish(left, right)
    if len(right.get_lines()) == 4:
        # Both aspect ratios have the same drag to us.
        right.get_lines()[2].set_linestyle((0, (4, 4)))
        right.legend(frameon=False, fontsize=8)
    return figure


@in_style
def draw_coins(found: Found) -> Any:
    """Speeds of coins that fall, and where they land."""
    from experiments.measured_data import COINS, VISCOSITY
    from mjx_revolve.view.plots import COLORS

    figure, left, right = _pair()
    place = np.arange(len(COINS))
    names = [f"{coin.module.removeprefix('Coin')} Kč" for coin in COINS]
    rows = {unit: [r for r in found.rows if r.unit == unit] for unit in ("m/s", "cm")}
    left.plot(place, [c.speed for c in COINS], "o", color="#3b3b3b", label="measured, mean track")
    left.plot(place, [c.reynolds * VISCOSITY / c.diameter for c in COINS], "o", color="#3b3b3b",
              markerfacecolor="white", label="measured, from Reynolds numbers")  # fmt: skip
    left.plot(place, [r.ours for r in rows["m/s"]], "s", color=COLORS[0], label="ours")
    left.set_ylim(0, 0.7)
    left.set_ylabel("speed (m/s)", fontsize=9)
    left.set_title("coins that fall")
    right.bar(place - 0.2, [c.landing for c in COINS], 0.36, color=_GREY, label="measured")
    right.bar(place + 0.2, [r.ours for r in rows["cm"]], 0.36, color=COLORS[0], label="ours")
    right.set_yscale("log")
    right.set_ylim(0.05, 90)
    right.set_yticks([0.1, 1, 10], ["0.1", "1", "10"])
    right.set_ylabel("distance from the plumb line (cm)", fontsize=9)
    right.set_title("where they land")
    for axes in (left, right):
        axes.set_xticks(place, names, fontsize=9)
    _finish(left, right)
    return figure


@in_style
def draw_rov(found: Found) -> Any:
    """Drag over speed, and added mass, of a remotely operated vehicle."""
    from experiments.measured_data import ROV_DRAG
    from mjx_revolve.view.plots import COLORS

    figure, left, right = _pair()
    for color, (name, (linear, square)) in zip(COLORS, ROV_DRAG.items(), strict=False):
        speed, ours = found.lines[name]
        left.plot(speed, (linear + square * speed) * speed, color=color, linestyle="--",
                  label=f"identified, {name}")  # fmt: skip
        left.plot(speed, ours, color=color, label=f"ours, {name}")
    left.set_xlabel("speed (m/s)", fontsize=9)
    left.set_ylabel("drag (N)", fontsize=9)
    left.set_title("BlueROV2 Heavy: drag")
    rows = [r for r in found.rows if r.unit == "kg"]
    place = np.arange(len(rows))
    right.bar(place - 0.2, [r.measured for r in rows], 0.36, color=_GREY, label="identified")
    right.bar(place + 0.2, [r.ours for r in rows], 0.36, color=COLORS[0], label="ours")
    right.set_xticks(place, [r.what.rsplit(" ", 1)[1] for r in rows], fontsize=9)
    right.set_ylabel("added mass (kg)", fontsize=9)
    right.set_title("added mass")
    _finish(left, right)
    right.grid(visible=False, axis="x")
    return figure


@in_style
def draw_section(found: Found) -> Any:
    """Heave and roll of a ship's section in regular waves."""
    from experiments.measured_data import (
        SECTION_BREADTH,
        SECTION_FREE,
        SECTION_HELD,
        WAVE_AMPLITUDE,
    )
    from mjx_revolve.view.plots import COLORS

    figure, left, right = _pair()
    steepness = lambda xi: np.degrees(2 * xi / SECTION_BREADTH * WAVE_AMPLITUDE)  # noqa: E731
    scales = {"heave": lambda xi: 1e3 * WAVE_AMPLITUDE, "roll": steepness}
    words = {"heave": "heave / wave amplitude", "roll": "roll / wave slope"}
    for axes, (what, scale) in zip((left, right), scales.items(), strict=True):
        xi, ours = found.lines[what]
        axes.plot(xi, ours / scale(xi), "-", color=COLORS[0], label="ours")
        for mark, fill, label, runs in (
            ("o", "#3b3b3b", "measured, free", SECTION_FREE),
            ("o", "white", "measured, one motion held", SECTION_HELD),
        ):
            some = [(m.xi, getattr(m, what)) for m in runs if getattr(m, what) is not None]
            at, value = np.array(some).T
            axes.plot(at, value / scale(at), mark, color="#3b3b3b", markerfacecolor=fill,
                      markersize=5, label=label)  # fmt: skip
        axes.set_xlabel("ξ = ω² B / 2 g", fontsize=9)
        axes.set_ylabel(words[what], fontsize=9)
        axes.set_title(f"a ship's section in waves: {what}")
    _finish(left, right)
    return figure


def main(argv: list[str] | None = None) -> int:
    """Asks the engine, prints the table, writes `measured.csv` and the pictures."""
    parser = make_parser("measured", "Our water beside what others have measured.")
    parser.add_argument("--quick", action="store_true", help="without the section in waves")
    options = parser.parse_args(argv)
    check_whole(parser, options, "quick")
    folder = make_folder(options.out, "measured")

    from mjx_revolve.numerics.runtime import prepare_process

    prepare_process()
    from experiments import measured_cases as cases
    from mjx_revolve.view.plots import figure_png

    steady, swung = cases.steady_drag(), cases.oscillating()
    on_faces = cases.oscillating(drag="faces")
    plates, falls, vehicle = cases.polars(), cases.coins(), cases.rov()
    glide, swum = cases.amphibot_glide(), cases.swimmers()
    figures = {
        "measured_swimmers": draw_swimmers(glide, swum),
        "measured_drag": draw_drag(steady, swung, on_faces),
        "measured_plates": draw_polars(plates),
        "measured_coins": draw_coins(falls),
        "measured_rov": draw_rov(vehicle),
    }
    rows = [
        *glide.rows,
        *swum.rows,
        *cases.foil(),
        *steady.rows,
        cases.sinking_plate(),
        *swung.rows,
        *plates.rows,
        *falls.rows,
        *vehicle.rows,
    ]
    if not options.quick:
        floats = cases.section()
        rows += floats.rows
        figures["measured_section"] = draw_section(floats)
    lines = table(rows)
    print("\n".join(align([lines[0], ("",) * len(HEADINGS), *lines[1:]], left=(0, 1))))
    by_law = {}
    for law in cases.LAWS[1:]:
        by_law[law] = {r.what: r.ours for r in cases.steady_drag(law).rows}
        numbers = ", ".join(f"{ours:.2f} {what}" for what, ours in by_law[law].items())
        print(f"steady C_d by drag: {law}: {numbers}")
    bias, scatter = cases.log_scatter([r for r in swum.rows if r.case == "lamprey robot"][:-1])
    print(f"lamprey robot, nine gaits: bias {bias:.2f}, scatter {scatter:.2f}")
    if options.results:
        law = "faces"
        former = [*cases.amphibot_glide(law).rows, *cases.swimmers(law).rows, *cases.foil(law)]
        former += [*on_faces.rows, *cases.steady_drag(law).rows, cases.sinking_plate(law)]
        former += [*cases.polars(drag=law).rows, *cases.coins(law).rows]
        few = [r for r in former if r.case == "lamprey robot"][:-1]
        numbers: dict[str, Any] = {
            "lamprey": {"bias": bias, "scatter": scatter},
            "cases": group(rows, by_law | {law: {r.what: r.ours for r in former}}),
            "faces": {
                "lamprey": dict(zip(("bias", "scatter"), cases.log_scatter(few), strict=True)),
                "cases": group(former, {}),
            },
        }
        write_results("measured", numbers, ())
        close = cases.section((0.55, 0.6, 1.0, 1.25), near_surface=True)
        write_results("near_surface", group(close.rows, {}), ())
    text = io.StringIO()
    csv.writer(text).writerows(lines)
    write_atomic(folder / "measured.csv", text.getvalue().encode())
    for name, figure in figures.items():
        write_atomic(folder / f"{name}.png", figure_png(figure))
    names = ", ".join(["measured.csv", *(f"{name}.png" for name in figures)])
    print(f"\nwritten: {names} in {short_path(folder)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
