"""The reader of run folders for reports, whole or not.

A folder may lack files, hold damaged ones, or come from another version. Everything is read that
can be read, and everything else is named.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

import mjx_revolve
from mjx_revolve.episodes.config import make_config, with_older_values
from mjx_revolve.episodes.individual_log import EVENTS, GENERATIONS, INDIVIDUALS
from mjx_revolve.episodes.passport import PASSPORT, load_passport
from mjx_revolve.episodes.run_reader import RunReader, find_run, generation_of, read_metrics
from mjx_revolve.episodes.settings import find_copies, locate_files
from mjx_revolve.inputs.commands import check_no_fit
from mjx_revolve.inputs.errors import InputError, reading
from mjx_revolve.inputs.files import check_path, resolve_inside
from mjx_revolve.inputs.packages import installed_version
from mjx_revolve.inputs.yaml_reader import load_yaml
from mjx_revolve.view.colony_history import read_history
from mjx_revolve.view.population import read_population
from mjx_revolve.view.report.record import RunRecord

# Read one way or another, and shown; none of them may be a link to a file elsewhere.
_FILES = ("config.yaml", "run.json", "metrics.csv", "champion/genes.yaml",
          "champion/morphology.yaml", INDIVIDUALS, GENERATIONS, EVENTS)  # fmt: skip
# Packages with versions that affect a replay.
_PACKAGES = ("mjx_revolve", "jax", "jaxlib", "mujoco", "mujoco-mjx", "evosax")


def read_run(folder: str | Path) -> RunRecord:
    """Reads whatever there is of a run.

    Args:
        folder: the run folder; its `champion` folder will do.

    Returns:
        The record; `problems` lists what it lacks.

    Raises:
        InputError: there is no such folder, or nothing of a run in it.
    """
    path = check_path(folder)
    if not path.is_dir():
        raise InputError(path, "a run folder", "a file" if path.exists() else "none")
    check_no_fit(path)
    with suppress(InputError):  # without a config.yaml, the rest is read
        path = find_run(path)
    label = str(path) if str(path) not in (".", "..") else path.resolve().name
    record = RunRecord(path.absolute(), label)
    for name in _FILES:
        with reading(path):
            resolve_inside(name, path)
    _read_info(record)
    _read_config(record)
    _read_metrics(record)
    _read_population(record)
    _read_champion(record)
    _check_end(record)
    _check_versions(record)
    if not (record.info or record.settings or record.metrics or record.genes is not None):
        found = "; ".join(problem.text for problem in record.problems if problem.kind == "damaged")
        raise InputError(folder, "a run folder", found or "nothing of a run")
    return record


def read_runs(names: Sequence[str]) -> tuple[list[RunRecord], list[str]]:
    """Reads several runs.

    Args:
        names: of their folders.

    Returns:
        The runs, and a line about each folder of which nothing could be read.

    Raises:
        InputError: a folder is missing or named twice, or nothing can be read of any.
    """
    records: list[RunRecord] = []
    lost: list[str] = []
    seen: dict[Path, str] = {}
    for name in names:
        try:
            record = read_run(name)
        except InputError as error:
            if not Path(name).is_dir():  # a misspelt name rather than a damaged run
                raise
            lost.append(str(error))
            continue
        place = record.folder.resolve()
        if place in seen:
            raise InputError(name, "each run once", f"it as {seen[place]}, too")
        seen[place] = name
        records.append(record)
    if not records:
        raise InputError(lost[0])
    return records, lost


def _read_info(record: RunRecord) -> None:
    if not (record.folder / "run.json").is_file():
        record.note("missing", "run.json is missing: versions, machine and times are not known")
        return
    with record.noting_damage():
        record.info = RunReader(record.folder).info


# --- the configuration ----------------------------------------------------------------------------


def _read_config(record: RunRecord) -> None:
    path = record.folder / "config.yaml"
    if not path.is_file():
        record.note("missing", "config.yaml is missing: neither settings nor a replay")
        return
    with record.noting_damage():
        data = load_yaml(path)
        if not isinstance(data, dict) or not data:
            raise InputError("config.yaml", "a mapping of settings", "something else")
        record.settings = data
    if not record.settings:
        return
    try:
        known = locate_files(record.settings, find_copies(record.folder))
        known = with_older_values(known, record.folder)
        record.config = make_config(known, record.folder, source=str(path))
    except InputError as error:
        kinds = {"found none": "missing", "unknown key": "version"}
        kind = next((kind for words, kind in kinds.items() if words in str(error)), "damaged")
        record.note(kind, str(error))


# --- the metrics ----------------------------------------------------------------------------------


def _read_metrics(record: RunRecord) -> None:
    """Every line that is whole; infinities count as NaN."""
    path = record.folder / "metrics.csv"
    if not path.is_file():
        record.note("missing", f"{path.name} is missing: no convergence")
        return
    columns, bad, damage = read_metrics(path)
    if damage:
        record.note("damaged", f"{path.name}: {damage}")
        return
    if bad:
        what = "line is" if bad == 1 else "lines are"
        record.note("damaged", f"{path.name}: {bad} {what} damaged and left out")
    if not columns:
        record.note("missing", f"{path.name} is empty: no generation was finished")
    elif not len(columns["generation"]):
        record.note("missing", f"{path.name} has no generation")
    else:
        record.metrics = {
            name: np.where(np.isfinite(column), column, np.nan) for name, column in columns.items()
        }
        found, last = len(columns["generation"]), int(columns["generation"][-1])
        if found != last:
            gap = f"{last - found} of {last} generations are not in it"
            record.note("damaged", f"{path.name}: {gap}")


# --- individuals ----------------------------------------------------------------------------------


def _read_population(record: RunRecord) -> None:
    """The individuals of a run in which bodies evolved."""
    if not record.settings.get("bodies") and not (record.folder / INDIVIDUALS).is_file():
        return
    record.population, problems = read_population(record.folder)
    if record.settings.get("colony") or (record.folder / EVENTS).is_file():
        time = record.metrics.get("time", np.zeros(0))
        until = time[np.isfinite(time)].max(initial=0.0)
        record.history, more = read_history(record.folder, float(until))
        problems += more
    for problem in problems:
        record.note("damaged", problem)
    if not record.population.lives:
        record.note("missing", f"{INDIVIDUALS} is empty: neither bodies nor families")


# --- the champion ---------------------------------------------------------------------------------


def _read_champion(record: RunRecord) -> None:
    """The champion, and its passport."""
    run = RunReader(record.folder)
    if run.champion_path is None:
        record.note("missing", "champion/genes.yaml is missing")
    else:
        with record.noting_damage():
            found = run.load_champion()
            if not found.genes.size:
                raise InputError(f"{found.path}: genes", "finite numbers", "none")
            record.genes, record.champion = found.genes, dict(found.facts)
    if (path := record.folder / PASSPORT).is_file():
        with record.noting_damage():
            record.passport = load_passport(path)
    judged = record.info.get("champion")
    if isinstance(judged, dict):  # the same facts, and there even where genes.yaml is not
        record.champion = record.champion | judged
    if failed := record.champion.get("failed_starts"):
        record.note("failed", f"{failed} of the champion's fresh starts; its score counts them")
    if not run.checkpoints():
        record.note("missing", "checkpoints/ has none: the run cannot be resumed")


# --- whether it is whole --------------------------------------------------------------------------


def _check_end(record: RunRecord) -> None:
    """A run that stopped early, or that lost its last lines."""
    planned = record.setting("evolution.generations")
    newest = max(map(generation_of, RunReader(record.folder).checkpoints()), default=0)
    ran = record.info.get("generations")
    reached = max(newest, ran if isinstance(ran, int) and "finished" in record.info else 0)
    if record.metrics and reached > record.generations:
        record.note("damaged", f"metrics.csv ends at generation {record.generations}, but the run "
                    f"reached {reached}")  # fmt: skip
    if record.population is not None and record.population.last < reached:
        record.note("damaged", f"{GENERATIONS} ends at generation {record.population.last}, but "
                    f"the run reached {reached}")  # fmt: skip
    if record.info and "finished" not in record.info:
        done = f"{max(record.generations, newest)}"
        done += f" of {planned}" if isinstance(planned, int) else ""
        record.note("unfinished", f"stopped or still running after {done} {record.round}s: its "
                    "champion is not evaluated on fresh starts")  # fmt: skip


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
        before, now = versions.get(name), installed_version(name)
        if name == "mjx_revolve":  # a checkout of ours need not be installed
            now = mjx_revolve.__version__
        if isinstance(before, str) and now and before != now:
            age = "older" if _numbers(before) < _numbers(now) else "newer"
            found.append(f"{age} {name} {before} (here {now})")
    if found:
        record.note("version", f"made with {', '.join(found)}: a replay may differ")
