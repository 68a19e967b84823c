"""Co-evolution, random search and hand-made bodies, each with as many trials, in the lake.

``python -m experiments.budgets [--seeds N] [--only NAME,...] [--generations N] [--report]``

`--generations` are those of co-evolution; the others get as many trials. Stopped by Ctrl-C, it goes
on when it is started again; see `studies.py`. What all runs share stands in `studies.yaml`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.common import ROOT, as_numbers
from experiments.studies import BASE, Case, describe_runs, draw_outcomes, study_main
from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.view.body_pictures import plot_bodies
from mjx_revolve.view.convergence import draw_scores
from mjx_revolve.view.outcomes import Outcome, by_case, write_csv
from mjx_revolve.view.plots import WIDE, figure_png, in_style, new_figure
from mjx_revolve.view.statistics import difference, holm, rank_test

ROBOTS = ("spider", "gecko", "snake", "centipede", "fish")
BRAINS = 64  # CMA-ES's population for one body: as many lanes as the step takes at a time, a choice
EVOLVED: dict[str, Case] = {
    "coevolution": Case("bodies and brains evolve, and learn in each life", ()),
    "random_search": Case(
        "bodies and brains are drawn at random, and learn as much; none inherits",
        ("bodies.selection.type=random",),
    ),
}


def count_trials(config: Config) -> int:
    """Brains that an evolution tries.

    Args:
        config: of an evolution of bodies.

    Returns:
        The number, with the evaluations of `selection.reevaluate`.
    """
    bodies, first = config.bodies, config.evolution.population_size
    assert bodies is not None
    children, later = bodies.selection.offspring or first, config.evolution.generations - 1
    again = bodies.selection.reevaluate * (first + later * (first + children))
    return (first + later * children) * bodies.learning.trials + again


def make_cases(settings: Sequence[str] = ()) -> dict[str, Case]:
    """What is compared, each with as many trials as co-evolution or, to fill a generation, more.

    Args:
        settings: what replaces values of the configuration, `KEY.PATH=VALUE` each.

    Returns:
        The cases by name.
    """
    generations = -(-count_trials(load_config(BASE, settings)) // BRAINS)
    budget = f"evolution.population_size={BRAINS}", f"evolution.generations={generations}"
    return EVOLVED | {
        robot: Case(
            f"`morphologies/{robot}.yaml`, whose controller evolves by CMA-ES",
            ("bodies=null", f"morphology={ROOT / 'morphologies' / robot}.yaml", *budget),
        )
        for robot in ROBOTS
    }


# --- the report -----------------------------------------------------------------------------------


@in_style
def write_report(folder: Path, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Writes `budgets.csv` and the pictures of `docs/budgets.md`.

    Args:
        folder: where.
        outcomes: of the finished runs.

    Returns:
        The numbers of the results file.
    """
    known = make_cases()
    cases = by_case(outcomes, known)
    scores, swum = (
        {name: [o.champion[figure] for o in found] for name, found in cases.items()}
        for figure in ("score", "swum_score")
    )
    fastest = max(outcomes, key=lambda o: o.champion["score"])
    figure = new_figure(WIDE + 3, 4.4)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    draw_outcomes(left, cases, "best score so far (body lengths/s)")
    draw_scores(right, scores)
    right.set_title("champions on fresh starts (body lengths/s)")
    write_atomic(folder / "budgets.png", figure_png(figure))
    bodies = plot_bodies({name: cases[name] for name in EVOLVED if name in cases} or cases)
    write_atomic(folder / "budgets_bodies.png", figure_png(bodies))
    rows = [{"case": o.plan.case, "seed": o.plan.seed, **o.champion} for o in outcomes]
    write_csv(folder / "budgets.csv", rows)
    return {
        "runs": describe_runs(cases, known),
        "differences": _compare(scores),
        "swum_differences": _compare(swum),
        "fastest": {
            "score": fastest.champion["score"], "name": fastest.plan.case, "seed": fastest.plan.seed
        },
    }  # fmt: skip


def _compare(scores: Mapping[str, Sequence[float]]) -> list[dict[str, Any]]:
    """Co-evolution's scores beside those of each other case."""
    others = [name for name in scores if "coevolution" in scores and name != "coevolution"]
    p = holm([rank_test(scores["coevolution"], scores[name]) for name in others])
    return [
        {
            "name": name,
            "difference": as_numbers(difference(scores["coevolution"], scores[name])),
            "p": value,
        }
        for name, value in zip(others, p, strict=True)
    ]


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and reports it."""
    what = "Co-evolution, random search and hand-made bodies, each with as many trials."
    return study_main("budgets", what, make_cases, write_report, argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main))
