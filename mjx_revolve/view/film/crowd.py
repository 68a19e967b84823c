"""A film of many robots as a value: who is there when, and where the camera is.

Robots are born and die while it runs; who is not alive is not drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.view.colony import Actor, Mark
from mjx_revolve.view.course import bed_at, nearer_signs
from mjx_revolve.view.film.camera import Shots, plan_circle
from mjx_revolve.water.flow import Water, water_of


@dataclass(frozen=True, eq=False)
class Crowd:
    """What is shown, and when; F frames, N robots, world frame.

    Attributes:
        title: what it is called.
        robots: all who are ever there.
        marks: places to show.
        fps: frames per second.
        size: width and height [pixels].
        time: `[F]` of the frames [s].
        qpos: N of `[F, nq]`, the robots' poses.
        alive: `[N, F]` whether they are there.
        births: time `[B]` [s] and robot `[B]` of those who are born in the film.
        deaths: the same of those who die.
        center: `[F, 3]` what the camera looks at [m].
        water: of `[F]` each.
        shots: the camera.
    """

    title: str
    robots: tuple[Robot, ...]
    marks: tuple[Mark, ...]
    fps: int
    size: tuple[int, int]
    time: np.ndarray
    qpos: tuple[np.ndarray, ...]
    alive: np.ndarray
    births: tuple[np.ndarray, np.ndarray]
    deaths: tuple[np.ndarray, np.ndarray]
    center: np.ndarray
    water: Water
    shots: Shots

    @property
    def cast(self) -> int:
        """How many robots there are."""
        return len(self.robots)

    @property
    def robot(self) -> Robot:
        """One of them; they share a world."""
        return self.robots[0]

    @property
    def origin(self) -> np.ndarray:
        """`[3]` the place from which OpenGL counts: the world's origin, where colonies live [m]."""
        return np.zeros(3)


def make_crowd(
    actors: Sequence[Actor],
    title: str,
    *,
    span: tuple[float, float],
    marks: Sequence[Mark] = (),
    leap: float | None = None,
    size: tuple[int, int] = (640, 480),
    fps: int = 30,
) -> Crowd:
    """Chooses the frames, and plans the camera.

    Args:
        actors: all who are ever there, at least one, in one world.
        title: what it is called.
        span: from when to when it goes [s].
        marks: places to show.
        leap: who is farther than this from its pose before has been put there [m]; None: nobody is.
        size: width and height [pixels].
        fps: frames per second.

    Returns:
        The film.
    """
    begin, end = span
    time = begin + np.arange(max(1, round((end - begin) * fps))) / fps
    starts = np.array([a.time[0] if a.start is None else a.start for a in actors], float)
    ends = np.array([np.inf if a.end is None else a.end for a in actors])
    alive = (time >= starts[:, None]) & (time < ends[:, None])
    qpos = tuple(_between(actor, time, leap) for actor in actors)
    robots, world = tuple(actor.robot for actor in actors), actors[0].robot.world
    water = _water_over(water_of(world), time)
    shots = plan_circle(
        time,
        np.stack([poses[:, :3] for poses in qpos]),
        alive,
        reach=max(robot.morphology.length for robot in robots) / 2,
        aspect=size[0] / size[1],
        surface=world.surface_height,
        waves=sum(wave.amplitude for wave in world.waves),
        bed=None if world.bed is None else partial(bed_at, world.bed),
    )
    born, died = np.flatnonzero(starts > begin), np.flatnonzero(ends <= end)
    return Crowd(
        title, robots, tuple(marks), fps, size, time, qpos, alive,
        (starts[born], born), (ends[died], died), shots.target, water, shots,
    )  # fmt: skip


def _water_over(water: Water, time: np.ndarray) -> Water:
    """The same water at times `[F]`; its waves go on."""
    fill = lambda x: np.full(len(time), x, np.float32)  # noqa: E731
    return Water(
        fill(water.surface_height),
        tuple(map(fill, water.current)),
        tuple(map(fill, water.acceleration)),
        time.astype(np.float32),
    )


def _between(actor: Actor, time: np.ndarray, leap: float | None) -> np.ndarray:
    """`[F, nq]` an actor's poses at times `[F]`; where it is put elsewhere it is not on the way."""
    rows, qpos = np.asarray(actor.time, float), np.array(actor.qpos, float)
    qpos[:, 3:7] = nearer_signs(qpos[:, 3:7])
    found = np.stack([np.interp(time, rows, column) for column in qpos.T], axis=-1)
    if leap is not None:
        far = np.linalg.norm(np.diff(qpos[:, :3], axis=0), axis=1) > leap
        before = np.clip(np.searchsorted(rows, time, side="right") - 1, 0, len(rows) - 1)
        held = np.r_[far, False][before]
        found[held] = qpos[before[held]]
    found[:, 3:7] /= np.linalg.norm(found[:, 3:7], axis=1, keepdims=True)
    return found
