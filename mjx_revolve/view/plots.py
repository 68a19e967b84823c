"""Pictures of a run: how the fitness grew, and the way the champion swam.

Figures are made with matplotlib's objects, without pyplot's global state, so that they can be drawn
anywhere: in a thread, in a test, on a machine without a screen.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from mjx_revolve.episodes.measure_table import MEASURES
from mjx_revolve.view.motion import speed_over

# Okabe and Ito's palette (2008), which all readers can tell apart, and its neighbours.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#3b3b3b")
_BLUE, _DEEP, _ORANGE, _GREY = COLORS[0], "#0b3c5d", COLORS[1], "#6b7680"
_WATER = "#eaf3f9"
# Axis labels of the measures; others are shown by their name.
LABELS = {name: f"{m.words} ({m.unit.replace('-', '–')})" for name, m in MEASURES.items()}
WIDE = 9.0  # of most figures [inches]
_FIGURES = {
    "generation", "evaluations", "best", "mean", "std", "median", "lower_quartile",
    "upper_quartile", "champion", "step_size", "failed", "restarts", "seconds",
    "evaluations_per_second",
}  # fmt: skip
# What is drawn of evolving bodies in place of the step size, the first that there is.
_BODIES = {
    "coverage": "share of the\narchive's cells", "mean_num_modules": "modules, mean\nof the living"
}  # fmt: skip
# A path is drawn in at most so many pieces, and a curve over time through so many points; the eye
# sees no more.
_PIECES, _POINTS = 300, 4000


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches, with a canvas that needs no screen."""
    figure = Figure(figsize=(width, height), dpi=120, facecolor="white")
    figure.set_layout_engine("constrained", w_pad=0.08, h_pad=0.06)  # [inches]
    FigureCanvasAgg(figure)
    return figure


