"""Scores of individuals from their episodes.

Which episodes there are, how their tracks are sampled and judged, and what comes of several of one
individual.

Episodes stand side by side in lanes: individual after individual, and within each the episodes of
its trials. Each is scored where it was run, chunk by chunk, so that no track outlives its chunk.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.episodes.tasks import Track, measure
from mjx_revolve.water.bed import bed_height
from mjx_revolve.water.world import World

# Score of a rollout that blew up. Finite, because optimisers' averages and sorts are not made for
# infinities, and below anything that a task gives.
WORST = -1e3

# Fresh episodes on which a champion is judged, and the stream of random numbers that draws them,
# which no generation uses.
REPORT_EPISODES = 16
REPORT_STREAM = 2**32 - 2

# The track is sampled at least this often [s].
_INTERVAL = 0.1


class Scores(NamedTuple):
    """What is left of episodes.

    Attributes:
        score: `[lanes]`, higher is better.
        sane: `[lanes]` whether the rollout did not blow up; if it did, its score means nothing.
        measures: `[lanes]` each, see `tasks.measure`.
    """

    score: jax.Array
    sane: jax.Array
    measures: Mapping[str, jax.Array]


def sample_rows(task: TaskConfig, timestep: float) -> tuple[int, int]:
    """How the track of an episode is sampled.

    Args:
        task: its duration.
        timestep: [s].

    Returns:
        Timesteps between rows, and how many rows there are, before the settling time is cut off.
    """
    every = max(1, int(_INTERVAL / timestep + 1e-6))
    return every, max(2, round(task.duration / (every * timestep)))


def list_episodes(population: int, trials: int) -> tuple[jax.Array, jax.Array]:
    """All episodes of a population.

    Args:
        population: P, how many individuals.
        trials: episodes of each.

    Returns:
        `[P trials]` whose each is, and `[P trials]` which of that individual's, int32.
    """
    lane = jnp.arange(population * trials, dtype=jnp.int32)
    return lane // trials, lane % trials


def first_counted(task: TaskConfig, timestep: float) -> int:
    """The row of a track at which the task begins to count; row 0 is one interval late."""
    every, rows = sample_rows(task, timestep)
    return min(round(task.settle / (every * timestep)), rows - 2)


def judge_tracks(
    task: TaskConfig,
    score_track: Callable[[Track, TaskConfig], jax.Array],
    world: World,
    position: jax.Array,
    energy: jax.Array,
    start_height: jax.Array,
    length: Any,
    weight: Any,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """What a task says of tracks, blown up or not; arguments as of `score_episodes`.

    Args:
        task: what they are about.
        score_track: from `tasks.find_task`.
        world: the world.
        position: `[S, 3, lanes]` of the core, world frame [m].
        energy: `[S, lanes]` since the row before [J].
        start_height: `[lanes]` z of the core at the start [m].
        length: body length, a number or `[lanes]` [m].
        weight: in air, likewise [N].

    Returns:
        `[lanes]` scores, and `[lanes]` measures (see `tasks.measure`).
    """
    first = first_counted(task, world.timestep)
    kept = position[first:]
    clearance = jnp.full_like(kept[:, 0], jnp.inf)
    if world.bed is not None:
        clearance = kept[:, 2] - bed_height(world.bed, kept[:, 0], kept[:, 1])
    track = Track(
        position=kept,
        clearance=clearance,
        energy=energy[first:],
        interval=sample_rows(task, world.timestep)[0] * world.timestep,
        start_height=start_height,
        length=length,
        weight=weight,
        surface_height=world.surface_height,
    )
    measures = measure(track)
    return score_track(track, task) - task.energy_weight * measures["energy_j"], measures


def score_episodes(
    task: TaskConfig,
    score_track: Callable[[Track, TaskConfig], jax.Array],
    world: World,
    position: jax.Array,
    energy: jax.Array,
    start: jax.Array,
    length: Any,
    weight: Any,
    farthest: float,
) -> Scores:
    """Scores and measures of episodes from their tracks.

    Args:
        task: what they are about.
        score_track: from `tasks.find_task`.
        world: the world.
        position: `[S, 3, lanes]` of the core [m], S and the time between rows as `sample_rows` has
            them.
        energy: `[S, lanes]` since the row before [J].
        start: `[3, lanes]` [m].
        length: body length, a number or `[lanes]` [m].
        weight: in air, likewise [N].
        farthest: whoever gets further than this has blown up [m].

    Returns:
        The scores.
    """
    score, measures = judge_tracks(
        task, score_track, world, position, energy, start[2], length, weight
    )
    away = jnp.max(jnp.abs(position - start), (0, 1))
    # Written so that NaN counts as too far.
    sane = jnp.isfinite(score) & (away < farthest)
    return Scores(jnp.where(sane, score, WORST), sane, measures)


def average_trials(scores: Scores, trials: int) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Scores and measures of individuals from those of their episodes.

    Args:
        scores: of all episodes, as `list_episodes` has them.
        trials: episodes of each individual.

    Returns:
        `[P]` mean scores, `WORST` where one of the rollouts blew up, and `[P]` mean measures.
    """
    mean = lambda x: jnp.mean(x.reshape(-1, trials), 1)  # noqa: E731
    sane = jnp.all(scores.sane.reshape(-1, trials), 1)
    return jnp.where(sane, mean(scores.score), WORST), {
        name: mean(values) for name, values in scores.measures.items()
    }


def replay_key(seed: int) -> jax.Array:
    """The first of the fresh starts on which a run's champion is judged.

    Args:
        seed: of the run.

    Returns:
        A key for `Fitness.replay`.
    """
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), REPORT_STREAM), 0)
