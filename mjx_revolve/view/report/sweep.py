"""The page about a sweep: scores of all cases, what few seeds can say of them, curves, a table."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from mjx_revolve.evolution.sweeps import Plan, Sweep, read_sweep
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import short_path, write_atomic
from mjx_revolve.inputs.grids import read_axes
from mjx_revolve.view.body_pictures import plot_bodies
from mjx_revolve.view.convergence import COLONY_LABEL, plot_cases
from mjx_revolve.view.outcomes import Outcome, by_case, find_outcomes, write_csv
from mjx_revolve.view.plots import label_of, letter, with_unit
from mjx_revolve.view.report.groups import setting_words
from mjx_revolve.view.report.page import default_page, make_page, sections, svg_source
from mjx_revolve.view.report.tables import format_number
from mjx_revolve.view.statistics import ALPHA, compare, difference, interval, smallest_p

TABLE = "sweep.csv"
# Pairs of more cases than this are not tested: Holm's correction would leave nothing (a choice).
_MOST_TESTED = 12
_MOST_BODIES = 100  # in the picture of bodies (a choice)

Numbered = Mapping[int, Sequence[Outcome]]
"""Outcomes by the number of their case in the sweep, which gives it letter and colour."""


class SweepReport(NamedTuple):
    """What was written about a sweep.

    Attributes:
        page: HTML that needs no other file.
        table: CSV, a row for each finished run.
        lost: a line on each run that could not be read.
    """

    page: Path
    table: Path
    lost: list[str]


def write_report(folder: str | Path, page: Path | None = None) -> SweepReport:
    """Writes the page and the table, of what is finished.

    Args:
        folder: of the sweep.
        page: where to; None: `report.html` in the folder.

    Returns:
        What was written.

    Raises:
        InputError: it is no sweep, no run is finished, or another file has the page's name.
        OSError: a file cannot be written.
    """
    folder = Path(folder)
    sweep = read_sweep(folder)
    page = page or default_page(folder)
    plans = sweep.plans(folder)
    outcomes, lost = find_outcomes(plans)
    if not outcomes:
        found = lost[0] if lost else "none"
        raise InputError(short_path(folder), "runs that are finished", found)
    text = make_report(sweep, folder, outcomes, lost, page.parent)
    write_csv(folder / TABLE, list_rows(sweep, outcomes))
    write_atomic(page, text.encode())
    return SweepReport(page, folder / TABLE, lost)


def list_rows(sweep: Sweep, outcomes: Sequence[Outcome]) -> list[dict[str, object]]:
    """Rows of the table, one for each finished run.

    Case, settings in which cases differ as they were typed, seed, generations, evaluations,
    seconds, and all figures of the champion.
    """
    varied, rows = _varied(sweep), []
    for outcome in outcomes:
        plan, metrics = outcome.plan, outcome.metrics
        typed = dict(setting.split("=", 1) for setting in plan.settings)
        rows.append(
            {"case": plan.case, **{key: typed[key] for key in varied}, "seed": plan.seed,
             "generations": int(metrics["generation"][-1]),
             "evaluations": int(metrics["evaluations"][-1]),
             "seconds": float(metrics["seconds"][-1])} | dict(outcome.champion)
        )  # fmt: skip
    return rows


def make_report(
    sweep: Sweep, folder: Path, outcomes: Sequence[Outcome], lost: Sequence[str], at: Path
) -> str:
    """Makes the page.

    Args:
        sweep: the sweep.
        folder: its folder.
        outcomes: of the finished runs, at least one.
        lost: a line on each run that could not be read.
        at: the folder that the page goes to, where links start.

    Returns:
        A complete HTML document that needs no other file.
    """
    cases = list(sweep.cases)
    plans = sweep.plans(folder)
    names = [case_words(sweep, case) for case in cases]
    named = dict(zip(cases, names, strict=True))
    settings = [(named[case], typed) for case, typed in sweep.cases.items()]
    known = by_case(outcomes, cases)
    numbered = {cases.index(case): found for case, found in known.items()}
    tasks = dict.fromkeys(found[0].task for found in numbered.values())
    content: list[tuple[str, str, str]] = []
    apart = ("task.type", "task.unit")  # each has tables of its own
    unequal = [k for k in _varied(sweep) if k.startswith("task.") and k not in apart]
    for n, task in enumerate(tasks):
        members = {k: found for k, found in numbered.items() if found[0].task == task}
        of = f": {task.replace('_', ' ')}" if len(tasks) > 1 else ""
        content += [
            (f"scores-{n}", f"Scores{of}", _scores(members, names, unequal)),
            (f"tests-{n}", f"Tests{of}", _tests(members, names)),
            (f"measures-{n}", f"Measures{of}", _measures(members)),
        ]
    content += [
        ("bodies", "Bodies", _bodies(numbered)),
        ("runs", "Runs", _runs(plans, outcomes, lost, named, folder.resolve() == at.resolve())),
        ("repeat", "Repeat it", sections.sweep_repeat(_command(sweep, folder), settings)),
    ]
    lead = sections.headline([
        (f"{len(outcomes)} of {len(plans)}", "runs finished"),
        (str(len(cases)), "cases" if len(cases) > 1 else "case"),
        (str(sweep.seeds), "seeds of each"),
    ])  # fmt: skip
    lead += sections.problems([], lost, True)
    title = f"Sweep of {Path(sweep.config).stem}"
    return make_page(title, short_path(folder), lead, content)


def _varied(sweep: Sweep) -> list[str]:
    """Keys of the settings in which cases differ."""
    return [axis.key for axis in read_axes(sweep.settings) if len(axis.texts) > 1]


def case_words(sweep: Sweep, case: str) -> str:
    """The settings that set a case apart, in words; its folder's name is no text to read."""
    varied = _varied(sweep)
    typed = (setting.split("=", 1) for setting in sweep.cases[case])
    words = [(key, text.strip("[]{}\"' ").replace(",", ", ")) for key, text in typed]
    return "; ".join(setting_words(*pair) for pair in words if pair[0] in varied) or case


