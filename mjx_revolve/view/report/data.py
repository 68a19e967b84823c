"""What can be read of a run folder, whole or not: the beginning of every report.

A folder may lack files, hold damaged ones, or come from another version. Everything is read that
can be read, and everything else is named.
"""

from __future__ import annotations

import csv
import importlib.metadata
import io
import json
import math
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

import mjx_revolve
from mjx_revolve.episodes.champion import load_genes
from mjx_revolve.episodes.config import Config, make_config
from mjx_revolve.episodes.tasks import score_unit
from mjx_revolve.evolution.runs import Run
from mjx_revolve.inputs.errors import InputError, load_yaml
from mjx_revolve.inputs.own_code import content_name

# Whose version decides what a replay gives.
_PACKAGES = ("mjx_revolve", "jax", "jaxlib", "mujoco", "mujoco-mjx", "evosax")
# Kinds of problems, gravest first, and what they make of the run.
KINDS = {
    "damaged": "damaged",
    "missing": "incomplete",
    "unfinished": "not finished",
    "version": "of another version",
    "changed": "changed",
    "copy": "a copy",
}


@dataclass(frozen=True)
class Problem:
    """Something that is wrong with a run folder.

    Attributes:
        kind: one of `KINDS`.
        text: one line for a reader.
    """

    kind: str
    text: str


@dataclass
class RunRecord:
    """What could be read of a run.

    Attributes:
        folder: the run folder.
        label: what the report calls it.
        info: `run.json`; empty where there is none.
        settings: `config.yaml` as plain values; empty where there is none.
        config: the same, checked; None where it cannot be used.
        metrics: columns of `metrics.csv`, `[T]` each, one row per generation; empty without any.
        genes: `[G]` of the champion; None without one.
        champion: facts about it: score, score_std, origin, final, measures.
        stand_in: where the genes are from, if they are not the champion's own.
        problems: what is missing, damaged or otherwise to be known.
    """

    folder: Path
    label: str
    info: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    config: Config | None = None
    metrics: dict[str, np.ndarray] = field(default_factory=dict)
    genes: np.ndarray | None = None
    champion: dict[str, Any] = field(default_factory=dict)
    stand_in: str = ""
    problems: list[Problem] = field(default_factory=list)

    def note(self, kind: str, text: str) -> None:
        """Adds a problem; what it says of the folder is said once."""
        problem = Problem(kind, text.replace(f"{self.folder}/", ""))
        if problem not in self.problems:
            self.problems.append(problem)

    def setting(self, path: str, default: Any = None) -> Any:
        """A setting by its dotted name; the default where nothing is known."""
        data: Any = self.settings if self.config is None else self.config.model_dump()
        for part in path.split("."):
            data = data.get(part) if isinstance(data, Mapping) else None
        return default if data is None else data

    @property
    def seed(self) -> int | None:
        """The seed, or None."""
        seed = self.setting("evolution.seed", self.info.get("seed"))
        return seed if isinstance(seed, int) else None

    @property
    def task(self) -> str:
        """The task's type; a user's own by what its file holds; "" where it is not known."""
        return content_name(self._task_type)

    @property
    def unit(self) -> str:
        """Of the fitness; "" where it is not known."""
        return score_unit(self._task_type)

    @property
    def _task_type(self) -> str:
        task = self.setting("task.type", "")
        return task if isinstance(task, str) else ""

    @property
    def generations(self) -> int:
        """How many generations the metrics have."""
        return int(self.metrics["generation"][-1]) if self.metrics else 0

    @property
    def is_finished(self) -> bool:
        """Whether its champion was judged on fresh starts."""
        return "finished" in self.info and number(self.champion.get("score")) is not None

    @property
    def state(self) -> str:
        """What the problems make of it, in words; "" for a sound run."""
        kinds = {problem.kind for problem in self.problems}
        words = [word for kind, word in KINDS.items() if kind in kinds]
        return ", ".join(words)

    @property
    def warning(self) -> str:
        """One line about all problems."""
        return f"{self.label}: {self.state}: {'; '.join(p.text for p in self.problems)}"


