"""Scores of individuals from their episodes: sampling of tracks, limits, means over trials.

Episodes stand side by side in lanes: individual after individual, and within each the episodes of
its trials. Each is scored where it was run, chunk by chunk, so that no track outlives its chunk.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from mjx_revolve.engine.plant import BodyGeometry
from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.episodes.tasks import Task, start_at_depth
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.bed import highest_bed
from mjx_revolve.water.flow import drift_speed
from mjx_revolve.water.world import World

# Score of a rollout that blew up. Finite, because optimisers' averages and sorts are not made for
# infinities, and below anything that a task gives: lower scores of its own count as `LEAST`.
WORST = -1e3
LEAST = float(np.nextafter(np.float32(WORST), np.float32(0)))

# No robot of hinges swims or sinks this fast: servos, drag and weight allow a tenth of it. A
# rollout that gets further than this speed allows counts as blown up [m/s].
_FASTEST = 3.0
# Thrusters are faster. What F newtons drive moves at √F m/s if it is 10 cm wide with a C_d of 0.25
# on its frontal area: less than bodies of modules have. A choice [N s²/m²].
_LEAST_DRAG = 1.0

# Recorded rates, which are 0 where nothing moves.
RATES = ("energy", "water_velocity")

# Fresh episodes on which a champion is evaluated, and the stream of random numbers that draws them,
# which no generation uses.
REPORT_EPISODES = 16
REPORT_STREAM = 2**32 - 2
# The same of a champion's passport (`passport`).
PASSPORT_STREAM = 2**32 - 3

# XLA:CPU sums so many numbers or more in an order that depends on how many sums there are.
_REORDERED = 32

# The track is sampled at least this often [s].
_INTERVAL = 0.1


class Scores(NamedTuple):
    """Results of episodes.

    Attributes:
        score: `[lanes]`, higher is better.
        sane: `[lanes]` whether the rollout did not blow up; if it did, its score means nothing.
        measures: `[lanes]` each, see `measures.measure`.
    """

    score: jax.Array
    sane: jax.Array
    measures: Mapping[str, jax.Array]


def sample_rows(task: TaskConfig, timestep: float) -> tuple[int, int]:
    """Timesteps between the rows of a track, and their number before the settling time is cut."""
    every = max(1, int(_INTERVAL / timestep + 1e-6))
    return every, max(2, round(task.duration / (every * timestep)))


def list_episodes(population: int, trials: int) -> tuple[jax.Array, jax.Array]:
    """All episodes of a population: `[P trials]` the individual, and which of its trials."""
    lane = jnp.arange(population * trials, dtype=jnp.int32)
    return lane // trials, lane % trials


def first_scored_row(task: TaskConfig, timestep: float) -> int:
    """The row of a track at which the task begins to count; row 0 is one interval late."""
    every, rows = sample_rows(task, timestep)
    return min(int(task.settle / (every * timestep) + 1e-6), rows - 2)


def extend_track(
    track: Mapping[str, jax.Array], rows: Mapping[str, jax.Array], first: Int[Array, "..."]
) -> dict[str, jax.Array]:
    """A track with new rows; all rows after them repeat the last one.

    Rates (`RATES`), which are 0 for robots at rest in still water, are 0 in the repeated rows.

    Args:
        track: `[S, ..., lanes]` each.
        rows: `[n, ..., lanes]` each.
        first: row of the track that the first of them becomes; one for all lanes if there are
            several.

    Returns:
        The track.
    """
    found = {}
    for name, new in rows.items():
        count, old = new.shape[0], track[name]
        index = jnp.arange(old.shape[0]).reshape(-1, *[1] * (new.ndim - 1)) - first
        later = new if count == 1 else new[jnp.clip(index.reshape(-1), 0, count - 1)]
        if name in RATES:
            later = jnp.where(index < count, later, 0.0)
        found[name] = jnp.where(index >= 0, later, old)
    return found


def max_distance(settings: TaskConfig, world: World, geometry: BodyGeometry) -> Any:
    """The distance from its start [m] beyond which a rollout counts as blown up.

    `geometry`: of the bodies, `[lanes]` or one.
    """
    drift = drift_speed(world) + 4 * settings.current_std
    fall = 0.5 * world.gravity * settings.duration**2
    fastest = (_FASTEST**2 + geometry.thrust / _LEAST_DRAG) ** 0.5
    swum = (fastest + drift) * settings.duration + 4 * settings.start_position
    return swum + geometry.sinks * fall + geometry.length


def may_touch_bed(task: Task, settings: TaskConfig, world: World, reach: float) -> bool:
    """Whether the bed is within `max_distance` of an episode; if not, the step needs no contact.

    `max_distance` is the way at top speed, plus the fall of a robot that sinks. A rollout that
    gets further counts as blown up, so no robot can pass through a bed that is left out. A task's
    own start may place robots anywhere.
    """
    if world.bed is None:
        return False
    if task.start is not start_at_depth:
        return True
    lowest = world.surface_height - settings.depth - reach
    return task.on_bed or lowest < highest_bed(world.bed, reach)


def pick_near(choices: Mapping[int, float], wanted: object, place: str, unit: str) -> int:
    """The key of the choice that a number means.

    Raises:
        InputError: it is none of them, to a thousandth.
    """
    if isinstance(wanted, int | float | np.number) and not isinstance(wanted, bool):
        for key, known in choices.items():
            if abs(known - wanted) < 1e-3 * known:
                return key
    shown = ", ".join(f"{known:.4g}" for known in choices.values())
    raise InputError(place, f"one of {shown} {unit}", repr(wanted))


def average_trials(scores: Scores, trials: int) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Scores and measures of individuals from those of their episodes.

    Args:
        scores: of all episodes, as `list_episodes` has them.
        trials: episodes of each individual.

    Returns:
        `[P]` mean scores, `WORST` where one of the rollouts blew up, and `[P]` mean measures.
    """

    def mean(x: jax.Array) -> jax.Array:
        rows = x.reshape(-1, trials)
        if trials < _REORDERED:
            return jnp.mean(rows, 1)
        total, _ = jax.lax.scan(lambda t, row: (t + row, None), jnp.zeros_like(rows[:, 0]), rows.T)
        return total / trials

    sane = jnp.all(scores.sane.reshape(-1, trials), 1)
    measures = {name: mean(values) for name, values in scores.measures.items()}
    return jnp.where(sane, jnp.maximum(mean(scores.score), LEAST), WORST), measures


def replay_key(seed: int) -> jax.Array:
    """The first of the fresh starts on which a run's champion is evaluated.

    Args:
        seed: of the run.

    Returns:
        A key for `Fitness.replay`.
    """
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), REPORT_STREAM), 0)
