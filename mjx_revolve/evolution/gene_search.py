"""The evolution of one body's genes: ask a strategy for a population, evaluate it, tell the scores.

The state between two generations is a `GeneSearch`, a plain value; the random numbers of generation
`g` come from `fold_in(root key, g)` alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_revolve.episodes.config import EvolutionConfig
from mjx_revolve.episodes.passport import Passport, make_passport
from mjx_revolve.evolution.blocks import Scored, take
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.generations import Champion, Evolution, Generation, choose_candidate
from mjx_revolve.evolution.individuals import NUM_ELITES
from mjx_revolve.evolution.strategies import STD_FLOOR, Strategy, make_strategy
from mjx_revolve.inputs.errors import InputError

# Up to this many rows, padding the candidates to a whole population, for which the program is
# compiled already, is quicker than compiling a program for a few rows.
_FILL_UP_TO = 128
# A population this narrow (in units of the step-size floor) for this many generations has stalled.
_STALL_SPREAD = 2.0
_STALL_GENERATIONS = 10


@dataclass(frozen=True)
class GeneSearch:
    """State of a search over genes between two generations.

    Attributes:
        generation: number of finished generations.
        state: the strategy's state.
        elites: `[NUM_ELITES, G]` the best of single generations, best first; `elites[0]` is the
            champion so far.
        elite_scores: `[NUM_ELITES]` their scores, on their own generation's starts; -inf: none yet.
        elite_generations: `[NUM_ELITES]` their generations.
        latest: `[G]` the last generation's best.
        evaluations: individuals that were scored.
        stalled: generations for which the population has been too narrow.
        restarts: number of restarts of the strategy.
        seconds: time spent in generations [s]; not reproducible.
    """

    generation: int
    state: dict[str, Any]
    elites: np.ndarray
    elite_scores: np.ndarray
    elite_generations: np.ndarray
    latest: np.ndarray
    evaluations: int = 0
    stalled: int = 0
    restarts: int = 0
    seconds: float = 0.0


class _Proposal(NamedTuple):
    """A population, its search, and the keys of `evaluate` and `tell`."""

    search: GeneSearch
    population: np.ndarray
    key_evaluate: jax.Array
    key_tell: jax.Array


# A search's numbers in a checkpoint; with the strategy's state and the root key they are all.
_COUNTERS = ("generation", "evaluations", "stalled", "restarts", "seconds")
_ARRAYS = ("elites", "elite_scores", "elite_generations", "latest")


class GeneEvolution(Evolution[GeneSearch, _Proposal, Scored]):
    """Evolves genes with an evosax strategy; see `generations.Evolution`.

    A strategy is started anew at random genes, the champion being kept, when its population has
    shrunk to the step-size floor for ten generations or its numbers are no longer finite.
    """

    def __init__(self, config: EvolutionConfig, executor: Executor) -> None:
        """Prepares a search.

        Args:
            config: strategy, sizes and seed.
            executor: scores a population, higher is better. Scores that are not finite, or at most
                its `worst_score`, count as failures, worse than all others.

        Raises:
            InputError: the strategy is unknown, or cannot take the population size or a parameter.
        """
        self.config, self.executor = config, executor
        self.strategy: Strategy = make_strategy(config, executor.num_genes)
        self.root_key = jax.random.key(config.seed)

    def start(self) -> GeneSearch:
        """The search before its first generation, around zero genes."""
        num_genes = self.executor.num_genes
        return GeneSearch(
            generation=0,
            state=self.strategy.init(jax.random.fold_in(self.root_key, 0)),
            elites=np.zeros((NUM_ELITES, num_genes), np.float32),
            elite_scores=np.full(NUM_ELITES, -np.inf, np.float32),
            elite_generations=np.zeros(NUM_ELITES, np.int32),
            latest=np.zeros(num_genes, np.float32),
        )

    def ask(self, search: GeneSearch) -> _Proposal:
        """The next population, from a new start where the search has stalled."""
        key = jax.random.fold_in(self.root_key, search.generation + 1)
        key_ask, key_evaluate, key_tell, key_restart = jax.random.split(key, 4)
        if search.stalled >= _STALL_GENERATIONS:
            search = self._restart(search, key_restart)
        population, state = self.strategy.ask(key_ask, search.state)
        if not np.isfinite(population).all():
            search = self._restart(search, key_restart)
            population, state = self.strategy.ask(key_ask, search.state)
        return _Proposal(replace(search, state=state), population, key_evaluate, key_tell)

    def _restart(self, search: GeneSearch, key: jax.Array) -> GeneSearch:
        """A new start from random genes rather than from the champion's, where it just stalled."""
        key_mean, key_init = jax.random.split(key)
        mean = self.strategy.std_init * jax.random.normal(key_mean, (self.executor.num_genes,))
        state = self.strategy.init(key_init, mean)
        return replace(search, state=state, restarts=search.restarts + 1, stalled=0)

    def evaluate(self, proposal: _Proposal) -> Scored:
        """Scores and measures of the population."""
        return self._score(proposal.population, proposal.key_evaluate)

    def _score(self, population: np.ndarray, key: jax.Array) -> Scored:
        scores, measures = self.executor.evaluate(population, key)
        scores = np.where(scores <= self.executor.worst_score, np.nan, scores)
        if scores.shape != population.shape[:1]:
            raise ValueError(
                f"fitness: expected {len(population)} scores; found shape {scores.shape}"
            )
        return scores, measures

    def tell(self, proposal: _Proposal, results: Scored) -> Generation[GeneSearch]:
        """The search with the strategy's state and the elites brought up to date.

        Columns: step_size (root mean square over the genes of the population's standard deviation),
        failed (rollouts without a finite score), restarts, the best individual's measures.
        """
        (scores, measures), population, search = results, proposal.population, proposal.search
        state = self.strategy.tell(proposal.key_tell, population, scores, search.state)
        deviation = float(np.sqrt(np.mean(np.var(population.astype(np.float64), axis=0))))
        narrow = deviation <= _STALL_SPREAD * STD_FLOOR * self.config.std_init
        best = int(np.argmax(np.where(np.isfinite(scores), scores, -np.inf)))
        search = replace(
            _update_elites(search, population[best], scores[best]),
            generation=search.generation + 1,
            state=state,
            evaluations=search.evaluations + len(population),
            stalled=search.stalled + 1 if narrow else 0,
        )
        columns = {
            "step_size": deviation,
            "failed": int(np.sum(~np.isfinite(scores))),
            "restarts": search.restarts,
            **{name: float(values[best]) for name, values in measures.items()},
        }
        return Generation(
            search, scores, float(search.elite_scores[0]), columns, len(population),
            search.evaluations,
        )  # fmt: skip

    def best(self, search: GeneSearch) -> Champion | None:
        """The best of all generations; None: every rollout failed."""
        if not np.isfinite(search.elite_scores[0]):
            return None
        origin = f"best of generation {search.elite_generations[0]}"
        return Champion(search.elites[0], float(search.elite_scores[0]), origin)

    def choose_champion(self, search: GeneSearch) -> Champion:
        """The best of the elites, the last best, the last mean and zero genes on fresh starts.

        Every search starts at zero genes, a robot that does not move: the champion of a search
        misled by noise is at least no worse than that. Where a passport is required, the first of
        the best few that passes.
        """
        origins = [f"best of generation {g}" for g in search.elite_generations]
        candidates = [*zip(origins, search.elites, strict=True)]
        candidates.append(("best of the last generation", search.latest))
        mean = self.strategy.mean(search.state)
        if mean is not None and np.isfinite(mean).all():
            candidates.append(("mean of the last distribution", mean))
        # Last, so that evolved genes win a tie.
        zero = np.zeros(self.executor.num_genes)
        candidates.append(("zero genes: nothing that evolved is better", zero))
        genes = np.stack([found for _, found in candidates]).astype(np.float32)
        # Empty places among the elites hold zero genes and must not win.
        eligible = np.ones(len(genes), bool)
        eligible[: len(search.elite_scores)] = np.isfinite(search.elite_scores)
        size, block = self.config.population_size, self.executor.block
        count = max(len(genes), size if size <= _FILL_UP_TO and block is None else 0)

        def score(indices: Sequence[int], key: jax.Array) -> Scored:
            """One shape for all calls: filled up with the first candidate."""
            rows = [*indices, *[indices[0]] * (count - len(indices))]
            return take(self._score(genes[rows], key), slice(len(indices)))

        def judge(k: int) -> Passport:
            return make_passport(self.executor.fitness, genes[k], self.config.seed)

        required = judge if self.config.passport == "required" else None
        winner, found = choose_candidate(score, eligible, self.config.seed, required)
        return Champion(genes=genes[winner], origin=candidates[winner][0], **found)

    # --- to and from a checkpoint

    def to_arrays(self, search: GeneSearch) -> dict[str, np.ndarray]:
        """Every value and every leaf of the strategy's state, dtypes as they are, and the root key.

        The root key is compared when the search is read back.
        """
        arrays = {name: np.asarray(getattr(search, name)) for name in (*_COUNTERS, *_ARRAYS)}
        arrays["root_key"] = np.asarray(jax.random.key_data(self.root_key))
        for path, leaf in jax.tree_util.tree_leaves_with_path(search.state):
            arrays["state" + jax.tree_util.keystr(path)] = leaf
        return arrays

    def from_arrays(self, arrays: Mapping[str, np.ndarray]) -> GeneSearch:
        """The inverse of `to_arrays`.

        Raises:
            InputError: the arrays are those of another strategy, size, seed or evosax version.
        """
        template = self.start()
        expected = self.to_arrays(template)
        for name, value in expected.items():
            found = arrays.get(name)
            if found is None or found.shape != value.shape or found.dtype != value.dtype:
                what = "nothing" if found is None else f"{found.dtype} {list(found.shape)}"
                own = f"as {self.config.strategy} of this version has it"
                raise InputError(name, f"{value.dtype} {list(value.shape)}, {own}", what)
        if not np.array_equal(arrays["root_key"], expected["root_key"]):
            raise InputError("root_key", f"the key of evolution.seed {self.config.seed}", "another")
        paths, structure = jax.tree_util.tree_flatten_with_path(template.state)
        leaves = [arrays["state" + jax.tree_util.keystr(path)] for path, _ in paths]
        fields: dict[str, Any] = {name: arrays[name].item() for name in _COUNTERS}
        fields |= {name: arrays[name] for name in _ARRAYS}
        return GeneSearch(state=jax.tree_util.tree_unflatten(structure, leaves), **fields)


def _update_elites(search: GeneSearch, genes: np.ndarray, score: float) -> GeneSearch:
    """Puts the next generation's best among the elites, if it is good enough."""
    if not np.isfinite(score):
        return search
    genes = genes.astype(np.float32)
    # The new one is last, so that the older one stays ahead in a tie.
    scores = np.append(search.elite_scores, np.float32(score))
    order = np.argsort(-scores, kind="stable")[:NUM_ELITES]
    generations = np.append(search.elite_generations, np.int32(search.generation + 1))
    return replace(
        search,
        latest=genes,
        elites=np.concatenate([search.elites, genes[None]])[order],
        elite_scores=scores[order],
        elite_generations=generations[order],
    )
