"""Pictures of a morphology at rest: three-quarter, top and side view in one PNG.

The parts' meshes are drawn by a small depth buffer of our own, in parallel projection: matplotlib
sorts whole polygons by their mean depth, which puts parts that touch in the wrong order. Nothing
here needs a display or a graphics driver. `swim_picture` draws with the same functions.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Affine2D
from scipy.ndimage import gaussian_filter

from mjx_revolve.body.morphology import Morphology
from mjx_revolve.body.solids import part_mesh
from mjx_revolve.inputs.errors import InputError

_DPI = 130
_INCHES = (13.0, 7.4)
# Each pixel is the mean of this many in both directions: smooth edges.
_FINE = 2
# Parts that move with a hinge are drawn darker than the frame, or the hinge could not be made out.
_MOVING = 0.72
_AXIS = (1.0, 0.47, 0.1)  # hinge axes are drawn as thin rods of this colour
_ROD = (0.0011, 0.025)  # their radius and half length [m]
_THRUST = (0.13, 0.66, 0.30)  # thrusts are drawn as arrows of this colour, along a command ahead
_ARROW = (0.0011, 0.034, 0.0036, 0.010)  # shaft's radius and length, head's radius and length [m]
_GREY = (0.62, 0.64, 0.68)  # modules without a colour of their own
_INK = "#3a4250"
_FAINT = "#c9ced6"
# Neighbouring pixels whose depths differ by more than this [m], or whose faces are turned by more
# than 30 degrees, get a line between them.
_STEP = 1.5e-3
_TURN = math.cos(math.radians(30.0))


@dataclass(frozen=True)
class Scene:
    """What is drawn: `m` triangles in the world frame.

    Attributes:
        corners: `[m, 3, 3]` [m].
        color: `[m, 3]` red, green, blue from 0 to 1.
        part: `[m]` number of the piece that the triangle belongs to.
    """

    corners: np.ndarray
    color: np.ndarray
    part: np.ndarray


@dataclass(frozen=True)
class Piece:
    """One part of a module, the rod that shows a hinge's axis, or the arrow of a thrust.

    Attributes:
        module: number of the module in its morphology.
        part: the part of the module that carries it.
        corners: `[m, 3, 3]` triangles, module frame at hinge angle 0 [m].
        color: `[3]` red, green, blue from 0 to 1.
    """

    module: int
    part: int
    corners: np.ndarray
    color: np.ndarray


def make_pieces(morphology: Morphology) -> list[Piece]:
    """All parts of a morphology in their file's colours, hinges' axes and thrusts.

    Args:
        morphology: the robot's modules.

    Returns:
        The pieces, in the order of the modules and their parts.
    """
    meshes: dict[Hashable, list[np.ndarray]] = {}
    pieces = []
    for number, module in enumerate(morphology.modules):
        kind = module.kind
        drawn = tuple(
            (part.name, part.boxes, part.volume, part.position, part.thruster)
            for part in kind.parts
        )
        key = (kind.name, kind.hinge, drawn)
        if key not in meshes:
            meshes[key] = [
                part_mesh(kind, part).triangles + np.asarray(part.position) for part in kind.parts
            ]
        rgb = np.clip(np.asarray(_GREY if module.rgb is None else module.rgb, float), 0.0, 1.0)
        for k, triangles in enumerate(meshes[key]):
            shade = rgb * (_MOVING if kind.hinge is not None and k > 0 else 1.0)
            pieces.append(Piece(number, k, triangles, shade))
        if kind.hinge is not None:
            radius, half = _ROD
            profile = [(-half, 0.0), (-half, radius), (half, radius), (half, 0.0)]
            rod = _spindle(kind.hinge.axis, profile) + np.asarray(kind.hinge.anchor)
            pieces.append(Piece(number, 0, rod, np.array(_AXIS)))
        for k, part in enumerate(kind.parts):
            if part.thruster is not None:
                radius, shaft, wide, head = _ARROW
                profile = [(0.0, 0.0), (0.0, radius), (shaft, radius), (shaft, wide)]
                arrow = _spindle(part.thruster.axis, [*profile, (shaft + head, 0.0)])
                arrow = arrow + np.asarray(part.position) + np.asarray(part.thruster.position)
                pieces.append(Piece(number, k, arrow, np.array(_THRUST)))
    return pieces


def place_pieces(
    pieces: Sequence[Piece], place: Callable[[Piece], tuple[np.ndarray, np.ndarray]]
) -> Scene:
    """Puts pieces together.

    Args:
        pieces: from `make_pieces`.
        place: position `[3]` [m] and rotation `[3, 3]` of a piece's module frame in the world.

    Returns:
        The scene.
    """
    corners, color, part = [], [], []
    for number, piece in enumerate(pieces):
        position, rotation = place(piece)
        corners.append(piece.corners @ rotation.T + position)
        color.append(np.broadcast_to(piece.color, (len(piece.corners), 3)))
        part.append(np.full(len(piece.corners), number))
    return Scene(np.concatenate(corners), np.concatenate(color), np.concatenate(part))


def rest_scene(morphology: Morphology) -> Scene:
    """All parts of the morphology at rest.

    Args:
        morphology: the robot's modules.

    Returns:
        The scene, the core's frame at the world's origin.
    """

    def place(piece: Piece) -> tuple[np.ndarray, np.ndarray]:
        module = morphology.modules[piece.module]
        return np.asarray(module.position), np.asarray(module.rotation)

    return place_pieces(make_pieces(morphology), place)


def _spindle(axis: Sequence[float], profile: Sequence[tuple[float, float]]) -> np.ndarray:
    """Six-sided solid of revolution `[m, 3, 3]` about a direction through the origin [m].

    Args:
        axis: the direction.
        profile: places along it and radii [m], from a point on the axis to another.
    """
    along = np.asarray(axis, float) / np.linalg.norm(axis)
    side = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    side /= np.linalg.norm(side)
    angle = np.arange(7)[:, None] * math.pi / 3
    ring = np.cos(angle) * side + np.sin(angle) * np.cross(along, side)
    rings = [place * along + radius * ring for place, radius in profile]
    walls = [(low[k], low[k + 1], high[k]) for low, high in pairwise(rings) for k in range(6)]
    walls += [(low[k + 1], high[k + 1], high[k]) for low, high in pairwise(rings) for k in range(6)]
    return np.array(walls)


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


def _depth_buffer(
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
        for axis in (0, 1):
            one, two = (slice(None, -1), slice(1, None))
            a = (one, slice(None)) if axis == 0 else (slice(None), one)
            b = (two, slice(None)) if axis == 0 else (slice(None), two)
            jump = np.abs(depth[a] - depth[b]) > _STEP
            turn = (normal[a] * normal[b]).sum(axis=-1) < _TURN
            line[a] |= jump | (turn & (part[a] >= 0) & (part[b] >= 0)) | (part[a] != part[b])
    return line


def draw_scene(
    scene: Scene,
    view: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    pixel: float,
    tint: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Picture of a scene in a view.

    Args:
        scene: what to draw.
        view: from `make_view`.
        low: `[2]` lower left corner of the picture, right and up in the view [m].
        high: `[2]` its upper right corner at least [m].
        pixel: size of a pixel [m].
        tint: changes the finished colours: `[..., 3]` colours and `[..., 3]` places in the view
            (right, up, towards the viewer [m]; towards is -inf where nothing is) to `[..., 3]`.

    Returns:
        red, green, blue, alpha `[rows, columns, 4]`, row 0 the lowest, and what it covers: left,
        right, bottom, top [m].
    """
    columns, rows = (np.ceil((high - low) / pixel).astype(int) + 1).tolist()
    fine = pixel / _FINE
    corners = scene.corners @ view.T
    depth, index = _depth_buffer(corners, low, fine, (rows * _FINE, columns * _FINE))
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
    color = 0.06 + 0.94 * scene.color[index]
    color = np.clip(color * light[..., None], 0.0, 1.0)
    color[_lines(depth, part, normal)] *= 0.4
    if tint is not None:
        right = low[0] + fine * (np.arange(columns * _FINE) + 0.5)
        up = low[1] + fine * (np.arange(rows * _FINE) + 0.5)
        color = tint(color, np.stack([*np.meshgrid(right, up), depth], axis=-1))
    image = np.concatenate([color * covered[..., None], covered[..., None]], axis=-1)
    image = image.reshape(rows, _FINE, columns, _FINE, 4).mean(axis=(1, 3))
    image[..., :3] /= np.maximum(image[..., 3:], 1e-6)
    return np.clip(image, 0.0, 1.0), (
        low[0],
        low[0] + columns * pixel,
        low[1],
        low[1] + rows * pixel,
    )


