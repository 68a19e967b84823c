"""The run folder: everything that an evolution writes to disk, and how it is read back.

    config.yaml        the resolved configuration; inputs/ holds the robot, and code, that it names
    run.json           versions, seed, arguments, platform, thread settings, times
    metrics.csv        one line per generation (RFC 4180), readable while the run goes on
    checkpoints/       the newest few, one npz each
    individuals.jsonl  where bodies evolve: one line for each individual, as it was born and lived
    generations.jsonl  likewise: one line per generation: who is alive
    events.jsonl       of a colony: births, matings and deaths, with time and place
    champion/          genes.yaml, morphology.yaml, robot.xml
    fitness.png, trajectory.png, swim.png, bodies.png

Files appear whole or not at all: they are written beside their place, flushed to the disk, and
moved there. Nothing here knows what the numbers mean.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import yaml

from mjx_revolve.body.tree import Morphology
from mjx_revolve.episodes.config import Config, dump_config, load_config
from mjx_revolve.episodes.lives import EVENTS, GENERATIONS, INDIVIDUALS, Life, find_lives
from mjx_revolve.evolution.archive import Archive, filled, from_arrays
from mjx_revolve.evolution.checkpoints import (
    Checkpoint,
    DamageError,
    generation_of,
    list_checkpoints,
    read_checkpoint,
    write_checkpoint,
)
from mjx_revolve.evolution.metrics import append_metrics, load_metrics
from mjx_revolve.inputs.errors import InputError, reading, show
from mjx_revolve.inputs.files import resolve_inside, with_path, write_atomic
from mjx_revolve.inputs.own_code import parse_own

try:
    import fcntl
except ImportError:  # not on Windows: there, nothing keeps two processes off one folder
    fcntl = None  # type: ignore[assignment]

LOGS = (INDIVIDUALS, GENERATIONS, EVENTS)
"""Files that only grow, a line at a time; a run that goes on cuts them to its checkpoint."""
# A folder with nothing else was begun by a process that died while making it.
_BEGINNING = {"inputs", "checkpoints", ".lock", "run.json"}
_TEMPORARY = re.compile(r"\.\d+-")


@dataclass
class Run:
    """An open run folder. Closing it, or the end of the process, lets others open it.

    Attributes:
        folder: the folder.
    """

    folder: Path
    _lock: IO[str] | None = field(default=None, repr=False)

    # --- plain files ---

    @property
    def info(self) -> dict[str, Any]:
        """The contents of `run.json`."""
        path = self.folder / "run.json"
        try:
            info = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise InputError(f"{path}: expected a file; found none") from None
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: expected JSON; found: {error}") from None
        if not isinstance(info, dict):
            raise InputError(f"{path}: expected a JSON object; found {type(info).__name__}")
        return info

    def update_info(self, **changes: Any) -> None:
        """Sets entries of `run.json`; None removes one."""
        info = (self.info if (self.folder / "run.json").exists() else {}) | changes
        info = {key: value for key, value in info.items() if value is not None}
        text = json.dumps(info, indent=2, ensure_ascii=False) + "\n"
        write_atomic(self.folder / "run.json", text.encode())

    def save_config(self, config: Config) -> None:
        """Writes `config.yaml`, paths inside the folder relative to it."""
        head = "# The resolved configuration of this run; it loads again as it stands.\n"
        text = head + dump_config(config, self.folder)
        write_atomic(self.folder / "config.yaml", text.encode())

    def load_config(self) -> Config:
        """Reads `config.yaml`."""
        return load_config(self.folder / "config.yaml")

    def write(self, name: str, content: bytes | Callable[[Path], None]) -> Path:
        """Writes any file below the folder, whole or not at all, and returns its path."""
        write_atomic(self.folder / name, content)
        return self.folder / name

    # --- metrics ---

    @property
    def metrics_path(self) -> Path:
        """Where the metrics are."""
        return self.folder / "metrics.csv"

    def append_metrics(self, row: Mapping[str, float]) -> None:
        """Adds a line to `metrics.csv`; see `metrics.append_metrics`."""
        append_metrics(self.metrics_path, row)

    def load_metrics(self) -> dict[str, np.ndarray]:
        """Reads `metrics.csv` as one float array per column."""
        return load_metrics(self.metrics_path)

    def _metrics_position(self) -> int:
        if not self.metrics_path.exists():
            return 0
        with open(self.metrics_path, "rb+") as file:
            os.fsync(file.fileno())  # the checkpoint will count on these lines
            return file.seek(0, os.SEEK_END)

    # --- logs ---

    def append_lines(self, name: str, lines: Iterable[str]) -> None:
        """Adds lines to one of `LOGS`."""
        path = self.folder / name
        try:
            with open(path, "ab") as file:
                file.write("".join(f"{line}\n" for line in lines).encode())
        except OSError as error:
            raise with_path(error, path) from None

    def _log_positions(self) -> dict[str, int]:
        """How long the logs are, which a checkpoint will count on."""
        found = {}
        for name in LOGS:
            path = self.folder / name
            if path.exists():
                with open(path, "rb+") as file:
                    os.fsync(file.fileno())
                    found[name] = file.seek(0, os.SEEK_END)
        return found

    # --- checkpoints ---

    def checkpoints(self) -> list[Path]:
        """The checkpoint files, newest first."""
        return list_checkpoints(self.folder / "checkpoints")

    def save_checkpoint(
        self, generation: int, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any], keep: int
    ) -> Path:
        """Saves a checkpoint, of which the newest `keep` stay; see `write_checkpoint`."""
        at = {"metrics_position": self._metrics_position(), "positions": self._log_positions()}
        meta = {**meta, "generation": generation, **at}
        path = write_checkpoint(self.folder / "checkpoints", generation, arrays, meta)
        for old in self.checkpoints()[keep:]:
            old.unlink(missing_ok=True)
        return path

    def load_checkpoint(self) -> Checkpoint:
        """Reads the newest checkpoint that is whole.

        Returns:
            The checkpoint; `damaged` says which newer ones were passed over.

        Raises:
            InputError: there is none.
        """
        damaged: list[str] = []
        for path in self.checkpoints():
            try:
                checkpoint = read_checkpoint(path)
                _check_meta(checkpoint.meta)
                have = self.metrics_path.stat().st_size if self.metrics_path.exists() else 0
                if have < checkpoint.meta["metrics_position"]:
                    raise DamageError(f"metrics.csv lacks lines: {have} bytes long")
                for name, position in checkpoint.meta.get("positions", {}).items():
                    log = self.folder / name
                    have = log.stat().st_size if log.exists() else 0
                    if have < position:
                        raise DamageError(f"{name} lacks lines: {have} bytes long")
            except DamageError as error:
                damaged.append(f"{path.name} ({error})")
                continue
            return replace(checkpoint, damaged=tuple(damaged))
        found = f"only damaged ones: {', '.join(damaged)}" if damaged else "none"
        raise InputError(
            f"{self.folder / 'checkpoints'}: expected a checkpoint to resume from; found {found}"
        )

    def rewind(self, checkpoint: Checkpoint | None) -> None:
        """Forgets what came after a checkpoint: metrics, checkpoints, half-written files.

        Args:
            checkpoint: the checkpoint; None: the run's beginning.
        """
        if checkpoint is None:
            for name in ("metrics.csv", *LOGS):
                (self.folder / name).unlink(missing_ok=True)
        else:
            positions = {"metrics.csv": checkpoint.meta["metrics_position"]}
            for name, position in (positions | checkpoint.meta.get("positions", {})).items():
                if (self.folder / name).exists():
                    os.truncate(self.folder / name, position)
            for path in self.checkpoints():
                if generation_of(path) > checkpoint.meta["generation"]:
                    path.unlink(missing_ok=True)
        for path in self.folder.rglob(".*"):
            if _TEMPORARY.match(path.name):
                path.unlink(missing_ok=True)

    # --- champion ---

    def save_champion(
        self, genes: np.ndarray, body: Morphology | None = None, **facts: Any
    ) -> None:
        """Writes `champion/genes.yaml`: genes `[G]`, and plain values that go with them.

        Where bodies have evolved, the champion's is written beside it.
        """
        data = {**facts, "config": "../config.yaml"}
        if body is not None:
            self.write("champion/morphology.yaml", body.save)
            data["morphology"] = "morphology.yaml"
        data["genes"] = [float(gene) for gene in genes]
        text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None)
        self.write("champion/genes.yaml", text.encode())

    def close(self) -> None:
        """Lets other processes open the folder."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def _check_meta(meta: Mapping[str, Any]) -> None:
    """Refuses plain values by which a run could not go on, or would cut files not its own.

    Raises:
        DamageError: they are others.
    """
    logs = meta.get("positions", {})
    if not isinstance(logs, dict) or not logs.keys() <= set(LOGS):
        raise DamageError(f"meta: positions: expected those of {', '.join(LOGS)}; found others")
    numbers = {"generation": meta.get("generation"), **meta, **logs}
    for name in ("generation", "metrics_position", *logs):
        value = numbers[name]
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise DamageError(f"meta: {name}: expected a whole number; found {show(value)}")


