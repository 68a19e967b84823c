"""Who lived in a run in which bodies evolved: its logs, read back as far as they are whole.

`individuals.jsonl` has a line for each individual ever born, `generations.jsonl` one for each
generation, and in a colony `events.jsonl` one for each birth, mating and death. What writes them is
in `evolution/`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import Morphology, make_morphology
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.schema import LARGEST

INDIVIDUALS, GENERATIONS = "individuals.jsonl", "generations.jsonl"
EVENTS = "events.jsonl"


@dataclass(frozen=True, eq=False)
class Life:
    """What became of an individual.

    Attributes:
        number: unique in its run.
        parents: theirs; of two, the first gave the body.
        born: the generation.
        origin: how it came about.
        score: the best of its life; NaN where every trial failed.
        figures: score, measures and descriptors by name.
        text: its line of JSON, which holds its body and genes, too.
    """

    number: int
    parents: tuple[int, ...]
    born: int
    origin: str
    score: float
    figures: Mapping[str, float] = field(repr=False)
    text: bytes = field(repr=False)

    @property
    def genes(self) -> np.ndarray | None:
        """`[n]` float32 what it has learnt, as its body's own controller takes it; None: nothing.

        Raises:
            InputError: they are no finite numbers.
        """
        found = json.loads(self.text).get("genes")
        if found is None:
            return None
        if not isinstance(found, list) or not all(map(_is_number, found)):
            raise InputError(
                f"individual {self.number}: genes: expected numbers; found {str(found)[:60]}"
            )
        return np.array(found, np.float32)

    def grow(self, modules: Mapping[str, ModuleType]) -> Morphology:
        """Its body, not trimmed.

        Args:
            modules: the types of modules by name.

        Returns:
            The body.

        Raises:
            InputError: the line holds none.
        """
        try:
            return make_morphology(json.loads(self.text).get("body"), modules, allow_overlap=True)
        except InputError as error:
            raise InputError(f"individual {self.number}: {error}") from None


@dataclass(frozen=True, eq=False)
class Event:
    """What happened in a colony.

    Attributes:
        time: when [s].
        kind: "birth", "mating" or "death".
        number: of the individual to whom it happened.
        place: `[3]` where, world frame [m]; NaN where that is not known.
        other: of a mating, the number of the second one.
        cause: of a death, what of; else "".
        parents: of a birth.
    """

    time: float
    kind: str
    number: int
    place: np.ndarray = field(repr=False)
    other: int | None = None
    cause: str = ""
    parents: tuple[int, ...] = ()


def read_lives(folder: Path) -> tuple[dict[int, Life], list[str]]:
    """Everybody who was born in a run.

    Args:
        folder: the run folder.

    Returns:
        Lives by number, in the order of birth, and a line about each thing that is wrong.
    """
    found: dict[int, Life] = {}
    bad = 0
    for text in _lines(folder / INDIVIDUALS):
        life = _read_life(text)
        if life is None:
            bad += 1
        else:
            found[life.number] = life
    return found, _complain(INDIVIDUALS, bad)


def find_lives(folder: Path, numbers: Sequence[int]) -> list[Life]:
    """Some of those who were born in a run.

    Args:
        folder: the run folder.
        numbers: whom.

    Returns:
        Their lives, in that order.

    Raises:
        InputError: there is none of such a number.
    """
    path = folder / INDIVIDUALS
    if not path.is_file():
        raise InputError(f"{path}: expected all who lived in the run; found no such file")
    lives, _ = read_lives(folder)
    for number in numbers:
        if number not in lives:
            known = f"those from {min(lives)} to {max(lives)}" if lives else "nobody"
            raise InputError(f"{path}: expected individual {number}; found {known}")
    return [lives[number] for number in numbers]


def read_generations(folder: Path) -> tuple[dict[int, tuple[int, ...]], list[str]]:
    """Who was alive after each generation of a run.

    Args:
        folder: the run folder.

    Returns:
        Numbers of individuals by generation, and a line about each thing that is wrong.
    """
    found: dict[int, tuple[int, ...]] = {}
    bad = 0
    for text in _lines(folder / GENERATIONS):
        try:
            line = json.loads(text)
            generation, living = line["generation"], line["living"]
            if not all(map(_is_whole, (generation, *living))):
                raise ValueError
            found[generation] = tuple(living)
        except (KeyError, TypeError, ValueError):
            bad += 1
    return dict(sorted(found.items())), _complain(GENERATIONS, bad)


def read_events(folder: Path) -> tuple[list[Event], list[str]]:
    """What happened in a colony.

    Args:
        folder: the run folder.

    Returns:
        The events in the order of time, and a line about each thing that is wrong.
    """
    found: list[Event] = []
    bad = 0
    for text in _lines(folder / EVENTS):
        event = _read_event(text)
        if event is None:
            bad += 1
        else:
            found.append(event)
    # Within an interval they are as they were written.
    return sorted(found, key=lambda event: event.time), _complain(EVENTS, bad)


def _lines(path: Path) -> Iterator[bytes]:
    """All lines that have an end; a last one without is being written, or was cut there."""
    if path.is_file():
        with open(path, "rb") as file:
            yield from (line for line in file if line.endswith(b"\n"))


def _complain(name: str, bad: int) -> list[str]:
    lines = "1 line is" if bad == 1 else f"{bad} lines are"
    return [f"{name}: {lines} damaged and left out"] if bad else []


def _read_life(text: bytes) -> Life | None:
    """A life from its line; None where that is damaged."""
    try:
        line = json.loads(text)
        number, parents, born = line["id"], line["parents"], line["born"]
        score = math.nan if line["score"] is None else line["score"]
        figures = {"score": score, **line["descriptors"], **line["measures"]}
        wrong = not all(map(_is_whole, (number, born, *parents)))
        wrong |= any(parent >= number for parent in parents)
        if wrong or any(not isinstance(x, float | int) for x in figures.values()):
            return None
        origin = str(line["origin"])
        return Life(number, tuple(parents), born, origin, float(score), figures, text)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return None


def _read_event(text: bytes) -> Event | None:
    """An event from its line; None where that is damaged."""
    try:
        line = json.loads(text)
        time, kind, number, place = line["time"], line["event"], line["id"], line["place"]
        other = line["other"] if kind == "mating" else None
        cause = line["cause"] if kind == "death" else ""
        parents = tuple(line["parents"]) if kind == "birth" else ()
        wrong = kind not in ("birth", "mating", "death") or not isinstance(cause, str)
        wrong |= not _is_number(time) or time < 0 or len(place) != 3
        wrong |= not all(_is_number(x) for x in place if x is not None)
        numbers = (number, *parents, *(() if other is None else (other,)))
        if wrong or not all(map(_is_whole, numbers)) or any(p >= number for p in parents):
            return None
        where = np.array([math.nan if x is None else x for x in place], float)
        return Event(float(time), kind, number, where, other, cause, parents)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return None


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= LARGEST  # neither infinite nor NaN, nor a whole number of many digits
