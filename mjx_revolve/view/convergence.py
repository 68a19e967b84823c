"""Pictures of the convergence of evolution: fitness over generations, and final scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from mjx_revolve.view.plots import (
    BLUE,
    COLORS,
    DEEP,
    GREEN,
    GREY,
    LABELS,
    ORANGE,
    WIDE,
    curve_with_band,
    in_style,
    label_of,
    legend_above,
    legend_outside,
    letter,
    limit_to_most,
    new_figure,
    style_of,
    whole_numbers,
    with_unit,
)
from mjx_revolve.view.statistics import FEWEST, interval, mean_and_half

if TYPE_CHECKING:
    from mjx_revolve.view.report.groups import RunGroup

Metrics = Mapping[str, np.ndarray]
"""Columns of `metrics.csv` by name, `[T]` each."""
Curve = tuple[np.ndarray, np.ndarray]
"""Abscissae and best score so far of a run, `[T]` each."""

# What is drawn of evolving bodies in place of the step size, the first that there is.
_BODIES = {
    "coverage": "share of the\narchive's cells", "mean_num_modules": "modules, mean\nof the living"
}  # fmt: skip
# Curves of runs that differ in length by more than this share a logarithmic axis.
_LOG_FROM = 5.0

# Most cases with scores beside the curves rather than below; and most cases named in legends.
_MOST_BESIDE, _MOST_NAMED = 20, 10

COLONY_LABEL = "fitness in the colony"
"""Name of a colony's fitness, which is not its champion's score."""
_SECONDS, _MINUTES = 180.0, 3 * 3600.0  # ends of time axes in seconds and in minutes [s]


def scale_time(end: float) -> tuple[float, str]:
    """Seconds in a unit that suits a time axis up to `end` [s], and the axis' label."""
    if end < _SECONDS:
        return 1.0, "time (s)"
    return (60.0, "time (min)") if end <= _MINUTES else (3600.0, "time (h)")


# --- one run --------------------------------------------------------------------------------------


def _three_axes(title: str, xlabel: str, x: np.ndarray) -> tuple[Figure, Axes, Axes, Axes]:
    """A figure with a wide panel above two narrow ones that share its horizontal axis."""
    figure = new_figure(8.0, 6.0, title)
    grid = figure.add_gridspec(2, 2, height_ratios=(2.4, 1.0))
    top = figure.add_subplot(grid[0, :])
    left, right = (figure.add_subplot(grid[1, k], sharex=top) for k in (0, 1))
    for axes in (top, left, right):
        axes.set_xlabel(xlabel)
    margin = 0.015 * max(float(x[-1] - x[0]), 1.0)
    top.set_xlim(x[0] - margin, x[-1] + margin)
    return figure, top, left, right


def _draw_fitness(axes: Axes, x: np.ndarray, metrics: Metrics, best: str, ever: str) -> None:
    """Middle and spread of the population, the best, and the best so far, as far as known."""
    dot = "o" if len(x) < 3 else None
    low = metrics.get("best", np.full(len(x), np.nan))
    dash: str | tuple = "-"
    if "lower_quartile" in metrics and "upper_quartile" in metrics:
        low = metrics["lower_quartile"]
        curve_with_band(axes, x, None, low, metrics["upper_quartile"], BLUE, band="quartiles")
    elif "mean" in metrics and "std" in metrics:
        mean, std = metrics["mean"], metrics["std"]
        low, dash = mean - std, (0, (2, 1.2))
        curve_with_band(axes, x, mean, low, mean + std, BLUE, label="mean",
                        band="mean ± standard deviation", marker=dot)  # fmt: skip
    if "median" in metrics:
        axes.plot(x, metrics["median"], color=GREEN, linestyle=dash, label="median", marker=dot)
    if "best" in metrics:
        axes.plot(x, metrics["best"], color=ORANGE, linewidth=1.1, label=best, marker=dot)
    if "champion" in metrics:
        # Straight as the best's line is: a step would lie below it between two rows.
        axes.plot(x, metrics["champion"], color=DEEP, linewidth=1.4, linestyle=(0, (5, 2)),
                  label=ever)  # fmt: skip
    highs = [metrics[name] for name in ("best", "champion") if name in metrics]
    limit_to_most(axes, [low], highs or [low])
    legend_above(axes, 0.0)


