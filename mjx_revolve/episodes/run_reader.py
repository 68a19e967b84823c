"""The reader of run folders, whole or not: configuration, metrics, checkpoints, champion.

A folder may lack files, hold damaged ones, or come from another version. Each file has one reader,
which raises `InputError`; a report notes that and goes on. `evolution.run_folder` writes run
folders.
"""

from __future__ import annotations

import csv
import io
import json
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.inputs.commands import check_no_fit, check_no_sweep
from mjx_revolve.inputs.errors import InputError, reading, show
from mjx_revolve.inputs.files import SWEEP, check_path, read_file, short_path
from mjx_revolve.inputs.schema import Number, Text, TupleOf, read, words
from mjx_revolve.inputs.yaml_reader import load_yaml

_CHECKPOINT = re.compile(r"generation_(\d+)\.npz")
# What is read of `run.json`.
_INFO: Mapping[str, Any] = {
    "settings": TupleOf[Text],
    "resumed": Annotated[list[Any], words("a list")],
    "champion": Annotated[dict[Text, Any], words("a mapping")],
}


def find_run(path: str | Path) -> Path:
    """The run folder of a path: the path itself, or the parent of a `champion` folder.

    Raises:
        InputError: it is neither.
    """
    folder = check_path(path)
    if folder.absolute().name == "champion" and not (folder / "config.yaml").is_file():
        folder = Path(short_path(folder.absolute().parent))  # "." has no parent
    check_no_sweep(folder)
    check_no_fit(folder)
    if not (folder / "config.yaml").is_file():
        found = (
            "no config.yaml in it" if folder.is_dir() else "a file" if folder.exists() else "none"
        )
        raise InputError(path, "a run folder", found)
    return folder


def check_runs(names: Sequence[str | Path]) -> None:
    """Refuses folders that hold no file of a run or a sweep.

    Raises:
        InputError: a folder is missing, or there is nothing of a run in any.
    """
    for name in names:
        if not check_path(name).is_dir():
            found = "a file" if Path(name).exists() else "none"
            raise InputError(name, "a run folder", found)
    if len(names) == 1:  # among others, a report leaves it out
        check_no_fit(names[0])
    files = ("config.yaml", "run.json", "metrics.csv", "champion", SWEEP)
    folders = [f for f in map(Path, names) for f in (f, f.parent)]
    if not any((folder / file).exists() for folder in folders for file in files):
        raise InputError(names[0], "a run folder", "nothing of a run")


@dataclass
class RunReader:
    """Reads the files of a run folder; each method raises `InputError` where its file is wrong.

    Attributes:
        path: the folder.
    """

    path: Path

    def __post_init__(self) -> None:
        """Takes a text, too."""
        self.path = Path(self.path)

    @property
    def info(self) -> dict[str, Any]:
        """The contents of `run.json`."""
        path = self.path / "run.json"
        content = read_file(path)
        try:
            info = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: expected JSON; found: {error}") from None
        if not isinstance(info, dict):
            raise InputError(path, "a JSON object", type(info).__name__)
        for name in _INFO.keys() & info.keys():
            read(_INFO[name], info[name], f"{path}: {name}")
        return info

    @property
    def is_finished(self) -> bool:
        """Whether its champion was evaluated on fresh starts."""
        return (self.path / "run.json").is_file() and "finished" in self.info

    def load_config(self, **overrides: object) -> Config:
        """The configuration, with settings replaced by their dotted names."""
        return load_config(self.path / "config.yaml", overrides)

    @property
    def metrics_path(self) -> Path:
        """The metrics' file."""
        return self.path / "metrics.csv"

    def load_metrics(self) -> dict[str, np.ndarray]:
        """Float columns `[T]` of `metrics.csv` by name; see `load_metrics`."""
        return load_metrics(self.metrics_path)

    def checkpoints(self) -> list[Path]:
        """The checkpoint files, newest first."""
        files = (self.path / "checkpoints").glob("*.npz")
        found = [path for path in files if generation_of(path) >= 0]
        return sorted(found, key=generation_of, reverse=True)

    def readable_checkpoints(self, damaged: dict[str, str]) -> Iterator[Checkpoint]:
        """The checkpoints that are whole, newest first; adds names of others, and why."""
        for path in self.checkpoints():
            try:
                yield read_checkpoint(path)
            except DamageError as error:
                damaged[path.name] = str(error)

    @property
    def champion_path(self) -> Path | None:
        """The champion's file, also of a `champion` folder itself; None: there is none."""
        places = (self.path / "genes.yaml", self.path / "champion" / "genes.yaml")
        return next((place for place in places if place.is_file()), None)

    def load_champion(self) -> ChampionRecord:
        """The champion."""
        if self.champion_path is not None:
            return read_champion(self.champion_path)
        find_run(self.path)
        none = "none: this run was stopped before its first checkpoint, or the file is lost"
        raise InputError(self.path / "champion" / "genes.yaml", "a champion", none)


