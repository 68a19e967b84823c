"""What a run evolves, genes of one body or bodies, as functions that a session calls."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.lives import EVENTS, GENERATIONS, INDIVIDUALS
from mjx_revolve.evolution import coevolution, colony, loop
from mjx_revolve.evolution.individuals import Individual, to_text
from mjx_revolve.evolution.loop import Champion
from mjx_revolve.evolution.pool import Pool
from mjx_revolve.evolution.runs import Run
from mjx_revolve.evolution.strategies import make_strategy


class Method(NamedTuple):
    """How a search is begun, advanced, saved and judged.

    Attributes:
        start: () → the search before its first generation.
        advance: search or None → generations, as `loop.evolve` yields them.
        to_arrays: search → named arrays for a checkpoint.
        from_arrays: the inverse.
        record: (run, search) → None: what is written after each generation, beside metrics.
        save_best: (run, search) → None: writes the champion so far, not yet judged.
        judge: search → the champion.
    """

    start: Callable[[], Any]
    advance: Callable[[Any], Iterator[tuple[Any, dict[str, float]]]]
    to_arrays: Callable[[Any], dict[str, np.ndarray]]
    from_arrays: Callable[[Mapping[str, np.ndarray]], Any]
    record: Callable[[Run, Any], None]
    save_best: Callable[[Run, Any], None]
    judge: Callable[[Any], Champion]


def make_method(config: Config, pool: Pool) -> Method:
    """The method that a configuration asks for.

    Args:
        config: the configuration.
        pool: its fitness.

    Returns:
        The method.

    Raises:
        InputError: a strategy, a selection or a name of a figure is wrong.
    """
    if config.colony is not None:
        return _of_colony(config, pool)
    return _of_genes(config, pool) if config.bodies is None else _of_bodies(config, pool)


_UNJUDGED = "not yet judged on fresh starts"


def _of_genes(config: Config, pool: Pool) -> Method:
    evolution = config.evolution
    strategy = make_strategy(evolution, pool.num_genes)

    def save_best(run: Run, search: loop.Search) -> None:
        origin = f"best of generation {search.elite_generations[0]}, {_UNJUDGED}"
        score = float(search.elite_scores[0])
        run.save_champion(search.elites[0], score=score, final=False, origin=origin)

    return Method(
        start=lambda: loop.start_search(evolution, strategy),
        advance=lambda search: loop.evolve(evolution, pool, search),
        to_arrays=lambda search: loop.search_to_arrays(evolution, search),
        from_arrays=lambda arrays: loop.search_from_arrays(evolution, pool.num_genes, arrays),
        record=lambda run, search: None,
        save_best=save_best,
        judge=lambda search: loop.choose_champion(evolution, pool, search),
    )


def _save_best_body(run: Run, best: Individual) -> None:
    """Writes an individual as the champion so far."""
    run.save_champion(
        np.array(best.genes, np.float32), best.body, score=best.score, final=False,
        origin=f"{coevolution.describe_origin(best)}, {_UNJUDGED}", individual=best.number,
    )  # fmt: skip


def _living_line(search: Any) -> str:
    """A line of JSON that says who is alive."""
    living = [individual.number for individual in search.living]
    return json.dumps({"generation": search.generation, "living": living}, separators=(",", ":"))


def _of_bodies(config: Config, pool: Pool) -> Method:
    coevolution.check_bodies(config, pool)
    fitness = pool.fitness

    def record(run: Run, search: coevolution.BodySearch) -> None:
        run.append_lines(INDIVIDUALS, (to_text(i, fitness.genotype) for i in search.newborn))
        run.append_lines(GENERATIONS, [_living_line(search)])

    def save_best(run: Run, search: coevolution.BodySearch) -> None:
        if search.archive is not None:
            run.write("archive.csv", coevolution.archive_table(search).encode())
        if search.elites:
            _save_best_body(run, search.elites[0])

    return Method(
        start=lambda: coevolution.start_search(config),
        advance=lambda search: coevolution.coevolve(config, pool, search),
        to_arrays=lambda search: coevolution.search_to_arrays(config, fitness, search),
        from_arrays=lambda arrays: coevolution.search_from_arrays(config, fitness, arrays),
        record=record,
        save_best=save_best,
        judge=lambda search: coevolution.judge(config, pool, search.elites),
    )


def _of_colony(config: Config, pool: Pool) -> Method:
    fitness, last = pool.fitness, config.evolution.generations
    colony.make_colony_tank(config, fitness)  # says what is wrong with the world

    def record(run: Run, search: colony.Colony) -> None:
        # A life is written down when it begins, and again when it is over; the later line counts.
        told = [*search.born, *search.died]
        if search.generation == last:
            told += search.living
        run.append_lines(INDIVIDUALS, (to_text(i, fitness.genotype) for i in told))
        run.append_lines(GENERATIONS, [_living_line(search)])
        run.append_lines(EVENTS, (json.dumps(e, separators=(",", ":")) for e in search.events))

    def elites(search: colony.Colony) -> tuple[Individual, ...]:
        """Where nobody has lived long enough to be known, who seems best."""
        return search.elites or colony.fittest(search.living)

    def save_best(run: Run, search: colony.Colony) -> None:
        if best := elites(search):
            _save_best_body(run, best[0])

    return Method(
        start=colony.Colony,
        advance=lambda search: colony.colony_of(config, pool, search),
        to_arrays=lambda search: colony.colony_to_arrays(config, fitness, search),
        from_arrays=lambda arrays: colony.colony_from_arrays(config, fitness, arrays),
        record=record,
        save_best=save_best,
        judge=lambda search: coevolution.judge(config, pool, elites(search)),
    )
