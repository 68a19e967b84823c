"""Runs of one configuration with different seeds belong together: groups, and their statistics."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from mjx_revolve.evolution.fingerprints import hash_text
from mjx_revolve.inputs.own_code import content_name, parse_own
from mjx_revolve.view.report.record import RunRecord, number

# Settings that do not make it another configuration: they only say how it is kept.
_KEEPING = ("checkpoint_every", "keep_checkpoints", "tensorboard")
# What groups are named by where it tells them apart, the most telling first; then all others.
_TELLING = (
    "morphology", "task.type", "world.name", "controller.type", "evolution.strategy",
    "evolution.population_size", "evolution.generations",
)  # fmt: skip
LEVEL = 0.95  # of all confidence intervals
_LABEL = 56  # longest name of a group in a legend [characters]


class Interval(NamedTuple):
    """A mean over seeds and how sure it is.

    Attributes:
        mean: of the finite values; NaN without any.
        half: half width of its confidence interval; NaN below two values.
        count: how many values.
    """

    mean: Any
    half: Any
    count: Any


def mean_interval(values: Any) -> Interval:
    """Mean over the first axis and its confidence interval.

    The interval is Student's: ± t(0.975, n - 1) s / √n, with s the standard deviation with n - 1.
    It takes the seeds' values as draws from a normal distribution, which few seeds cannot test.

    Args:
        values: `[n]` or `[n, T]`, a row for each seed; what is not finite does not count.

    Returns:
        Numbers, or `[T]` each.
    """
    x = np.asarray(values, float)
    x = np.where(np.isfinite(x), x, np.nan)
    count = np.isfinite(x).sum(axis=0)
    with warnings.catch_warnings():  # of columns with too few values: NaN is the answer
        warnings.simplefilter("ignore")
        mean, error = np.nanmean(x, axis=0), stats.sem(x, axis=0, nan_policy="omit")
        half = np.asarray(stats.t.ppf(0.5 + LEVEL / 2, count - 1) * error)
    return Interval(mean[()], half[()], count[()])


def mean_difference(values: Any, others: Any) -> Interval:
    """Difference of two means and its confidence interval, without assuming equal spreads.

    Welch (1947), Biometrika 34: degrees of freedom after Satterthwaite.

    Args:
        values: `[n]`, a value for each seed.
        others: `[m]`, to be subtracted.

    Returns:
        The difference; `half` is NaN where a side has fewer than two values.
    """
    a, b = (np.asarray(x, float)[np.isfinite(x)] for x in (values, others))
    count = min(len(a), len(b))
    if not count:
        return Interval(np.nan, np.nan, 0)
    difference = float(a.mean() - b.mean())
    if count > 1 and not np.ptp(a) and not np.ptp(b):
        return Interval(difference, 0.0, count)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        welch = stats.ttest_ind(a, b, equal_var=False).confidence_interval(LEVEL)
    return Interval(difference, float(welch.high - welch.low) / 2, count)


def quantiles(values: np.ndarray, shares: Sequence[float]) -> np.ndarray:
    """Quantiles `[q, T]` of values `[n, T]` over the seeds; NaN where there is no finite value."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.nanquantile(np.where(np.isfinite(values), values, np.nan), shares, axis=0)


def format_interval(interval: Interval) -> str:
    """`0.1537 ± 0.0042`: the mean to the digits that its interval bears; `–` without a value."""
    if interval.count == 0 or not np.isfinite(interval.mean):
        return "–"
    if not interval.half > 1e-9 * abs(interval.mean):  # one value, or all of them the same
        text = f"{interval.mean:.3g}"
    elif (places := 1 - int(np.floor(np.log10(interval.half)))) > 8:
        text = f"{interval.mean:.3g} ± {interval.half:.1g}"
    else:
        places = max(places, 0)
        text = f"{interval.mean:.{places}f} ± {interval.half:.{places}f}"
    return text.replace("-", "−")


@dataclass(frozen=True, eq=False)
class Group:
    """Runs that differ in their seed only.

    Attributes:
        name: what legends call it.
        records: one run for each seed.
        copies: runs that repeat a seed; they are no further evidence and do not count.
        settings: all its settings by dotted name, without the seed.
    """

    name: str
    records: tuple[RunRecord, ...]
    copies: tuple[RunRecord, ...]
    settings: Mapping[str, Any]

    @property
    def task(self) -> str:
        """The task's type."""
        return self.records[0].task

    @property
    def unit(self) -> str:
        """Of its scores."""
        return self.records[0].unit

    @property
    def shown(self) -> tuple[RunRecord, ...]:
        """The runs that have a curve."""
        return tuple(record for record in self.records if record.metrics)

    @property
    def common_generations(self) -> int:
        """The last generation that every run of the group has reached."""
        return min((record.generations for record in self.shown), default=0)

    def curve(self, column: str, over: str = "generation") -> tuple[np.ndarray, np.ndarray]:
        """A column of all runs, as far as all of them reach.

        Args:
            column: of the metrics; NaN in a run that lacks it.
            over: the column for the horizontal axis; the first run's counts.

        Returns:
            `[T]` abscissae and `[n, T]` values, a row for each run.
        """
        if not self.shown:
            return np.zeros(0), np.zeros((0, 0))
        steps = self.shown[0].metrics["generation"]
        for record in self.shown[1:]:
            steps = np.intersect1d(steps, record.metrics["generation"])
        steps = steps[steps <= self.common_generations]
        first = self.shown[0].metrics
        x = first[over][np.isin(first["generation"], steps)]
        return x, np.array([
            record.metrics[column][np.isin(record.metrics["generation"], steps)]
            if column in record.metrics else np.full(len(steps), np.nan)
            for record in self.shown
        ])  # fmt: skip

    def scores(self) -> list[float]:
        """Scores of the champions that were judged on fresh starts."""
        found = [number(r.champion.get("score")) for r in self.records if r.is_finished]
        return [score for score in found if score is not None]

    def best_after(self, generations: int) -> list[float]:
        """The best so far that each run had after so many generations, if it has got there."""
        early = [
            r.metrics["champion"][r.metrics["generation"] <= generations]
            for r in self.shown if "champion" in r.metrics
        ]  # fmt: skip
        return [float(values[-1]) for values in early if len(values)]

    def best(self) -> RunRecord:
        """The run with the best champion: judged ones first, else by the best so far."""

        def rank(record: RunRecord) -> tuple[bool, bool, float]:
            score = number(record.champion.get("score"))
            if score is None and "champion" in record.metrics:
                score = number(float(record.metrics["champion"][-1]))
            known = -np.inf if score is None else score
            return record.genes is not None, record.is_finished, known

        return max(self.records, key=rank)


