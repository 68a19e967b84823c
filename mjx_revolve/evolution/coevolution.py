"""The evolution of bodies with their brains: parents, children, lives, survivors.

All that passes from one generation to the next is a `BodySearch`, a plain value, as `loop.Search`
is for genes alone. The random numbers of a generation's k-th child come from (seed, generation, k)
and those of a life from the individual's number alone.
"""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.fitness import read_modules
from mjx_revolve.episodes.scoring import REPORT_EPISODES, REPORT_STREAM, replay_key
from mjx_revolve.evolution import archive as archives
from mjx_revolve.evolution.archive import Archive, make_archive
from mjx_revolve.evolution.body_fitness import BodyFitness
from mjx_revolve.evolution.individuals import Individual, from_record, to_record
from mjx_revolve.evolution.life import evaluate, live, make_learner
from mjx_revolve.evolution.loop import (
    CHOOSE_EPISODES,
    CHOOSE_STREAM,
    NUM_ELITES,
    Champion,
    score_afresh,
    summarize,
)
from mjx_revolve.evolution.novelty import novelty, spread
from mjx_revolve.evolution.pool import Pool
from mjx_revolve.evolution.selection import SCHEMES, Candidates, check_selection, order
from mjx_revolve.inputs.errors import InputError

# Descriptors whose mean over the living goes into the metrics.
SHOWN = ("num_modules", "num_hinges", "length", "mass", "branching", "limbs", "symmetry")


@dataclass(frozen=True)
class BodySearch:
    """Everything that passes from one generation to the next.

    Attributes:
        generation: how many generations are done; the first one is random, or of seeds.
        living: best first.
        elites: those with the best scores of all times, best first, `loop.NUM_ELITES` at most.
        archive: the best of each kind, or None.
        kept: `{number: individual}` of those in the archive.
        past: `[K, D]` where the most novel of each generation stood.
        next_number: of the next individual.
        trials: brains that were tried.
        seconds: time spent in generations [s]; not reproducible.
        newborn: the last generation's individuals; not part of what passes on.
    """

    generation: int = 0
    living: tuple[Individual, ...] = ()
    elites: tuple[Individual, ...] = ()
    archive: Archive | None = None
    kept: Mapping[int, Individual] = field(default_factory=dict)
    past: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    next_number: int = 0
    trials: int = 0
    seconds: float = 0.0
    newborn: tuple[Individual, ...] = ()


def check_bodies(config: Config, pool: Pool) -> None:
    """Refuses what cannot be evolved, before anything is compiled.

    Raises:
        InputError: the learning strategy, the selection or a figure's name is wrong.
    """
    bodies = config.bodies
    assert bodies is not None
    fitness: BodyFitness = pool.fitness
    make_learner(bodies.learning, fitness.brains.size)
    check_selection(bodies.selection, config.evolution.population_size)
    known = fitness.figures
    named = {"bodies.selection.objectives": [x.lstrip("-") for x in bodies.selection.objectives]}
    named["bodies.selection.novelty"] = list(bodies.selection.novelty)
    named["bodies.archive.axes"] = list(bodies.archive.axes) if bodies.archive else []
    for place, names in named.items():
        for name in names:
            if name not in known and not (name == "novelty" and place.endswith("objectives")):
                raise InputError(f"{place}: expected any of {', '.join(known)}; found {name!r}")


def coevolve(
    config: Config, pool: Pool, search: BodySearch | None = None
) -> Iterator[tuple[BodySearch, dict[str, float]]]:
    """Evolves bodies and brains, one generation at a time.

    Args:
        config: how.
        pool: a pool over a `BodyFitness`.
        search: where to go on; None starts a new search.

    Yields:
        The search after each generation, and the generation's figures: those of `loop.evolve` over
        the new-born individuals' scores, the best one's measures, means over the living of some
        descriptors, and cells and quality of the archive.
    """
    step = _Step(config, pool)
    search = start_search(config) if search is None else search
    while search.generation < config.evolution.generations:
        search, row = step.advance(search)
        yield search, row


def start_search(config: Config) -> BodySearch:
    """The search before its first generation."""
    bodies = config.bodies
    assert bodies is not None
    found = None
    if bodies.archive is not None:
        found = make_archive(bodies.archive, config.evolution.seed)
    return BodySearch(archive=found, past=np.zeros((0, len(bodies.selection.novelty))))


