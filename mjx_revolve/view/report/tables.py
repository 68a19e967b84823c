"""Numbers and tables of a report, as plain values: headers, and rows of cells."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mjx_revolve.body.descriptors import UNITS
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.episodes.scoring import REPORT_EPISODES
from mjx_revolve.view.colony_history import ColonyHistory
from mjx_revolve.view.colony_pictures import cause_styles
from mjx_revolve.view.plots import LABELS, NO_VALUE, format_number, label_of, with_unit
from mjx_revolve.view.report.champion import ChampionReplay
from mjx_revolve.view.report.groups import RunGroup, differences
from mjx_revolve.view.report.record import RunRecord, number
from mjx_revolve.view.statistics import difference, interval

# Stands behind the number of a champion that fails its passport.
_FAILS = "✗"
Cell = str | int
"""Of a table."""


def _measure(record: RunRecord, name: str) -> float | None:
    measures = record.champion.get("measures")
    return number(measures.get(name)) if isinstance(measures, Mapping) else None


def _score(record: RunRecord) -> str:
    score, std = (number(record.champion.get(key)) for key in ("score", "score_std"))
    if score is None or not record.is_finished:
        return NO_VALUE
    failed = record.passport is not None and record.passport.failed
    spread = "" if std is None else f" ± {format_number(std, 2)}"
    return format_number(score) + spread + (f" {_FAILS}" if failed else "")


def _known_measures(records: Iterable[RunRecord]) -> list[str]:
    """Measures for tables of several runs, as far as any of them has them."""
    names = {name: None for record in records for name in (record.measure, "cost_of_transport")
             if _measure(record, name) is not None}  # fmt: skip
    return sorted(names, key=lambda name: name == "cost_of_transport")


def _column(name: str) -> str:
    """`speed (m/s)` as a header of two lines."""
    words, _, unit = label_of(name).partition(" (")
    return f"{words}\n{unit.rstrip(')')}"


def headline(groups: Sequence[RunGroup]) -> list[tuple[str, str]]:
    """The most important numbers and their names; of several groups none: they have a table."""
    if len(groups) != 1:
        return []
    (group,) = groups
    unit = f" ({group.unit})" if group.unit else ""
    pairs = _of_seeds(group, unit) if len(group.records) > 1 else _of_run(group.records[0], unit)
    colonies = all(record.history is not None for record in group.records)
    counted = "robots lived" if colonies else "evaluations"
    for name, words, scale in (
        ("evaluations", counted, 1), ("seconds", "minutes of evolution", 60)
    ):  # fmt: skip
        totals = [r.metrics[name][-1] / scale for r in group.shown if name in r.metrics]
        if totals:
            pairs.append((f"{sum(totals):,.{0 if sum(totals) >= 10 else 1}f}", words))
    return pairs


def _of_seeds(group: RunGroup, unit: str) -> list[tuple[str, str]]:
    pairs = []
    if scores := group.scores():
        pairs = [(str(interval(scores)), f"mean score{unit}, 95 % interval"),
                 (format_number(max(scores)), f"best score{unit}")]  # fmt: skip
    count = str(len(group.records))
    done = count if len(scores) == len(group.records) else f"{len(scores)} of {count}"
    return [*pairs, (done, "seeds" if done == count else "seeds are finished")]


def _of_run(record: RunRecord, unit: str) -> list[tuple[str, str]]:
    pairs = []
    if record.is_finished:
        starts = f"mean ± standard deviation over {REPORT_EPISODES} fresh starts"
        starts += f", each of {record.trials} episodes" if record.trials > 1 else ""
        mark = record.passport.mark if record.passport is not None else ""
        starts += f"; {_FAILS} {mark}" if mark else ""
        pairs.append((_score(record), f"score{unit}, {starts}"))
    elif "champion" in record.metrics:
        own = unit if record.history is None else ", fitness in the colony"
        pairs.append((format_number(record.metrics["champion"][-1]), f"best so far{own}"))
    for name in (record.measure, "cost_of_transport"):
        if (value := _measure(record, name)) is not None:
            pairs.append((format_number(value), label_of(name)))
    return [*pairs, (str(record.generations), f"{record.round}s"), ("1", "seed")]


def colony_table(history: ColonyHistory) -> list[tuple[str, str]]:
    """A colony in numbers: rows of words and a value."""
    births, deaths = history.of_kind("birth"), history.of_kind("death")
    causes = Counter(event.cause for event in deaths)
    died = [f"{causes[name]} {words}" for name, (_, words) in cause_styles(causes).items()]
    alive = [span.founder for span in history.spans.values() if not span.cause]
    ages = [span.age for span in history.spans.values() if span.cause]
    founders = sum(not event.parents for event in births)
    rows = [
        ("time that it has lived", f"{history.end:,.0f} s"),
        ("born", f"{len(births)}, {founders} of them without parents"),
        ("matings", str(len(history.of_kind("mating")))),
        ("dead", ", ".join([str(len(deaths)), *died])),
        ("alive in the end", f"{len(alive)}, of {len(set(alive))} families"),
    ]
    if ages:
        rows.append(("age of the dead, median", f"{format_number(float(np.median(ages)))} s"))
    return rows


class TaskTable(NamedTuple):
    """Final scores of the configurations of one task.

    Attributes:
        header: of the columns.
        rows: the first cell is the group's number.
        unequal: settings of the task in which the groups differ.
        lone: names of groups with a single seed.
    """

    header: list[str]
    rows: list[list[Cell]]
    unequal: list[str]
    lone: list[str]


def task_tables(groups: Sequence[RunGroup]) -> list[TaskTable]:
    """Final scores of all configurations, a table for each task."""
    return [
        _task_table([(k, group) for k, group in enumerate(groups) if group.task == task])
        for task in dict.fromkeys(group.task for group in groups)
    ]


def _task_table(members: Sequence[tuple[int, RunGroup]]) -> TaskTable:
    groups = [group for _, group in members]
    unit, first = groups[0].unit, groups[0]
    alike = [group for group in groups if group.records[0].fitness == first.records[0].fitness]
    reached = min((group.common_generations for group in alike if group.shown), default=0)
    known = _known_measures(record for group in groups for record in group.records)
    header = ["", "configuration", "n\nseeds", f"score\n{unit}", f"best seed\n{unit}"]
    header += [f"less the first\n{unit}"] * (len(groups) > 1)
    rounds = {"generation": "gen."}.get(first.records[0].round, f"{first.records[0].round}s")
    header += [f"after {reached} {rounds}\nbest so far", *map(_column, known)]
    rows: list[list[Cell]] = []
    for index, group in members:
        scores = group.scores()
        less = NO_VALUE if group is first else str(difference(scores, first.scores()))
        measures = [[_measure(r, name) for r in group.records if r.is_finished] for name in known]
        rows.append([
            index, group.name, len(scores), str(interval(scores)),
            format_number(max(scores, default=None)), *[less] * (len(groups) > 1),
            str(interval(group.best_after(reached))) if group in alike else NO_VALUE,
            *(str(interval([v for v in values if v is not None])) for values in measures),
        ])  # fmt: skip
    unequal = [key for key in differences(groups) if key.startswith("task.")]
    return TaskTable(header, rows, unequal, [g.name for g in groups if len(g.scores()) == 1])


def different_settings(groups: Sequence[RunGroup]) -> list[list[object]]:
    """Rows of settings in which the groups differ: the setting, and its value in each group."""
    if not all(group.settings for group in groups):
        return []
    found = differences(groups).items()
    return [[key, *(NO_VALUE if value is None else value for value in row)] for key, row in found]


def runs_table(groups: Sequence[RunGroup]) -> tuple[list[str], list[list[Cell]]]:
    """Header and rows, one for each run; its first cell is the number of its group."""
    records = [(k, r) for k, group in enumerate(groups) for r in (*group.records, *group.copies)]
    known = _known_measures(record for _, record in records)
    units = {record.unit for _, record in records}
    unit = units.pop() if len(units) == 1 else ""
    header = ["", "run", "seed", "generations", f"score\n{unit}", *map(_column, known)]
    header += ["minutes", "champion", "state"]
    rows: list[list[Cell]] = []
    for k, record in records:
        seconds = record.metrics["seconds"][-1] if "seconds" in record.metrics else None
        planned = record.setting("evolution.generations")
        short = isinstance(planned, int) and planned != record.generations
        rows.append([
            k, record.label, NO_VALUE if record.seed is None else record.seed,
            f"{record.generations} of {planned}" if short else record.generations, _score(record),
            *(format_number(_measure(record, name)) for name in known),
            NO_VALUE if seconds is None else f"{seconds / 60:.1f}",
            str(record.champion.get("origin", NO_VALUE))[:60],
            record.state or "whole",
        ])  # fmt: skip
    return header, rows


def measures_table(record: RunRecord, replay: ChampionReplay) -> list[tuple[str, str, str]]:
    """Rows of a champion's score and measures: in its episode, and over all fresh starts."""
    name = with_unit("score", record.unit)
    return [(name, format_number(replay.score), _score(record))] + [
        (label_of(n), format_number(replay.measures[n]), format_number(_measure(record, n)))
        for n in LABELS if n in replay.measures
    ]  # fmt: skip


