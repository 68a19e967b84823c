"""The metrics of a run: one line of CSV (RFC 4180) per generation, readable while it goes on."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import with_path


def append_metrics(path: Path, row: Mapping[str, float]) -> None:
    """Adds a line of figures by column; the first line brings the columns, which then stay."""
    text = io.StringIO()
    writer = csv.writer(text)
    try:
        columns = _columns(path)
        if not columns:
            columns = list(row)
            writer.writerow(columns)
        # A run that another version began may know other measures.
        writer.writerow(_number(row.get(name, math.nan)) for name in columns)
        with open(path, "ab") as file:
            file.write(text.getvalue().encode())
    except OSError as error:
        raise with_path(error, path) from None


def _columns(path: Path) -> list[str]:
    """The columns of a metrics file; none where there is no file yet."""
    if not path.exists():
        return []
    with open(path, encoding="utf-8", newline="") as file:
        return next(csv.reader(file), [])


def _number(value: float) -> str:
    """Few digits, but enough to read the same float32 back."""
    return str(value) if isinstance(value, int | np.integer) else f"{value:.9g}"


def load_metrics(path: str | Path) -> dict[str, np.ndarray]:
    """Reads a metrics file, also one that is being written.

    Returns:
        One float array per column; a last line that is still incomplete is left out.

    Raises:
        InputError: there is no such file, or it holds something else.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: expected a file; found none")
    try:
        text = Path(path).read_bytes().decode()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected a CSV file; found: {error}") from None
    rows = list(csv.reader(io.StringIO(text[: text.rfind("\n") + 1])))
    if not rows:
        return {}
    header, lines = rows[0], rows[1:]
    try:
        values = np.array([[float(cell) for cell in line] for line in lines], float)
        values = values.reshape(len(lines), len(header))
    except ValueError as error:
        raise InputError(f"{path}: expected a number in every cell; found: {error}") from None
    return {name: values[:, column] for column, name in enumerate(header)}
