"""An individual: a body, a brain, their origin and score; its record in logs and checkpoints."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import Morphology, make_morphology
from mjx_revolve.episodes.named_files import read_modules
from mjx_revolve.genotypes.genotype import Genotype
from mjx_revolve.inputs.errors import InputError, show

if TYPE_CHECKING:
    from mjx_revolve.evolution.body_fitness import BodyFitness

NUM_ELITES = 4
"""Elites that are kept for the final evaluation. Each was scored on its own generation's starts, so
the highest score is partly luck."""


@dataclass(frozen=True, eq=False)
class Individual:
    """A body and its brain.

    Attributes:
        number: unique in a run; children have larger ones than their parents.
        parents: their numbers; of two, the first gave the body.
        born: generation of birth.
        origin: the operation that made it: `random`, `seed NAME`, `mutation`, `crossover`, ...
        genome: of the genotype's kind.
        body: that the genome develops into, not trimmed.
        brain: at birth; see `brains.BrainEncoding`.
        learnt: the best brain that was tried; None before learning, and if every trial failed.
        genes: `learnt` as genes of the body's own controller; None without `learnt`.
        score: of `learnt`; NaN without `learnt`.
        measures: of `learnt`, see `measures`.
        trials: brains that were tried.
        evaluations: of which `score` is the mean, where `learnt` is evaluated again; 0: it is the
            highest of its trials.
    """

    number: int
    parents: tuple[int, ...]
    born: int
    origin: str
    genome: Any = field(repr=False)
    body: Morphology
    brain: Any = field(repr=False)
    learnt: Any = field(default=None, repr=False)
    genes: tuple[float, ...] | None = field(default=None, repr=False)
    score: float = float("nan")
    measures: Mapping[str, float] = field(default_factory=dict, repr=False)
    trials: int = 0
    evaluations: int = 0

    @cached_property
    def descriptors(self) -> Mapping[str, float]:
        """Descriptors of the body by name."""
        return self.body.descriptors

    def feature(self, name: str) -> float:
        """A feature by name: the score, a measure or a descriptor of the body; NaN: not known."""
        if name == "score":
            return self.score
        return float(self.measures.get(name, self.descriptors.get(name, np.nan)))


def features(individuals: Sequence[Individual], names: Sequence[str]) -> np.ndarray:
    """`[N, D]` features of individuals by name; NaN where one is not known."""
    rows = [[individual.feature(name) for name in names] for individual in individuals]
    return np.array(rows, float).reshape(len(individuals), len(names))


def best_individuals(
    individuals: Iterable[Individual], count: int = NUM_ELITES
) -> tuple[Individual, ...]:
    """The `count` with the best scores, each once and at its best; of equals, the older."""
    best: dict[int, Individual] = {}
    for one in individuals:
        if np.isfinite(one.score):
            best[one.number] = max(best.get(one.number, one), one, key=lambda i: i.score)
    return tuple(sorted(best.values(), key=lambda i: (-i.score, i.number))[:count])


# --- to and from files


def to_record(individual: Individual, genotype: Genotype) -> dict[str, object]:
    """An individual as plain values by name, for JSON; floats keep their bits.

    `genome` is None if the body is the genome.
    """
    body = individual.body.to_mapping()
    genome = genotype.to_plain(individual.genome)
    return {
        "id": individual.number,
        "parents": list(individual.parents),
        "born": individual.born,
        "origin": individual.origin,
        "score": None if individual.score != individual.score else individual.score,
        "trials": individual.trials,
        "evaluations": individual.evaluations,
        "measures": dict(individual.measures),
        "descriptors": {name: float(x) for name, x in individual.descriptors.items()},
        "brain": individual.brain,
        "learnt": individual.learnt,
        "genes": None if individual.genes is None else list(individual.genes),
        "genome": None if genome == body else genome,
        "body": body,
    }


def from_record(
    record: Any, genotype: Genotype, modules: Mapping[str, ModuleType], check: Callable[[Any], Any]
) -> Individual:
    """The inverse of `to_record`.

    Args:
        record: plain values.
        genotype: of its kind.
        modules: module types by name.
        check: `brains.BrainEncoding.check`.

    Returns:
        The individual.

    Raises:
        InputError: the record is damaged, or of another kind of genotype or brain.
    """
    try:
        plain = record["body"] if record["genome"] is None else record["genome"]
        genome = genotype.from_plain(plain)
        score = record["score"]
        learnt, genes = record["learnt"], record["genes"]
        found = Individual(
            number=int(record["id"]),
            parents=tuple(map(int, record["parents"])),
            born=int(record["born"]),
            origin=str(record["origin"]),
            genome=genome,
            body=make_morphology(record["body"], modules, allow_overlap=True),
            brain=check(record["brain"]),
            learnt=None if learnt is None else check(learnt),
            genes=None if genes is None else tuple(map(float, genes)),
            score=float("nan") if score is None else float(score),
            measures={str(name): float(x) for name, x in record["measures"].items()},
            trials=int(record["trials"]),
            evaluations=int(record.get("evaluations", 0)),  # earlier versions counted none
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError("individual", "a record of one", show(error)) from None
    grown = genotype.develop(genome)
    if grown.modules != found.body.modules:
        own = "the body that its genome grows into"
        raise InputError(f"individual {found.number}", own, "another one")
    return replace(found, body=grown)


def to_text(individual: Individual, genotype: Genotype) -> str:
    """A line of JSON."""
    return json.dumps(to_record(individual, genotype), separators=(",", ":"), default=str)


def to_records(individuals: Iterable[Individual], genotype: Genotype) -> list[dict[str, object]]:
    """Records of individuals by number, each once; of several states of one, the last counts."""
    known = {individual.number: individual for individual in individuals}
    return [to_record(known[number], genotype) for number in sorted(known)]


def from_records(records: Any, fitness: BodyFitness) -> dict[int, Individual]:
    """The inverse of `to_records`: individuals by number.

    Raises:
        InputError: see `from_record`.
    """
    modules = read_modules(fitness.config)
    found = (from_record(r, fitness.genotype, modules, fitness.brains.check) for r in records)
    return {individual.number: individual for individual in found}


def state_to_arrays(search: Any, counters: Sequence[str], seed: int) -> dict[str, np.ndarray]:
    """A search's counters and its seed, which `reading_state` compares."""
    return {name: np.asarray(getattr(search, name)) for name in counters} | {"seed": np.array(seed)}


@contextlib.contextmanager
def reading_state(
    what: str, counters: Sequence[str], seed: int, arrays: Mapping[str, np.ndarray]
) -> Iterator[dict[str, Any]]:
    """Within this, arrays of a checkpoint are read; yields the counters by name.

    Raises:
        InputError: the arrays are damaged, or those of another run.
    """
    try:
        found = int(arrays["seed"])
        if found != seed:
            raise InputError("seed", f"evolution.seed {seed}", found)
        counted = {name: arrays[name].item() for name in counters}
        for name, count in counted.items():
            if isinstance(count, str | bytes | complex) or not count >= 0:
                raise InputError(name, "a number >= 0", count)
        yield counted
    except InputError:
        raise
    except (KeyError, ValueError, TypeError, AttributeError, OverflowError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"expected {what}; found {reason}") from None


def pack_json(value: object) -> np.ndarray:
    """Plain values as an array of bytes."""
    return np.frombuffer(json.dumps(value, default=str).encode(), np.uint8)


def unpack_json(array: np.ndarray) -> Any:
    """The inverse of `pack_json`."""
    return json.loads(array.tobytes())
