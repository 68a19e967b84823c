"""Pictures of an archive: the filled cells and their scores.

Two axes make a map. More are drawn in parallel coordinates: each individual is a line from axis to
axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.spatial import Voronoi

from mjx_revolve.evolution.archive import Archive, best, filled, scale_points
from mjx_revolve.view.plots import ORANGE, WIDE, color_bar, in_style, label_of, new_figure

_INK, _FRAME, _LINE = "#333333", "#9aa5ad", "#e3e8eb"
# More cells than this have no outlines, which would hide their colours.
_MOST_OUTLINES = 3000


@in_style
def plot_archive(
    archive: Archive,
    label: str = "score",
    title: str = "",
    champion: int | None = None,
    links: Mapping[int, str] | None = None,
) -> Figure:
    """Draws an archive.

    Args:
        archive: with two axes or more.
        label: what the score measures, with its unit.
        title: a line above the picture.
        champion: id of the individual that is marked, if it is there; None: the best.
        links: by id, where a click on an individual leads, in pictures that can have links (SVG).

    Returns:
        The figure. Empty cells are blank.
    """
    cells = filled(archive)
    marked = best(archive)
    if champion is not None:
        marked = next(iter(np.flatnonzero(archive.ids == champion).tolist()), -1)
    colors = ScalarMappable(cmap="viridis")
    if cells.size:
        colors.set_norm(Normalize(archive.scores[cells].min(), archive.scores[cells].max()))
    urls = [(links or {}).get(number) for number in archive.ids.tolist()]
    is_map = len(archive.names) == 2
    figure = new_figure(*((7.2, 5.4) if is_map else (WIDE, 4.6)), title)
    axes = figure.add_subplot()
    axes.grid(False)
    axes.tick_params(length=3)
    place = (_draw_map if is_map else _draw_parallel)(axes, archive, colors, marked, urls)
    count = f"{cells.size} of {len(archive.ids)} cells"
    if cells.size:
        color_bar(figure, colors, label, ax=figure.axes, aspect=30, pad=0.015, shrink=0.9)
    if marked >= 0:
        axes.plot(*place, "*", color=ORANGE, markeredgecolor="white", markersize=14,
                  markeredgewidth=1.0, zorder=5, clip_on=False, url=urls[marked])  # fmt: skip
        name = "best" if champion is None else "champion"
        count += f" · {name}: {archive.scores[marked]:.3g}"
    axes.set_title(count)
    return figure


# --- two axes -------------------------------------------------------------------------------------


def _draw_map(
    axes: Axes, archive: Archive, colors: ScalarMappable, marked: int, urls: Sequence[str | None]
) -> np.ndarray:
    """A polygon for each cell; returns the place `[2]` of the marked one."""
    span = archive.highs - archive.lows
    if archive.shape:
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        polygons = list(archive.centers[:, None] + span / archive.shape * corners)
    else:
        shares = voronoi_cells(scale_points(archive, archive.centers))
        polygons = [archive.lows + span * share for share in shares]
    faces = colors.to_rgba(np.ma.masked_invalid(archive.scores))
    few = len(polygons) < _MOST_OUTLINES
    axes.add_collection(
        PolyCollection(polygons, facecolors=faces, edgecolors=_LINE if few else "face",
                       linewidths=0.5 if few else 0.2, urls=urls)
    )  # fmt: skip
    axes.axis((archive.lows[0], archive.highs[0], archive.lows[1], archive.highs[1]))
    axes.set(xlabel=label_of(archive.names[0]), ylabel=label_of(archive.names[1]))
    axes.spines[:].set(color=_FRAME, visible=True)
    return archive.centers[marked]


def voronoi_cells(centers: np.ndarray) -> list[np.ndarray]:
    """The Voronoi cells of points `[cells, 2]` of the unit square, cut at its border.

    With the points' images in the four sides as neighbours, the sides are borders of cells.
    """
    images = [centers]
    for axis in range(2):
        for side in (0.0, 1.0):
            image = centers.copy()
            image[:, axis] = 2.0 * side - image[:, axis]
            images.append(image)
    diagram = Voronoi(np.concatenate(images))
    regions = [diagram.regions[region] for region in diagram.point_region[: len(centers)]]
    return [diagram.vertices[region] for region in regions]


# --- more axes -----------------------------------------------------------------------------------


def _draw_parallel(
    axes: Axes, archive: Archive, colors: ScalarMappable, marked: int, urls: Sequence[str | None]
) -> np.ndarray:
    """A line for each individual, the best ones on top; returns the end `[2]` of the marked one."""
    cells = filled(archive)
    cells = cells[np.argsort(archive.scores[cells])]
    heights = scale_points(archive, archive.points)
    places = np.arange(len(archive.names))
    axes.add_collection(LineCollection(
        [np.stack([places, row], axis=1) for row in heights[cells]], linewidths=1.0, alpha=0.6,
        colors=colors.to_rgba(archive.scores[cells]), urls=[urls[cell] for cell in cells],
    ))  # fmt: skip
    for place, low, high in zip(places.tolist(), archive.lows, archive.highs, strict=True):
        axes.plot([place, place], [0.0, 1.0], color=_FRAME, linewidth=1.0, zorder=3)
        for height, value, side in ((-0.02, low, "top"), (1.02, high, "bottom")):
            axes.text(place, height, f"{value:g}", ha="center", va=side, fontsize=8.5, color=_INK)
    axes.axis((-0.1, places[-1] + 0.1, -0.08, 1.08))
    axes.set_yticks([])
    axes.set_xticks(places, [label_of(name).replace(" (", "\n(") for name in archive.names])
    axes.tick_params(axis="x", length=0)
    axes.spines[:].set_visible(False)
    if marked >= 0:
        axes.plot(places, heights[marked], color=ORANGE, linewidth=2.2, zorder=4)
    return np.array([places[-1], heights[marked, -1]])