def dress(axes: Axes) -> None:
    """Gives axes the look of all our figures."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_GREY)
    axes.tick_params(colors="#333333", labelsize=9)
    axes.grid(True, color="#d9dfe3", linewidth=0.6)
    axes.set_axisbelow(True)


def head(axes: Axes, text: str) -> None:
    """Writes a line above axes, at their left."""
    axes.set_title(text, loc="left", fontsize=10, color="#222222")


def limit_to_most(axes: Axes, low: Sequence[np.ndarray], high: Sequence[np.ndarray]) -> None:
    """Keeps a few terrible generations from squeezing all the others into a line.

    Args:
        axes: whose vertical limits are set; nothing happens without finite values.
        low: curves of which the worst few may lie below the frame.
        high: curves of which all lie within.
    """
    lows, highs = (np.concatenate([*curves, np.zeros(0)]) for curves in (low, high))
    lows, highs = lows[np.isfinite(lows)], highs[np.isfinite(highs)]
    if not lows.size or not highs.size:
        return
    bottom, top = float(np.percentile(lows, 5)), float(highs.max())
    # Only if they would take most of it.
    if top - lows.min() < 2.0 * (top - bottom):
        bottom = float(lows.min())
    margin = 0.06 * (top - bottom) or 0.1 * max(abs(top), 1e-3)
    axes.set_ylim(bottom - margin, top + margin)


def draw_curve(axes: Axes, x: np.ndarray, y: np.ndarray, **style: Any) -> None:
    """Draws a curve `y` over `x`, `[T]` each, long ones through every so many of their points."""
    stride = max(-(-len(x) // _POINTS), 1)
    axes.plot(x[::stride], y[::stride], **style)


def legend_above(axes: Axes, side: float = 1.0) -> None:
    """Puts the legend into one line above the axes, where it hides nothing.

    Args:
        axes: which; nothing happens where no line has a label.
        side: 0: at the left, 1: at the right.
    """
    handles, labels = axes.get_legend_handles_labels()
    if labels:
        axes.legend(handles, labels, loc="lower left" if side < 0.5 else "lower right",
                    bbox_to_anchor=(side, 1.0), borderaxespad=0.2, borderpad=0.2, fontsize=8.5,
                    ncols=len(labels), frameon=False, columnspacing=1.4)  # fmt: skip


def figure_png(figure: Figure) -> bytes:
    """The bytes of a figure as a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def figure_svg(figure: Figure) -> bytes:
    """The bytes of a figure as an SVG that needs no fonts; the same figure, the same bytes."""
    buffer = io.BytesIO()
    with rc_context({"svg.fonttype": "path", "svg.hashsalt": "mjx_revolve"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def plot_fitness(
    metrics: Mapping[str, np.ndarray], title: str = "", label: str = "fitness"
) -> Figure:
    """Draws how the fitness grew.

    Args:
        metrics: columns of `metrics.csv`, each `[T]`: generation, best, mean, std, champion,
            step_size, and, where there are such columns, median, the quartiles and measures of the
            generations' best. Other versions may lack any but the generation.
        title: a line above the picture.
        label: what the fitness measures, with its unit.

    Returns:
        The figure: fitness on top, below it a measure (the speed, if there) and the step size, or
        where bodies evolve how full the archive is, or how large they are.
    """
    generation = np.asarray(metrics["generation"])
    measures = [name for name in metrics if name not in _FIGURES]
    figure = new_figure(8.0, 6.0)
    grid = figure.add_gridspec(2, 2, height_ratios=(2.4, 1.0))
    top = figure.add_subplot(grid[0, :])
    dot = "o" if len(generation) < 3 else None
    band = _draw_population(top, generation, metrics, dot)
    if "best" in metrics:
        top.plot(generation, metrics["best"], color=_ORANGE, linewidth=1.1, label="best",
                 marker=dot)  # fmt: skip
    if "champion" in metrics:
        top.step(generation, metrics["champion"], where="post", color=_DEEP, linewidth=1.4,
                 linestyle=(0, (5, 2)), label="best so far")  # fmt: skip
    top.set_ylabel(label)
    highs = [metrics[name] for name in ("best", "champion") if name in metrics]
    limit_to_most(top, [band], highs or [band])
    legend_above(top, 0.0)
    if title:
        top.set_title(title, loc="left", fontsize=11, color="#222222", pad=24)
    known = [name for name in LABELS if name in measures]
    rate = ["evaluations_per_second"] if "evaluations_per_second" in metrics else []
    left, right = figure.add_subplot(grid[1, 0], sharex=top), None
    for name in (known + measures + rate)[:1]:
        left.plot(generation, metrics[name], color=_ORANGE, linewidth=1.1, marker=dot)
        words = LABELS.get(name, name.replace("_", " "))
        left.set_ylabel(words.replace(" (", "\n(") + ("\nof the best" if measures else ""),
                        fontsize=9)  # fmt: skip
    if "step_size" in metrics:
        right = figure.add_subplot(grid[1, 1], sharex=top)
        _draw_step_size(right, generation, np.asarray(metrics["step_size"]), dot)
    for name in _BODIES if right is None else ():
        if name in metrics:
            right = figure.add_subplot(grid[1, 1], sharex=top)
            right.plot(generation, metrics[name], color=_GREY, linewidth=1.3, marker=dot)
            right.set_ylabel(_BODIES[name], fontsize=9)
            break
    for axes in (top, left, right):
        if axes is None:
            continue
        axes.set_xlabel("generation")
        dress(axes)
        axes.tick_params(which="minor", labelsize=8, colors="#333333")
    top.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    span = max(float(generation[-1] - generation[0]), 1.0)
    top.set_xlim(generation[0] - 0.015 * span, generation[-1] + 0.015 * span)
    return figure


def _draw_population(
    axes: Axes, generation: np.ndarray, metrics: Mapping[str, np.ndarray], dot: str | None
) -> np.ndarray:
    """The middle of the population and its spread; returns the spread's lower edge `[T]`."""
    quartiles = ("lower_quartile", "upper_quartile")
    if all(name in metrics for name in quartiles):
        low, high = (np.asarray(metrics[name]) for name in quartiles)
        axes.fill_between(generation, low, high, color=_BLUE, alpha=0.18, linewidth=0,
                          label="quartiles")  # fmt: skip
    elif all(name in metrics for name in ("mean", "std")):
        mean, std = np.asarray(metrics["mean"]), np.asarray(metrics["std"])
        low, high = mean - std, mean + std
        axes.fill_between(generation, low, high, color=_BLUE, alpha=0.15, linewidth=0,
                          label="mean ± standard deviation")  # fmt: skip
        axes.plot(generation, mean, color=_BLUE, linewidth=1.6, label="mean", marker=dot)
    else:
        low = np.asarray(metrics.get("best", generation * np.nan))
    if "median" in metrics:
        dash = "-" if quartiles[0] in metrics else (0, (2, 1.2))
        axes.plot(generation, metrics["median"], color=COLORS[2], linewidth=1.1, label="median",
                  linestyle=dash, marker=dot)  # fmt: skip
    return low


def _draw_step_size(axes: Axes, generation: np.ndarray, size: np.ndarray, dot: str | None) -> None:
    axes.plot(generation, size, color=_GREY, linewidth=1.3, marker=dot)
    if np.all(size > 0):
        axes.set_yscale("log")
        plain = FuncFormatter(lambda value, _: f"{value:g}")
        axes.yaxis.set_major_formatter(plain)
        # Few decades need more numbers than the powers of ten, but not so many that they meet.
        decades = float(np.ptp(np.log10(size)))
        digits = "123456789" if decades < 0.4 else "235" if decades < 1.2 else ""
        axes.yaxis.set_minor_formatter(
            FuncFormatter(lambda x, _: f"{x:g}" if f"{x:.0e}"[0] in digits else "")
        )
    axes.set_ylabel("step size\n(gene units)", fontsize=9)


def plot_trajectory(trajectory: Any, surface_height: float = 0.0, title: str = "") -> Figure:
    """Draws the way a robot swam, see `plot_way`.

    Args:
        trajectory: has `time` `[T]` [s] and `xpos` `[T, nbody, 3]`, world frame [m].
        surface_height: of the water [m].
        title: a line above the picture.

    Returns:
        The figure.
    """
    time, path = np.asarray(trajectory.time, float), np.asarray(trajectory.xpos, float)[:, 1]
    return plot_way(time, path, surface_height, title)


def plot_way(
    seconds: np.ndarray, path: np.ndarray, surface_height: float = 0.0, title: str = ""
) -> Figure:
    """Draws the way a robot swam, from above and from the side.

    Args:
        seconds: `[T]` [s].
        path: `[T, 3]` of the core, world frame [m].
        surface_height: of the water [m].
        title: a line above the picture.

    Returns:
        The figure: paths from above and from the side, coloured by time, and depth and speed over
        time.
    """
    figure = new_figure(WIDE, 6.6)
    outer = figure.add_gridspec(2, 1, height_ratios=(1.7, 1.0))
    paths = outer[0].subgridspec(1, 2)
    curves = outer[1].subgridspec(1, 2)
    above = figure.add_subplot(paths[0])
    side = figure.add_subplot(paths[1])
    line = _draw_path(above, path[:, [0, 1]], seconds)
    # From the side on which it can be seen to get ahead.
    ahead = int(np.argmax(np.ptp(path[:, :2], axis=0)))
    _draw_path(side, path[:, [ahead, 2]], seconds)
    above.set(xlabel="x (m)", ylabel="y (m)")
    for axes in (above, side):
        axes.locator_params(nbins=6)
    above.set_title("from above", fontsize=9.5, color=_GREY)
    side.set(xlabel=f"{'xy'[ahead]} (m)", ylabel="z (m)")
    side.set_title("from the side", fontsize=9.5, color=_GREY)
    _square_limits(above, path[:, 0], path[:, 1])
    _square_limits(side, path[:, ahead], path[:, 2])
    _draw_surface(side, surface_height)
    bar = figure.colorbar(line, ax=[above, side], shrink=0.85, aspect=30, pad=0.015)
    bar.set_label("time (s)", fontsize=9)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=9, colors="#333333")
    handles, labels = above.get_legend_handles_labels()
    above.legend(handles, labels, loc="best", fontsize=8, frameon=True, framealpha=0.85,
                 edgecolor="none")  # fmt: skip

    depth, speed = figure.add_subplot(curves[0]), figure.add_subplot(curves[1])
    draw_curve(depth, seconds, surface_height - path[:, 2], color=_BLUE, linewidth=1.4)
    depth.set(xlabel="time (s)", ylabel="depth (m)")
    _widen(depth, surface_height - path[:, 2], least=0.1)
    depth.invert_yaxis()
    if len(seconds) > 2:
        momentary = np.linalg.norm(np.gradient(path, seconds, axis=0), axis=1)
        draw_curve(speed, seconds, momentary, color="#b9c6cf", linewidth=0.8, label="momentary")
        draw_curve(speed, seconds, speed_over(seconds, path), color=_ORANGE, linewidth=1.8,
                   label="over 1 s")  # fmt: skip
        legend_above(speed)
    speed.set(xlabel="time (s)", ylabel="speed (m/s)")
    speed.set_ylim(bottom=0)
    for axes in (above, side, depth, speed):
        dress(axes)
    for axes in (depth, speed):
        axes.set_xlim(seconds[0], max(seconds[-1], seconds[0] + 1e-6))
    if title:
        figure.suptitle(title, x=0.012, ha="left", fontsize=11, color="#222222")
    return figure


def _draw_path(axes: Axes, points: np.ndarray, seconds: np.ndarray) -> LineCollection:
    """A line whose colour tells the time, its start and its end marked."""
    kept = np.unique(np.linspace(0, len(points) - 1, min(len(points), _PIECES)).astype(int))
    points, seconds = points[kept], seconds[kept]
    segments = np.stack([points[:-1], points[1:]], axis=1)
    line = LineCollection(list(segments), cmap="viridis", linewidth=2.2, capstyle="round")
    line.set_array(seconds[:-1])
    axes.add_collection(line)
    axes.plot(*points[0], "o", color="white", markeredgecolor=_DEEP, markersize=8,
              markeredgewidth=1.8, label="start", zorder=5)  # fmt: skip
    axes.plot(*points[-1], "s", color=_ORANGE, markeredgecolor="white", markersize=8,
              label="end", zorder=5)  # fmt: skip
    return line


def _square_limits(axes: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """The same scale on both axes, and a frame of at least .2 m: nobody is misled by a wiggle."""
    half = max(np.ptp(x), np.ptp(y), 0.2) * 0.57
    for centre, limit in ((x, axes.set_xlim), (y, axes.set_ylim)):
        middle = (centre.min() + centre.max()) / 2
        limit(middle - half, middle + half)
    axes.set_aspect("equal", adjustable="box")


def _draw_surface(axes: Axes, height: float) -> None:
    """The water: tinted, with its surface where that is in the frame."""
    low, high = axes.get_ylim()
    if low < height < high:
        axes.axhspan(low, height, color=_WATER, zorder=0)
        axes.axhline(height, color="#4aa3df", linewidth=1.6, zorder=1)
        axes.text(0.985, height, "water surface", color="#2f7fb5", fontsize=8, ha="right",
                  va="bottom", transform=axes.get_yaxis_transform())  # fmt: skip
    elif height >= high:
        axes.set_facecolor(_WATER)
        axes.text(0.985, 0.98, f"water surface at z = {height:g} m ↑", color="#2f7fb5", fontsize=8,
                  ha="right", va="top", transform=axes.transAxes)  # fmt: skip


def _widen(axes: Axes, values: np.ndarray, least: float) -> None:
    low, high = float(np.min(values)), float(np.max(values))
    half = max((high - low) * 0.56, least / 2)
    axes.set_ylim((low + high) / 2 - half, (low + high) / 2 + half)
