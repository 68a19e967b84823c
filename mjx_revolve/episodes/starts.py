"""What differs from episode to episode: where robots start, and the water around them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.control.courses import Course
from mjx_revolve.control.pursuit import Chase
from mjx_revolve.control.sense import Cues
from mjx_revolve.engine.plant import Figure
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.episodes.tasks import Task
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.spatial import quat_mul
from mjx_revolve.water.flow import Water, gust_path, water_of
from mjx_revolve.water.world import World

# How long a sea is before it begins again, as episodes see it [s].
_SEA = 1000.0


class Starts(NamedTuple):
    """Of a key's episodes.

    Attributes:
        place: `[3, trials]` drawn around 0 [m]; the task says where that leads a body.
        quat: `[4, trials]` of the core, world from body (w, x, y, z).
        water: `[trials]` where it varies, else None.
        gusts: `[steps + 1, 3, trials]` velocity around the episode's current [m/s], or None where
            the world has no gusts.
        noise: `[trials]` uint32 what the sensors' noise is drawn from.
        towards: `[3, trials]` from the start to the target [m]; None where the task draws none.
        drift: `[3, trials]` velocity of the target [m/s]; None where it keeps still, or chases the
            robot.
        variation: `[trials]` each, what is not known exactly; None where nothing is drawn.
        course: `[trials]` each, the direction to keep to; None where the task has none.
    """

    place: jax.Array
    quat: jax.Array
    water: Water | None
    gusts: jax.Array | None
    noise: jax.Array
    towards: jax.Array | None = None
    drift: jax.Array | None = None
    variation: Variation | None = None
    course: Course | None = None


def check_key(key: Any) -> None:
    """Refuses what `jax.random` would not draw from, such as a bare seed.

    Args:
        key: from `jax.random.key`, or one of the older arrays of uint32.

    Raises:
        InputError: it is something else.
    """
    dtype = getattr(key, "dtype", None)
    if dtype is None or not (jnp.issubdtype(dtype, jax.dtypes.prng_key) or dtype == jnp.uint32):
        raise InputError(f"key: expected jax.random.key(SEED); found {key!r}")


def draw_starts(task: TaskConfig, world: World, key: jax.Array, steps: int) -> Starts:
    """Draws the starts of a key's episodes, the same for all bodies.

    Args:
        task: how starts vary.
        world: the world.
        key: draws them.
        steps: how long episodes are.

    Returns:
        The starts.
    """
    trials = task.trials
    place_key, tilt_key, yaw_key, current_key = jax.random.split(key, 4)
    place = task.start_position * jax.random.normal(place_key, (3, trials))
    tilt = task.start_tilt * jax.random.normal(tilt_key, (2, trials))
    yaw = task.start_yaw * jax.random.normal(yaw_key, (trials,))
    quat = _euler_quat(tilt[0], tilt[1], yaw)
    gusts = None
    if world.gust is not None:
        gust_key = jax.random.fold_in(key, 1)
        gusts = gust_path(world.gust, gust_key, steps, world.timestep, trials)
    noise = jax.random.bits(jax.random.fold_in(key, 3), (trials,), "uint32")
    starts = Starts(place, quat, None, gusts, noise, *_draw_target(task, key))
    starts = starts._replace(variation=_draw_variation(task, key), course=_draw_course(task, key))
    if task.current_std == 0 and not world.waves:
        return starts
    extra = task.current_std * jax.random.normal(current_key, (2, trials))
    x, y, z = world.current
    full = jnp.full((trials,), 0.0, place.dtype)
    water = Water(full + world.surface_height, (x + extra[0], y + extra[1], full + z))
    if world.waves:
        # Episodes begin at any moment of the sea.
        time_key = jax.random.fold_in(key, 2)
        water = water._replace(time=jax.random.uniform(time_key, (trials,), maxval=_SEA))
    water = jax.tree.map(lambda x: jnp.broadcast_to(x, (trials,)), water)
    return starts._replace(water=water)


def _draw_target(task: TaskConfig, key: jax.Array) -> tuple[jax.Array | None, jax.Array | None]:
    """Where targets are from the start, and how they move, `[3, trials]` each or None."""
    bearing_key, drift_key = jax.random.split(jax.random.fold_in(key, 4))

    def level(key: jax.Array, size: float, spread: float) -> jax.Array:
        angle = jax.random.uniform(key, (task.trials,), minval=-spread, maxval=spread)
        return size * jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)])

    towards = drift = None
    if task.target_distance is not None:
        towards = level(bearing_key, task.target_distance, task.target_spread)
    if task.target_speed > 0 and task.target_turn is None:
        drift = level(drift_key, task.target_speed, np.pi)
    return towards, drift


def _draw_course(task: TaskConfig, key: jax.Array) -> Course | None:
    """Courses and how they turn, `[trials]` each; None where the task has none."""
    if task.course_spread is None:
        return None
    first_key, rate_key, moment_key, turn_key = jax.random.split(jax.random.fold_in(key, 6), 4)
    count = task.course_changes

    def within(key: jax.Array, most: float, *shape: int) -> jax.Array:
        return jax.random.uniform(key, (*shape, task.trials), minval=-most, maxval=most)

    ahead = math.atan2(task.direction[1], task.direction[0])
    moments = jax.random.uniform(
        moment_key, (count, task.trials), minval=task.settle, maxval=task.duration
    )
    turns = within(turn_key, task.course_turn, count)
    heading = ahead + within(first_key, task.course_spread)
    return Course(heading, within(rate_key, task.course_rate), tuple(moments), tuple(turns))


def _draw_variation(task: TaskConfig, key: jax.Array) -> Variation | None:
    """Factors within the ranges of `task.robust`, uniformly in their logarithm, `[trials]` each."""
    if task.robust is None:
        return None
    shares = jax.random.uniform(jax.random.fold_in(key, 5), (4, task.trials), minval=-1.0)
    ranges = [getattr(task.robust, name) for name in Variation._fields]
    return Variation(*(width**share for width, share in zip(ranges, shares, strict=True)))


def cues_of(task: TaskConfig, starts: Starts, place: jax.Array) -> Cues:
    """What episodes give their robots to feel.

    Args:
        task: whose target it is.
        starts: of the episodes, `[lanes]`.
        place: `[3, lanes]` where the cores start, world frame [m].

    Returns:
        The cues.
    """
    target: Any = None
    if starts.towards is not None:
        target = tuple(place + starts.towards)
    elif task.target is not None:
        target = tuple(jnp.full_like(place[0], x) for x in task.target)
    drift = None if starts.drift is None or target is None else tuple(starts.drift)
    chase = sight = None
    if task.sight is not None:
        sight = jnp.full_like(place[0], task.sight)
    if task.target_turn is not None:
        chase = Chase(*(jnp.full_like(place[0], x) for x in (task.target_speed, task.target_turn)))
    return Cues(target, drift, starts.noise, sight, chase, starts.course)


def target_path(cues: Cues, time: jax.Array) -> jax.Array:
    """Where the targets are that do not chase their robots.

    Args:
        cues: of episodes, `[lanes]`.
        time: `[S]` since their start [s].

    Returns:
        `[S, 3, lanes]` world frame [m].
    """
    place = jax.vmap(cues.target_at)(time) if cues.drift is not None else cues.target
    wide = (time.shape[0], *jnp.shape(cues.target[0]))
    return jnp.stack([jnp.broadcast_to(x, wide) for x in place], 1)


def start_pose(
    task: Task, settings: TaskConfig, world: World, figure: Figure, starts: Starts
) -> jax.Array:
    """Where the cores of bodies start.

    Args:
        task: which knows.
        settings: of the task.
        world: the world.
        figure: of the bodies, `[lanes]` or one.
        starts: of their episodes, `[lanes]`.

    Returns:
        `[7, lanes]` position, world frame [m], and quaternion (w, x, y, z).
    """
    place = task.start(settings, world, figure, starts.place)
    quat = starts.quat
    if settings.start_attitude == "righted":
        righting = _righting(figure.up)
        turned = quat_mul(tuple(quat), righting)
        quat = jnp.stack([x.astype(quat.dtype) for x in turned])
    return jnp.concatenate([place, quat])


def _righting(up: Any) -> tuple[Any, ...]:
    """The least turn (w, x, y, z) that brings a direction, a unit vector, upright."""
    x, y, z = (jnp.asarray(component) for component in up)
    # Half way round, where any horizontal axis would do, it is x.
    over = jnp.where(z < -1 + 1e-6, 1.0, 0.0)
    w, x, y = (1 - over) * (1 + z), over + (1 - over) * y, -(1 - over) * x
    norm = jnp.sqrt(w * w + x * x + y * y)
    return w / norm, x / norm, y / norm, jnp.zeros_like(w)


def gusty_water(world: World, path: jax.Array, water: Water | None = None) -> Water:
    """The water along a path of gusts.

    Args:
        world: whose gusts they are.
        path: `[steps + 1, 3, ...]` from `flow.gust_path` [m/s], around the world's current.
        water: what else differs from the world; its current is that around which the gusts blow.

    Returns:
        Water whose current and acceleration are `[steps, ...]`.
    """
    base = water_of(world) if water is None else water
    current = tuple(c + path[:-1, i] for i, c in enumerate(base.current))
    change = jnp.diff(path, axis=0) / world.timestep
    return base._replace(current=current, acceleration=tuple(change[:, i] for i in range(3)))


def _euler_quat(roll: Any, pitch: Any, yaw: Any) -> jax.Array:
    """`[4, n]` quaternion (w, x, y, z) of roll, then pitch, then yaw [rad]."""
    (cr, sr), (cp, sp), (cy, sy) = ((jnp.cos(x / 2), jnp.sin(x / 2)) for x in (roll, pitch, yaw))
    return jnp.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )
