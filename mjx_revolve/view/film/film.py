"""A film as a value: robots and their poses at equal times, the water, and where the camera is.

`draw` draws its frames, `overlay` lays marks and words over them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.view.film.camera import Shots, plan_circle, plan_shots
from mjx_revolve.view.motion import smooth_path, speed_over, stroke_period
from mjx_revolve.view.poses import finite_rows, pose_robot
from mjx_revolve.view.recording import Mark, Recording, interpolate_poses
from mjx_revolve.view.surroundings import bed_at, target_name, target_of, water_at, water_velocity
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import World

# Factor by which ripples around many robots, seen from the air, are smaller than by the camera's
# distance; and by which the haze in the water is thinner. A choice.
_FINE = 2.5


@dataclass(frozen=True, eq=False)
class FilmRobot:
    """A robot of a film of F frames.

    Attributes:
        robot: its body.
        qpos: `[F, nq]` its poses, world frame.
        alive: `[F]` whether it is shown.
    """

    robot: Robot
    qpos: np.ndarray
    alive: np.ndarray


@dataclass(frozen=True, eq=False)
class EpisodeNotes:
    """What is written and marked over the frames of an episode.

    Attributes:
        score: a line below the title.
        length: body length, as the task has it [m].
        way: `[F, 3]` of the robot without the to and fro of its strokes, world frame [m].
        radius: `[F]` of balls around the robot [m].
        speed: `[F]` of the core, over a stroke or a second around each frame [m/s].
        current: `[F, 3]` velocity of the water around the robot, waves apart, world frame [m/s].
        target: `[F, 3]` world frame [m]; None without one.
        target_name: what it is called.
    """

    score: str
    length: float
    way: np.ndarray
    radius: np.ndarray
    speed: np.ndarray
    current: np.ndarray
    target: np.ndarray | None
    target_name: str


@dataclass(frozen=True, eq=False)
class ColonyNotes:
    """What is written and marked over the frames of a colony.

    Attributes:
        marks: places to show.
        births: time `[B]` [s] and index `[B]` of the robots that are born in the film.
        deaths: the same of those that die.
    """

    marks: tuple[Mark, ...]
    births: tuple[np.ndarray, np.ndarray]
    deaths: tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Film:
    """What is shown, and when; F frames, world frame.

    Attributes:
        title: what is shown.
        robots: all that ever appear, in one world.
        fps: frames per second.
        size: width and height [pixels].
        time: `[F]` of the frames [s].
        center: `[F, 3]` middle of what is shown [m].
        water: of `[F]` each.
        shots: the camera.
        origin: `[3]` OpenGL counts from there: near its origin it has digits for small robots [m].
        fine: how fine ripples are and how thin the haze is, next to films of one robot.
        notes: what is laid over the frames.
        lost: time from which the trajectory is not finite, or None [s].
    """

    title: str
    robots: tuple[FilmRobot, ...]
    fps: int
    size: tuple[int, int]
    time: np.ndarray
    center: np.ndarray
    water: Water
    shots: Shots
    origin: np.ndarray
    fine: float
    notes: EpisodeNotes | ColonyNotes
    lost: float | None = None

    @property
    def world(self) -> World:
        """Around all robots."""
        return self.robots[0].robot.world


def make_film(episode: Episode, size: tuple[int, int] = (640, 480), fps: int = 30) -> Film:
    """Chooses the frames of an episode, and plans a camera that follows the robot.

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
    episode, lost = finite_rows(episode)
    rows = np.asarray(episode.trajectory.time, float)
    time = np.arange(max(1, round(float(rows[-1]) * fps))) / fps
    qpos = interpolate_poses(rows, np.asarray(episode.trajectory.qpos), time)
    parts = pose_robot(robot, qpos).parts
    center, radius = enclosing_balls(parts, np.linalg.norm(robot.fluid.half_size, axis=1))
    period = stroke_period(time, qpos[:, 7:])
    before = np.searchsorted(rows, time + 1e-6, "right") - 1
    water = water_at(world, before, time, len(rows), episode.water)
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
    score = ""
    if episode.score is not None:
        score = f"score {episode.score:.3g} {episode.score_unit}".rstrip()
        score += f", mean over {episode.starts}"
    target = target_of(episode.task, episode.trajectory)
    if target is not None:
        target = np.stack([np.interp(time, rows, x) for x in target[: len(rows)].T], axis=-1)
    notes = EpisodeNotes(
        score, episode.length, smooth_path(time, center, period), radius,
        speed_over(time, qpos[:, :3], period), water_velocity(world, water, center), target,
        target_name(episode.task),
    )  # fmt: skip
    shown = FilmRobot(robot, qpos, np.ones(len(time), bool))
    origin = (center.min(axis=0) + center.max(axis=0)) / 2
    return Film(
        episode.title, (shown,), fps, size, time, center, water, shots, origin, 1.0, notes, lost
    )


def make_colony_film(
    recording: Recording, size: tuple[int, int] = (640, 480), fps: int = 30
) -> Film:
    """Chooses the frames of a colony, and plans a camera that circles over it.

    Args:
        recording: what to show.
        size: width and height [pixels].
        fps: frames per second.

    Returns:
        The film.
    """
    begin, end = recording.start, recording.end
    time = begin + np.arange(max(1, round((end - begin) * fps))) / fps
    starts = np.array([one.appears for one in recording.robots])
    ends = np.array([np.inf if one.end is None else one.end for one in recording.robots])
    alive = (time >= starts[:, None]) & (time < ends[:, None])
    robots = tuple(
        FilmRobot(one.robot, interpolate_poses(one.time, one.qpos, time, recording.leap), own)
        for one, own in zip(recording.robots, alive, strict=True)
    )
    world = robots[0].robot.world
    water = water_at(world, np.zeros(len(time), int), time, 1)  # the same at any time
    shots = plan_circle(
        time,
        np.stack([one.qpos[:, :3] for one in robots]),
        alive,
        reach=max(one.robot.morphology.length for one in robots) / 2,
        aspect=size[0] / size[1],
        surface=world.surface_height,
        waves=sum(wave.amplitude for wave in world.waves),
        bed=None if world.bed is None else partial(bed_at, world.bed),
    )
    born, died = np.flatnonzero(starts > begin), np.flatnonzero(ends <= end)
    notes = ColonyNotes(tuple(recording.marks), (starts[born], born), (ends[died], died))
    # Colonies live around the world's origin.
    return Film(
        recording.title, robots, fps, size, time, shots.target, water, shots, np.zeros(3),
        _FINE if shots.above else 1.0, notes,
    )  # fmt: skip


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
