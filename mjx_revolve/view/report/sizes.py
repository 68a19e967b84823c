"""How bodies changed over the generations of a run: a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mjx_revolve.body.descriptors import UNITS
from mjx_revolve.view.plots import COLORS, LABELS, WIDE, dress, new_figure
from mjx_revolve.view.population import Population

_PANELS = 8  # most figures that are drawn over the generations
# These first, where they differ; counts of modules of a kind that nobody has are left out.
_FIRST = (
    "num_modules", "num_hinges", "length", "mass", "symmetry", "proportion", "limbs", "branching",
    "num_fins", "num_thrusters", "num_sensors", "length_of_limbs", "coverage",
)  # fmt: skip
_BLUE, _ORANGE = COLORS[:2]


def plot_sizes(
    population: Population, named: Sequence[str] = (), over: str = "generation"
) -> Figure | None:
    """Draws how bodies changed over the generations.

    Args:
        population: of a run.
        named: figures that are shown in any case.
        over: what the generations are called.

    Returns:
        The figure, None where there is nothing to draw: of those who were alive after each
        generation the mean, the quartiles and the best one's value, for some descriptors (and
        measures, where named).
    """
    generations = np.array([g for g in population.living if population.alive(g)])
    names = [*named, *(name for name in _FIRST if name not in named)]
    table = {name: [population.figures(int(g), name) for g in generations] for name in names}
    shown = [
        name for name, rows in table.items()
        if any(np.isfinite(row).any() for row in rows)
        and (name in named or np.ptp(np.concatenate([r[np.isfinite(r)] for r in rows])) > 0)
    ][:_PANELS]  # fmt: skip
    if not shown:
        return None
    columns = min(4, len(shown))
    lines = -(-len(shown) // columns)
    figure = new_figure(WIDE, 0.5 + 1.95 * lines)
    grid = figure.subplots(lines, columns, sharex=True, squeeze=False)
    for axes in grid.flat[len(shown) :]:
        axes.remove()
    dot = "o" if len(generations) < 3 else None
    for axes, name in zip(figure.axes, shown, strict=True):
        rows = [row[np.isfinite(row)] for row in table[name]]
        known = [k for k, row in enumerate(rows) if row.size]
        x = generations[known]
        low, high = (np.array([np.quantile(rows[k], q) for k in known]) for q in (0.25, 0.75))
        axes.fill_between(x, low, high, color=_BLUE, alpha=0.18, linewidth=0, label="quartiles")
        axes.plot(x, [rows[k].mean() for k in known], color=_BLUE, linewidth=1.6, marker=dot,
                  markersize=4, label="mean of the living")  # fmt: skip
        axes.plot(x, [table[name][k][0] for k in known], color=_ORANGE, linewidth=1.1,
                  marker=dot, markersize=4, label="the best of them")  # fmt: skip
        axes.set_title(_words(name), loc="left", fontsize=9.5, color="#222222", parse_math=False)
        dress(axes)
        axes.tick_params(labelsize=8.5)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=5, steps=[1, 2, 5, 10]))
        axes.yaxis.set_major_locator(MaxNLocator(nbins=5))
    for k, axes in enumerate(figure.axes):
        if k + columns >= len(shown):  # nothing below it
            axes.tick_params(labelbottom=True)
            axes.set_xlabel(over, fontsize=9)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", fontsize=8.5, ncols=3, frameon=False)
    return figure


def _words(name: str) -> str:
    """A figure's name and unit."""
    if name in LABELS:
        return LABELS[name]
    unit = UNITS.get(name, "-")
    plain = name.removeprefix("num_").replace("_", " ")
    return plain if unit in ("-", "modules") else f"{plain} ({unit.replace('3', '³')})"
