"""Logs of a run in which bodies evolved, read back as far as they are whole.

`individuals.jsonl` has a line for each individual, `generations.jsonl` one for each generation, and
in a colony `events.jsonl` one for each birth, mating and death. They are written in `evolution/`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

import numpy as np
from annotated_types import Ge, Le
from pydantic import AllowInfNan, BaseModel, ConfigDict, ValidationError, model_validator

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import Morphology, make_morphology
from mjx_revolve.inputs.errors import InputError, reading
from mjx_revolve.inputs.schema import LARGEST, Number, TupleOf, read

INDIVIDUALS, GENERATIONS = "individuals.jsonl", "generations.jsonl"
EVENTS = "events.jsonl"

_Count = Annotated[int, Ge(0)]
_Time = Annotated[float, Ge(0), Le(LARGEST)]
_Coordinate = Annotated[float, Ge(-LARGEST), Le(LARGEST)] | None


class _Line(BaseModel):
    """A line of a log; further keys are ignored."""

    model_config = ConfigDict(strict=True)


class _Child(_Line):
    """A line about an individual: its number, and those of its parents."""

    id: _Count
    parents: tuple[_Count, ...]

    @model_validator(mode="after")
    def _check_parents(self) -> Self:
        if any(parent >= self.id for parent in self.parents):
            raise ValueError("expected parents that are older")
        return self


class _Individual(_Child):
    born: _Count
    origin: str
    score: Annotated[float, AllowInfNan(False)] | None
    descriptors: dict[str, float]
    measures: dict[str, float]


class _Generation(_Line):
    generation: _Count
    living: tuple[_Count, ...]


class _Event(_Child):
    time: _Time
    event: Literal["birth", "mating", "death"]
    place: tuple[_Coordinate, _Coordinate, _Coordinate]
    other: _Count | None = None
    cause: str = ""
    parents: tuple[_Count, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        needed = {"birth": "parents", "mating": "other", "death": "cause"}[self.event]
        if needed not in self.model_fields_set or getattr(self, needed) is None:
            raise ValueError(f"expected {needed}")
        return self


@dataclass(frozen=True, eq=False)
class LoggedIndividual:
    """An individual of a run.

    Attributes:
        number: unique in its run.
        parents: their numbers; of two, the first gave the body.
        born: generation of birth.
        origin: the operation that made it.
        score: of its best brain; NaN if every trial failed.
        features: score, measures and descriptors by name.
        text: its line of JSON, which holds its body and genes, too.
    """

    number: int
    parents: tuple[int, ...]
    born: int
    origin: str
    score: float
    features: Mapping[str, float] = field(repr=False)
    text: bytes = field(repr=False)

    @property
    def genes(self) -> np.ndarray | None:
        """`[n]` float32 of its best brain, for its body's own controller; None: there is none.

        Raises:
            InputError: they are no finite numbers.
        """
        found = json.loads(self.text).get("genes")
        if found is None:
            return None
        genes = read(TupleOf[Number], found, f"individual {self.number}: genes")
        return np.array(genes, np.float32)

    def grow(self, modules: Mapping[str, ModuleType]) -> Morphology:
        """Its body, of module types by name, not trimmed.

        Raises:
            InputError: the line holds none.
        """
        with reading(f"individual {self.number}"):
            return make_morphology(json.loads(self.text).get("body"), modules, allow_overlap=True)


@dataclass(frozen=True, eq=False)
class Event:
    """An event of a colony.

    Attributes:
        time: of the event [s].
        kind: "birth", "mating" or "death".
        number: of the individual.
        place: `[3]` of the event, world frame [m]; NaN where that is not known.
        other: of a mating, the number of the second one.
        cause: of a death; else "".
        parents: of a birth.
    """

    time: float
    kind: str
    number: int
    place: np.ndarray = field(repr=False)
    other: int | None = None
    cause: str = ""
    parents: tuple[int, ...] = ()


def read_individuals(folder: Path) -> tuple[dict[int, LoggedIndividual], list[str]]:
    """All individuals of a run.

    Args:
        folder: the run folder.

    Returns:
        Individuals by number, in the order of birth, and a line about each thing that is wrong.
    """
    found: dict[int, LoggedIndividual] = {}
    lines, wrong = _read_lines(folder / INDIVIDUALS, _Individual)
    for line, text in lines:
        score = math.nan if line.score is None else line.score
        features = {"score": score, **line.descriptors, **line.measures}
        origin = line.parents, line.born, line.origin
        found[line.id] = LoggedIndividual(line.id, *origin, score, features, text)
    return found, wrong


def find_individuals(folder: Path, numbers: Sequence[int]) -> list[LoggedIndividual]:
    """Individuals of a run by their numbers, in that order.

    Raises:
        InputError: there is none of such a number.
    """
    path = folder / INDIVIDUALS
    if not path.is_file():
        raise InputError(path, "the log of the run's individuals", "no such file")
    known, _ = read_individuals(folder)
    for number in numbers:
        if number not in known:
            found = f"those from {min(known)} to {max(known)}" if known else "none at all"
            raise InputError(path, f"individual {number}", found)
    return [known[number] for number in numbers]


def read_generations(folder: Path) -> tuple[dict[int, tuple[int, ...]], list[str]]:
    """Numbers of the individuals that were alive after each generation of a run.

    Args:
        folder: the run folder.

    Returns:
        Numbers of individuals by generation, and a line about each thing that is wrong.
    """
    lines, wrong = _read_lines(folder / GENERATIONS, _Generation)
    return dict(sorted((line.generation, line.living) for line, _ in lines)), wrong


def read_events(folder: str | Path) -> tuple[list[Event], list[str]]:
    """The events of a colony.

    Args:
        folder: the run folder.

    Returns:
        The events in the order of time, and a line about each thing that is wrong.
    """
    lines, wrong = _read_lines(Path(folder) / EVENTS, _Event)
    events = [
        Event(x.time, x.event, x.id, np.array(x.place, float), x.other, x.cause, x.parents)
        for x, _ in lines
    ]
    # Within an interval they are as they were written.
    return sorted(events, key=lambda event: event.time), wrong


Line = TypeVar("Line", bound=_Line)


def _read_lines(path: Path, kind: type[Line]) -> tuple[list[tuple[Line, bytes]], list[str]]:
    """The lines that have an end and are whole, and a sentence about those that are damaged.

    A last line without an end is being written, or was cut there.
    """
    found, bad = [], 0
    if path.is_file():
        with open(path, "rb") as file:
            for text in filter(lambda line: line.endswith(b"\n"), file):
                try:
                    found.append((kind.model_validate_json(text), text))
                except ValidationError:
                    bad += 1
    lines = "1 line is" if bad == 1 else f"{bad} lines are"
    return found, [f"{path.name}: {lines} damaged and left out"] if bad else []