@in_style
def plot_fitness(metrics: Metrics, title: str = "", label: str = "fitness") -> Figure:
    """Draws how the fitness grew.

    Args:
        metrics: generation, and as far as they are known best, mean, std, median, the quartiles,
            champion, step_size and measures of each generation's best.
        title: a line above the picture.
        label: what the fitness measures, with its unit.

    Returns:
        The figure: fitness on top, below it a measure (the speed, if there) and the step size, or
        where bodies evolve how full the archive is, or how large they are.
    """
    metrics = {name: np.asarray(column) for name, column in metrics.items()}
    x = metrics["generation"]
    dot = "o" if len(x) < 3 else None
    figure, top, left, right = _three_axes(title, "generation", x)
    _draw_fitness(top, x, metrics, "best", "best so far")
    top.set_ylabel(label)
    whole_numbers(top)
    known = [name for name in LABELS if name in metrics]
    rate = ["evaluations_per_second"] if "evaluations_per_second" in metrics else []
    if names := known + rate:
        left.plot(x, metrics[names[0]], color=ORANGE, linewidth=1.1, marker=dot)
        of = "\nof the best" if known else ""
        left.set_ylabel(label_of(names[0]).replace(" (", "\n(") + of, fontsize=9)
    bodies = [name for name in _BODIES if name in metrics]
    if "step_size" in metrics:
        right.plot(x, metrics["step_size"], color=GREY, marker=dot)
        right.set_ylabel("step size\n(gene units)", fontsize=9)
        if np.all(metrics["step_size"] > 0):
            right.set_yscale("log")
            right.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            right.yaxis.set_major_formatter("{x:g}")
            right.yaxis.set_minor_locator(NullLocator())
    elif bodies:
        right.plot(x, metrics[bodies[0]], color=GREY, marker=dot)
        right.set_ylabel(_BODIES[bodies[0]], fontsize=9)
    else:
        right.remove()
    return figure


@in_style
def plot_colony(metrics: Metrics, title: str = "") -> Figure:
    """Draws the fitness of a colony's robots.

    Args:
        metrics: time, best, median, the quartiles and champion; mean_age, mean_num_modules and
            mean_num_hinges where they are there.
        title: a line above the picture.

    Returns:
        The figure: on top, fitness of the living that have lived as long as it is measured; below
        it, mean age and size of all.
    """
    scale, words = scale_time(float(metrics["time"][-1]))
    time = metrics["time"] / scale
    dot = "o" if len(time) < 3 else None
    figure, top, ages, sizes = _three_axes(title, words, time)
    _draw_fitness(top, time, metrics, "best alive", "fittest ever")
    top.set_xlim(-0.012 * time[-1], 1.012 * time[-1])
    top.set_ylabel(COLONY_LABEL)
    if "mean_age" in metrics:
        age, unit = scale_time(float(np.nanmax(metrics["mean_age"], initial=0.0)))
        ages.plot(time, metrics["mean_age"] / age, color=GREY, marker=dot)
        ages.set_ylabel(f"mean age\nof the living{unit.removeprefix('time')}", fontsize=9)
    for name in ("modules", "hinges"):
        if f"mean_num_{name}" in metrics:
            sizes.plot(time, metrics[f"mean_num_{name}"], marker=dot, label=name)
    sizes.set_ylabel("mean of\nthe living", fontsize=9)
    legend_above(sizes)
    for axes in (ages, sizes):
        axes.set_ylim(bottom=0)
    return figure


# --- several runs ---------------------------------------------------------------------------------


def draw_curves(
    axes: Axes, cases: Mapping[str, Sequence[Curve]], numbers: Sequence[int] | None = None
) -> None:
    """Draws the best score so far of each case: mean over the seeds, its band, and each seed.

    Args:
        axes: to draw into.
        cases: runs by case. The mean reaches from where all of them have begun to where the first
            one ends; it has its 95 % confidence band from three runs on.
        numbers: of the cases, for their colours and dashes; None: as they come.
    """
    limits = []
    for k, (name, curves) in zip(numbers or range(len(cases)), cases.items(), strict=True):
        style = style_of(k)
        for x, y in curves:
            dot = "o" if len(x) < 3 else None
            axes.plot(x, y, linewidth=0.7, alpha=0.4, zorder=2, marker=dot, markersize=4, **style)
        grid = np.unique(np.concatenate([x for x, _ in curves]))
        # Until then every rollout of a seed has failed: it has no score.
        begun = [x[np.isfinite(y)][:1] for x, y in curves]
        first = np.max(begun) if all(map(len, begun)) else np.inf
        last = min(x[-1] for x, _ in curves)
        grid = grid[(grid >= first) & (grid <= last)]
        dot = "o" if len(grid) < 3 else None
        mean, half, _ = mean_and_half([np.interp(grid, x, y) for x, y in curves])
        half = half if len(curves) >= FEWEST else np.full(len(grid), np.nan)
        curve_with_band(axes, grid, mean, mean - half, mean + half, linewidth=2.0, zorder=3,
                        label=f"{name}, n = {len(curves)}", marker=dot, **style)  # fmt: skip
        limits += [y for _, y in curves] + [mean - half, mean + half]
    limit_to_most(axes, limits, limits)
    ends = [float(x[-1]) for curves in cases.values() for x, _ in curves]
    if max(ends) > _LOG_FROM * min(ends):
        axes.set_xscale("log")
    else:
        whole_numbers(axes, 7)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))


