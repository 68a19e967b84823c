"""Audit of files: which of those that a run folder names may be read or run.

A run folder names Python files of its owner, and may name any file at all. A command reads or runs
such a file only if this user has used it before: it was named in a configuration given to `evolve`,
or allowed by `--trust`. Both are recorded by the files' content, outside of all run folders. So a
run folder may be moved, and a stranger's files are never taken for the user's own.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import logging
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Literal

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.shipped import is_shipped

_log = logging.getLogger(__name__)

Kind = Literal["data", "Python"]
Hook = Callable[[Path, Kind, bytes], None]
"""Takes a file's path, what it is used as, and its content; raises to refuse it."""

# Global, so that they hold in all threads of the process.
_hooks: list[Hook] = []


class UntrustedError(InputError):
    """A file is not used because it is not trusted."""


@contextlib.contextmanager
def audited_by(hook: Hook) -> Iterator[None]:
    """Calls a hook for each file before it is used."""
    _hooks.append(hook)
    try:
        yield
    finally:
        _hooks.remove(hook)


def audit(path: str | Path, kind: Kind, content: bytes) -> None:
    """Calls the hooks for a file that is about to be used; without any, all files are allowed.

    Raises:
        InputError: it is refused.
    """
    for hook in _hooks:
        hook(Path(path), kind, content)


def add_trust_argument(parser: argparse.ArgumentParser) -> None:
    """Adds `--trust` to a command that opens run folders."""
    parser.add_argument(
        "--trust", action="store_true",
        help="run the Python files, and read the files elsewhere, that the run folder names; "
        "those that you have used yourself are known",
    )  # fmt: skip


def record_path() -> Path:
    """The record of files used: below `$XDG_STATE_HOME`, or `~/.local/state`."""
    home = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(home).absolute() / "mjx_revolve" / "trusted"


def opening(*places: str | Path, trust: bool) -> contextlib.AbstractContextManager[None]:
    """Restricts what run folders may name.

    Args:
        places: the folders, or files in them; all files there may be read, but not run.
        trust: whether every file is allowed, and recorded as trusted.
    """
    if trust:
        return remembering()
    roots = [_root_of(Path(place)) for place in places]
    # Genes outside of all run folders may name any run's configuration: that run is opened, too. A
    # run's own champion may not, or it would show another run as its own.
    own = any(Path(place).is_file() and not _belongs_to_run(Path(place)) for place in places)

    def check(path: Path, kind: Kind, content: bytes) -> None:
        real = path.resolve()
        if own and kind == "data" and is_run_config(real):
            roots.append(real.parent)
        inside = any(real.is_relative_to(root) for root in roots)
        if is_shipped(real) or (kind == "data" and inside) or _is_known(kind, content):
            return
        if kind == "Python":
            known = "a Python file that you have used before, or --trust"
            new = "one that is new here and would be run: read it first"
            raise UntrustedError(path, known, new)
        known = "a file inside the run folder, one that you have used before, or --trust"
        raise UntrustedError(path, known, "another")

    return audited_by(check)


def remembering() -> contextlib.AbstractContextManager[None]:
    """Records all files that are used within the context as trusted by this user."""
    return audited_by(_remember)


def opening_config(
    path: str | Path, trust: bool = False
) -> contextlib.AbstractContextManager[None]:
    """Trusts the files of a configuration that a user names, unless it is a run folder's."""
    restricted = is_run_config(Path(path)) and not trust
    return opening(path, trust=False) if restricted else remembering()


def is_run_config(path: Path) -> bool:
    """Whether a configuration is that of a run folder, rather than one that a user has written."""
    return path.name == "config.yaml" and (path.parent / "run.json").exists()


def _root_of(place: Path) -> Path:
    """The run folder that a path belongs to, without links."""
    base = place if place.is_dir() else place.parent
    base = base.resolve()
    # Any other folder's parent may hold a configuration that has nothing to do with it.
    inner = base.name == "champion" and not (base / "config.yaml").is_file()
    return base.parent if inner and (base.parent / "config.yaml").is_file() else base


def _belongs_to_run(file: Path) -> bool:
    """Whether a file is one of a run folder's, even if that has lost its configuration."""
    folder = file.resolve().parent
    return folder.name == "champion" or (folder / "config.yaml").is_file()


def _digest(kind: Kind, content: bytes) -> str:
    """A line of the record; it holds the kind of use, as a file read as data may not be run."""
    return f"{kind} {hashlib.sha256(content).hexdigest()}"


def _is_known(kind: Kind, content: bytes) -> bool:
    try:
        return _digest(kind, content) in record_path().read_text(encoding="ascii").splitlines()
    except (OSError, ValueError):
        return False


def _remember(path: Path, kind: Kind, content: bytes) -> None:
    if is_shipped(path.resolve()) or _is_known(kind, content):
        return
    record = record_path()
    try:
        record.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with open(record, "a", encoding="ascii", opener=partial(os.open, mode=0o600)) as file:
            file.write(f"{_digest(kind, content)}\n")
    except OSError as error:  # a read-only home: --trust is needed again
        _log.warning("not recorded that you use %s: %s", path, error.strerror)
