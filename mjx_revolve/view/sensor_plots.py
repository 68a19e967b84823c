"""Pictures of sensors over an episode: readings as the controller gets them, and true values."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from mjx_revolve.view.plots import (
    COLORS,
    GREY,
    WIDE,
    color_bar,
    curve_with_band,
    in_style,
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
# A curve that turns more often than this is shown by its mean and its spread over so many shares of
# the time: three such curves over one another show nothing else. Choices, for half a page's width.
_MAX_TURNS, _BINS = 150, 200
_ROW, _STRIP, _EDGE = 1.12, 0.17, 0.66  # heights: of curves, of a strip's row, around strips [in]


@in_style
def plot_sensors(time: np.ndarray, traces: Sequence[SensorTrace]) -> Figure:
    """Draws readings over time, in the sensors' units.

    Args:
        time: `[T]` before each step [s].
        traces: of the sensors; some.

    Returns:
        The figure: sensors of the whole robot as curves, with the true value behind them where a
        sensor errs; sensors at each hinge or rigid body as strips.
    """
    curves = [trace for trace in traces if len(trace.rows) == 1]
    strips = [trace for trace in traces if len(trace.rows) > 1]
    columns = 1 if len(curves) == 1 else 2
    lines = math.ceil(len(curves) / columns)
    heights = [_ROW * lines + 0.3] * bool(curves)
    heights += [_EDGE + _STRIP * len(trace.rows) for trace in strips]
    figure = new_figure(WIDE, sum(heights) + 0.45)
    parts = list(figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0])
    if curves:
        top = parts.pop(0)
        grid, first = top.add_gridspec(lines, columns), None
        odd = len(curves) % columns > 0  # the last one is as wide as two
        for k, trace in enumerate(curves):
            line, column = divmod(k, columns)
            wide = odd and k == len(curves) - 1
            axes = top.add_subplot(grid[line, :] if wide else grid[line, column], sharex=first)
            first = first or axes
            _draw_curves(axes, time, trace)
            # Ticks are those of the panel below, but for the wide one.
            axes.tick_params(labelbottom=line == lines - 1 or (line == lines - 2 and odd))
            if line == lines - 1:
                axes.set_xlabel("time (s)", fontsize=9)
        top.align_ylabels(top.axes)
        _draw_legend(top, curves)
    for part, trace in zip(parts, strips, strict=True):
        _draw_strips(part, time, trace)
    return figure


def _draw_legend(figure: SubFigure, curves: Sequence[SensorTrace]) -> None:
    """What lines mean, above them."""
    kinds = [t.sensor.kind.parts for t in curves if len(t.sensor.kind.parts) > 1]
    entries: list[tuple[str, Artist]] = []
    for k in range(max(map(len, kinds), default=0)):
        words = " / ".join(dict.fromkeys(parts[k] for parts in kinds if len(parts) > k))
        entries.append((words, Line2D([], [], color=COLORS[k], linewidth=1.6)))
    if any(map(_is_dense, curves)):
        entries.append(("spread", Patch(color=GREY, alpha=0.3, linewidth=0)))
    if not all(trace.is_exact or _is_dense(trace) for trace in curves):
        entries.append(("what was true", Line2D([], [], color=GREY, linewidth=3.5, alpha=0.3)))
    if any(map(_reached_limits, curves)):
        dotted = Line2D([], [], color=GREY, linewidth=0.9, linestyle=(0, (1, 2)))
        entries.append(("end of the range", dotted))
    if entries:
        names, handles = zip(*entries, strict=True)
        figure.legend(handles, names, loc="outside upper right", ncols=len(names),
                      handlelength=1.6, borderpad=0)  # fmt: skip


def _unit(trace: SensorTrace) -> str:
    unit = trace.sensor.kind.unit
    return {"-": "", "m/s2": "m/s²", "N m": "N·m"}.get(unit, unit)


def _set_titles(left: Axes, right: Axes, trace: SensorTrace, name: str = "") -> None:
    """The sensor's name at the left, its errors at the right."""
    sensor, unit = trace.sensor, _unit(trace)
    errors = [f"noise {sensor.noise:g} {unit}".strip()] if sensor.noise else []
    errors += [f"{sensor.rate:g} Hz"] if sensor.rate is not None else []
    errors += [f"{1000 * sensor.delay:g} ms late"] if sensor.delay else []
    left.set_title(name or sensor.label, fontsize=9, pad=4)
    right.set_title(", ".join(errors) or "exact", loc="right", fontsize=8, color=GREY, pad=4)