class _Step:
    """One generation after the other."""

    def __init__(self, config: Config, pool: Pool) -> None:
        assert config.bodies is not None
        self.config, self.pool, self.bodies = config, pool, config.bodies
        self.fitness: BodyFitness = pool.fitness
        self.selection = config.bodies.selection
        self.scheme = SCHEMES[self.selection.type]
        self.learner = make_learner(self.bodies.learning, self.fitness.brains.size)

    def advance(self, search: BodySearch) -> tuple[BodySearch, dict[str, float]]:
        began = time.perf_counter()
        seed, mu = self.config.evolution.seed, self.config.evolution.population_size
        generation = search.generation + 1
        if search.living and self.selection.type != "random":
            born = self._children(search, generation)
        else:
            born = self._strangers(search, generation)
        key = jax.random.fold_in(jax.random.key(seed), generation)
        born = live(self.pool, self.learner, born, key)

        together = [*search.living, *born]
        new = self._novelty(together, search.past)
        past = self._remember(search.past, born, new[len(search.living) :])
        archive, kept = self._store(search, born)
        if self.selection.type == "map_elites":
            living = list(kept.values())
        else:
            everybody = self._candidates(together, new, len(search.living))
            stay = self.scheme.survivors(everybody, self.selection, mu, generation)
            living = [together[k] for k in stay]
        elites = best_of([*search.elites, *born])
        seconds = time.perf_counter() - began
        found = BodySearch(
            generation=generation,
            living=tuple(living or born),
            elites=elites,
            archive=archive,
            kept=kept,
            past=past,
            next_number=search.next_number + len(born),
            trials=search.trials + sum(individual.trials for individual in born),
            seconds=search.seconds + seconds,
            newborn=tuple(born),
        )
        return found, self._row(found, seconds)

    # --- who is born

    def _strangers(self, search: BodySearch, generation: int) -> list[Individual]:
        """Individuals without parents: random ones, and seeds."""
        evolution = self.config.evolution
        count = self.selection.offspring if search.living else None
        count = count or evolution.population_size
        seeds = self.fitness.seeds if not search.living else ()
        sown = round((1 - self.bodies.random) * count)
        sown = max(sown, min(len(seeds), count)) if seeds else 0
        genotype, found = self.fitness.genotype, []
        for k in range(count):
            rng = np.random.default_rng([evolution.seed, generation, k])
            if k < sown:
                assert genotype.adopt is not None
                seed = seeds[k % len(seeds)]
                genome, origin = genotype.adopt(seed), f"seed {seed.name}"
                if k >= len(seeds):
                    genome, origin = genotype.mutate(rng, genome), f"mutant of {seed.name}"
            else:
                genome, origin = genotype.random(rng), "random"
            number = search.next_number + k
            found.append(self._grow(rng, number, (), generation, origin, genome))
        return found

    def _children(self, search: BodySearch, generation: int) -> list[Individual]:
        evolution, genotype = self.config.evolution, self.fitness.genotype
        count = self.selection.offspring or evolution.population_size
        rng = np.random.default_rng([evolution.seed, generation])
        new = self._novelty(search.living, search.past)
        living = self._candidates(search.living, new, len(search.living))
        pairs = self.scheme.parents(rng, living, self.selection, count)
        found = []
        for k, (i, j) in enumerate(pairs):
            rng = np.random.default_rng([evolution.seed, generation, k])
            parents, origin = [search.living[i]], "mutation"
            genome = parents[0].genome
            if i != j and rng.random() < self.bodies.crossover:
                parents.append(search.living[j])
                genome, origin = genotype.cross(rng, genome, parents[1].genome), "crossover"
            if len(parents) == 1 or rng.random() < self.bodies.mutation:
                genome = genotype.mutate(rng, genome)
                origin = "mutation" if len(parents) == 1 else "crossover, mutation"
            number = search.next_number + k
            found.append(self._grow(rng, number, parents, generation, origin, genome))
        return found

    def _grow(
        self,
        rng: np.random.Generator,
        number: int,
        parents: Sequence[Individual],
        generation: int,
        origin: str,
        genome: Any,
    ) -> Individual:
        """A new individual: its body, and the brain that it is born with."""
        body = self.fitness.genotype.develop(genome)
        layout, brains = self.fitness.layout(body), self.fitness.brains
        how = self.bodies.brains.inheritance
        if not parents or how == "none":
            brain = brains.draw(rng, layout)
        else:
            learnt = how == "lamarckian"
            taught = [p.learnt if learnt and p.learnt is not None else p.brain for p in parents]
            brain = brains.inherit(rng, taught, layout)
        ancestors = tuple(parent.number for parent in parents)
        return Individual(number, ancestors, generation, origin, genome, body, brain)

    # --- who stays

    def _candidates(
        self, individuals: Sequence[Individual], new: np.ndarray, old: int
    ) -> Candidates:
        """The first `old` ones are parents; how `new` each is follows from the past."""
        columns = []
        for name in self.selection.objectives:
            plain = name.lstrip("-")
            values = new if plain == "novelty" else _figures(individuals, plain)
            columns.append(-values if name.startswith("-") else values)
        objectives = np.stack(columns, -1)
        objectives[np.isnan([individual.score for individual in individuals])] = np.nan
        return Candidates(
            objectives=objectives,
            born=np.array([individual.born for individual in individuals]),
            ids=np.array([individual.number for individual in individuals]),
            is_child=np.arange(len(individuals)) >= old,
        )

    def _novelty(self, individuals: Sequence[Individual], past: np.ndarray) -> np.ndarray:
        """`[N]` how new each is; 0 where nobody asks."""
        if not self.selection.novelty:
            return np.zeros(len(individuals))
        points = _points(individuals, self.selection.novelty)
        scale = spread(np.concatenate([points, past]))
        return novelty(points, past, self.selection.neighbours, scale)

    def _remember(
        self, past: np.ndarray, born: Sequence[Individual], new: np.ndarray
    ) -> np.ndarray:
        """The past, and the most novel one of those that were born."""
        if not self.selection.novelty or not np.isfinite(new).any():
            return past
        best = born[int(np.nanargmax(new))]
        return np.concatenate([past, _points([best], self.selection.novelty)])

    def _store(
        self, search: BodySearch, born: Sequence[Individual]
    ) -> tuple[Archive | None, dict[int, Individual]]:
        if search.archive is None:
            return None, {}
        points = _points(born, search.archive.names)
        numbers = np.array([individual.number for individual in born])
        scores = np.array([individual.score for individual in born])
        found, _ = archives.insert(search.archive, numbers, scores, points)
        known = {**search.kept, **{individual.number: individual for individual in born}}
        return found, {int(n): known[int(n)] for n in sorted(found.ids[found.ids >= 0])}

    # --- what is told

    def _row(self, search: BodySearch, seconds: float) -> dict[str, float]:
        born = search.newborn
        scores = np.array([individual.score for individual in born])
        tried = sum(individual.trials for individual in born)
        champion = search.elites[0].score if search.elites else float("-inf")
        best = born[int(np.nanargmax(scores))] if np.isfinite(scores).any() else None
        row: dict[str, float] = {
            "generation": search.generation,
            "evaluations": search.trials,
            **summarize(scores),
            "champion": champion,
            "failed": int(np.sum(~np.isfinite(scores))),
            "living": len(search.living),
            "living_mean": mean_known(_figures(search.living, "score")),
        }
        for name in self.fitness.measured:
            row[name] = float(best.measures[name]) if best is not None else float("nan")
        for name in SHOWN:
            row[f"mean_{name}"] = mean_known(_figures(search.living, name))
        if search.archive is not None:
            row["coverage"] = archives.coverage(search.archive)
            row["qd_score"] = archives.qd_score(search.archive)
        row["seconds"] = search.seconds
        row["evaluations_per_second"] = tried / seconds
        return row