def draw_scores(
    axes: Axes, groups: Mapping[str, Sequence[float]], numbers: Sequence[int] | None = None
) -> None:
    """Draws a dot for each seed, and beside them mean and 95 % interval (from three seeds on).

    Args:
        axes: to draw into.
        groups: values by case; the names are the ticks.
        numbers: of the cases, for their colours; None: as they come.
    """
    numbers = numbers or range(len(groups))
    for k, (number, values) in enumerate(zip(numbers, groups.values(), strict=True)):
        color = COLORS[number % len(COLORS)]
        reach = min(0.03 * (len(values) - 1), 0.2)
        axes.plot(k - 0.1 + np.linspace(-reach, reach, len(values)), values, "o", color=color,
                  alpha=0.5, markersize=5, markeredgewidth=0)  # fmt: skip
        found = interval(values)
        half = found.half if found.size >= FEWEST else np.nan
        axes.errorbar(k + 0.2, found.mean, yerr=half, fmt="D", color=color, markersize=5, capsize=3)
    axes.set_xticks(range(len(groups)), [name.replace("_", "\n") for name in groups])
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.grid(False, axis="x")


def plot_comparison(groups: Sequence[RunGroup], numbers: Mapping[str, int]) -> Figure:
    """Draws configurations beside each other.

    Args:
        groups: configurations of one task.
        numbers: of the groups by name, for their colours.

    Returns:
        The figure: `draw_curves` of the best so far, and `draw_scores` of the champions.
    """
    shown = [group for group in groups if group.shown]
    records = [record for group in shown for record in group.shown]
    sizes = {group.settings.get("evolution.population_size") for group in shown}
    counted = len(sizes) > 1 and all("evaluations" in r.metrics for r in records)
    over = "evaluations" if counted else "generation"
    curves = {
        numbers[group.name]: [(r.metrics[over], r.metrics["champion"]) for r in group.shown
                              if "champion" in r.metrics] for group in shown
    }  # fmt: skip
    what = records[0].fitness if records else "fitness"
    return plot_cases(
        {number: name for name, number in numbers.items()},
        {number: own for number, own in curves.items() if own},
        {numbers[group.name]: group.scores() for group in groups},
        "evaluations" if counted or not records else records[0].round,
        f"best {what.replace('fitness', 'fitness so far', 1)}",
        groups[0].unit,
    )


@in_style
def plot_cases(
    names: Mapping[int, str],
    curves: Mapping[int, Sequence[Curve]],
    scores: Mapping[int, Sequence[float]],
    over: str,
    best: str,
    unit: str,
) -> Figure:
    """Draws cases beside each other: the best so far of each, and the champions' final scores.

    Args:
        names: of the cases by number, which gives letter and colour.
        curves: of each case with any, see `draw_curves`.
        scores: of each case, see `draw_scores`.
        over: label of the curves' abscissa.
        best: label of their ordinate.
        unit: of the scores; "" where it is not known.

    Returns:
        The figure; scores of many cases are below the curves.
    """
    if len(scores) <= _MOST_BESIDE:
        figure = new_figure(WIDE, 4.4)
        left, right = figure.subplots(1, 2, width_ratios=(2.3, max(1.0, 0.12 * len(scores))))
    else:
        figure = new_figure(WIDE, 8.0)
        left, right = figure.subplots(2, 1)
    if curves:
        # Names of many cases would take more room than their curves; tables have them.
        more = "" if len(curves) > _MOST_NAMED else ": {}"
        named = {letter(k) + more.format(names[k]): own for k, own in curves.items()}
        draw_curves(left, named, list(curves))
    left.set(xlabel=over, ylabel=best, title="mean over seeds and 95 % confidence band")
    legend_outside(figure, left, 2 if len(curves) <= _MOST_NAMED else 8)
    draw_scores(right, {letter(k): own for k, own in scores.items()}, list(scores))
    right.set(ylabel=with_unit("champion's score", unit), title="final, on fresh starts")
    return figure
