"""Triangles to pixels: a depth buffer in parallel projection.

matplotlib sorts whole polygons by their mean depth, which puts parts that touch in the wrong order.
Nothing here needs a display or a graphics driver.
"""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from scipy.ndimage import gaussian_filter

from mjx_revolve.view.pieces import Scene

# Each pixel is the mean of this many in both directions: smooth edges.
_FINE = 2
# Neighbouring pixels get a line between them where depths differ by more than this [m], or faces
# are turned by more than 30 degrees.
_STEP = 1.5e-3
_TURN = math.cos(math.radians(30.0))


def on_white(picture: np.ndarray) -> np.ndarray:
    """A picture `[height, width, 4]` without its transparency: `[height, width, 3]`."""
    return picture[..., :3] * picture[..., 3:] + 1.0 - picture[..., 3:]


def make_view(azimuth: float, elevation: float) -> np.ndarray:
    """Rotation from the world to a view.

    Args:
        azimuth: where the viewer stands, about z from x [deg].
        elevation: how high [deg].

    Returns:
        `[3, 3]`; its rows are right, up and towards the viewer.
    """
    a, e = math.radians(azimuth), math.radians(elevation)
    right = np.array([-math.sin(a), math.cos(a), 0.0])
    towards = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    return np.stack([right, np.cross(towards, right), towards])


REST_VIEW = make_view(-58.0, 30.0)
"""The three-quarter view of bodies at rest."""


