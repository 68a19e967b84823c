"""Pictures of what a champion felt: what its brain was told of each sensor, and what was true."""

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

from mjx_revolve.view.felt import Felt
from mjx_revolve.view.plots import COLORS, WIDE, dress, new_figure

_INK, _GREY = "#222222", "#6b7680"
_AXES = (COLORS[0], COLORS[1], COLORS[2])  # of x, y, z, or of left and right
# A curve is drawn through at most so many points: a dozen to a stroke of an episode of half a
# minute.
_POINTS = 700
# The range of an axis is no narrower than this share of the sensor's, so that noise is not blown up
# to look like a signal. A choice.
_LEAST = 0.02
# Of strips, so much is cut off at either end of what is shown, so that one jolt does not pale the
# rest [%].
_CUT = 0.5
# A curve that turns more often than this is shown by its mean and its spread over so many shares of
# the time: three such curves over one another show nothing else. Choices, for half a page's width.
_TURNS, _BINS = 150, 200
_ROW, _STRIP, _EDGE = 1.12, 0.17, 0.66  # heights: of curves, of a strip's row, around strips [in]


def plot_senses(time: np.ndarray, felt: Sequence[Felt]) -> Figure:
    """Draws what was told over time, in the sensors' units.

    Args:
        time: `[T]` before each step [s].
        felt: of the sensors; some.

    Returns:
        The figure: what there is once as curves, with what was true behind them where a sensor
        errs; what there is at each hinge or rigid body as strips.
    """
    curves = [one for one in felt if len(one.rows) == 1]
    strips = [one for one in felt if len(one.rows) > 1]
    columns = 1 if len(curves) == 1 else 2
    lines = math.ceil(len(curves) / columns)
    heights = [_ROW * lines + 0.3] * bool(curves)
    heights += [_EDGE + _STRIP * len(one.rows) for one in strips]
    figure = new_figure(WIDE, sum(heights) + 0.45)
    parts = list(figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0])
    if curves:
        top = parts.pop(0)
        grid, first = top.add_gridspec(lines, columns), None
        for k, one in enumerate(curves):
            line, column = divmod(k, columns)
            last = k == len(curves) - 1  # alone in its line, it is as wide as two
            place = grid[line, :] if last and not column else grid[line, column]
            axes = top.add_subplot(place, sharex=first)
            first = first or axes
            _draw_curves(axes, time, one)
            # A line's ticks are those of the one below, but for the wide one.
            above_wide = line == lines - 2 and len(curves) % columns > 0
            axes.tick_params(labelbottom=line == lines - 1 or above_wide)
            if line == lines - 1:
                axes.set_xlabel("time (s)", fontsize=9)
        top.align_ylabels(top.axes)
        _explain(top, curves)
    for part, one in zip(parts, strips, strict=True):
        _draw_strips(part, time, one)
    return figure


def _explain(figure: SubFigure, curves: Sequence[Felt]) -> None:
    """What lines mean, above them."""
    most = max(len(one.sensor.kind.parts) for one in curves)
    lines: list[Artist] = []
    if most > 1:
        lines += [Line2D([], [], color=_AXES[k], linewidth=1.6) for k in range(most)]
    parts = [one.sensor.kind.parts for one in curves if len(one.sensor.kind.parts) > 1]
    words = [" / ".join(dict.fromkeys(x[k] for x in parts if len(x) > k)) for k in range(most)]
    words = words if most > 1 else []
    if any(_is_dense(one) for one in curves):
        lines.append(Patch(color=_GREY, alpha=0.3, linewidth=0))
        words.append("spread")
    if not all(one.is_exact or _is_dense(one) for one in curves):
        lines.append(Line2D([], [], color=_GREY, linewidth=3.5, alpha=0.3))
        words.append("what was true")
    if any(_edges(one) for one in curves):
        lines.append(Line2D([], [], color=_GREY, linewidth=0.9, linestyle=(0, (1, 2))))
        words.append("end of the range")
    if lines:
        figure.legend(lines, words, loc="outside upper right", fontsize=8.5, ncols=len(words),
                      frameon=False, columnspacing=1.4, handlelength=1.6, borderpad=0)  # fmt: skip


def _unit(one: Felt) -> str:
    return {"-": "", "m/s2": "m/s²", "N m": "N·m"}.get(one.sensor.kind.unit, one.sensor.kind.unit)


def _errors(one: Felt) -> str:
    """By what a sensor errs, in words."""
    sensor, unit = one.sensor, _unit(one)
    words = [f"noise {sensor.noise:g} {unit}".strip()] if sensor.noise else []
    words += [f"{sensor.rate:g} Hz"] if sensor.rate is not None else []
    words += [f"{1000 * sensor.delay:g} ms late"] if sensor.delay else []
    return ", ".join(words) or "exact"


def _head(axes: Axes, one: Felt, name: str = "") -> None:
    axes.set_title(name or one.sensor.label, loc="left", fontsize=9, color=_INK, pad=4)
    axes.set_title(_errors(one), loc="right", fontsize=8, color=_GREY, pad=4)


