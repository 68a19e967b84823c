"""The record of a run for reports: what could be read of its folder, and what is wrong with it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.episodes.config import OLDER_TASK, Config
from mjx_revolve.episodes.passport import Passport
from mjx_revolve.episodes.tasks import score_unit, shown_measure
from mjx_revolve.inputs.errors import InputError, plain
from mjx_revolve.inputs.files import short_path
from mjx_revolve.inputs.trust import UntrustedError
from mjx_revolve.inputs.user_code import content_name
from mjx_revolve.view.colony_history import ColonyHistory
from mjx_revolve.view.convergence import COLONY_LABEL
from mjx_revolve.view.plots import with_unit
from mjx_revolve.view.population import Population

# Kinds of problems, gravest first, and what they make of the run.
KINDS = {
    "damaged": "damaged",
    "missing": "incomplete",
    "unfinished": "not finished",
    "failed": "some starts failed",
    "untrusted": "not shown in full",
    "version": "of another version",
    "changed": "changed",
    "copy": "a copy",
}


@dataclass(frozen=True)
class Problem:
    """Something that is wrong with a run folder.

    Attributes:
        kind: one of `KINDS`.
        text: one line for a reader.
    """

    kind: str
    text: str


@dataclass
class RunRecord:
    """A run as far as it could be read.

    Attributes:
        folder: the run folder.
        label: what the report calls it.
        info: `run.json`; empty where there is none.
        settings: `config.yaml` as plain values; empty where there is none.
        config: the same, checked; None where it cannot be used.
        metrics: columns of `metrics.csv`, `[T]` each, one row per generation; empty without any.
        genes: `[G]` of the champion; None without one.
        population: all individuals, where bodies have evolved; else None.
        history: their births, matings and deaths, in a colony; else None.
        champion: facts about it: score, score_std, origin, final, measures, individual.
        passport: what it was tried for; None without one.
        problems: what is missing, damaged or otherwise notable.
    """

    folder: Path
    label: str
    info: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    config: Config | None = None
    metrics: dict[str, np.ndarray] = field(default_factory=dict)
    genes: np.ndarray | None = None
    population: Population | None = None
    history: ColonyHistory | None = None
    champion: dict[str, Any] = field(default_factory=dict)
    passport: Passport | None = None
    problems: list[Problem] = field(default_factory=list)

    @property
    def path(self) -> str:
        """Of the folder, for commands: the label of one that is worked in is a name alone."""
        leads_there = Path(self.label).absolute() == self.folder
        return self.label.rstrip("/") if leads_there else str(self.folder)

    def note(self, kind: str, text: str) -> None:
        """Adds a problem once, without the folder's path."""
        for folder in (str(self.folder), short_path(self.folder)):
            text = text.replace(f"{folder}/", "")
        problem = Problem(kind, plain(text))
        if problem not in self.problems:
            self.problems.append(problem)

    @contextmanager
    def noting_damage(self) -> Iterator[None]:
        """Turns errors of readers within the context into problems."""
        try:
            yield
        except UntrustedError as error:
            self.note("untrusted", str(error))
        except (InputError, OverflowError) as error:
            self.note("damaged", str(error))

    def setting(self, path: str, default: object = None) -> Any:
        """A setting by its dotted name; the default where nothing is known."""
        data: Any = self.settings if self.config is None else self.config.model_dump()
        for part in path.split("."):
            data = data.get(part) if isinstance(data, Mapping) else None
        return default if data is None else data

    @property
    def seed(self) -> int | None:
        """The seed, or None."""
        seed = self.setting("evolution.seed", self.info.get("seed"))
        return seed if isinstance(seed, int) else None

    @property
    def task(self) -> str:
        """The task's type; a user's own by what its file holds; "" where it is not known.

        Scores in metres are those of another task, and so are those of the core or by the length
        at rest.
        """
        found = content_name(self._task_type) + " in metres" * (self._length_unit == "m")
        measured = [str(self.setting(f"task.{name}", old)) for name, old in OLDER_TASK.items()]
        return found + (f" ({', '.join(measured)})" if measured == [*OLDER_TASK.values()] else "")

    @property
    def unit(self) -> str:
        """Of the fitness; "" where it is not known."""
        return score_unit(self._task_type, self._length_unit)

    @property
    def measure(self) -> str:
        """Name of the measure that reports show beside the score."""
        return shown_measure(self._task_type, self._length_unit)

    @property
    def _length_unit(self) -> str:
        return str(self.setting("task.unit", "body_lengths"))

    @property
    def _task_type(self) -> str:
        task = self.setting("task.type", "")
        return task if isinstance(task, str) else ""

    @property
    def fitness(self) -> str:
        """Name and unit of the fitness; in a colony it differs from its champion's score."""
        if self.history is not None:
            return COLONY_LABEL
        return with_unit("fitness", self.unit)

    @property
    def round(self) -> str:
        """The word for a generation: "interval" in a colony."""
        return "generation" if self.history is None else "interval"

    @property
    def generations(self) -> int:
        """How many generations the metrics have."""
        return int(self.metrics["generation"][-1]) if self.metrics else 0

    @property
    def individual(self) -> int | None:
        """The champion's number, where bodies have evolved and it is known."""
        found = self.champion.get("individual")
        known = {} if self.population is None else self.population.lives
        return found if isinstance(found, int) and found in known else None

    @property
    def trials(self) -> int:
        """Episodes of each start; 1 where that is not known."""
        return 1 if self.config is None else self.config.task.trials

    @property
    def is_finished(self) -> bool:
        """Whether its champion was evaluated on fresh starts."""
        return "finished" in self.info and number(self.champion.get("score")) is not None

    @property
    def state(self) -> str:
        """What the problems make of it, in words; "" for a sound run."""
        kinds = {problem.kind for problem in self.problems}
        return ", ".join(word for kind, word in KINDS.items() if kind in kinds)

    @property
    def warning(self) -> str:
        """One line about all problems."""
        return f"{self.label}: {self.state}: {'; '.join(p.text for p in self.problems)}"


def number(value: object) -> float | None:
    """A finite number as a float; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:  # a whole number of hundreds of digits
        return None
