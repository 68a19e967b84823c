"""The run folder: everything that an evolution writes to disk.

    config.yaml        the resolved configuration
    inputs/            copies of all files that it names: robots, modules, world, code, data
    run.json           versions, seed, arguments, platform, threads, times, hashes of the copies
    metrics.csv        one line per generation (RFC 4180), readable while the run goes on
    checkpoints/       the newest few, one npz each
    individuals.jsonl  where bodies evolve: one line for each individual, at birth and after
    generations.jsonl  where bodies evolve: one line per generation, with the numbers alive
    events.jsonl       of a colony: births, matings and deaths, with time and place
    champion/          genes.yaml, morphology.yaml, robot.xml
    fitness.png, trajectory.png, swim.png, bodies.png

Files appear whole or not at all: they are written beside their place, flushed to the disk, and
moved there. The reader is `episodes.run_reader`.
"""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from mjx_revolve.body.tree import Morphology
from mjx_revolve.episodes.config import Config, dump_config, make_config, state_world
from mjx_revolve.episodes.individual_log import (
    EVENTS,
    GENERATIONS,
    INDIVIDUALS,
    LoggedIndividual,
    find_individuals,
)
from mjx_revolve.episodes.run_reader import (
    Checkpoint,
    DamageError,
    RunReader,
    arrays_of,
    generation_of,
)
from mjx_revolve.episodes.settings import copy_files, locate_files
from mjx_revolve.evolution.archive import Archive, filled, from_arrays
from mjx_revolve.inputs.commands import check_no_sweep
from mjx_revolve.inputs.errors import InputError, reading, show
from mjx_revolve.inputs.files import check_path, naming, resolve_inside, write_atomic
from mjx_revolve.inputs.yaml_reader import dump_yaml

try:
    import fcntl
except ImportError:  # not on Windows: there, run folders are not locked
    fcntl = None  # type: ignore[assignment]

LOGS = (INDIVIDUALS, GENERATIONS, EVENTS)
"""Files that only grow, a line at a time; a run that goes on cuts them to its checkpoint."""
# A folder with nothing else was begun by a process that died while making it.
_BEGINNING = {"inputs", "checkpoints", ".lock", "run.json"}
TEMPORARY = re.compile(r"\.\d+-")
"""Names of half-written files begin like that."""


