"""Co-evolution, random search and hand-made bodies, each with as many trials, in the lake.

``python -m experiments.budgets [--seeds N] [--only NAME,...] [--generations N] [--report]``

`--generations` are those of co-evolution; the others get as many trials. Stopped by Ctrl-C, it goes
on when it is started again; see `studies.py`. What all runs share stands in `studies.yaml`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from experiments.common import ROOT
from experiments.studies import (
    BASE,
    Case,
    given_settings,
    make_plans,
    read_outcomes,
    run_study,
    study_parser,
)
from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.inputs.commands import run_command

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


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and reports it."""
    argv = sys.argv[1:] if argv is None else argv
    what = "Co-evolution, random search and hand-made bodies, each with as many trials."
    options = study_parser("budgets", what, make_cases()).parse_args(argv)
    folder, plans = make_plans(make_cases(given_settings(options)), options, "budgets")
    if not options.report and (code := run_study(plans, "budgets", argv)):
        return code
    read_outcomes(plans)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
