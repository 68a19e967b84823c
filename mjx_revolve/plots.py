"""Pictures of a run: how the fitness grew, and the way the champion swam.

Figures are made with matplotlib's objects, without pyplot's global state, so that they can be drawn
anywhere: in a thread, in a test, on a machine without a screen.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

_BLUE, _DEEP, _ORANGE, _GREY = "#1f77b4", "#0b3c5d", "#e07b00", "#6b7680"
_WATER = "#eaf3f9"
# Axis labels of the measures that the tasks report; others are shown by their name.
_LABELS = {
    "speed_bl_s": "speed (body lengths/s)",
    "speed_m_s": "speed (m/s)",
    "straightness": "straightness (–)",
    "energy_j": "energy (J)",
    "depth_m": "depth (m)",
    "cost_of_transport": "cost of transport (–)",
}
_FIGURES = {
    "generation", "evaluations", "best", "mean", "std", "median", "champion", "step_size", "failed",
    "restarts", "seconds", "evaluations_per_second",
}  # fmt: skip


def _new_figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _dress(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_GREY)
    axes.tick_params(colors="#333333", labelsize=9)
    axes.grid(True, color="#d9dfe3", linewidth=0.6)
    axes.set_axisbelow(True)


def figure_png(figure: Figure) -> bytes:
    """Renders a figure.

    Args:
        figure: the figure.

    Returns:
        The bytes of a PNG.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def plot_fitness(
    metrics: Mapping[str, np.ndarray], title: str = "", label: str = "fitness"
) -> Figure:
    """Draws how the fitness grew.

    Args:
        metrics: columns of `metrics.csv`, each `[T]`: generation, best, mean, std, champion,
            step_size, and any measures of the generations' best.
        title: a line above the picture.
        label: what the fitness measures, with its unit.

    Returns:
        The figure: fitness on top, below it a measure (the speed, if there) and the step size.
    """
    generation = np.asarray(metrics["generation"])
    measures = [name for name in metrics if name not in _FIGURES]
    figure = _new_figure(8.0, 6.0)
    grid = figure.add_gridspec(2, 2, height_ratios=(2.4, 1.0))
    top = figure.add_subplot(grid[0, :])
    mean, std = np.asarray(metrics["mean"]), np.asarray(metrics["std"])
    dot = "o" if len(generation) < 3 else None
    top.fill_between(generation, mean - std, mean + std, color=_BLUE, alpha=0.15, linewidth=0,
                     label="mean ± standard deviation")  # fmt: skip
    top.plot(generation, mean, color=_BLUE, linewidth=1.6, label="mean", marker=dot)
    top.plot(generation, metrics["best"], color=_ORANGE, linewidth=1.1, label="best", marker=dot)
    top.step(generation, metrics["champion"], where="post", color=_DEEP, linewidth=1.4,
             linestyle=(0, (5, 2)), label="best so far")  # fmt: skip
    top.set_ylabel(label)
    _limit_to_the_many(top, metrics)
    # Fitness grows towards the top right, so the lower right stays free.
    top.legend(loc="lower right", fontsize=8.5, frameon=True, framealpha=0.9, edgecolor="none")
    if title:
        top.set_title(title, loc="left", fontsize=11, color="#222222")
    known = [name for name in _LABELS if name in measures]
    name = (known + measures + ["evaluations_per_second"])[0]
    left = figure.add_subplot(grid[1, 0], sharex=top)
    left.plot(generation, metrics[name], color=_ORANGE, linewidth=1.1, marker=dot)
    words = _LABELS.get(name, name.replace("_", " "))
    left.set_ylabel(words.replace(" (", "\n(") + ("\nof the best" if measures else ""), fontsize=9)
    right = figure.add_subplot(grid[1, 1], sharex=top)
    right.plot(generation, metrics["step_size"], color=_GREY, linewidth=1.3, marker=dot)
    if np.all(np.asarray(metrics["step_size"]) > 0):
        right.set_yscale("log")
        plain = FuncFormatter(lambda value, _: f"{value:g}")
        right.yaxis.set_major_formatter(plain)
        few = np.ptp(np.log10(metrics["step_size"])) < 1  # otherwise the decades suffice
        right.yaxis.set_minor_formatter(plain if few else FuncFormatter(lambda value, _: ""))
    right.set_ylabel("step size\n(gene units)", fontsize=9)
    for axes in (top, left, right):
        axes.set_xlabel("generation")
        _dress(axes)
        axes.tick_params(which="minor", labelsize=8, colors="#333333")
    top.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    span = max(float(generation[-1] - generation[0]), 1.0)
    top.set_xlim(generation[0] - 0.015 * span, generation[-1] + 0.015 * span)
    return figure


