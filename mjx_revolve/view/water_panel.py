"""A view into the water: its colours, the ground and the surface, and robots in it.

Drawn as arrays of pixels with the depth buffer of `raster`, row 0 the lowest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import gaussian_filter, map_coordinates

from mjx_revolve.view.pieces import Scene
from mjx_revolve.view.raster import draw_scene

_HIGH_WATER, _LOW_WATER = np.array([0.925, 0.968, 0.985]), np.array([0.52, 0.745, 0.86])
_SAND = np.array([0.80, 0.74, 0.58])
_WHITE, _SHADE = (1.0, 1.0, 1.0), (0.06, 0.22, 0.34)
_HAZE = 0.34  # share of the water's colour in the farthest thing that is shown
# Length [m], direction and phase of wave trains that together make no visible pattern.
_RIPPLES = ((0.16, 0.4, 0.0), (0.11, 1.9, 1.3), (0.13, 3.0, 4.1), (0.07, 5.1, 2.2))
# Shadows are drawn from above with pixels of this size, and blurred by the second number [m].
_SHADOW, _BLUR = 0.002, 0.012


def round_values(low: float, high: float, count: int) -> np.ndarray:
    """At most about `count` round values from just below `low` to just above `high`."""
    return np.asarray(MaxNLocator(nbins=count, steps=[1, 2, 5, 10]).tick_values(low, high))


@dataclass(frozen=True)
class Panel:
    """A parallel projection: pixels of a panel against the world.

    Attributes:
        view: `[3, 3]` right, up, towards the viewer, from `make_view`.
        low: `[2]` lower left corner in the view [m].
        pixel: size of a pixel [m].
        size: columns, rows.
    """

    view: np.ndarray
    low: np.ndarray
    pixel: float
    size: tuple[int, int]

    def pixels(self, points: Any) -> np.ndarray:
        """Where points `[..., 3]` of the world lie: `[..., 2]` pixels from the lower left."""
        return (np.asarray(points, float) @ self.view[:2].T - self.low) / self.pixel

    def plane(self, height: float, slope: np.ndarray) -> np.ndarray:
        """Where each pixel's line of sight meets z = height + slope · (x, y): `[rows, columns, 2]`.

        Args:
            height: of the plane at the origin [m].
            slope: `[2]` along x and y.

        Returns:
            x and y [m].
        """
        axes = [self.low[k] + self.pixel * (np.arange(self.size[k]) + 0.5) for k in (0, 1)]
        return on_plane(self.view, np.stack(np.meshgrid(*axes), axis=-1), height, slope)


def fit_panel(
    view: np.ndarray, points: np.ndarray, size: tuple[int, int], margins: Sequence[float]
) -> Panel:
    """The panel that shows points `[n, 3]` within margins: left, right, bottom, top [pixels]."""
    flat = points @ view[:2].T
    low, high = flat.min(axis=0), flat.max(axis=0)
    left, right, bottom, top = margins
    room = np.array([size[0] - left - right, size[1] - bottom - top])
    pixel = float(np.max((high - low) / room))
    corner = (low + high) / 2 - pixel * (np.array([left, bottom]) + room / 2)
    return Panel(view, corner, pixel, size)


def on_plane(view: np.ndarray, flat: np.ndarray, height: float, slope: np.ndarray) -> np.ndarray:
    """Where lines of sight `[..., 2]` (right, up [m]) meet a plane, see `Panel.plane`."""
    base, towards = flat @ view[:2], view[2]
    rise = height + base[..., :2] @ slope - base[..., 2]
    return base[..., :2] + (rise / (towards[2] - towards[:2] @ slope))[..., None] * towards[:2]


@dataclass(frozen=True)
class Region:
    """The part of a horizontal plane around the robot's way that is worth showing.

    Attributes:
        along: `[2]` unit vector of the way.
        low: `[2]` along and across the way [m].
        high: `[2]` likewise.
        fade: how far beyond it the plane is lost in the haze [m].
    """

    along: np.ndarray
    low: np.ndarray
    high: np.ndarray
    fade: float

    def split(self, xy: np.ndarray) -> np.ndarray:
        """Coordinates along the way and across it, towards the viewer: `[..., 2]` [m]."""
        return xy @ _axes_of(self.along)

    def shown(self, xy: np.ndarray) -> np.ndarray:
        """1 at points `[..., 2]` in the region, 0 far from it."""
        split = self.split(xy)
        beyond = np.maximum(np.maximum(self.low - split, split - self.high), 0.0)
        out = np.clip(np.linalg.norm(beyond, axis=-1) / self.fade, 0.0, 1.0)
        return 1.0 - out * out * (3.0 - 2.0 * out)  # a smooth step


def _axes_of(along: np.ndarray) -> np.ndarray:
    """Along the way and across it as columns."""
    return np.array([[along[0], along[1]], [along[1], -along[0]]])


def region_around(along: np.ndarray, points: np.ndarray, fade: float) -> Region:
    """The region that holds points `[n, 2]` of the plane; see `Region`."""
    split = points @ _axes_of(along)
    return Region(along, split.min(axis=0), split.max(axis=0), fade)


@dataclass(frozen=True)
class Surface:
    """The water's surface, as far as it is in sight: its height [m] and where it is shown."""

    height: float
    region: Region

    def sheen(self, xy: np.ndarray) -> np.ndarray:
        """How much of it is seen at points x, y `[..., 2]`: its sheen and ripples."""
        waves = np.zeros(xy.shape[:-1])
        for length, angle, phase in _RIPPLES:
            ahead = xy @ (math.cos(angle), math.sin(angle))
            waves += np.sin(ahead * (2 * math.pi / length) + phase)
        return self.region.shown(xy) * (0.16 + 0.40 * np.exp(-6.0 * waves**2))


