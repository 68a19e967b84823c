"""Everybody who lived in a colony: their lives as lines, their families, and where they met."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import MaxNLocator

from mjx_revolve.episodes.colony_config import ColonyConfig
from mjx_revolve.view.colony_curves import LABEL, death_looks, scale_time
from mjx_revolve.view.colony_history import History, Span
from mjx_revolve.view.plots import COLORS, WIDE, dress, head, legend_above, new_figure

# The largest families have colours of their own; of one palette, so that neighbours differ.
_FAMILIES = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7b5ea7", "#8c6d31",
)  # fmt: skip
_REST, _INK, _GREY = "#c3ccd3", "#222222", "#6b7680"
_CHARGER, _WATER = "#e69f00", "#f2f7fa"
# Lines of lives: width where there is room, and the least [points].
_THICK, _THIN = 3.0, 0.55
_SHADES = "viridis"


def plot_lives(history: History, title: str = "") -> Figure:
    """Draws the lives of all who were born in a colony, one line each.

    Args:
        history: of the colony.
        title: a line above the picture.

    Returns:
        The figure: on the left a line from birth to death for each robot, the first one lowest,
        coloured by its last fitness, a dot where it died of something else than age; on the right
        how old they got.
    """
    scale, words = scale_time(history.end)
    spans = list(history.spans.values())
    figure = new_figure(WIDE, 6.4)
    left, right = figure.subplots(1, 2, width_ratios=(3.4, 1.0))
    scores = np.array([span.score for span in spans])
    known = scores[np.isfinite(scores)]
    # A few who are far above all others would leave no colours for the rest.
    shades = Normalize(0.0, float(np.quantile(known, 0.98)) if known.size else 1.0, clip=True)
    width = float(np.clip(260.0 / max(len(spans), 1), _THIN, _THICK))
    rows = np.arange(len(spans))
    lines = _lines(spans, rows, scale, width)
    # Grey: not known, as of the living where a run was stopped.
    lines.set(cmap=colormaps[_SHADES].with_extremes(bad=_REST), norm=shades)
    lines.set_array(np.ma.masked_invalid(scores))
    left.add_collection(lines)
    _mark_deaths(left, spans, rows, scale)
    left.set_ylim(-0.02 * len(spans) - 1, 1.02 * len(spans))
    left.set_xlim(-0.01 * history.end / scale, 1.01 * max(history.end, 1e-9) / scale)
    left.set(xlabel=words, ylabel="robots, in the order of birth")
    left.yaxis.set_major_locator(MaxNLocator(integer=True))
    dress(left)
    left.grid(False, axis="y")
    # Nobody is drawn in the corner of those who are born late and live early.
    inset = left.inset_axes((0.03, 0.93, 0.42, 0.022))
    bar = figure.colorbar(lines, cax=inset, orientation="horizontal", extend="max")
    bar.set_label(f"last {LABEL}", fontsize=9)
    bar.outline.set_visible(False)
    inset.tick_params(labelsize=8.5, colors="#333333")
    _draw_ages(right, spans)
    if title:
        figure.suptitle(title, x=0.012, ha="left", fontsize=11, color=_INK, parse_math=False)
    return figure


def _lines(spans: Sequence[Span], rows: np.ndarray, scale: float, width: float) -> LineCollection:
    """A line for each life, in its row."""
    ends = np.array([[span.born, span.end] for span in spans]).reshape(-1, 2) / scale
    points = np.stack([ends, np.repeat(rows[:, None], 2, 1)], -1)
    return LineCollection(list(points), linewidths=width, capstyle="butt")


def _mark_deaths(axes: Axes, spans: Sequence[Span], rows: np.ndarray, scale: float) -> None:
    """Dots where somebody died of something else than age."""
    causes = {span.cause: 1 for span in spans if span.cause not in ("", "age")}
    for cause, (color, words) in death_looks(causes).items():
        these = [k for k, span in enumerate(spans) if span.cause == cause]
        axes.plot([spans[k].end / scale for k in these], rows[these], "o", color=color,
                  markersize=3.2, markeredgewidth=0, label=words, zorder=3)  # fmt: skip
    if causes:
        axes.legend(loc="upper left", bbox_to_anchor=(0.02, 0.82), fontsize=8.5, frameon=False,
                    borderaxespad=0.2, handletextpad=0.2)  # fmt: skip


def _draw_ages(axes: Axes, spans: Sequence[Span]) -> None:
    """How old who has died got, by cause; and who lives, so far."""
    scale, words = scale_time(max((span.age for span in spans), default=0.0))
    edges = np.linspace(0, max((span.age for span in spans), default=1.0) / scale or 1.0, 19)
    causes = {span.cause: 1 for span in spans if span.cause}
    looks = {**death_looks(causes), "": (COLORS[0], "alive in the end")}
    ages = {name: [s.age / scale for s in spans if s.cause == name] for name in looks}
    shown = [name for name in looks if ages[name]]
    if shown:
        axes.hist([ages[name] for name in shown], bins=edges.tolist(), stacked=True, rwidth=0.88,
                  orientation="horizontal", color=[looks[name][0] for name in shown],
                  label=[looks[name][1] for name in shown])  # fmt: skip
        axes.legend(loc="lower left", bbox_to_anchor=(-0.05, 1.0), fontsize=8.5, frameon=False,
                    borderaxespad=0.1, handlelength=1.1)  # fmt: skip
    axes.set(xlabel="robots", ylabel=words.replace("time", "age"))
    axes.set_ylim(0, edges[-1])
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=4))
    dress(axes)


# --- families -------------------------------------------------------------------------------------


def plot_families(history: History, champion: int | None = None, title: str = "") -> Figure:
    """Draws who descends from whom in a colony.

    Args:
        history: of the colony.
        champion: whose line is drawn over the others; None: nobody's.
        title: a line above the picture.

    Returns:
        The figure: on top each family's share of the living; below, a line for each life, which
        hangs on that of the parent that gave the body, families beside each other. A family is all
        who have their bodies from one founder; the largest have colours.
    """
    scale, words = scale_time(history.end)
    shown = [f for f in history.families if len(_members(history, f)) > 1][: len(_FAMILIES)]
    colors = dict(zip(shown, _FAMILIES, strict=False))
    figure = new_figure(WIDE, 8.0)
    top, low = figure.subplots(2, 1, sharex=True, height_ratios=(1.0, 2.4))
    times = np.linspace(0.0, history.end, 500)
    counts = [history.count_living(times, family) for family in shown]
    rest = (
        history.count_living(times) - np.sum(counts, axis=0)
        if shown
        else (history.count_living(times))
    )
    labels = [f"of #{family}" for family in shown]
    top.stackplot(times / scale, [*counts, rest], labels=[*labels, "others"],
                  colors=[*(colors[f] for f in shown), _REST], linewidth=0, alpha=0.9)  # fmt: skip
    top.set_ylabel("robots alive")
    top.set_ylim(bottom=0)
    legend_above(top, 0.0)
    order = _order(history)
    row = {number: k for k, number in enumerate(order)}
    spans = [history.spans[number] for number in order]
    width = float(np.clip(330.0 / max(len(order), 1), _THIN, _THICK))
    shades = [colors.get(span.founder, _REST) for span in spans]
    lines = _lines(spans, np.arange(len(spans)), scale, width)
    lines.set_color(shades)
    _draw_descent(low, history, row, colors, scale, max(0.45, 0.3 * width))
    low.add_collection(lines)
    if champion in history.spans:
        assert champion is not None
        _draw_line(low, history, champion, row, scale)
    low.set_ylim(len(order) + 1.0, -2.0)
    low.set_yticks([])
    low.set(xlabel=words, ylabel=f"{len(order)} robots by family")
    for axes in (top, low):
        dress(axes)
    low.grid(False, axis="y")
    low.spines["left"].set_visible(False)
    low.set_xlim(-0.01 * history.end / scale, 1.01 * max(history.end, 1e-9) / scale)
    legend_above(low)
    if title:
        figure.suptitle(title, x=0.012, ha="left", fontsize=11, color=_INK, parse_math=False)
    return figure


def _draw_descent(
    axes: Axes,
    history: History,
    row: Mapping[int, int],
    colors: Mapping[int, str],
    scale: float,
    width: float,
) -> None:
    """From each parent's line down to its children's; paler beyond its death, where they came late.

    A child is born a while after its parents have met, which they need not live to see.
    """
    drops, late, hues, late_hues = [], [], [], []
    for number, children in history.children.items():
        span, at = history.spans[number], row[number]
        hue = colors.get(span.founder, _REST)
        for child in children:
            born = history.spans[child].born / scale
            drops.append([(born, at), (born, row[child])])
            hues.append(hue)
        last = max((history.spans[child].born for child in children), default=span.end)
        if last > span.end:
            late.append([(span.end / scale, at), (last / scale, at)])
            late_hues.append(hue)
    axes.add_collection(LineCollection(drops, colors=hues, linewidths=width, alpha=0.55))
    axes.add_collection(LineCollection(late, colors=late_hues, linewidths=width, alpha=0.35))


def _members(history: History, founder: int) -> list[int]:
    return [span.number for span in history.spans.values() if span.founder == founder]


def _order(history: History) -> list[int]:
    """All numbers, families by their founders' births, each child's own line beside its parent."""
    found: list[int] = []
    founders = [span.number for span in history.spans.values() if span.founder == span.number]
    stack = founders[::-1]
    while stack:
        number = stack.pop()
        found.append(number)
        # The youngest first, so that lines down to children do not cross elder ones' families.
        stack += history.children[number]
    return found


def _draw_line(
    axes: Axes, history: History, number: int, row: Mapping[int, int], scale: float
) -> None:
    """The line of descent of one robot, over all others."""
    line = history.line(number)
    points = []
    for one, child in zip(line, [*line[1:], None], strict=True):
        span = history.spans[one]
        end = span.end if child is None else history.spans[child].born
        points += [(span.born / scale, row[one]), (end / scale, row[one])]
    axes.plot(*np.transpose(points), color=_INK, linewidth=1.3, zorder=4,
              label=f"the champion's line, #{number}")  # fmt: skip
    axes.plot(*points[-1], "*", color=_INK, markersize=9, zorder=5)


# --- the arena ------------------------------------------------------------------------------------


def plot_arena(history: History, colony: ColonyConfig, title: str = "") -> Figure:
    """Draws where a colony's robots were born, met and died, from above.

    Args:
        history: of the colony.
        colony: whose arena, clinic and chargers.
        title: a line above the picture.

    Returns:
        The figure: three maps in one scale. Births and matings are coloured by time, deaths by
        cause.
    """
    scale, words = scale_time(history.end)
    figure = new_figure(WIDE, 4.3)
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    points = None
    for axes, kind, name in zip(panels[:2], ("birth", "mating"), ("born", "met"), strict=True):
        events = history.of_kind(kind)
        place = np.array([event.place for event in events]).reshape(-1, 3)
        if kind == "birth":
            _draw_clinic(axes, colony)
        points = axes.scatter(
            place[:, 0], place[:, 1], c=[event.time / scale for event in events],
            s=_dot(len(events)), cmap=_SHADES, vmin=0, vmax=max(history.end, 1e-9) / scale,
            alpha=0.8, linewidths=0, zorder=3,
        )  # fmt: skip
        head(axes, f"where {len(events)} {'were ' if kind == 'birth' else 'pairs '}{name}")
    deaths = history.of_kind("death")
    for cause, (color, told) in death_looks({event.cause: 1 for event in deaths}).items():
        place = np.array([event.place for event in deaths if event.cause == cause])
        panels[2].scatter(place[:, 0], place[:, 1], s=_dot(len(deaths)), color=color, alpha=0.8,
                          linewidths=0, label=told, zorder=3)  # fmt: skip
    head(panels[2], f"where {len(deaths)} died")
    half = colony.arena.size / 2
    for axes in panels:
        axes.set_aspect("equal")
        axes.set(xlabel="x (m)", xlim=(-1.06 * half, 1.06 * half), ylim=(-1.06 * half, 1.06 * half))
        dash = "-" if colony.arena.edge == "lost" else (0, (4, 3))
        frame = Rectangle((-half, -half), 2 * half, 2 * half, facecolor=_WATER, edgecolor=_GREY)
        frame.set(linewidth=1.0, linestyle=dash, zorder=0)
        axes.add_patch(frame)
        _draw_chargers(axes, colony)
        dress(axes)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
        axes.yaxis.set_major_locator(MaxNLocator(nbins=5))
        axes.tick_params(labelleft=axes is panels[0])
    panels[0].set_ylabel("y (m)")
    if deaths:
        # Beside the colours' bar, which leaves room for it.
        panels[2].legend(loc="upper center", bbox_to_anchor=(0.5, -0.19), fontsize=8.5, ncols=1,
                         frameon=False, borderaxespad=0.2, handletextpad=0.2,
                         markerscale=1.6).set_in_layout(False)  # fmt: skip
    if points is not None:
        bar = figure.colorbar(points, ax=list(panels), location="bottom", shrink=0.42, aspect=32,
                              pad=0.04, anchor=(0.2, 1.0))  # fmt: skip
        bar.set_label(words, fontsize=9)
        bar.outline.set_visible(False)
        if bar.solids is not None:
            bar.solids.set_alpha(1)
        bar.ax.tick_params(labelsize=8.5, colors="#333333")
    if title:
        figure.suptitle(title, x=0.012, ha="left", fontsize=11, color=_INK, parse_math=False)
    return figure


def _dot(count: int) -> float:
    """Area of a dot, less where there are many [points²]."""
    return float(np.clip(5000.0 / max(count, 1), 7.0, 26.0))


def _draw_clinic(axes: Axes, colony: ColonyConfig) -> None:
    radius = colony.birth.radius
    axes.add_patch(Circle((0, 0), radius, facecolor="#fbe3ec", edgecolor="#cc79a7", linewidth=1.0,
                          zorder=1))  # fmt: skip
    box = {"facecolor": _WATER, "alpha": 0.8, "linewidth": 0, "pad": 1.0}
    axes.text(0, -1.06 * radius, "clinic", color="#a8517f", fontsize=8.5, ha="center", va="top",
              zorder=4, bbox=box)  # fmt: skip


def _draw_chargers(axes: Axes, colony: ColonyConfig) -> None:
    energy = colony.energy
    for x, y, _ in energy.chargers if energy is not None else ():
        assert energy is not None
        axes.add_patch(Circle((x, y), energy.reach, facecolor="none", edgecolor=_CHARGER,
                              linewidth=1.2, linestyle=(0, (2, 2)), zorder=2))  # fmt: skip
        axes.plot(x, y, "P", color=_CHARGER, markersize=8, markeredgecolor="white", zorder=4)