def load_archive(folder: str | Path) -> tuple[Archive, list[Life]]:
    """The archive of a run in which bodies evolved, as its newest checkpoint has it.

    Args:
        folder: the run folder, which may still be written to.

    Returns:
        The archive, and who is in it, in the order of `archive.filled` and `archive.rows`.

    Raises:
        InputError: it is no run folder, or has no archive yet.
    """
    run = Run(Path(folder))
    arrays = run.load_checkpoint().arrays
    own = {k.removeprefix("archive."): v for k, v in arrays.items() if k.startswith("archive.")}
    if not own:
        raise InputError(f"{folder}: expected a run with bodies.archive; found none in it")
    with reading(folder):
        found = from_arrays(own)
    return found, find_lives(run.folder, [int(number) for number in found.ids[filled(found)]])


def is_new_folder(folder: Path) -> bool:
    """Whether a folder is empty, or was being made by a process that has died."""
    if not folder.is_dir():
        return False
    names = {path.name for path in folder.iterdir()}
    begun = ".lock" in names and not any(folder.glob("checkpoints/*"))
    return not names or (begun and names <= _BEGINNING)


def check_new_folder(folder: str | Path, option: str = "--out") -> None:
    """Refuses a folder that holds something.

    Args:
        folder: where a new run is to go.
        option: what messages call it.

    Raises:
        InputError: there is a file, or a folder that is not empty.
    """
    folder = Path(folder)
    if is_new_folder(folder):
        return
    if folder.is_dir():
        hint = "; continue it with --resume" if (folder / "run.json").exists() else ""
        raise InputError(f"{option} {folder}: expected a new or empty folder; found files{hint}")
    if folder.exists():
        raise InputError(f"{option} {folder}: expected a new or empty folder; found a file")