def _is_dense(one: Felt) -> bool:
    """Whether its curves turn too often to be told apart."""
    if one.sensor.rate is not None:
        return False
    told = one.told[:, :, 0]
    change = np.diff(told, axis=0)
    # What is too small to be seen is no turn.
    change = np.where(np.abs(change) > 0.01 * np.ptp(told), np.sign(change), 0)
    return bool((change[1:] * change[:-1] < 0).sum(0).max() > _TURNS)


def _bins(told: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, least and greatest value over each share of the time."""
    edges = np.linspace(0, len(told), min(_BINS, len(told)) + 1).astype(int)[:-1]
    count = np.diff(np.append(edges, len(told)))
    mean = np.add.reduceat(told, edges) / count
    return mean, np.minimum.reduceat(told, edges), np.maximum.reduceat(told, edges)


def _thin(time: np.ndarray) -> slice:
    return slice(None, None, max(-(-len(time) // _POINTS), 1))


def _edges(one: Felt) -> tuple[float, ...]:
    """Ends of its range beyond which something was."""
    low, high = one.sensor.limits
    true = one.true[np.isfinite(one.true)]
    if not true.size:
        return ()
    return tuple(x for x, beyond in ((low, true.min() < low), (high, true.max() > high)) if beyond)


def _draw_curves(axes: Axes, time: np.ndarray, one: Felt) -> None:
    """A sensor that there is once."""
    dress(axes)
    rows, held = _thin(time), one.sensor.rate is not None
    for k in range(one.told.shape[1]):
        told, true, color = one.told[:, k, 0], one.true[:, k, 0], _AXES[k]
        if _is_dense(one):
            middle, low, high = _bins(told)
            at = time[0] + (time[-1] - time[0]) * (np.arange(len(middle)) + 0.5) / len(middle)
            axes.fill_between(at, low, high, color=color, alpha=0.22, linewidth=0)
            axes.plot(at, middle, color=color, linewidth=1.1)
            continue
        if not one.is_exact:
            shown = np.where(np.isfinite(true), true, np.nan)[rows]
            axes.plot(time[rows], shown, color=color, linewidth=3.0, alpha=0.28)
        style = "steps-post" if held else "default"
        axes.plot(time[rows], told[rows], color=color, linewidth=1.1, drawstyle=style)
    for edge in _edges(one):
        axes.axhline(edge, color=_GREY, linewidth=0.9, linestyle=(0, (1, 2)))
    bottom, top = float(one.told.min()), float(one.told.max())
    span = max(top - bottom, _LEAST * (one.sensor.limits[1] - one.sensor.limits[0]))
    axes.set_ylim((bottom + top) / 2 - 0.58 * span, (bottom + top) / 2 + 0.58 * span)
    axes.set_xlim(time[0], time[-1])
    axes.yaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 2.5, 5, 10]))
    axes.set_ylabel(_unit(one), fontsize=9)
    _head(axes, one)


def _draw_strips(figure: SubFigure, time: np.ndarray, one: Felt) -> None:
    """A sensor that there is at each hinge or rigid body: rows of colour over time."""
    count = one.told.shape[1]
    grid = figure.subplots(1, count, sharey=True, squeeze=False)[0]
    low, high = (float(x) for x in np.percentile(one.told, (_CUT, 100 - _CUT)))
    least = _LEAST * (one.sensor.limits[1] - one.sensor.limits[0])
    if low < 0 < high:  # both ways: no colour is nothing
        ends = max(-low, high, least / 2)
        colors, low, high = "RdBu_r", -ends, ends
    else:
        colors, high = "cividis", max(high, low + least)
    rows = _thin(time)
    image = None
    for k, axes in enumerate(grid):
        image = axes.imshow(
            one.told[rows, k].T, aspect="auto", cmap=colors, vmin=low, vmax=high,
            interpolation="nearest",
            extent=(time[0], time[-1], len(one.rows) - 0.5, -0.5),
        )  # fmt: skip
        axes.set_yticks(range(len(one.rows)), one.rows)
        axes.tick_params(colors="#333333", labelsize=8.5, length=2)
        axes.spines[:].set_visible(False)
        axes.set_xlabel("time (s)", fontsize=9)
        name = f"{one.sensor.label} {one.sensor.kind.parts[k]}".strip() if count > 1 else ""
        axes.set_title(name or one.sensor.label, loc="left", fontsize=9, color=_INK, pad=4)
        # White lines keep neighbours apart.
        for row in range(1, len(one.rows)):
            axes.axhline(row - 0.5, color="white", linewidth=0.8)
    grid[-1].set_title(_errors(one), loc="right", fontsize=8, color=_GREY, pad=4)
    assert image is not None
    bar = figure.colorbar(image, ax=grid, pad=0.012, aspect=14, extend="both")
    bar.set_label(_unit(one), fontsize=9)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8.5, colors="#333333")
