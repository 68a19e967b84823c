"""Where the camera stands while it follows a robot: numbers in, numbers out.

The whole way is known before the first picture is drawn, so the camera can glide along it without
lagging behind: it looks at the robot's place averaged over strokes, from one side, and far enough
off that the robot stays in frame whatever it does in between. It never passes through the surface
or the bed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

# Angle of view, upright [rad].
FOVY = math.radians(40.0)
# The camera's path is smoothed over this long, less where the robot would leave the frame [s].
_SMOOTHING = (1.0, 0.6, 0.35, 0.2, 0.1, 0.05)
# How far the robot may get from where the camera looks, in its own radii.
_STRAY = 0.6
# Share of the frame's smaller half that robot and its to and fro fill at most.
_FILL = 0.66
# The camera's height above the robot's horizon where the bed is near, and elsewhere, where more is
# to be seen above than below [rad].
_HIGH, _LEVEL = math.radians(17.0), math.radians(5.0)
# How far the robot moves towards the viewer, not straight across [rad].
_TOWARDS = math.radians(24.0)
# The bed is near within so many distances of the camera from the robot.
_NEAR_BED = 4.0
# How far above the robot's middle the camera looks, in shares of what it sees upright.
_HEADROOM = 0.07
# The steepest that a camera in the air looks down, and one in the water may have to [rad].
_STEEP = math.radians(42.0)
# Between camera and surface or bed, in shares of the distance to the robot.
_AIR = 0.16
# Of many robots: how steeply they are looked down at [rad], how fast the camera goes around them
# [rad/s], and over how long their middle is averaged [s].
_DOWN, _ROUND, _DRIFT = math.radians(45.0), math.radians(3.0), 4.0
# The share of them within the disc that fills the frame, and the least that it is across [m].
_DISC_SHARE, _MIN_DISC = 0.75, 1.0
# The camera's distance in radii of that disc, and how far before its middle the camera looks, in
# distances: the near edge, seen larger, then is as far below the frame's middle as the far one
# above, 19.5 degrees by tan a = sin 45 / (2.2 - cos 45) and tan b = sin 45 / (2.2 + cos 45).
_DISC_DISTANCE, _AIM_BEFORE = 2.2, 0.13
# A robot is filmed from the air if its middle is less deep than this most of the time [radii].
_AFLOAT = 0.8


@dataclass(frozen=True)
class Shots:
    """A camera along a film.

    Attributes:
        position: `[F, 3]` world frame [m].
        target: `[F, 3]` what it looks at, world frame [m].
        above: whether it stands in the air.
        distance: usual distance from the robot [m].
    """

    position: np.ndarray
    target: np.ndarray
    above: bool
    distance: float

    def axes(self, frame: int) -> np.ndarray:
        """`[3, 3]` of a frame; its rows point right, up and along the view, world frame."""
        along = self.target[frame] - self.position[frame]
        along = along / np.linalg.norm(along)
        right = np.cross(along, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, along), along])

    def project(self, frame: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points appear.

        Args:
            frame: number of the frame.
            points: `[n, 3]` world frame [m].

        Returns:
            `[n, 2]` right and up of the frame's middle, 1 at its upper edge, and `[n]` distance
            along the view [m]. What lies behind the camera has a distance below 0.
        """
        right, up, depth = self.axes(frame) @ (points - self.position[frame]).T
        safe = np.where(np.abs(depth) > 1e-9, depth, 1e-9) * math.tan(FOVY / 2)
        return np.stack([right / safe, up / safe], axis=-1), depth


