"""What a run says while it goes on."""

import io
import os
import re

import pytest

from mjx_revolve.evolution import progress


class Terminal(io.StringIO):
    """A terminal; `drawn` is what stood on it, one after the other."""

    def __init__(self, encoding="utf-8"):
        super().__init__()
        self.code = encoding

    encoding = property(lambda self: self.code)
    drawn = property(lambda self: self.getvalue().split("\r")[1:])

    def isatty(self):
        return True


def row(generation, **more):
    return {"generation": generation, "best": 0.25, "mean": 1 / 3, "std": 0.1,
            "evaluations_per_second": 1234.5} | more  # fmt: skip


@pytest.fixture
def clock(monkeypatch):
    """Time that passes only when told to."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    monkeypatch.setenv("TERM", "xterm")
    return now


@pytest.mark.parametrize(("total", "stride"), [(1, 1), (61, 2), (200, 5), (2000, 50)])
def test_a_log_has_sixty_lines_at_most(total, stride, clock):
    assert progress.choose_stride(total) == stride
    out = io.StringIO()
    shown = progress.Progress(0, total, out)
    for generation in range(1, total + 1):
        shown.show(row(generation))
    shown.close()
    told = [int(line.split("/")[0].split()[1]) for line in out.getvalue().splitlines()]
    assert told == sorted({0, 1, total, *range(stride, total + 1, stride)})


def test_plain_lines_tell_the_time_left(clock):
    out = io.StringIO()
    shown = progress.Progress(4, 10, out)
    clock[0] += 40.0  # compiling does not count
    shown.show(row(5))
    clock[0] += 15.0
    shown.show(row(6, failed=3))
    shown.say("drawing")
    assert out.getvalue().splitlines() == [
        "generation 4/10  compiling",
        "generation 5/10  best 0.25  mean 0.3333  evaluations/s 1234  left ?",
        "generation 6/10  best 0.25  mean 0.3333  failed 3  evaluations/s 1234  left 01:00",
        "drawing",
    ]


LINES = {  # columns: what stands there, bar aside; nothing is cut in the middle
    40: ["generation 3/4", "best 0.25", "left 00:02"],
    0: ["generation 3/4", "bar", "best 0.25", "mean 0.3333", "left 00:02"],
    200: ["generation 3/4", "bar", "best 0.25", "mean 0.3333", "evaluations/s 1234", "left 00:02"],
}


@pytest.mark.parametrize("columns", LINES)
def test_the_live_line_fits_its_terminal(columns, clock, monkeypatch):
    size = os.terminal_size((columns, 0))  # as of terminals that do not know their height
    monkeypatch.setattr(os, "get_terminal_size", lambda _: size)
    out = Terminal()
    out.fileno = lambda: 1
    columns = columns or 80
    shown = progress.Progress(0, 4, out)
    for generation in (1, 2, 3):
        clock[0] += 2.0
        shown.show(row(generation, best=0.25 if generation == 3 else -0.001234))
    clock[0] += 0.01
    shown.show(row(4))  # the last one, too soon for any other
    shown.close()
    assert all(len(line.rstrip("\n")) < columns for line in out.drawn)
    assert out.drawn[0].startswith("generation 0/4")
    assert len(out.drawn) == 5
    assert out.getvalue().endswith("\n")
    assert re.split("  +", re.sub("█+.", "bar", out.drawn[3]).strip()) == LINES[size.columns]


def test_dumb_terminals_get_plain_lines(clock, monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    out = Terminal()
    progress.Progress(0, 4, out).show(row(1))
    assert out.getvalue() == (
        "generation 0/4  compiling\n"
        "generation 1/4  best 0.25  mean 0.3333  evaluations/s 1234  left ?\n"
    )
