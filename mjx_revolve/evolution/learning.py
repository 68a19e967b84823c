"""Learning of brains between birth and score, for all new bodies at once.

Each body's brains are searched by an evosax strategy of its own, around the brain of its birth. The
score of an individual is that of the best brain it has tried. The result for one body does not
depend on the others: keys follow from its number, and blocks have a fixed shape.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from mjx_revolve.body.tree import Morphology
from mjx_revolve.episodes.bodies_config import LearningConfig
from mjx_revolve.episodes.strategy_names import find_strategy
from mjx_revolve.evolution.blocks import Scored, join, take
from mjx_revolve.evolution.body_fitness import BodyFitness, Genes
from mjx_revolve.evolution.brains import GeneLayout
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.individuals import Individual
from mjx_revolve.evolution.strategies import Strategy, make_strategy
from mjx_revolve.inputs.errors import InputError


@dataclass(frozen=True)
class Perturbation:
    """Brains drawn around the inherited one; random search with the interface of a `Strategy`."""

    count: int
    std: float

    def init(self, key: jax.Array, mean: np.ndarray) -> np.ndarray:
        """The state: the brain of birth `[G]`."""
        return mean

    def ask(self, key: jax.Array, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Brains `[count, G]`, and the state."""
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
        return state + self.std * rng.standard_normal((self.count, len(state))), state

    def tell(
        self, key: jax.Array, population: np.ndarray, scores: np.ndarray, state: np.ndarray
    ) -> np.ndarray:
        """The same state."""
        return state


def make_learner(settings: LearningConfig, size: int) -> Strategy | Perturbation:
    """The strategy by which a body learns vectors of some size.

    Raises:
        InputError: there is no such strategy, or it cannot take the population size.
    """
    once = settings.generations == 1
    if settings.population_size < 2 and not once:
        least = f"at least 2, as there are {settings.generations} generations to learn in"
        raise InputError("bodies.learning.population_size", least, 1)
    try:
        if not once:
            return make_strategy(settings, size)
        find_strategy(settings.strategy)
        return Perturbation(settings.population_size, settings.std_init)
    except InputError as error:
        text = re.sub(r"(^|expected )evolution\.", r"\1bodies.learning.", str(error))
        raise InputError(text) from None


@dataclass
class _Learner:
    """One body while it learns: the strategy's state, the brains in trial, and the best so far."""

    individual: Individual
    layout: GeneLayout
    key: jax.Array
    birth: np.ndarray
    state: Any
    tried: np.ndarray
    best: tuple[float, np.ndarray, Mapping[str, float]] | None = None

    def ask(self, strategy: Strategy | Perturbation, turn: int) -> None:
        """Draws the brains to be tried next; the very first is the one of birth."""
        tried, self.state = strategy.ask(jax.random.fold_in(self.key, 2 * turn), self.state)
        if isinstance(strategy, Strategy) and strategy.name == "RandomSearch":
            tried = tried + self.birth  # evosax's has no mean
        # A strategy may have run into numbers that are not finite; its state is then of no use.
        self.tried = np.where(np.isfinite(tried), tried, self.birth).astype(np.float32)
        if turn == 0:
            self.tried = np.concatenate([self.birth[None], self.tried[1:]])
            if isinstance(strategy, Strategy):
                self.state = strategy.with_mean_first(self.state)

    def tell(self, strategy: Strategy | Perturbation, scored: Scored, turn: int) -> None:
        """Takes in the scores of the brains that were tried."""
        scores, measures = scored
        key = jax.random.fold_in(self.key, 2 * turn + 1)
        self.state = strategy.tell(key, self.tried, scores, self.state)
        if not np.isfinite(scores).any():
            return
        k = int(np.nanargmax(np.where(np.isfinite(scores), scores, np.nan)))
        if self.best is None or scores[k] > self.best[0]:
            found = {name: float(values[k]) for name, values in measures.items()}
            self.best = float(scores[k]), self.tried[k], found


def learn(
    executor: Executor, individuals: Sequence[Individual], key: jax.Array
) -> list[Individual]:
    """Optimises the brains of individuals.

    Args:
        executor: an executor over a `BodyFitness`.
        individuals: new ones.
        key: of the generation: draws the episodes' starts and water, the same for all individuals
            and turns, so that scores can be compared.

    Returns:
        The individuals with learnt brains, their scores and measures.
    """
    fitness: BodyFitness = executor.fitness
    settings, brains = fitness.bodies.learning, fitness.brains
    strategy = make_learner(settings, brains.size)
    key_starts, key_learn = jax.random.split(key)
    learners = []
    for one in individuals:
        layout, own = fitness.layout(one.body), jax.random.fold_in(key_learn, one.number)
        birth = brains.to_vector(one.brain, layout)
        learners.append(_Learner(one, layout, own, birth, strategy.init(own, birth), birth[None]))
    for turn in range(settings.generations):
        for each in learners:
            each.ask(strategy, turn)
        genes = [brains.express(each.tried, each.layout) for each in learners]
        scored = score_brains(executor, individuals, genes, key_starts)
        for each, found in zip(learners, scored, strict=True):
            each.tell(strategy, found, turn)
    return [_taught(each, fitness) for each in learners]