def _flatten(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping) and value:
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _settings(record: RunRecord) -> dict[str, Any]:
    """All that makes a configuration, files by what they hold rather than where they are."""
    data = dict(record.settings if record.config is None else record.config.model_dump())
    if isinstance(data.get("world"), str):
        data["world"] = {"name": data["world"]}
    flat = _flatten(data)
    for key in ("seed", *_KEEPING):
        flat.pop(f"evolution.{key}", None)
    for key in ("morphology", "modules", "world.name"):
        value = flat.get(key)
        if isinstance(value, str) and value.endswith((".yaml", ".yml")):
            path = record.folder / value
            text = path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""
            named = record.settings.get(key, value)  # another file may stand in for a lost one
            flat[key] = f"{Path(str(named)).stem} {hash_text(text)[:6]}"
    for key in ("task.type", "controller.type"):
        if parse_own(flat.get(key)):
            function, _, digest = content_name(flat[key]).partition(" ")
            flat[key] = f"{function} {digest[:6]}"
    return flat


def group_runs(records: Sequence[RunRecord]) -> list[Group]:
    """Puts runs of the same configuration together.

    Args:
        records: the runs; a run that repeats a seed of its group is told so.

    Returns:
        The groups, in the order of their first runs. A run without settings is alone.
    """
    groups: dict[str, list[RunRecord]] = {}
    settings: dict[str, dict[str, Any]] = {}
    for record in records:
        flat = _settings(record)
        key = json.dumps(flat, sort_keys=True, default=str) if flat else str(record.folder)
        groups.setdefault(key, []).append(record)
        settings[key] = flat
    names = _names(list(groups.values()), list(settings.values()))
    made = []
    for name, (key, members) in zip(names, groups.items(), strict=True):
        kept: dict[Any, RunRecord] = {}
        # Of two with one seed the one that went further counts.
        for record in sorted(members, key=lambda r: (r.is_finished, r.generations), reverse=True):
            kept.setdefault(record.folder if record.seed is None else record.seed, record)
        unique = tuple(record for record in members if record in kept.values())
        copies = tuple(record for record in members if record not in kept.values())
        for record in copies:
            record.note("copy", f"the same configuration and seed as {kept[record.seed].label}: "
                        "it counts once")  # fmt: skip
        made.append(Group(name, unique, copies, settings[key]))
    return made


def differences(groups: Sequence[Group]) -> dict[str, list[Any]]:
    """Settings in which groups differ.

    Args:
        groups: the groups.

    Returns:
        By dotted name, the value of each group; None where it has none.
    """
    return _differences([group.settings for group in groups if group.settings])


def _differences(settings: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    keys = dict.fromkeys(key for flat in settings for key in flat)
    table = {key: [flat.get(key) for flat in settings] for key in keys}
    return {key: row for key, row in table.items() if any(value != row[0] for value in row)}


def _names(groups: Sequence[Sequence[RunRecord]], settings: Sequence[dict[str, Any]]) -> list[str]:
    """Short names that tell the groups apart: the fewest settings that do, or the file's name."""
    differ = _differences([flat for flat in settings if flat])
    told: list[tuple[str, ...]] = [()] * len(groups)
    for key in sorted(differ, key=lambda k: _TELLING.index(k) if k in _TELLING else len(_TELLING)):
        more = [
            (*words, _words(key, flat.get(key))) for words, flat in zip(told, settings, strict=True)
        ]
        if len(set(more)) > len(set(told)):
            told = more
    names = []
    for records, words in zip(groups, told, strict=True):
        source = records[0].info.get("config_file")
        file = Path(source).stem if isinstance(source, str) else records[0].folder.name
        name = ", ".join(word for word in words if word) or file
        names.append(name if len(name) <= _LABEL else name[: _LABEL - 1] + "…")
    # Whatever is still the same gets a letter.
    return [
        f"{name} ({chr(ord('a') + names[:k].count(name) % 26)})" if names.count(name) > 1 else name
        for k, name in enumerate(names)
    ]


def _words(key: str, value: Any) -> str:
    """`controller.type: cpg` as "cpg", anything else as "name value"."""
    if value is None:
        return ""
    section, _, leaf = key.rpartition(".")
    if key in ("morphology", "modules", "world.name"):
        return str(value).split(" ")[0] if key != "world.name" else Path(str(value)).stem
    if leaf in ("type", "strategy") and section:
        return str(value).split(" ")[0]
    if leaf == "generations":
        return f"{value} generations"
    return f"{leaf.replace('_size', '').replace('_', ' ')} {value}"
