"""The worker processes of one host: started together, watched, and gone when they should be.

They are plain processes that run `worker.main`, not forks: JAX's threads do not survive a fork, and
a script that uses a pool needs no `if __name__ == "__main__"`.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import Config
    from mjx_revolve.evolution.place import Place

# What a worker runs: it finds modules where this process finds them.
_PROGRAM = (
    "import sys; sys.path[:] = sys.argv[1:]; from mjx_revolve.evolution.worker import main; main()"
)
# How much of a worker's last words is looked at [bytes].
_TAIL = 4096
# What a worker may take to leave when it was told to [s].
_FAREWELL = 5.0
MAKE_FITNESS = "mjx_revolve.episodes.fitness:make_fitness"


class WorkerError(RuntimeError):
    """A worker died, hangs, or never came; the message says which and what is known of it."""


def make_job(config: Config, make_fitness: Callable | None, place: Place, cache: Path | None,
             patience: float) -> dict[str, Any]:  # fmt: skip
    """What a worker is told on its standard input; `Crew` adds its number and core.

    Args:
        config: of the run.
        make_fitness: a function that workers can import by its name; None: the real one.
        place: this host's, with the address at which its workers find the leader.
        cache: the compilation cache's folder.
        patience: how long the leader may take to listen [s].

    Raises:
        ValueError: the function cannot be imported by its name.
    """
    make = MAKE_FITNESS
    if make_fitness is not None:
        make = f"{make_fitness.__module__}:{make_fitness.__qualname__}"
        if make_fitness.__module__ == "__main__" or "<" in make:
            raise ValueError(
                f"make_fitness: expected a function that can be imported; found {make}"
            )
    return {
        "config": config.model_dump(),
        "source": config.source,
        "make": make,
        "address": place.address,
        "secret": place.secret.decode(),
        "cache": str(cache) if cache else None,
        "host": place.index,
        "hosts": place.hosts,
        "patience": patience,
    }


class WorkerProcess:
    """One worker process of this host.

    Attributes:
        process: the process.
    """

    def __init__(self, job: dict[str, Any]) -> None:
        # Appending, so that reading in between does not move the place of writing.
        self._log: IO[bytes] = tempfile.TemporaryFile("a+b")  # noqa: SIM115  (kept open)
        # A group of its own: Ctrl-C and Ctrl-Z at the terminal reach only who leads.
        group: dict[str, Any] = {"process_group": 0} if os.name == "posix" else {}
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM, *sys.path],
                stdin=subprocess.PIPE, stdout=self._log, stderr=self._log, **group,
            )  # fmt: skip
        except OSError:
            self._log.close()
            raise
        # The pipe stays open: its end tells the worker that this process has ended.
        with contextlib.suppress(OSError):  # dead already: whoever waits for it will find out
            assert self.process.stdin is not None
            self.process.stdin.write(json.dumps(job).encode() + b"\n")
            self.process.stdin.flush()

    def last_words(self) -> str:
        """The last line that it wrote, without `error: `, or nothing."""
        self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, self._log.tell() - _TAIL))
        lines = self._log.read().decode(errors="replace").split("\n")
        words = next((line.strip() for line in reversed(lines) if line.strip()), "")
        return words.removeprefix("error: ")

    def describe_end(self, patience: float = 2.0) -> str:
        """How it ended, in words, waiting a little for it to do so."""
        try:
            code = self.process.wait(patience)
        except subprocess.TimeoutExpired:
            return "its connection closed"
        if code < 0:
            with contextlib.suppress(ValueError):
                return f"killed by {signal.Signals(-code).name}"
        words = self.last_words()
        return f"exit code {code}" + (f": {words}" if words else "")

    def end(self, deadline: float) -> None:
        """Waits for it until `deadline` (of `time.monotonic`), then kills it; never returns early.

        SIGKILL ends a stopped process, too.
        """
        try:
            self.process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        with contextlib.suppress(OSError):  # closing flushes what a dead worker never read
            if self.process.stdin is not None:
                self.process.stdin.close()
        self._log.close()


class Crew:
    """The worker processes of this host.

    Attributes:
        workers: the processes, in the order of their numbers.
    """

    def __init__(self, count: int, job: dict[str, Any]) -> None:
        """Starts them.

        Args:
            count: how many. When they are at least as many as there are cores, each is pinned to a
                core; fewer are left to the system, so that several such runs on one host do not
                crowd on the same cores.
            job: what to do; see `make_job`.

        Raises:
            WorkerError: the system refuses to start so many.
        """
        self.workers: list[WorkerProcess] = []
        cores = runtime.list_cores()
        pinned = bool(cores) and count >= len(cores)
        try:
            for index in range(count):
                core = cores[index % len(cores)] if pinned else None
                more = {"worker": index, "workers": count, "core": core}
                self.workers.append(WorkerProcess(job | more))
        except BaseException as error:
            begun = len(self.workers)
            self.close(0.0)
            if not isinstance(error, OSError):
                raise
            raise WorkerError(
                f"expected to start {count} workers; found after {begun}: {error.strerror or error}"
            ) from None

    def find_ended(self) -> int | None:
        """The number of a worker that has ended, or None."""
        for index, worker in enumerate(self.workers):
            if worker.process.poll() is not None:
                return index
        return None

    def close(self, patience: float = _FAREWELL) -> None:
        """Waits for all of them to end, kills those that do not, and forgets them.

        Args:
            patience: how long to wait [s].
        """
        deadline = time.monotonic() + patience
        if patience <= 0:  # all at once, rather than one after the other
            for worker in self.workers:
                worker.process.kill()
        while self.workers:
            self.workers[-1].end(deadline)
            self.workers.pop()
