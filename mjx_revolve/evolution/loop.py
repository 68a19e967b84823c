"""The evolution loop: ask for a population, evaluate it, tell the strategy.

`evolve` is a generator of generations; whoever runs it decides what to print, what to save and
when to stop. All that passes from one generation to the next is a `Search`, a plain value, so a
search that is read back from disk continues with the same bits: the random numbers of generation
`g` come from `fold_in(root key, g)` alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import jax
import numpy as np

from mjx_revolve.body.tree import Morphology
from mjx_revolve.episodes.config import EvolutionConfig
from mjx_revolve.episodes.scoring import REPORT_EPISODES, REPORT_STREAM, replay_key
from mjx_revolve.evolution.strategies import FAILED_SCORE, STD_FLOOR, Strategy, make_strategy
from mjx_revolve.inputs.errors import InputError

# How many of the generations' best are kept for the final evaluation. Each was scored on its own
# generation's starts, so the highest score is partly luck.
NUM_ELITES = 4
# Fresh episodes per candidate: to choose the champion, and then to report it. They differ, because
# the best of several means is a little too good, too.
CHOOSE_EPISODES = 8
# Up to this many rows, filling the candidates up to a whole population, for which the program is
# compiled already, is quicker than compiling one for a handful.
_FILL_UP_TO = 128
# A population this narrow (in units of the step-size floor) for this many generations has stalled.
_STALL_SPREAD = 2.0
_STALL_GENERATIONS = 10
# Streams of random numbers that no generation uses.
CHOOSE_STREAM = 2**32 - 1


class Fitness(Protocol):
    """What the loop needs of a fitness; any object with these two will do.

    It may also have a number `worst_score`: scores at or below it count as failed rollouts, too;
    and a number `block`: it fills populations up to multiples of that many rows by itself.
    """

    @property
    def num_genes(self) -> int:
        """Length of an individual's genes."""

    def evaluate(self, population: Any, key: jax.Array) -> tuple[Any, Mapping[str, Any]]:
        """Scores `[P, G]` genes: `[P]`, higher is better, and further measures, each `[P]`."""


@dataclass(frozen=True)
class Search:
    """Everything that passes from one generation to the next.

    Attributes:
        generation: how many generations are done.
        state: the strategy's state.
        elites: `[NUM_ELITES, G]` the best generations' bests, best first; `elites[0]` is the
            champion so far.
        elite_scores: `[NUM_ELITES]` their scores, on their own generation's starts; -inf: none yet.
        elite_generations: `[NUM_ELITES]` where they are from.
        latest: `[G]` the last generation's best.
        evaluations: how many individuals were scored.
        stalled: for how many generations the population has been too narrow.
        restarts: how often the strategy was started anew.
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


@dataclass(frozen=True)
class Champion:
    """The winner, judged on starts that evolution never saw.

    Attributes:
        genes: `[G]`; those of the body's own controller.
        score: mean over `REPORT_EPISODES` fresh keys; `FAILED_SCORE` stands for a failed rollout.
        std: standard deviation over those keys.
        origin: where it came from, in words.
        measures: mean of each measure over those keys.
        key: the first of those keys, to replay.
        body: the champion's, where bodies have evolved.
        individual: its number there.
    """

    genes: np.ndarray
    score: float
    std: float
    origin: str
    measures: dict[str, float]
    key: jax.Array
    body: Morphology | None = None
    individual: int | None = None


def start_search(config: EvolutionConfig, strategy: Strategy) -> Search:
    """The search before its first generation, around zero genes.

    Args:
        config: the seed.
        strategy: the strategy.

    Returns:
        The search.
    """
    num_genes = strategy.algorithm.num_dims
    return Search(
        generation=0,
        state=strategy.init(jax.random.fold_in(jax.random.key(config.seed), 0)),
        elites=np.zeros((NUM_ELITES, num_genes), np.float32),
        elite_scores=np.full(NUM_ELITES, -np.inf, np.float32),
        elite_generations=np.zeros(NUM_ELITES, np.int32),
        latest=np.zeros(num_genes, np.float32),
    )


def evolve(
    config: EvolutionConfig, fitness: Fitness, search: Search | None = None
) -> Iterator[tuple[Search, dict[str, float]]]:
    """Evolves genes, one generation at a time.

    A strategy is started anew at random genes, the champion being kept, when its population has
    shrunk to the step-size floor for ten generations or its numbers are no longer finite.

    Args:
        config: strategy, sizes and seed.
        fitness: scores a population, higher is better. Scores that are not finite count as
            failures, worse than every finite score.
        search: where to go on; None starts a new search.

    Yields:
        The search after each generation, and the generation's figures: generation, evaluations,
        best, mean, std and median over the finite scores, champion (the best score so far),
        step_size (root mean square over the genes of the population's standard deviation), failed
        (rollouts without a finite score), restarts, the best individual's measures, seconds (so
        far) and evaluations_per_second.

    Raises:
        InputError: the strategy is unknown, or cannot take the population size or a parameter.
    """
    strategy = make_strategy(config, fitness.num_genes)
    search = start_search(config, strategy) if search is None else search
    while search.generation < config.generations:
        search, row = _advance(config, strategy, fitness, search)
        yield search, row


def _advance(
    config: EvolutionConfig, strategy: Strategy, fitness: Fitness, search: Search
) -> tuple[Search, dict[str, float]]:
    """One generation."""
    began = time.perf_counter()
    generation = search.generation + 1
    key = jax.random.fold_in(jax.random.key(config.seed), generation)
    key_ask, key_evaluate, key_tell, key_restart = jax.random.split(key, 4)

    state, restarts, stalled = search.state, search.restarts, search.stalled
    if stalled >= _STALL_GENERATIONS:
        state, restarts, stalled = _restart(strategy, key_restart), restarts + 1, 0
    population, state = strategy.ask(key_ask, state)
    if not np.isfinite(population).all():
        state, restarts, stalled = _restart(strategy, key_restart), restarts + 1, 0
        population, state = strategy.ask(key_ask, state)

    scores, measures = _evaluate(fitness, population, key_evaluate)
    state = strategy.tell(key_tell, population, scores, state)

    spread = float(np.sqrt(np.mean(np.var(population.astype(np.float64), axis=0))))
    narrow = spread <= _STALL_SPREAD * STD_FLOOR * config.std_init
    best = int(np.argmax(np.where(np.isfinite(scores), scores, -np.inf)))
    search = _remember(search, population[best], scores[best], generation)
    seconds = time.perf_counter() - began
    search = replace(
        search,
        generation=generation,
        state=state,
        evaluations=search.evaluations + len(population),
        stalled=stalled + 1 if narrow else 0,
        restarts=restarts,
        seconds=search.seconds + seconds,
    )
    return search, {
        "generation": generation,
        "evaluations": search.evaluations,
        **summarize(scores),
        "champion": float(search.elite_scores[0]),
        "step_size": spread,
        "failed": int(np.sum(~np.isfinite(scores))),
        "restarts": restarts,
        **{name: float(values[best]) for name, values in measures.items()},
        "seconds": search.seconds,
        "evaluations_per_second": len(population) / seconds,
    }


def _restart(strategy: Strategy, key: jax.Array) -> dict[str, Any]:
    """A new start from random genes rather than from the champion's, where it just stalled."""
    key_mean, key_init = jax.random.split(key)
    shape = (strategy.algorithm.num_dims,)
    return strategy.init(key_init, strategy.std_init * jax.random.normal(key_mean, shape))


