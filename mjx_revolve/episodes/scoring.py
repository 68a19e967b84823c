"""Scores of individuals from their episodes.

Which episodes there are, how their tracks are sampled and judged, and what comes of several of one
individual.

Episodes stand side by side in lanes: individual after individual, and within each the episodes of
its trials. Each is scored where it was run, chunk by chunk, so that no track outlives its chunk.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.plant import Figure
from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.episodes.measures import measure
from mjx_revolve.episodes.tasks import Task, Track
from mjx_revolve.water.bed import bed_height
from mjx_revolve.water.world import World

# Score of a rollout that blew up. Finite, because optimisers' averages and sorts are not made for
# infinities, and below anything that a task gives.
WORST = -1e3

# Nothing made of these modules swims or sinks this fast: servos, drag and weight allow a tenth of
# it. An individual that gets further than this allows has blown up [m/s].
_FASTEST = 3.0

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
        measures: `[lanes]` each, see `measures.measure`.
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
    task: Task,
    settings: TaskConfig,
    world: World,
    recorded: Mapping[str, jax.Array],
    start_height: jax.Array,
    figure: Figure,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """What a task says of tracks, blown up or not.

    Args:
        task: what they are about.
        settings: of the task.
        world: the world.
        recorded: `position` and `energy`, and what else the task has recorded: fields of a `Track`,
            sampled as `sample_rows` has it, the settling time not cut off.
        start_height: `[lanes]` z of the core at the start [m].
        figure: of the bodies, `[lanes]` or one.

    Returns:
        `[lanes]` scores, and `[lanes]` measures (see `measures.measure`).
    """
    first = first_counted(settings, world.timestep)
    kept = {name: x[first:] for name, x in recorded.items()}
    place = kept["position"]
    clearance = jnp.full_like(place[:, 0], jnp.inf)
    if world.bed is not None:
        clearance = place[:, 2] - bed_height(world.bed, place[:, 0], place[:, 1])
    track = Track(
        clearance=clearance,
        interval=sample_rows(settings, world.timestep)[0] * world.timestep,
        start_height=start_height,
        length=figure.length,
        weight=figure.weight,
        surface_height=world.surface_height,
        num_hinges=figure.num_hinges,
        **kept,
    )
    measures = measure(track, settings.measures)
    return task.score(track, settings) - settings.energy_weight * measures["energy_j"], measures


def score_episodes(
    task: Task,
    settings: TaskConfig,
    world: World,
    recorded: Mapping[str, jax.Array],
    start: jax.Array,
    figure: Figure,
) -> Scores:
    """Scores and measures of episodes from their tracks.

    Args:
        task: what they are about.
        settings: of the task.
        world: the world.
        recorded: as of `judge_tracks`.
        start: `[3, lanes]` of the core [m].
        figure: of the bodies, `[lanes]` or one.

    Returns:
        The scores.
    """
    score, measures = judge_tracks(task, settings, world, recorded, start[2], figure)
    away = jnp.max(jnp.abs(recorded["position"] - start), (0, 1))
    # Written so that NaN counts as too far.
    sane = jnp.isfinite(score) & (away < farthest(settings, world, figure))
    return Scores(jnp.where(sane, score, WORST), sane, measures)


def farthest(settings: TaskConfig, world: World, figure: Figure) -> Any:
    """How far from its start an episode may lead; who gets further has blown up.

    Args:
        settings: of the task.
        world: the world.
        figure: of the bodies, `[lanes]` or one.

    Returns:
        The distance [m].
    """
    current = np.linalg.norm(world.current) + 4 * settings.current_std
    fall = 0.5 * world.gravity * settings.duration**2
    swum = (_FASTEST + current) * settings.duration + 4 * settings.start_position
    return swum + figure.sinks * fall + figure.length


def may_touch_bed(task: Task, settings: TaskConfig, world: World, figure: Figure) -> bool:
    """Whether the bed is within reach of an episode; if not, the step needs no contact.

    Reach is what a robot at `_FASTEST` covers, plus its fall where the water does not carry it. An
    individual that outruns it counts as blown up, so nothing can pass through an absent bed unseen.
    """
    if world.bed is None:
        return False
    reach = float(farthest(settings, world, figure))
    line = np.linspace(-reach, reach, 101)
    highest = float(np.max(bed_height(world.bed, *np.meshgrid(line, line))))
    return task.on_bed or world.surface_height - settings.depth - reach < highest


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
