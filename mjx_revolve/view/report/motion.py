"""Pictures of what a champion does: its joints, oscillators, thrusters and power over time.

The picture of its way through the water is that of `plots`.
"""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mjx_revolve.view.plots import COLORS, draw_curve, dress, legend_above, new_figure
from mjx_revolve.view.report.champion import Replay, path_of
from mjx_revolve.view.motion import stroke_period

_INK, _GREY, _PALE = "#222222", "#6b7680", "#b9c6cf"
_BLUE, _ORANGE, _GREEN = COLORS[:3]
# Joints are shown over this many strokes, or all the time where there are none.
_STROKES = 6.0
_SWINGS = 12.0  # of a thruster's command that one picture shows
_WIDE = 9.0  # of all figures [inches]


def _title(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="left", fontsize=10, color=_INK)


def _window(replay: Replay) -> tuple[slice, str]:
    """Rows that show the strokes one by one, and what they are."""
    time = np.asarray(replay.episode.trajectory.time, float)
    hinges = np.asarray(replay.episode.trajectory.qpos, float)[:, 7:]
    period = stroke_period(time, hinges)
    if period is None or time[-1] <= 1.5 * _STROKES * period:
        return slice(0, len(time)), "the whole episode"
    first = int(np.searchsorted(time, time[-1] - _STROKES * period))
    return slice(first, len(time)), f"the last {_STROKES:.0f} strokes of {period:.2g} s"


def _small(figure: Figure, count: int, columns: int) -> list[Axes]:
    """Small axes that share what they measure, numbers at the outer ones only."""
    rows = math.ceil(count / columns)
    all_axes: list[Axes] = []
    for k in range(count):
        first = all_axes[0] if all_axes else None
        axes = figure.add_subplot(rows, columns, k + 1, sharex=first, sharey=first)
        dress(axes)
        axes.tick_params(labelbottom=k + columns >= count, labelleft=k % columns == 0)
        axes.set_xlabel("time (s)" if k + columns >= count else "", fontsize=9)
        all_axes.append(axes)
    return all_axes


def _columns(count: int) -> int:
    return 1 if count == 1 else 2 if count <= 12 else 3 if count <= 30 else 4


def plot_joints(replay: Replay) -> Figure:
    """Draws the angle of each joint and the target that it follows.

    Args:
        replay: of a robot with hinges.

    Returns:
        The figure.
    """
    robot, trajectory = replay.episode.robot, replay.episode.trajectory
    servos = list(robot.servos)
    rows, words = _window(replay)
    time = np.asarray(trajectory.time)[rows]
    targets = np.degrees(np.asarray(trajectory.ctrl)[rows][:, servos])
    joints = [int(robot.mj_model.actuator_trnid[i, 0]) for i in servos]
    places = [int(robot.mj_model.jnt_qposadr[j]) for j in joints]
    angles = np.degrees(np.asarray(trajectory.qpos)[rows][:, places])
    columns = _columns(len(servos))
    height = 0.75 + 1.15 * math.ceil(len(servos) / columns)
    figure = new_figure(_WIDE, max(height, 2.4))
    for k, axes in enumerate(_small(figure, len(servos), columns)):
        axes.plot(time, targets[:, k], color=_ORANGE, linewidth=1.0, label="target",
                  linestyle=(0, (3, 1)))  # fmt: skip
        axes.plot(time, angles[:, k], color=_BLUE, linewidth=1.3, label="angle")
        error = math.sqrt(float(np.mean((angles[:, k] - targets[:, k]) ** 2)))
        axes.set_title(f"{robot.mj_model.actuator(servos[k]).name}", loc="left", fontsize=8.5,
                       color=_INK, pad=3)  # fmt: skip
        axes.set_title(f"rms error {error:.2g}°", loc="right", fontsize=8, color=_GREY, pad=3)
        axes.yaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 1.5, 2, 3, 5, 10]))
        axes.set_xlim(time[0], time[-1])
    figure.supylabel("joint angle (°)", fontsize=9.5, color=_INK)
    _top_legend(figure, words)
    return figure


def _top_legend(figure: Figure, words: str) -> None:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", fontsize=8.5, ncols=len(labels),
                  frameon=False, title=words, title_fontsize=8.5, alignment="right")  # fmt: skip


def _lively(time: np.ndarray, commands: np.ndarray) -> tuple[slice, str]:
    """The end of an episode, where its commands swing too often to show all of it."""
    away = commands - commands.mean(axis=0)
    swings = (np.diff(np.sign(away), axis=0) != 0).sum(axis=0).max() / 2
    if swings <= 2 * _SWINGS:
        return slice(0, len(time)), "the whole episode"
    span = float(time[-1] - time[0]) * _SWINGS / swings
    return slice(int(np.searchsorted(time, time[-1] - span)), len(time)), f"the last {span:.2g} s"


def plot_thrusters(replay: Replay) -> Figure:
    """Draws the command of each thruster and what its lag makes of it.

    Args:
        replay: of a robot with thrusters.

    Returns:
        The figure.
    """
    robot, trajectory = replay.episode.robot, replay.episode.trajectory
    ids = list(robot.thrusters)
    rows, words = _lively(np.asarray(trajectory.time), np.asarray(trajectory.ctrl)[:, ids])
    time = np.asarray(trajectory.time)[rows]
    ctrl = np.asarray(trajectory.ctrl)[rows][:, ids]
    command = np.asarray(trajectory.command)[rows]
    columns = _columns(len(ids))
    figure = new_figure(_WIDE, max(0.75 + 1.3 * math.ceil(len(ids) / columns), 2.4))
    for k, axes in enumerate(_small(figure, len(ids), columns)):
        axes.plot(time, ctrl[:, k], color=_ORANGE, linewidth=1.0, linestyle=(0, (3, 1)),
                  label="command")  # fmt: skip
        axes.plot(time, command[:, k], color=_BLUE, linewidth=1.3, label="behind its lag")
        axes.set_title(robot.mj_model.actuator(ids[k]).name, loc="left", fontsize=8.5, color=_INK,
                       pad=3)  # fmt: skip
        axes.set_xlim(time[0], time[-1])
    figure.supylabel("command (–)", fontsize=9.5, color=_INK)
    _top_legend(figure, words)
    return figure


