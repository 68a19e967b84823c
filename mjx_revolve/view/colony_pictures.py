"""Pictures of a colony: its population over time, its robots' lives, families and places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator

from mjx_revolve.episodes.colony_config import ColonyConfig
from mjx_revolve.view.colony_history import ColonyHistory
from mjx_revolve.view.convergence import scale_time
from mjx_revolve.view.plots import (
    BLUE,
    COLORS,
    GREY,
    INK,
    WIDE,
    color_bar,
    in_style,
    legend_above,
    new_figure,
)
from mjx_revolve.view.population import trace_line

_CAUSES = {
    "age": ("#8894a0", "died of age"),
    "energy": ("#e69f00", "died of an empty battery"),
    "lost": ("#cc79a7", "lost"),
    "failed": ("#d55e00", "failed"),
}
_OTHER_CAUSE = ("#3b3b3b", "died of something else")  # causes of other versions
_CHILD, _FOUNDER = "#4a97c9", "#b9d6e8"  # births with and without parents
_BINS = 60  # of births and deaths along the time axis, at most
# The largest families have colours of their own.
_FAMILIES = (*COLORS[:6], "#7b5ea7", "#8c6d31")
_REST, _CHARGER, _WATER = "#c3ccd3", "#e69f00", "#f2f7fa"
_THIN, _THICK = 0.55, 3.0  # of the lines of lives [points]


def cause_styles(causes: Sequence[str] | Mapping[str, int]) -> dict[str, tuple[str, str]]:
    """Colours and words of causes of death, the known ones first; "" is no cause."""
    names = [*(name for name in _CAUSES if name in causes), *sorted(set(causes) - {*_CAUSES, ""})]
    return {name: _CAUSES.get(name, _OTHER_CAUSE) for name in names}


def plot_history(
    history: ColonyHistory,
    colony: ColonyConfig | None,
    room: int | None = None,
    champion: int | None = None,
    title: str = "",
) -> dict[str, Figure]:
    """All pictures of a colony by name; see the functions of this module."""
    figures = {
        "population": plot_population(history, room, title),
        "families": plot_families(history, champion, title),
    }
    return figures if colony is None else figures | {"arena": plot_arena(history, colony, title)}


# --- population -----------------------------------------------------------------------------------


@in_style
def plot_population(history: ColonyHistory, room: int | None = None, title: str = "") -> Figure:
    """Draws how many robots lived in a colony, and births and deaths over time.

    Args:
        history: of the colony.
        room: the most robots that may live at a time; None: not known.
        title: a line above the picture.

    Returns:
        The figure: the living over time; below, births upwards and deaths by cause downwards.
    """
    scale, words = scale_time(history.end)
    figure = new_figure(WIDE, 5.6, title)
    top, low = figure.subplots(2, 1, sharex=True, height_ratios=(1.15, 1.0))
    moments = [event.time for event in history.events if event.kind != "mating"]
    times = np.unique([0.0, *moments, history.end])
    living = history.count_living(times)
    top.fill_between(times / scale, living, step="post", color=BLUE, alpha=0.2, linewidth=0)
    top.step(times / scale, living, where="post", color=BLUE, label="alive")
    if room is not None:
        top.axhline(room, color=GREY, linewidth=1.0, linestyle=(0, (5, 3)),
                    label=f"room for {room}")  # fmt: skip
    top.set(ylabel="robots", ylim=(0, 1.08 * max([*living, room or 1])))
    top.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=6))
    # Edges of round, equal bins [s].
    bins = MaxNLocator(nbins=_BINS, steps=[1, 2, 3, 6, 10])
    edges = np.asarray(bins.tick_values(0.0, max(history.end, 1.0)))
    _draw_turnover(low, history, edges, scale)
    low.set(xlabel=words, ylabel=f"robots in each {edges[1] - edges[0]:g} s")
    for axes in (top, low):
        legend_above(axes)
    _limit_time(top, history, scale)
    return figure


def _draw_turnover(axes: Axes, history: ColonyHistory, edges: np.ndarray, scale: float) -> None:
    """Births upwards, deaths downwards, stacked by kind."""
    births, deaths = history.of_kind("birth"), history.of_kind("death")
    up = [
        ([e.time for e in births if e.parents], _CHILD, "children born"),
        ([e.time for e in births if not e.parents], _FOUNDER, "founders born"),
    ]
    down = [
        ([e.time for e in deaths if e.cause == cause], color, words)
        for cause, (color, words) in cause_styles([e.cause for e in deaths]).items()
    ]
    middle, width = (edges[:-1] + edges[1:]) / 2 / scale, (edges[1] - edges[0]) / scale
    for sign, stack in ((1, up), (-1, down)):
        base = np.zeros(len(middle))
        for moments, color, words in stack:
            if moments:
                count = sign * np.histogram(moments, edges)[0]
                axes.bar(middle, count, 0.86 * width, base, color=color, label=words)
                base = base + count
    axes.axhline(0, color="#333333", linewidth=0.8)
    low, high = axes.dataLim.intervaly
    axes.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low) or 1.0)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=7))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{abs(value):.0f}"))


def _limit_time(axes: Axes, history: ColonyHistory, scale: float) -> None:
    end = max(history.end, 1e-9) / scale
    axes.set_xlim(-0.012 * end, 1.012 * end)


# --- families -------------------------------------------------------------------------------------


@in_style
def plot_families(history: ColonyHistory, champion: int | None = None, title: str = "") -> Figure:
    """Draws the lines of descent of a colony.

    Args:
        history: of the colony.
        champion: number of a robot, to draw its line over the others; None: none.
        title: a line above the picture.

    Returns:
        The figure: on top each family's share of the living; below, a line for each life, which
        hangs on that of the parent that gave the body, families beside each other. A family is all
        robots that have their bodies from one founder; the largest have colours.
    """
    scale, words = scale_time(history.end)
    spans = [history.spans[number] for number in _order(history)]
    members = [span.founder for span in spans]
    shown = [family for family in history.families if members.count(family) > 1][: len(_FAMILIES)]
    colors = dict(zip(shown, _FAMILIES, strict=False))
    hues = [colors.get(span.founder, _REST) for span in spans]
    figure = new_figure(WIDE, 8.0, title)
    top, low = figure.subplots(2, 1, sharex=True, height_ratios=(1.0, 2.4))
    times = np.linspace(0.0, history.end, 500)
    counts = [history.count_living(times, family) for family in shown]
    rest = history.count_living(times) - sum(counts, np.zeros(len(times)))
    top.stackplot(times / scale, [*counts, rest], labels=[*(f"of #{f}" for f in shown), "others"],
                  colors=[*colors.values(), _REST], linewidth=0, alpha=0.9)  # fmt: skip
    top.set(ylabel="robots alive", ylim=(0, None))
    legend_above(top, 0.0)
    row = {span.number: k for k, span in enumerate(spans)}
    width = float(np.clip(330.0 / max(len(spans), 1), _THIN, _THICK))
    _draw_descent(low, history, row, hues, scale, max(0.45, 0.3 * width))
    lines = [[(span.born / scale, k), (span.end / scale, k)] for k, span in enumerate(spans)]
    low.add_collection(LineCollection(lines, linewidths=width, capstyle="butt", colors=hues))
    if champion in row:
        _draw_line(low, history, champion, row, scale)
    low.set(xlabel=words, ylabel=f"{len(spans)} robots by family", ylim=(len(spans) + 1.0, -2.0))
    low.set_yticks([])
    low.grid(False, axis="y")
    low.spines["left"].set_visible(False)
    _limit_time(low, history, scale)
    legend_above(low)
    return figure


def _order(history: ColonyHistory) -> list[int]:
    """All numbers, families by their founders' births, each child's own line beside its parent."""
    order: list[int] = []
    stack = [span.number for span in history.spans.values() if span.founder == span.number][::-1]
    while stack:
        order.append(stack.pop())
        # The youngest first, so that lines down to children do not cross older ones' families.
        stack += history.children[order[-1]]
    return order


def _draw_descent(
    axes: Axes,
    history: ColonyHistory,
    row: Mapping[int, int],
    hues: Sequence[str],
    scale: float,
    width: float,
) -> None:
    """From each parent's line down to its children's; paler beyond its death, where they came late.

    A child is born a while after its parents have met: they may be dead by then.
    """
    drops, late, drop_hues, late_hues = [], [], [], []
    for number, children in history.children.items():
        span, at = history.spans[number], row[number]
        births = [history.spans[child].born / scale for child in children]
        drops += [[(x, at), (x, row[child])] for x, child in zip(births, children, strict=True)]
        drop_hues += [hues[at]] * len(children)
        if births and max(births) > span.end / scale:
            late.append([(span.end / scale, at), (max(births), at)])
            late_hues.append(hues[at])
    axes.add_collection(LineCollection(drops, colors=drop_hues, linewidths=width, alpha=0.55))
    axes.add_collection(LineCollection(late, colors=late_hues, linewidths=width, alpha=0.35))


def _draw_line(
    axes: Axes, history: ColonyHistory, number: int, row: Mapping[int, int], scale: float
) -> None:
    """The line of descent of one robot, over all others."""
    line = trace_line(history.spans, number)
    ends = [*(child.born for child in line[1:]), line[-1].end]
    points = [
        (time / scale, row[span.number])
        for span, end in zip(line, ends, strict=True)
        for time in (span.born, end)
    ]
    axes.plot(*np.transpose(points), color=INK, zorder=4,
              label=f"the champion's line, #{number}")  # fmt: skip
    axes.plot(*points[-1], "*", color=INK, markersize=9, zorder=5)


# --- the arena ------------------------------------------------------------------------------------


@in_style
def plot_arena(history: ColonyHistory, colony: ColonyConfig, title: str = "") -> Figure:
    """Draws the places of births, matings and deaths in a colony, from above.

    Args:
        history: of the colony.
        colony: its arena, clinic and chargers.
        title: a line above the picture.

    Returns:
        The figure: three maps in one scale. Births and matings are coloured by time, deaths by
        cause.
    """
    scale, words = scale_time(history.end)
    figure = new_figure(WIDE, 4.3, title)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    born, met, died = panels
    for axes, kind, name in ((born, "birth", "were born"), (met, "mating", "pairs met")):
        events = history.of_kind(kind)
        place = np.array([event.place for event in events]).reshape(-1, 3)
        points = axes.scatter(
            place[:, 0], place[:, 1], c=[event.time / scale for event in events],
            s=_dot(len(events)), cmap="viridis", vmin=0, vmax=max(history.end, 1e-9) / scale,
            alpha=0.8, linewidths=0, zorder=3,
        )  # fmt: skip
        axes.set_title(f"where {len(events)} {name}")
    deaths = history.of_kind("death")
    for cause, (color, label) in cause_styles([event.cause for event in deaths]).items():
        place = np.array([event.place for event in deaths if event.cause == cause])
        died.scatter(place[:, 0], place[:, 1], s=_dot(len(deaths)), color=color, alpha=0.8,
                     linewidths=0, label=label, zorder=3)  # fmt: skip
    died.set_title(f"where {len(deaths)} died")
    for axes in panels:
        _draw_arena(axes, colony)
        axes.tick_params(labelleft=axes is born)
    born.set_ylabel("y (m)")
    _draw_clinic(born, colony)
    if deaths:
        # Beside the colour bar, which leaves room for it.
        died.legend(loc="upper center", bbox_to_anchor=(0.5, -0.19), borderaxespad=0.2,
                    handletextpad=0.2, markerscale=1.6).set_in_layout(False)  # fmt: skip
    bar = color_bar(figure, points, words, ax=list(panels), location="bottom", shrink=0.42,
                    aspect=32, pad=0.04, anchor=(0.2, 1.0))  # fmt: skip
    if bar.solids is not None:
        bar.solids.set_alpha(1)
    return figure


def _dot(count: int) -> float:
    """Area of a dot, less where there are many [points²]."""
    return float(np.clip(5000.0 / max(count, 1), 7.0, 26.0))


def _draw_arena(axes: Axes, colony: ColonyConfig) -> None:
    half, energy = colony.arena.size / 2, colony.energy
    axes.set(xlabel="x (m)", xlim=(-1.06 * half, 1.06 * half), ylim=(-1.06 * half, 1.06 * half))
    axes.set_aspect("equal")
    axes.locator_params(nbins=5)
    dash = "-" if colony.arena.edge == "lost" else (0, (4, 3))
    axes.add_patch(Rectangle((-half, -half), 2 * half, 2 * half, facecolor=_WATER, edgecolor=GREY,
                             linewidth=1.0, linestyle=dash, zorder=0))  # fmt: skip
    chargers, reach = ((), 0.0) if energy is None else (energy.chargers, energy.reach)
    for x, y, _ in chargers:
        axes.add_patch(Circle((x, y), reach, facecolor="none", edgecolor=_CHARGER,
                              linewidth=1.2, linestyle=(0, (2, 2)), zorder=2))  # fmt: skip
        axes.plot(x, y, "P", color=_CHARGER, markersize=8, markeredgecolor="white", zorder=4)


def _draw_clinic(axes: Axes, colony: ColonyConfig) -> None:
    """The circle in which children are born."""
    radius = colony.birth.radius
    axes.add_patch(Circle((0, 0), radius, facecolor="#fbe3ec", edgecolor="#cc79a7", linewidth=1.0,
                          zorder=1))  # fmt: skip
    box = {"facecolor": _WATER, "alpha": 0.8, "pad": 1.0, "linewidth": 0}
    axes.text(0, -1.06 * radius, "clinic", color="#a8517f", fontsize=8.5, ha="center", va="top",
              zorder=4, bbox=box)  # fmt: skip