def _evaluate(
    fitness: Fitness, population: np.ndarray, key: jax.Array
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    scores, measures = fitness.evaluate(jax.numpy.asarray(population), key)
    scores = np.array(scores)
    worst = getattr(fitness, "worst_score", None)
    if worst is not None:
        scores[scores <= worst] = np.nan
    if scores.shape != population.shape[:1]:
        raise ValueError(f"fitness: expected {len(population)} scores; found shape {scores.shape}")
    return scores, {name: np.asarray(values) for name, values in measures.items()}


def summarize(scores: np.ndarray) -> dict[str, float]:
    """Figures of a generation's finite scores `[P]`: best, mean, std, median and quartiles."""
    finite = scores[np.isfinite(scores)].astype(np.float64)
    if not finite.size:
        names = ("best", "mean", "std", "median", "lower_quartile", "upper_quartile")
        return dict.fromkeys(names, float("nan"))
    return {
        "best": float(finite.max()),
        "mean": float(finite.mean()),
        "std": float(finite.std()),
        "median": float(np.median(finite)),
        "lower_quartile": float(np.quantile(finite, 0.25)),
        "upper_quartile": float(np.quantile(finite, 0.75)),
    }


def _remember(search: Search, genes: np.ndarray, score: float, generation: int) -> Search:
    """Puts a generation's best among the elites, if it is good enough."""
    if not np.isfinite(score):
        return search
    genes = genes.astype(np.float32)
    search = replace(search, latest=genes)
    # The newcomer stands last, so that of equal scores the older one stays ahead.
    scores = np.append(search.elite_scores, np.float32(score))
    order = np.argsort(-scores, kind="stable")[:NUM_ELITES]
    return replace(
        search,
        elites=np.concatenate([search.elites, genes[None]])[order],
        elite_scores=scores[order],
        elite_generations=np.append(search.elite_generations, np.int32(generation))[order],
    )


def choose_champion(config: EvolutionConfig, fitness: Fitness, search: Search) -> Champion:
    """Judges the elites, the last best, the last mean and zero genes on fresh starts.

    Zero genes are where every search begins, a robot that does nothing: where noise has led a
    search astray, its champion is at least no worse than that. The candidate with the best mean
    over `CHOOSE_EPISODES` fresh keys wins; its score is then measured on `REPORT_EPISODES` others.

    Args:
        config: strategy and seed.
        fitness: the fitness that evolution used.
        search: the finished search.

    Returns:
        The champion.
    """
    strategy = make_strategy(config, fitness.num_genes)
    candidates = [*search.elites, search.latest]
    origins = [f"best of generation {g}" for g in search.elite_generations]
    origins.append("best of the last generation")
    mean = strategy.mean(search.state)
    if mean is not None and np.isfinite(mean).all():
        candidates.append(mean)
        origins.append("mean of the last distribution")
    # Last, so that of equal ones what has evolved wins.
    candidates.append(np.zeros(fitness.num_genes))
    origins.append("zero genes: nothing that evolved is better")
    count = len(candidates)
    size = config.population_size
    fills_up = getattr(fitness, "block", None) is not None
    candidates += [candidates[0]] * (size - count if size <= _FILL_UP_TO and not fills_up else 0)
    rows = np.stack(candidates).astype(np.float32)
    root = jax.random.key(config.seed)
    key = jax.random.fold_in(root, CHOOSE_STREAM)
    scores, _ = score_afresh(partial(_evaluate, fitness, rows), key, CHOOSE_EPISODES)
    # Empty places among the elites hold zero genes and must not win.
    means = scores.mean(axis=0)[:count]
    means[: len(search.elite_scores)][~np.isfinite(search.elite_scores)] = -np.inf
    winner = int(np.argmax(means))
    key = jax.random.fold_in(root, REPORT_STREAM)
    rows = np.repeat(rows[winner][None], len(rows), 0)  # one row is enough; the shape must stay
    scores, measures = score_afresh(partial(_evaluate, fitness, rows), key, REPORT_EPISODES)
    return Champion(
        genes=rows[0],
        score=float(scores[:, 0].mean()),
        std=float(scores[:, 0].std()),
        origin=origins[winner],
        measures={name: float(values[:, 0].mean()) for name, values in measures.items()},
        key=replay_key(config.seed),
    )


def score_afresh(
    score: Callable[[jax.Array], tuple[np.ndarray, dict[str, np.ndarray]]],
    key: jax.Array,
    episodes: int,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Scores candidates on one key after the other.

    Args:
        score: key → `[candidates]` scores, not finite where a rollout failed, and measures alike.
        key: draws the keys.
        episodes: how many.

    Returns:
        `[episodes, candidates]` scores, `FAILED_SCORE` where a rollout failed, and measures alike.
    """
    results = [score(jax.random.fold_in(key, i)) for i in range(episodes)]
    scores = np.stack([np.where(np.isfinite(s), s, FAILED_SCORE) for s, _ in results])
    measures = {name: np.stack([m[name] for _, m in results]) for name in results[0][1]}
    return scores.astype(np.float64), measures


# --- to and from a checkpoint ---------------------------------------------------------------------

_COUNTERS = ("generation", "evaluations", "stalled", "restarts", "seconds")
_ARRAYS = ("elites", "elite_scores", "elite_generations", "latest")


def search_to_arrays(config: EvolutionConfig, search: Search) -> dict[str, np.ndarray]:
    """A search as named arrays, for `runs.Run.save_checkpoint`.

    Args:
        config: the seed; its root key goes along, to be compared when the search is read back.
        search: the search.

    Returns:
        Every value and every leaf of the strategy's state, dtypes as they are.
    """
    arrays = {name: np.asarray(getattr(search, name)) for name in (*_COUNTERS, *_ARRAYS)}
    arrays["root_key"] = np.asarray(jax.random.key_data(jax.random.key(config.seed)))
    for path, leaf in jax.tree_util.tree_leaves_with_path(search.state):
        arrays["state" + jax.tree_util.keystr(path)] = leaf
    return arrays


def search_from_arrays(
    config: EvolutionConfig, num_genes: int, arrays: Mapping[str, np.ndarray]
) -> Search:
    """The inverse of `search_to_arrays`.

    Args:
        config: strategy, population size and seed of the run.
        num_genes: length of the genes.
        arrays: what `search_to_arrays` gave.

    Returns:
        The search.

    Raises:
        InputError: the arrays are those of another strategy, size, seed or evosax version.
    """
    root_key = np.asarray(jax.random.key_data(jax.random.key(config.seed)))
    template = start_search(config, make_strategy(config, num_genes))
    expected = search_to_arrays(config, template)
    for name, value in expected.items():
        found = arrays.get(name)
        if found is None or found.shape != value.shape or found.dtype != value.dtype:
            what = "nothing" if found is None else f"{found.dtype} {list(found.shape)}"
            raise InputError(
                f"{name}: expected {value.dtype} {list(value.shape)}, as "
                f"{config.strategy} of this version has it; found {what}"
            )
    if not np.array_equal(arrays["root_key"], root_key):
        raise InputError(
            f"root_key: expected the key of evolution.seed {config.seed}; found another"
        )
    paths, structure = jax.tree_util.tree_flatten_with_path(template.state)
    leaves = [arrays["state" + jax.tree_util.keystr(path)] for path, _ in paths]
    fields: dict[str, Any] = {name: arrays[name].item() for name in _COUNTERS}
    fields |= {name: arrays[name] for name in _ARRAYS}
    return Search(state=jax.tree_util.tree_unflatten(structure, leaves), **fields)
