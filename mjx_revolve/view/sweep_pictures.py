"""Plots of studies and sweeps: curves over trials, a dot for each seed, champions' bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_revolve.body.tree import Morphology
from mjx_revolve.view.outcomes import Outcome
from mjx_revolve.view.plots import COLORS, WIDE, dress, head, new_figure
from mjx_revolve.view.statistics import interval
from mjx_revolve.view.thumbnails import SIZE, draw_bodies

Cases = Mapping[str, Sequence[Outcome]]


def color_of(k: int) -> str:
    """Of the k-th case, in all plots."""
    return COLORS[k % len(COLORS)]


def draw_curves(axes: Axes, cases: Cases, label: str, numbers: Sequence[int] | None = None) -> None:
    """The best so far over trials: a thin line for each seed, a thick one for their mean.

    Args:
        axes: where.
        cases: outcomes by case.
        label: of the scores.
        numbers: of the cases, for their colours; None: as they come.
    """
    for k, (name, outcomes) in zip(numbers or range(len(cases)), cases.items(), strict=True):
        curves = [(o.metrics["evaluations"], o.metrics["champion"]) for o in outcomes]
        for x, y in curves:
            axes.plot(x, y, color=color_of(k), lw=0.7, alpha=0.35)
        end = min(x[-1] for x, _ in curves)
        grid = np.unique(np.concatenate([x for x, _ in curves]))
        grid = grid[(grid <= end) & (grid >= max(x[0] for x, _ in curves))]
        mean = np.mean([np.interp(grid, x, y) for x, y in curves], 0)
        axes.plot(grid, mean, color=color_of(k), lw=2.2, label=f"{name} (n = {len(curves)})")
    dress(axes)
    axes.set(xlabel="trials", ylabel=label)
    axes.legend(loc="best", fontsize="small", frameon=False)


def draw_dots(
    axes: Axes,
    groups: Mapping[str, Sequence[float]],
    title: str,
    numbers: Sequence[int] | None = None,
) -> None:
    """A dot for each seed, and beside it mean and interval.

    Args:
        axes: where.
        groups: values by case.
        title: of the axes.
        numbers: of the cases, for their colours; None: as they come.
    """
    colors = [color_of(k) for k in numbers or range(len(groups))]
    for k, values in enumerate(groups.values()):
        spread = np.linspace(-0.16, 0.16, len(values)) if len(values) > 1 else [0.0]
        axes.plot(k - 0.1 + np.array(spread), values, ".", color=colors[k], ms=6, alpha=0.7)
        found = interval(values)
        place = k + 0.25
        axes.plot([place], [found.mean], "_", color=colors[k], ms=9, mew=2)
        if np.isfinite(found.low):
            axes.plot([place, place], [found.low, found.high], color=colors[k], lw=1.6)
    dress(axes)
    head(axes, title)
    axes.set_xticks(range(len(groups)), [name.replace("_", "\n") for name in groups], fontsize=8)
    axes.set_xlim(-0.5, len(groups) - 0.5)


def plot_dots(panels: Mapping[str, Mapping[str, Sequence[float]]], columns: int = 3) -> Figure:
    """Panels of `draw_dots`.

    Args:
        panels: groups by title.
        columns: beside each other.

    Returns:
        The figure.
    """
    lines = -(-len(panels) // columns)
    figure = new_figure(WIDE, 2.1 * lines)
    grid = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, (title, groups) in zip(grid, panels.items(), strict=False):
        draw_dots(axes, groups, title)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    return figure


def plot_bodies(cases: Cases, numbers: Sequence[int] | None = None) -> Figure:
    """The champions at rest, with scores and lengths, in one scale: a line for each case.

    Args:
        cases: outcomes by case.
        numbers: of the cases, for their colours; None: as they come.

    Returns:
        The figure.
    """
    colors = [color_of(k) for k in numbers or range(len(cases))]
    pictures = iter(draw_bodies([_body(o) for found in cases.values() for o in found]))
    columns = max(map(len, cases.values()))
    figure = new_figure(WIDE, (WIDE / columns * SIZE[1] / SIZE[0] + 0.25) * len(cases))
    grid = figure.subplots(len(cases), columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for k, (line, (name, found)) in enumerate(zip(grid, cases.items(), strict=True)):
        for axes, outcome in zip(line, found, strict=False):
            axes.imshow(next(pictures), interpolation="lanczos")
            length = 100 * _body(outcome).descriptors["length"]
            words = f"seed {outcome.plan.seed}: {outcome.champion['score']:.3g}, {length:.0f} cm"
            axes.set_title(words.replace("-", "−"), fontsize=7, color="#333333", pad=2)
        # Left of the line's first body.
        line[0].text(
            -0.02, 0.5, name.replace("_", " "), transform=line[0].transAxes, rotation=90,
            ha="right", va="center", fontsize=10, color=colors[k], fontweight="bold",
        )  # fmt: skip
    return figure


def _body(outcome: Outcome) -> Morphology:
    assert outcome.body is not None  # bodies have evolved
    return outcome.body