def _command(sweep: Sweep, folder: Path) -> str:
    words = ["python", "-m", "mjx_revolve.sweep", sweep.config, "--seeds", str(sweep.seeds)]
    words += ["--out", short_path(folder)]
    words += ["--first-seed", str(sweep.first_seed)] if sweep.first_seed else []
    for setting in sweep.settings:
        words += ["--set", setting]
    return shlex.join(words)


def _values(outcomes: Sequence[Outcome], name: str) -> list[float]:
    return [o.champion.get(name, math.nan) for o in outcomes]


def _range(outcomes: Sequence[Outcome], name: str) -> str:
    """The last value of a metric; its least and most where seeds differ in it."""
    values = [o.metrics[name][-1] for o in outcomes]
    ends = dict.fromkeys(f"{value:,.0f}" for value in (min(values), max(values)))
    return " to ".join(ends)


# --- scores ---------------------------------------------------------------------------------------


def _scores(members: Numbered, cases: Sequence[str], unequal: Sequence[str]) -> str:
    """Means and intervals of the champions' scores, a dot for each seed, and the way there."""
    first = next(iter(members.values()))[0]
    unit = first.unit
    header = ["", "case", "n\nseeds", f"mean score\n{unit}", f"best seed\n{unit}"]
    header += ["evaluations\neach", "time of generations\ns each"]
    scores = {k: _values(found, "score") for k, found in members.items()}
    rows = [
        [
            k, cases[k], len(found), str(interval(scores[k])), format_number(np.max(scores[k])),
            _range(found, "evaluations"),
            f"{np.mean([o.metrics['seconds'][-1] for o in found]):.0f}",
        ]
        for k, found in members.items()
    ]  # fmt: skip
    # A colony's fitness is not that of other runs, though their champions have one task.
    curves = {k: [(o.metrics["evaluations"], o.metrics["champion"]) for o in found]
              for k, found in members.items() if found[0].colony == first.colony}  # fmt: skip
    best = f"best {COLONY_LABEL}" if first.colony else with_unit("best score so far", unit)
    figure = plot_cases(dict(enumerate(cases)), curves, scores, "evaluations", best, unit)
    failed = [cases[k] for k, found in members.items() if any(o.failed for o in found)]
    return sections.sweep_scores(header, rows, svg_source(figure), unequal, failed)