def depth_buffer(
    corners: np.ndarray, low: np.ndarray, pixel: float, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Draws triangles given in a view.

    Args:
        corners: `[m, 3, 3]` right, up, towards the viewer [m].
        low: `[2]` the picture's lower left corner [m].
        pixel: size of a pixel [m].
        shape: rows and columns; row 0 is the lowest.

    Returns:
        depth `[rows, columns]` towards the viewer [m], -inf where nothing is, and the number of the
        triangle `[rows, columns]`, -1 where nothing is.
    """
    depth, index = np.full(shape, -np.inf), np.full(shape, -1, np.int32)
    points = (corners[..., :2] - low) / pixel - 0.5  # pixel centres at whole numbers
    (ax, ay), (bx, by), (cx, cy) = points.transpose(1, 2, 0)
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    first = np.maximum(np.ceil(points.min(axis=1)).astype(int), 0)
    last = np.minimum(np.floor(points.max(axis=1)).astype(int), np.array(shape)[::-1] - 1)
    # Faces that look away are hidden by the closed mesh in front of them.
    for k in np.flatnonzero((area > 1e-9) & (first <= last).all(axis=1)):
        x = np.arange(first[k, 0], last[k, 0] + 1)
        y = np.arange(first[k, 1], last[k, 1] + 1)[:, None]
        # Barycentric weights of b and c at each pixel.
        beta = ((cy[k] - ay[k]) * (x - ax[k]) - (cx[k] - ax[k]) * (y - ay[k])) / area[k]
        gamma = ((bx[k] - ax[k]) * (y - ay[k]) - (by[k] - ay[k]) * (x - ax[k])) / area[k]
        za, zb, zc = corners[k, :, 2]
        z = za + beta * (zb - za) + gamma * (zc - za)
        window = (slice(first[k, 1], last[k, 1] + 1), slice(first[k, 0], last[k, 0] + 1))
        seen = (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1) & (z > depth[window])
        depth[window][seen] = z[seen]
        index[window][seen] = k
    return depth, index


def _occlusion(depth: np.ndarray, pixel: float) -> np.ndarray:
    """How much of the light from all around reaches each pixel, 0 to 1, from the depths nearby."""
    radii = (0.003, 0.008, 0.018)  # m
    border = math.ceil(max(radii) / pixel) + 1
    here = np.where(np.isfinite(depth), depth, -1e3)
    around = np.pad(here, border, constant_values=-1e3)
    (rows, columns), blocked, samples = depth.shape, np.zeros(depth.shape), 0
    for radius in radii:
        reach = max(1.0, radius / pixel)
        for angle in np.arange(12) * (math.pi / 6) + radius * 100:
            row = border + round(reach * math.sin(angle))
            column = border + round(reach * math.cos(angle))
            rise = around[row : row + rows, column : column + columns] - here - 0.15 * radius
            # A rise far larger than the radius is another limb in front, not a corner.
            blocked += np.clip(rise / radius, 0.0, 1.0) * (rise < 4.0 * radius)
            samples += 1
    return 1.0 - 0.75 * gaussian_filter(blocked / samples, max(2.0, 0.0012 / pixel))


def _lines(depth: np.ndarray, part: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Where the outline of a part or a sharp edge lies: `[rows, columns]` bool."""
    line = np.zeros(depth.shape, bool)
    with np.errstate(invalid="ignore"):
        for a, b in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
            jump = np.abs(depth[a] - depth[b]) > _STEP
            turn = (normal[a] * normal[b]).sum(axis=-1) < _TURN
            line[a] |= jump | (turn & (part[a] >= 0) & (part[b] >= 0)) | (part[a] != part[b])
    return line


def draw_scene(
    scene: Scene, view: np.ndarray, low: np.ndarray, high: np.ndarray, pixel: float
) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Picture of a scene in a view.

    Args:
        scene: what to draw.
        view: from `make_view`.
        low: `[2]` lower left corner of the picture, right and up in the view [m].
        high: `[2]` its upper right corner at least [m].
        pixel: size of a pixel [m].

    Returns:
        red, green, blue, alpha `[rows, columns, 4]`, row 0 the lowest, and what it covers: left,
        right, bottom, top [m].
    """
    columns, rows = (np.ceil((high - low) / pixel).astype(int) + 1).tolist()
    fine = pixel / _FINE
    corners = scene.corners @ view.T
    depth, index = depth_buffer(corners, low, fine, (rows * _FINE, columns * _FINE))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    covered = index >= 0
    normal, part = normals[index], np.where(covered, scene.part[index], -1)
    # Two lamps fixed to the viewer (a main one from the upper left) over light from everywhere.
    main, fill = np.array([-0.45, 0.65, 0.75]), np.array([0.8, 0.1, 0.4])
    main, fill = main / np.linalg.norm(main), fill / np.linalg.norm(fill)
    light = 0.46 + 0.60 * np.clip(normal @ main, 0, 1) + 0.16 * np.clip(normal @ fill, 0, 1)
    light *= _occlusion(depth, fine)
    # Dark colours keep a little light of their own, or their edges would vanish.
    color = np.clip((0.06 + 0.94 * scene.color[index]) * light[..., None], 0.0, 1.0)
    color[_lines(depth, part, normal)] *= 0.4
    image = np.concatenate([color * covered[..., None], covered[..., None]], axis=-1)
    image = image.reshape(rows, _FINE, columns, _FINE, 4).mean(axis=(1, 3))
    image[..., :3] /= np.maximum(image[..., 3:], 1e-6)
    right, top = low + pixel * np.array([columns, rows])
    return np.clip(image, 0.0, 1.0), (low[0], right, low[1], top)


def show_scene(
    axes: Axes, scene: Scene, view: np.ndarray, pixel: float, alpha: float = 1.0
) -> None:
    """Puts a picture of a scene into axes in metres of the view, limits unchanged.

    Args:
        axes: to draw into.
        scene: what to draw.
        view: from `make_view`.
        pixel: size of a pixel [m].
        alpha: opacity, 0 to 1.
    """
    low, high = scene.bounds(view)
    image, extent = draw_scene(scene, view, low - 4 * pixel, high + 4 * pixel, pixel)
    limits = axes.axis()
    axes.imshow(image, extent=extent, origin="lower", interpolation="bilinear", aspect="auto",
                alpha=alpha, zorder=3)  # fmt: skip
    axes.axis(limits)