def count_modules(morphology: Morphology) -> tuple[list[list[Cell]], list[Cell]]:
    """The modules of a robot by type.

    Returns:
        Rows, and a last one for all: type, count, mass of one and of all [g], displaced volume of
        one and of all [cm³], boxes [mm].
    """
    kinds = Counter(
        (m.kind.name, m.kind.mass, m.kind.volume,
         tuple((part.name, " and ".join(_edges(box.size) for box in part.boxes))
               for part in m.kind.parts))
        for m in morphology.modules
    )  # fmt: skip
    rows: list[list[Cell]] = []
    for (name, mass, volume, parts), count in kinds.items():
        boxes = parts[0][1] if len(parts) == 1 else "; ".join(f"{p} {size}" for p, size in parts)
        rows.append([
            name, count, f"{1e3 * mass:.4g}", f"{1e3 * mass * count:.4g}", f"{1e6 * volume:.4g}",
            f"{1e6 * volume * count:.4g}", boxes,
        ])  # fmt: skip
    return rows, [
        "all", morphology.num_modules, "", f"{1e3 * morphology.mass:.4g}", "",
        f"{1e6 * morphology.volume:.4g}", _edges(morphology.extent, 4),
    ]  # fmt: skip


def _edges(size: Iterable[float], digits: int = 3) -> str:
    """Edges of a box [m] as `41 × 41 × 35.5` [mm]."""
    return " × ".join(f"{1e3 * edge:.{digits}g}" for edge in size)


def list_descriptors(morphology: Morphology) -> list[list[str]]:
    """Rows of a robot's descriptors: name, value, unit."""
    return [
        [name.replace("_", " "), format_number(value, 4), UNITS[name].replace("-", NO_VALUE)]
        for name, value in morphology.descriptors.items()
    ]


def list_modules(morphology: Morphology) -> list[list[Cell]]:
    """Rows of a robot's modules.

    Number, name, type, parent, slot and turn there [deg], position at rest in the core's frame [m],
    mass [g], displaced volume [cm³].
    """
    return [
        [k, m.name, m.type, *((m.parent, m.slot, f"{m.orientation:g}") if m.parent >= 0 else "–––"),
         *(f"{x:.5f}".replace("-", "−") for x in (round(float(x), 5) + 0.0 for x in m.position)),
         f"{1e3 * m.kind.mass:.4g}", f"{1e6 * m.kind.volume:.4g}"]
        for k, m in enumerate(morphology.modules)
    ]  # fmt: skip
