"""What became of everybody in a colony: from when to when they lived, and of whom they come."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from mjx_revolve.episodes.lives import Event, read_events, read_lives


@dataclass(frozen=True, eq=False)
class Span:
    """From birth to death.

    Attributes:
        number: whose.
        parents: theirs; the first gave the body.
        founder: the first of the line that gave the body.
        born: when [s].
        end: of its death, or of what is known where it lives on [s].
        cause: of its death; "" where it lives on.
        score: its last fitness; NaN where that is not known.
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
        """How old it got, or is [s]."""
        return self.end - self.born


@dataclass(frozen=True, eq=False)
class History:
    """A colony's life.

    Attributes:
        spans: of all who were ever born, by number, in the order of birth.
        events: in the order of time.
        end: until when it is known [s].
    """

    spans: dict[int, Span]
    events: list[Event]
    end: float

    def of_kind(self, kind: str) -> list[Event]:
        """All births, matings or deaths."""
        return [event for event in self.events if event.kind == kind]

    @cached_property
    def children(self) -> dict[int, list[int]]:
        """Numbers of those to whom somebody gave the body, in the order of birth."""
        found: dict[int, list[int]] = {number: [] for number in self.spans}
        for span in self.spans.values():
            if span.parents and span.parents[0] in found:
                found[span.parents[0]].append(span.number)
        return found

    @cached_property
    def families(self) -> list[int]:
        """Founders, whose line lived longest (in robots times seconds) first."""
        lived: dict[int, float] = defaultdict(float)
        for span in self.spans.values():
            lived[span.founder] += span.age
        return sorted(lived, key=lambda founder: (-lived[founder], founder))

    def count_living(self, times: np.ndarray, founder: int | None = None) -> np.ndarray:
        """How many lived at some times.

        Args:
            times: `[T]` [s].
            founder: of one family only; None: of all.

        Returns:
            `[T]`; who dies at a moment does not count in it, who is born does.
        """
        these = [s for s in self.spans.values() if founder is None or s.founder == founder]
        born = np.sort([span.born for span in these])
        gone = np.sort([span.end for span in these if span.cause])
        return np.searchsorted(born, times, "right") - np.searchsorted(gone, times, "right")

    def line(self, number: int) -> list[int]:
        """Somebody and those whose body it has, in the end: the oldest first."""
        found: list[int] = []
        while number in self.spans:
            found.append(number)
            parents = self.spans[number].parents
            if not parents:
                break
            number = parents[0]
        return found[::-1]


def read_history(folder: Path, until: float = 0.0) -> tuple[History, list[str]]:
    """Reads what became of everybody in a colony.

    Args:
        folder: the run folder.
        until: until when it has lived, where more is known than its events tell [s].

    Returns:
        The history, and a line about each thing that is wrong. Who died without having been born,
        as a log says that lacks lines, is left out.
    """
    events, problems = read_events(folder)
    lives, more = read_lives(folder)
    end = max([until, *(event.time for event in events)])
    if lives and not events:
        problems.append("events.jsonl: nobody knows when and where who lived")
    return put_together(events, {n: life.score for n, life in lives.items()}, end), problems + more


def put_together(events: list[Event], scores: dict[int, float], end: float) -> History:
    """A history from what happened.

    Args:
        events: in the order of time.
        scores: of individuals, as far as they are known.
        end: until when it is known [s].

    Returns:
        The history.
    """
    deaths = {event.number: event for event in events if event.kind == "death"}
    spans: dict[int, Span] = {}
    for event in sorted((e for e in events if e.kind == "birth"), key=lambda e: e.number):
        number, death = event.number, deaths.get(event.number)
        mother = spans.get(event.parents[0]) if event.parents else None
        spans[number] = Span(
            number=number,
            parents=event.parents,
            founder=number if mother is None else mother.founder,
            born=event.time,
            end=end if death is None else death.time,
            cause="" if death is None else death.cause,
            score=scores.get(number, math.nan),
        )
    return History(spans, events, end)
