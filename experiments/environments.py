"""Bodies and brains evolved in four environments, and how they differ: the thesis's question.

``python -m experiments.environments [--seeds N] [--only NAME,...] [--generations N] [--report]``

Each run is an ordinary run folder. Stopped by Ctrl-C, it goes on when it is started again; see
`studies.py`. What all runs have in common stands in `studies.yaml`.
"""

from __future__ import annotations

import sys

from experiments.studies import Case, Figures, make_plans, read_outcomes, run_study, study_parser
from mjx_revolve.inputs.commands import run_command

CURRENT = 0.05  # m/s along x, of `current`; about what a small swimmer can keep up with, a choice
# A pond in which neither surface nor bed is further than 0.3 m from the start; both slope together
# 2 m away. Choices, of a robot's size.
_POND = "{kind: lake, height: -0.6, highest: 0.3, extent: 6.0}"

ENVIRONMENTS: dict[str, Case] = {
    "open_water": Case(
        "deep, still water: `empty_underwater`, 2 m below the surface",
        ("world=empty_underwater",),
    ),
    "shore": Case(
        "a pond 0.6 m deep whose shore is 2 m away, halfway between surface and bed",
        (f"world={{name: lake, bed: {_POND}}}", "task.depth=0.3"),
    ),
    "bed": Case(
        "on the lake's bed; bodies are not trimmed, so they sink",
        ("world=lake", "trim=none", "task.type=crawl"),
    ),
    "current": Case(
        f"2 m below the lake's surface in a current of {CURRENT:g} m/s; progress against it counts",
        (
            f"world={{name: lake, current: [{CURRENT:g}, 0, 0]}}",
            "task.type=directed_swim",
            "task.direction=[-1, 0, 0]",
        ),
    ),
}


def through_water(case: str, figures: Figures) -> Figures:
    """The score as a speed through the water: what the current takes is added.

    Args:
        case: the environment.
        figures: of an individual.

    Returns:
        `water_speed_bl_s` [body lengths/s].
    """
    taken = CURRENT / figures["length"] if case == "current" else 0.0
    return {"water_speed_bl_s": figures["score"] + taken}


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and reports it."""
    argv = sys.argv[1:] if argv is None else argv
    parser = study_parser("environments", "Bodies evolved in four environments.", ENVIRONMENTS)
    options = parser.parse_args(argv)
    folder, plans = make_plans(ENVIRONMENTS, options, "environments")
    if not options.report and (code := run_study(plans, "environments", argv)):
        return code
    read_outcomes(plans, through_water)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