# --- metrics --------------------------------------------------------------------------------------


class MetricsTable(NamedTuple):
    """A metrics file, as far as it can be read.

    Attributes:
        columns: `[T]` floats by name, in the order of generations; empty without any.
        bad: how many lines are damaged, and left out.
        damage: what is wrong with the file as a whole; "": nothing.
    """

    columns: dict[str, np.ndarray]
    bad: int = 0
    damage: str = ""


def read_metrics(path: Path) -> MetricsTable:
    """Reads every line of a metrics file that is whole.

    A last line without an end is being written, or was cut there. Of two lines of one generation
    the later one counts, which is the resumed run's.
    """
    try:
        text = path.read_bytes().decode(errors="replace")
        lines = list(csv.reader(io.StringIO(text[: text.rfind("\n") + 1])))
    except OSError as error:
        return MetricsTable({}, damage=f"cannot be read: {error.strerror}")
    except csv.Error as error:
        return MetricsTable({}, damage=f"expected a CSV file; found: {error}")
    if not text.strip("\0 \r\n"):
        return MetricsTable({})
    header = lines[0] if lines else []
    if "generation" not in header or len(set(header)) < len(header):
        damage = f"expected a header with a column generation; found {str(header)[:60]}"
        return MetricsTable({}, damage=damage)
    rows: dict[float, list[float]] = {}
    place = header.index("generation")
    bad = 0
    for line in lines[1:]:
        try:
            row = [float(cell) for cell in line]
        except ValueError:
            row = []
        if len(row) == len(header) and np.isfinite(row[place]):
            rows[row[place]] = row
        else:
            bad += 1
    table = np.array([rows[generation] for generation in sorted(rows)]).reshape(-1, len(header))
    return MetricsTable(dict(zip(header, table.T, strict=True)), bad)


def load_metrics(path: str | Path) -> dict[str, np.ndarray]:
    """Reads a metrics file, also one that is being written.

    Returns:
        One float array per column; a last line that is still incomplete is left out.

    Raises:
        InputError: there is no such file, or it holds something else.
    """
    path = check_path(path)
    if not path.is_file():
        raise InputError(path, "a file", "none")
    columns, bad, damage = read_metrics(path)
    if damage or bad:
        found = damage or f"expected a number in every cell; found {bad} damaged lines"
        raise InputError(f"{path}: {found}")
    return columns


# --- checkpoints ----------------------------------------------------------------------------------


class DamageError(ValueError):
    """A checkpoint cannot be used; the message says why, in one line."""


@dataclass(frozen=True)
class Checkpoint:
    """The contents of a checkpoint.

    Attributes:
        path: the file.
        arrays: the arrays that were saved.
        meta: the plain values that were saved.
        damaged: names of newer checkpoints that could not be used, and why.
    """

    path: Path
    arrays: dict[str, np.ndarray] = field(repr=False)
    meta: dict[str, Any]
    damaged: tuple[str, ...] = ()

    @property
    def positions(self) -> dict[str, int]:
        """Lengths of the files that only grow when it was saved, by name [bytes]."""
        return {"metrics.csv": self.meta["metrics_position"], **self.meta.get("positions", {})}


