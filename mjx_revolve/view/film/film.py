"""A film as a value: poses at equal times, the water and the robot's way, and where the camera is.

Whoever draws frames (`draw`), or lays something over them (`overlay`), reads it from here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.view.course import bed_at, finite_part, nearer_signs, pose_robot
from mjx_revolve.view.film.camera import Shots, plan_shots
from mjx_revolve.view.forces import water_at
from mjx_revolve.view.motion import smooth_path, speed_over, stroke_period
from mjx_revolve.water.flow import Water


class Shown(Protocol):
    """What films of one robot and of many have in common; see `Film`."""

    @property
    def robot(self) -> Robot:
        """One whose world it is."""

    @property
    def fps(self) -> int:
        """Frames per second."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [pixels]."""

    @property
    def time(self) -> np.ndarray:
        """`[F]` of the frames [s]."""

    @property
    def center(self) -> np.ndarray:
        """`[F, 3]` the middle of who is shown [m]."""

    @property
    def water(self) -> Water:
        """Of `[F]` each."""

    @property
    def shots(self) -> Shots:
        """The camera."""

    @property
    def origin(self) -> np.ndarray:
        """`[3]` from where OpenGL counts [m]."""


@dataclass(frozen=True, eq=False)
class Film:
    """What is shown, and when; F frames, world frame.

    Attributes:
        episode: whose life it is.
        fps: frames per second.
        size: width and height [pixels].
        time: `[F]` of the frames [s].
        qpos: `[F, nq]` the robot's poses.
        center: `[F, 3]` of balls that hold the robot [m].
        radius: `[F]` of these balls [m].
        way: `[F, 3]` of their centres without the to and fro of the strokes [m].
        speed: `[F]` of the core, over a stroke or a second around each frame [m/s].
        water: of `[F]` each.
        shots: the camera.
        lost: time from which the trajectory is not finite, or None [s].
    """

    episode: Episode
    fps: int
    size: tuple[int, int]
    time: np.ndarray
    qpos: np.ndarray
    center: np.ndarray
    radius: np.ndarray
    way: np.ndarray
    speed: np.ndarray
    water: Water
    shots: Shots
    lost: float | None

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.episode.robot

    @property
    def cast(self) -> int:
        """How many robots there are."""
        return 1

    @property
    def title(self) -> str:
        """What is shown."""
        return self.episode.title

    @property
    def origin(self) -> np.ndarray:
        """`[3]` middle of the way [m]; OpenGL counts from there."""
        return (self.center.min(axis=0) + self.center.max(axis=0)) / 2


def make_film(episode: Episode, size: tuple[int, int] = (640, 480), fps: int = 30) -> Film:
    """Chooses the frames, and plans the camera.

    Args:
        episode: what to show.
        size: width and height [pixels].
        fps: frames per second.

    Returns:
        The film; rows of the trajectory after the first that is not finite are left out.

    Raises:
        InputError: the trajectory has no finite row.
    """
    robot, world = episode.robot, episode.robot.world
    episode, lost = finite_part(episode)
    rows = np.asarray(episode.trajectory.time, float)
    # Times are multiples of the step from the start, which is one step before the first row.
    time = np.arange(max(1, round(float(rows[-1]) * fps))) / fps
    qpos = np.array(episode.trajectory.qpos, float)
    qpos[:, 3:7] = nearer_signs(qpos[:, 3:7])
    qpos = np.stack([np.interp(time, rows, column) for column in qpos.T], axis=-1)
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    parts = pose_robot(robot, qpos).parts
    center, radius = enclosing_balls(parts, np.linalg.norm(robot.fluid.half_size, axis=1))
    period = stroke_period(time, qpos[:, 7:])
    before = np.round(time / world.timestep).astype(int) - 1
    water = water_at(robot, before, time, len(rows), episode.water)
    shots = plan_shots(
        time,
        center,
        radius,
        aspect=size[0] / size[1],
        surface=float(np.asarray(water.surface_height)[0]),
        waves=sum(wave.amplitude for wave in world.waves),
        along=_long_axis(parts[0]),
        bed=None if world.bed is None else partial(bed_at, world.bed),
    )
    way, speed = smooth_path(time, center, period), speed_over(time, qpos[:, :3], period)
    return Film(episode, fps, size, time, qpos, center, radius, way, speed, water, shots, lost)


def enclosing_balls(parts: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Balls around a robot in its poses.

    Args:
        parts: `[F, npart, 3]` centres of its parts, world frame [m].
        reach: `[npart]` how far each part reaches from there [m].

    Returns:
        Centres `[F, 3]`, world frame [m], and radii `[F]` [m].
    """
    low, high = parts - reach[:, None], parts + reach[:, None]
    center = (low.min(axis=1) + high.max(axis=1)) / 2
    away = np.linalg.norm(parts - center[:, None], axis=-1)
    return center, (away + reach).max(axis=1)


def _long_axis(parts: np.ndarray) -> tuple[float, float]:
    """Horizontal direction in which a robot of parts at `[npart, 3]` is longest."""
    spread = np.cov(parts[:, :2].T) if len(parts) > 1 else np.diag([1.0, 0.0])
    x, y = np.linalg.eigh(spread)[1][:, 1]
    return (float(x), float(y)) if x >= 0 else (-float(x), -float(y))
