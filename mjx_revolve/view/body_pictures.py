"""Pictures of evolved bodies: small ones to one scale, sheets of them, and how they changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.episodes.individual_log import LoggedIndividual
from mjx_revolve.view.outcomes import Outcome
from mjx_revolve.view.pieces import rest_scene
from mjx_revolve.view.plots import (
    BLUE,
    COLORS,
    INK,
    ORANGE,
    WIDE,
    curve_with_band,
    format_number,
    in_style,
    label_of,
    legend_outside,
    new_figure,
    panels,
    whole_numbers,
)
from mjx_revolve.view.population import Population, read_population
from mjx_revolve.view.raster import REST_VIEW, draw_scene, on_white
from mjx_revolve.view.statistics import quantiles

SIZE = (240, 180)
"""Width and height of a small picture [pixels]."""
_MARGIN = 6  # [pixels]
# A sheet: most bodies, columns, and sizes [inches].
_MAX_SHOWN, _COLUMNS, _WIDTH, _HEIGHT, _TOP = 12, 4, 2.2, 2.0, 0.5
_PANELS = 8  # most descriptors that are drawn over the generations
_IN_LINE = 5  # most champions beside each other: as many as a study has seeds by default
# These first, where they differ; counts of modules of a kind that no body has are left out.
_FIRST = (
    "num_modules", "num_hinges", "length", "mass", "symmetry", "proportion", "limbs", "branching",
    "num_fins", "num_thrusters", "num_sensors", "length_of_limbs", "coverage",
)  # fmt: skip


def draw_bodies(bodies: Sequence[Morphology]) -> list[np.ndarray]:
    """Draws bodies, each in the middle of a picture, the largest one filling it.

    Args:
        bodies: what to draw.

    Returns:
        `[height, width, 3]` uint8 each, on white, row 0 the highest.
    """
    scenes = [rest_scene(body) for body in bodies]
    bounds = [scene.bounds(REST_VIEW) for scene in scenes]
    room = np.array(SIZE) - 2 * _MARGIN
    pixel = max((float(((high - low) / room).max()) for low, high in bounds), default=1.0)
    pictures = []
    for scene, (low, high) in zip(scenes, bounds, strict=True):
        image = draw_scene(scene, REST_VIEW, low - pixel, high + pixel, pixel)[0][::-1]
        page = np.ones((SIZE[1], SIZE[0], 3))
        top, left = (np.array(page.shape[:2]) - image.shape[:2]) // 2
        page[top : top + image.shape[0], left : left + image.shape[1]] = on_white(image)
        pictures.append(np.round(255 * page).astype(np.uint8))
    return pictures


@in_style
def plot_best(folder: Path, modules: Mapping[str, ModuleType], title: str = "") -> Figure:
    """Draws the best bodies that are alive at the end of a run in which bodies evolve.

    Args:
        folder: the run folder.
        modules: the types of modules by name.
        title: a line above the picture.

    Returns:
        The figure.

    Raises:
        InputError: a body cannot be read.
    """
    population, _ = read_population(folder)
    best = population.alive(population.last)[:_MAX_SHOWN]
    pictures = draw_bodies([life.grow(modules) for life in best])
    rows = max(1, -(-len(best) // _COLUMNS))
    figure = new_figure(_WIDTH * _COLUMNS, _HEIGHT * rows + _TOP, title)
    grid = figure.subplots(rows, _COLUMNS, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, picture, life in zip(grid.flat, pictures, best, strict=False):
        axes.imshow(picture, interpolation="lanczos")
        look: dict[str, Any] = {"ha": "center", "va": "top", "transform": axes.transAxes}
        words = f"{life.number}: {format_number(life.score)}"
        axes.text(0.5, -0.01, words, fontsize=9.5, color=INK, **look)
        axes.text(0.5, -0.12, count_modules(life), fontsize=8.5, color="#5b6a75", **look)
    return figure


def count_modules(life: LoggedIndividual) -> str:
    """Numbers of modules and hinges of an individual, in words."""
    words = []
    for name in ("module", "hinge"):
        count = life.features.get(f"num_{name}s")
        if count is not None:
            words.append(f"{count:.0f} {name}{'s' if count != 1 else ''}")
    return ", ".join(words)


@in_style
def plot_bodies(
    cases: Mapping[str, Sequence[Outcome]], numbers: Sequence[int] | None = None
) -> Figure:
    """Draws the champions at rest, with scores and lengths, in one scale: lines for each case.

    Args:
        cases: outcomes by case, all with bodies.
        numbers: of the cases, for their colours; None: as they come.

    Returns:
        The figure.
    """
    bodies = {name: [(o, o.body) for o in case if o.body is not None]
              for name, case in cases.items()}  # fmt: skip
    pictures = iter(draw_bodies([body for case in bodies.values() for _, body in case]))
    columns = min(_IN_LINE, max(map(len, bodies.values())))
    lines = [
        (k, name, case[first : first + columns])
        for k, (name, case) in zip(numbers or range(len(bodies)), bodies.items(), strict=True)
        for first in range(0, len(case), columns)
    ]
    figure = new_figure(WIDE, (WIDE / columns * SIZE[1] / SIZE[0] + 0.25) * len(lines))
    grid = figure.subplots(len(lines), columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for line, (k, name, some) in zip(grid, lines, strict=True):
        for axes, (outcome, body) in zip(line, some, strict=False):
            axes.imshow(next(pictures), interpolation="lanczos")
            length = 100 * body.descriptors["length"]
            words = f"seed {outcome.plan.seed}: {outcome.champion['score']:.3g}, {length:.0f} cm"
            axes.set_title(words.replace("-", "−"), loc="center", fontsize=7, pad=2)
        # Left of the line's first body.
        line[0].text(
            -0.02, 0.5, name.replace("_", " "), transform=line[0].transAxes, rotation=90,
            ha="right", va="center", color=COLORS[k % len(COLORS)], fontweight="bold",
        )  # fmt: skip
    return figure


@in_style
def plot_descriptors(
    population: Population, named: Sequence[str] = (), over: str = "generation"
) -> Figure | None:
    """Draws how bodies changed over the generations.

    Args:
        population: of a run.
        named: figures that are shown in any case.
        over: name of a generation.

    Returns:
        The figure, None where there is nothing to draw: of the living after each generation the
        mean, the quartiles and the value of the best, for some descriptors (and measures, where
        named).
    """
    generations = [g for g in population.living if population.alive(g)]
    shown: dict[str, np.ndarray] = {}  # [individuals, generations]
    for name in dict.fromkeys((*named, *_FIRST)):
        columns = [population.figures(generation, name) for generation in generations]
        table = np.array([*zip_longest(*columns, fillvalue=np.nan)])
        known = table[np.isfinite(table)]
        if known.size and (name in named or np.ptp(known) > 0) and len(shown) < _PANELS:
            shown[name] = table
    if not shown:
        return None
    wide = min(4, len(shown))
    figure = new_figure(WIDE, 0.5 + 1.95 * -(-len(shown) // wide))
    dot = "o" if len(generations) < 3 else None
    grid = panels(figure, len(shown), wide, over, sharex=True)
    for axes, (name, table) in zip(grid, shown.items(), strict=True):
        low, high = quantiles(table, (0.25, 0.75))
        some = np.isfinite(low)
        x = np.array(generations)[some]
        mean = np.nanmean(table[:, some], axis=0)
        curve_with_band(axes, x, mean, low[some], high[some], BLUE, label="mean of the living",
                        band="quartiles", marker=dot, markersize=4)  # fmt: skip
        axes.plot(x, table[0, some], color=ORANGE, linewidth=1.1, marker=dot, markersize=4,
                  label="the best of them")  # fmt: skip
        axes.set_title(label_of(name), fontsize=9.5)
        axes.tick_params(labelsize=8.5)
        whole_numbers(axes, 5)
        axes.yaxis.set_major_locator(MaxNLocator(nbins=5))
    legend_outside(figure, grid[0], 3, "upper left")
    return figure
