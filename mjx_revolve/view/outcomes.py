"""Results of the runs of a study: figures of champions and populations, ready to compare."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.body.tree import Morphology
from mjx_revolve.episodes.named_files import read_modules
from mjx_revolve.episodes.run_reader import RunReader
from mjx_revolve.episodes.tasks import TASKS, score_unit
from mjx_revolve.evolution.sweeps import Plan
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import csv_table, short_path, write_atomic
from mjx_revolve.inputs.user_code import content_name
from mjx_revolve.view.population import read_population

Figures = dict[str, float]
"""Numbers by name."""


class Outcome(NamedTuple):
    """The result of a finished evolution.

    Attributes:
        plan: of the evolution.
        champion: figures of its champion by name: `score` and measures on fresh starts, descriptors
            of its body.
        population: means over the individuals alive at the end; empty where only
            brains evolve.
        metrics: the columns of `metrics.csv`.
        body: the champion's; None if it could not be read.
        task: the task's type, a user's own by what its file holds, and "in metres" where its
            scores are.
        unit: of the scores; "" where it is not known.
        evolved: whether bodies have evolved.
        colony: whether in a colony: its fitness is not the champion's score.
        generations: that the run was to have, or intervals.
        failed: fresh starts from which its champion failed; its score counts them.
    """

    plan: Plan
    champion: Mapping[str, float]
    population: Mapping[str, float]
    metrics: Mapping[str, np.ndarray]
    body: Morphology | None
    task: str = ""
    unit: str = ""
    evolved: bool = True
    colony: bool = False
    generations: int = 0
    failed: int = 0


def find_outcomes(
    plans: Sequence[Plan], add: Callable[[str, Figures], Figures] = lambda case, figures: {}
) -> tuple[list[Outcome], list[str]]:
    """The results of the finished runs, without running any user's code.

    Args:
        plans: the runs; those that are not finished are left out.
        add: (case, figures of an individual) → more figures of it.

    Returns:
        The outcomes, and a line on each run that is damaged.
    """
    found, lost = [], []
    for plan in plans:
        try:
            if RunReader(plan.folder).is_finished:
                found.append(_read_outcome(plan, add))
        except (OSError, KeyError, ValueError, TypeError, IndexError) as error:
            place = short_path(plan.folder)
            words = " ".join(str(error).split())
            lost.append(f"{place}: expected a whole run; found: {words.removeprefix(place + ': ')}")
    # In a study that was made longer, a run that has not gone on yet is not finished.
    return [one for one in found if one.generations >= _wanted(one.plan)], lost


def _wanted(plan: Plan) -> int:
    """The generations that a study asks of a run; 0 where its base is not there any more."""
    try:
        return plan.config.evolution.generations
    except (InputError, OSError):
        return 0


def _read_outcome(plan: Plan, add: Callable[[str, Figures], Figures]) -> Outcome:
    run = RunReader(plan.folder)
    facts, config = run.info["champion"], run.load_config()
    path = plan.folder / "champion" / "morphology.yaml"
    body = None
    if path.is_file() or config.bodies is not None:
        body = load_morphology(path, read_modules(config), allow_overlap=True)
    champion = {"score": float(facts["score"])}
    champion |= {name: float(value) for name, value in facts["measures"].items()}
    champion |= {} if body is None else body.descriptors
    champion |= add(plan.case, champion)
    population: Figures = {}
    if config.bodies is not None:
        people, problems = read_population(plan.folder)
        if problems:
            raise ValueError(problems[0])
        living = people.alive(people.last)
        alive = [dict(life.features) for life in living if life.score == life.score]
        lives = [life | add(plan.case, life) for life in alive]
        names = lives[0] if lives else {}
        population = {name: float(np.mean([life[name] for life in lives])) for name in names}
    metrics = run.load_metrics()
    for name in ("generation", "evaluations", "seconds", "champion"):
        _ = metrics[name][-1]
    name = config.task.type
    unit = score_unit(name, config.task.unit) if name in TASKS else ""
    task = content_name(name) + " in metres" * (config.task.unit == "m")
    kind = config.bodies is not None, config.colony is not None, config.evolution.generations
    failed = int(facts.get("failed_starts", 0))
    return Outcome(plan, champion, population, metrics, body, task, unit, *kind, failed)


def by_case(outcomes: Sequence[Outcome], cases: Iterable[str]) -> dict[str, list[Outcome]]:
    """Outcomes by case, in the order of the cases; those without any are left out."""
    found = {name: [o for o in outcomes if o.plan.case == name] for name in cases}
    return {name: some for name, some in found.items() if some}


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Rows as CSV, whole or not at all; see `csv_table`."""
    write_atomic(path, csv_table(rows))
