"""Picture of a swimming robot: poses along its way, and one stroke seen by a camera that follows.

Drawn with the depth buffer of `pictures`, so it needs no display and no graphics driver. The view
is a parallel projection from a little above, turned so that the robot swims to the right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import gaussian_filter, map_coordinates

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.pictures import (
    Piece,
    Scene,
    check_picture_path,
    draw_scene,
    make_pieces,
    make_view,
    place_pieces,
    write_figure,
)
from mjx_revolve.water.bed import bed_height, bed_slope

if TYPE_CHECKING:
    from mjx_revolve.engine.robot import Robot
    from mjx_revolve.episodes.simulate import Trajectory

_PAGE = (1600, 900)  # pixels
_DPI = 100
_LEFT, _TOP, _GAP = 36, 74, 14  # of the panels on the page [pixels]
_STRIP = 212  # height of the snapshots
_INK, _SOFT = "#17303f", "#4d6675"
_HIGH_WATER, _LOW_WATER = np.array([0.925, 0.968, 0.985]), np.array([0.52, 0.745, 0.86])
_SAND = np.array([0.80, 0.74, 0.58])
_PATH = "#e2711d"

_ELEVATION = 20.0  # of the viewer [deg]
_TOWARDS = 14.0  # the robot swims this much towards the viewer, not straight to the right [deg]
_HAZE = 0.34  # share of the water's colour in the farthest thing that is shown
# Length [m], direction and phase of wave trains that together make no visible pattern.
_RIPPLES = ((0.16, 0.4, 0.0), (0.11, 1.9, 1.3), (0.13, 3.0, 4.1), (0.07, 5.1, 2.2))
_MOST = 6  # poses in the large picture, and snapshots of the stroke
# Neighbouring poses are at least this far apart [body lengths]; two alone may be closer.
_APART, _PAIR = 0.55, 0.35
# A stroke must come back to where it began: correlation with the record one period earlier.
_REPEATS = 0.7


# --- what to show -------------------------------------------------------------------------------


def pose_scene(robot: Robot, qpos: np.ndarray, pieces: Sequence[Piece] | None = None) -> Scene:
    """The robot's parts in a pose.

    Args:
        robot: the robot.
        qpos: `[nq]` as in a trajectory.
        pieces: from `make_pieces(robot.morphology)`, where they are there already.

    Returns:
        The scene, world frame [m].
    """
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(robot.mj_model, data)
    modules, fluid = robot.morphology.modules, robot.fluid
    row = np.cumsum([0] + [len(module.kind.parts) for module in modules])

    def place(piece: Piece) -> tuple[np.ndarray, np.ndarray]:
        k = row[piece.module] + piece.part
        part = modules[piece.module].kind.parts[piece.part]
        body = fluid.body[k]
        frame = data.xmat[body].reshape(3, 3)
        rotation = frame @ fluid.rotation[k]
        # The table has the centre of the part's main box.
        center = np.asarray(part.position) + np.asarray(part.boxes[0].position)
        return data.xpos[body] + frame @ fluid.position[k] - rotation @ center, rotation

    return place_pieces(make_pieces(robot.morphology) if pieces is None else pieces, place)


def choose_poses(time: np.ndarray, path: np.ndarray, length: float) -> list[int]:
    """Rows of a trajectory at equal times that can be told apart.

    Args:
        time: `[T]` [s].
        path: `[T, 3]` of the core [m].
        length: of the body [m].

    Returns:
        At most six rows from the first to the last; only the last where the robot stayed.
    """
    for count in range(_MOST, 1, -1):
        moments = np.linspace(time[0], time[-1], count)
        rows = np.abs(time[:, None] - moments).argmin(axis=0)
        apart = np.linalg.norm(path[rows, None] - path[rows], axis=-1) / length
        apart[np.diag_indices(count)] = np.inf
        if apart.min() >= (_APART if count > 2 else _PAIR):
            return rows.tolist()
    return [len(time) - 1]


def stroke_period(time: np.ndarray, angles: np.ndarray) -> float | None:
    """Period of the strokes, from the strongest frequency of all hinges together.

    Args:
        time: `[T]` [s], equal steps.
        angles: `[T, nhinge]` [rad].

    Returns:
        The period [s]; None where the hinges do not repeat themselves.
    """
    late = slice(len(time) // 3, None)  # the beginning is no steady stroke
    time, angles = time[late], angles[late]
    count = len(time)
    if count < 16 or angles.shape[1] == 0 or np.ptp(angles, axis=0).max() < 0.02:
        return None
    step = float(time[-1] - time[0]) / (count - 1)
    waves = (angles - angles.mean(axis=0)) * np.hanning(count)[:, None]
    power = (np.abs(np.fft.rfft(waves, 16 * count, axis=0)) ** 2).sum(axis=1)
    power[: 16 * 2] = 0.0  # fewer than two periods in the record are no period
    period = 16 * count * step / int(power.argmax())
    lag = round(period / step)
    if lag < 4:
        return None
    late, early = angles[lag:] - angles.mean(axis=0), angles[:-lag] - angles.mean(axis=0)
    alike = (late * early).sum() / max(math.sqrt((late**2).sum() * (early**2).sum()), 1e-12)
    return period if alike >= _REPEATS else None


def smooth_path(time: np.ndarray, path: np.ndarray, period: float | None) -> np.ndarray:
    """A path without the to and fro of the strokes.

    Args:
        time: `[T]` [s], equal steps.
        path: `[T, 3]` [m].
        period: of the strokes [s]; None: one second.

    Returns:
        `[T, 3]` mean over one stroke around each row, over less towards the path's two ends [m].
    """
    count = len(path)
    step = float(time[-1] - time[0]) / max(count - 1, 1)
    half = round(0.5 * (period or 1.0) / max(step, 1e-9))
    rows = np.arange(count)
    reach = np.minimum(half, np.minimum(rows, count - 1 - rows))
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(path, axis=0)])
    return (total[rows + reach + 1] - total[rows - reach]) / (2 * reach + 1)[:, None]


@dataclass(frozen=True)
class _Swim:
    """What the page shows of a trajectory."""

    robot: Robot
    time: np.ndarray  # [T] s
    qpos: np.ndarray  # [T, nq]
    pieces: list[Piece]

    @property
    def path(self) -> np.ndarray:
        """Of the core: `[T, 3]` [m]."""
        return self.qpos[:, :3]

    def scene(self, row: int) -> Scene:
        """The robot in one row of the trajectory."""
        return pose_scene(self.robot, self.qpos[row], self.pieces)

    @property
    def length(self) -> float:
        """Of the body [m]."""
        return self.robot.morphology.length

    @property
    def along(self) -> np.ndarray:
        """Unit vector of the way in the horizontal plane: `[2]`."""
        net = self.path[-1, :2] - self.path[0, :2]
        size = float(np.linalg.norm(net))
        # Who only drifted to and fro is shown along x.
        return net / size if size > 0.05 * self.length else np.array([1.0, 0.0])


# --- the water ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Panel:
    """A view into the water: pixels of a panel against the world."""

    view: np.ndarray  # [3, 3] right, up, towards the viewer
    low: np.ndarray  # [2] lower left corner in the view [m]
    pixel: float  # [m]
    size: tuple[int, int]  # columns, rows

    def pixels(self, points: Any) -> np.ndarray:
        """Where points `[..., 3]` of the world lie: `[..., 2]` pixels from the lower left."""
        return (np.asarray(points, float) @ self.view[:2].T - self.low) / self.pixel

    def grid(self) -> np.ndarray:
        """Right and up in the view of all pixels' centres: `[rows, columns, 2]` [m]."""
        axes = [self.low[k] + self.pixel * (np.arange(self.size[k]) + 0.5) for k in (0, 1)]
        return np.stack(np.meshgrid(*axes), axis=-1)


