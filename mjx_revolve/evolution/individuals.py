"""An individual: a body and a brain, where they come from, and what their life was worth."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from mjx_revolve.body.morphology import Morphology, make_morphology
from mjx_revolve.genotypes.genotype import Genotype
from mjx_revolve.inputs.errors import InputError, show


@dataclass(frozen=True, eq=False)
class Individual:
    """A body and its brain.

    Attributes:
        number: unique in a run; children have larger ones than their parents.
        parents: theirs; of two, the first gave the body.
        born: the generation.
        origin: how it came about: `random`, `seed NAME`, `mutation`, `crossover`, ...
        genome: of the genotype's kind.
        body: what has grown of it, not trimmed.
        brain: the one that it was born with; see `brains.Brains`.
        learnt: the best one of its life; None before that, and where every trial failed.
        genes: `learnt` as genes of the body's own controller; None where there is none.
        score: of `learnt`; NaN where there is none.
        measures: of `learnt`, see `measures`.
        trials: brains that it has tried.
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

    @cached_property
    def descriptors(self) -> Mapping[str, float]:
        """Of the body."""
        return self.body.descriptors

    def figure(self, name: str) -> float:
        """A figure by name: the score, a measure of the life or a descriptor of the body.

        Raises:
            KeyError: there is no such figure.
        """
        if name == "score":
            return self.score
        if name in self.measures:
            return float(self.measures[name])
        return float(self.descriptors[name])


def to_record(individual: Individual, genotype: Genotype) -> dict[str, Any]:
    """An individual as plain values, for JSON; floats keep their bits.

    Args:
        individual: the individual.
        genotype: of its kind.

    Returns:
        The values by name; `genome` is None where the body says all.
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
        "measures": dict(individual.measures),
        "descriptors": {name: float(x) for name, x in individual.descriptors.items()},
        "brain": individual.brain,
        "learnt": individual.learnt,
        "genes": None if individual.genes is None else list(individual.genes),
        "genome": None if genome == body else genome,
        "body": body,
    }


def from_record(record: Any, genotype: Genotype, modules: Any, check: Any) -> Individual:
    """The inverse of `to_record`.

    Args:
        record: plain values.
        genotype: of its kind.
        modules: the types of modules by name.
        check: `brains.Brains.check`.

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
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"individual: expected a record of one; found {show(error)}") from None
    grown = genotype.develop(genome)
    if grown.modules != found.body.modules:
        raise InputError(
            f"individual {found.number}: expected the body that its genome grows into; found "
            "another one"
        )
    return replace(found, body=grown)


def to_text(individual: Individual, genotype: Genotype) -> str:
    """A line of JSON."""
    return json.dumps(to_record(individual, genotype), separators=(",", ":"))