def _limit_to_the_many(axes: Axes, metrics: Mapping[str, np.ndarray]) -> None:
    """Keeps one terrible generation from squeezing all the others into a line."""
    low = np.asarray(metrics["mean"]) - np.asarray(metrics["std"])
    high = np.concatenate([metrics["best"], metrics["champion"]])
    low, high = low[np.isfinite(low)], high[np.isfinite(high)]
    if not low.size or not high.size:
        return
    bottom, top = float(np.percentile(low, 5)), float(high.max())
    # The worst few may lie below the frame only if they would take most of it.
    if top - low.min() < 2.0 * (top - bottom):
        bottom = float(low.min())
    margin = 0.06 * (top - bottom) or 0.1 * max(abs(top), 1e-3)
    axes.set_ylim(bottom - margin, top + margin)


def plot_trajectory(
    trajectory: Any, surface_height: float = 0.0, title: str = "", body: int = 1
) -> Figure:
    """Draws the way a robot swam, from above and from the side.

    Args:
        trajectory: has `time` `[T]` [s] and `xpos` `[T, nbody, 3]`, world frame [m].
        surface_height: of the water [m].
        title: a line above the picture.
        body: the body to follow; 1 is the robot's root.

    Returns:
        The figure: x-y and x-z paths coloured by time, depth and speed over time.
    """
    seconds = np.asarray(trajectory.time, float)
    path = np.asarray(trajectory.xpos, float)[:, body]
    figure = _new_figure(9.0, 6.6)
    outer = figure.add_gridspec(2, 1, height_ratios=(1.7, 1.0))
    paths = outer[0].subgridspec(1, 2)
    curves = outer[1].subgridspec(1, 2)
    above = figure.add_subplot(paths[0])
    side = figure.add_subplot(paths[1])
    line = _draw_path(above, path[:, [0, 1]], seconds)
    _draw_path(side, path[:, [0, 2]], seconds)
    above.set(xlabel="x (m)", ylabel="y (m)")
    above.set_title("from above", fontsize=9.5, color=_GREY)
    side.set(xlabel="x (m)", ylabel="z (m)")
    side.set_title("from the side", fontsize=9.5, color=_GREY)
    _square_limits(above, path[:, 0], path[:, 1])
    _square_limits(side, path[:, 0], path[:, 2])
    _draw_surface(side, surface_height)
    bar = figure.colorbar(line, ax=[above, side], shrink=0.85, aspect=30, pad=0.015)
    bar.set_label("time (s)", fontsize=9)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=9, colors="#333333")
    handles, labels = above.get_legend_handles_labels()
    above.legend(handles, labels, loc="best", fontsize=8, frameon=True, framealpha=0.85,
                 edgecolor="none")  # fmt: skip

    depth, speed = figure.add_subplot(curves[0]), figure.add_subplot(curves[1])
    depth.plot(seconds, surface_height - path[:, 2], color=_BLUE, linewidth=1.4)
    depth.set(xlabel="time (s)", ylabel="depth (m)")
    _widen(depth, surface_height - path[:, 2], least=0.1)
    depth.invert_yaxis()
    if len(seconds) > 2:
        velocity = np.gradient(path, seconds, axis=0)
        speed.plot(seconds, np.linalg.norm(velocity, axis=1), color="#b9c6cf", linewidth=0.8,
                   label="momentary")  # fmt: skip
        window, smooth = _smooth_velocity(path, seconds)
        speed.plot(window, np.linalg.norm(smooth, axis=1), color=_ORANGE, linewidth=1.8,
                   label="over 1 s")  # fmt: skip
        speed.legend(loc="best", fontsize=8, frameon=True, framealpha=0.85, edgecolor="none")
    speed.set(xlabel="time (s)", ylabel="speed (m/s)")
    speed.set_ylim(bottom=0)
    for axes in (above, side, depth, speed):
        _dress(axes)
    for axes in (depth, speed):
        axes.set_xlim(seconds[0], max(seconds[-1], seconds[0] + 1e-6))
    if title:
        figure.suptitle(title, x=0.012, ha="left", fontsize=11, color="#222222")
    return figure


def _draw_path(axes: Axes, points: np.ndarray, seconds: np.ndarray) -> LineCollection:
    """A line whose colour tells the time, its start and its end marked."""
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


def _smooth_velocity(path: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Displacement over one second (or all there is), at the middle of that second."""
    step = float(np.median(np.diff(seconds)))
    lag = int(np.clip(round(1.0 / step), 1, len(path) - 1))
    velocity = (path[lag:] - path[:-lag]) / (seconds[lag:] - seconds[:-lag])[:, None]
    return (seconds[lag:] + seconds[:-lag]) / 2, velocity
