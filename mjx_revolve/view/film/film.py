"""An episode as a film: poses at equal times, drawn one after the other.

Frames come one by one, so that a long film needs no more memory than a short one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import mujoco
import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.film.camera import Shots, plan_shots
from mjx_revolve.view.film.captions import Captions
from mjx_revolve.view.film.painter import Painter
from mjx_revolve.view.film.scene import FOVY, SUN, SURFACE, build_scene
from mjx_revolve.view.film.waterlight import make_shader
from mjx_revolve.view.swim_picture import smooth_path, stroke_period
from mjx_revolve.water.bed import Bed, bed_height
from mjx_revolve.water.flow import Water, flow, water_of

# How far one sees, in distances of the camera from the robot.
_SIGHT = 9.0
# Motes in a cube around the camera, and its edge in camera distances.
_MOTES, _CUBE = 1500, 6.0
# The trail: a mark every so often, for so long [s].
_MARK, _TRAIL = 0.25, 12.0


@dataclass(frozen=True, eq=False)
class Film:
    """What is shown, and when.

    Attributes:
        episode: whose life it is.
        fps: frames per second.
        size: width and height [pixels].
        time: `[F]` of the frames [s].
        qpos: `[F, nq]` the robot's poses.
        lost: time from which the trajectory is not finite, or None [s].
    """

    episode: Episode
    fps: int
    size: tuple[int, int]
    time: np.ndarray
    qpos: np.ndarray
    lost: float | None

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.episode.robot

    @cached_property
    def balls(self) -> tuple[np.ndarray, np.ndarray]:
        """Centres `[F, 3]` and radii `[F]` of balls that hold the robot, world frame [m]."""
        return enclosing_balls(self.robot, self.qpos)

    @cached_property
    def origin(self) -> np.ndarray:
        """`[3]` middle of the way, world frame [m]; OpenGL counts from there."""
        return (self.balls[0].min(axis=0) + self.balls[0].max(axis=0)) / 2

    @cached_property
    def way(self) -> np.ndarray:
        """`[F, 3]` of the robot's centre without the to and fro of its strokes [m]."""
        period = stroke_period(self.time, self.qpos[:, 7:])
        return smooth_path(self.time, self.balls[0], period)

    @cached_property
    def speed(self) -> np.ndarray:
        """`[F]` along the way, over a stroke or a second around each frame [m/s]."""
        count = len(self.time)
        if count < 2:
            return np.zeros(count)
        period = stroke_period(self.time, self.qpos[:, 7:]) or 1.0
        whole = min(max(1, round(period * self.fps)), count - 1)
        first = np.clip(np.arange(count) - whole // 2, 0, count - 1 - whole)
        path = self.balls[0]
        return np.linalg.norm(path[first + whole] - path[first], axis=1) * self.fps / whole

    @cached_property
    def water(self) -> Water:
        """The episode's water at time 0."""
        water = self._episode_water
        return Water(
            _first(water.surface_height),
            tuple(_first(c) for c in water.current),
            (0.0, 0.0, 0.0),
            _first(water.time),
        )

    @cached_property
    def current(self) -> np.ndarray:
        """`[F, 3]` uniform part of the water's velocity, gusts included, world frame [m/s]."""
        step = self.robot.world.timestep
        rows = (np.ravel(np.asarray(c, float)) for c in self._episode_water.current)
        return np.stack([np.interp(self.time, step * np.arange(len(c)), c) for c in rows], axis=-1)

    @property
    def _episode_water(self) -> Water:
        water = self.episode.water
        return water_of(self.robot.world) if water is None else water

    @cached_property
    def shots(self) -> Shots:
        """The camera."""
        world = self.robot.world
        return plan_shots(
            self.time,
            *self.balls,
            aspect=self.size[0] / self.size[1],
            fovy=math.radians(FOVY),
            surface=self.water.surface_height,
            waves=sum(wave.amplitude for wave in world.waves),
            along=_long_axis(self.robot, self.qpos[0]),
            bed=None if world.bed is None else partial(_bed_height, world.bed),
        )


def _first(value: Any) -> float:
    return float(np.ravel(np.asarray(value))[0])


def _long_axis(robot: Robot, pose: np.ndarray) -> tuple[float, float]:
    """Horizontal direction in which the robot is longest."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = pose
    mujoco.mj_kinematics(robot.mj_model, data)
    frames = data.xmat.reshape(-1, 3, 3)[robot.fluid.body]
    place = data.xpos[robot.fluid.body] + np.einsum("pij,pj->pi", frames, robot.fluid.position)
    _, axes = np.linalg.eigh(np.cov(place[:, :2].T) if len(place) > 1 else np.diag([1.0, 0.0]))
    x, y = axes[:, 1] if axes[0, 1] >= 0 else -axes[:, 1]
    return float(x), float(y)


def _bed_height(bed: Bed, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(bed_height(bed, x.astype(np.float32), y.astype(np.float32)))


def make_film(episode: Episode, size: tuple[int, int] = (640, 480), fps: int = 30) -> Film:
    """Chooses the frames.

    Args:
        episode: what to show.
        size: width and height [pixels].
        fps: frames per second.

    Returns:
        The film; rows of the trajectory after the first that is not finite are left out.

    Raises:
        InputError: the trajectory has no finite row.
    """
    time = np.atleast_1d(np.asarray(episode.trajectory.time, np.float64))
    qpos = np.asarray(episode.trajectory.qpos, np.float64).reshape(len(time), -1)
    finite: np.ndarray = np.asarray(np.isfinite(qpos).all(axis=1))
    rows = len(finite) if finite.all() else int(finite.argmin())
    if rows == 0:
        raise InputError(
            f"{episode.title}: expected a trajectory of finite numbers; found none in its first row"
        )
    lost = None if rows == len(finite) else float(time[rows])
    time, qpos = time[:rows], qpos[:rows]
    # Times are multiples of the step from the start, which is one step before the first row.
    count = max(1, round(float(time[-1]) * fps))
    moments = np.arange(count) / fps
    return Film(episode, fps, size, moments, _between(time, qpos, moments), lost)


def _between(time: np.ndarray, qpos: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Poses at any time, between rows: `[F, nq]`."""
    moments = np.clip(moments, time[0], time[-1])
    after = np.clip(np.searchsorted(time, moments), 1, max(len(time) - 1, 1))
    if len(time) == 1:
        return np.repeat(qpos, len(moments), axis=0)
    share = ((moments - time[after - 1]) / (time[after] - time[after - 1]))[:, None]
    first, second = qpos[after - 1].copy(), qpos[after].copy()
    # A quaternion and its negative turn alike: the nearer of the two.
    opposite = (first[:, 3:7] * second[:, 3:7]).sum(axis=1) < 0
    second[opposite, 3:7] *= -1
    between = first + share * (second - first)
    between[:, 3:7] /= np.linalg.norm(between[:, 3:7], axis=1, keepdims=True)
    return between


def enclosing_balls(robot: Robot, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Balls around the robot in its poses.

    Args:
        robot: the robot.
        qpos: `[F, nq]`.

    Returns:
        Centres `[F, 3]`, world frame [m], and radii `[F]` [m].
    """
    data, table = mujoco.MjData(robot.mj_model), robot.fluid
    reach = np.linalg.norm(table.half_size, axis=1)
    centers, radii = np.zeros((len(qpos), 3)), np.zeros(len(qpos))
    for row, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(robot.mj_model, data)
        frames = data.xmat.reshape(-1, 3, 3)[table.body]
        place = data.xpos[table.body] + np.einsum("pij,pj->pi", frames, table.position)
        low, high = (place - reach[:, None]).min(axis=0), (place + reach[:, None]).max(axis=0)
        centers[row] = (low + high) / 2
        radii[row] = (np.linalg.norm(place - centers[row], axis=1) + reach).max()
    return centers, radii


def draw_frames(film: Film, way: str) -> Iterator[np.ndarray]:
    """Draws a film.

    Args:
        film: from `make_film`.
        way: of making an OpenGL context, from `opengl.find_opengl`.

    Yields:
        `[height, width, 3]` uint8, one frame after the other.
    """
    shots, size = film.shots, film.size
    span = float(np.linalg.norm(np.ptp(film.balls[0][:, :2], axis=0))) / 2 + shots.distance
    sight = _SIGHT * shots.distance
    shadow = 1.5 * shots.distance
    model = build_scene(film.robot, size, film.origin.tolist(), span, sight, shadow, plain=True)
    shade = make_shader(film.robot.world, size, shots.distance, shots.above, film.origin.tolist())
    floating = _Floating(film)
    captions = Captions(film)
    with Painter(model, size, way) as painter:
        painter.option.geomgroup[SURFACE] = 0
        for flag in (mujoco.mjtRndFlag.mjRND_FOG, mujoco.mjtRndFlag.mjRND_HAZE):
            painter.scene.flags[flag] = 0
        waiting: tuple[int, Any, np.ndarray] | None = None
        for frame in range(len(film.time)):
            _aim(painter, film, frame)
            color, depth = painter.paint()
            water = film.water._replace(
                surface_height=film.water.surface_height - film.origin[2],
                time=film.water.time + film.time[frame],
            )
            # JAX works on this frame while MuJoCo draws the next.
            shaded = shade(
                np.ascontiguousarray(color),
                np.ascontiguousarray(depth),
                (shots.position[frame] - film.origin).astype(np.float32),
                shots.axes(frame).astype(np.float32),
                np.float32(shots.fovy),
                Water(*_f32(water)),
            )
            if waiting is not None:
                yield _finish(captions, floating, *waiting)
            waiting = (frame, shaded, depth)
        if waiting is not None:
            yield _finish(captions, floating, *waiting)


def _f32(water: Water) -> tuple[Any, ...]:
    """The same numbers in single precision, whatever the environment asks JAX for."""
    return (np.float32(water.surface_height), tuple(np.float32(c) for c in water.current),
            (0.0, 0.0, 0.0), np.float32(water.time))  # fmt: skip


def _aim(painter: Painter, film: Film, frame: int) -> None:
    """Poses the robot, and puts camera and light in their places."""
    model, data, scene, shots = painter.model, painter.data, painter.scene, film.shots
    data.qpos[:] = film.qpos[frame]
    data.qpos[:3] -= film.origin
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    axes, target = shots.axes(frame), shots.target[frame]
    camera = painter.camera
    camera.lookat[:] = target - film.origin
    camera.distance = np.linalg.norm(shots.position[frame] - target)
    camera.azimuth = math.degrees(math.atan2(axes[2, 1], axes[2, 0]))
    camera.elevation = math.degrees(math.asin(np.clip(axes[2, 2], -1.0, 1.0)))
    mujoco.mjv_updateScene(
        model, data, painter.option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene
    )
    # The shadow map is spread around the sun's own place: close to the robot it is fine.
    for light in scene.lights[: scene.nlight]:
        if light.castshadow:
            light.pos[:] = film.balls[0][frame] - film.origin + 4.0 * shots.distance * SUN
    # What is there for show casts no shadow. The bed's own would only stain it with dots.
    for geom in scene.geoms[: scene.ngeom]:
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and model.geom_bodyid[geom.objid] == 0:
            geom.category = mujoco.mjtCatBit.mjCAT_DECOR


def _finish(
    captions: Captions, floating: _Floating, frame: int, shaded: Any, depth: np.ndarray
) -> np.ndarray:
    """What is laid over a frame."""
    picture = np.array(shaded)
    floating.draw(picture, depth, frame)
    return captions.draw(picture, frame)


class _Floating:
    """What floats in the water and shows that the robot moves: motes, and marks along its way."""

    def __init__(self, film: Film) -> None:
        self._film = film
        shots, count = film.shots, len(film.time)
        random = np.random.default_rng(3)
        self._edge = _CUBE * shots.distance
        self._place = random.uniform(0.0, self._edge, (_MOTES, 3))
        self._weight = random.uniform(0.25, 1.0, _MOTES) ** 2
        # Motes go where the water goes that is around the robot, waves apart.
        world = replace(film.robot.world, waves=())
        center = film.balls[0].astype(np.float32)
        now = film.water._replace(current=tuple(film.current.astype(np.float32).T))
        velocity, _ = flow(world, now, *center.T)
        speed = np.stack([np.broadcast_to(np.asarray(v, float), (count,)) for v in velocity], -1)
        self._drift = np.concatenate([np.zeros((1, 3)), np.cumsum(speed[:-1], axis=0) / film.fps])
        every = max(1, round(_MARK * film.fps))
        self._marks = np.arange(0, count, every)

    def draw(self, picture: np.ndarray, depth: np.ndarray, frame: int) -> None:
        """Draws them into a picture, in place."""
        shots, film = self._film.shots, self._film
        surface = film.water.surface_height
        if not shots.above:
            edge, camera = self._edge, shots.position[frame]
            corner = camera - edge / 2
            motes = corner + (self._place + self._drift[frame] - corner) % edge
            off = np.linalg.norm(motes - camera, axis=1) / (edge / 2)
            alpha = 0.9 * self._weight * np.clip(1.0 - off, 0.0, 1.0) ** 0.7
            # Not in the lens, and none that stands in the air.
            alpha *= np.clip(8.0 * off - 1.2, 0.0, 1.0) * (motes[:, 2] < surface - 0.02)
            size = 0.0032 * shots.distance * (0.5 + self._weight)
            _add_dots(picture, depth, shots, frame, motes, alpha, size, (0.86, 0.97, 1.0))
        marks = self._marks[self._marks < frame]
        age = (frame - marks) / film.fps
        marks, age = marks[age < _TRAIL], age[age < _TRAIL]
        if len(marks):
            # They come up behind the robot rather than inside it.
            away = np.linalg.norm(film.way[marks] - film.balls[0][frame], axis=1)
            alpha = 0.85 * (1.0 - age / _TRAIL)
            alpha *= np.clip(4.0 * away / film.balls[1][frame] - 2.0, 0.0, 1.0)
            size = np.full(len(marks), 0.0065 * shots.distance)
            _add_dots(picture, depth, shots, frame, film.way[marks], alpha, size, (1.0, 0.88, 0.45))


def _add_dots(
    picture: np.ndarray,
    depth: np.ndarray,
    shots: Shots,
    frame: int,
    points: np.ndarray,
    alpha: np.ndarray,
    size: np.ndarray,
    color: tuple[float, float, float],
) -> None:
    """Lays soft dots over a picture, in place, where nothing stands before them.

    Args:
        picture: `[height, width, 3]` uint8.
        depth: `[height, width]` along the view [m].
        shots: the camera.
        frame: number of the frame.
        points: `[n, 3]` world frame [m].
        alpha: `[n]` how opaque, 0 to 1.
        size: `[n]` radius [m].
        color: of the dots.
    """
    height, width = depth.shape
    flat, away = shots.project(frame, points)
    x = width / 2 + flat[:, 0] * height / 2 - 0.5
    y = height / 2 - flat[:, 1] * height / 2 - 0.5
    radius = size / np.maximum(away, 1e-6) / math.tan(shots.fovy / 2) * height / 2
    shown = (away > 0.05 * shots.distance) & (alpha > 0.01) & (radius < 40)
    shown &= (x > -9) & (x < width + 9) & (y > -9) & (y < height + 9)
    x, y, away, radius, alpha = (v[shown] for v in (x, y, away, radius, alpha))
    if not len(x):
        return
    # Dots smaller than a pixel are drawn as large as one, and fainter.
    wide = np.clip(radius, 0.8, 5.0)
    alpha = alpha * np.minimum(1.0, (radius / 0.8) ** 2)
    reach = 7
    offset = np.arange(-reach, reach + 1)
    column = np.floor(x).astype(int)[:, None, None] + offset[None, None, :]
    row = np.floor(y).astype(int)[:, None, None] + offset[None, :, None]
    square = (column - x[:, None, None]) ** 2 + (row - y[:, None, None]) ** 2
    cover = alpha[:, None, None] * np.exp(-square / (wide**2)[:, None, None])
    column, row = np.broadcast_arrays(column, row)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (cover > 0.004)
    which = np.broadcast_to(np.arange(len(x))[:, None, None], inside.shape)[inside]
    column, row, cover = column[inside], row[inside], cover[inside]
    clear = away[which] < depth[row, column]
    column, row, cover = column[clear], row[clear], cover[clear]
    layer = np.zeros((height, width), np.float32)
    np.add.at(layer, (row, column), cover)
    place = np.nonzero(layer)
    share = np.minimum(layer[place], 1.0)[:, None]
    old = picture[place].astype(np.float32)
    picture[place] = np.round(old + share * (255 * np.asarray(color) - old)).astype(np.uint8)
