"""Bodies and brains evolved in four environments, and how they differ: the thesis's question.

``python -m experiments.environments [--seeds N] [--only NAME,...] [--generations N] [--report]``

Each run is an ordinary run folder. Stopped by Ctrl-C, it goes on when it is started again; see
`studies.py`. What all runs have in common stands in `studies.yaml`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from scipy import stats

from experiments.common import as_numbers
from experiments.studies import Case, describe_runs, draw_outcomes, study_main
from mjx_revolve.body.descriptors import UNITS
from mjx_revolve.episodes.measure_table import MEASURES
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.inputs.overrides import read_overrides, sets
from mjx_revolve.view.body_pictures import plot_bodies
from mjx_revolve.view.convergence import draw_scores
from mjx_revolve.view.outcomes import Figures, Outcome, by_case, write_csv
from mjx_revolve.view.plots import WIDE, figure_png, in_style, new_figure, panels
from mjx_revolve.view.statistics import ALPHA, Comparison, compare, interval, smallest_p

CURRENT = 0.05  # m/s along x, of `current`; about what a small swimmer can keep up with, a choice
# A pond that bodies of 0.2 to 0.3 m must notice: their core starts 0.15 m from surface and bed, and
# these meet 0.9 m away. Choices.
_POND = "{kind: lake, height: -0.3, highest: 0.1, extent: 2.4}"

# The way that was made counts, not what is foretold of it: a shore is soon reached.
_SWUM = "task.horizon=null"
ENVIRONMENTS: dict[str, Case] = {
    "open_water": Case(
        "deep, still water: `empty_underwater`, 2 m below the surface",
        ("world=empty_underwater", _SWUM),
    ),
    "shore": Case(
        "a pond 0.3 m deep whose shore is 0.9 m away, halfway between surface and bed",
        (f"world={{name: lake, bed: {_POND}}}", "task.depth=0.15", _SWUM),
    ),
    "bed": Case(
        "on the lake's bed; bodies are not trimmed, so they sink",
        ("world=lake", "trim=none", "task.type=crawl", "task.start_attitude=level", _SWUM),
    ),
    "current": Case(
        f"2 m below the lake's surface in a current of {CURRENT:g} m/s; progress against it counts",
        (
            f"world={{name: lake, current: [{CURRENT:g}, 0, 0]}}",
            "task.type=directed_swim",
            "task.direction=[-1, 0, 0]",
            # All of the way counts, at any depth.
            "task.depth_tolerance=2.0",
            _SWUM,
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
    moved = case == "current" and figures["speed_m_s"] > 0
    taken = CURRENT * figures["speed_bl_s"] / figures["speed_m_s"] if moved else 0.0
    return {"water_speed_bl_s": figures["score"] + taken}


# --- the report -----------------------------------------------------------------------------------

# What is compared: how they move, and what they are like. The CSV file has all other figures.
_GAIT = (
    "water_speed_bl_s", "gait_frequency_hz", "gait_phase_spread_rad", "joint_amplitude_rad",
    "straightness", "energy_j", "cost_of_transport", "bed_contact",
)  # fmt: skip
_BODY = (
    "num_modules", "num_hinges", "length", "limbs", "branching", "proportion", "symmetry",
    "height_base_ratio",
)  # fmt: skip
FIGURES: dict[str, str] = {
    "water_speed_bl_s": "water speed (body lengths/s)",
    **{name: f"{MEASURES[name].words} ({MEASURES[name].unit})" for name in _GAIT[1:]},
    **{name: f"{name.removeprefix('num_').replace('_', ' ')} ({UNITS[name]})" for name in _BODY},
}
"""What is compared, and what it is called, with its unit."""
_WHOSE = {"champion": "champions", "population": "final populations"}


class Compared(NamedTuple):
    """A figure in all environments.

    Attributes:
        name: of the figure.
        values: of the seeds, by environment.
        p: of Kruskal's and Wallis's test, corrected over all figures of a table (see `_TESTS`).
        comparison: the tests.
    """

    name: str
    values: Mapping[str, Sequence[float]]
    p: float
    comparison: Comparison

    @property
    def differs(self) -> list[tuple[str, str]]:
        """Environments that differ, the larger mean first."""
        if self.p >= ALPHA:
            return []
        mean = {name: interval(values).mean for name, values in self.values.items()}
        pairs = [pair for pair, p in self.comparison.pairs.items() if p < ALPHA]
        return [(a, b) if mean[a] >= mean[b] else (b, a) for a, b in pairs]


def compare_figures(cases: Mapping[str, Sequence[Outcome]], whose: str) -> list[Compared]:
    """Compares environments, figure by figure.

    Args:
        cases: outcomes by environment.
        whose: `champion` or `population`.

    Returns:
        The figures, in the order of the report.
    """
    tables = {
        name: {case: [getattr(o, whose)[name] for o in found] for case, found in cases.items()}
        for name in FIGURES
    }
    compared = {name: compare(values) for name, values in tables.items()}
    corrected = stats.false_discovery_control([c.p for c in compared.values()])
    return [
        Compared(name, values, p, compared[name])
        for (name, values), p in zip(tables.items(), corrected, strict=True)
    ]


def describe_differences(figures: Sequence[Compared], whose: str) -> list[str]:
    """Sentences on figures that differ significantly, and on nothing else.

    Args:
        figures: from `compare_figures`.
        whose: who they are of, in words.

    Returns:
        Lines of Markdown.
    """
    lines = []
    for figure in figures:
        mean = {name: interval(values).mean for name, values in figure.values.items()}
        for larger in mean:
            rest = [b for a, b in figure.differs if a == larger]
            if rest:
                others = ", ".join(f"`{name}` ({mean[name]:.3g})" for name in rest)
                lines.append(
                    f"- {FIGURES[figure.name]} of {whose}: larger in `{larger}` "
                    f"({mean[larger]:.3g}) than in {others}"
                )
    return lines or [f"- No figure of {whose} tells two environments apart."]


def tabulate(figures: Sequence[Compared]) -> list[dict[str, Any]]:
    """Figures by environment, and p of whether these differ at all, bold where they do."""
    rows = []
    for figure in figures:
        p = "< .001" if figure.p < 1e-3 else f"{figure.p:.3f}".removeprefix("0")
        rows.append({
            "name": FIGURES[figure.name], "p": f"**{p}**" if figure.p < ALPHA else p,
            **{name: as_numbers(interval(values)) for name, values in figure.values.items()},
        })  # fmt: skip
    return rows


def write_report(folder: Path, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Writes `environments.csv` and the pictures of `docs/environments.md`.

    Args:
        folder: where.
        outcomes: of the finished runs.

    Returns:
        The numbers of the results file.
    """
    cases = by_case(outcomes, ENVIRONMENTS)
    compared = {whose: compare_figures(cases, whose) for whose in _WHOSE}
    counts = sorted(map(len, cases.values()))
    pairs = len(cases) * (len(cases) - 1) // 2
    least = smallest_p(counts[0], counts[min(1, len(counts) - 1)], max(1, pairs))
    shown = {FIGURES[figure.name]: figure.values for figure in compared["champion"]}
    pictures = {
        "bodies": plot_bodies(cases), "figures": plot_scores(shown), "curves": plot_curves(cases)
    }  # fmt: skip
    for name, picture in pictures.items():
        write_atomic(folder / f"environments_{name}.png", figure_png(picture))
    rows = [
        {"environment": o.plan.case, "seed": o.plan.seed, "of": whose, **getattr(o, whose)}
        for o in outcomes
        for whose in _WHOSE
    ]
    write_csv(folder / "environments.csv", rows)
    return {
        "runs": describe_runs(cases, ENVIRONMENTS),
        "least_p": least,
        **{whose: tabulate(figures) for whose, figures in compared.items()},
        "differences": [
            line
            for whose, figures in compared.items()
            for line in describe_differences(figures, _WHOSE[whose])
        ],
    }