def number(value: Any) -> float | None:
    """A finite number, or None.

    Args:
        value: anything.

    Returns:
        The number as a float.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:  # a whole number of hundreds of digits
        return None


def read_run(folder: str | Path) -> RunRecord:
    """Reads whatever there is of a run.

    Args:
        folder: the run folder; its `champion` folder will do.

    Returns:
        The record; `problems` says what it lacks.

    Raises:
        InputError: there is no such folder, or nothing of a run in it.
    """
    path = Path(folder)
    if not path.is_dir():
        found = "a file" if path.exists() else "none"
        raise InputError(f"{path}: expected a run folder; found {found}")
    if path.name == "champion" and (path.parent / "config.yaml").is_file():
        path = path.parent
    label = str(path) if str(path) not in (".", "..") else path.resolve().name
    record = RunRecord(path.absolute(), label)
    _read_info(record)
    _read_config(record)
    _read_metrics(record)
    _read_champion(record)
    _check_end(record)
    _check_versions(record)
    anything = (record.info, record.settings, record.metrics, record.genes is not None)
    if not any(anything):
        found = "; ".join(problem.text for problem in record.problems if problem.kind == "damaged")
        raise InputError(f"{folder}: expected a run folder; found {found or 'nothing of a run'}")
    return record


def _read_info(record: RunRecord) -> None:
    if not (record.folder / "run.json").is_file():
        record.note("missing", "run.json is missing: versions, machine and times are not known")
        return
    try:
        record.info = Run(record.folder).info
    except InputError as error:
        record.note("damaged", str(error))


# --- the configuration ----------------------------------------------------------------------------


def _split_unknown(
    data: Mapping[str, Any], model: type[BaseModel] = Config, prefix: str = ""
) -> tuple[dict[str, Any], list[str]]:
    """Settings that this version knows, and the names of all others."""
    known: dict[str, Any] = {}
    unknown: list[str] = []
    for key, value in data.items():
        if key not in model.model_fields:
            unknown.append(f"{prefix}{key}")
            continue
        inner = model.model_fields[key].annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel) and isinstance(value, Mapping):
            known[key], more = _split_unknown(value, inner, f"{prefix}{key}.")
            unknown += more
        else:
            known[key] = value
    return known, unknown


def _read_config(record: RunRecord) -> None:
    path = record.folder / "config.yaml"
    if not path.is_file():
        record.note("missing", "config.yaml is missing: neither settings nor a replay")
        return
    try:
        data = load_yaml(path)
    except InputError as error:
        record.note("damaged", str(error))
        return
    if not isinstance(data, dict) or not data:
        record.note("damaged", "config.yaml: expected a mapping of settings; found something else")
        return
    record.settings = data
    known, unknown = _split_unknown(data)
    if unknown:
        record.note(
            "version",
            f"config.yaml: this version does not know {', '.join(unknown)}; read without",
        )
    try:
        record.config = make_config(known, record.folder, source=str(path))
    except InputError as error:
        spare = record.folder / "champion" / "morphology.yaml"
        lost = "morphology: expected a file; found none" in str(error)
        if lost and spare.is_file():
            record.note("missing", f"{known['morphology']} is missing: champion/morphology.yaml "
                        "stands in for it")  # fmt: skip
            try:
                spared = {**known, "morphology": str(spare), "trim": "none"}
                record.config = make_config(spared, record.folder, source=str(path))
            except InputError as second:
                record.note("damaged", str(second))
        else:
            record.note("missing" if "found none" in str(error) else "damaged", str(error))


# --- the metrics ----------------------------------------------------------------------------------


def read_metrics(path: Path) -> tuple[dict[str, np.ndarray], list[Problem]]:
    """Reads every line of a metrics file that is whole.

    Args:
        path: the CSV.

    Returns:
        Float columns `[T]` by name, in the order of generations, infinities as NaN, and what was
        wrong.
    """
    if not path.is_file():
        return {}, [Problem("missing", f"{path.name} is missing: no convergence")]
    try:
        text = path.read_bytes().decode(errors="replace")
    except OSError as error:
        return {}, [Problem("damaged", f"{path.name}: cannot be read: {error.strerror}")]
    problems = []
    try:
        # A last line without an end is being written, or was cut there.
        lines = list(csv.reader(io.StringIO(text[: text.rfind("\n") + 1])))
    except csv.Error as error:
        return {}, [Problem("damaged", f"{path.name}: expected a CSV file; found: {error}")]
    if not text.strip("\0 \r\n"):
        return {}, [Problem("missing", f"{path.name} is empty: no generation was finished")]
    header = lines[0] if lines else []
    if "generation" not in header or len(set(header)) < len(header):
        return {}, [Problem("damaged", f"{path.name}: expected a header with a column generation; "
                            f"found {str(header)[:60]}")]  # fmt: skip
    rows: dict[float, list[float]] = {}
    bad = 0
    place = header.index("generation")
    for line in lines[1:]:
        try:
            row = [float(cell) for cell in line]
        except ValueError:
            row = []
        if len(row) == len(header) and np.isfinite(row[place]):
            rows[row[place]] = row  # of two, the later one is the resumed run's
        else:
            bad += 1
    if bad:
        what = "line is" if bad == 1 else "lines are"
        problems.append(Problem("damaged", f"{path.name}: {bad} {what} damaged and left out"))
    if not rows:
        return {}, [*problems, Problem("missing", f"{path.name} has no generation")]
    table = np.array([rows[generation] for generation in sorted(rows)])
    table[~np.isfinite(table)] = np.nan
    last = int(table[-1, place])
    if len(table) != last:
        gap = f"{last - len(table)} of {last} generations are not in it"
        problems.append(Problem("damaged", f"{path.name}: {gap}"))
    return {name: table[:, k] for k, name in enumerate(header)}, problems


def _read_metrics(record: RunRecord) -> None:
    record.metrics, problems = read_metrics(record.folder / "metrics.csv")
    for problem in problems:
        record.note(problem.kind, problem.text)


# --- the champion ---------------------------------------------------------------------------------


def _read_champion(record: RunRecord) -> None:
    """The champion; where there is none, the best that a checkpoint remembers."""
    elite, origin = _read_checkpoints(record)
    path = record.folder / "champion" / "genes.yaml"
    if not path.is_file():
        record.note("missing", "champion/genes.yaml is missing")
    else:
        try:
            genes = load_genes(path)
            if not genes.size or not np.isfinite(genes).all():
                raise InputError(f"{path}: genes: expected finite numbers; found others")
            record.genes = genes
            facts = load_yaml(path)
            record.champion = {key: facts[key] for key in facts if key != "genes"}
        except (InputError, OverflowError) as error:
            record.note("damaged", str(error))
    judged = record.info.get("champion")
    if isinstance(judged, dict):  # the same facts, and there even where genes.yaml is not
        record.champion = record.champion | judged
    if record.genes is None and elite is not None:
        record.genes = elite
        record.stand_in = f"best individual in {origin}"
        record.note("missing", f"the champion shown is the {record.stand_in}")


def _read_checkpoints(record: RunRecord) -> tuple[np.ndarray | None, str]:
    """The best individual of the newest checkpoint that is whole; every damaged one is named."""
    found: tuple[np.ndarray | None, str] = (None, "")
    paths = Run(record.folder).checkpoints()
    for path in paths:
        try:
            with zipfile.ZipFile(path) as file:
                broken = file.testzip()
            if broken:
                raise ValueError(f"{broken} is damaged")
            with np.load(path, allow_pickle=False) as file:
                elites, scores = file["array:elites"], file["array:elite_scores"]
                json.loads(file["meta"].tobytes())
        # Whatever a damaged zip, header or JSON makes the readers raise.
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, RuntimeError,
                NotImplementedError, MemoryError, SyntaxError) as error:  # fmt: skip
            what = str(error).splitlines()[0] if str(error) else type(error).__name__
            record.note("damaged", f"checkpoints/{path.name}: {what}")
            continue
        if found[0] is None and np.isfinite(scores[0]) and np.isfinite(elites[0]).all():
            found = np.asarray(elites[0], np.float32), f"checkpoints/{path.name}"
    if not paths:
        record.note("missing", "checkpoints/ has none: the run cannot be resumed")
    return found


# --- whether it is whole --------------------------------------------------------------------------


def _check_end(record: RunRecord) -> None:
    """A run that stopped early, or that lost its last lines."""
    planned = record.setting("evolution.generations")
    names = [path.stem for path in Run(record.folder).checkpoints()]
    newest = max((int(name.rpartition("_")[2]) for name in names), default=0)
    ran = record.info.get("generations")
    reached = max(newest, ran if isinstance(ran, int) and "finished" in record.info else 0)
    if record.metrics and reached > record.generations:
        record.note("damaged", f"metrics.csv ends at generation {record.generations}, but the run "
                    f"reached {reached}")  # fmt: skip
    if record.info and "finished" not in record.info:
        done = f"{max(record.generations, newest)}"
        done += f" of {planned}" if isinstance(planned, int) else ""
        record.note("unfinished", f"stopped or still running after {done} generations: its "
                    "champion is not judged on fresh starts")  # fmt: skip


def _numbers(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version)]


def _check_versions(record: RunRecord) -> None:
    """Packages that were others when the run was made."""
    versions = record.info.get("versions")
    if not isinstance(versions, Mapping):
        if record.info:
            record.note("version", "run.json names no versions: made by another version")
        return
    found = []
    for name in _PACKAGES:
        before = versions.get(name)
        try:
            now = (
                mjx_revolve.__version__
                if name == "mjx_revolve"
                else importlib.metadata.version(name)
            )
        except importlib.metadata.PackageNotFoundError:
            continue
        if isinstance(before, str) and before != now:
            age = "older" if _numbers(before) < _numbers(now) else "newer"
            found.append(f"{age} {name} {before} (here {now})")
    if found:
        record.note("version", f"made with {', '.join(found)}: a replay may differ")
