"""Pictures of an episode in curves: path, depth and speed, joints, thrusters, power."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mjx_revolve.view.motion import (
    Motion,
    count_finite,
    last_strokes,
    last_swings,
    mean_rate,
    rms,
    speed_over,
)
from mjx_revolve.view.plots import (
    BLUE,
    DEEP,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    WIDE,
    color_bar,
    curve_with_band,
    in_style,
    legend_above,
    legend_outside,
    letter,
    new_figure,
    panels,
    style_of,
    thin,
)
from mjx_revolve.view.statistics import FEWEST, mean_and_half

if TYPE_CHECKING:
    from mjx_revolve.episodes.simulate import Trajectory

# Joints are shown over this many strokes, or all the time where there are none.
_STROKES = 6.0
_SWINGS = 12.0  # of a thruster's command that one picture shows


# --- the path -------------------------------------------------------------------------------------


def plot_trajectory(trajectory: Trajectory, surface_height: float = 0.0, title: str = "") -> Figure:
    """Draws the core's path of a trajectory, see `plot_path`."""
    count = max(count_finite(trajectory.qpos), 2)  # up to where it blows up
    time, path = np.asarray(trajectory.time, float), np.asarray(trajectory.xpos, float)[:, 1]
    time, path = time[:count], np.nan_to_num(path[:count])
    return plot_path(time, path, surface_height, title)


@in_style
def plot_path(
    time: np.ndarray, path: np.ndarray, surface_height: float = 0.0, title: str = ""
) -> Figure:
    """Draws the path of a robot.

    Args:
        time: `[T]` [s].
        path: `[T, 3]` of the core, world frame [m].
        surface_height: z of the water's surface [m].
        title: a line above the picture.

    Returns:
        The figure: the path from above, coloured by time, and depth and speed over time.
    """
    figure = new_figure(WIDE, 3.5, title)
    above, depth, speed = figure.subplots(1, 3, width_ratios=(1.5, 1.0, 1.0))
    rows = thin(len(path), 300)
    points = path[rows, :2]
    line = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), cmap="viridis",
                          linewidth=2.2, capstyle="round")  # fmt: skip
    line.set_array(time[rows][:-1])
    above.add_collection(line)
    above.plot(*points[0], "o", color="white", markeredgecolor=DEEP, markersize=8,
               markeredgewidth=1.8, label="start", zorder=5)  # fmt: skip
    above.plot(*points[-1], "s", color=ORANGE, markeredgecolor="white", markersize=8, label="end",
               zorder=5)  # fmt: skip
    above.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    above.locator_params(nbins=6)
    # At least 0.2 m wide: small wiggles stay small.
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    half = 0.57 * max(*np.ptp(path[:, :2], axis=0), 0.2)
    above.axis((middle[0] - half, middle[0] + half, middle[1] - half, middle[1] + half))
    color_bar(figure, line, "time (s)", ax=above, shrink=0.85, aspect=30, pad=0.015)
    legend_above(above)

    rows = thin(len(time))
    depths = surface_height - path[:, 2]
    depth.plot(time[rows], depths[rows], color=BLUE)
    half = max(0.56 * float(np.ptp(depths)), 0.05)
    middle = (depths.min() + depths.max()) / 2
    depth.set(ylabel="depth (m)", ylim=(middle + half, middle - half))
    if len(time) > 2:
        momentary = np.linalg.norm(np.gradient(path, time, axis=0), axis=1)
        speed.plot(time[rows], momentary[rows], color=PALE, linewidth=0.8, label="momentary")
        over = speed_over(time, path)[rows]
        speed.plot(time[rows], over, color=ORANGE, linewidth=1.8, label="over 1 s")
        legend_above(speed)
    speed.set(ylabel="speed (m/s)", ylim=(0, None))
    for axes in (depth, speed):
        axes.set(xlabel="time (s)", xlim=(time[0], max(time[-1], time[0] + 1e-6)))
    return figure


@in_style
def plot_champions(groups: Sequence[tuple[str, int, Sequence[Motion]]]) -> Figure:
    """Draws the champions of several runs beside each other.

    Args:
        groups: for each group its name, the number of its colour, and its champions' motions.

    Returns:
        The figure: paths from above and from the side, all from one start, and the distance from
        the start over time, mean over the seeds with its 95 % confidence band.
    """
    figure = new_figure(WIDE, 3.7)
    above, side, away = figure.subplots(1, 3)
    longest = max((m.path for *_, motions in groups for m in motions),
                  key=lambda path: float(np.ptp(path[:, :2], axis=0).max()))  # fmt: skip
    ahead = int(np.ptp(longest[:, :2], axis=0).argmax())  # the axis along which it goes further
    views = ((above, 0, 1, "from above"), (side, ahead, 2, "from the side"))
    for name, number, motions in groups:
        style = style_of(number)
        curves = []
        for motion in motions:
            path = motion.path - motion.path[0]
            rows = thin(len(path), 300)
            for axes, i, j, _ in views:
                axes.plot(path[rows, i], path[rows, j], linewidth=1.1, alpha=0.8, **style)
                axes.plot(*path[-1, [i, j]], "s", color=style["color"], markersize=4)
            curves.append(np.linalg.norm(path, axis=1))
            away.plot(motion.time, curves[-1], linewidth=0.5, alpha=0.5, **style)
        count = min(map(len, curves))
        mean, half, _ = mean_and_half([distance[:count] for distance in curves])
        half = half if len(curves) >= FEWEST else np.full(count, np.nan)
        curve_with_band(away, motions[0].time[:count], mean, np.maximum(mean - half, 0),
                        mean + half, label=f"{letter(number)}: {name}, n = {len(curves)}",
                        **style)  # fmt: skip
    for axes, i, j, words in views:
        axes.plot(0, 0, "o", color="white", markeredgecolor=INK, markersize=7, zorder=5)
        axes.set(xlabel=f"{'xyz'[i]} (m)", ylabel=f"{'xyz'[j]} (m)", title=words)
        axes.locator_params(nbins=5)
        axes.set_aspect("equal", adjustable="datalim")
    away.set(xlabel="time (s)", ylabel="distance from the start (m)", title="mean and 95 % band")
    away.set(xlim=(0, None), ylim=(0, None))
    if len(groups) > 1:
        legend_outside(figure, away, 2)
    return figure


