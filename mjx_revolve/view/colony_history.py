"""Lives of the robots of a colony: birth, death and descent."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from mjx_revolve.episodes.individual_log import Event, read_events, read_individuals


@dataclass(frozen=True, eq=False)
class Lifespan:
    """A robot's life, from birth to death.

    Attributes:
        number: of the robot.
        parents: their numbers; the first gave the body.
        founder: the first of the line that gave the body.
        born: when [s].
        end: time of death; of a living robot, end of the record [s].
        cause: of death; "" of a living robot.
        score: last fitness; NaN where it is not known.
    """

    number: int
    parents: tuple[int, ...]
    founder: int
    born: float
    end: float
    cause: str
    score: float

    @property
    def age(self) -> float:
        """Age at death, or so far [s]."""
        return self.end - self.born


@dataclass(frozen=True, eq=False)
class ColonyHistory:
    """The history of a colony.

    Attributes:
        spans: lives by number, in the order of birth.
        events: in the order of time.
        end: of the record [s].
    """

    spans: dict[int, Lifespan]
    events: list[Event]
    end: float

    def of_kind(self, kind: str) -> list[Event]:
        """All births, matings or deaths."""
        return [event for event in self.events if event.kind == kind]

    @cached_property
    def children(self) -> dict[int, list[int]]:
        """Numbers of the children that have each robot's body, in the order of birth."""
        found: dict[int, list[int]] = {number: [] for number in self.spans}
        for span in self.spans.values():
            if span.parents and span.parents[0] in found:
                found[span.parents[0]].append(span.number)
        return found

    @cached_property
    def families(self) -> list[int]:
        """Founders, the longest-lived line (robots times seconds) first."""
        lived: dict[int, float] = defaultdict(float)
        for span in self.spans.values():
            lived[span.founder] += span.age
        return sorted(lived, key=lambda founder: (-lived[founder], founder))

    def count_living(self, times: np.ndarray, founder: int | None = None) -> np.ndarray:
        """Numbers of living robots `[T]`; births count at their time, deaths do not.

        Args:
            times: `[T]` [s].
            founder: of one family only; None: of all.
        """
        these = [s for s in self.spans.values() if founder is None or s.founder == founder]
        born = np.sort([span.born for span in these])
        gone = np.sort([span.end for span in these if span.cause])
        return np.searchsorted(born, times, "right") - np.searchsorted(gone, times, "right")


def read_history(folder: Path, until: float = 0.0) -> tuple[ColonyHistory, list[str]]:
    """Reads the history of a colony.

    Args:
        folder: the run folder.
        until: time that it has lived at least, where its events end earlier [s].

    Returns:
        The history, and a line about each thing that is wrong. Deaths without a birth, of a log
        that lacks lines, are left out.
    """
    events, problems = read_events(folder)
    lives, more = read_individuals(folder)
    end = max([until, *(event.time for event in events)])
    if lives and not events:
        problems.append("events.jsonl is missing: times and places of lives are not known")
    return make_history(events, {n: life.score for n, life in lives.items()}, end), problems + more


def make_history(events: list[Event], scores: dict[int, float], end: float) -> ColonyHistory:
    """Makes a history of events.

    Args:
        events: in the order of time.
        scores: of individuals, as far as they are known.
        end: of the record [s].

    Returns:
        The history.
    """
    deaths = {event.number: event for event in events if event.kind == "death"}
    spans: dict[int, Lifespan] = {}
    for event in sorted((e for e in events if e.kind == "birth"), key=lambda e: e.number):
        number, death = event.number, deaths.get(event.number)
        mother = spans.get(event.parents[0]) if event.parents else None
        spans[number] = Lifespan(
            number=number,
            parents=event.parents,
            founder=number if mother is None else mother.founder,
            born=event.time,
            end=end if death is None else death.time,
            cause="" if death is None else death.cause,
            score=scores.get(number, math.nan),
        )
    return ColonyHistory(spans, events, end)
