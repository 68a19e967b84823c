"""Paths that may be read and written, and atomic writing."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import os
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from mjx_revolve.inputs.errors import InputError, reading, show

PAGES = (".html", ".htm")
"""Suffixes of pages for browsers."""


def check_path(path: object) -> Path:
    """A path that a user gave from Python.

    Raises:
        InputError: it is neither text nor path, or one that no file can have.
    """
    if not isinstance(path, str | Path):
        raise InputError(f"expected a path; found {show(path)}")
    try:
        str(path).encode()
        os.stat(path)
    except ValueError:
        raise InputError(repr(str(path)), "a path", "characters that none has") from None
    except OSError as error:
        if error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
            raise InputError(f"{path}: expected a path; found: {error.strerror}") from None
    return Path(path)


def read_file(path: str | Path, most: int | None = None) -> bytes:
    """The content of a file; never waits for a pipe.

    Args:
        path: of the file.
        most: bytes to read; None: all.

    Raises:
        InputError: it is missing, no regular file, or not readable.
    """
    path = check_path(path)
    with reading(path):
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise InputError("expected a file; found a pipe or a device")
        with open(path, "rb") as file:
            return file.read(-1 if most is None else most)


def check_name(path: str | Path, endings: Sequence[str], label: str | None = None) -> Path:
    """The path of a file to write.

    Args:
        path: as a user gave it.
        endings: suffixes that it may have.
        label: of messages; by default the path.

    Raises:
        InputError: it has none of the suffixes, or is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(label or path, "a file", "a folder")
    if path.suffix.lower() not in endings:
        named = f"a name that ends in {' or '.join(endings)}"
        raise InputError(label or path, named, repr(path.suffix))
    return path


def resolve_inside(path: str | Path, folder: str | Path) -> Path:
    """A file's path without links, which must lie inside a folder.

    Args:
        path: relative to the folder.
        folder: that contains it.

    Raises:
        InputError: it leads out, or nowhere.
    """
    try:
        inside = Path(folder).resolve()
        full = (inside / path).resolve()
    except ValueError:
        raise InputError(repr(str(path)), "a file name", "a null byte") from None
    except (OSError, RuntimeError):
        raise InputError(path, "a readable file", "a loop of links") from None
    if not full.is_relative_to(inside):
        found = "one" if ".." in Path(path).parts else "a link"
        raise InputError(path, f"a path inside {folder}", f"{found} that leads out")
    return full


SWEEP = "sweep.yaml"
"""The file in a sweep's folder that describes its runs."""


def short_path(path: str | Path) -> str:
    """A path as short as it can be typed here."""
    path = Path(path).absolute()
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def write_atomic(path: Path, content: bytes | Callable[[Path], None]) -> None:
    """Writes a file so that a crash leaves the old one or the new one, never half of it.

    Args:
        path: the file; its folder is made if need be.
        content: the bytes, or a function that writes to a path.

    Raises:
        OSError: the disk is full or the folder cannot be written; it names `path`.
    """
    # The temporary name keeps the suffix: some writers go by it.
    temporary = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        with naming(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.unlink(missing_ok=True)  # a link that a stranger has put there
            if callable(content):
                content(temporary)
            else:
                temporary.write_bytes(content)
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
            sync_folder(path.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Makes a rename survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Gives the system's errors within the context the path that the user gave."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


def csv_table(rows: Sequence[Mapping[str, object]]) -> bytes:
    """Rows as CSV (RFC 4180) under the names of all their cells; what a row lacks stays empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)))
    if rows:
        writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def path_inside(named: str) -> str:
    """Where a file stands in a copy of the folder that names it: one that lies elsewhere, by name.

    Args:
        named: its path from that folder, or an absolute one.
    """
    path = Path(named)
    return path.name if path.is_absolute() or ".." in path.parts else path.as_posix()