def plot_phases(replay: Replay) -> Figure:
    """Draws the phases of a CPG.

    Args:
        replay: with `phases`.

    Returns:
        The figure: phase of each oscillator over time, and its mean frequency.
    """
    assert replay.phases is not None
    robot = replay.episode.robot
    rows, words = _window(replay)
    time = np.asarray(replay.episode.trajectory.time, float)
    phases = replay.phases
    names = [robot.mj_model.actuator(i).name for i in robot.servos]
    turned = np.unwrap(phases, axis=0)
    span = max(float(time[-1] - time[0]), 1e-9)
    rate = (turned[-1] - turned[0]) / (2 * np.pi * span)
    figure = new_figure(_WIDE, 1.5 + 0.24 * len(names))
    grid = figure.add_gridspec(1, 2, width_ratios=(3.2, 1.0))
    left, right = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    shown = time[rows]
    image = left.imshow(
        np.mod(phases[rows].T, 2 * np.pi), aspect="auto", cmap="twilight", vmin=0, vmax=2 * np.pi,
        interpolation="nearest", extent=(shown[0], shown[-1], len(names) - 0.5, -0.5),
    )  # fmt: skip
    left.set_yticks(range(len(names)), names)
    left.set_xlabel("time (s)")
    _title(left, f"phase of each oscillator, {words}")
    left.tick_params(colors="#333333", labelsize=9)
    bar = figure.colorbar(image, ax=left, pad=0.015, aspect=25)
    bar.set_ticks(
        [0, np.pi / 2, np.pi, 3 * np.pi / 2, 2 * np.pi], labels=["0", "π/2", "π", "3π/2", "2π"]
    )
    bar.set_label("phase (rad)", fontsize=9)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8.5, colors="#333333")
    right.barh(range(len(names)), rate, color=_BLUE, height=0.6)
    right.set_ylim(len(names) - 0.5, -0.5)
    right.set_yticks(range(len(names)), [""] * len(names))
    right.set_xlabel("mean frequency (Hz)")
    right.xaxis.set_major_locator(MaxNLocator(nbins=5))
    right.axvline(0, color=_GREY, linewidth=0.8)
    _title(right, "turns per second")
    dress(right)
    right.grid(False, axis="y")
    return figure


def plot_energy(replay: Replay) -> Figure:
    """Draws power, energy and cost of transport.

    Args:
        replay: the episode.

    Returns:
        The figure: power over time, energy so far, and the cost of transport so far, counted from
        the end of the settling time.
    """
    time, path = path_of(replay)
    trajectory = replay.episode.trajectory
    power = np.asarray(trajectory.power, float)
    step = float(np.median(np.diff(time)))
    energy = np.cumsum(power) * step
    figure = new_figure(_WIDE, 3.1)
    left, middle, right = (figure.add_subplot(1, 3, k + 1) for k in range(3))
    draw_curve(left, time, power, color=_PALE, linewidth=0.7, label="momentary")
    lag = int(np.clip(round(1.0 / step), 1, max(len(time) - 1, 1)))
    draw_curve(left, (time[lag:] + time[:-lag]) / 2, (energy[lag:] - energy[:-lag]) / (lag * step),
               color=_ORANGE, linewidth=1.7, label="over 1 s")  # fmt: skip
    left.set_ylabel("power (W)")
    # A lone spike at the start must not press the rest flat.
    top = max(float(np.percentile(power, 99.5)), 1e-9)
    left.set_ylim(0, 1.12 * min(max(top, 1e-9), max(float(power.max()), 1e-9)))
    legend_above(left)
    draw_curve(middle, time, energy, color=_BLUE, linewidth=1.7)
    middle.set_ylabel("energy so far (J)")
    middle.set_ylim(bottom=0)
    _title(middle, f"{energy[-1]:.3g} J in {time[-1]:.3g} s")
    _draw_cost(right, replay, time, path, energy)
    for axes in (left, middle, right):
        axes.set_xlabel("time (s)")
        axes.set_xlim(0, time[-1])
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 5, 10]))
        dress(axes)
    return figure


def _draw_cost(
    axes: Axes, replay: Replay, time: np.ndarray, path: np.ndarray, energy: np.ndarray
) -> None:
    """Cost of transport so far, once the robot has got anywhere."""
    first = min(int(np.searchsorted(time, replay.counted_from - 1e-6)), len(time) - 2)
    away = np.linalg.norm(path - path[first], axis=1)
    cost = (energy - energy[first]) / (replay.weight * np.maximum(away, 1e-3))
    final = float(cost[-1])
    # Close to the start the quotient is noise: a tenth of the way is something.
    late = (np.arange(len(time)) > first) & (away > 0.1 * max(float(away[first:].max()), 1e-3))
    draw_curve(axes, time[late], cost[late], color=_GREEN, linewidth=1.5)
    axes.set_ylabel("cost of transport (–)")
    axes.set_ylim(0, 2.2 * max(final, 1e-6))
    axes.axvline(replay.counted_from, color=_PALE, linewidth=1.0, linestyle=(0, (3, 2)))
    _title(axes, f"{final:.3g} at the end")
