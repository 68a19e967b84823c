"""Numbers and tables of a report, as plain values: headers, and rows of cells."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjx_revolve.body.descriptors import UNITS
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.episodes.scoring import REPORT_EPISODES
from mjx_revolve.view.colony_curves import death_looks
from mjx_revolve.view.colony_history import History
from mjx_revolve.view.plots import LABELS
from mjx_revolve.view.report.champion import Replay
from mjx_revolve.view.report.groups import (
    Group,
    differences,
    format_interval,
    mean_difference,
    mean_interval,
)
from mjx_revolve.view.report.record import RunRecord, number

_NONE = "–"


def format_number(value: float | None, digits: int = 3) -> str:
    """A number to so many digits, with a true minus; `–` where there is none."""
    if value is None or not np.isfinite(value):
        return _NONE
    return f"{value:.{digits}g}".replace("-", "−")


def _measure(record: RunRecord, name: str) -> float | None:
    measures = record.champion.get("measures")
    return number(measures.get(name)) if isinstance(measures, Mapping) else None


def _score(record: RunRecord) -> str:
    score, std = (number(record.champion.get(key)) for key in ("score", "score_std"))
    if score is None or not record.is_finished:
        return _NONE
    return format_number(score) + ("" if std is None else f" ± {format_number(std, 2)}")


def _known_measures(records: Sequence[RunRecord]) -> list[str]:
    """Measures for tables of several runs, as far as any of them has them."""
    names = dict.fromkeys(
        name for record in records for name in
        ("depth_error_m" if record.task == "hold_depth" else "speed_m_s", "cost_of_transport")
    )  # fmt: skip
    return [n for n in names if any(_measure(record, n) is not None for record in records)]


def _label(name: str) -> str:
    return LABELS.get(name, name.replace("_", " "))


def _column(name: str) -> str:
    """`speed (m/s)` as a header of two lines."""
    words, _, unit = _label(name).partition(" (")
    return f"{words}\n{unit.rstrip(')')}"


def headline(groups: Sequence[Group]) -> list[tuple[str, str]]:
    """The numbers that matter most, each before what it is; several groups have a table instead."""
    if len(groups) != 1:
        return []
    (group,) = groups
    pairs: list[tuple[str, str]] = []
    unit = f" ({group.unit})" if group.unit else ""
    if len(group.records) > 1:
        scores = group.scores()
        if scores:
            mean = format_interval(mean_interval(scores))
            pairs.append((mean, f"mean score{unit}, 95 % interval"))
            pairs.append((format_number(max(scores)), f"best score{unit}"))
        pairs.append((str(len(group.records)), "seeds"))
    else:
        (record,) = group.records
        if record.is_finished:
            starts = f"mean ± standard deviation over {REPORT_EPISODES} fresh starts"
            pairs.append((_score(record), f"score{unit}, {starts}"))
        elif "champion" in record.metrics:
            best = format_number(float(record.metrics["champion"][-1]))
            own = unit if record.history is None else ", fitness in the colony"
            pairs.append((best, f"best so far{own}"))
        known = [name for name in ("speed_m_s", "cost_of_transport") if _measure(record, name)]
        pairs += [(format_number(_measure(record, name)), _label(name)) for name in known]
        pairs.append((str(record.generations), f"{record.round}s"))
        pairs.append(("1", "seed"))
    for name, words, scale in (
        ("evaluations", _counted(group), 1), ("seconds", "minutes of evolution", 60)
    ):  # fmt: skip
        totals = [r.metrics[name][-1] / scale for r in group.shown if name in r.metrics]
        if totals:
            pairs.append((f"{sum(totals):,.{0 if sum(totals) >= 10 else 1}f}", words))
    return pairs


def _counted(group: Group) -> str:
    """What the evaluations of a group's runs are."""
    colonies = all(record.history is not None for record in group.records)
    return "robots lived" if colonies else "evaluated individuals"


def colony_table(history: History) -> list[tuple[str, str]]:
    """What became of a colony in numbers: rows of words and a value."""
    births, deaths = history.of_kind("birth"), history.of_kind("death")
    strangers = sum(not event.parents for event in births)
    ages = [span.age for span in history.spans.values() if span.cause]
    now = int(history.count_living(np.array([history.end]))[0])
    causes = Counter(event.cause for event in deaths)
    died = {words: causes[name] for name, (_, words) in death_looks(causes).items()}
    alive = {s.founder for s in history.spans.values() if not s.cause}
    rows = [
        ("time that it has lived", f"{history.end:,.0f} s"),
        ("born", f"{len(births)}, {strangers} of them without parents"),
        ("matings", str(len(history.of_kind("mating")))),
        ("dead", ", ".join([str(len(deaths)), *(f"{n} {words}" for words, n in died.items())])),
        ("alive in the end", f"{now}, of {len(alive)} families"),
    ]
    if ages:
        rows.append(("age of the dead, median", f"{format_number(float(np.median(ages)))} s"))
    return rows


