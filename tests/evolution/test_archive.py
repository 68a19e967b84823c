"""Archives by hand: a grid of two by three, and a tessellation compared with what it means."""

import io

import numpy as np
import pytest

from mjx_revolve.episodes.bodies_config import ArchiveConfig
from mjx_revolve.evolution.archive import (
    best,
    cell_of,
    coverage,
    filled,
    from_arrays,
    insert,
    make_archive,
    qd_score,
    rows,
    to_arrays,
    to_ribs,
)

NAN, INF = np.nan, np.inf


def grid(**axes):
    """Two cells of 5 modules each, three of 0.2 m/s; or others."""
    axes = axes or {
        "num_modules": {"low": 2, "high": 12, "cells": 2},
        "speed": {"low": -0.3, "high": 0.3, "cells": 3},
    }
    return make_archive(ArchiveConfig(axes=axes), 0)


def tessellation(cells=64, seed=0):
    """Axes as different as modules and metres per second."""
    axes = {"num_modules": {"low": 2, "high": 32}, "speed": {"low": -0.1, "high": 0.3}}
    return make_archive(ArchiveConfig(type="cvt", axes=axes, cells=cells), seed)


def crowd(count=400, seed=1):
    """Numbers, scores (all different) and places, some of them outside, for both archives."""
    rng = np.random.default_rng(seed)
    points = np.stack([rng.uniform(0, 35, count), rng.uniform(-0.4, 0.4, count)], axis=1)
    return np.arange(count), rng.permutation(count) / 7 - 20, points


def same(a, b):
    """Bit for bit."""
    a, b = to_arrays(a), to_arrays(b)
    return a.keys() == b.keys() and all(
        (x.dtype, x.shape, x.tobytes()) == (b[name].dtype, b[name].shape, b[name].tobytes())
        for name, x in a.items()
    )


def test_the_cells_of_a_grid():
    archive = grid()
    assert archive.names == ("num_modules", "speed") and archive.shape == (2, 3)
    middles = [[4.5, -0.2], [4.5, 0], [4.5, 0.2], [9.5, -0.2], [9.5, 0], [9.5, 0.2]]
    assert archive.centers == pytest.approx(np.array(middles))
    assert cell_of(archive, archive.centers).tolist() == [0, 1, 2, 3, 4, 5]
    points = [[2, -0.3], [6.9, 0], [7, 0], [12, 0.3], [99, -9], [-99, 9], [2, NAN], [INF, 0]]
    assert cell_of(archive, np.array(points)).tolist() == [0, 1, 4, 5, 3, 2, -1, -1]
    assert cell_of(archive, np.zeros((0, 2))).tolist() == []
    # Whole numbers, one in each cell.
    counts = grid(a={"low": 1, "high": 16, "cells": 15}, b={"low": 0, "high": 1, "cells": 1})
    points = np.stack([np.arange(1.0, 17.0), np.ones(16)], axis=1)
    assert cell_of(counts, points).tolist() == [*range(15), 14]


def test_insertion():
    empty = grid()
    a, b, c, d, e, f = [2, -0.3], [4, -0.2], [3, -0.2], [9, 0.2], [9, 0.0], [9, NAN]
    archive = insert(
        empty,
        np.array([4, 1, 2, 3, 5, 6, 7]),
        np.array([1.0, 1.0, 2.0, -5.0, NAN, 9.0, 2.0]),
        np.array([a, b, c, d, e, f, a]),
    )
    # 1 comes first, 2 is better; 4 is not, though it stands first; 7 is only as good as 2.
    assert filled(archive).tolist() == [0, 5]
    assert archive.ids[[0, 5]].tolist() == [2, 3]
    assert archive.scores[[0, 5]].tolist() == [2.0, -5.0]
    assert archive.points[[0, 5]].tolist() == [c, d]
    assert (empty.ids == -1).all() and np.isnan(empty.scores).all()  # as it was
    assert coverage(archive) == 2 / 6 and coverage(empty) == qd_score(empty) == 0
    assert qd_score(archive) == -3.0 and qd_score(archive, -10.0) == 17.0
    # In another generation.
    archive = insert(archive, np.array([8, 9]), np.array([2.5, 2.0]), np.array([b, [12, 0]]))
    assert best(archive) == 0 and best(empty) == -1
    assert archive.ids[[0, 4]].tolist() == [8, 9] and archive.points[0].tolist() == b