# --- actuators ------------------------------------------------------------------------------------


def _strokes(motion: Motion) -> tuple[slice, str]:
    """Rows that show the strokes one by one, and what they are."""
    first = last_strokes(motion.time, motion.period, _STROKES)
    if not first:
        return slice(None), "the whole episode"
    return slice(first, None), f"the last {_STROKES:.0f} strokes of {motion.period:.2g} s"


def _names(motion: Motion, actuators: Sequence[int]) -> list[str]:
    return [motion.robot.mj_model.actuator(i).name for i in actuators]


def _plot_pairs(
    time: np.ndarray,
    names: Sequence[str],
    wanted: tuple[str, np.ndarray],
    actual: tuple[str, np.ndarray],
    what: str,
    words: str,
    row_height: float,
) -> Figure:
    """A set value (dashed) and the actual one, `[T, n]` each, in axes for each actuator."""
    columns = 1 if len(names) == 1 else 2 if len(names) <= 12 else 3 if len(names) <= 30 else 4
    figure = new_figure(WIDE, max(0.75 + row_height * math.ceil(len(names) / columns), 2.4))
    grid = panels(figure, len(names), columns, "time (s)", sharex=True, sharey=True)
    for k, axes in enumerate(grid):
        axes.plot(time, wanted[1][:, k], color=ORANGE, linewidth=1.0, linestyle=(0, (3, 1)),
                  label=wanted[0])  # fmt: skip
        axes.plot(time, actual[1][:, k], color=BLUE, label=actual[0])
        axes.set_title(names[k], fontsize=8.5, pad=3)
        axes.set_xlim(time[0], time[-1])
    legend_outside(figure, grid[0], 2, "upper right")
    figure.legends[0].set(title=words, alignment="right")
    figure.supylabel(what, fontsize=9.5, color=INK)
    return figure


@in_style
def plot_joints(motion: Motion) -> Figure:
    """Draws the angle of each joint and the target that it follows; the robot has hinges."""
    rows, words = _strokes(motion)
    targets, angles = np.degrees(motion.targets[rows]), np.degrees(motion.angles[rows])
    names = _names(motion, motion.robot.servos)
    figure = _plot_pairs(motion.time[rows], names, ("target", targets), ("angle", angles),
                         "joint angle (°)", words, 1.15)  # fmt: skip
    for axes, error in zip(figure.axes, rms(angles - targets), strict=True):
        axes.set_title(f"rms error {error:.2g}°", loc="right", fontsize=8, color=GREY, pad=3)
        axes.yaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 1.5, 2, 3, 5, 10]))
    return figure


@in_style
def plot_thrusters(motion: Motion) -> Figure:
    """Draws the command of each thruster and its lagged value; the robot has thrusters."""
    first = last_swings(motion.time, motion.commands, _SWINGS)
    span = motion.time[-1] - motion.time[first]
    words = f"the last {span:.2g} s" if first else "the whole episode"
    names = _names(motion, motion.robot.thrusters)
    pair = ("command", motion.commands[first:]), ("behind its lag", motion.lagged[first:])
    return _plot_pairs(motion.time[first:], names, *pair, "command (–)", words, 1.3)


@in_style
def plot_energy(motion: Motion) -> Figure:
    """Draws power over time, the energy so far, and the cost of transport after settling."""
    figure = new_figure(WIDE, 3.1)
    left, middle, right = figure.subplots(1, 3)
    rows = thin(len(motion.time))
    time, power, energy = motion.time[rows], motion.power[rows], motion.energy[rows]
    left.plot(time, power, color=PALE, linewidth=0.7, label="momentary")
    rate = mean_rate(motion.time, motion.energy)[rows]
    left.plot(time, rate, color=ORANGE, linewidth=1.7, label="over 1 s")
    # A lone spike at the start must not press the rest flat.
    most = max(float(np.percentile(motion.power, 99.5)), 1e-9)
    left.set(ylabel="power (W)", ylim=(0, 1.12 * most))
    legend_above(left)
    middle.plot(time, energy, color=BLUE, linewidth=1.7)
    middle.set(ylabel="energy so far (J)", ylim=(0, None))
    middle.set_title(f"{energy[-1]:.3g} J in {time[-1]:.3g} s")
    right.plot(time, motion.costs[rows], color=GREEN, linewidth=1.5)
    right.axvline(motion.counted_from, color=PALE, linewidth=1.0, linestyle=(0, (3, 2)))
    right.set(ylabel="cost of transport (–)", ylim=(0, 2.2 * max(motion.cost, 1e-6)))
    right.set_title(f"{motion.cost:.3g} at the end")
    for axes in (left, middle, right):
        axes.set(xlabel="time (s)", xlim=(0, time[-1]))
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 5, 10]))
    return figure
