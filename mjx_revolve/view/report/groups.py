"""Groups of runs: one configuration with different seeds."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.settings import NamedFile, map_files
from mjx_revolve.evolution.fingerprints import FREE_SETTINGS
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.plots import letter
from mjx_revolve.view.report.record import RunRecord, number

# Settings that do not make it another configuration: they only say how it is kept.
_KEEPING = tuple(name for name in FREE_SETTINGS if name != "generations")
# Settings that name groups, if they differ, in this order; then all others.
_DISTINGUISHING = (
    "morphology", "task.type", "world.name", "controller.type", "evolution.strategy",
    "evolution.population_size", "evolution.generations",
)  # fmt: skip
_LABEL = 56  # longest name of a group in a legend [characters]


@dataclass(frozen=True, eq=False)
class RunGroup:
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
    settings: Mapping[str, object]

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

    def scores(self) -> list[float]:
        """Scores of the champions that were evaluated on fresh starts."""
        found = [number(r.champion.get("score")) for r in self.records if r.is_finished]
        return [score for score in found if score is not None]

    def best_after(self, generations: int) -> list[float]:
        """The best so far that each run had after so many generations, or at its end."""
        early = [
            r.metrics["champion"][r.metrics["generation"] <= generations]
            for r in self.shown if "champion" in r.metrics
        ]  # fmt: skip
        return [float(values[-1]) for values in early if len(values)]

    def best(self) -> RunRecord:
        """The run with the best champion: evaluated ones first, else by the best so far."""

        def rank(record: RunRecord) -> tuple[bool, bool, float]:
            score = number(record.champion.get("score"))
            if score is None and "champion" in record.metrics:
                score = number(float(record.metrics["champion"][-1]))
            known = -np.inf if score is None else score
            return record.genes is not None, record.is_finished, known

        return max(self.records, key=rank)


def _flatten(data: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    flat: dict[str, object] = {}
    for key, value in data.items():
        if isinstance(value, Mapping) and value:
            flat |= _flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _settings(record: RunRecord) -> dict[str, object]:
    """All that makes a configuration, files by what they hold rather than where they are."""
    data = dict(record.settings if record.config is None else record.config.model_dump())
    if isinstance(data.get("world"), str):
        data["world"] = {"name": data["world"]}

    def by_content(file: NamedFile) -> str:
        try:
            digest = file._replace(path=str(record.folder / file.path)).digest()[:6]
        except InputError:
            digest = ""
        return f"{file.function or Path(file.path).stem} {digest}"

    flat = _flatten(map_files(data, by_content, Config))
    for key in ("seed", *_KEEPING):
        flat.pop(f"evolution.{key}", None)
    return flat


def group_runs(records: Sequence[RunRecord]) -> list[RunGroup]:
    """Puts runs of the same configuration together.

    Args:
        records: the runs; a run that repeats a seed of its group gets a note.

    Returns:
        The groups, in the order of their first runs. A run without settings is alone.
    """
    groups: dict[str, list[RunRecord]] = {}
    settings: dict[str, dict[str, object]] = {}
    for record in records:
        flat = _settings(record)
        key = json.dumps(flat, sort_keys=True, default=str) if flat else str(record.folder)
        groups.setdefault(key, []).append(record)
        settings[key] = flat
    names = _names(list(groups.values()), list(settings.values()))
    made = []
    for name, (key, members) in zip(names, groups.items(), strict=True):
        kept: dict[Path | int, RunRecord] = {}
        # Of two with one seed the one that went further counts.
        for record in sorted(members, key=lambda r: (r.is_finished, r.generations), reverse=True):
            kept.setdefault(_identity(record), record)
        unique = tuple(record for record in members if record in kept.values())
        copies = tuple(record for record in members if record not in kept.values())
        for record in copies:
            label = kept[_identity(record)].label
            record.note("copy", f"the same configuration and seed as {label}: it counts once")
        made.append(RunGroup(name, unique, copies, settings[key]))
    return made


def _identity(record: RunRecord) -> Path | int:
    """The identity of a run in its group: its seed, or else its folder."""
    return record.folder if record.seed is None else record.seed


def differences(groups: Sequence[RunGroup]) -> dict[str, list[object]]:
    """Settings in which groups differ: by dotted name the value of each group, or None."""
    return _differences([group.settings for group in groups if group.settings])


def _differences(settings: Sequence[Mapping[str, object]]) -> dict[str, list[object]]:
    keys = dict.fromkeys(key for flat in settings for key in flat)
    table = {key: [flat.get(key) for flat in settings] for key in keys}
    return {key: row for key, row in table.items() if any(value != row[0] for value in row)}


def _names(
    groups: Sequence[Sequence[RunRecord]], settings: Sequence[dict[str, object]]
) -> list[str]:
    """Short unique names of groups: the fewest settings that differ, or the file's name."""
    differ = _differences([flat for flat in settings if flat])
    first = [key for key in _DISTINGUISHING if key in differ]
    chosen: list[tuple[str, ...]] = [()] * len(groups)
    for key in dict.fromkeys([*first, *differ]):
        words = [setting_words(key, flat.get(key)) for flat in settings]
        more = [(*before, word) for before, word in zip(chosen, words, strict=True)]
        if len(set(more)) > len(set(chosen)):
            chosen = more
    names = []
    for records, parts in zip(groups, chosen, strict=True):
        source = records[0].info.get("config_file")
        file = Path(source).stem if isinstance(source, str) else records[0].folder.name
        name = ", ".join(word for word in parts if word) or file
        names.append(name if len(name) <= _LABEL else name[: _LABEL - 1] + "…")
    # Whatever is still the same gets a letter.
    return [
        f"{name} ({letter(names[:k].count(name)).lower()})" if names.count(name) > 1 else name
        for k, name in enumerate(names)
    ]


def setting_words(key: str, value: object) -> str:
    """`controller.type: cpg` as "cpg", anything else as "name value"."""
    if value is None:
        return ""
    section, _, leaf = key.rpartition(".")
    if key in ("morphology", "modules", "world.name"):
        named = re.fullmatch(r"(.*) (?:[0-9a-f]{6})?", str(value))  # of `by_content`
        return named[1] if named else Path(str(value)).stem
    if leaf in ("type", "strategy") and section:
        return str(value).split(" ")[0]
    if leaf == "generations":
        return f"{value} generations"
    return f"{leaf.replace('_size', '').replace('_', ' ')} {value}"
