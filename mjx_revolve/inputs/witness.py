"""Who is told of each file of a user's before it is used, and may refuse it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

Kind = Literal["data", "Python"]
Witness = Callable[[Path, Kind, bytes], None]
"""Takes a file's path, what it is used as, and what is in it; raises to refuse it."""

# Of the whole process, so that no thread of it is forgotten.
_witnesses: list[Witness] = []


@contextlib.contextmanager
def heard_by(witness: Witness) -> Iterator[None]:
    """Has somebody told of all files that are used meanwhile.

    Args:
        witness: who is told.
    """
    _witnesses.append(witness)
    try:
        yield
    finally:
        _witnesses.remove(witness)


def tell(path: str | Path, kind: Kind, content: bytes) -> None:
    """Tells of a file that is about to be used; by programs that have no witness, nothing is asked.

    Args:
        path: the file.
        kind: what it is used as.
        content: what is in it.

    Raises:
        InputError: it is refused.
    """
    for witness in _witnesses:
        witness(Path(path), kind, content)