def _taught(learner: _Learner, fitness: BodyFitness) -> Individual:
    """The individual with its best brain."""
    one = replace(learner.individual, trials=fitness.bodies.learning.trials)
    if learner.best is None:
        return one
    score, vector, measures = learner.best
    learnt = fitness.brains.from_vector(vector, learner.layout)
    genes = fitness.brains.express(vector, learner.layout)[learner.layout.columns]
    genes = tuple(map(float, genes))
    return replace(one, learnt=learnt, genes=genes, score=score, measures=measures)


def evaluate_again(
    executor: Executor, individuals: Sequence[Individual], key: jax.Array
) -> list[Individual]:
    """Evaluates learnt brains on other episodes of a generation: explicit averaging over time.

    Scores of one generation are partly luck, which selection of the best adds up; see Jin and
    Branke, "Evolutionary optimization in uncertain environments — a survey", IEEE Trans.
    Evolutionary Computation 9(3), 2005. The episodes are not those on which the best brains of
    `learn` were chosen: those scores are the highest of several and do not count.

    Args:
        executor: an executor over a `BodyFitness`.
        individuals: those of which every trial failed, or that are lost with their workers now,
            stay as they are.
        key: of the generation, as for `learn`.

    Returns:
        The individuals; scores and measures are means over all of their evaluations here, NaN if
        one blew up.
    """
    again = [one for one in individuals if one.learnt is not None]
    genes = [learnt_genes(executor.fitness, one) for one in again]
    means = {}
    scored = score_brains(executor, again, genes, jax.random.fold_in(key, 2)) if again else []
    for one, (scores, measures) in zip(again, scored, strict=True):
        if np.isnan(scores[0]):
            continue
        count = one.evaluations + 1
        old = one.measures.items()
        mean = {name: _add_to_mean(x, float(measures[name][0]), count) for name, x in old}
        blew_up = np.isneginf(scores[0])
        score = np.nan if blew_up else _add_to_mean(one.score, float(scores[0]), count)
        means[one.number] = replace(one, score=score, measures=mean, evaluations=count)
    return [means.get(one.number, one) for one in individuals]


def _add_to_mean(mean: float, value: float, count: int) -> float:
    """The mean of `count` values, from that of all but the last; of one, the value itself."""
    return value if count == 1 else (1 - 1 / count) * mean + 1 / count * value


def learnt_genes(fitness: BodyFitness, individual: Individual) -> np.ndarray:
    """`[1, num_genes]` genes of a learnt brain, for `score_brains`."""
    genes = np.array([individual.genes], np.float32)
    return fitness.mixed.pad_genes(genes, fitness.build(individual.body))


def score_brains(
    executor: Executor, individuals: Sequence[Individual], genes: Genes, key: jax.Array
) -> list[Scored]:
    """Scores several brains of each of several bodies.

    Args:
        executor: an executor over a `BodyFitness`.
        individuals: their bodies are scored.
        genes: `[L, num_genes]` for each of them, of any length.
        key: draws the episodes' starts and water.

    Returns:
        For each body, `[L]` scores, −inf where a rollout blew up and NaN where its workers failed,
        and `[L]` measures.
    """
    fitness: BodyFitness = executor.fitness
    owner = np.repeat(np.arange(len(genes)), [len(g) for g in genes])
    rows = np.concatenate(genes)
    mine = [np.flatnonzero(owner == k) for k in range(len(genes))]
    # Blocks of rows: of one body each, or across bodies of about a size, as a block takes as long
    # as its largest body.
    size, groups = executor.block or len(rows), mine
    if not fitness.one_body_per_block:
        order = sorted(range(len(mine)), key=lambda k: _size(individuals[k].body), reverse=True)
        groups = [np.concatenate([mine[k] for k in order])]
    cut = [g[start : start + size] for g in groups for start in range(0, len(g), size)]
    blocks = []
    for part in cut:
        # The last block is filled up with its own first row: one shape, one program.
        full = np.concatenate([part, np.full(size - len(part), part[0])])
        bodies, which = np.unique(owner[full], return_inverse=True)
        blocks.append((rows[full], which.astype(np.int32), [individuals[k].body for k in bodies]))
    found = zip(executor.score(blocks, key), cut, strict=True)
    scores, measures = join([take(scored, slice(len(part))) for scored, part in found])
    scores[scores <= fitness.worst_score] = -np.inf
    place = np.argsort(np.concatenate(cut))
    return [take((scores, measures), place[k]) for k in mine]


def _size(body: Morphology) -> tuple[int, int]:
    """A body's order by the cost of its step."""
    return body.num_hinges, len(body.modules)