@pytest.mark.parametrize("make", [grid, tessellation])
def test_archives_hold_the_best_of_each_cell_in_whatever_order_they_come(make):
    ids, scores, points = crowd()
    cells = cell_of(make(), points)
    archive = insert(make(), ids, scores, points)
    for cell in range(len(archive.ids)):
        inside = np.flatnonzero(cells == cell)
        assert archive.ids[cell] == (inside[scores[inside].argmax()] if inside.size else -1)
    assert len(filled(archive)) == len({*cells.tolist()}) > 5
    rng = np.random.default_rng(2)
    for _ in range(3):
        late, split = rng.permutation(len(ids)), int(rng.integers(1, len(ids)))
        other = make()
        for part in (late[:split], late[split:]):
            other = insert(other, ids[part], scores[part], points[part])
        assert same(archive, other)


def test_a_tessellation_has_cells_of_nearest_centres_and_equal_size():
    archive = tessellation()
    assert same(archive, tessellation())
    assert not np.array_equal(archive.centers, tessellation(seed=1).centers)
    assert archive.shape == () and archive.centers.shape == (64, 2)
    low, high = np.array([2, -0.1]), np.array([32, 0.3])
    assert ((archive.centers > low) & (archive.centers < high)).all()
    rng = np.random.default_rng(3)
    points = low + (high - low) * rng.uniform(-0.2, 1.2, (2000, 2))
    found = cell_of(archive, points)
    for point, cell in zip(points, found, strict=True):
        away = (archive.centers - np.minimum(np.maximum(point, low), high)) / (high - low)
        assert cell == (away**2).sum(1).argmin()
    assert cell_of(archive, np.array([[NAN, 0], [3, INF]])).tolist() == [-1, -1]
    # Random centres would have a standard deviation of half of the mean volume.
    inside = low + (high - low) * rng.random((64 * 400, 2))
    volumes = np.bincount(cell_of(archive, inside), minlength=64) / 400
    assert volumes.std() < 0.2 and volumes.min() > 0.5


@pytest.mark.parametrize("make", [grid, tessellation])
def test_archives_come_back_from_a_file_as_they_were(make):
    archive = insert(make(), *crowd())
    file = io.BytesIO()
    np.savez(file, **to_arrays(archive))
    file.seek(0)
    with np.load(file, allow_pickle=False) as arrays:
        again = from_arrays(arrays)
    assert same(archive, again)
    one, other = ({n: type(x) for n, x in vars(y).items()} for y in (again, archive))
    assert one == other
    more = (np.array([900]), np.array([99.0]), np.array([[5, 0.1]]))
    assert same(insert(archive, *more), insert(again, *more))


NO_RIBS = "ribs is not installed (pip install 'ribs>=0.12,<0.13')"


@pytest.mark.slow
@pytest.mark.parametrize("make", [grid, lambda: tessellation(2000)], ids=["grid", "cvt"])
def test_ribs_opens_an_archive_with_the_same_cells(make):
    pytest.importorskip("ribs", reason=NO_RIBS)
    archive = insert(make(), *crowd(8000))
    table = rows(archive)
    # Objects of any kind, among them sequences of one length.
    solutions = [[row["id"], {"body": row["cell"]}] for row in table]
    found = to_ribs(archive, solutions)
    assert len(found) == len(table) == found.stats.num_elites > 5
    assert found.cells == len(archive.ids)
    data = {name: found.data(name) for name in found.field_list}
    assert sorted(data["index"].tolist()) == filled(archive).tolist()
    for k, cell in enumerate(data["index"]):
        assert data["solution"][k] == [archive.ids[cell], {"body": cell}]
        assert data["id"][k] == archive.ids[cell]
        assert data["objective"][k] == archive.scores[cell]
        assert data["descriptors"][k].tolist() == archive.points[cell].tolist()
    assert found.stats.qd_score == pytest.approx(qd_score(archive))
    assert found.best_elite["id"] == archive.ids[np.nanargmax(archive.scores)]
    assert len(to_ribs(make(), [])) == 0
    with pytest.raises(ValueError, match=r"expected \d+ solutions"):
        to_ribs(archive, solutions[1:])