@dataclass
class RunFolder(RunReader):
    """A run folder to write. Closing it, or the end of the process, lets others open it.

    Attributes:
        path: the folder.
    """

    _lock: IO[str] | None = field(default=None, repr=False)
    _made_lock: bool = field(default=False, repr=False)

    # --- plain files ---

    def update_info(self, **changes: object) -> None:
        """Sets entries of `run.json`; None removes one."""
        info = (self.info if (self.path / "run.json").exists() else {}) | changes
        self.write("run.json", _info_text(info))

    def save_config(self, config: Config) -> None:
        """Writes `config.yaml`, paths inside the folder relative to it."""
        self.write("config.yaml", _config_text(config, self.path))

    def write(self, name: str, content: bytes | Callable[[Path], None]) -> Path:
        """Writes any file below the folder, whole or not at all, and returns its path.

        Raises:
            OSError: the disk is full, or the folder was removed: it is not made anew in parts.
        """
        if not (self.path / "config.yaml").exists():
            raise OSError(errno.ENOENT, "the run folder was removed", str(self.path))
        write_atomic(self.path / name, content)
        return self.path / name

    # --- metrics ---

    def append_metrics(self, row: Mapping[str, float]) -> None:
        """Appends a row to `metrics.csv`; the file's first line names the columns."""
        text = io.StringIO()
        writer = csv.writer(text)
        with naming(self.metrics_path):
            columns: list[str] = []
            if self.metrics_path.exists():
                with open(self.metrics_path, encoding="utf-8", newline="") as file:
                    columns = next(csv.reader(file), [])
            if not columns:
                columns = list(row)
                writer.writerow(columns)
            # A run that another version began may have other measures.
            writer.writerow(_number(row.get(name, math.nan)) for name in columns)
            with open(self.metrics_path, "ab") as file:
                file.write(text.getvalue().encode())

    # --- logs ---

    def append_lines(self, name: str, lines: Iterable[str]) -> None:
        """Adds lines to one of `LOGS`."""
        path = self.path / name
        with naming(path), open(path, "ab") as file:
            file.write("".join(f"{line}\n" for line in lines).encode())

    def _positions(self) -> dict[str, int]:
        """The lengths of the files that only grow, flushed: a checkpoint will count on them."""
        found = {}
        for name in ("metrics.csv", *LOGS):
            path = self.path / name
            if path.exists():
                with open(path, "rb+") as file:
                    os.fsync(file.fileno())
                    found[name] = file.seek(0, os.SEEK_END)
        return found

    # --- checkpoints ---

    def save_checkpoint(
        self, generation: int, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any], keep: int
    ) -> Path:
        """Saves any arrays but object arrays, and values for JSON; the newest `keep` stay."""
        logs = self._positions()
        at = {"metrics_position": logs.pop("metrics.csv", 0), "positions": logs}
        text = json.dumps({**meta, "generation": generation, "arrays": sorted(arrays), **at})
        # Names go into the zip as they are; "meta" cannot collide with an "array:" one.
        named: dict[str, Any] = {f"array:{name}": value for name, value in arrays.items()}
        buffer = io.BytesIO()
        np.savez(buffer, meta=np.frombuffer(text.encode(), np.uint8), **named)
        name = f"checkpoints/generation_{generation:06d}.npz"
        path = self.write(name, buffer.getvalue())
        for old in self.checkpoints()[keep:]:
            old.unlink(missing_ok=True)
        return path

    def load_checkpoint(self) -> Checkpoint:
        """Reads the newest checkpoint that is whole.

        Returns:
            The checkpoint; `damaged` lists newer ones that were passed over.

        Raises:
            InputError: there is none.
        """
        damaged: dict[str, str] = {}
        for checkpoint in self.readable_checkpoints(damaged):
            try:
                _check_meta(checkpoint.meta)
                for name, position in checkpoint.positions.items():
                    log = self.path / name
                    have = log.stat().st_size if log.exists() else 0
                    if have < position:
                        raise DamageError(f"{name} lacks lines: {have} bytes long")
                    if position and _byte_at(log, position - 1) != b"\n":
                        raise DamageError(f"{name} has no line that ends at byte {position}")
            except DamageError as error:
                damaged[checkpoint.path.name] = str(error)
                continue
            return replace(checkpoint, damaged=tuple(f"{k} ({v})" for k, v in damaged.items()))
        lines = ", ".join(f"{name} ({why})" for name, why in damaged.items())
        found = f"only damaged ones: {lines}" if damaged else "none"
        raise InputError(self.path / "checkpoints", "a checkpoint to resume from", found)

    def rewind(self, checkpoint: Checkpoint | None) -> None:
        """Removes all later than a checkpoint: metrics, checkpoints, half-written files.

        Args:
            checkpoint: the checkpoint; None: the run's beginning.
        """
        later = [path for path in self.path.rglob(".*") if TEMPORARY.match(path.name)]
        for log in (self.path / name for name in ("metrics.csv", *LOGS)):
            if checkpoint is None:
                later.append(log)
            elif log.exists():
                os.truncate(log, checkpoint.positions.get(log.name, 0))
        if checkpoint is not None:
            newest = checkpoint.meta["generation"]
            later += [path for path in self.checkpoints() if generation_of(path) > newest]
        for path in later:
            path.unlink(missing_ok=True)

    # --- champion ---

    def save_champion(
        self, genes: np.ndarray, body: Morphology | None = None, **facts: object
    ) -> None:
        """Writes `champion/genes.yaml`: genes `[G]`, and plain values that go with them.

        Where bodies have evolved, the champion's is written beside it.
        """
        data = {**facts, "config": "../config.yaml"}
        if body is not None:

            def save(path: Path) -> None:
                """Wherever this stops, no genes stand beside another body."""
                body.save(path)
                (self.path / "champion/genes.yaml").unlink(missing_ok=True)

            self.write("champion/morphology.yaml", save)
            data["morphology"] = "morphology.yaml"
        data["genes"] = [float(gene) for gene in genes]
        text = dump_yaml(data, default_flow_style=None)
        self.write("champion/genes.yaml", text.encode())

    def close(self) -> None:
        """Lets other processes open the folder."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def abandon(self) -> None:
        """Closes it as it was found: without a lock file that was not there before."""
        if self._made_lock:
            (self.path / ".lock").unlink(missing_ok=True)
        self.close()


def _info_text(info: Mapping[str, object]) -> bytes:
    """The text of `run.json`; entries that are None are left out."""
    kept = {key: value for key, value in info.items() if value is not None}
    text = json.dumps(kept, indent=2, ensure_ascii=False) + "\n"
    return text.encode(errors="backslashreplace")  # folders may have names of any bytes


def _config_text(config: Config, folder: Path) -> bytes:
    """The text of `config.yaml`."""
    head = "# The resolved configuration of this run; it loads again as it stands.\n"
    config = config.model_copy(update={"world": state_world(config.world)})
    return (head + dump_config(config, folder)).encode()


def _number(value: float) -> str:
    """Few digits, but enough to read the same float32 back."""
    return str(value) if isinstance(value, int | np.integer) else f"{value:.9g}"


def _check_meta(meta: Mapping[str, object]) -> None:
    """Refuses plain values with which a run could not be resumed, or would cut other files.

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


def load_archive(folder: str | Path) -> tuple[Archive, list[LoggedIndividual]]:
    """The archive of a run in which bodies evolved, as its newest checkpoint has it.

    Args:
        folder: the run folder, which may still be written to.

    Returns:
        The archive, and its individuals, in the order of `archive.filled` and `archive.rows`.

    Raises:
        InputError: it is no run folder, or has no archive yet.
    """
    run = RunFolder(check_path(folder))
    own = arrays_of("archive.", run.load_checkpoint().arrays)
    if not own:
        raise InputError(folder, "a run with bodies.archive", "none in it")
    with reading(folder):
        found = from_arrays(own)
    return found, find_individuals(run.path, [int(number) for number in found.ids[filled(found)]])