def create_run(folder: str | Path, config: Config, **info: Any) -> tuple[Run, Config]:
    """Makes a run folder and writes down what will run.

    Args:
        folder: a new or empty folder.
        config: the configuration. Its morphology, and the files of a task or controller of the
            user's own, are copied into the folder, so that the run can be moved and still be read;
            a world or modules file stays where it is, because it may refer to files beside it.
        **info: entries for `run.json`.

    Returns:
        The run, and its configuration, which names the copies.

    Raises:
        InputError: the folder holds something.
        OSError: it cannot be written.
    """
    check_new_folder(folder)
    folder = Path(folder).absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        run = _lock_run(folder)
        (folder / "inputs").mkdir(exist_ok=True)
        (folder / "checkpoints").mkdir(exist_ok=True)
    except OSError as error:
        raise with_path(error, folder) from None
    config = _copy_own_code(_copy_robots(config, folder / "inputs"), folder / "inputs")
    run.update_info(**info)
    run.save_config(config)  # last: where it is, the run can be continued
    return run, config


def _copy_robots(config: Config, folder: Path) -> Config:
    """Keeps the morphology, or those that begin the population, and names the copies."""
    copies: dict[str, str] = {}
    bodies = config.bodies
    for path in [config.morphology] if config.morphology else bodies.seeds if bodies else ():
        copy = folder / Path(path).name
        if path not in copies and str(copy) in copies.values():  # two files of one name
            copy = folder / f"{len(copies)}_{copy.name}"
        write_atomic(copy, Path(path).read_bytes())
        copies[path] = str(copy)
    if bodies is None:
        return config.model_copy(update={"morphology": copies[config.morphology or ""]})
    seeds = tuple(copies[path] for path in bodies.seeds)
    return config.model_copy(update={"bodies": bodies.model_copy(update={"seeds": seeds})})


def _copy_own_code(config: Config, folder: Path) -> Config:
    """Keeps the files of the user's own functions, and names the copies."""
    copies: dict[str, Path] = {}
    changes = {}
    for section, key in (("controller", "type"), ("task", "type"), ("bodies", "genotype")):
        settings = getattr(config, section)
        own = parse_own(getattr(settings, key, None))
        if own is None:
            continue
        if own.path not in copies:
            copy = folder / Path(own.path).name
            if copy in copies.values():  # two files of one name
                copy = folder / f"{section}_{Path(own.path).name}"
            write_atomic(copy, Path(own.path).read_bytes())
            copies[own.path] = copy
        named = f"{copies[own.path]}:{own.function}"
        changes[section] = settings.model_copy(update={key: named})
    return config.model_copy(update=changes)


def open_run(folder: str | Path) -> Run:
    """Opens a run folder to continue it.

    Args:
        folder: the run folder.

    Returns:
        The run.

    Raises:
        InputError: it is no run folder, or another process is writing it.
    """
    folder = Path(folder).absolute()
    if not folder.is_dir():
        found = "a file" if folder.exists() else "none"
        raise InputError(f"{folder}: expected a run folder; found {found}")
    for name in ("config.yaml", "run.json"):
        if not (folder / name).is_file():
            raise InputError(f"{folder}: expected a run folder; found no {name} in it")
    for path in folder.iterdir():
        _check_writable(path, folder)
    return _lock_run(folder)


def _check_writable(path: Path, folder: Path) -> None:
    """Refuses what would have a run write, cut or delete files that are not its own, or hang."""
    with reading(folder):
        real = resolve_inside(path.name, folder)
    if path.name in ("checkpoints", "champion", "inputs"):
        what, fits = "a folder", real.is_dir()
    elif path.name in (".lock", "metrics.csv", *LOGS):
        what, fits = "a file", real.is_file()
    else:
        what, fits = "a file or a folder", real.is_file() or real.is_dir()
    if not fits:
        raise InputError(f"{path}: expected {what}; found something else")


def _lock_run(folder: Path) -> Run:
    """Keeps a second process from writing the same folder; the lock dies with the process."""
    if fcntl is None:
        return Run(folder)
    try:
        lock = open(folder / ".lock", "a", encoding="utf-8")  # noqa: SIM115  (kept open)
    except OSError as error:
        raise with_path(error, folder / ".lock") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise InputError(f"{folder}: expected a run that has stopped; found it running") from None
    except OSError:  # a file system without locks
        pass
    return Run(folder, lock)
