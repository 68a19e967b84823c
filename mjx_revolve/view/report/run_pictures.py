"""Pictures of several runs: seeds of one configuration, configurations, and their champions.

The picture of one run's fitness is that of `plots`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from mjx_revolve.view.motion import Motion
from mjx_revolve.view.plots import COLORS, WIDE, dress, head, limit_to_most, new_figure
from mjx_revolve.view.report.groups import Group, mean_interval, quantiles

_INK, _PALE = "#222222", "#9aaab5"
_BLUE, _ORANGE = COLORS[:2]
_DASHES: tuple[str | tuple, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (6, 1.5, 1.5, 1.5)))
# Curves of runs that differ in length by more than this share a logarithmic axis.
_LOG_FROM = 5.0
# The interval of two seeds is wider than any page: t(0.975, 1) is 12.7.
_BAND_FROM = 3


def style_of(index: int) -> dict[str, Any]:
    """Colour and dash of a group's lines, by its number: colours first, then other dashes."""
    dash = _DASHES[(index // len(COLORS)) % len(_DASHES)]
    return {"color": COLORS[index % len(COLORS)], "linestyle": dash}


def letter(index: int) -> str:
    """What tables and pictures call a group, by its number: A, B ... Z, AA, AB ..."""
    return (letter(index // 26 - 1) if index >= 26 else "") + chr(ord("A") + index % 26)


def _legend_below(figure: Figure, axes: Axes, columns: int) -> None:
    """One legend for all axes, where it hides nothing."""
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        figure.legend(handles, labels, loc="outside lower center", fontsize=8.5, frameon=False,
                      ncols=min(columns, len(labels)))  # fmt: skip


# --- runs -----------------------------------------------------------------------------------------


def plot_seeds(group: Group) -> Figure:
    """Draws how the runs of one configuration went.

    Args:
        group: at least one run with metrics.

    Returns:
        The figure: best so far on the left, the middle of the population on the right; over the
        seeds the best, the median and the quartiles, as far as all runs reach, and each run as a
        thin line as far as it goes.
    """
    figure = new_figure(WIDE, 3.9)
    middle = "median" if all("median" in r.metrics for r in group.shown) else "mean"
    panels = (("champion", "best so far"), (middle, f"population's {middle}"))
    both = figure.subplots(1, 2, sharex=True)
    for axes, (column, words) in zip(both, panels, strict=True):
        x, values = group.curve(column)
        for record in group.shown:
            if column in record.metrics:
                axes.plot(record.metrics["generation"], record.metrics[column], color=_PALE,
                          linewidth=0.7, zorder=1)  # fmt: skip
        if len(x) and np.isfinite(values).any():
            low, median, high, best = quantiles(values, (0.25, 0.5, 0.75, 1.0))
            axes.fill_between(x, low, high, color=_BLUE, alpha=0.2, linewidth=0, label="quartiles")
            axes.plot(x, median, color=_BLUE, linewidth=1.8, label="median")
            axes.plot(x, best, color=_ORANGE, linewidth=1.3, label="best")
            axes.plot([], [], color=_PALE, linewidth=0.9, label="each run")
        axes.set_xlabel(group.shown[0].round)
        axes.set_ylabel(group.shown[0].fitness)
        head(axes, f"{words}, over {len(group.shown)} seeds")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10], nbins=6))
        dress(axes)
        curves = [r.metrics[column] for r in group.shown if column in r.metrics]
        limit_to_most(axes, curves, curves)
    _legend_below(figure, both[0], 4)
    return figure


def plot_comparison(groups: Sequence[Group], styles: Mapping[str, int]) -> Figure:
    """Draws configurations beside each other.

    Args:
        groups: whose scores mean the same.
        styles: number of each group's colour, by its name.

    Returns:
        The figure: mean over the seeds of the best so far with its 95 % confidence band as far as
        all runs of a group reach, single runs beyond as thin lines; and the final scores.
    """
    shown = [group for group in groups if group.shown]
    sizes = {group.settings.get("evolution.population_size") for group in shown}
    known = all("evaluations" in r.metrics for group in shown for r in group.shown)
    over = "evaluations" if len(sizes) > 1 and known else "generation"
    figure = new_figure(WIDE, 4.4)
    left, right = figure.subplots(1, 2, width_ratios=(2.3, 1.0))
    ends: list[float] = []
    core: list[np.ndarray] = []
    for group in shown:
        style = style_of(styles[group.name])
        x, values = group.curve("champion", over)
        middle = mean_interval(values)
        left.plot(x, middle.mean, linewidth=1.8, zorder=3,
                  label=f"{letter(styles[group.name])}: {group.name}, n = {len(group.shown)}",
                  **style)  # fmt: skip
        if len(group.shown) >= _BAND_FROM:
            band = middle.mean - middle.half, middle.mean + middle.half
            left.fill_between(x, *band, color=style["color"], alpha=0.16, linewidth=0)
            core += band
        for record in group.shown:
            end = record.metrics[over]
            ends.append(float(end[-1]))
            later = record.metrics["generation"] >= group.common_generations
            if "champion" not in record.metrics:
                continue
            core.append(record.metrics["champion"])
            if later.sum() > 1 and len(group.shown) > 1:
                left.plot(end[later], record.metrics["champion"][later], linewidth=0.8, alpha=0.7,
                          zorder=2, **style)  # fmt: skip
    if ends and max(ends) > _LOG_FROM * min(ends):
        left.set_xscale("log")
    else:
        left.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10], nbins=7))
    left.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    left.set_xlabel(
        shown[0].shown[0].round if over == "generation" and shown else "evaluated individuals"
    )
    unit = shown[0].unit if shown else ""
    what = shown[0].shown[0].fitness if shown else "fitness"
    left.set_ylabel(f"best {what.replace('fitness', 'fitness so far', 1)}")
    head(left, "mean over seeds and 95 % confidence band")
    dress(left)
    limit_to_most(left, core, core)
    _legend_below(figure, left, 2)
    _draw_finals(right, groups, styles)
    right.set_ylabel(f"champion's score ({unit})" if unit else "champion's score")
    return figure


