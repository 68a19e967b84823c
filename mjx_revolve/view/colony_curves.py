"""A colony over its time: how fit its robots are, how many there are, who is born and dies."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from mjx_revolve.view.colony_history import History
from mjx_revolve.view.plots import (
    COLORS,
    WIDE,
    dress,
    legend_above,
    limit_to_most,
    new_figure,
)

CAUSES = {
    "age": ("#8894a0", "died of age"),
    "energy": ("#e69f00", "died of an empty battery"),
    "lost": ("#cc79a7", "lost"),
    "failed": ("#d55e00", "failed"),
}
"""Colours and words of what robots die of."""
OTHER = ("#3b3b3b", "died of something else")
"""Of a cause that this version does not know."""
LABEL = "fitness in the colony"
"""What its fitness is called, which is not the champion's score."""
_BLUE, _ORANGE, _GREEN, _DEEP, _GREY = COLORS[0], COLORS[1], COLORS[2], "#0b3c5d", "#6b7680"
_KIN, _STRANGER = "#4a97c9", "#b9d6e8"  # births: children, and who has no parents
_BINS = 60  # of births and deaths along the time axis, at most
# Until when times are told in seconds, and in minutes [s].
_SECONDS, _MINUTES = 180.0, 3 * 3600.0


def scale_time(end: float) -> tuple[float, str]:
    """Seconds in a unit that suits a time axis, and the axis' label."""
    if end < _SECONDS:
        return 1.0, "time (s)"
    return (60.0, "time (min)") if end <= _MINUTES else (3600.0, "time (h)")


def plot_colony(metrics: Mapping[str, np.ndarray], title: str = "") -> Figure:
    """Draws how fit a colony's robots were.

    Args:
        metrics: columns of `metrics.csv`, each `[T]`: time, best, median, the quartiles and
            champion; mean_age, mean_num_modules and mean_num_hinges where they are there.
        title: a line above the picture.

    Returns:
        The figure: fitness of the living on top, below it how old and how large they are.
    """
    scale, words = scale_time(float(metrics["time"][-1]))
    time = metrics["time"] / scale
    figure = new_figure(8.0, 6.0)
    grid = figure.add_gridspec(2, 2, height_ratios=(2.4, 1.0))
    top = figure.add_subplot(grid[0, :])
    ages, sizes = (figure.add_subplot(grid[1, k], sharex=top) for k in (0, 1))
    dot = "o" if len(time) < 3 else None
    low, high = metrics["lower_quartile"], metrics["upper_quartile"]
    top.fill_between(time, low, high, color=_BLUE, alpha=0.18, linewidth=0, label="quartiles")
    top.plot(time, metrics["median"], color=_GREEN, linewidth=1.1, label="median", marker=dot)
    top.plot(time, metrics["best"], color=_ORANGE, linewidth=1.0, label="best alive", marker=dot)
    top.step(time, metrics["champion"], where="post", color=_DEEP, linewidth=1.4,
             linestyle=(0, (5, 2)), label="fittest ever")  # fmt: skip
    top.set_ylabel(LABEL)
    limit_to_most(top, [low], [metrics["best"], metrics["champion"]])
    legend_above(top, 0.0)
    if title:
        top.set_title(title, loc="left", fontsize=11, color="#222222", pad=24, parse_math=False)
    if "mean_age" in metrics:
        age, unit = scale_time(float(np.nanmax(metrics["mean_age"], initial=0.0)))
        ages.plot(time, metrics["mean_age"] / age, color=_GREY, linewidth=1.3, marker=dot)
        ages.set_ylabel(f"mean age\nof the living{unit.removeprefix('time')}", fontsize=9)
        ages.set_ylim(bottom=0)
    for name, color in (("modules", _BLUE), ("hinges", _ORANGE)):
        if f"mean_num_{name}" in metrics:
            sizes.plot(time, metrics[f"mean_num_{name}"], color=color, linewidth=1.3, marker=dot,
                       label=name)  # fmt: skip
    sizes.set_ylabel("mean of\nthe living", fontsize=9)
    sizes.set_ylim(bottom=0)
    legend_above(sizes)
    for axes in (top, ages, sizes):
        axes.set_xlabel(words)
        dress(axes)
    _limit_time(top, 0.0, time[-1])
    return figure


