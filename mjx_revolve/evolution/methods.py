"""What a run evolves, genes of one body or bodies, as functions that a session calls."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.lives import GENERATIONS, INDIVIDUALS
from mjx_revolve.evolution import coevolution, loop
from mjx_revolve.evolution.individuals import to_text
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


def _of_bodies(config: Config, pool: Pool) -> Method:
    coevolution.check_bodies(config, pool)
    fitness = pool.fitness

    def record(run: Run, search: coevolution.BodySearch) -> None:
        run.append_lines(INDIVIDUALS, (to_text(i, fitness.genotype) for i in search.newborn))
        living = [individual.number for individual in search.living]
        line = {"generation": search.generation, "living": living}
        run.append_lines(GENERATIONS, [json.dumps(line, separators=(",", ":"))])

    def save_best(run: Run, search: coevolution.BodySearch) -> None:
        if search.archive is not None:
            run.write("archive.csv", coevolution.archive_table(search).encode())
        if not search.elites:
            return
        best = search.elites[0]
        run.save_champion(
            np.array(best.genes, np.float32), best.body, score=best.score, final=False,
            origin=f"{coevolution.describe_origin(best)}, {_UNJUDGED}", individual=best.number,
        )  # fmt: skip

    return Method(
        start=lambda: coevolution.start_search(config),
        advance=lambda search: coevolution.coevolve(config, pool, search),
        to_arrays=lambda search: coevolution.search_to_arrays(config, fitness, search),
        from_arrays=lambda arrays: coevolution.search_from_arrays(config, fitness, arrays),
        record=record,
        save_best=save_best,
        judge=lambda search: coevolution.judge(config, pool, search),
    )
