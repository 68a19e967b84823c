"""Files written so that nothing is lost: the old one or the new one, never half of it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path


def write_atomic(path: Path, content: bytes | Callable[[Path], None]) -> None:
    """Writes a file so that a crash leaves the old one or the new one, never half of it.

    Args:
        path: the file; its folder is made if need be.
        content: the bytes, or a function that writes to the path it is given.

    Raises:
        OSError: the disk is full or the folder cannot be written; it names `path`.
    """
    # The temporary name keeps the suffix: some writers go by it.
    temporary = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if callable(content):
            content(temporary)
        else:
            temporary.write_bytes(content)
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        raise with_path(error, path) from None
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


def with_path(error: OSError, path: Path) -> OSError:
    """The same error, naming the file that the user knows."""
    return OSError(error.errno, error.strerror or str(error), str(path))