@in_style
def plot_curves(cases: Mapping[str, Sequence[Outcome]]) -> Figure:
    """The best so far of each case over evaluated individuals."""
    figure = new_figure(WIDE, 4.4)
    draw_outcomes(figure.subplots(), cases, "best score so far (body lengths/s)")
    return figure


@in_style
def plot_scores(groups: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """A panel of `draw_scores` for each title of `groups`, three beside each other."""
    figure = new_figure(WIDE, 2.1 * -(-len(groups) // 3))
    grid = panels(figure, len(groups), min(len(groups), 3))
    for axes, (title, values) in zip(grid, groups.items(), strict=True):
        draw_scores(axes, values)
        axes.set_title(title)
    return figure


def make_cases(settings: Sequence[str] = ()) -> Mapping[str, Case]:
    """The environments.

    Args:
        settings: what replaces values in all of them, `KEY.PATH=VALUE` each.

    Raises:
        InputError: one has a value of its own there, which would win in it and in no other.
    """
    for key in read_overrides(settings)[0]:
        for name, case in ENVIRONMENTS.items():
            if sets(read_overrides(case.settings)[0], key):
                share = "what all environments share"
                raise InputError(f"--set {key}", share, f"one of {name}'s own")
    return ENVIRONMENTS


def main(argv: list[str] | None = None) -> int:
    """Runs the study, and reports it."""
    what = "Bodies evolved in four environments."
    return study_main("environments", what, make_cases, write_report, argv, through_water)


if __name__ == "__main__":
    raise SystemExit(run_command(main))