def _ticks(low: float, high: float, count: int) -> np.ndarray:
    """Round values that reach from just below `low` to just above `high`."""
    return np.asarray(MaxNLocator(nbins=count, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))


def _number(value: float) -> str:
    """A tick's label, with a minus sign as in the other views."""
    return f"{value + 0.0:.4g}".replace("-", "\u2212")


def _shadow(axes: Axes, scene: Scene, view: np.ndarray, ground: float) -> None:
    """Draws the soft shadow that light from straight above throws on the floor z = `ground`."""
    points = scene.corners[..., :2].reshape(-1, 2)
    blur = 0.01
    low, high = points.min(0) - 4 * blur, points.max(0) + 4 * blur
    pixel = float((high - low).max()) / 300
    columns, rows = np.ceil((high - low) / pixel).astype(int)
    depth, _ = _depth_buffer(scene.corners, low, pixel, (rows, columns))
    shade = gaussian_filter(np.isfinite(depth).astype(float), blur / pixel)
    image = np.zeros((rows, columns, 4))
    image[..., 3] = 0.28 * shade
    flat = np.eye(3)
    flat[:2, :2], flat[:2, 2] = view[:2, :2], view[:2, 2] * ground
    picture = axes.imshow(
        image,
        extent=(low[0], low[0] + columns * pixel, low[1], low[1] + rows * pixel),
        origin="lower",
        interpolation="bilinear",
        zorder=2,
    )
    picture.set_transform(Affine2D(flat) + axes.transData)