def _fit(
    view: np.ndarray, points: np.ndarray, size: tuple[int, int], margins: Sequence[float]
) -> _Panel:
    """The panel that shows points `[n, 3]` within margins: left, right, bottom, top [pixels]."""
    flat = points @ view[:2].T
    low, high = flat.min(axis=0), flat.max(axis=0)
    left, right, bottom, top = margins
    room = np.array([size[0] - left - right, size[1] - bottom - top])
    pixel = float(np.max((high - low) / room))
    corner = (low + high) / 2 - pixel * (np.array([left, bottom]) + room / 2)
    return _Panel(view, corner, pixel, size)


def _on_plane(view: np.ndarray, flat: np.ndarray, height: float, slope: np.ndarray) -> np.ndarray:
    """Where the lines of sight `[..., 2]` (right, up) meet z = height + slope · (x, y).

    Returns:
        x and y of the points, `[..., 2]` [m].
    """
    base, towards = flat @ view[:2], view[2]
    rise = height + base[..., :2] @ slope - base[..., 2]
    return base[..., :2] + (rise / (towards[2] - towards[:2] @ slope))[..., None] * towards[:2]


def _smooth(value: np.ndarray) -> np.ndarray:
    """0 below 0, 1 above 1, a smooth step between."""
    value = np.clip(value, 0.0, 1.0)
    return value * value * (3.0 - 2.0 * value)