def _byte_at(path: Path, position: int) -> bytes:
    with path.open("rb") as file:
        file.seek(position)
        return file.read(1)


def is_new_folder(folder: Path) -> bool:
    """Whether a folder is empty, or was being made by a process that has died."""
    if not folder.is_dir():
        return False
    names = {path.name for path in folder.iterdir() if not TEMPORARY.match(path.name)}
    begun = ".lock" in names and not any(folder.glob("checkpoints/*"))
    return not names or (begun and names <= _BEGINNING)


def check_new_folder(folder: str | Path) -> None:
    """Refuses a folder that holds something.

    Raises:
        InputError: there is a file, or a folder that is not empty.
    """
    folder = Path(folder)
    if (folder.exists() or folder.is_symlink()) and not is_new_folder(folder):
        hint = "; continue it with --resume" if (folder / "run.json").exists() else ""
        found = f"files{hint}" if folder.is_dir() else "a file"
        raise InputError(f"--out {folder}", "a new or empty folder", found)


def create_run_folder(
    folder: str | Path, config: Config, **info: object
) -> tuple[RunFolder, Config]:
    """Makes a run folder with configuration and inputs.

    Args:
        folder: a new or empty folder.
        config: the configuration. All files that it names are copied into the folder, so that the
            run can be moved, and depends on nothing else.
        **info: entries for `run.json`.

    Returns:
        The run, and its configuration, which names the copies.

    Raises:
        InputError: the folder holds something.
        OSError: it cannot be written.
    """
    settings, copies = copy_files(config.model_dump(), Config)
    folder = Path(folder).absolute()
    run = begin_run_folder(folder, copies, **info)
    places = {name: folder / name for name in copies}
    config = make_config(locate_files(settings, places), source=config.source)
    # Last: where it is, the run can be continued.
    write_atomic(folder / "config.yaml", _config_text(config, folder))
    return run, config


def begin_run_folder(folder: str | Path, copies: Mapping[str, bytes], **info: object) -> RunFolder:
    """Makes a run folder of any kind, all but its `config.yaml`, which a run writes last.

    Args:
        folder: a new or empty folder.
        copies: of the files that its configuration names, by paths relative to the folder.
        **info: entries for `run.json`.

    Raises:
        InputError: the folder holds something.
        OSError: it cannot be written.
    """
    check_new_folder(folder)
    folder = Path(folder).absolute()
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
        run = _lock_run(folder)
        (folder / "inputs").mkdir(exist_ok=True)
        (folder / "checkpoints").mkdir(exist_ok=True)
    for name, content in copies.items():
        write_atomic(folder / name, content)
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in copies.items()}
    write_atomic(folder / "run.json", _info_text(info | {"inputs": hashes}))
    return run


def open_run_folder(folder: str | Path) -> RunFolder:
    """Opens a run folder to continue it.

    Args:
        folder: the run folder.

    Returns:
        The run.

    Raises:
        InputError: it is no run folder, or another process is writing it.
    """
    return _lock_run(check_run_folder(folder))


def check_run_folder(folder: str | Path) -> Path:
    """The absolute path of a run folder that can be continued.

    Raises:
        InputError: it is none.
    """
    folder = Path(folder).absolute()
    if not folder.is_dir():
        found = "a file" if folder.exists() else "none"
        raise InputError(folder, "a run folder", found)
    if (folder / ".lock").exists() and is_new_folder(folder):
        found = "one that was not begun; begin it with --out"
        raise InputError(folder, "a run folder", found)
    check_no_sweep(folder)
    for name in ("config.yaml", "run.json"):
        if not (folder / name).is_file():
            raise InputError(folder, "a run folder", f"no {name} in it")
    for path in folder.iterdir():
        _check_writable(path, folder)
    return folder


def _check_writable(path: Path, folder: Path) -> None:
    """Refuses links and special files in a folder: a run could harm other files, or hang."""
    with reading(folder):
        real = resolve_inside(path.name, folder)
    if path.name in ("checkpoints", "champion", "inputs"):
        what, fits = "a folder", real.is_dir()
    elif path.name in (".lock", "metrics.csv", *LOGS):
        what, fits = "a file", real.is_file()
    else:
        what, fits = "a file or a folder", real.is_file() or real.is_dir()
    if not fits:
        raise InputError(path, what, "something else")


def _lock_run(folder: Path) -> RunFolder:
    """Keeps a second process from writing the same folder; the lock ends with the process."""
    if fcntl is None:
        return RunFolder(folder)
    made = not (folder / ".lock").exists()
    with naming(folder / ".lock"):
        lock = open(folder / ".lock", "a", encoding="utf-8")  # noqa: SIM115  (kept open)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise InputError(folder, "a run that has stopped", "it running") from None
    except OSError:  # a file system without locks
        pass
    if os.fstat(lock.fileno()).st_nlink == 0:  # removed meanwhile by another that gave up
        lock.close()
        return _lock_run(folder)
    return RunFolder(folder, lock, made)
