"""Checkpoints: arrays and plain values in one npz, of which half a file is never read."""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.inputs.files import write_atomic

_NAME = re.compile(r"generation_(\d+)\.npz")


class DamageError(ValueError):
    """A checkpoint cannot be used; the message says why, in one line."""


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds.

    Attributes:
        path: the file.
        arrays: the arrays that were saved.
        meta: the plain values that were saved.
        damaged: names of newer checkpoints that could not be used, and why.
    """

    path: Path
    arrays: dict[str, np.ndarray]
    meta: dict[str, Any]
    damaged: tuple[str, ...] = ()


def list_checkpoints(folder: Path) -> list[Path]:
    """The checkpoint files of a folder, newest first."""
    found = [path for path in folder.glob("*.npz") if _NAME.fullmatch(path.name)]
    return sorted(found, key=generation_of, reverse=True)


def generation_of(path: Path) -> int:
    """After which generation a checkpoint was saved; -1 for another file."""
    match = _NAME.fullmatch(path.name)
    return int(match.group(1)) if match else -1


def write_checkpoint(
    folder: Path, generation: int, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]
) -> Path:
    """Writes a checkpoint: any arrays but object arrays, and values that JSON can hold."""
    path = folder / f"generation_{generation:06d}.npz"
    buffer = io.BytesIO()
    text = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    # Names go into the zip as they are; "meta" cannot collide with an "array:" one.
    named: dict[str, Any] = {f"array:{name}": value for name, value in arrays.items()}
    np.savez(buffer, meta=text, **named)
    write_atomic(path, buffer.getvalue())
    return path


def read_checkpoint(path: Path) -> Checkpoint:
    """Reads a checkpoint, every byte of which is checked.

    Raises:
        DamageError: it is damaged, or no checkpoint.
    """
    try:
        if not path.is_file():  # a pipe would have us wait for ever
            raise DamageError("expected a file; found none")
        with zipfile.ZipFile(path) as file:
            broken = file.testzip()  # every checksum; np.load looks only at what it happens to read
        if broken:
            raise DamageError(f"{broken} is damaged")
        with np.load(path, allow_pickle=False) as file:
            meta = json.loads(file["meta"].tobytes())
            arrays = {
                name.removeprefix("array:"): file[name]
                for name in file.files
                if name.startswith("array:")
            }
    # Whatever a damaged zip, header or JSON makes the readers raise.
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, RuntimeError,
            NotImplementedError, MemoryError, SyntaxError) as error:  # fmt: skip
        raise DamageError((str(error) or type(error).__name__).splitlines()[0]) from None
    if not isinstance(meta, dict) or "metrics_position" not in meta:
        raise DamageError("meta is no mapping")
    return Checkpoint(path, arrays, meta)