def _figures(individuals: Sequence[Individual], name: str) -> np.ndarray:
    """`[N]` a figure of each; NaN where a life has not given it."""
    found = np.full(len(individuals), np.nan)
    for k, individual in enumerate(individuals):
        try:
            found[k] = individual.figure(name)
        except KeyError:
            continue
    return found


def _points(individuals: Sequence[Individual], names: Sequence[str]) -> np.ndarray:
    """`[N, D]` figures of each."""
    columns = [_figures(individuals, name) for name in names]
    return np.stack(columns, -1) if columns else np.zeros((len(individuals), 0))


def mean_known(values: Any) -> float:
    """The mean of what is known; NaN where nothing is."""
    found = np.asarray(values, float)
    return float(np.nanmean(found)) if np.isfinite(found).any() else float("nan")


def best_of(individuals: Sequence[Individual]) -> tuple[Individual, ...]:
    """Those with the best scores; of equals, the older ones."""
    known = [individual for individual in individuals if np.isfinite(individual.score)]
    scores = np.array([[individual.score] for individual in known]).reshape(-1, 1)
    numbers = np.array([individual.number for individual in known], int)
    return tuple(known[k] for k in order(scores, numbers)[:NUM_ELITES])


def judge(config: Config, pool: Pool, elites: Sequence[Individual]) -> Champion:
    """Judges the elites on fresh starts, as `loop.choose_champion` judges genes.

    Args:
        config: the seed.
        pool: as evolution used it.
        elites: of the finished search, best first.

    Returns:
        The champion.

    Raises:
        InputError: every life failed.
    """
    fitness: BodyFitness = pool.fitness
    if not elites:
        raise InputError("champion: expected an individual with a score; found none: all failed")
    root = jax.random.key(config.evolution.seed)

    def fresh(who: Sequence[Individual], stream: int, episodes: int) -> tuple[Any, Any]:
        """`[episodes, who]` scores, and measures alike."""
        genes = [
            fitness.mixed.pad_genes(np.array([i.genes], np.float32), fitness.build(i.body))
            for i in who
        ]

        def score(key: jax.Array) -> tuple[np.ndarray, dict[str, np.ndarray]]:
            found = evaluate(pool, who, genes, key)
            measures = {n: np.concatenate([m[n] for _, m in found]) for n in found[0][1]}
            return np.concatenate([s for s, _ in found]), measures

        return score_afresh(score, jax.random.fold_in(root, stream), episodes)

    means = fresh(elites, CHOOSE_STREAM, CHOOSE_EPISODES)[0].mean(0)
    winner = elites[int(np.argmax(means))]
    scores, measures = fresh([winner], REPORT_STREAM, REPORT_EPISODES)
    return Champion(
        genes=np.array(winner.genes, np.float32),
        score=float(scores.mean()),
        std=float(scores.std()),
        origin=describe_origin(winner),
        measures={name: float(values.mean()) for name, values in measures.items()},
        key=replay_key(config.evolution.seed),
        body=winner.body,
        individual=winner.number,
    )


