"""Configurations, robots and worlds that come with the package, found by their names.

Worlds are inside the package, the others at the top of a checkout or inside an installed package.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Literal

from mjx_revolve.inputs.errors import InputError, reading
from mjx_revolve.inputs.files import check_path

Kind = Literal["configs", "morphologies", "worlds"]
_PACKAGE = Path(__file__).resolve().parents[1]


def list_shipped(kind: Kind) -> dict[str, Path]:
    """Paths of the files that come with the package, by name, in alphabetical order."""
    folders = (_PACKAGE / kind, _PACKAGE / "water" / kind, _PACKAGE.parent / kind)
    folder = next((folder for folder in folders if folder.is_dir()), folders[0])
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def is_shipped(path: Path) -> bool:
    """Whether a path without links is that of a file of the package."""
    kinds = ("configs", "morphologies")
    folders = (_PACKAGE, *(_PACKAGE.parent / kind for kind in kinds))
    return any(path.is_relative_to(folder) for folder in folders)


def find_shipped(
    path: str | Path, kind: Kind, folder: str | Path = "", label: str | None = None
) -> Path:
    """The path of a user's file, or of a shipped one by its name.

    Args:
        path: a path, or a name. A file of that path wins over a shipped one of that name.
        kind: of file.
        folder: base of relative paths; "" for the current one.
        label: the place that named it, for the message; None for the path.

    Returns:
        The path; unchanged if it has a folder or a suffix, so that the reader reports its errors.

    Raises:
        InputError: there is neither such a file nor such a name, or it is no path.
    """
    with reading(label) if label else contextlib.nullcontext():
        path = check_path(path)
    here = folder / path
    if here.is_file() or path.suffix or len(path.parts) != 1:
        return here
    shipped = list_shipped(kind)
    if path.name in shipped:
        return shipped[path.name]
    if here.exists():
        return here
    known = f"a file, or one of {', '.join(shipped)}, which come with the package"
    raise InputError(label or path, known, "none" if label is None else repr(str(path)))