def _draw_finals(axes: Axes, groups: Sequence[Group], styles: Mapping[str, int]) -> None:
    """Scores on fresh starts: a dot for each seed, and mean and interval."""
    for place, group in enumerate(groups):
        color = COLORS[styles[group.name] % len(COLORS)]
        scores = np.array(group.scores())
        spread = (np.arange(len(scores)) - (len(scores) - 1) / 2) * min(
            0.06, 0.4 / max(len(scores), 1)
        )
        axes.plot(place - 0.12 + spread, scores, "o", color=color, alpha=0.45, markersize=5,
                  markeredgewidth=0)  # fmt: skip
        middle = mean_interval(scores) if len(scores) else None
        if middle is not None:
            half = middle.half if len(scores) >= _BAND_FROM else np.nan
            axes.errorbar(place + 0.16, middle.mean, yerr=half, fmt="D", color=color, markersize=6,
                          capsize=4, linewidth=1.6)  # fmt: skip
    axes.set_xticks(range(len(groups)), [letter(styles[group.name]) for group in groups])
    axes.set_xlim(-0.6, len(groups) - 0.4)
    head(axes, "final, on fresh starts")
    dress(axes)
    axes.grid(False, axis="x")


def plot_champions(groups: Sequence[tuple[str, int, Sequence[Motion]]]) -> Figure:
    """Draws the champions of several runs beside each other.

    Args:
        groups: for each group its name, the number of its colour, and what its champions did.

    Returns:
        The figure: ways from above and from the side, all from one start, and the distance from
        the start over time, mean over the seeds with its 95 % confidence band.
    """
    figure = new_figure(WIDE, 3.7)
    above, side, away = figure.subplots(1, 3)
    spans = [np.ptp(motion.path[:, :2], axis=0) for *_, members in groups for motion in members]
    ahead = int(np.argmax(np.max(spans, axis=0)))  # the side on which they get ahead
    for name, index, members in groups:
        style = style_of(index)
        curves = []
        for motion in members:
            way = motion.path - motion.path[0]
            thin = np.unique(np.linspace(0, len(way) - 1, min(len(way), 300)).astype(int))
            for axes, j, k in ((above, 0, 1), (side, ahead, 2)):
                axes.plot(way[thin, j], way[thin, k], linewidth=1.1, alpha=0.8, **style)
                axes.plot(*way[-1, [j, k]], "s", color=style["color"], markersize=4)
            curves.append(np.linalg.norm(way, axis=1))
        count = min(map(len, curves))
        middle = mean_interval([distance[:count] for distance in curves])
        time = members[0].time[:count]
        away.plot(time, middle.mean, linewidth=1.7,
                  label=f"{letter(index)}: {name}, n = {len(curves)}", **style)  # fmt: skip
        if len(curves) >= _BAND_FROM:
            away.fill_between(time, np.maximum(middle.mean - middle.half, 0),
                              middle.mean + middle.half, color=style["color"], alpha=0.16,
                              linewidth=0)  # fmt: skip
        for motion, distance in zip(members, curves, strict=True):
            away.plot(motion.time, distance, linewidth=0.5, alpha=0.5, **style)
    panels = ((above, "from above", "x", "y"), (side, "from the side", "xy"[ahead], "z"))
    for axes, words, across, up in panels:
        axes.plot(0, 0, "o", color="white", markeredgecolor=_INK, markersize=7, zorder=5)
        axes.set(xlabel=f"{across} (m)", ylabel=f"{up} (m)")
        axes.locator_params(nbins=5)
        axes.set_aspect("equal", adjustable="datalim")
        head(axes, words)
    away.set(xlabel="time (s)", ylabel="distance from the start (m)")
    away.set_xlim(left=0)
    away.set_ylim(bottom=0)
    head(away, "mean and 95 % band")
    for axes in (above, side, away):
        dress(axes)
    if len(groups) > 1:
        _legend_below(figure, away, 2)
    return figure