def describe_origin(individual: Individual) -> str:
    """Where an individual came from, in words."""
    return f"individual {individual.number} of generation {individual.born}, {individual.origin}"


def archive_table(search: BodySearch) -> str:
    """The archive as CSV: a line for each cell that is taken."""
    assert search.archive is not None
    rows = archives.rows(search.archive)
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue()


# --- to and from a checkpoint ---------------------------------------------------------------------

_COUNTERS = ("generation", "next_number", "trials", "seconds")


def search_to_arrays(config: Config, fitness: BodyFitness, search: BodySearch) -> dict[str, Any]:
    """A search as named arrays, for `runs.Run.save_checkpoint`."""
    people = {i.number: i for i in (*search.living, *search.elites, *search.kept.values())}
    records = [to_record(people[number], fitness.genotype) for number in sorted(people)]
    found = {name: np.asarray(getattr(search, name)) for name in _COUNTERS}
    found["seed"] = np.asarray(config.evolution.seed)
    found["past"] = search.past
    for name in ("living", "elites"):
        found[name] = np.array([i.number for i in getattr(search, name)], np.int64)
    found["individuals"] = np.frombuffer(json.dumps(records).encode(), np.uint8)
    if search.archive is not None:
        found |= {f"archive.{k}": v for k, v in archives.to_arrays(search.archive).items()}
    return found


def check_seed(config: Config, arrays: Mapping[str, np.ndarray]) -> None:
    """Refuses the arrays of a run with another seed.

    Raises:
        InputError: it is another one.
    """
    wanted, found = config.evolution.seed, int(arrays["seed"])
    if found != wanted:
        raise InputError(f"seed: expected evolution.seed {wanted}; found {found}")


def search_from_arrays(
    config: Config, fitness: BodyFitness, arrays: Mapping[str, np.ndarray]
) -> BodySearch:
    """The inverse of `search_to_arrays`.

    Raises:
        InputError: the arrays are damaged, or those of another run.
    """
    try:
        check_seed(config, arrays)
        modules = read_modules(config)
        records = json.loads(arrays["individuals"].tobytes())
        found = [from_record(r, fitness.genotype, modules, fitness.brains.check) for r in records]
        people = {individual.number: individual for individual in found}
        own = {k.removeprefix("archive."): v for k, v in arrays.items() if k.startswith("archive.")}
        archive = archives.from_arrays(own) if own else None
        kept: list[int] = [] if archive is None else sorted(archive.ids[archive.ids >= 0].tolist())
        fields: dict[str, Any] = {name: arrays[name].item() for name in _COUNTERS}
        return BodySearch(
            living=tuple(people[int(n)] for n in arrays["living"]),
            elites=tuple(people[int(n)] for n in arrays["elites"]),
            archive=archive,
            kept={n: people[n] for n in kept},
            past=arrays["past"],
            **fields,
        )
    except InputError:
        raise
    except (KeyError, ValueError, TypeError, AttributeError, OverflowError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"expected a search over bodies; found {reason}") from None
