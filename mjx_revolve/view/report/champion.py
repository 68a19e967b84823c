"""A replay of a run's champion: one episode, its score and measures."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import numpy as np

from mjx_revolve.episodes.fitness import Fitness
from mjx_revolve.episodes.scoring import replay_key
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.motion import Motion, count_finite, replay_motion
from mjx_revolve.view.report.record import RunRecord, number
from mjx_revolve.view.sensor_log import SensorTrace, trace_sensors

# A replay with a score further than this from the recorded mean counts as another episode: standard
# deviations of single episodes, and a share of the score itself if those hardly differ.
_DEVIATIONS, _SHARE = 5.0, 0.05


@dataclass(frozen=True, eq=False)
class ChampionReplay:
    """A champion's episode.

    Attributes:
        motion: up to the first row that is not finite.
        score: of this episode; NaN where it blew up.
        measures: of this episode, as in `metrics.csv`.
        traces: readings of the declared sensors, up to the same row.
    """

    motion: Motion
    score: float
    measures: dict[str, float]
    traces: tuple[SensorTrace, ...] = ()


def replay_champion(record: RunRecord, fitness: Fitness) -> ChampionReplay:
    """Simulates a run's champion.

    Args:
        record: the run; differences from the recorded score are added to its problems.
        fitness: of its configuration, with any seed.

    Returns:
        The first of the fresh starts on which the champion was evaluated.

    Raises:
        InputError: there is no champion, or it is another controller's.
    """
    if record.genes is None or record.config is None:
        raise InputError(record.label, "a champion and a configuration", "none")
    if len(record.genes) != fitness.num_genes:
        wanted = f"{fitness.num_genes}, as config.yaml has it"
        raise InputError("champion/genes.yaml: genes", wanted, len(record.genes))
    key = replay_key(record.config.evolution.seed)
    trajectory: Trajectory = jax.tree.map(np.asarray, fitness.replay(record.genes, key))
    score, measures = fitness.judge(trajectory, key)
    count = count_finite(trajectory.qpos)
    if count < 2:
        raise InputError("the champion's replay is not finite from its first step on")
    if count < len(trajectory.qpos):
        record.note("changed", f"the replay blows up after {float(trajectory.time[count]):.3g} s")
    _compare(record, score)
    motion = replay_motion(fitness, trajectory, key)
    finite = jax.tree.map(lambda x: x[:count] if np.ndim(x) else x, trajectory)
    return ChampionReplay(motion, score, measures, trace_sensors(fitness, finite, key))


def _compare(record: RunRecord, score: float) -> None:
    """Notes a replay with another score than the run recorded."""
    mean, std = (number(record.champion.get(name)) for name in ("score", "score_std"))
    if mean is None or std is None or not record.is_finished:
        return
    # What is recorded is the deviation of means over so many episodes.
    single = std * math.sqrt(record.trials)
    allowed = max(_DEVIATIONS * single, _SHARE * abs(mean))
    if not abs(score - mean) <= allowed:
        record.note(
            "changed",
            f"the replay scores {score:.3g}, but the run recorded {mean:.3g} ± {std:.2g}: the "
            "simulator has changed since, or files of the run have",
        )