def arrays_of(prefix: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays with names that begin so, by the rest of their names."""
    return {n.removeprefix(prefix): arrays[n] for n in arrays if n.startswith(prefix)}


def generation_of(path: Path) -> int:
    """After which generation a checkpoint was saved; -1 for another file."""
    match = _CHECKPOINT.fullmatch(path.name)
    return int(match.group(1)) if match else -1


def read_checkpoint(path: Path) -> Checkpoint:
    """Reads a checkpoint, every byte of which is checked.

    Raises:
        DamageError: it is damaged, or no checkpoint.
    """
    try:
        if not path.is_file():  # a pipe would block
            raise DamageError("expected a file; found none")
        with zipfile.ZipFile(path) as file:
            if any(entry.compress_type for entry in file.infolist()):
                raise DamageError("expected plain arrays; found compressed ones")  # of any size
            broken = file.testzip()  # every checksum; np.load looks only at what it happens to read
        if broken:
            raise DamageError(f"{broken} is damaged")
        with np.load(path, allow_pickle=False) as file:
            meta = json.loads(file["meta"].tobytes())
            arrays = arrays_of("array:", file)
    # Errors that the readers raise for a damaged zip, header or JSON.
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, RuntimeError,
            NotImplementedError, MemoryError, SyntaxError, zlib.error) as error:  # fmt: skip
        raise DamageError((str(error) or type(error).__name__).splitlines()[0]) from None
    if not isinstance(meta, dict) or "metrics_position" not in meta:
        raise DamageError("meta is no mapping")
    listed = meta.get("arrays")  # older checkpoints do not list them
    if isinstance(listed, list) and (lost := [x for x in listed if str(x) not in arrays]):
        raise DamageError(f"expected an array {show(lost[0])}; found none")
    return Checkpoint(path, arrays, meta)


# --- the champion ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChampionRecord:
    """A champion's file.

    Attributes:
        path: the file, a `genes.yaml`.
        genes: `[G]` float32, the same bits as evolved.
        facts: all else in it: score, score_std, origin, final, measures, individual.
    """

    path: Path
    genes: np.ndarray
    facts: Mapping[str, Any]

    @property
    def score(self) -> float | None:
        """Its score; None where that is not known."""
        score = self.facts.get("score")
        return float(score) if isinstance(score, int | float) and abs(score) < 1e300 else None

    @property
    def is_final(self) -> bool:
        """Whether its score is of fresh starts; of a run under way it is that of its selection."""
        return self.facts.get("final", True) is True

    @property
    def individual(self) -> int:
        """Its number among the individuals of a run in which bodies evolved."""
        found = self.facts.get("individual")
        if isinstance(found, bool) or not isinstance(found, int):
            number = "the champion's number, as bodies have evolved"
            raise InputError(f"{self.path}: individual", number, show(found))
        return found

    def load_run_config(self, **overrides: object) -> Config:
        """The run's configuration; raises `InputError` if there is no such file."""
        named = self.facts.get("config", "../config.yaml")
        if not isinstance(named, str):
            raise InputError(f"{self.path}: config", "a path", repr(named))
        source = self.path.parent / named
        if not source.is_file():
            raise InputError(f"{self.path}: config", "the run's config.yaml", f"no {source}")
        return load_config(source, overrides)

    def load_config(self, **overrides: object) -> Config:
        """The run's configuration; where bodies have evolved, of the champion's body alone.

        Raises:
            InputError: there is no such file, or no body.
        """
        config = self.load_run_config(**overrides)
        if config.bodies is None:
            return config
        body = self.facts.get("morphology")
        if not isinstance(body, str) or not (self.path.parent / body).is_file():
            named = "the path of the champion's body, as bodies have evolved"
            raise InputError(f"{self.path}: morphology", named, show(body))
        return config.for_body((self.path.parent / body).absolute())

    def check_genes(self, count: int, named: str) -> None:
        """Refuses genes that are not as many as `named`, a configuration or robot, takes."""
        if len(self.genes) != count:
            raise InputError(f"{self.path}: genes", f"{count}, as {named} has it", len(self.genes))


def read_champion(path: Path) -> ChampionRecord:
    """Reads a champion's file.

    Raises:
        InputError: it is missing, or holds something else.
    """
    data = load_yaml(path)
    genes = data.get("genes") if isinstance(data, dict) else None
    with reading(path):
        genes = read(TupleOf[Number], genes, "genes")
    facts = {name: value for name, value in data.items() if name != "genes"}
    return ChampionRecord(path, np.asarray(genes, np.float32), facts)
