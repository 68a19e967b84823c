"""Pictures of an archive: which cells somebody is in, and how good they are.

Two axes make a map. Three or four axes of a grid make maps within a map: one of the first two axes
for each cell of the others. All others are drawn in parallel coordinates: each individual is a line
from axis to axis.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PatchCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.spatial import Voronoi

from mjx_revolve.evolution.archive import Archive, best, filled, scale_points
from mjx_revolve.view.plots import COLORS, LABELS, WIDE, head, new_figure

_Addresses = Sequence[str | None]  # of each cell
_COLOURS = "viridis"
_ORANGE, _INK, _FRAME, _LINE = COLORS[1], "#333333", "#9aa5ad", "#e3e8eb"
# Between the maps within a map, in cells of theirs.
_GAP = 0.7
# Most numbers along an edge of a map of maps.
_MOST_NUMBERS = 8
# More cells than this have no outlines, which would hide their colours.
_MOST_OUTLINES = 3000


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
        The figure. Cells in which nobody is are blank.
    """
    cells = filled(archive)
    marked = best(archive) if champion is None else _find(archive, champion)
    dimensions = len(archive.names)
    colours = ScalarMappable(cmap=_COLOURS)
    if cells.size:
        scores = archive.scores[cells]
        colours.set_norm(Normalize(scores.min(), scores.max()))
    if dimensions == 2:
        figure = new_figure(7.2, 5.4)
        draw = _draw_map
    elif dimensions <= 4 and archive.shape:
        figure = new_figure(WIDE, 4.0 if dimensions == 3 else 6.6)
        draw = _draw_nested
    else:
        figure = new_figure(WIDE, 4.6)
        draw = _draw_parallel
    axes = figure.add_subplot()
    axes.tick_params(colors=_INK, labelsize=9, length=3)
    links = links or {}
    addresses = [links.get(number) for number in archive.ids.tolist()]
    draw(axes, archive, colours, marked, addresses)
    if cells.size:
        bar = figure.colorbar(colours, ax=figure.axes, aspect=30, pad=0.015, shrink=0.9)
        bar.set_label(label, fontsize=9)
        bar.outline.set_visible(False)
        bar.ax.tick_params(labelsize=9, colors=_INK)
    count = f"{cells.size} of {len(archive.ids)} cells"
    if marked >= 0:
        who = "best" if champion is None else "champion"
        count += f" · {who}: {archive.scores[marked]:.3g}"
    if title:
        figure.suptitle(title, x=0.012, ha="left", fontsize=11, color="#222222")
    head(axes, count)
    return figure


def _find(archive: Archive, individual: int) -> int:
    """The cell of an individual; -1: it is not there."""
    found = np.flatnonzero(archive.ids == individual)
    return int(found[0]) if found.size else -1


def _words(archive: Archive, axis: int) -> str:
    """An axis' name and unit."""
    name = archive.names[axis]
    return LABELS.get(name, name.replace("_", " "))


def _mark(axes: Axes, place: Sequence[float] | np.ndarray, address: str | None) -> None:
    axes.plot(*place, "*", color=_ORANGE, markeredgecolor="white", markersize=14,
              markeredgewidth=1.0, zorder=5, clip_on=False, url=address)  # fmt: skip


# --- two axes -------------------------------------------------------------------------------------


def _draw_map(
    axes: Axes, archive: Archive, colours: ScalarMappable, marked: int, addresses: _Addresses
) -> None:
    """A polygon for each cell."""
    span = archive.highs - archive.lows
    if archive.shape:
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        polygons = list(archive.centers[:, None] + span / archive.shape * corners)
    else:
        shares = _polygons(scale_points(archive, archive.centers))
        polygons = [archive.lows + span * share for share in shares]
    faces = colours.to_rgba(np.ma.masked_invalid(archive.scores))
    few = len(polygons) < _MOST_OUTLINES
    axes.add_collection(
        PolyCollection(polygons, facecolors=faces, edgecolors=_LINE if few else "face",
                       linewidths=0.5 if few else 0.2, urls=addresses)
    )  # fmt: skip
    axes.set_xlim(archive.lows[0], archive.highs[0])
    axes.set_ylim(archive.lows[1], archive.highs[1])
    axes.set(xlabel=_words(archive, 0), ylabel=_words(archive, 1))
    axes.spines[:].set_color(_FRAME)
    if marked >= 0:
        _mark(axes, archive.centers[marked], addresses[marked])


def _polygons(centers: np.ndarray) -> list[np.ndarray]:
    """The Voronoi cells of points `[cells, 2]` of the unit square, cut at its border.

    With the points' images in the four sides as neighbours, the sides are borders of cells.
    """
    images = [centers]
    for axis in range(2):
        for side in (0.0, 1.0):
            image = centers.copy()
            image[:, axis] = 2.0 * side - image[:, axis]
            images.append(image)
    found = Voronoi(np.concatenate(images))
    regions = [found.regions[region] for region in found.point_region[: len(centers)]]
    return [found.vertices[region] for region in regions]


