"""Progress of a run: tqdm's live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import TextIO

from tqdm import tqdm

# A log gets about this many lines, however long the run, and one at least in such a time [s].
_LINES = 60
_LONGEST_GAP = 30.0
# Widths of the live line [columns]: the largest, the default for a terminal without a size, and the
# smallest of the bar.
_WIDEST, _USUAL, _BAR = 120, 80, 10


class _Line(tqdm):
    """tqdm's clock and screen, with a line that leaves out figures for which there is no room.

    Attributes:
        figures: in words, the most important first.
        words: the current activity, shown in place of the figures; "" for none.
    """

    monitor_interval = 0  # no thread that redraws bars without progress
    words = "compiling"
    figures: Sequence[str] = ()

    def __str__(self) -> str:
        """The line; without a bar, and with everything, where it has no width."""
        facts, width = self.format_dict, self.ncols
        done, total, rate = facts["n"], facts["total"], facts["rate"]
        rate = rate or (done - facts["initial"]) / (facts["elapsed"] or 1)
        left = self.format_interval((total - done) / rate) if rate else "?"
        parts = [f"{(width and self.desc) or self.unit} {done}/{total}"]
        parts += [self.words] if self.words else [*self.figures, f"left {left}"]
        while width and len(parts) > 3 and len("  ".join(parts)) + 2 + _BAR > width:
            del parts[-2]
        room = (width or 0) - len("  ".join(parts)) - 2
        if room >= _BAR and not self.words:
            drawn = {"ncols": room, "ascii": facts["ascii"], "bar_format": "{bar}"}
            parts.insert(1, self.format_meter(done, total, 1.0, **drawn))
        return "  ".join(parts)[:width]


class _Nowhere(io.StringIO):
    """A file that drops the bar, which still estimates the time left."""

    def write(self, text: str) -> int:
        """Discards it."""
        return len(text)


def is_live(out: TextIO) -> bool:
    """Whether a line can be drawn anew where this is written."""
    return out.isatty() and os.environ.get("TERM") != "dumb"


def choose_stride(total: int) -> int:
    """Generations between two plain lines: 1, 2, 5, 10, 20, 50 ..., for at most 60 lines."""
    strides = (digit * 10**power for power in itertools.count() for digit in (1, 2, 5))
    return next(stride for stride in strides if total / stride <= _LINES)


class Progress:
    """Shows the progress of a run, generation by generation, or a colony's interval by interval.

    On a terminal it is one line that is drawn anew. Elsewhere (a pipe, a log) it is one line each
    for the first generation, the last one, and those between at equal steps, at most about sixty in
    all; where generations are slow, one at least every thirty seconds.
    """

    def __init__(
        self,
        done: int,
        total: int,
        out: TextIO | None = None,
        unit: str = "generation",
        log: TextIO | None = None,
        label: str = "",
    ) -> None:
        """Begins.

        Args:
            done: generations that are done already.
            total: generations of the whole run.
            out: where to write; None: standard output.
            unit: what is counted.
            log: gets plain lines in any case. The live line then vanishes at the end, and elsewhere
                than on a terminal `out` gets nothing.
            label: in the live line in place of `unit`.
        """
        self._total = total
        self._out = sys.stdout if out is None else out
        self._live = is_live(self._out)
        self._plain = log or (None if self._live else self._out)
        self._leave = log is None
        if self._live and log is not None:  # a line that was begun
            self._out.write("\r\x1b[K")
        self._bar = _Line(
            total=total, initial=done, file=self._out if self._live else _Nowhere(), miniters=1,
            ncols=self._columns(), unit=unit, desc=label, leave=self._leave,
            position=0, nrows=24,  # on a terminal without a height tqdm draws nothing
        )  # fmt: skip
        self._stride = choose_stride(total)
        self._written = time.monotonic()
        self._first = True
        with self._forgiving():
            self._write()

    def show(self, row: Mapping[str, float]) -> None:
        """Shows a generation.

        Args:
            row: its figures: generation, best, mean, evaluations_per_second, and failed where
                there is such a column; a colony's: living, time [s] and times_real_time, too.
        """
        generation = int(row["generation"])
        with self._forgiving():
            self._bar.ncols = self._columns()
            self._bar.figures = self._figures(row)
            self._bar.words = ""
            first, self._first = self._first, False
            if first:  # mostly compilation: the time left is estimated from later ones
                self._bar.unpause()
                self._bar.n = self._bar.initial = self._bar.last_print_n = generation
                self._bar.refresh()
            else:
                self._bar.update(generation - self._bar.n)
            last = generation >= self._total
            overdue = time.monotonic() - self._written > _LONGEST_GAP
            if first or last or overdue or generation % self._stride == 0:
                self._write()

    def say(self, words: str) -> None:
        """Shows the activity after the last generation."""
        with self._forgiving():
            if self._live and not self._leave:
                self._bar.words = words
                self._bar.refresh()
            elif self._live:
                self.close()
                print(words, file=self._out, flush=True)
            if self._plain is not None:
                print(words, file=self._plain, flush=True)

    @contextlib.contextmanager
    def _forgiving(self) -> Iterator[None]:
        """Ignores the loss of the terminal or the pipe: it must not end a run."""
        try:
            yield
        except OSError:
            self._live, self._bar.disable = False, True
            self._plain = None if self._leave else self._plain

    def _write(self) -> None:
        """A plain line."""
        if self._plain is None:
            return
        width, self._bar.ncols = self._bar.ncols, None
        print(self._bar, file=self._plain, flush=True)
        self._bar.ncols = width
        self._written = time.monotonic()

    def _figures(self, row: Mapping[str, float]) -> list[str]:
        """What is shown of a row."""
        # A colony's robots have no fitness before they are some age.
        figures = {x: "-" if row[x] != row[x] else f"{row[x]:.4g}" for x in ("best", "mean")}
        rate = row["evaluations_per_second"]
        speed = "evaluations/s", f"{rate:.0f}" if rate >= 1000 else f"{rate:.4g}"
        if "times_real_time" in row:
            figures = {"alive": f"{row['living']:.0f}", "time": f"{row['time']:.0f} s"} | figures
            speed = "times real time", f"{row['times_real_time']:.3g}"
        if row.get("failed", 0) > 0:
            figures["failed"] = f"{row['failed']:.0f}"
        return [f"{name} {value}" for name, value in (*figures.items(), speed)]

    def _columns(self) -> int | None:
        """The width of the live line; plain ones have any."""
        if not self._live:
            return None
        try:
            columns = os.get_terminal_size(self._out.fileno()).columns
        except (OSError, ValueError):
            columns = 0
        # Some terminals wrap at the last column, and some report no size.
        return min(columns if columns > 1 else _USUAL, _WIDEST) - 1

    def close(self) -> None:
        """Leaves the last state of the line where it stands."""
        with contextlib.suppress(OSError):
            self._bar.close()
