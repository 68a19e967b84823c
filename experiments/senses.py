"""Closed loops beside the best open loop of equal budget, for each shipped task that needs senses.

``python -m experiments.senses [--seeds N] [--only NAME,...] [--generations N] [--report]``

Each configuration evolves as it is shipped; with the same controller that lacks only the sense
which the task is about; and with each kind of controller that feels nothing. Population,
generations, episodes and their starts are the same. Champions are then scored anew, all on the same
fresh starts. Stopped by Ctrl-C, it goes on when it is started again; see `studies.py`.
`docs/senses.md` has a result.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common import as_numbers, check_whole, make_folder, write_results
from experiments.studies import Case, check_finished, given_settings, run_study, study_parser
from mjx_revolve.episodes.config import ControllerConfig, load_config
from mjx_revolve.episodes.run_reader import RunReader
from mjx_revolve.evolution.sweeps import Plan, make_plans
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import short_path
from mjx_revolve.numerics.runtime import prepare_process
from mjx_revolve.view.outcomes import write_csv
from mjx_revolve.view.statistics import Interval, difference, interval

CONFIGS: Mapping[str, Case] = {
    "lake_target": Case("reach a target that moves", ("bearing",)),
    "auv_follow_course": Case("follow a course that turns", ("course",)),
    "auv_hold_depth": Case("hold depth in gusts", ()),
    "auv_hold_heading": Case("hold depth and heading in gusts", ("compass",)),
    "auv_follow_bed": Case("follow the bed at a height", ("sonar",)),
    "auv_search": Case("search and touch", ("bearing",)),
    "auv_escape": Case("escape from a pursuer", ("bearing", "distance")),
}
"""What is compared: a shipped configuration's task, and the senses that it is about. (`feedback`
has no declared sensors that could be taken away.)"""
OPEN = ("cpg", "sine")
"""Controllers that feel nothing."""
CLOSED, WITHOUT, STILL = "closed", "without", "still"

_KEYS, _KEY = 16, 30_000  # of the starts on which champions are compared; choices


def make_cases(name: str, settings: Sequence[str] = ()) -> dict[str, tuple[str, ...]]:
    """How a configuration is varied.

    Args:
        name: in `CONFIGS`.
        settings: what replaces values in all of them, `KEY.PATH=VALUE` each.

    Returns:
        What replaces values of the configuration, by case.
    """
    found = {CLOSED: tuple(settings)}
    sensors = load_config(name).controller.sensors
    if CONFIGS[name].settings and sensors is not None:
        left = [s.to_mapping() for s in sensors if s.type not in CONFIGS[name].settings]
        # A brain that feels nothing is one of the open loops.
        if left:
            found[WITHOUT] = (*settings, f"controller.sensors={left}")
    usual = {key: ControllerConfig.model_fields[key].default for key in ("gain", "sensors")}
    blind = [f"controller.{key}={'null' if x is None else x}" for key, x in usual.items()]
    return found | {kind: (*settings, f"controller.type={kind}", *blind) for kind in OPEN}


def plan_config(folder: Path, name: str, settings: Sequence[str], seeds: int) -> list[Plan]:
    """The evolutions of a configuration, their cases named `CONFIGURATION/CASE`."""
    cases = {f"{name}/{case}": given for case, given in make_cases(name, settings).items()}
    return make_plans(folder, name, cases, range(seeds))


def score_champions(plans: Sequence[Plan]) -> dict[str, list[float]]:
    """Scores of one configuration's champions, all on the same fresh starts.

    Args:
        plans: of the configuration; those that are not finished are left out.

    Returns:
        Scores by case, one for each seed; `STILL`: of the robot at rest.
    """
    import jax

    from mjx_revolve.episodes.champion import load_genes
    from mjx_revolve.episodes.fitness import make_fitness

    keys = jax.random.split(jax.random.key(_KEY), _KEYS)
    found: dict[str, list[float]] = {}
    for label in dict.fromkeys(plan.case for plan in plans):
        case = label.rpartition("/")[2]
        some = [plan for plan in plans if plan.case == label and RunReader(plan.folder).is_finished]
        if not some:
            continue
        fitness = make_fitness(some[0].config)
        genes = [load_genes(plan.folder) for plan in some]
        if case == OPEN[0]:
            genes.append(np.zeros(fitness.num_genes, np.float32))
        # As many as a generation had, for which the program is compiled already.
        size = max(some[0].config.evolution.population_size, len(genes))
        population = np.resize(np.stack(genes), (size, fitness.num_genes))
        scores = np.mean([np.asarray(fitness(population, key)) for key in keys], 0)
        found[case] = scores[: len(some)].tolist()
        if case == OPEN[0]:
            found[STILL] = [float(scores[len(some)])]
    return found


def best_open(scores: Mapping[str, Sequence[float]]) -> str:
    """The open loop whose champions score most on average; "" without any."""
    known = [case for case in (STILL, *OPEN) if case in scores]  # one that never moves is at rest
    return max(known, key=lambda case: float(np.mean(scores[case]))) if known else ""


def compare(scores: Mapping[str, Sequence[float]]) -> Interval:
    """By how much the closed loop is better than the best open loop."""
    ours, best = scores.get(CLOSED, ()), best_open(scores)
    others = scores.get(best, ())
    # A robot at rest has no seeds: its score is known.
    return difference(ours, list(others) * (len(ours) if best == STILL else 1))


def describe(
    name: str, plans: Sequence[Plan], scores: Mapping[str, Sequence[float]]
) -> dict[str, Any]:
    """A row of the table in `docs/senses.md`."""
    from mjx_revolve.episodes.tasks import score_unit

    config, best = plans[0].config, best_open(scores)
    evolution = config.evolution
    return {
        "name": name,
        "unit": score_unit(config.task.type),
        "budget": f"{evolution.generations} × {evolution.population_size} × {config.task.trials}",
        "closed": as_numbers(interval(scores.get(CLOSED, ()))),
        "without": as_numbers(interval(scores[WITHOUT]))["text"] if WITHOUT in scores else "",
        "open": as_numbers(interval(scores.get(best, ()))),
        "best_open": best,
        "difference": as_numbers(compare(scores)),
    }


def write_report(
    folder: Path, found: Mapping[str, tuple[Sequence[Plan], Any]]
) -> list[dict[str, Any]]:
    """Writes `senses.csv`.

    Args:
        folder: where.
        found: plans and scores of each configuration.

    Returns:
        The rows of the table.
    """
    rows = [
        {"configuration": name, "case": case, "champion": k, "score": score}
        for name, (_, scores) in found.items()
        for case, values in scores.items()
        for k, score in enumerate(values)
    ]
    write_csv(folder / "senses.csv", rows)
    return [describe(name, *both) for name, both in found.items()]


def main(argv: list[str] | None = None) -> int:
    """Runs the experiment."""
    argv = sys.argv[1:] if argv is None else argv
    words = "Evolves closed and open loops for the tasks that need senses, and compares them."
    parser = study_parser("senses", words, CONFIGS)
    options = parser.parse_args(argv)
    check_whole(parser, options, "only")
    folder = make_folder(options.out, "senses").resolve()
    settings = given_settings(options)
    plans = {name: plan_config(folder, name, settings, options.seeds) for name in options.only}
    every = [plan for some in plans.values() for plan in some]
    if options.report:
        check_finished(every)
    elif code := run_study(every, "senses", argv, lambda start, champion: None):
        return code
    done = sum(RunReader(plan.folder).is_finished for plan in every)
    if options.results and done < len(every):
        raise InputError("--results", f"{len(every)} finished runs", done)
    prepare_process()
    found = {}
    for name, some in plans.items():
        if scores := score_champions(some):
            found[name] = some, scores
    if not found:
        raise InputError("--report", "runs that are finished", "none")
    rows = write_report(folder, found)
    for row in rows:
        gained = f"{row['difference']['text']} more than `{row['best_open']}`"
        print(f"{row['name']}: {row['closed']['text']} {row['unit']}, {gained}")
    if options.results:
        numbers = {"tasks": rows, "keys": _KEYS, "settings": [*settings]}
        write_results("senses", numbers, range(options.seeds))
    print(f"written: senses.csv in {short_path(folder)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