# --- three or four --------------------------------------------------------------------------------


def _draw_nested(
    axes: Axes, archive: Archive, colours: ScalarMappable, marked: int, addresses: _Addresses
) -> None:
    """A map of the first two axes for each cell of the third, and of the fourth if there is one."""
    shape = (*archive.shape, 1)[:4]
    inner, outer = np.array(shape[:2]), np.array(shape[2:])
    step = inner + _GAP
    where = np.stack(np.unravel_index(np.arange(len(archive.ids)), shape), axis=1)
    corners = where[:, :2] + where[:, 2:] * step
    cells = filled(archive)
    squares = [Rectangle(corner, 1.0, 1.0) for corner in corners[cells].tolist()]
    faces = colours.to_rgba(archive.scores[cells])
    urls = [addresses[cell] for cell in cells]
    axes.add_collection(PatchCollection(squares, facecolors=faces, edgecolors="none", urls=urls))
    maps = (np.indices(shape[2:]).reshape(2, -1).T * step).tolist()
    frames = [Rectangle(corner, *inner.tolist()) for corner in maps]
    axes.add_collection(
        PatchCollection(frames, facecolors="none", edgecolors=_FRAME, linewidths=0.6)
    )
    right, top = outer * step - _GAP / 2
    axes.set_xlim(-_GAP / 2, right)
    axes.set_ylim(-_GAP / 2, top)
    axes.spines[:].set_visible(False)
    # Below and at the left the axes of each map; above and at the right those of the maps.
    ends = [
        [f"{low:g}", f"{high:g}"] for low, high in zip(archive.lows, archive.highs, strict=True)
    ]
    axes.set_xticks([0, shape[0]], ends[0])
    axes.set_yticks([0, shape[1]], ends[1])
    axes.set_xlabel(f"in each map: {_words(archive, 0)}")
    axes.set_ylabel(f"in each map: {_words(archive, 1)}")
    for k in range(len(archive.names) - 2):
        edges = np.linspace(archive.lows[2 + k], archive.highs[2 + k], shape[2 + k] + 1)
        texts = [f"{low:.3g} … {high:.3g}" for low, high in itertools.pairwise(edges)]
        middles = np.arange(shape[2 + k]) * step[k] + inner[k] / 2
        every = -(-len(texts) // _MOST_NUMBERS)
        far = axes.secondary_yaxis("right") if k else axes.secondary_xaxis("top")
        (far.set_yticks if k else far.set_xticks)(middles[::every], texts[::every])
        (far.set_ylabel if k else far.set_xlabel)(_words(archive, 2 + k))
        far.tick_params(colors=_INK, labelsize=8, length=0)
        far.spines[:].set_visible(False)
    if marked >= 0:
        _mark(axes, corners[marked] + 0.5, addresses[marked])


# --- any number -----------------------------------------------------------------------------------


def _draw_parallel(
    axes: Axes, archive: Archive, colours: ScalarMappable, marked: int, addresses: _Addresses
) -> None:
    """A line for each individual, the best ones on top."""
    cells = filled(archive)
    cells = cells[np.argsort(archive.scores[cells])]
    heights = scale_points(archive, archive.points)
    places = np.arange(len(archive.names))
    lines = [np.stack([places, row], axis=1) for row in heights[cells]]
    shades = colours.to_rgba(archive.scores[cells])
    urls = [addresses[cell] for cell in cells]
    axes.add_collection(LineCollection(lines, colors=shades, linewidths=1.0, alpha=0.6, urls=urls))
    for place, (low, high) in enumerate(zip(archive.lows, archive.highs, strict=True)):
        axes.plot([place, place], [0.0, 1.0], color=_FRAME, linewidth=1.0, zorder=3)
        for height, value, side in ((0.0, low, "top"), (1.0, high, "bottom")):
            axes.text(place, height + (0.02 if height else -0.02), f"{value:g}", ha="center",
                      va=side, fontsize=8.5, color=_INK)  # fmt: skip
    axes.set_xlim(-0.1, places[-1] + 0.1)
    axes.set_ylim(-0.08, 1.08)
    axes.set_yticks([])
    words = [_words(archive, k).replace(" (", "\n(") for k in range(len(places))]
    axes.set_xticks(places, words)
    axes.tick_params(axis="x", length=0)
    axes.spines[:].set_visible(False)
    if marked >= 0:
        axes.plot(places, heights[marked], color=_ORANGE, linewidth=2.2, zorder=4)
        _mark(axes, (places[-1], heights[marked, -1]), addresses[marked])