def plot_population(history: History, room: int | None = None, title: str = "") -> Figure:
    """Draws how many lived in a colony, and who was born and died when.

    Args:
        history: of the colony.
        room: how many may live at a time; None: not known.
        title: a line above the picture.

    Returns:
        The figure: the living over time; below, births upwards and deaths by cause downwards.
    """
    scale, words = scale_time(history.end)
    figure = new_figure(WIDE, 5.6)
    top, low = figure.subplots(2, 1, sharex=True, height_ratios=(1.15, 1.0))
    moments = [event.time for event in history.events if event.kind != "mating"]
    times = np.unique([0.0, *moments, history.end])
    living = history.count_living(times)
    top.fill_between(times / scale, living, step="post", color=_BLUE, alpha=0.2, linewidth=0)
    top.step(times / scale, living, where="post", color=_BLUE, linewidth=1.5, label="alive")
    if room is not None:
        top.axhline(
            room, color=_GREY, linewidth=1.0, linestyle=(0, (5, 3)), label=f"room for {room}"
        )
    top.set_ylabel("robots")
    top.set_ylim(0, 1.08 * max([*living, room or 1]))
    top.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=6))
    legend_above(top)
    edges = _bins(history)
    _draw_turnover(low, history, edges, scale)
    low.set_xlabel(words)
    wide = f"{edges[1] - edges[0]:g} s"
    low.set_ylabel(f"robots in each {wide}")
    for axes in (top, low):
        dress(axes)
    _limit_time(top, 0.0, max(history.end, 1e-9) / scale)
    if title:
        figure.suptitle(title, x=0.012, ha="left", fontsize=11, color="#222222", parse_math=False)
    return figure


def _bins(history: History) -> np.ndarray:
    """Edges of round, equal bins over the time [s]."""
    least = max(history.end, 1.0) / _BINS
    power = 10.0 ** math.floor(math.log10(least))
    steps = (k * power for k in (1, 2, 3, 6, 10) if k * power >= least * (1 - 1e-9))
    width = next(steps)
    count = max(1, math.ceil(history.end / width + 1e-9))
    return width * np.arange(count + 1)


def _draw_turnover(axes: Axes, history: History, edges: np.ndarray, scale: float) -> None:
    """Births upwards, deaths downwards, stacked by kind."""
    width = (edges[1] - edges[0]) / scale
    middle = (edges[:-1] + edges[1:]) / 2 / scale

    def stack(groups: list[tuple[list[float], str, str]], sign: int) -> None:
        base = np.zeros(len(middle))
        for moments, color, label in groups:
            if not moments:
                continue
            count = sign * np.histogram(moments, edges)[0]
            axes.bar(middle, count, 0.86 * width, base, color=color, label=label, linewidth=0)
            base = base + count

    births = history.of_kind("birth")
    stack([
        ([e.time for e in births if e.parents], _KIN, "children born"),
        ([e.time for e in births if not e.parents], _STRANGER, "strangers born"),
    ], 1)  # fmt: skip
    deaths = history.of_kind("death")
    causes = Counter(event.cause for event in deaths)
    stack([
        ([e.time for e in deaths if e.cause == cause], color, words)
        for cause, (color, words) in death_looks(causes).items()
    ], -1)  # fmt: skip
    axes.axhline(0, color="#333333", linewidth=0.8)
    low, high = axes.dataLim.intervaly
    axes.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low) or 1.0)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=7))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{abs(value):.0f}"))
    legend_above(axes)


def death_looks(causes: Mapping[str, int]) -> dict[str, tuple[str, str]]:
    """Colours and words of the causes that there are, the known ones first."""
    names = [*(name for name in CAUSES if name in causes), *sorted(set(causes) - set(CAUSES))]
    return {name: CAUSES.get(name, OTHER) for name in names}


def _limit_time(axes: Axes, begin: float, end: float) -> None:
    margin = 0.012 * (end - begin)
    axes.set_xlim(begin - margin, end + margin)