@dataclass(frozen=True)
class _Region:
    """The part of a horizontal plane around the robot's way that is worth showing."""

    along: np.ndarray  # [2] unit vector of the way
    low: np.ndarray  # [2] along and across the way [m]
    high: np.ndarray  # [2]
    fade: float  # how far beyond it the plane is lost in the haze [m]

    def split(self, xy: np.ndarray) -> np.ndarray:
        """Coordinates along the way and across it, towards the viewer: `[..., 2]` [m]."""
        across = np.array([self.along[1], -self.along[0]])
        return np.stack([xy @ self.along, xy @ across], axis=-1)

    def point(self, along: float, across: float, z: float) -> np.ndarray:
        """The point of the world at these coordinates: `[3]` [m]."""
        x, y = along * self.along + across * np.array([self.along[1], -self.along[0]])
        return np.array([x, y, z])

    def shown(self, xy: np.ndarray) -> np.ndarray:
        """1 in the region, 0 far from it."""
        split = self.split(xy)
        beyond = np.maximum(np.maximum(self.low - split, split - self.high), 0.0)
        return 1.0 - _smooth(np.linalg.norm(beyond, axis=-1) / self.fade)


def _open_water(size: tuple[int, int]) -> np.ndarray:
    """Colours `[rows, columns, 3]` of open water: light from above, darker below."""
    columns, rows = size
    up = np.linspace(0.0, 1.0, rows)[:, None, None]
    side = np.linspace(-1.0, 1.0, columns)[:, None]
    return _LOW_WATER + (_HIGH_WATER - _LOW_WATER) * np.clip(up - 0.05 * side**2, 0.0, 1.0)


def _lay(image: np.ndarray, color: Any, alpha: np.ndarray) -> None:
    """Lays a colour over an image, in place."""
    image += alpha[..., None] * (np.asarray(color) - image)


def _draw_ground(
    image: np.ndarray,
    panel: _Panel,
    region: _Region,
    ground: tuple[float, np.ndarray],
    scenes: Sequence[Scene],
    fades: np.ndarray,
    sand: bool,
) -> None:
    """Lays the ground over the water: sand or open water, a grid and the robot's shadows."""
    xy = _on_plane(panel.view, panel.grid(), *ground)
    shown = region.shown(xy)
    if sand:
        _lay(image, _SAND, 0.85 * shown)
    split = region.split(xy)
    step = float(np.diff(_round_values(0.0, float((region.high - region.low).max()), 12))[0])
    for k in (0, 1):
        cells = split[..., k] / step
        # Distance to the nearest line in pixels: lines are a pixel wide at any slant.
        rate = np.hypot(*np.gradient(cells))
        line = np.clip(1.1 - np.abs(cells - np.round(cells)) / rate, 0.0, 1.0)
        _lay(image, (1.0, 1.0, 1.0), 0.75 * line * shown)
    for scene, fade in zip(scenes, fades, strict=True):
        low = scene.corners[..., :2].min((0, 1)) - 0.05
        shape = np.ceil((scene.corners[..., :2].max((0, 1)) + 0.05 - low) / 0.002).astype(int)
        covered = draw_scene(scene, np.eye(3), low, low + 0.002 * shape, 0.002)[0][..., 3]
        shade = gaussian_filter(covered, 0.012 / 0.002)
        place = (xy - low) / 0.002 - 0.5
        shadow = map_coordinates(shade, [place[..., 1], place[..., 0]], order=1)
        _lay(image, (0.06, 0.22, 0.34), 0.30 * fade * shadow * shown)