def _floor(
    axes: Axes, scene: Scene, view: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Draws a floor grid and three scaled axes below and beside the bounds `low` to `high` [m].

    Returns:
        The corners of what was drawn, in the view: `[n, 2]` [m].
    """
    size = float((high - low).max())
    step = float(np.diff(_ticks(0.0, size, 10))[0])
    xs, ys = (
        step * np.arange(math.floor(low[k] / step - 0.3), math.ceil(high[k] / step + 0.3) + 1)
        for k in (0, 1)
    )
    zs = step * np.arange(math.floor(low[2] / step - 0.2), math.ceil(high[2] / step) + 1)
    ground = zs[0]
    tick = 0.016 * size

    def line(start: Sequence[float], end: Sequence[float], **style: Any) -> None:
        points = np.array([start, end]) @ view[:2].T
        axes.plot(points[:, 0], points[:, 1], solid_capstyle="round", **style)

    def text(place: Sequence[float], words: str, **style: Any) -> None:
        x, y = view[:2] @ np.asarray(place)
        axes.text(x, y, words, color=_INK, **style)

    plane = [(x, y, ground) for x, y in zip(xs[[0, -1, -1, 0]], ys[[0, 0, -1, -1]], strict=True)]
    axes.fill(*(np.array(plane) @ view[:2].T).T, color="#f4f6f9", zorder=0)
    for x in xs:
        line((x, ys[0], ground), (x, ys[-1], ground), color=_FAINT, lw=0.6, zorder=1)
    for y in ys:
        line((xs[0], y, ground), (xs[-1], y, ground), color=_FAINT, lw=0.6, zorder=1)
    _shadow(axes, scene, view, ground)
    edge: dict[str, Any] = {"color": _INK, "lw": 1.0, "zorder": 1}
    line((xs[0], ys[0], ground), (xs[-1], ys[0], ground), **edge)
    line((xs[-1], ys[0], ground), (xs[-1], ys[-1], ground), **edge)
    line((xs[0], ys[0], ground), (xs[0], ys[0], zs[-1]), **edge)
    small: dict[str, Any] = {"fontsize": 8, "ha": "center", "va": "center"}
    every = step * max(1, math.ceil(max(len(xs), len(ys)) / 8))
    for x in xs[np.abs(np.remainder(xs / every + 0.5, 1.0) - 0.5) < 0.01]:
        line((x, ys[0], ground), (x, ys[0] - tick, ground), **edge)
        text((x, ys[0] - 3.2 * tick, ground), _number(x), **small)
    for y in ys[np.abs(np.remainder(ys / every + 0.5, 1.0) - 0.5) < 0.01]:
        line((xs[-1], y, ground), (xs[-1] + tick, y, ground), **edge)
        text((xs[-1] + 3.4 * tick, y, ground), _number(y), **small)
    for z in zs:
        line((xs[0], ys[0], z), (xs[0] - tick, ys[0], z), **edge)
        text((xs[0] - 3.4 * tick, ys[0], z), _number(z), **small)
    large: dict[str, Any] = {"fontsize": 10, "ha": "center", "va": "center"}
    text(((xs[0] + xs[-1]) / 2, ys[0] - 8.5 * tick, ground), "x [m]", **large)
    text((xs[-1] + 8.0 * tick, (ys[0] + ys[-1]) / 2, ground), "y [m]", **large)
    text((xs[0] - 4.0 * tick, ys[0], zs[-1] + 3.0 * tick), "z [m]", **large)
    far = 10.0 * tick
    corners = [(x, y, ground) for x in (xs[0], xs[-1] + far) for y in (ys[0] - far, ys[-1])]
    corners += [
        (xs[0] - 0.6 * far, ys[0], zs[-1] + 0.5 * far),
        (*high,),
        (low[0], high[1], high[2]),
    ]
    return np.array(corners) @ view[:2].T


def _show(axes: Axes, scene: Scene, view: np.ndarray, pixel: float) -> None:
    """Draws the scene into axes whose units are metres of the view."""
    points = scene.corners.reshape(-1, 3) @ view[:2].T
    margin = 4 * pixel
    image, extent = draw_scene(scene, view, points.min(0) - margin, points.max(0) + margin, pixel)
    limits = axes.axis()
    axes.imshow(image, extent=extent, origin="lower", interpolation="bilinear", zorder=3)
    axes.axis(limits)


def _compose(morphology: Morphology) -> Figure:
    """The whole picture."""
    scene = rest_scene(morphology)
    low, high = scene.corners.min((0, 1)), scene.corners.max((0, 1))
    width, height = _INCHES
    figure = Figure(figsize=_INCHES, dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)

    # Three-quarter view: fills the left part of the page.
    room = np.array([8.3, height - 0.75])
    axes = figure.add_axes((0.1 / width, 0.1 / height, room[0] / width, room[1] / height))
    axes.set_axis_off()
    view = make_view(-58.0, 30.0)
    corners = _floor(axes, scene, view, low, high)
    center = (corners.min(0) + corners.max(0)) / 2
    unit = float((np.ptp(corners, axis=0) / room).max()) * 1.01  # metres per inch
    axes.set_xlim(center[0] - unit * room[0] / 2, center[0] + unit * room[0] / 2)
    axes.set_ylim(center[1] - unit * room[1] / 2, center[1] + unit * room[1] / 2)
    _show(axes, scene, view, unit / _DPI)

    # Top and side view, in one scale, above each other in the right part.
    size = high - low
    pad = 0.05 * float(size.max())
    along = 0 if size[0] >= 0.8 * size[1] else 1  # the side view looks across the longer way
    panels = (
        (0, 1, "from above", np.eye(3)),
        (along, 2, "from the side", make_view(-90.0 if along == 0 else 0.0, 0.0)),
    )
    room = np.array([3.4, height - 2.7])
    wide, tall = (np.array([size[panel[k]] + 2 * pad for panel in panels]) for k in (0, 1))
    unit = max(float(wide.max()) / room[0], float(tall.sum()) / room[1])
    wide, tall = wide / unit, tall / unit  # inches
    spare = room[1] - tall.sum()
    for k, (across, up, title, view) in enumerate(panels):
        left = width - 0.35 - (room[0] + wide[k]) / 2
        bottom = 1.55 + tall[1] + 0.6 * spare if k == 0 else 0.65 + 0.4 * spare
        axes = figure.add_axes((left / width, bottom / height, wide[k] / width, tall[k] / height))
        axes.set_xlim(low[across] - pad, high[across] + pad)
        axes.set_ylim(low[up] - pad, high[up] + pad)
        axes.set_title(title, fontsize=9, color=_INK)
        axes.set_xlabel("xyz"[across] + " [m]", color=_INK)
        axes.set_ylabel("xyz"[up] + " [m]", color=_INK)
        axes.grid(True, color=_FAINT, lw=0.5)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=8, colors=_INK, length=3)
        for spine in axes.spines.values():
            spine.set_color(_INK)
        for axis, span in ((axes.xaxis, wide[k] / 0.6), (axes.yaxis, tall[k] / 0.35)):
            count = int(np.clip(span, 1, 6))
            axis.set_major_locator(MaxNLocator(nbins=count, steps=[1, 2, 5, 10]))
        _show(axes, scene, view, unit / _DPI)

    counts = [
        f"{name} {count}"
        for name, count in (("thrusters", morphology.num_thrusters), ("fins", morphology.num_fins))
        if count
    ]
    words = ", ".join(
        [
            f"modules {morphology.num_modules}, hinges {morphology.num_hinges}",
            *counts,
            f"{morphology.mass:.4g} kg, {1e6 * morphology.volume:.4g} cm³",
        ]
    )
    figure.text(
        0.3 / width, 1 - 0.38 / height, morphology.name, fontsize=15, color=_INK, va="center"
    )
    figure.text(
        1 - 0.35 / width, 1 - 0.38 / height, words, fontsize=10, color=_INK, ha="right", va="center"
    )
    return figure


def check_picture_path(path: str | Path) -> Path:
    """Whether a picture may be written somewhere.

    Args:
        path: of the PNG.

    Returns:
        The path.

    Raises:
        InputError: `path` does not end in `.png`, is a folder, or lies in none.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise InputError(f"{path}: expected a name that ends in .png; found '{path.suffix}'")
    if path.is_dir():
        raise InputError(f"{path}: expected a file; found a folder")
    if not path.parent.is_dir():
        raise InputError(f"{path}: expected the folder {path.parent} to exist; found none")
    return path


def write_figure(figure: Figure, path: Path) -> None:
    """Writes a figure as a PNG that appears whole or not at all.

    Args:
        figure: the figure.
        path: the file, see `check_picture_path`.

    Raises:
        InputError: it cannot be written.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with draft.open("wb") as file:
            figure.savefig(file, format="png", dpi=figure.dpi)
        os.replace(draft, path)
    except OSError as error:
        raise InputError(f"{path}: expected a writable file; found {error.strerror}") from None
    finally:
        draft.unlink(missing_ok=True)


def draw_morphology(morphology: Morphology, path: str | Path) -> None:
    """Draws a morphology at rest: three-quarter, top and side view, axes in metres.

    Modules have the colours of their file; the part of a hinge that moves is drawn darker than its
    frame. An orange rod is a hinge's axis, a green arrow the thrust of a command ahead. The file
    appears whole or not at all.

    Args:
        morphology: what to draw.
        path: where to write the PNG.

    Raises:
        InputError: `path` does not end in `.png`, its folder does not exist, or it cannot be
            written.
    """
    path = check_picture_path(path)
    write_figure(_compose(morphology), path)
