"""Random quantities of episodes: start poses, water, targets, courses, coefficients."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from mjx_revolve.control.courses import Course
from mjx_revolve.control.pursuit import PursuitLimits
from mjx_revolve.control.readings import EpisodeContext
from mjx_revolve.engine.plant import BodyGeometry
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.episodes.tasks import Task
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.spatial import Vec, quat_mul
from mjx_revolve.water.flow import Water, gust_path, water_of
from mjx_revolve.water.world import World

# Period after which the sea of the episodes repeats [s].
_SEA = 1000.0


class Starts(NamedTuple):
    """Random quantities of a key's episodes.

    Attributes:
        place: offset drawn around 0 [m], from which the task makes a start position.
        quat: of the core, world from body (w, x, y, z).
        water: `[trials]`; None where it does not vary.
        gusts: velocity around the episode's current [m/s]; None without.
        noise: seed of the sensors' noise.
        towards: from the start to the target [m]; None where the task draws none.
        drift: velocity of the target [m/s]; None where it is fixed, or pursues the robot.
        variation: factors on coefficients, `[trials]` each; None where none is drawn.
        course: direction to keep to, `[trials]` each; None where the task has none.
    """

    place: Float[Array, "3 trials"]
    quat: Float[Array, "4 trials"]
    water: Water | None
    gusts: Float[Array, "rows 3 trials"] | None
    noise: UInt[Array, " trials"]
    towards: Float[Array, "3 trials"] | None = None
    drift: Float[Array, "3 trials"] | None = None
    variation: Variation | None = None
    course: Course | None = None


def check_key(key: object) -> None:
    """Refuses anything but a key of `jax.random`, such as a seed.

    Args:
        key: from `jax.random.key`, or one of the older arrays of uint32.

    Raises:
        InputError: it is something else.
    """
    dtype, shape = getattr(key, "dtype", None), getattr(key, "shape", None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    raw = jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0))).shape
    if not (shape == () if typed else dtype == jnp.uint32 and shape == raw):
        raise InputError("key", "jax.random.key(SEED)", repr(key))


def draw_starts(task: TaskConfig, world: World, key: jax.Array, steps: int) -> Starts:
    """Draws the starts of a key's episodes, the same for all bodies.

    Args:
        task: how starts vary.
        world: the world.
        key: draws them.
        steps: timesteps of an episode.

    Returns:
        The starts.
    """
    trials = task.trials
    # `split` has the keys of `fold_in` with 0 to 3: all others have numbers of their own.
    place_key, tilt_key, yaw_key, current_key = jax.random.split(key, 4)
    place = task.start_position * jax.random.normal(place_key, (3, trials))
    tilt = task.start_tilt * jax.random.normal(tilt_key, (2, trials))
    yaw = task.start_yaw * jax.random.normal(yaw_key, (trials,))
    quat = _euler_quat(tilt[0], tilt[1], yaw)
    gusts = None if world.gust is None else draw_gusts(world, key, steps, trials)
    noise = jax.random.bits(noise_key(key), (trials,), "uint32")
    starts = Starts(place, quat, None, gusts, noise, *_draw_target(task, key))
    starts = starts._replace(variation=_draw_variation(task, key), course=_draw_course(task, key))
    if task.current_std == 0 and not world.waves:
        return starts
    extra = task.current_std * jax.random.normal(current_key, (2, trials))
    x, y, z = world.current
    full = jnp.full((trials,), 0.0, place.dtype)
    water = Water(full + world.surface_height, (x + extra[0], y + extra[1], full + z))
    if world.waves:
        # Episodes begin at a random time of the waves.
        time_key = jax.random.fold_in(key, 9)
        water = water._replace(time=jax.random.uniform(time_key, (trials,), maxval=_SEA))
    water = jax.tree.map(lambda x: jnp.broadcast_to(x, (trials,)), water)
    return starts._replace(water=water)


def noise_key(key: jax.Array) -> jax.Array:
    """The key of sensors' noise in a key's episodes."""
    return jax.random.fold_in(key, 10)


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
    """Factors within the ranges of `task.robust`, uniformly in their logarithm, `[trials]` each.

    A Latin hypercube (McKay, Beckman & Conover 1979): of n trials each factor has one in every nth
    of its range. A trial's factors are as if drawn alone, and the mean over trials depends little
    on the draw, so that generations can be compared: parents keep the scores of theirs.
    """
    if task.robust is None:
        return None
    within_key, order_key = jax.random.fold_in(key, 5), jax.random.fold_in(key, 7)
    within = jax.random.uniform(within_key, (4, task.trials), minval=-1.0)
    parts = (2 * jnp.arange(task.trials) + 1 + within) / task.trials - 1
    shares = jax.random.permutation(order_key, parts, axis=1, independent=True)
    ranges = [getattr(task.robust, name) for name in Variation._fields]
    return Variation(*(width**share for width, share in zip(ranges, shares, strict=True)))


def episode_context(
    task: TaskConfig, starts: Starts, position: Float[Array, "3 lanes"]
) -> EpisodeContext:
    """The sensors' context of episodes.

    Args:
        task: its target and pursuer.
        starts: of the episodes, `[lanes]`.
        position: of the cores at the start, world frame [m].
    """
    like = position[0]
    wide = lambda x: jnp.full_like(like, x)  # noqa: E731
    target: Vec | None = None
    if starts.towards is not None:
        target = tuple(position + starts.towards)
    elif task.target is not None:
        target = tuple(map(wide, task.target))
    pursuit = None
    if task.target_turn is not None:
        pursuit = PursuitLimits(wide(task.target_speed), wide(task.target_turn))
    return EpisodeContext(
        target=target,
        drift=None if starts.drift is None or target is None else tuple(starts.drift),
        noise=starts.noise,
        sight=None if task.sight is None else wide(task.sight),
        pursuit=pursuit,
        course=starts.course,
    )


def target_path(context: EpisodeContext, time: Float[Array, " S"]) -> Float[Array, "S 3 lanes"]:
    """Positions of targets that do not pursue their robots, world frame [m], at times [s]."""
    path = jax.vmap(context.target_at)(time) if context.drift is not None else context.target
    wide = (time.shape[0], *jnp.shape(context.target[0]))
    return jnp.stack([jnp.broadcast_to(x, wide) for x in path], 1)


def start_pose(
    task: Task, settings: TaskConfig, world: World, geometry: BodyGeometry, starts: Starts
) -> Float[Array, "7 lanes"]:
    """Poses of the cores at the start.

    Args:
        task: places a body in the world.
        settings: of the task.
        world: the world.
        geometry: of the bodies, `[lanes]` or one.
        starts: of their episodes, `[lanes]`.

    Returns:
        Position, world frame [m], and quaternion (w, x, y, z).
    """
    position = task.start(settings, world, geometry, starts.place)
    quat = starts.quat
    if settings.start_attitude == "righted":
        turned = quat_mul(tuple(quat), _righting(geometry.up))
        quat = jnp.stack([x.astype(quat.dtype) for x in turned])
    return jnp.concatenate([position, quat])


def _righting(up: Vec) -> tuple[jax.Array, ...]:
    """The least turn (w, x, y, z) that brings a direction, a unit vector, upright."""
    x, y, z = (jnp.asarray(component) for component in up)
    # For half a turn any horizontal axis would do; x is used.
    over = jnp.where(z < -1 + 1e-6, 1.0, 0.0)
    w, x, y = (1 - over) * (1 + z), over + (1 - over) * y, -(1 - over) * x
    norm = jnp.sqrt(w * w + x * x + y * y)
    return w / norm, x / norm, y / norm, jnp.zeros_like(w)


def draw_gusts(
    world: World, key: jax.Array, steps: int, trials: int
) -> Float[Array, "rows 3 trials"]:
    """Paths of gusts around the current, `[steps + 1, 3, trials]` [m/s]; `key`: of the episodes."""
    assert world.gust is not None
    return gust_path(world.gust, jax.random.fold_in(key, 8), steps, world.timestep, trials)


def gusty_water(world: World, path: jax.Array, water: Water | None = None) -> Water:
    """The water along a path of gusts.

    Args:
        world: its timestep, and its water by default.
        path: `[steps + 1, 3, ...]` from `draw_gusts` [m/s].
        water: its current is that around which the gusts blow.

    Returns:
        Water with current and acceleration `[steps, ...]`.
    """
    base = water_of(world) if water is None else water
    current = tuple(c + path[:-1, i] for i, c in enumerate(base.current))
    change = jnp.diff(path, axis=0) / world.timestep
    return base._replace(current=current, acceleration=tuple(change[:, i] for i in range(3)))


def steady_water(world: World, starts: Starts) -> Water:
    """The water of episodes, but for gusts."""
    return water_of(world) if starts.water is None else starts.water


def gust_rows(
    world: World, starts: Starts, steps: int, first: Int[Array, "..."] | None = None
) -> Water | None:
    """The water of each timestep of episodes in gusts.

    Args:
        world: the world.
        starts: of the episodes, `[lanes]`.
        steps: number of timesteps; after an episode's last one, that is repeated.
        first: timestep to begin with, of all or of each lane; None: 0.

    Returns:
        `[steps, lanes]`; None without gusts.
    """
    path = starts.gusts
    if path is None:
        return None
    if first is not None:
        index = jnp.minimum(first + jnp.arange(steps + 1)[:, None], path.shape[0] - 1)
        index = jnp.broadcast_to(index, (steps + 1, path.shape[-1]))
        path = jnp.take_along_axis(path, index[:, None], 0)
    water = gusty_water(world, path, starts.water)
    shape = steps, path.shape[-1]
    return jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x, path.dtype), shape), water)


def _euler_quat(roll: jax.Array, pitch: jax.Array, yaw: jax.Array) -> jax.Array:
    """`[4, n]` quaternion (w, x, y, z) of roll, then pitch, then yaw [rad]."""
    (cr, sr), (cp, sp), (cy, sy) = ((jnp.cos(x / 2), jnp.sin(x / 2)) for x in (roll, pitch, yaw))
    w = cr * cp * cy + sr * sp * sy
    x = sr * cp * cy - cr * sp * sy
    y = cr * sp * cy + sr * cp * sy
    z = cr * cp * sy - sr * sp * cy
    return jnp.stack([w, x, y, z])
