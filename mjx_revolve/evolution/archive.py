"""An archive of the best of each kind, in cells of a grid or of a Voronoi tessellation.

MAP-Elites after Mouret and Clune, "Illuminating search spaces by mapping elites", arXiv:1504.04909,
2015; centroidal Voronoi cells (CVT) after Vassiliades, Chatzilygeroudis and Mouret, "Using
centroidal Voronoi tessellations to scale up the multidimensional archive of phenotypic elites
algorithm", IEEE Trans. Evolutionary Computation 22(4), 2018.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from mjx_revolve.episodes.bodies_config import ArchiveConfig
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.packages import check_package

# Samples per cell, and rounds, with which a tessellation is found: from evenly spread points, more
# rounds no longer make the cells' volumes more equal (12 to 14 % standard deviation).
_SAMPLES, _ROUNDS = 50, 10


@dataclass(frozen=True)
class Archive:
    """Cells, and the individual in each.

    Attributes:
        names: `[D]` of the axes: descriptors and measures.
        lows: `[D]` lower end of each axis, in its own unit.
        highs: `[D]` upper end.
        shape: `[D]` cells along each axis of a grid, the last axis running fastest; empty where
            cells are those of a tessellation.
        centers: `[cells, D]` middles of the cells, in the axes' units.
        ids: `[cells]` numbers of the individuals; -1: the cell is empty.
        scores: `[cells]` their scores; NaN: empty.
        points: `[cells, D]` their descriptors, which may lie outside the axes; NaN: empty.
    """

    names: tuple[str, ...]
    lows: np.ndarray
    highs: np.ndarray
    shape: tuple[int, ...]
    centers: np.ndarray
    ids: np.ndarray
    scores: np.ndarray
    points: np.ndarray


def make_archive(settings: ArchiveConfig, seed: int) -> Archive:
    """An empty archive; a tessellation's cells follow from the seed."""
    axes = settings.axes.values()
    lows, highs = (np.array([getattr(axis, end) for axis in axes]) for end in ("low", "high"))
    if settings.type == "grid":
        shape = tuple(axis.cells for axis in axes)
        indices = np.indices(shape).reshape(len(shape), -1).T
        centers = (indices + 0.5) / shape
    else:
        shape = ()
        centers = _tessellate(settings.cells, len(lows), np.random.default_rng(seed))
    count = len(centers)
    return Archive(
        names=tuple(settings.axes),
        lows=lows,
        highs=highs,
        shape=shape,
        centers=lows + (highs - lows) * centers,
        ids=np.full(count, -1),
        scores=np.full(count, np.nan),
        points=np.full((count, len(lows)), np.nan),
    )


def _tessellate(cells: int, axes: int, rng: np.random.Generator) -> np.ndarray:
    """Centroids `[cells, axes]` of Voronoi cells of the unit cube, by Lloyd's algorithm.

    It begins with points that are spread evenly: those of Roberts, "The unreasonable effectiveness
    of quasirandom sequences", 2018, shifted by chance.
    """
    from scipy.spatial import KDTree

    samples = rng.random((_SAMPLES * cells, axes))
    ratio = 1.0
    for _ in range(64):  # the root of x^(axes + 1) = x + 1, to the last bit
        ratio = (1.0 + ratio) ** (1.0 / (axes + 1))
    steps = ratio ** -np.arange(1.0, axes + 1)
    centers = (rng.random(axes) + np.arange(cells)[:, None] * steps) % 1.0
    for _ in range(_ROUNDS):
        nearest = KDTree(centers).query(samples)[1]
        count = np.bincount(nearest, minlength=cells)[:, None]
        sums = np.stack([np.bincount(nearest, x, cells) for x in samples.T], axis=1)
        centers = np.where(count > 0, sums / np.maximum(count, 1), centers)
    return centers


def scale_points(archive: Archive, points: np.ndarray) -> np.ndarray:
    """Points `[N, D]` in units of the axes: 0 at their lower, 1 at their upper end.

    Points outside the axes are moved to the border; values that are not finite become NaN.
    """
    points = np.where(np.isfinite(points), points, np.nan)
    inside = np.clip(points, archive.lows, archive.highs)
    return (inside - archive.lows) / (archive.highs - archive.lows)


def cell_of(archive: Archive, points: np.ndarray) -> np.ndarray:
    """The cells to which points belong.

    Args:
        archive: the archive.
        points: `[N, D]` descriptors. Those outside the axes belong to the cells at the border.

    Returns:
        `[N]` cells; -1 where a value is not finite. A point on a border of a grid belongs to the
        cell above it, up to rounding. In a tessellation it is the nearest centre, each axis having
        length 1.
    """
    points = np.asarray(points, float)
    found = np.full(len(points), -1)
    known = np.isfinite(points).all(1)
    if archive.shape:
        inside = np.clip(points[known], archive.lows, archive.highs)
        # In the order of `ribs`, so that both round alike.
        steps = archive.shape * (inside - archive.lows) / (archive.highs - archive.lows)
        indices = np.minimum(steps.astype(int), np.array(archive.shape) - 1)
        found[known] = np.ravel_multi_index(tuple(indices.T), archive.shape)
    elif known.any():
        from scipy.spatial.distance import cdist

        centers = scale_points(archive, archive.centers)
        found[known] = cdist(scale_points(archive, points[known]), centers).argmin(1)
    return found


def insert(archive: Archive, ids: np.ndarray, scores: np.ndarray, points: np.ndarray) -> Archive:
    """The archive with further individuals, inserted one after the other, the oldest first.

    Args:
        archive: before the insertion; not changed.
        ids: `[N]` from 0 on, unique; lower ones are older.
        scores: `[N]` higher is better. One that is not finite, or not better than that in its cell,
            is not inserted.
        points: `[N, D]` descriptors, see `cell_of`.

    Returns:
        The archive.
    """
    cells = np.where(np.isfinite(scores), cell_of(archive, points), -1)
    new = copy.deepcopy(archive)
    for row in np.argsort(ids):
        cell = cells[row]
        if cell >= 0 and not new.scores[cell] >= scores[row]:
            new.ids[cell], new.scores[cell], new.points[cell] = ids[row], scores[row], points[row]
    return new


# --- contents


def filled(archive: Archive) -> np.ndarray:
    """The cells that are not empty."""
    return np.flatnonzero(archive.ids >= 0)


def coverage(archive: Archive) -> float:
    """Share of the cells that are not empty."""
    return len(filled(archive)) / len(archive.ids)


def qd_score(archive: Archive, offset: float = 0.0) -> float:
    """Sum of the scores above `offset`, which should be the lowest that is possible.

    Pugh, Soros and Stanley, "Quality diversity", Frontiers in Robotics and AI 3, 2016.
    """
    return float((archive.scores[filled(archive)] - offset).sum())


def best(archive: Archive) -> int:
    """The cell with the highest score, of equal ones that of the oldest; -1: all are empty."""
    cells = filled(archive)
    if not cells.size:
        return -1
    return int(cells[np.lexsort((archive.ids[cells], -archive.scores[cells]))[0]])


# --- conversion


def to_arrays(archive: Archive) -> dict[str, np.ndarray]:
    """An archive as named arrays, for a checkpoint, without rounding."""
    arrays = {field.name: np.asarray(getattr(archive, field.name)) for field in fields(archive)}
    return arrays | {"shape": np.array(archive.shape, int)}


def from_arrays(arrays: Mapping[str, np.ndarray]) -> Archive:
    """The inverse of `to_arrays`.

    Raises:
        InputError: the arrays are no archive's.
    """
    known = [field.name for field in fields(Archive)]
    found: dict[str, Any] = {name: np.asarray(arrays.get(name)) for name in known}
    count, axes = len(np.atleast_1d(found["ids"])), np.size(found["names"])
    both = {"centers": (count, axes), "points": (count, axes)}
    ends = dict.fromkeys(("names", "lows", "highs"), (axes,))
    shapes = both | ends | {"ids": (count,), "scores": (count,)}
    shapes["shape"] = (axes,) if found["shape"].size else (0,)
    kinds = dict.fromkeys(shapes, "f") | {"names": "U", "ids": "i", "shape": "i"}
    for name, array in found.items():
        if array.shape != shapes[name] or array.dtype.kind != kinds[name]:
            what = f"{array.dtype} {list(array.shape)}" if name in arrays else "nothing"
            raise InputError(f"archive.{name}", "that of an archive", what)
    names, shape = (tuple(found[name].tolist()) for name in ("names", "shape"))
    if shape and (min(shape) < 1 or math.prod(shape) != count):
        raise InputError("archive.shape", f"one of {count} cells", list(shape))
    return Archive(**found | {"names": names, "shape": shape})


def rows(archive: Archive) -> list[dict[str, float]]:
    """The archive as lines of a table, one for each cell that is not empty.

    Each has cell, id, score, and for each axis its value by its name, NAME_center and, in a grid,
    NAME_cell.
    """
    found = []
    for cell in filled(archive).tolist():
        row = {"cell": cell, "id": int(archive.ids[cell]), "score": float(archive.scores[cell])}
        where = np.unravel_index(cell, archive.shape) if archive.shape else ()
        for k, name in enumerate(archive.names):
            row[name] = float(archive.points[cell, k])
            row[f"{name}_center"] = float(archive.centers[cell, k])
            if archive.shape:
                row[f"{name}_cell"] = int(where[k])
        found.append(row)
    return found


def to_ribs(archive: Archive, solutions: Sequence[object]) -> Any:
    """The archive as one of `ribs` (pyribs), with the same cells.

    Args:
        archive: the archive.
        solutions: any object for each individual, in the order of `rows`.

    Returns:
        A `ribs.archives.GridArchive`, or a `CVTArchive`. `ribs` measures distances in the axes' own
        units, which may differ (metres, modules), so in it each axis runs from 0 to 1. The fields
        `id` and `descriptors` hold numbers and descriptors in their own units.

    Raises:
        InputError: `ribs` is not installed.
        ValueError: there are not as many solutions as individuals.
    """
    check_package("archive", "ribs")
    from ribs.archives import CVTArchive, GridArchive

    cells = filled(archive)
    if len(solutions) != len(cells):
        raise ValueError(f"expected {len(cells)} solutions; found {len(solutions)}")
    usual: dict[str, Any] = {
        "solution_dim": (), "solution_dtype": object,
        "extra_fields": {"id": ((), np.int64), "descriptors": (len(archive.names), np.float64)},
    }  # fmt: skip
    points = archive.points[cells]
    found: Any
    if archive.shape:
        ranges = list(zip(archive.lows, archive.highs, strict=True))
        # Without its own margin at the borders, cells are the same as here.
        found = GridArchive(dims=archive.shape, ranges=ranges, epsilon=0.0, **usual)
        measures = np.clip(points, archive.lows, archive.highs)
    else:
        ranges = [(0.0, 1.0)] * len(archive.names)
        centers = scale_points(archive, archive.centers)
        found = CVTArchive(centroids=centers, ranges=ranges, **usual)
        measures = scale_points(archive, points)
    if len(cells):
        column = np.empty(len(cells), object)  # one by one: rows of rows must not become a matrix
        for k, solution in enumerate(solutions):
            column[k] = solution
        found.add(column, archive.scores[cells], measures, id=archive.ids[cells],
                  descriptors=points)  # fmt: skip
    return found
