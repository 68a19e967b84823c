"""A life: what bodies learn between birth and judgement, all of them at once.

Each body's brains are searched by an evosax strategy of its own, around the brain that it was born
with. The score of an individual is that of the best brain it has tried. What one body does never
depends on the others: keys come of its number, and blocks have a fixed shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from mjx_revolve.body.tree import Morphology
from mjx_revolve.episodes.bodies_config import LearningConfig
from mjx_revolve.evolution.body_fitness import BodyFitness
from mjx_revolve.evolution.brains import Brains, Layout
from mjx_revolve.evolution.individuals import Individual
from mjx_revolve.evolution.pool import Pool
from mjx_revolve.evolution.strategies import Strategy, make_strategy
from mjx_revolve.inputs.errors import InputError


def make_learner(settings: LearningConfig, size: int) -> Strategy | None:
    """The strategy by which a body learns; None where it just tries brains.

    Args:
        settings: of learning.
        size: length of the vectors that are searched.

    Returns:
        The strategy.

    Raises:
        InputError: there is no such strategy, or it cannot take the population size.
    """
    if settings.generations == 1:
        return None
    if settings.population_size < 2:
        raise InputError(
            "bodies.learning.population_size: expected at least 2, as there are "
            f"{settings.generations} generations to learn in; found 1"
        )
    try:
        return make_strategy(settings, size)
    except InputError as error:
        text = str(error)
        if text.startswith("evolution."):
            text = "bodies.learning." + text.removeprefix("evolution.")
        raise InputError(text) from None


@dataclass
class _Life:
    """One body while it learns."""

    individual: Individual
    layout: Layout
    key: jax.Array
    birth: np.ndarray
    state: Any = None
    tried: Any = None
    best: float = float("nan")
    learnt: np.ndarray | None = None
    measures: dict[str, float] | None = None


def live(
    pool: Pool, learner: Strategy | None, individuals: Sequence[Individual], key: jax.Array
) -> list[Individual]:
    """Lets individuals live and learn.

    Args:
        pool: a pool over a `BodyFitness`.
        learner: from `make_learner`.
        individuals: new-born ones.
        key: of the generation: draws the episodes' starts and water, the same for all individuals
            and throughout their lives, so that what they try can be compared.

    Returns:
        The individuals with what they have learnt, their scores and measures.
    """
    fitness: BodyFitness = pool.fitness
    settings, brains = fitness.bodies.learning, fitness.brains
    key_starts, key_learn = jax.random.split(key)
    lives = []
    for individual in individuals:
        layout = fitness.layout(individual.body)
        birth = brains.to_vector(individual.brain, layout)
        lives.append(
            _Life(individual, layout, jax.random.fold_in(key_learn, individual.number), birth)
        )
    for round_ in range(settings.generations):
        for life in lives:
            _ask(life, learner, settings, round_)
        genes = [brains.express(life.tried, life.layout) for life in lives]
        scored = evaluate(pool, [life.individual for life in lives], genes, key_starts)
        for life, (scores, measures) in zip(lives, scored, strict=True):
            _tell(life, learner, scores, measures, round_)
    return [_end(life, brains, settings.trials) for life in lives]


def _ask(life: _Life, learner: Strategy | None, settings: LearningConfig, round_: int) -> None:
    """The brains to be tried next; the very first is the one that the body was born with."""
    key = jax.random.fold_in(life.key, 2 * round_)
    if learner is None:
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
        noise = rng.standard_normal((settings.population_size, len(life.birth)))
        life.tried = (life.birth + settings.std_init * noise).astype(np.float32)
    else:
        if life.state is None:
            life.state = learner.init(life.key, life.birth)
        tried, life.state = learner.ask(key, life.state)
        # A strategy may have run into numbers that are none; what it knows is then of no use.
        life.tried = np.where(np.isfinite(tried), tried, life.birth).astype(np.float32)
    if round_ == 0:
        life.tried = np.concatenate([life.birth[None], life.tried[1:]])


def _tell(
    life: _Life, learner: Strategy | None, scores: np.ndarray, measures: Any, round_: int
) -> None:
    if learner is not None:
        key = jax.random.fold_in(life.key, 2 * round_ + 1)
        life.state = learner.tell(key, life.tried, scores, life.state)
    if not np.isfinite(scores).any():
        return
    best = int(np.nanargmax(np.where(np.isfinite(scores), scores, np.nan)))
    # Written so that whatever is finite beats nothing.
    if not scores[best] <= life.best:
        life.best, life.learnt = float(scores[best]), life.tried[best]
        life.measures = {name: float(values[best]) for name, values in measures.items()}


def _end(life: _Life, brains: Brains, trials: int) -> Individual:
    """What comes of a life."""
    if life.learnt is None:
        return replace(life.individual, trials=trials)
    genes = brains.express(life.learnt, life.layout)[life.layout.columns]
    return replace(
        life.individual,
        learnt=brains.from_vector(life.learnt, life.layout),
        genes=tuple(map(float, genes)),
        score=life.best,
        measures=life.measures or {},
        trials=trials,
    )


def evaluate(
    pool: Pool, individuals: Sequence[Individual], genes: Sequence[np.ndarray], key: jax.Array
) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Scores several brains of each of several bodies.

    Args:
        pool: a pool over a `BodyFitness`.
        individuals: whose bodies.
        genes: `[L, num_genes]` for each of them, of any length.
        key: draws the episodes' starts and water.

    Returns:
        For each body, `[L]` scores, NaN where a rollout blew up, and `[L]` measures.
    """
    fitness: BodyFitness = pool.fitness
    owner = np.repeat(np.arange(len(genes)), [len(g) for g in genes])
    rows = np.concatenate(genes)
    mine = [np.flatnonzero(owner == k) for k in range(len(genes))]
    # Blocks of rows: of one body each, or across bodies of about a size, as a block takes as long
    # as its largest body.
    size, groups = pool.block or len(rows), mine
    if not fitness.alone:
        order = sorted(range(len(mine)), key=lambda k: _size(individuals[k].body), reverse=True)
        groups = [np.concatenate([mine[k] for k in order])]
    cut = [g[start : start + size] for g in groups for start in range(0, len(g), size)]
    blocks = []
    for part in cut:
        # The last block is filled up with its own first row: one shape, one program.
        full = np.concatenate([part, np.full(size - len(part), part[0])])
        bodies, which = np.unique(owner[full], return_inverse=True)
        blocks.append((rows[full], which.astype(np.int32), [individuals[k].body for k in bodies]))
    scores = np.full(len(rows), np.nan, np.float32)
    measures: dict[str, np.ndarray] = {}
    for part, (found, figures) in zip(cut, pool.score(blocks, key), strict=True):
        scores[part] = np.asarray(found)[: len(part)]
        for name, values in figures.items():
            whole = measures.setdefault(name, np.full(len(rows), np.nan, np.float32))
            whole[part] = np.asarray(values)[: len(part)]
    scores[~(scores > fitness.worst_score)] = np.nan
    return [(scores[k], {name: values[k] for name, values in measures.items()}) for k in mine]


def _size(body: Morphology) -> tuple[int, int]:
    """What the step of a body costs, to be compared with others'."""
    return body.num_hinges, len(body.modules)