def task_tables(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """Final scores of all configurations.

    Args:
        groups: all groups.

    Returns:
        For each task the `header` and `rows` of a table, each row's first cell being the group's
        number; `compare`: whether it has several groups; `unequal`: settings of the task in which
        they differ; `lone`: names of groups with a single seed.
    """
    return [
        _task_table([(k, group) for k, group in enumerate(groups) if group.task == task])
        for task in dict.fromkeys(group.task for group in groups)
    ]


def _task_table(members: Sequence[tuple[int, Group]]) -> dict[str, Any]:
    groups = [group for _, group in members]
    unit, compare = groups[0].unit, len(groups) > 1
    reached = min((group.common_generations for group in groups if group.shown), default=0)
    known = _known_measures([record for group in groups for record in group.records])
    header = ["", "configuration", "n\nseeds", f"score\n{unit}", f"best seed\n{unit}"]
    header += [f"less the first\n{unit}"] if compare else []
    header += [f"after {reached} gen.\nbest so far", *map(_column, known)]
    rows = []
    for index, group in members:
        scores = group.scores()
        row: list[object] = [index, group.name, len(scores)]
        row += [format_interval(mean_interval(scores)), format_number(max(scores, default=None))]
        if compare:
            less = mean_difference(scores, groups[0].scores())
            row.append(_NONE if group is groups[0] else format_interval(less))
        row.append(format_interval(mean_interval(group.best_after(reached))))
        for name in known:
            values = [_measure(r, name) for r in group.records if r.is_finished]
            row.append(format_interval(mean_interval([v for v in values if v is not None])))
        rows.append(row)
    unequal = [key for key in differences(groups) if key.startswith("task.")]
    lone = [group.name for group in groups if len(group.scores()) == 1]
    return {"header": header, "rows": rows, "compare": compare, "unequal": unequal, "lone": lone}


def different_settings(groups: Sequence[Group]) -> list[list[Any]]:
    """Rows of what the groups differ in: the setting, and its value in each group."""
    if not all(group.settings for group in groups):
        return []
    found = differences(groups).items()
    return [[key, *(_NONE if value is None else value for value in row)] for key, row in found]


def runs_table(groups: Sequence[Group]) -> tuple[list[str], list[list[Any]]]:
    """Header and rows, one for each run; its first cell is the number of its group."""
    records = [(k, r) for k, group in enumerate(groups) for r in (*group.records, *group.copies)]
    known = _known_measures([record for _, record in records])
    units = {record.unit for _, record in records}
    unit = units.pop() if len(units) == 1 else ""
    header = ["", "run", "seed", "generations", f"score\n{unit}", *map(_column, known)]
    header += ["minutes", "champion", "state"]
    rows = []
    for k, record in records:
        seconds = record.metrics["seconds"][-1] if "seconds" in record.metrics else None
        planned = record.setting("evolution.generations")
        short = isinstance(planned, int) and planned != record.generations
        rows.append([
            k, record.label, _NONE if record.seed is None else record.seed,
            f"{record.generations} of {planned}" if short else record.generations, _score(record),
            *(format_number(_measure(record, name)) for name in known),
            _NONE if seconds is None else f"{seconds / 60:.1f}",
            str(record.stand_in or record.champion.get("origin", _NONE))[:60],
            record.state or "whole",
        ])  # fmt: skip
    return header, rows


def measures_table(record: RunRecord, replay: Replay) -> list[tuple[str, str, str]]:
    """Rows of a champion's score and measures: in its episode, and over all fresh starts."""
    unit = f" ({record.unit})" if record.unit else ""
    return [(f"score{unit}", format_number(replay.score), _score(record))] + [
        (_label(name), format_number(replay.measures[name]), format_number(_measure(record, name)))
        for name in LABELS
        if name in replay.measures
    ]


def count_modules(morphology: Morphology) -> tuple[list[list[Any]], list[Any]]:
    """The modules of a robot by type.

    Args:
        morphology: the robot.

    Returns:
        Rows, and a last one for all: type, count, mass of one and of all [g], displaced volume of
        one and of all [cm³], boxes [mm].
    """
    kinds = Counter(
        (m.kind.name, m.kind.mass, m.kind.volume, tuple(
            (part.name, part.boxes[0].size) for part in m.kind.parts
        ))
        for m in morphology.modules
    )  # fmt: skip
    rows = []
    for (name, mass, volume, parts), count in kinds.items():
        sizes = [(part, " × ".join(f"{1e3 * edge:.3g}" for edge in size)) for part, size in parts]
        boxes = sizes[0][1] if len(sizes) == 1 else "; ".join(f"{p} {s}" for p, s in sizes)
        rows.append([
            name, count, f"{1e3 * mass:.4g}", f"{1e3 * mass * count:.4g}", f"{1e6 * volume:.4g}",
            f"{1e6 * volume * count:.4g}", boxes,
        ])  # fmt: skip
    extent = " × ".join(f"{1e3 * x:.4g}" for x in morphology.extent)
    foot = ["all", morphology.num_modules, "", f"{1e3 * morphology.mass:.4g}", "",
            f"{1e6 * morphology.volume:.4g}", extent]  # fmt: skip
    return rows, foot


def list_descriptors(morphology: Morphology) -> list[list[str]]:
    """Rows of a robot's descriptors: name, value, unit."""
    return [
        [name.replace("_", " "), format_number(value, 4), UNITS[name].replace("-", _NONE)]
        for name, value in morphology.descriptors.items()
    ]


def list_modules(morphology: Morphology) -> list[list[Any]]:
    """Rows of a robot's modules.

    Number, name, type, what it hangs on, slot and turn there [deg], place at rest in the core's
    frame [m], mass [g], displaced volume [cm³].
    """
    return [
        [k, m.name, m.type, *((m.parent, m.slot, f"{m.orientation:g}") if m.parent >= 0 else "–––"),
         *(f"{x:.5f}".replace("-", "−") for x in (round(float(x), 5) + 0.0 for x in m.position)),
         f"{1e3 * m.kind.mass:.4g}", f"{1e6 * m.kind.volume:.4g}"]
        for k, m in enumerate(morphology.modules)
    ]  # fmt: skip
