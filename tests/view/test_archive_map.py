"""Pictures of archives: what is drawn where, in which colour."""

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import Normalize
from matplotlib.path import Path

from mjx_revolve.episodes.bodies_config import ArchiveConfig
from mjx_revolve.evolution.archive import cell_of, filled, insert, make_archive
from mjx_revolve.view.archive_map import plot_archive, voronoi_cells

VIRIDIS = colormaps["viridis"]
AXES = {
    "num_modules": {"low": 2, "high": 8, "cells": 3},
    "speed_m_s": {"low": 0, "high": 0.4, "cells": 2},
    "symmetry": {"low": 0, "high": 1, "cells": 4},
    "depth_m": {"low": 0, "high": 2, "cells": 2},
    "mass": {"low": 0, "high": 1, "cells": 2},
}


def archive(axes, kind="grid", count=30):
    """With individuals that are the better the later they were born."""
    settings = ArchiveConfig(type=kind, axes=dict(list(AXES.items())[:axes]), cells=40)
    empty = make_archive(settings, 0)
    share = np.random.default_rng(1).random((count, axes))
    points = empty.lows + share * (empty.highs - empty.lows)
    return insert(empty, np.arange(count), np.linspace(-1, 2, count), points)


def star(figure):
    """Where the best one is marked; None: nowhere."""
    found = [line.get_xydata()[0] for line in figure.axes[0].lines if line.get_marker() == "*"]
    assert len(found) < 2
    return found[0].tolist() if found else None


def test_a_grid_of_two_axes():
    found = archive(2, count=4)
    assert 1 < len(filled(found)) < 6
    figure = plot_archive(found, label="score (m)", title="a run")
    axes, bar = figure.axes
    drawn = axes.collections[0]
    norm = Normalize(np.nanmin(found.scores), np.nanmax(found.scores))
    assert len(drawn.get_paths()) == 6
    for cell, path in enumerate(drawn.get_paths()):
        column, row = divmod(cell, 2)
        box = path.get_extents()
        corners = (2 + 2 * column, 0.2 * row, 4 + 2 * column, 0.2 + 0.2 * row)
        assert (box.x0, box.y0, box.x1, box.y1) == pytest.approx(corners)
        score, face = found.scores[cell], drawn.get_facecolors()[cell]
        assert face[3] == 0 if np.isnan(score) else (face == VIRIDIS(norm(score))).all()
    assert (*axes.get_xlim(), *axes.get_ylim()) == (2, 8, 0, 0.4)
    assert axes.get_xlabel() == "number of modules"
    assert axes.get_ylabel() == "speed over ground (m/s)"
    assert bar.get_ylabel() == "score (m)"
    assert star(figure) == found.centers[np.nanargmax(found.scores)].tolist()
    assert f"{len(filled(found))} of 6 cells · best: 2" in axes.get_title(loc="left")


def test_the_cells_of_a_tessellation_are_those_of_the_nearest_centre():
    found = archive(2, "cvt")
    figure = plot_archive(found)
    drawn = figure.axes[0].collections[0]
    polygons = drawn.get_paths()
    points = np.random.default_rng(2).uniform(found.lows, found.highs, (300, 2))
    for point, cell in zip(points, cell_of(found, points), strict=True):
        inside = [k for k, path in enumerate(polygons) if path.contains_point(point)]
        assert inside == [cell]
    blank = drawn.get_facecolors()[:, 3] == 0
    assert np.flatnonzero(~blank).tolist() == filled(found).tolist()
    assert star(figure) == found.centers[np.nanargmax(found.scores)].tolist()


def test_voronoi_cells_fill_the_square():
    centers = np.random.default_rng(3).random((50, 2))
    polygons = voronoi_cells(centers)
    areas = []
    for x, y in (polygon.T for polygon in polygons):
        areas.append(abs(np.sum(x * np.roll(y, 1) - y * np.roll(x, 1))) / 2)
        assert min(x.min(), y.min()) > -1e-9 and max(x.max(), y.max()) < 1 + 1e-9
    assert sum(areas) == pytest.approx(1.0)
    assert all(Path(p).contains_point(c) for p, c in zip(polygons, centers, strict=True))


@pytest.mark.parametrize(("count", "kind"), [(5, "grid"), (3, "cvt")])
def test_a_line_for_each_individual(count, kind):
    found = archive(count, kind)
    figure = plot_archive(found)
    axes = figure.axes[0]
    lines = axes.collections[0].get_segments()
    assert len(lines) == len(filled(found)) > 8
    best = found.points[np.nanargmax(found.scores)]
    heights = (best - found.lows) / (found.highs - found.lows)
    assert lines[-1][:, 1] == pytest.approx(heights)  # on top
    assert star(figure) == pytest.approx([count - 1, heights[-1]])
    assert len(axes.get_xticklabels()) == count
