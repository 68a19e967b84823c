"""What a run says while it goes on: one live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Mapping
from typing import TextIO

# A log gets about this many lines, however long the run, and never stays silent for longer [s].
_LINES = 60
_SILENCE = 30.0
# A live line is drawn at most this often [1/s].
_DRAWS = 10.0
# The time left is told from the last generations: the first one compiles, and strategies change.
_RECENT = 30
_BAR = (8, 30)  # least and greatest width [columns]


def _clock(seconds: float) -> str:
    """`0:42`, `12:03` or `3:05:59`."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


def choose_stride(total: int) -> int:
    """Generations between two plain lines: 1, 2, 5, 10, 20, 50 ..., for at most 60 lines.

    Args:
        total: generations of the whole run.

    Returns:
        The stride.
    """
    stride, factors = 1, (2.0, 2.5, 2.0)
    count = 0
    while total / stride > _LINES:
        stride = round(stride * factors[count % 3])
        count += 1
    return stride


class Progress:
    """Tells generation by generation how a run goes.

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
        self._out = sys.stdout if out is None else out
        self._total = total
        self._stride = choose_stride(total)
        self._marks: deque[float] = deque(maxlen=_RECENT)
        self._written = time.monotonic()
        self._first = True
        self._pending = ""
        self._live = self._out.isatty() and os.environ.get("TERM") != "dumb"
        if self._live:
            self._draw(done, "compiling")

    def show(self, row: Mapping[str, float]) -> None:
        """Tells a generation.

        Args:
            row: its figures: generation, best, mean, evaluations_per_second, and failed where
                there is such a column.
        """
        now = time.monotonic()
        self._marks.append(now)
        generation = int(row["generation"])
        text = self._describe(row)
        last = generation >= self._total
        if self._live:
            if last or self._first or now - self._written > 1 / _DRAWS:
                self._draw(generation, text)
                self._pending = ""
            else:
                self._pending = text
                self._generation = generation
        elif (
            last or self._first or generation % self._stride == 0 or now - self._written > _SILENCE
        ):
            print(f"generation {generation}/{self._total}  {text}", file=self._out, flush=True)
            self._written = now
        self._first = False

    def _describe(self, row: Mapping[str, float]) -> str:
        figures = {
            "best": f"{row['best']:.4g}",
            "mean": f"{row['mean']:.4g}",
            "evaluations/s": f"{row['evaluations_per_second']:.4g}",
        }
        if row.get("failed", 0) > 0:
            figures["failed"] = f"{row['failed']:.0f}"
        count = len(self._marks) - 1
        if count > 0:
            pace = (self._marks[-1] - self._marks[0]) / count
            figures["left"] = _clock(pace * max(self._total - row["generation"], 0))
        return "  ".join(f"{name} {value}" for name, value in figures.items())

    def _draw(self, generation: int, text: str) -> None:
        """Draws the live line; what does not fit is left out, the bar first."""
        width = self._columns() - 1  # some terminals wrap at the last column
        head = f"generation {generation}/{self._total}"
        space = min(width - len(head) - len(text) - 4, _BAR[1])
        bar = f"  {self._bar(generation, space)}" if space >= _BAR[0] else ""
        line = f"{head}{bar}  {text}"[:width]
        self._out.write(f"\r{line}\x1b[K")
        self._out.flush()
        self._written = time.monotonic()

    def _bar(self, generation: int, space: int) -> str:
        full, empty = "━", "─"
        try:
            (full + empty).encode(getattr(self._out, "encoding", None) or "ascii")
        except (UnicodeEncodeError, LookupError):
            full, empty = "#", "."
        done = int(space * min(generation / max(self._total, 1), 1.0))
        return full * done + empty * (space - done)

    def _columns(self) -> int:
        try:
            columns = os.get_terminal_size(self._out.fileno()).columns
        except (OSError, ValueError, AttributeError):
            columns = 0
        return columns if columns > 1 else 100  # a terminal that does not know its size

    def close(self) -> None:
        """Leaves the last state of the line where it stands."""
        if self._live:
            if self._pending:
                self._draw(self._generation, self._pending)
            self._out.write("\n")
            self._out.flush()
