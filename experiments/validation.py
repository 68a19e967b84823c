"""Every law of the water against closed forms, as one table and the plots of a thesis.

``python -m experiments.validation [--quick] [--out DIR]``

Exit code 1 if anything is outside its tolerance. The cases are in `validation_cases.py`.
"""

from __future__ import annotations

import csv
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.common import check_whole, make_folder, make_parser, write_results
from mjx_revolve.body.table import align
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.files import short_path
from mjx_revolve.view.plots import figure_png

HEADINGS = ("case", "quantity", "expected", "found", "error", "tolerance", "unit", "")


def draw(curves: list) -> Figure:
    """All curves as panels of one figure.

    Args:
        curves: `validation_cases.Curve` each.

    Returns:
        The figure.
    """
    columns = 2
    lines = -(-len(curves) // columns)
    figure = Figure(figsize=(11, 3.2 * lines), layout="constrained")
    FigureCanvasAgg(figure)
    for axes in figure.subplots(lines, columns, squeeze=False).flat[len(curves) :]:
        axes.set_visible(False)
    for axes, curve in zip(figure.axes, curves, strict=False):
        for label, x, y, exact in curve.lines:
            style = {"color": "black", "ls": "--", "lw": 1} if exact else {"lw": 2, "alpha": 0.8}
            axes.plot(x, y, label=label, **style)
        axes.set(title=curve.title, xlabel=curve.x_label, ylabel=curve.y_label)
        axes.grid(alpha=0.3)
        if len(curve.lines) > 1:
            axes.legend(loc="best", fontsize="small")
    return figure


def main(argv: list[str] | None = None) -> int:
    """Runs the cases, prints the table, writes `validation.csv` and `validation.png`."""
    parser = make_parser("validation", "The water's laws against closed forms.")
    parser.add_argument("--quick", action="store_true", help="only the cases that are quick")
    options = parser.parse_args(argv)
    check_whole(parser, options, "quick")
    folder = make_folder(options.out, "validation")

    from mjx_revolve.numerics.runtime import prepare_process

    prepare_process()
    from experiments.validation_cases import CASES, QUICK_CASES

    table, curves, failed = [HEADINGS, ("",) * len(HEADINGS)], [], 0
    results: dict[str, list[dict[str, Any]]] = {}
    for name, case in CASES.items():
        if options.quick and name not in QUICK_CASES:
            continue
        result = case()
        curves += result.curves
        results[name] = [asdict(row) for row in result.rows]
        for row in result.rows:
            failed += not row.passed
            numbers = (row.expected, row.found, abs(row.found - row.expected), row.tolerance)
            cells = tuple(f"{np.float64(x):.4g}" for x in numbers)
            table.append((name, row.what, *cells, row.unit, "ok" if row.passed else "FAILS"))
    print("\n".join(align(table, left=(0, 1))))
    with (folder / "validation.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([row for row in table if any(row)])
    written = "validation.csv"
    if curves:
        (folder / "validation.png").write_bytes(figure_png(draw(curves)))
        written += " and validation.png"
    count = len(table) - 2
    if options.results:
        write_results("validation", {"comparisons": count, "failed": failed, "cases": results}, ())
    verdict = f"{failed} outside their tolerances" if failed else "all within their tolerances"
    print(f"\n{count} comparisons, {verdict}\nwritten: {written} in {short_path(folder)}")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
