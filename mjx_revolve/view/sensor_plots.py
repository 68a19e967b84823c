"""Pictures of sensors over an episode: readings as the controller gets them, and true values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mjx_revolve.view.plots import (
    COLORS,
    GREY,
    WIDE,
    color_bar,
    in_style,
    legend_above,
    new_figure,
    thin,
)
from mjx_revolve.view.sensor_log import SensorTrace

# Points of a curve: a dozen to a stroke of an episode of half a minute.
_POINTS = 700
# The range of an axis is no narrower than this share of the sensor's, so that noise is not blown up
# to look like a signal. A choice.
_MIN_RANGE = 0.02
# Of strips, so much is cut off at either end of the range, so that one jolt does not pale the
# rest [%].
_CUT = 0.5
_ROW, _STRIP, _EDGE = 1.3, 0.17, 0.4  # heights: of curves, of a strip's row, around strips [in]


@in_style
def plot_sensors(time: np.ndarray, traces: Sequence[SensorTrace]) -> Figure:
    """Draws readings over time, in the sensors' units.

    Args:
        time: `[T]` before each step [s].
        traces: of the sensors; some.

    Returns:
        The figure: sensors of the whole robot as curves, with the true value behind them where a
        sensor errs; then sensors at each hinge or rigid body as strips.
    """
    shown = [(trace, -1) for trace in traces if len(trace.rows) == 1]
    shown += [(t, k) for t in traces if len(t.rows) > 1 for k in range(t.given.shape[1])]
    heights = [_ROW if k < 0 else _EDGE + _STRIP * len(trace.rows) for trace, k in shown]
    figure = new_figure(WIDE, sum(heights) + 0.45)
    grid = figure.subplots(len(shown), 1, height_ratios=heights, sharex=True, squeeze=False)
    for axes, (trace, k) in zip(grid[:, 0], shown, strict=True):
        sensor, unit = trace.sensor, _unit(trace)
        errors = [f"noise {sensor.noise:g} {unit}".strip()] if sensor.noise else []
        errors += [f"{sensor.rate:g} Hz"] if sensor.rate is not None else []
        errors += [f"{1000 * sensor.delay:g} ms late"] if sensor.delay else []
        parts = sensor.kind.parts
        name = f"{sensor.label} {parts[k] if k >= 0 and len(parts) > 1 else ''}".strip()
        axes.set_title(f"{name}: {', '.join(errors) or 'exact'}", fontsize=9, pad=4)
        if k < 0:
            _draw_curves(axes, time, trace)
        else:
            _draw_strips(figure, axes, time, trace, k)
    axes.set(xlabel="time (s)", xlim=(time[0], time[-1]))
    return figure


def _unit(trace: SensorTrace) -> str:
    unit = trace.sensor.kind.unit
    return {"-": "", "m/s2": "m/s²", "N m": "N·m"}.get(unit, unit)


def _draw_curves(axes: Axes, time: np.ndarray, trace: SensorTrace) -> None:
    """Readings of a sensor of the whole robot."""
    rows, sensor, parts = thin(len(time), _POINTS), trace.sensor, trace.sensor.kind.parts
    style = "default" if trace.rate is None else "steps-post"
    for k in range(trace.given.shape[1]):
        given, true, color = trace.given[rows, k, 0], trace.true[rows, k, 0], COLORS[k]
        if not trace.is_exact:
            axes.plot(time[rows], np.where(np.isfinite(true), true, np.nan), color=color,
                      linewidth=3.0, alpha=0.28, label="" if k else "what was true")  # fmt: skip
        axes.plot(time[rows], given, color=color, linewidth=1.0, drawstyle=style,
                  label=parts[k] if len(parts) > 1 else "")  # fmt: skip
    bottom, top = float(trace.given.min()), float(trace.given.max())
    span = max(top - bottom, _MIN_RANGE * (sensor.limits[1] - sensor.limits[0]))
    middle = (bottom + top) / 2
    axes.set_ylim(middle - 0.58 * span, middle + 0.58 * span)
    for limit in sensor.limits:
        axes.axhline(limit, color=GREY, linewidth=0.9, linestyle=(0, (1, 2)))
    axes.yaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 2.5, 5, 10]))
    axes.set_ylabel(_unit(trace), fontsize=9)
    legend_above(axes)


def _draw_strips(
    figure: Figure, axes: Axes, time: np.ndarray, trace: SensorTrace, part: int
) -> None:
    """Readings of a sensor at each hinge or rigid body: rows of colour over time."""
    sensor, rows, count = trace.sensor, thin(len(time), _POINTS), len(trace.rows)
    low, high = (float(x) for x in np.percentile(trace.given, (_CUT, 100 - _CUT)))
    least = _MIN_RANGE * (sensor.limits[1] - sensor.limits[0])
    if low < 0 < high:  # of both signs: white is zero
        high = max(-low, high, least / 2)
        colors, low = "RdBu_r", -high
    else:
        colors, high = "cividis", max(high, low + least)
    image = axes.imshow(trace.given[rows, part].T, aspect="auto", cmap=colors, vmin=low, vmax=high,
                        extent=(time[0], time[-1], count - 0.5, -0.5))  # fmt: skip
    axes.grid(False)
    axes.set_yticks(range(count), trace.rows)
    axes.tick_params(labelsize=8.5, length=2)
    axes.spines[:].set_visible(False)
    axes.hlines(np.arange(1, count) - 0.5, *time[[0, -1]], color="white", linewidth=0.8)
    color_bar(figure, image, _unit(trace), ax=axes, pad=0.012, aspect=8, extend="both")
