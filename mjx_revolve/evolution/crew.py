"""The worker processes of one host: started together, watched, and gone when they should be.

They are plain processes (`python -m mjx_revolve.evolution.worker`), not forks: JAX's threads do not
survive a fork, and a script that uses a pool needs no `if __name__ == "__main__"`.
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
from pathlib import Path
from typing import IO, Any

from mjx_revolve.numerics import runtime

# How much of a worker's last words is looked at [bytes].
_TAIL = 4096
# What a worker may take to leave when it was told to [s].
_FAREWELL = 5.0


class WorkerError(RuntimeError):
    """A worker died, hangs, or never came; the message says which and what is known of it."""


class WorkerProcess:
    """One worker process of this host.

    Attributes:
        process: the process.
    """

    def __init__(self, job: dict[str, Any]) -> None:
        # Appending, so that reading in between does not move the place of writing.
        self._log: IO[bytes] = tempfile.TemporaryFile("a+b")  # noqa: SIM115  (kept open)
        here = str(Path(__file__).resolve().parents[2])
        paths = [here, *filter(None, [os.environ.get("PYTHONPATH")])]
        # A group of its own: Ctrl-C and Ctrl-Z at the terminal reach only who leads.
        group: dict[str, Any] = {"process_group": 0} if os.name == "posix" else {}
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "mjx_revolve.evolution.worker"],
                stdin=subprocess.PIPE,
                stdout=self._log,
                stderr=self._log,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
                **group,
            )
        except OSError:
            self._log.close()
            raise
        # The pipe stays open: its end tells the worker that this process has ended.
        with contextlib.suppress(OSError):  # dead already: whoever waits for it will find out
            assert self.process.stdin is not None
            self.process.stdin.write(json.dumps(job).encode() + b"\n")
            self.process.stdin.flush()

    def last_words(self) -> str:
        """The last line that it wrote, or nothing."""
        self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, self._log.tell() - _TAIL))
        lines = self._log.read().decode(errors="replace").split("\n")
        return next((line.strip() for line in reversed(lines) if line.strip()), "")

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
        return f"exit code {code}" + (f": {words.removeprefix('error: ')}" if words else "")

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
            job: what to do; see `mjx_revolve.evolution.worker`.

        Raises:
            WorkerError: the system refuses to start so many.
        """
        self.workers: list[WorkerProcess] = []
        cores = runtime.list_cores()
        pinned = bool(cores) and count >= len(cores)
        try:
            for index in range(count):
                core = cores[index % len(cores)] if pinned else None
                more = {"worker": index, "workers": count, "core": core, "path": sys.path}
                self.workers.append(WorkerProcess(job | more))
        except OSError as error:
            begun = len(self.workers)
            self.close(0.0)
            raise WorkerError(
                f"expected to start {count} workers; found after {begun}: {error.strerror or error}"
            ) from None
        except BaseException:
            self.close(0.0)
            raise

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