def _is_dense(trace: SensorTrace) -> bool:
    """Whether its curves oscillate too often to be drawn."""
    if trace.sensor.rate is not None:
        return False
    given = trace.given[:, :, 0]
    change = np.diff(given, axis=0)
    # A change too small to be seen is no turn.
    change = np.where(np.abs(change) > 0.01 * np.ptp(given), np.sign(change), 0)
    return bool((change[1:] * change[:-1] < 0).sum(0).max() > _MAX_TURNS)


def _reached_limits(trace: SensorTrace) -> tuple[float, ...]:
    """Ends of the sensor's range that the true value went beyond."""
    low, high = trace.sensor.limits
    true = trace.true[np.isfinite(trace.true)]
    if not true.size:
        return ()
    return tuple(x for x, beyond in ((low, true.min() < low), (high, true.max() > high)) if beyond)


def _draw_curves(axes: Axes, time: np.ndarray, trace: SensorTrace) -> None:
    """Readings of a sensor of the whole robot."""
    rows, sensor = thin(len(time), _POINTS), trace.sensor
    style = "default" if sensor.rate is None else "steps-post"
    for k in range(trace.given.shape[1]):
        given, true, color = trace.given[:, k, 0], trace.true[:, k, 0], COLORS[k]
        if _is_dense(trace):
            edges = np.linspace(0, len(given), min(_BINS, len(given)) + 1).astype(int)
            mean = np.add.reduceat(given, edges[:-1]) / np.diff(edges)
            low, high = (f.reduceat(given, edges[:-1]) for f in (np.minimum, np.maximum))
            at = time[0] + (time[-1] - time[0]) * (np.arange(len(mean)) + 0.5) / len(mean)
            curve_with_band(axes, at, mean, low, high, color, linewidth=1.1)
            continue
        if not trace.is_exact:
            shown = np.where(np.isfinite(true), true, np.nan)[rows]
            axes.plot(time[rows], shown, color=color, linewidth=3.0, alpha=0.28)
        axes.plot(time[rows], given[rows], color=color, linewidth=1.1, drawstyle=style)
    for limit in _reached_limits(trace):
        axes.axhline(limit, color=GREY, linewidth=0.9, linestyle=(0, (1, 2)))
    bottom, top = float(trace.given.min()), float(trace.given.max())
    span = max(top - bottom, _MIN_RANGE * (sensor.limits[1] - sensor.limits[0]))
    middle = (bottom + top) / 2
    axes.set(xlim=(time[0], time[-1]), ylim=(middle - 0.58 * span, middle + 0.58 * span))
    axes.yaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 2.5, 5, 10]))
    axes.set_ylabel(_unit(trace), fontsize=9)
    _set_titles(axes, axes, trace)


def _draw_strips(figure: SubFigure, time: np.ndarray, trace: SensorTrace) -> None:
    """Readings of a sensor at each hinge or rigid body: rows of colour over time."""
    sensor, parts = trace.sensor, trace.given.shape[1]
    grid = figure.subplots(1, parts, sharey=True, squeeze=False)[0]
    low, high = (float(x) for x in np.percentile(trace.given, (_CUT, 100 - _CUT)))
    least = _MIN_RANGE * (sensor.limits[1] - sensor.limits[0])
    if low < 0 < high:  # of both signs: white is zero
        high = max(-low, high, least / 2)
        colors, low = "RdBu_r", -high
    else:
        colors, high = "cividis", max(high, low + least)
    rows = thin(len(time), _POINTS)
    extent = (time[0], time[-1], len(trace.rows) - 0.5, -0.5)
    for k, axes in enumerate(grid):
        image = axes.imshow(trace.given[rows, k].T, aspect="auto", cmap=colors, vmin=low, vmax=high,
                            extent=extent)  # fmt: skip
        axes.grid(False)
        axes.set_yticks(range(len(trace.rows)), trace.rows)
        axes.tick_params(labelsize=8.5, length=2)
        axes.spines[:].set_visible(False)
        axes.set_xlabel("time (s)", fontsize=9)
        # White lines keep neighbours apart.
        for row in range(1, len(trace.rows)):
            axes.axhline(row - 0.5, color="white", linewidth=0.8)
        name = f"{sensor.label} {sensor.kind.parts[k]}".strip() if parts > 1 else ""
        _set_titles(axes, grid[-1], trace, name)
    color_bar(figure, image, _unit(trace), ax=grid, pad=0.012, aspect=14, extend="both")
