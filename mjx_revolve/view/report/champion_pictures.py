"""Pictures of what a champion does: its joints, oscillators, thrusters and power over time.

The picture of its way through the water is that of `plots`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mjx_revolve.view.motion import (
    Motion,
    last_strokes,
    last_swings,
    mean_frequency,
    mean_rate,
    rms,
)
from mjx_revolve.view.plots import (
    COLORS,
    WIDE,
    draw_curve,
    dress,
    head,
    legend_above,
    new_figure,
)

_INK, _GREY, _PALE = "#222222", "#6b7680", "#b9c6cf"
_BLUE, _ORANGE, _GREEN = COLORS[:3]
# Joints are shown over this many strokes, or all the time where there are none.
_STROKES = 6.0
_SWINGS = 12.0  # of a thruster's command that one picture shows


def _strokes(motion: Motion) -> tuple[slice, str]:
    """Rows that show the strokes one by one, and what they are."""
    first = last_strokes(motion.time, motion.period, _STROKES)
    if not first:
        return slice(None), "the whole episode"
    return slice(first, None), f"the last {_STROKES:.0f} strokes of {motion.period:.2g} s"


def _names(motion: Motion, actuators: Sequence[int]) -> list[str]:
    return [motion.robot.mj_model.actuator(i).name for i in actuators]


def _draw_pairs(
    motion: Motion,
    rows: slice,
    names: Sequence[str],
    curves: tuple[np.ndarray, np.ndarray],
    labels: tuple[str, str],
    what: str,
    words: str,
    row_height: float,
) -> Figure:
    """What is wanted (dashed) and what comes of it, `[T, n]` each, in axes of their own."""
    columns = 1 if len(names) == 1 else 2 if len(names) <= 12 else 3 if len(names) <= 30 else 4
    lines = math.ceil(len(names) / columns)
    figure = new_figure(WIDE, max(0.75 + row_height * lines, 2.4))
    grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(names) :]:
        axes.remove()
    time = motion.time[rows]
    for k, axes in enumerate(figure.axes):
        dress(axes)
        for curve, color, width, dash, label in zip(
            curves, (_ORANGE, _BLUE), (1.0, 1.3), ((0, (3, 1)), "-"), labels, strict=True
        ):
            axes.plot(time, curve[rows, k], color=color, linewidth=width, linestyle=dash,
                      label=label)  # fmt: skip
        axes.set_title(names[k], loc="left", fontsize=8.5, color=_INK, pad=3)
        axes.set_xlim(time[0], time[-1])
        if k + columns >= len(names):  # nothing below it
            axes.tick_params(labelbottom=True)
            axes.set_xlabel("time (s)", fontsize=9)
    handles, _ = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", fontsize=8.5, ncols=2,
                  frameon=False, title=words, title_fontsize=8.5, alignment="right")  # fmt: skip
    figure.supylabel(what, fontsize=9.5, color=_INK)
    return figure


def plot_joints(motion: Motion) -> Figure:
    """Draws the angle of each joint and the target that it follows.

    Args:
        motion: of a robot with hinges.

    Returns:
        The figure.
    """
    rows, words = _strokes(motion)
    curves = np.degrees(motion.targets), np.degrees(motion.angles)
    names = _names(motion, motion.robot.servos)
    figure = _draw_pairs(
        motion, rows, names, curves, ("target", "angle"), "joint angle (°)", words, 1.15
    )
    errors = np.degrees(rms(motion.angles[rows] - motion.targets[rows]))
    for axes, error in zip(figure.axes, errors, strict=True):
        axes.set_title(f"rms error {error:.2g}°", loc="right", fontsize=8, color=_GREY, pad=3)
        axes.yaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 1.5, 2, 3, 5, 10]))
    return figure


def plot_thrusters(motion: Motion) -> Figure:
    """Draws the command of each thruster and what its lag makes of it.

    Args:
        motion: of a robot with thrusters.

    Returns:
        The figure.
    """
    first = last_swings(motion.time, motion.commands, _SWINGS)
    words = (
        f"the last {motion.time[-1] - motion.time[first]:.2g} s" if first else "the whole episode"
    )
    curves, labels = (motion.commands, motion.lagged), ("command", "behind its lag")
    names = _names(motion, motion.robot.thrusters)
    rows = slice(first, None)
    return _draw_pairs(motion, rows, names, curves, labels, "command (–)", words, 1.3)


def plot_phases(motion: Motion) -> Figure:
    """Draws the phases of a CPG.

    Args:
        motion: with `phases`.

    Returns:
        The figure: phase of each oscillator over time, and its mean frequency.
    """
    assert motion.phases is not None
    rows, words = _strokes(motion)
    names = _names(motion, motion.robot.servos)
    figure = new_figure(WIDE, 1.5 + 0.24 * len(names))
    left, right = figure.subplots(1, 2, width_ratios=(3.2, 1.0))
    shown = motion.time[rows]
    image = left.imshow(
        np.mod(motion.phases[rows].T, 2 * np.pi), aspect="auto", cmap="twilight",
        vmin=0, vmax=2 * np.pi, interpolation="nearest",
        extent=(shown[0], shown[-1], len(names) - 0.5, -0.5),
    )  # fmt: skip
    left.set_yticks(range(len(names)), names)
    left.set_xlabel("time (s)")
    head(left, f"phase of each oscillator, {words}")
    left.tick_params(colors="#333333", labelsize=9)
    bar = figure.colorbar(image, ax=left, pad=0.015, aspect=25)
    bar.set_ticks(
        [0, np.pi / 2, np.pi, 3 * np.pi / 2, 2 * np.pi], labels=["0", "π/2", "π", "3π/2", "2π"]
    )
    bar.set_label("phase (rad)", fontsize=9)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8.5, colors="#333333")
    right.barh(
        range(len(names)), mean_frequency(motion.time, motion.phases), color=_BLUE, height=0.6
    )
    right.set_ylim(len(names) - 0.5, -0.5)
    right.set_yticks(range(len(names)), [""] * len(names))
    right.set_xlabel("mean frequency (Hz)")
    right.xaxis.set_major_locator(MaxNLocator(nbins=5))
    right.axvline(0, color=_GREY, linewidth=0.8)
    head(right, "turns per second")
    dress(right)
    right.grid(False, axis="y")
    return figure


def plot_energy(motion: Motion) -> Figure:
    """Draws power, energy and cost of transport.

    Args:
        motion: what the robot did.

    Returns:
        The figure: power over time, energy so far, and the cost of transport so far, counted from
        the end of the settling time.
    """
    time, power, energy = motion.time, motion.power, motion.energy
    figure = new_figure(WIDE, 3.1)
    left, middle, right = figure.subplots(1, 3)
    draw_curve(left, time, power, color=_PALE, linewidth=0.7, label="momentary")
    draw_curve(left, time, mean_rate(time, energy), color=_ORANGE, linewidth=1.7, label="over 1 s")
    left.set_ylabel("power (W)")
    # A lone spike at the start must not press the rest flat.
    left.set_ylim(0, 1.12 * max(float(np.percentile(power, 99.5)), 1e-9))
    legend_above(left)
    draw_curve(middle, time, energy, color=_BLUE, linewidth=1.7)
    middle.set_ylabel("energy so far (J)")
    middle.set_ylim(bottom=0)
    head(middle, f"{energy[-1]:.3g} J in {time[-1]:.3g} s")
    draw_curve(right, time, motion.costs, color=_GREEN, linewidth=1.5)
    right.set_ylabel("cost of transport (–)")
    right.set_ylim(0, 2.2 * max(motion.cost, 1e-6))
    right.axvline(motion.counted_from, color=_PALE, linewidth=1.0, linestyle=(0, (3, 2)))
    head(right, f"{motion.cost:.3g} at the end")
    for axes in (left, middle, right):
        axes.set_xlabel("time (s)")
        axes.set_xlim(0, time[-1])
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 5, 10]))
        dress(axes)
    return figure