def _tests(members: Numbered, cases: Sequence[str]) -> str:
    """Whether cases differ, and which."""
    if len(members) < 2:
        return ""
    scores = {letter(k): _values(found, "score") for k, found in members.items()}
    names = {letter(k): cases[k] for k in members}
    counts = sorted(n for x in scores.values() if (n := len(x)) > 1)
    said = ""  # of what is tested: nothing
    if len(counts) > 1:
        whole = len(counts) == len(scores)
        seeds = f"{counts[0]}" if counts[0] == counts[-1] else f"{counts[0]} to {counts[-1]}"
        said = f"{'all cases' if whole else 'the cases with two seeds or more'}, {seeds}"
    found = compare(scores, pairs=len(members) <= _MOST_TESTED)
    rows = [
        [
            f"{a} − {b}", names[a], names[b], str(difference(scores[a], scores[b])),
            f"{len(scores[a])} + {len(scores[b])}",
            _p(p) if min(len(scores[a]), len(scores[b])) > 1 else "not tested",
        ]
        for (a, b), p in found.pairs.items()
    ]  # fmt: skip
    pairs = len(counts) * (len(counts) - 1) // 2
    least = smallest_p(counts[-1], counts[-2], pairs) if rows and said else 1.0
    return sections.sweep_tests(_p(found.p), said, rows, f"{least:.2g}", ALPHA, _MOST_TESTED)


def _p(value: float) -> str:
    """A p value to three decimals."""
    return "< 0.001" if value < 1e-3 else f"{value:.3f}"


def _measures(members: Numbered) -> str:
    """Means and intervals of all measures of champions."""
    everything = [o for found in members.values() for o in found]
    bodies = {name for o in everything if o.body is not None for name in o.body.descriptors}
    known = [o for o in everything if o.body is not None]
    fixed = {name for name in bodies if len({o.champion[name] for o in known}) == 1}
    names = dict.fromkeys(name for o in everything for name in o.champion)
    rows = [
        [label_of(name), *(str(interval(_values(found, name))) for found in members.values())]
        for name in names if name != "score" and name not in fixed
    ]  # fmt: skip
    return sections.sweep_measures(["", *map(letter, members)], rows) if rows else ""


def _bodies(numbered: Numbered) -> str:
    """The champions' bodies, where they evolve and are not too many."""
    evolved = {k: found for k, found in numbered.items() if found[0].evolved}
    if not evolved or sum(map(len, evolved.values())) > _MOST_BODIES:
        return ""
    figure = plot_bodies({letter(k): found for k, found in evolved.items()}, [*evolved])
    return sections.sweep_bodies(svg_source(figure))


# --- runs -----------------------------------------------------------------------------------------


def _runs(
    plans: Sequence[Plan],
    outcomes: Sequence[Outcome],
    lost: Sequence[str],
    cases: Mapping[str, str],
    near: bool,
) -> str:
    """A line for each run, with a link to its folder where the page is near: beside the cases."""
    found = {o.plan: o for o in outcomes}
    rows: list[list[str | int]] = []
    for plan in plans:
        outcome, link = found.get(plan), plan.folder.name
        if near and plan.folder.is_dir():
            address = f"{plan.case}/{plan.folder.name}/"
            link = Markup('<a href="{}">{}</a>').format(address, link)
        figures = ["–", "–", "–", _state(plan, lost)]
        if outcome is not None:
            figures = [f"{outcome.metrics['generation'][-1]:.0f}",
                       format_number(outcome.champion["score"]),
                       f"{outcome.metrics['seconds'][-1]:.0f}", _finished(outcome)]  # fmt: skip
        rows.append([[*cases].index(plan.case), cases[plan.case], link, *figures])
    return sections.sweep_runs(rows)


def _finished(outcome: Outcome) -> str:
    """Of a run that has one."""
    count = outcome.failed
    return f"finished; {count} of its champion's fresh starts failed" if count else "finished"


def _state(plan: Plan, lost: Sequence[str]) -> str:
    """Of a run that has no outcome."""
    if any(line.startswith(f"{short_path(plan.folder)}: ") for line in lost):
        return "damaged"
    return "not finished" if plan.folder.is_dir() else "not begun"
