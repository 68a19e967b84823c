"""Individuals of a run in which bodies evolved: the living, the best, lines of descent."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from mjx_revolve.episodes.individual_log import LoggedIndividual, read_generations, read_individuals
from mjx_revolve.view.colony_history import Lifespan

Picked = TypeVar("Picked")
Born = TypeVar("Born", LoggedIndividual, Lifespan)


@dataclass(frozen=True, eq=False)
class Population:
    """All individuals of a run.

    Attributes:
        lives: by number.
        living: numbers of the individuals that were alive after each generation.
    """

    lives: dict[int, LoggedIndividual]
    living: dict[int, tuple[int, ...]]

    @property
    def last(self) -> int:
        """The last generation; 0: there is none."""
        return max(self.living, default=0)

    def alive(self, generation: int) -> list[LoggedIndividual]:
        """Individuals alive after a generation, the best first, failures last."""
        found = [self.lives[n] for n in self.living.get(generation, ()) if n in self.lives]
        return sorted(found, key=rank)

    def figures(self, generation: int, name: str) -> np.ndarray:
        """`[N]` a feature of the individuals alive after a generation, the best first."""
        return np.array([life.features.get(name, math.nan) for life in self.alive(generation)])

    def best(self) -> LoggedIndividual | None:
        """The best of all, of equals the oldest; None: none has a score."""
        known = [life for life in self.lives.values() if not math.isnan(life.score)]
        return min(known, key=rank, default=None)

    def line(self, number: int) -> list[LoggedIndividual]:
        """An individual and the ancestors that gave its body, the oldest first."""
        return trace_line(self.lives, number)


def trace_line(lives: Mapping[int, Born], number: int) -> list[Born]:
    """One of these by number, and the ancestors that gave its body, the oldest first."""
    found = [lives[number]] if number in lives else []
    while found and found[-1].parents and found[-1].parents[0] in lives:
        found.append(lives[found[-1].parents[0]])
    return found[::-1]


def rank(life: LoggedIndividual) -> tuple[float, int]:
    """Sorts the best first, of equals the oldest, and failures last."""
    return math.inf if math.isnan(life.score) else -life.score, life.number


def read_population(folder: Path) -> tuple[Population, list[str]]:
    """Reads the individuals of a run.

    Args:
        folder: the run folder.

    Returns:
        The population, and a line about each thing that is wrong.
    """
    lives, problems = read_individuals(folder)
    living, more = read_generations(folder)
    problems += more
    if lives and not living:
        problems.append("generations.jsonl names none: which were alive is not known")
    lost = {number for numbers in living.values() for number in numbers} - set(lives)
    if lost:
        problems.append(f"individuals.jsonl lacks {len(lost)} of the living")
    return Population(lives, living), problems


class LineageStep(NamedTuple):
    """A step of a line of descent.

    Attributes:
        life: the individual.
        mate: the second parent, if there is one.
        skipped: ancestors between this one and the one before.
    """

    life: LoggedIndividual
    mate: LoggedIndividual | None
    skipped: int


def trace_lineage(population: Population, number: int, most: int = 8) -> list[LineageStep]:
    """The line of descent of an individual, by the parents that gave it its body.

    Args:
        population: of the run.
        number: of the individual.
        most: steps; of a longer line those stay that gained most over their parent.

    Returns:
        The steps, the oldest first.
    """
    line = population.line(number)
    scores = np.array([life.score for life in line])
    gains = np.nan_to_num(np.diff(scores, prepend=np.nan), nan=-math.inf, neginf=-math.inf)
    gains[[0, -1]] = math.inf
    kept = np.sort(np.argsort(-gains, kind="stable")[: max(most, 2)])
    found = []
    for place, before in zip(kept, [-1, *kept], strict=False):
        life = line[place]
        mate = population.lives.get(life.parents[1]) if len(life.parents) > 1 else None
        found.append(LineageStep(life, mate, int(place - before - 1)))
    return found


def pick_ancestors(population: Population, number: int, count: int) -> list[LoggedIndividual]:
    """An individual and some of its ancestors, at equal distances in its line.

    Args:
        population: of the run.
        number: of the individual.
        count: how many of them; all, where there are fewer.

    Returns:
        The oldest one first, the individual last.
    """
    return pick_evenly(population.line(number), count + 1)


def pick_evenly(these: Sequence[Picked], count: int) -> list[Picked]:
    """Some of these at equal distances, the last one among them, the first one first."""
    places = np.linspace(0, len(these) - 1, min(count, len(these)))
    return [these[k] for k in np.round(places).astype(int)]
