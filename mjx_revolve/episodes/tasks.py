"""Tasks: from the track of an episode to measures and a score. Knows nothing of simulators.

A task is a plain function of a `Track` and the task's settings (`config.TaskConfig`). A task of
one's own stands in a file of one's own: see `find_task`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.own_code import call_own, load_own, parse_own, short_name
from mjx_revolve.numerics.spatial import safe_norm

# Units of the tasks' scores.
UNITS = {
    "directed_swim": "body lengths/s",
    "speed": "body lengths/s",
    "crawl": "body lengths/s",
    "reach_target": "body lengths",
    "hold_depth": "body lengths",
}


@dataclass(frozen=True)
class Track:
    """An episode of many individuals, sampled at equal intervals after the settling time.

    Attributes:
        position: `[S, 3, lanes]` core, world frame [m]; the first row is where counting starts.
        clearance: `[S, lanes]` height of the core above the bed, infinite without one [m].
        energy: `[S, lanes]` work of the servos since the row before, summed without sign [J].
        interval: time between rows [s].
        start_height: height of the core at the episode's start, world frame [m].
        length: body length, the robot's largest extent at rest [m].
        weight: of the robot in air [N].
        surface_height: [m].
    """

    position: jax.Array
    clearance: jax.Array
    energy: jax.Array
    interval: float
    start_height: jax.Array
    length: float
    weight: float
    surface_height: jax.Array | float

    @property
    def duration(self) -> float:
        """Counted time [s]."""
        return self.interval * (self.position.shape[0] - 1)


def _keeping(error: jax.Array, tolerance: float) -> jax.Array:
    """1 within the tolerance, 0 beyond twice it, a smooth step between."""
    beyond = jnp.clip(jnp.abs(error) / tolerance - 1, 0, 1)
    return 1 - beyond * beyond * (3 - 2 * beyond)


def _keeps_depth(track: Track, settings: Any) -> jax.Array:
    """`[S - 1, lanes]` share of each interval's progress that counts."""
    middle = (track.position[1:, 2] + track.position[:-1, 2]) / 2
    return _keeping(middle - track.start_height, settings.depth_tolerance)


def directed_swim(track: Track, settings: Any) -> jax.Array:
    """Progress along a direction while the robot keeps its depth [body lengths/s]."""
    direction = np.asarray(settings.direction, float) / np.linalg.norm(settings.direction)
    moved = jnp.diff(track.position, axis=0)
    along = sum(float(direction[i]) * moved[:, i] for i in range(3))
    counted = jnp.sum(along * _keeps_depth(track, settings), 0)
    return counted / (track.duration * track.length)


def speed(track: Track, settings: Any) -> jax.Array:
    """Net horizontal speed in any direction while the robot keeps its depth [body lengths/s]."""
    counted = jnp.diff(track.position[:, :2], axis=0) * _keeps_depth(track, settings)[:, None]
    return safe_norm(tuple(jnp.sum(counted, 0))) / (track.duration * track.length)


def reach_target(track: Track, settings: Any) -> jax.Array:
    """How much nearer to the target the robot ends than it began [body lengths]."""
    target = np.asarray(settings.target, float)
    away = [
        safe_norm(tuple(row[i] - target[i] for i in range(3)))
        for row in (track.position[0], track.position[-1])
    ]
    return (away[0] - away[1]) / track.length


def hold_depth(track: Track, settings: Any) -> jax.Array:
    """Minus the root mean square distance from the start's depth [body lengths]."""
    error = (track.position[:, 2] - track.start_height) / track.length
    # The tiny term keeps the gradient finite where the error is 0.
    return -jnp.sqrt(jnp.mean(error * error, 0) + 1e-12)


def crawl(track: Track, settings: Any) -> jax.Array:
    """Progress along a direction while the core stays near the bed [body lengths/s]."""
    direction = np.asarray(settings.direction, float) / np.linalg.norm(settings.direction)
    moved = jnp.diff(track.position, axis=0)
    along = sum(float(direction[i]) * moved[:, i] for i in range(3))
    middle = (track.clearance[1:] + track.clearance[:-1]) / 2
    counted = jnp.sum(along * _keeping(middle, settings.depth_tolerance), 0)
    return counted / (track.duration * track.length)