def plan_shots(
    time: np.ndarray,
    center: np.ndarray,
    radius: np.ndarray,
    *,
    aspect: float,
    surface: float,
    waves: float = 0.0,
    bed: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    along: tuple[float, float] = (1.0, 0.0),
) -> Shots:
    """Plans a camera that follows a robot.

    Args:
        time: `[F]` of the frames, equally spaced [s].
        center: `[F, 3]` middle of the robot, world frame [m].
        radius: `[F]` of a ball around it that holds the robot [m].
        aspect: width of the frame over its height.
        surface: z of the still surface [m].
        waves: the most that waves rise above it [m].
        bed: height of the bed at x and y `[n]` [m], or None.
        along: direction from which a robot that goes nowhere is not seen: its own long axis.

    Returns:
        The camera; the ball is inside every frame.
    """
    largest = float(radius.max())
    step = float(time[1] - time[0]) if len(time) > 1 else 1.0
    for calm in (*_SMOOTHING, 0.0):
        target = _smooth(center, calm / step) if calm else center
        stray = float(np.linalg.norm(target - center, axis=1).max())
        if stray <= _STRAY * largest:
            break
    half = math.atan(min(1.0, aspect) * math.tan(FOVY / 2))
    distance = (largest + stray) / (_FILL * math.sin(half))

    ahead = _heading(center, largest, along)
    side = np.array([ahead[1], -ahead[0]])
    stand = math.cos(_TOWARDS) * side + math.sin(_TOWARDS) * ahead
    depth = surface - center[:, 2]
    above = bool(np.median(depth) < _AFLOAT * largest)
    margin = _AIR * distance
    # Whether the bed is close below for half of the time.
    over_bed = np.inf if bed is None else np.median(center[:, 2] - bed(*center[:, :2].T))
    near = over_bed < _NEAR_BED * distance
    elevation = _HIGH if above or near else _LEVEL
    low: Any = surface + waves + margin if above else -np.inf
    high = np.inf if above else surface - waves - 0.5 * margin
    foot = target[:, :2] + distance * math.cos(elevation) * stand
    if bed is not None:
        # Also halfway, or a dune could stand between camera and robot.
        for share in (1.0, 0.5):
            at = target[:, :2] + share * (foot - target[:, :2])
            rise = bed(*at.T) + 0.6 * margin - target[:, 2]
            low = np.maximum(low, target[:, 2] + rise / share)
    # In a gap too narrow for both, rather through the surface than through the bed.
    height = np.maximum(np.minimum(target[:, 2] + distance * math.sin(elevation), high), low)
    height = _smooth(height[:, None], _SMOOTHING[2] / step)[:, 0]
    height = np.maximum(np.minimum(height, high), low)
    rise = height - target[:, 2]
    reach = np.maximum(distance, np.abs(rise) / math.sin(_STEEP))
    level = np.sqrt(np.maximum(reach**2 - rise**2, 0.0))
    position = np.concatenate([target[:, :2] + level[:, None] * stand, height[:, None]], axis=1)
    target = target + np.array([0.0, 0.0, _HEADROOM * 2 * distance * math.tan(FOVY / 2)])
    return Shots(position, target, above, distance)


def plan_circle(
    time: np.ndarray,
    places: np.ndarray,
    alive: np.ndarray,
    *,
    reach: float,
    aspect: float,
    surface: float,
    waves: float = 0.0,
    bed: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> Shots:
    """Plans a camera that circles over many robots, and looks down at them.

    Args:
        time: `[F]` of the frames, equally spaced [s].
        places: `[N, F, 3]` of the robots, world frame [m].
        alive: `[N, F]` whether they are there.
        reach: how far a robot reaches from its place [m].
        aspect: width of the frame over its height.
        surface: z of the still surface [m].
        waves: the most that waves rise above it [m].
        bed: height of the bed at x and y `[n]` [m], or None.

    Returns:
        The camera; most robots are inside every frame. It stands in the air or in the water,
        whichever takes it less from its height.
    """
    step = float(time[1] - time[0]) if len(time) > 1 else 1.0
    there = np.where(alive[..., None], places, np.nan)
    some = alive.any(axis=0)
    middle = np.zeros((len(time), 3))
    middle[some] = np.nanmedian(there[:, some], axis=0)
    # Where no robot is left, the camera stays.
    rows = np.maximum.accumulate(np.where(some, np.arange(len(time)), 0))
    target = _smooth(middle[rows], _DRIFT / step)
    away = np.linalg.norm((there - target)[..., :2], axis=-1)[alive]
    half = (float(np.quantile(away, _DISC_SHARE)) if away.size else 0.0) + reach
    # A frame that is less wide than high has to be farther off.
    distance = max(half, _MIN_DISC / 2) * _DISC_DISTANCE * max(1.0, 1.3 / aspect)
    margin = _AIR * distance
    height = target[:, 2] + distance * math.sin(_DOWN)
    low, high = surface + waves + margin, surface - waves - margin
    above = bool(np.median(height) > (low + high) / 2)
    height = np.maximum(height, low) if above else np.minimum(height, high)
    angle = _ROUND * (time - time[0]) - math.pi / 3
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    foot = target[:, :2] + distance * math.cos(_DOWN) * around
    if bed is not None:
        height = np.maximum(height, bed(*foot.T) + margin)
    target = target + _AIM_BEFORE * distance * np.c_[around, np.zeros(len(time))]
    return Shots(np.c_[foot, height], target, above, distance)


def _smooth(path: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian mean over rows that leaves straight lines as they are, ends included."""
    count = len(path)
    reach = min(int(4 * sigma) + 1, count - 1)
    padded = np.pad(path, [(reach, reach), (0, 0)], mode="reflect", reflect_type="odd")
    return gaussian_filter1d(padded, sigma, axis=0, mode="nearest")[reach : reach + count]


def _heading(center: np.ndarray, radius: float, along: tuple[float, float]) -> np.ndarray:
    """Unit vector `[2]` of the way as a whole; of the robot, where there is none."""
    net = center[-1, :2] - center[0, :2]
    if float(np.linalg.norm(net)) <= 0.1 * radius:
        net = np.asarray(along, float)
    return net / np.linalg.norm(net)
