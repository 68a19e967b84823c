"""Progress of a run: tqdm's live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import time
from collections.abc import Mapping
from typing import TextIO

from tqdm import tqdm

# A log gets about this many lines, however long the run, and never stays silent for longer [s].
_LINES = 60
_SILENCE = 30.0
_LINE = "generation {n_fmt}/{total_fmt}  {desc}  left {remaining}"
_LIVE = "generation {n_fmt}/{total_fmt}  {bar}  {desc}  left {remaining}"
_WIDEST = 120  # of the live line [columns]


class _Bar(tqdm):
    """tqdm without the thread that redraws bars which have gone silent."""

    monitor_interval = 0


class _Nowhere(io.StringIO):
    """A file that drops the bar, which still estimates the time left."""

    def write(self, text: str) -> int:
        """Forgets it."""
        return len(text)


def choose_stride(total: int) -> int:
    """Generations between two plain lines: 1, 2, 5, 10, 20, 50 ..., for at most 60 lines."""
    stride, factors = 1, (2.0, 2.5, 2.0)
    count = 0
    while total / stride > _LINES:
        stride = round(stride * factors[count % 3])
        count += 1
    return stride


class Progress:
    """Shows the progress of a run, generation by generation.

    On a terminal it is one line that is drawn anew. Elsewhere (a pipe, a log) it is one line each
    for the first generation, the last one, and those between at equal steps, at most about sixty in
    all; where generations are slow, one at least every thirty seconds.
    """

    def __init__(self, done: int, total: int, out: TextIO | None = None) -> None:
        """Begins.

        Args:
            done: generations that are done already.
            total: generations of the whole run.
            out: where to write; None: standard output.
        """
        self._total = total
        self._out = sys.stdout if out is None else out
        self._live = self._out.isatty() and os.environ.get("TERM") != "dumb"
        file, line = (self._out, _LIVE) if self._live else (_Nowhere(), _LINE)
        self._bar = _Bar(
            total=total, initial=done, desc="compiling", file=file, miniters=1,
            ncols=self._columns(), bar_format=line,
        )  # fmt: skip
        self._stride = choose_stride(total)
        self._written = time.monotonic()
        self._first = True

    def show(self, row: Mapping[str, float]) -> None:
        """Shows a generation.

        Args:
            row: its figures: generation, best, mean, evaluations_per_second, and failed where
                there is such a column.
        """
        try:
            self._show(row)
        except OSError:  # the terminal or the pipe is gone: no reason to end a run of days
            self._out, self._live = _Nowhere(), False
            self._bar.disable = True

    def _show(self, row: Mapping[str, float]) -> None:
        generation = int(row["generation"])
        figures = {
            "best": f"{row['best']:.4g}",
            "mean": f"{row['mean']:.4g}",
            "evaluations/s": f"{row['evaluations_per_second']:.4g}",
        }
        if row.get("failed", 0) > 0:
            figures["failed"] = f"{row['failed']:.0f}"
        words = "  ".join(f"{name} {value}" for name, value in figures.items())
        self._bar.set_description_str(words, refresh=False)
        self._bar.ncols = self._columns()
        first, self._first = self._first, False
        if first:  # compiling took most of it: the time left follows from the next ones
            self._bar.unpause()
            self._bar.n = self._bar.initial = self._bar.last_print_n = generation
            self._bar.refresh()
        else:
            self._bar.update(generation - self._bar.n)
        last = generation >= self._total
        now = time.monotonic()
        silent = now - self._written > _SILENCE
        if not self._live and (first or last or silent or generation % self._stride == 0):
            print(self._bar, file=self._out, flush=True)
            self._written = now

    def _columns(self) -> int | None:
        """The width of the live line; plain ones have any."""
        if not self._live:
            return None
        try:
            columns = os.get_terminal_size(self._out.fileno()).columns
        except (OSError, ValueError):
            columns = 0
        # Some terminals wrap at the last column, and some do not know their size.
        return min(columns - 1, _WIDEST) if columns > 1 else _WIDEST

    def close(self) -> None:
        """Leaves the last state of the line where it stands."""
        with contextlib.suppress(OSError):
            self._bar.close()
