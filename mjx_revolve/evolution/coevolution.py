"""The evolution of bodies with their brains: parents, children, learning, survivors.

The state between two generations is a `BodySearch`, a plain value. The random numbers
of a generation's k-th child come from (seed, generation, k), and those of its learning from the
individual's number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import numpy as np

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.individual_log import GENERATIONS, INDIVIDUALS
from mjx_revolve.episodes.run_reader import arrays_of
from mjx_revolve.evolution import archive as archives
from mjx_revolve.evolution.archive import Archive, make_archive
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.generations import Evolution, Generation
from mjx_revolve.evolution.individual_search import (
    IndividualEvolution,
    finite_mean,
    living_line,
    mean_descriptors,
)
from mjx_revolve.evolution.individuals import (
    Individual,
    best_individuals,
    features,
    from_records,
    pack_json,
    reading_state,
    state_to_arrays,
    to_records,
    to_text,
    unpack_json,
)
from mjx_revolve.evolution.learning import evaluate_again, learn, make_learner
from mjx_revolve.evolution.novelty import axis_scale, novelty
from mjx_revolve.evolution.reproduction import make_child, make_founders
from mjx_revolve.evolution.selection import SCHEMES, Candidates, check_selection
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import csv_table

_COUNTERS = ("generation", "next_number", "trials", "seconds")


@dataclass(frozen=True)
class BodySearch:
    """State of a search over bodies between two generations.

    Attributes:
        generation: number of finished generations; the first one is random, or of seeds.
        living: the population, best first; of an archive, by number.
        elites: those with the best scores of all times, best first, `NUM_ELITES` at most.
        archive: the best of each kind, or None.
        archived: `{number: individual}` of those in the archive.
        novelty_archive: `[K, D]` features of the most novel individual of each generation.
        novelty_ids: `[K]` its number.
        next_number: of the next individual.
        trials: brains that were tried.
        seconds: time spent in generations [s]; not reproducible.
        offspring: the last generation's individuals; not saved.
        parents: its parents, with their new scores, where they are evaluated again; not saved.
    """

    generation: int = 0
    living: tuple[Individual, ...] = ()
    elites: tuple[Individual, ...] = ()
    archive: Archive | None = None
    archived: Mapping[int, Individual] = field(default_factory=dict)
    novelty_archive: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    novelty_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    next_number: int = 0
    trials: int = 0
    seconds: float = 0.0
    offspring: tuple[Individual, ...] = ()
    parents: tuple[Individual, ...] = ()


class _Proposal(NamedTuple):
    """New individuals, the search that they belong to, and the key of their episodes."""

    search: BodySearch
    offspring: list[Individual]
    key: jax.Array


class BodyEvolution(IndividualEvolution, Evolution[BodySearch, _Proposal, list[Individual]]):
    """Evolves bodies and brains; see `generations.Evolution`."""

    def __init__(self, config: Config, executor: Executor) -> None:
        """Prepares a search.

        Args:
            config: the configuration.
            executor: an executor over a `BodyFitness`.

        Raises:
            InputError: the learning strategy, the selection or the name of a feature is wrong.
        """
        super().__init__(config, executor)
        self.bodies = self.fitness.bodies
        self.selection = self.bodies.selection
        self.scheme = SCHEMES[self.selection.type]
        make_learner(self.bodies.learning, self.fitness.brains.size)  # refuses wrong settings
        check_selection(self.selection, config.evolution.population_size)
        self._check_features()

    def _check_features(self) -> None:
        known, archive = self.fitness.features, self.bodies.archive
        objectives = [name.removeprefix("-") for name in self.selection.objectives]
        named = {
            "bodies.selection.objectives": [name for name in objectives if name != "novelty"],
            "bodies.selection.novelty": self.selection.novelty,
            "bodies.archive.axes": list(archive.axes) if archive else [],
        }
        for place, names in named.items():
            for name in names:
                if name not in known:
                    raise InputError(place, f"any of {', '.join(known)}", repr(name))

    def start(self) -> BodySearch:
        """The search before its first generation."""
        settings, seed = self.bodies.archive, self.config.evolution.seed
        archive = None if settings is None else make_archive(settings, seed)
        past = np.zeros((0, len(self.selection.novelty)))
        return BodySearch(archive=archive, novelty_archive=past)

    # --- ask

    def ask(self, search: BodySearch) -> _Proposal:
        """New individuals, each with the brain of its birth."""
        generation = search.generation + 1
        if search.living and self.selection.type != "random":
            offspring = self._children(search, generation)
        else:
            offspring = self._founders(search, generation)
        key = jax.random.fold_in(jax.random.key(self.config.evolution.seed), generation)
        return _Proposal(search, offspring, key)

    def _founders(self, search: BodySearch, generation: int) -> list[Individual]:
        """Individuals without parents: random ones, and seeds."""
        evolution = self.config.evolution
        count = self.selection.offspring if search.living else None
        count = count or evolution.population_size
        rngs = [np.random.default_rng([evolution.seed, generation, k]) for k in range(count)]
        first, new = search.next_number, not search.living
        return list(make_founders(self.fitness, rngs, first, generation, sow=new))

    def _children(self, search: BodySearch, generation: int) -> list[Individual]:
        """Children of selected parents."""
        evolution, living = self.config.evolution, search.living
        count = self.selection.offspring or evolution.population_size
        # `count` makes it another stream than each child's: a seed's missing numbers count as 0.
        rng = np.random.default_rng([evolution.seed, generation, count])
        new = self._novelty(living, search)
        candidates = self._candidates(living, new, len(living))
        pairs = self.scheme.parents(rng, candidates, self.selection, count)
        return [
            make_child(
                self.fitness,
                np.random.default_rng([evolution.seed, generation, k]),
                search.next_number + k,
                generation,
                living[first],
                living[second],
            )
            for k, (first, second) in enumerate(pairs)
        ]

    # --- evaluate and tell

    def evaluate(self, proposal: _Proposal) -> list[Individual]:
        """The living, and the new individuals with what they have learnt, with their scores."""
        born = learn(self.executor, proposal.offspring, proposal.key)
        together = [*proposal.search.living, *born]
        if self.selection.reevaluate:
            together = evaluate_again(self.executor, together, proposal.key)
        return together

    def tell(self, proposal: _Proposal, results: list[Individual]) -> Generation[BodySearch]:
        """The search with survivors, elites and archives brought up to date.

        Columns: failed (individuals of which every trial failed), living, living_mean, the best
        new individual's measures, the living's mean of `MEAN_DESCRIPTORS`, coverage and qd_score
        of the archive. Scores are those of the new individuals.
        """
        search, together, old = proposal.search, results, len(proposal.search.living)
        born, current = together[old:], {one.number: one for one in together}
        generation, mu = search.generation + 1, self.config.evolution.population_size
        new = self._novelty(together, search)
        archive, archived = _insert(search, born)
        if self.selection.type == "map_elites":
            living = list(archived.values())
        else:
            candidates = self._candidates(together, new, old)
            survivors = self.scheme.survivors(candidates, self.selection, mu, generation)
            living = [together[k] for k in survivors]
        trials = sum(individual.trials for individual in born)
        # What has failed is not evaluated again.
        trials += self.selection.reevaluate * sum(one.learnt is not None for one in together)
        past, ids = self._add_most_novel(search, born, new[old:])
        found = replace(
            search,
            generation=generation,
            living=tuple(living or born),
            elites=best_individuals(
                [*(current.get(one.number, one) for one in search.elites), *together]
            ),
            archive=archive,
            archived=archived,
            novelty_archive=past,
            novelty_ids=ids,
            next_number=search.next_number + len(born),
            trials=search.trials + trials,
            offspring=tuple(born),
            parents=tuple(together[:old]) if self.selection.reevaluate else (),
        )
        scores = np.array([individual.score for individual in born])
        champion = found.elites[0].score if found.elites else float("-inf")
        columns = self._columns(found, scores)
        return Generation(found, scores, champion, columns, trials, found.trials)

    def _columns(self, search: BodySearch, scores: np.ndarray) -> dict[str, float]:
        best = search.offspring[int(np.nanargmax(scores))] if np.isfinite(scores).any() else None
        columns: dict[str, float] = {
            "failed": int(np.sum(~np.isfinite(scores))),
            "living": len(search.living),
            "living_mean": finite_mean(features(search.living, ["score"])),
        }
        for name in self.fitness.measure_names:
            columns[name] = float(best.measures[name]) if best is not None else float("nan")
        columns |= mean_descriptors(search.living)
        if search.archive is not None:
            columns["coverage"] = archives.coverage(search.archive)
            columns["qd_score"] = archives.qd_score(search.archive)
        return columns

    def _candidates(
        self, individuals: Sequence[Individual], new: np.ndarray, old: int
    ) -> Candidates:
        """Individuals to choose from; the first `old` ones are parents, `new` is their novelty."""
        columns = []
        for name in self.selection.objectives:
            plain = name.removeprefix("-")
            values = new if plain == "novelty" else features(individuals, [plain])[:, 0]
            columns.append(-values if name.startswith("-") else values)
        objectives = np.stack(columns, -1)
        objectives[np.isnan([individual.score for individual in individuals])] = np.nan
        return Candidates(
            objectives=objectives,
            born=np.array([individual.born for individual in individuals]),
            ids=np.array([individual.number for individual in individuals]),
            is_child=np.arange(len(individuals)) >= old,
        )

    def _novelty(self, individuals: Sequence[Individual], search: BodySearch) -> np.ndarray:
        """`[N]` novelty; 0 where it is no objective."""
        if not self.selection.novelty:
            return np.zeros(len(individuals))
        points = features(individuals, self.selection.novelty)
        # Those of the archive that live on are among the individuals: none is its own neighbour.
        here = np.isin(search.novelty_ids, [one.number for one in individuals])
        past = search.novelty_archive[~here]
        scale = axis_scale(np.concatenate([points, past]))
        return novelty(points, past, self.selection.neighbours, scale)

    def _add_most_novel(
        self, search: BodySearch, born: Sequence[Individual], new: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The archive of novelty and its numbers, with the most novel of those that were born."""
        past, ids = search.novelty_archive, search.novelty_ids
        if not self.selection.novelty or not np.isfinite(new).any():
            return past, ids
        best = born[int(np.nanargmax(new))]
        point = features([best], self.selection.novelty)
        return np.concatenate([past, point]), np.append(ids, best.number)

    # --- files of the run folder

    def logs(self, search: BodySearch) -> Mapping[str, Sequence[str]]:
        """The last generation's individuals, and the numbers of the living.

        Parents that were evaluated again have a line with their new scores, too; those that leave
        may still be among the best.
        """
        logged = (*search.offspring, *search.parents)
        lines = [to_text(one, self.fitness.genotype) for one in logged]
        return {INDIVIDUALS: lines, GENERATIONS: [living_line(search)]}

    def files(self, search: BodySearch) -> Mapping[str, bytes]:
        """The archive as CSV: a line for each cell that is taken."""
        if search.archive is None:
            return {}
        return {"archive.csv": csv_table(archives.rows(search.archive))}

    # --- to and from a checkpoint

    def to_arrays(self, search: BodySearch) -> dict[str, np.ndarray]:
        """A search as named arrays."""
        everyone = (*search.living, *search.elites, *search.archived.values())
        found = state_to_arrays(search, _COUNTERS, self.config.evolution.seed)
        found |= {"past": search.novelty_archive, "past_ids": search.novelty_ids}
        for name in ("living", "elites"):
            found[name] = np.array([i.number for i in getattr(search, name)], np.int64)
        found["individuals"] = pack_json(to_records(everyone, self.fitness.genotype))
        if search.archive is not None:
            found |= {f"archive.{k}": v for k, v in archives.to_arrays(search.archive).items()}
        return found

    def from_arrays(self, arrays: Mapping[str, np.ndarray]) -> BodySearch:
        """The inverse of `to_arrays`.

        Raises:
            InputError: the arrays are damaged, or those of another run.
        """
        seed = self.config.evolution.seed
        with reading_state("a search over bodies", _COUNTERS, seed, arrays) as counters:
            known = from_records(unpack_json(arrays["individuals"]), self.fitness)
            own = arrays_of("archive.", arrays)
            archive = archives.from_arrays(own) if own else None
            ids = [] if archive is None else sorted(archive.ids[archives.filled(archive)].tolist())
            return BodySearch(
                living=tuple(known[int(n)] for n in arrays["living"]),
                elites=tuple(known[int(n)] for n in arrays["elites"]),
                archive=archive,
                archived={n: known[n] for n in ids},
                novelty_archive=arrays["past"],
                # Earlier versions kept no numbers.
                novelty_ids=arrays.get("past_ids", np.full(len(arrays["past"]), -1)),
                **counters,
            )


def _insert(
    search: BodySearch, born: Sequence[Individual]
) -> tuple[Archive | None, dict[int, Individual]]:
    """The archive with new individuals, and those that are in it by number."""
    if search.archive is None:
        return None, {}
    points = features(born, search.archive.names)
    numbers = np.array([individual.number for individual in born])
    scores = np.array([individual.score for individual in born])
    found = archives.insert(search.archive, numbers, scores, points)
    known = {**search.archived, **{individual.number: individual for individual in born}}
    return found, {int(n): known[int(n)] for n in sorted(found.ids[archives.filled(found)])}