TASKS: Mapping[str, Callable[[Track, Any], jax.Array]] = {
    "directed_swim": directed_swim,
    "speed": speed,
    "reach_target": reach_target,
    "hold_depth": hold_depth,
    "crawl": crawl,
}


def find_task(settings: Any, source: str = "config") -> Callable[[Track, Any], jax.Array]:
    """The function that scores a task.

    Args:
        settings: a `config.TaskConfig`. Its `type` is a name in `TASKS`, or FILE.py:FUNCTION for a
            function of the user's own: it takes a `Track` and these settings, and returns `[lanes]`
            scores, higher is better, by JAX, so that it can be compiled.
        source: what messages call the configuration.

    Returns:
        (track, settings) → `[lanes]` scores.

    Raises:
        InputError: the file or the function is missing, or it does not score a track; one line
            says where.
    """
    if settings.type in TASKS:
        return TASKS[settings.type]
    name = settings.type
    function = load_own(name, f"{source}: task.type")
    rows, lanes = 7, 3  # unlike numbers, so that an axis taken for another shows

    def score(
        position: jax.Array, clearance: jax.Array, energy: jax.Array, start: jax.Array
    ) -> Any:
        return function(Track(position, clearance, energy, 0.1, start, 0.5, 1.0, 0.0), settings)

    shapes = [(rows, 3, lanes), (rows, lanes), (rows, lanes), (lanes,)]
    given = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    what = f"{short_name(name)} to score a track"
    found = call_own(name, what, jax.eval_shape, score, *given)
    if not isinstance(found, jax.ShapeDtypeStruct) or found.shape != (lanes,):
        own = parse_own(name)
        assert own is not None
        shown = list(found.shape) if isinstance(found, jax.ShapeDtypeStruct) else type(found)
        raise InputError(
            f"{own.path}: {own.function}: expected a score for each lane, [{lanes}] for a position "
            f"of [{rows}, 3, {lanes}]; found {shown}"
        )
    return function


def score_unit(name: str) -> str:
    """Unit of a task's scores.

    Args:
        name: `type` of a task. Own functions say it in brackets in the first line of their
            docstring, as ours do: `Mean height above the bed [body lengths].`

    Returns:
        The unit; "" where it is not known.
    """
    if name in UNITS:
        return UNITS[name]
    try:
        text = inspect.getdoc(load_own(name, "task.type")) or ""
    except InputError:
        return ""
    units = re.findall(r"\[([^\[\]]+)\]", text.partition("\n")[0])
    return units[-1] if units else ""


def measure(track: Track) -> dict[str, jax.Array]:
    """What is worth knowing of an episode beside its score.

    Args:
        track: the episode.

    Returns:
        `[lanes]` each: `speed_m_s` net speed [m/s], `speed_bl_s` the same in body lengths [1/s],
        `straightness` net distance over path length [-], `energy_j` servo work [J],
        `cost_of_transport` energy over weight in air times net distance [-], `depth_m` mean depth
        of the core [m], `depth_error_m` root mean square distance from the start's depth [m].
    """
    moved = jnp.diff(track.position, axis=0)
    net = safe_norm(tuple(jnp.sum(moved, 0)))
    path = jnp.sum(safe_norm(tuple(moved[:, i] for i in range(3))), 0)
    energy = jnp.sum(track.energy[1:], 0)
    error = track.position[:, 2] - track.start_height
    return {
        "speed_m_s": net / track.duration,
        "speed_bl_s": net / (track.duration * track.length),
        "straightness": net / jnp.maximum(path, 1e-9),
        "energy_j": energy,
        # A robot that stays where it is has no cost of transport; a millimetre bounds the number.
        "cost_of_transport": energy / (track.weight * jnp.maximum(net, 1e-3)),
        "depth_m": jnp.mean(track.surface_height - track.position[:, 2], 0),
        "depth_error_m": jnp.sqrt(jnp.mean(error * error, 0) + 1e-12),
    }
