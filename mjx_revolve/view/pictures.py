"""Pictures of a morphology at rest: three-quarter, top and side view in one PNG."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Affine2D
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from mjx_revolve.body.morphology import Morphology
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import check_name, write_atomic
from mjx_revolve.view.pieces import Scene, rest_scene
from mjx_revolve.view.raster import depth_buffer, draw_scene, make_view

_DPI = 130
_INCHES = (13.0, 7.4)
_INK = "#3a4250"
_FAINT = "#c9ced6"


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
    depth, _ = depth_buffer(scene.corners, low, pixel, (rows, columns))
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

    def line(start: ArrayLike, end: ArrayLike, **style: Any) -> None:
        points = np.array([start, end]) @ view[:2].T
        axes.plot(points[:, 0], points[:, 1], solid_capstyle="round", **style)

    def text(place: ArrayLike, words: str, **style: Any) -> None:
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
    small: dict[str, Any] = {"fontsize": 8, "ha": "center", "va": "center"}
    every = step * max(1, math.ceil(max(len(xs), len(ys)) / 8))
    some = [v[np.abs(np.remainder(v / every + 0.5, 1.0) - 0.5) < 0.01] for v in (xs, ys)]
    # Each axis: where it begins, its ticks, where it ends, and outwards.
    for k, (corner, ticks, end, away) in enumerate((
        ((xs[0], ys[0], ground), some[0], xs[-1], (0, -1, 0)),
        ((xs[-1], ys[0], ground), some[1], ys[-1], (1, 0, 0)),
        ((xs[0], ys[0], ground), zs, zs[-1], (-1, 0, 0)),
    )):  # fmt: skip
        at = lambda value, corner=corner, k=k: np.where(np.arange(3) == k, value, corner)  # noqa: E731
        line(corner, at(end), **edge)
        for value in ticks:
            line(at(value), at(value) + np.multiply(tick, away), **edge)
            text(at(value) + np.multiply(3.4 * tick, away), _number(value), **small)
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
        axes.set(xlim=(low[across] - pad, high[across] + pad), ylim=(low[up] - pad, high[up] + pad))
        axes.set_title(title, fontsize=9, color=_INK)
        axes.set_xlabel(f"{'xyz'[across]} [m]", color=_INK)
        axes.set_ylabel(f"{'xyz'[up]} [m]", color=_INK)
        axes.grid(True, color=_FAINT, lw=0.5)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=8, colors=_INK, length=3)
        axes.spines[:].set_color(_INK)
        for axis, span in ((axes.xaxis, wide[k] / 0.6), (axes.yaxis, tall[k] / 0.35)):
            count = int(np.clip(span, 1, 6))
            axis.set_major_locator(MaxNLocator(nbins=count, steps=[1, 2, 5, 10]))
        _show(axes, scene, view, unit / _DPI)

    counts = {"thrusters": morphology.num_thrusters, "fins": morphology.num_fins}
    words = ", ".join([
        f"modules {morphology.num_modules}, hinges {morphology.num_hinges}",
        *(f"{name} {count}" for name, count in counts.items() if count),
        f"{morphology.mass:.4g} kg, {1e6 * morphology.volume:.4g} cm³",
    ])  # fmt: skip
    top = 1 - 0.38 / height
    look: dict[str, Any] = {"color": _INK, "va": "center"}
    figure.text(0.3 / width, top, morphology.name, fontsize=15, **look)
    figure.text(1 - 0.35 / width, top, words, fontsize=10, ha="right", **look)
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
    path = check_name(path, (".png",))
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
    content = io.BytesIO()
    try:
        figure.savefig(content, format="png", dpi=figure.dpi)
        write_atomic(path, content.getvalue())
    except OSError as error:
        raise InputError(f"{path}: expected a writable file; found {error.strerror}") from None


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
