"""Co-evolution, random search and hand-made bodies, each with as many trials, in the lake.

``python -m experiments.budgets [--seeds N] [--only NAME,...] [--generations N] [--report]``

`--generations` are those of co-evolution; the others get as many trials. Stopped by Ctrl-C, it goes
on when it is started again; see `studies.py`. What all runs share stands in `studies.yaml`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.common import ROOT
from experiments.studies import (
    BASE,
    Case,
    describe_runs,
    draw_outcomes,
    fill,
    study_main,
)
from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.view.body_pictures import plot_bodies
from mjx_revolve.view.convergence import draw_scores
from mjx_revolve.view.outcomes import Outcome, by_case, write_csv
from mjx_revolve.view.plots import WIDE, figure_png, in_style, new_figure
from mjx_revolve.view.statistics import COVERAGE, difference, holm, rank_test

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
        The number.
    """
    bodies, first = config.bodies, config.evolution.population_size
    assert bodies is not None
    children = bodies.selection.offspring or first
    return (first + (config.evolution.generations - 1) * children) * bodies.learning.trials


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

_INTRODUCTION = """# Co-evolution beside random search and hand-made bodies

All swim in the lake and get equally many trials, in which the score is the net horizontal speed
[body lengths/s]. Made by `python -m experiments.budgets`, which repeats it;
`experiments/studies.yaml` has what all runs share. Champions are judged on sixteen fresh starts.
"""


_NOTES = f"""{COVERAGE} p is Mann's and Whitney's test, by permutations and with Holm's correction
over the table. Who picks the best of the hand-made bodies picks it by the scores that it is then
judged by, which is in its favour. The fish has a fin, which co-evolution has not."""


def describe_difference(name: str, values: Sequence[float], others: Sequence[float]) -> str:
    """Co-evolution beside another case.

    Args:
        name: of the other case.
        values: scores of co-evolution's champions.
        others: of the other case's.

    Returns:
        A row of a table in Markdown, but for its last cell.
    """
    found = difference(values, others)
    zero = "no" if found.low > 0 or found.high < 0 else "yes"
    return f"| `coevolution` − `{name}` | {found} | {zero if np.isfinite(found.low) else '–'} |"


@in_style
def write_report(folder: Path, outcomes: Sequence[Outcome]) -> list[str]:
    """Writes `budgets.md`, its pictures and `budgets.csv`.

    Args:
        folder: where.
        outcomes: of the finished runs.

    Returns:
        What was found, in lines.
    """
    known = make_cases()
    cases = by_case(outcomes, known)
    scores = {name: [o.champion["score"] for o in found] for name, found in cases.items()}
    lines = []
    if ours := scores.get("coevolution"):
        others = [name for name in cases if name != "coevolution"]
        p = holm([rank_test(ours, scores[name]) for name in others])
        lines = ["| | difference of means | holds 0 | p |", "|---|---|---|---|"]
        lines += [
            f"{describe_difference(name, ours, scores[name])} {value:.2g} |"
            for name, value in zip(others, p, strict=True)
        ]
    fastest = max(outcomes, key=lambda o: o.champion["score"])
    text = [
        _INTRODUCTION,
        *describe_runs(cases, known),
        "",
        *lines,
        "",
        f"The fastest of all: {fastest.champion['score']:.3g} body lengths/s, "
        f"`{fastest.plan.case}`, seed {fastest.plan.seed}.",
        "",
        fill(_NOTES),
        "",
        "![scores over trials, and champions'](budgets.png)",
        "",
        "Left: the best score so far, on the starts that it was found on, which flatters. Right:",
        "champions on fresh starts.",
        "",
        "![champions' bodies](budgets_bodies.png)",
    ]
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
    write_atomic(folder / "budgets.md", ("\n".join(text) + "\n").encode())
    return lines


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and reports it."""
    what = "Co-evolution, random search and hand-made bodies, each with as many trials."
    return study_main("budgets", what, make_cases, write_report, argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main))
