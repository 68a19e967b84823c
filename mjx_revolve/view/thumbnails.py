"""Small pictures of bodies at rest, all to one scale, and a sheet of the best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.episodes.lives import Life
from mjx_revolve.view.pieces import rest_scene
from mjx_revolve.view.plots import new_figure
from mjx_revolve.view.population import read_population
from mjx_revolve.view.raster import draw_scene, make_view

SIZE = (240, 180)
"""Width and height of a picture [pixels]."""
# The three-quarter view of `pictures`.
_VIEW = make_view(-58.0, 30.0)
_MARGIN = 6  # [pixels]
# A sheet of at most so many, and what they take [inches].
_MOST, _COLUMNS, _WIDTH, _HEIGHT, _TOP = 12, 4, 2.2, 2.0, 0.5


def draw_bodies(bodies: Sequence[Morphology]) -> list[np.ndarray]:
    """Draws bodies, each in the middle of a picture, the largest one filling it.

    Args:
        bodies: what to draw.

    Returns:
        `[height, width, 3]` uint8 each, on white, row 0 the highest.
    """
    scenes = [rest_scene(body) for body in bodies]
    bounds = []
    for scene in scenes:
        points = scene.corners.reshape(-1, 3) @ _VIEW[:2].T
        bounds.append((points.min(axis=0), points.max(axis=0)))
    room = np.array(SIZE) - 2 * _MARGIN
    pixel = max((float(((high - low) / room).max()) for low, high in bounds), default=1.0)
    pictures = []
    for scene, (low, high) in zip(scenes, bounds, strict=True):
        image, _ = draw_scene(scene, _VIEW, low - pixel, high + pixel, pixel)
        flat = image[::-1, :, :3] * image[::-1, :, 3:] + 1.0 - image[::-1, :, 3:]
        page = np.ones((SIZE[1], SIZE[0], 3))
        top, left = (np.array(page.shape[:2]) - flat.shape[:2]) // 2
        page[top : top + flat.shape[0], left : left + flat.shape[1]] = flat
        pictures.append(np.round(255 * page).astype(np.uint8))
    return pictures


def plot_best(folder: Path, modules: Mapping[str, ModuleType], title: str = "") -> Figure:
    """Draws the best of those who are alive in the end of a run in which bodies evolve.

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
    best = population.alive(population.last)[:_MOST]
    pictures = draw_bodies([life.grow(modules) for life in best])
    rows = max(1, -(-len(best) // _COLUMNS))
    figure = new_figure(_WIDTH * _COLUMNS, _HEIGHT * rows + _TOP)
    grid = figure.subplots(rows, _COLUMNS, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, picture, life in zip(grid.flat, pictures, best, strict=False):
        axes.imshow(picture, interpolation="lanczos")
        look: dict[str, Any] = {"ha": "center", "va": "top", "transform": axes.transAxes}
        score = f"{life.score:.3g}".replace("-", "\u2212")
        axes.text(0.5, -0.01, f"{life.number}: {score}", fontsize=9.5, color="#222222", **look)
        axes.text(0.5, -0.12, count_modules(life), fontsize=8.5, color="#5b6a75", **look)
    if title:
        figure.suptitle(title, x=0.012, ha="left", fontsize=11, color="#222222", parse_math=False)
    return figure


def count_modules(life: Life) -> str:
    """How many modules and hinges somebody has, in words."""
    words = []
    for name in ("module", "hinge"):
        count = life.figures.get(f"num_{name}s")
        if count is not None:
            words.append(f"{count:.0f} {name}{'s' if count != 1 else ''}")
    return ", ".join(words)