def _sheet(xy: np.ndarray, region: _Region) -> np.ndarray:
    """How much of the water's surface is seen at points x, y `[..., 2]`: its sheen and ripples."""
    waves = np.zeros(xy.shape[:-1])
    for length, angle, phase in _RIPPLES:
        waves += np.sin(xy @ (math.cos(angle), math.sin(angle)) * (2 * math.pi / length) + phase)
    return region.shown(xy) * (0.16 + 0.40 * np.exp(-6.0 * waves**2))


def _draw_pose(
    layer: np.ndarray,
    panel: _Panel,
    scene: Scene,
    opacity: float,
    span: tuple[float, float],
    surface: tuple[float, _Region] | None,
) -> None:
    """Lays the robot over a layer, in place.

    Args:
        layer: `[rows, columns, 4]` red, green, blue times alpha, and alpha.
        panel: where it lies.
        scene: the robot.
        opacity: 0 to 1.
        span: farthest and nearest depth of all that is shown, towards the viewer [m].
        surface: height of the water's surface [m] and what is seen of it.
    """
    haze = _open_water(panel.size)[:, panel.size[0] // 2]

    def tint(color: np.ndarray, place: np.ndarray) -> np.ndarray:
        row = np.clip((place[:, 0, 1] - panel.low[1]) / panel.pixel, 0, panel.size[1] - 1)
        far = np.clip((span[1] - place[..., 2]) / max(span[1] - span[0], 1e-9), 0.0, 1.0)
        _lay(color, haze[row.astype(int)][:, None], _HAZE * far)
        if surface is not None:
            height, region = surface
            xy = _on_plane(panel.view, place[..., :2], height, np.zeros(2))
            z = np.where(np.isfinite(place), place, 0.0) @ panel.view[:, 2]
            _lay(color, (1.0, 1.0, 1.0), _sheet(xy, region) * (z < height))
        return color

    # Whole pixels of the panel, so that nothing is resampled.
    points = panel.pixels(scene.corners.reshape(-1, 3))
    first = np.maximum(np.floor(points.min(axis=0)).astype(int) - 3, 0)
    last = np.minimum(np.ceil(points.max(axis=0)).astype(int) + 3, panel.size)
    if (last <= first + 2).any():
        return
    # The picture has a pixel more than the number that fits.
    low, high = (panel.low + panel.pixel * k for k in (first, last - 1.5))
    drawn, _ = draw_scene(scene, panel.view, low, high, panel.pixel, tint)
    drawn[..., 3] *= opacity
    drawn[..., :3] *= drawn[..., 3:]
    below = layer[first[1] : first[1] + len(drawn), first[0] : first[0] + drawn.shape[1]]
    below *= 1.0 - drawn[..., 3:]
    below += drawn


# --- marks --------------------------------------------------------------------------------------


def _round_values(low: float, high: float, count: int) -> np.ndarray:
    """Round values from just below `low` to just above `high`."""
    return np.asarray(MaxNLocator(nbins=count, steps=[1, 2, 5, 10]).tick_values(low, high))


def _panel_axes(figure: Figure, left: int, bottom: int, size: tuple[int, int]) -> Axes:
    """Axes whose units are the pixels of the page, `size` of them from its corner."""
    width, height = _PAGE
    box = (left / width, bottom / height, size[0] / width, size[1] / height)
    axes = figure.add_axes(box)
    axes.set_axis_off()
    axes.set_xlim(0, size[0])
    axes.set_ylim(0, size[1])
    return axes


def _show_image(axes: Axes, image: np.ndarray, zorder: float) -> None:
    """Puts an image, pixel for pixel, into axes of `_panel_axes`."""
    rows, columns = image.shape[:2]
    image = np.clip(image, 0.0, 1.0)
    if image.shape[2] == 4:
        image[..., :3] /= np.maximum(image[..., 3:], 1e-6)
        image = np.clip(image, 0.0, 1.0)
    limits = axes.axis()
    extent = (0, columns, 0, rows)
    axes.imshow(image, extent=extent, origin="lower", interpolation="nearest", aspect="auto",
                zorder=zorder)  # fmt: skip
    axes.axis(limits)


class _Places:
    """Which pixels of a panel are taken, so that no word lies on another or on the robot."""

    def __init__(self, axes: Axes, taken: np.ndarray):
        self.axes = axes
        self.taken = taken  # [rows, columns] bool

    def extent(self, text: Text) -> np.ndarray:
        """Lower left and upper right corner of a text: `[2, 2]` [pixels of the panel]."""
        box = text.get_window_extent(cast(FigureCanvasAgg, text.figure.canvas).get_renderer())
        return self.axes.transData.inverted().transform(box.get_points())

    def _window(self, low: np.ndarray, high: np.ndarray) -> tuple[slice, slice]:
        (left, bottom), (right, top) = (np.maximum(np.round(k).astype(int), 0) for k in (low, high))
        return slice(bottom, top + 1), slice(left, right + 1)

    def free(self, low: np.ndarray, high: np.ndarray, pad: int) -> bool:
        """Whether a box lies in the panel with nothing else within `pad` of it."""
        rows, columns = self.taken.shape
        inside = min(low) >= pad and high[0] < columns - pad and high[1] < rows - pad
        return bool(inside and not self.taken[self._window(low - pad, high + pad)].any())

    def take(self, low: np.ndarray, high: np.ndarray) -> None:
        """Marks a box."""
        self.taken[self._window(low, high)] = True

    def take_line(self, points: np.ndarray) -> None:
        """Marks a line `[n, 2]` and three pixels on both sides of it."""
        for start, end in pairwise(points):
            count = int(min(np.abs(end - start).max() // 3, 1000)) + 2
            for point in np.linspace(start, end, count):
                self.take(point - 3, point + 3)

    def put(self, text: Text, spots: Sequence[Sequence[float]]) -> None:
        """Moves a text to the first of the spots that is free; removes it where none is."""
        for spot in spots:
            text.set_position((spot[0], spot[1]))
            low, high = self.extent(text)
            if self.free(low, high, 6):
                self.take(low, high)
                return
        text.remove()


def _write(axes: Axes, spot: Sequence[float], words: str, **style: Any) -> Text:
    """Words with a pale rim, so that they can be read on any ground."""
    look: dict[str, Any] = {"fontsize": 11, "color": _INK, "ha": "center", "va": "center"}
    rim = [withStroke(linewidth=2.5, foreground=(1, 1, 1, 0.55))]
    return axes.text(spot[0], spot[1], words, path_effects=rim, zorder=8, **(look | style))


def _scale_bars(axes: Axes, panel: _Panel, swim: _Swim, places: _Places) -> None:
    """Bars of a round number of metres and of one body length, parallel to the way.

    In a parallel projection they may lie anywhere: where the lower left corner is free. If there is
    no room for both, the first has to do, or a shorter one; over the robot they would be read
    wrongly.
    """
    rounds = _round_values(0.0, swim.length, 4)
    metres = [float(x) for x in rounds[(rounds > 0) & (rounds <= 1.001 * swim.length)]]
    bars = [(x, f"{x:g} m") for x in metres]
    own = (swim.length, f"1 body length ({swim.length:.2g} m)")
    unit = np.subtract(*panel.pixels([[*swim.along, 0.0], [0.0, 0.0, 0.0]]))  # pixels per metre
    for sizes in ((bars[-1], own), bars[-1:], bars[:1]):
        marks = _scale_marks(axes, unit, sizes)
        corners = np.concatenate(
            [line for _, line in marks] + [places.extent(text) for text, _ in marks]
        )
        low, high = corners.min(axis=0), corners.max(axis=0)
        columns, rows = panel.size
        # Columns first: better further right than up beside the robot.
        spots = (
            np.array([x, y]) for y in range(16, rows // 3, 8) for x in range(20, columns // 2, 24)
        )
        spot = next((s for s in spots if places.free(s, s + high - low, 8)), None)
        if spot is None:
            for text, _ in marks:
                text.remove()
            continue
        shift = spot - low
        places.take(low + shift, high + shift)
        for text, line in marks:
            text.set_position(np.asarray(text.get_position()) + shift)
            axes.plot(*(line + shift).T, color=_INK, lw=1.8, solid_capstyle="butt",
                      solid_joinstyle="miter", zorder=7)  # fmt: skip
        return


def _scale_marks(
    axes: Axes, unit: np.ndarray, sizes: Sequence[tuple[float, str]]
) -> list[tuple[Any, np.ndarray]]:
    """Texts and lines of bars from a common origin; `unit` are pixels per metre, `[2]`."""
    angle = math.degrees(math.atan2(unit[1], unit[0]))
    ahead = unit / np.linalg.norm(unit)
    across = np.array([ahead[1], -ahead[0]])
    marks = []
    for k, (size, label) in enumerate(sizes):
        start = 26 * k * across
        end = start + size * unit
        text = _write(axes, end + 12 * ahead, label, ha="left", rotation=angle,
                      rotation_mode="anchor")  # fmt: skip
        tick = 5 * across
        line = np.array([start - tick, start + tick, start, end, end - tick, end + tick])
        marks.append((text, line))
    return marks


def _depth_scale(
    axes: Axes, panel: _Panel, foot: np.ndarray, top: float, surface: float
) -> list[Text]:
    """An upright rod with the depth below the surface.

    Args:
        axes: of the panel.
        panel: its view.
        foot: `[3]` its lower end [m].
        top: height of its upper end [m].
        surface: height of the water's surface [m].

    Returns:
        The words beside it.
    """
    head = np.array([foot[0], foot[1], top])
    a, b = panel.pixels([foot, head])
    axes.plot(*np.array([a, b]).T, color=_INK, lw=1.2, zorder=2)
    values = _round_values(surface - top, surface - foot[2], 3)
    values = values[(values >= surface - top) & (values <= surface - foot[2])]
    decimals = 0 if len(values) < 2 else max(0, -math.floor(math.log10(np.diff(values)[0] * 1.001)))
    words = []
    for depth in values:
        x, y = panel.pixels([foot[0], foot[1], surface - depth])
        axes.plot([x - 5, x], [y, y], color=_INK, lw=1.2, zorder=2)
        words.append(_write(axes, (x - 9, y), f"{depth:.{decimals}f} m", ha="right"))
    words.append(_write(axes, (b[0], b[1] + 13), "depth", color=_SOFT))
    return words


# --- the page -----------------------------------------------------------------------------------


def _ground(robot: Robot, points: np.ndarray) -> tuple[float, np.ndarray, bool]:
    """The plane below the robot: height at the origin [m], slope [2], and whether it is the bed."""
    length, bed = robot.morphology.length, robot.world.bed
    lowest = float(points[:, 2].min())
    if bed is not None:
        place = points[:, :2].mean(axis=0)
        slope = np.array([float(k) for k in bed_slope(bed, *place)])
        height = float(bed_height(bed, *place)) - float(slope @ place)
        if (points[:, 2] - height - points[:, :2] @ slope).min() < 0.6 * length:
            return height, slope, True
    return lowest - 0.08 * length, np.zeros(2), False


def _draw_way(
    figure: Figure, swim: _Swim, view: np.ndarray, period: float | None, bottom: int
) -> None:
    """The large picture: the robot in several poses along its way."""
    world, length = swim.robot.world, swim.length
    size = (_PAGE[0] - 2 * _LEFT, _PAGE[1] - _TOP - bottom)
    rows = choose_poses(swim.time, swim.path, length)
    scenes = [swim.scene(row) for row in rows]
    points = np.concatenate([*(scene.corners.reshape(-1, 3) for scene in scenes), swim.path])
    height, slope, sand = _ground(swim.robot, points)
    region = _Region(swim.along, np.zeros(2), np.zeros(2), 0.9 * length)
    split = region.split(points[:, :2])
    region = replace(region, low=split.min(axis=0), high=split.max(axis=0))

    low, top = float(points[:, 2].min()), float(points[:, 2].max())
    surface = (world.surface_height, region) if world.surface_height < top + 0.3 * length else None
    start = region.split(swim.path[0, :2])
    foot = region.point(region.low[0] - 0.06 * length, start[1], low)
    if surface is None:
        marks = [foot, (*foot[:2], top)]
    else:
        marks = [region.point(start[0], start[1], world.surface_height)]
    panel = _fit(view, np.concatenate([points, marks]), size, (84, 46, 34, 40))

    image = _open_water(size)
    opacity = np.linspace(0.45, 1.0, len(scenes)) if len(scenes) > 1 else np.ones(1)
    _draw_ground(image, panel, region, (height, slope), scenes, opacity, sand)
    if surface is not None:
        xy = _on_plane(view, panel.grid(), world.surface_height, np.zeros(2))
        _lay(image, (1.0, 1.0, 1.0), _sheet(xy, region))
    depth = points @ view[2]
    layer = np.zeros((*image.shape[:2], 4))
    for scene, share in zip(scenes, opacity, strict=True):
        _draw_pose(layer, panel, scene, float(share), (depth.min(), depth.max()), surface)
    axes = _panel_axes(figure, _LEFT, bottom, size)
    _show_image(axes, image, zorder=1)
    _show_image(axes, layer, zorder=3)

    places = _Places(axes, layer[..., 3] > 0.02)
    # The same line once behind the robots and once, faintly, in front of them.
    way, steady = panel.pixels(swim.path), panel.pixels(smooth_path(swim.time, swim.path, period))
    axes.plot(*way.T, color=_PATH, lw=0.9, alpha=0.6, zorder=2)
    axes.plot(*steady.T, color=_PATH, lw=2.6, solid_capstyle="round", zorder=2)
    axes.plot(*steady.T, color=_PATH, lw=1.4, alpha=0.7, solid_capstyle="round", zorder=4)
    axes.plot(*way[rows].T, "o", color="white", markeredgecolor=_PATH, markeredgewidth=2,
              markersize=7, zorder=5)  # fmt: skip
    if surface is None:
        for word in _depth_scale(axes, panel, foot, top, world.surface_height):
            places.take(*places.extent(word))
    places.take_line(way)
    _scale_bars(axes, panel, swim, places)
    for row, scene in zip(rows, scenes, strict=True):
        label = _write(axes, (0, 0), f"{swim.time[row]:.1f}".removesuffix(".0") + " s",
                       fontsize=14, fontweight="bold")  # fmt: skip
        x, y = way[row]
        reach = int(np.abs(panel.pixels(scene.corners.reshape(-1, 3)) - way[row]).max()) + 60
        spots = [(x + side, y + sign * up) for up in range(20, reach, 4) for sign in (1, -1)
                 for side in (0, 25, -25, 50, -50)]  # fmt: skip
        places.put(label, spots)
    if surface is not None:
        label = _write(axes, (0, 0), "water surface", color=_SOFT)
        spots = [(x, y) for y in range(size[1] - 20, 20, -10) for x in range(90, size[0] - 90, 20)]
        places.put(label, spots)


def _draw_stroke(figure: Figure, swim: _Swim, view: np.ndarray, period: float | None) -> None:
    """The strip: snapshots of one stroke, or of the last second."""
    time, world = swim.time, swim.robot.world
    span = min(1.0 if period is None else period, float(time[-1] - time[0]))
    moments = time[-1] - span + span * np.arange(_MOST) / _MOST
    rows = np.abs(time[:, None] - moments).argmin(axis=0)
    scenes = [swim.scene(row) for row in rows]
    places = swim.path[rows]
    size = ((_PAGE[0] - 2 * _LEFT - (_MOST - 1) * _GAP) // _MOST, _STRIP)
    around = np.concatenate(
        [scene.corners.reshape(-1, 3) - at for scene, at in zip(scenes, places, strict=True)]
    )
    home = _fit(view, around, size, (8, 8, 10, 26))
    depth = around @ view[2]
    for k, (scene, at) in enumerate(zip(scenes, places, strict=True)):
        panel = replace(home, low=home.low + view[:2] @ at)
        near = float(view[2] @ at)
        image = _open_water(size)
        surface = None
        if world.surface_height < float(scene.corners[..., 2].max()) + 0.3 * swim.length:
            here = _Region(swim.along, np.zeros(2), np.zeros(2), swim.length)
            here = replace(here, low=here.split(at[:2]), high=here.split(at[:2]))
            surface = (world.surface_height, here)
            xy = _on_plane(view, panel.grid(), world.surface_height, np.zeros(2))
            _lay(image, (1.0, 1.0, 1.0), _sheet(xy, here))
        layer = np.zeros((size[1], size[0], 4))
        _draw_pose(layer, panel, scene, 1.0, (near + depth.min(), near + depth.max()), surface)
        axes = _panel_axes(figure, _LEFT + k * (size[0] + _GAP), _LEFT, size)
        _show_image(axes, image * (1.0 - layer[..., 3:]) + layer[..., :3], zorder=1)
        late = f"+{time[rows[k]] - time[rows[0]]:.2f} s" if k else f"{time[rows[0]]:.2f} s"
        _write(axes, (12, size[1] - 17), late, ha="left")
    words = "the last second" if period is None else f"one stroke of {period:.2f} s"
    figure.text(_LEFT / _PAGE[0], (_LEFT + _STRIP + 19) / _PAGE[1],
                f"{words.capitalize()}, seen by a camera that follows the core",
                fontsize=12, color=_INK, va="center")  # fmt: skip


def _headline(swim: _Swim) -> str:
    """Who, and how fast from the first row to the last."""
    name = str(swim.robot.morphology.name)
    seconds = float(swim.time[-1] - swim.time[0])
    if seconds <= 0.0:
        return name
    speed = float(np.linalg.norm(swim.path[-1] - swim.path[0])) / seconds
    return f"{name}: {speed / swim.length:.2g} body lengths/s ({speed:.2g} m/s)"


def _facts(swim: _Swim) -> str:
    """How far and how long."""
    net = float(np.linalg.norm(swim.path[-1] - swim.path[0]))
    return (
        f"{net:.2g} m ({net / swim.length:.2g} body lengths) in "
        f"{swim.time[-1] - swim.time[0]:.3g} s, getting under way included"
    )


def plot_swim(robot: Robot, trajectory: Trajectory) -> Figure:
    """Draws the way a robot swam.

    Args:
        robot: the robot.
        trajectory: what it did: `time` `[T]` [s] and `qpos` `[T, nq]`. Rows after the first that
            is not finite are left out.

    Returns:
        The figure: poses along the way with the core's path, and below them six snapshots of one
        stroke where the robot has hinges.

    Raises:
        InputError: the trajectory is another robot's, or has no finite row.
    """
    time = np.atleast_1d(np.asarray(trajectory.time, np.float64))
    qpos = np.asarray(trajectory.qpos, np.float64)
    expected = (len(time), robot.mj_model.nq)
    if qpos.shape != expected:
        raise InputError(
            f"trajectory.qpos: expected {list(expected)} [T, nq]; found {list(qpos.shape)}"
        )
    finite = np.asarray(np.isfinite(qpos).all(axis=1))
    count = len(finite) if finite.all() else int(finite.argmin())
    if count == 0:
        raise InputError("trajectory.qpos: expected finite numbers in its first row; found none")
    swim = _Swim(robot, time[:count], qpos[:count], make_pieces(robot.morphology))

    width, height = _PAGE
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    heading = math.degrees(math.atan2(swim.along[1], swim.along[0]))
    view = make_view(heading - 90.0 + _TOWARDS, _ELEVATION)
    period = stroke_period(swim.time, swim.qpos[:, 7:])
    strip = robot.num_hinges > 0 and count > 1
    if strip:
        _draw_stroke(figure, swim, view, period)
    _draw_way(figure, swim, view, period, _LEFT + (_STRIP + 38 if strip else 0))

    left, line = _LEFT / width, 1.0 - 0.5 * _TOP / height
    figure.text(left, line, _headline(swim), fontsize=17, color=_INK, va="center")
    figure.text(1.0 - left, line, _facts(swim), fontsize=12, color=_SOFT, ha="right", va="center")
    return figure


def draw_swim(robot: Robot, trajectory: Trajectory, path: str | Path) -> None:
    """Draws the way a robot swam into a PNG of 1600 x 900 pixels; see `plot_swim`.

    The file appears whole or not at all.

    Args:
        robot: the robot.
        trajectory: what it did.
        path: where to write the PNG.

    Raises:
        InputError: `path` does not end in `.png`, its folder does not exist, or it cannot be
            written; the trajectory is another robot's, or has no finite row.
    """
    path = check_picture_path(path)
    write_figure(plot_swim(robot, trajectory), path)