def open_water(size: tuple[int, int]) -> np.ndarray:
    """Colours `[rows, columns, 3]` of open water: light from above, darker below."""
    columns, rows = size
    up = np.linspace(0.0, 1.0, rows)[:, None, None]
    side = np.linspace(-1.0, 1.0, columns)[:, None]
    return _LOW_WATER + (_HIGH_WATER - _LOW_WATER) * np.clip(up - 0.05 * side**2, 0.0, 1.0)


def _lay(image: np.ndarray, color: Any, alpha: np.ndarray) -> None:
    """Lays a colour over an image, in place."""
    image += alpha[..., None] * (np.asarray(color) - image)


def draw_ground(
    image: np.ndarray,
    panel: Panel,
    region: Region,
    ground: tuple[float, np.ndarray, bool],
    scenes: Sequence[Scene],
    fades: np.ndarray,
) -> None:
    """Lays the ground over the water, in place: sand or open water, a grid, the robot's shadows.

    Args:
        image: `[rows, columns, 3]`.
        panel: where it lies.
        region: what is shown of the ground.
        ground: height at the origin [m], slope `[2]`, and whether it is sand.
        scenes: the robot in each pose.
        fades: how dark each one's shadow is, from 0 to 1.
    """
    height, slope, sand = ground
    xy = panel.plane(height, slope)
    shown = region.shown(xy)
    if sand:
        _lay(image, _SAND, 0.85 * shown)
    split = region.split(xy)
    step = float(np.diff(round_values(0.0, float((region.high - region.low).max()), 12))[0])
    for k in (0, 1):
        cells = split[..., k] / step
        # Distance to the nearest line in pixels: lines are a pixel wide at any slant.
        rate = np.hypot(*np.gradient(cells))
        line = np.clip(1.1 - np.abs(cells - np.round(cells)) / rate, 0.0, 1.0)
        _lay(image, _WHITE, 0.75 * line * shown)
    for scene, fade in zip(scenes, fades, strict=True):
        low = scene.corners[..., :2].min((0, 1)) - 0.05
        count = np.ceil((scene.corners[..., :2].max((0, 1)) + 0.05 - low) / _SHADOW)
        covered = draw_scene(scene, np.eye(3), low, low + _SHADOW * count, _SHADOW)[0][..., 3]
        shade = gaussian_filter(covered, _BLUR / _SHADOW)
        place = (xy - low) / _SHADOW - 0.5
        shadow = map_coordinates(shade, [place[..., 1], place[..., 0]], order=1)
        _lay(image, _SHADE, 0.30 * fade * shadow * shown)


def draw_surface(image: np.ndarray, panel: Panel, surface: Surface) -> None:
    """Lays the water's surface, seen from above, over an image, in place."""
    _lay(image, _WHITE, surface.sheen(panel.plane(surface.height, np.zeros(2))))


def draw_pose(
    layer: np.ndarray,
    panel: Panel,
    scene: Scene,
    opacity: float,
    span: tuple[float, float],
    surface: Surface | None,
) -> None:
    """Lays the robot over a layer, in place.

    Args:
        layer: `[rows, columns, 4]` red, green, blue times alpha, and alpha.
        panel: where it lies.
        scene: the robot.
        opacity: 0 to 1.
        span: farthest and nearest depth of all that is shown, towards the viewer [m].
        surface: what is seen of the water's surface, or None.
    """
    haze = open_water(panel.size)[:, panel.size[0] // 2]

    def tint(color: np.ndarray, place: np.ndarray) -> np.ndarray:
        row = np.clip((place[:, 0, 1] - panel.low[1]) / panel.pixel, 0, panel.size[1] - 1)
        far = np.clip((span[1] - place[..., 2]) / max(span[1] - span[0], 1e-9), 0.0, 1.0)
        _lay(color, haze[row.astype(int)][:, None], _HAZE * far)
        if surface is not None:
            xy = on_plane(panel.view, place[..., :2], surface.height, np.zeros(2))
            z = np.where(np.isfinite(place), place, 0.0) @ panel.view[:, 2]
            _lay(color, _WHITE, surface.sheen(xy) * (z < surface.height))
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
