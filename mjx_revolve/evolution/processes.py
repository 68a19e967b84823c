"""Workers on this machine: processes that score blocks, watched, and replaced when they are lost.

They are plain processes that run `serve`: JAX's threads do not survive a fork, and a script that
uses an executor needs no `if __name__ == "__main__"`. Only a command that has imported JAX, and has
not used it yet, forks its first ones, which saves them their imports. The job, blocks and scores
pass through a pipe, pickled. A second pipe, standard input, ends when the process that started them
does, even by kill -9; they end with it. Workers ignore interrupts, which the run handles, so that
the generation under way can be finished.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections import deque
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NoReturn

from mjx_revolve.evolution.block_executor import WorkerExecutor
from mjx_revolve.evolution.fingerprints import find_difference
from mjx_revolve.evolution.jobs import (
    SCRATCH,
    MakeFitness,
    WorkerError,
    compile_job,
    describe_error,
    open_job,
)
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import Config
    from mjx_revolve.evolution.blocks import Block, KeyData, Scored

# The program of a worker: it has the same module search path as this process.
_PROGRAM = (
    "import sys; sys.path[:] = sys.argv[2:]; "
    "from mjx_revolve.evolution.processes import serve; serve(int(sys.argv[1]))"
)
_DESCRIPTORS = "/proc/self/fd"
# Time between two checks of the workers' time limits [s].
_TICK = 0.25
# How much of the end of a worker's log is read [bytes].
_TAIL = 4096
_log = logging.getLogger(__name__)
# Of a worker.
_scratch: str | None = None


# ------------------------------------------------------------------ in the worker


def serve(descriptor: int) -> NoReturn:
    """Scores blocks until the pipe is closed, and ends the process.

    Args:
        descriptor: of its end of the pipe.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        _work(Connection(descriptor))
    except (EOFError, OSError):  # its end, as that of standard input, is that of the run's process
        _remove_scratch()
    # JAX's clean-up at exit takes a tenth of a second, and a worker has nothing to clean up.
    _flush()
    os._exit(0)


def _flush() -> None:
    """What waits for output; a stream is None where it is closed, and its disk may be full."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, OSError, ValueError):
            stream.flush()


def _end_with_parent() -> NoReturn:
    while os.read(0, 1):
        pass
    _remove_scratch()
    os._exit(1)


def _remove_scratch() -> None:
    """Removes the workers' temporary folder, which a process that is killed leaves behind."""
    if _scratch is not None:
        shutil.rmtree(_scratch, ignore_errors=True)


def _work(channel: Connection) -> None:
    global _scratch
    core, cache = channel.recv()
    try:
        with runtime.few_collections():
            runtime.prepare_worker(core, cache)
            from mjx_revolve.evolution.blocks import evaluate_block, key_from_data
            from mjx_revolve.evolution.fingerprints import identify

            job, _scratch = channel.recv()
            fitness = open_job(job, _scratch)
            compile_job(job, fitness)
        if core is not None:
            runtime.pin_process([core])
        channel.send(identify(fitness))
    except Exception as error:
        if _scratch is None and isinstance(error, EOFError):  # of the pipe, not of a user's code
            raise
        channel.send(describe_error(error))
        return
    while True:
        block, key = channel.recv()
        try:
            channel.send(evaluate_block(fitness, block, key_from_data(key)))
        except Exception as error:
            channel.send(describe_error(error))


# ------------------------------------------------------------------ in the run's process


def can_fork() -> bool:
    """Whether this process may fork workers once it has imported what they need.

    Where it had imported JAX before, that may have threads, as others may than the main one and
    that of `Interrupts`, which holds no lock; other systems' libraries forbid forks.
    """
    alone = "jax" not in sys.modules and threading.active_count() <= 2
    return alone and sys.platform == "linux" and Path(_DESCRIPTORS).is_dir()


class _Fork:
    """A process forked from this one, with as much of `subprocess.Popen` as is needed."""

    def __init__(self, descriptor: int, log: int) -> None:
        """Forks it; it serves at the pipe's end `descriptor`, and its output goes to `log`."""
        theirs, ours = os.pipe()
        self.stdin = open(ours, "wb", buffering=0)  # noqa: SIM115  (kept open)
        self.returncode: int | None = None
        _flush()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # of threads, see `can_fork`
                self.pid = os.fork()
            if not self.pid:
                self._serve(descriptor, theirs, log)
        finally:
            os.close(theirs)

    @staticmethod
    def _serve(descriptor: int, stdin: int, log: int) -> NoReturn:
        """The forked process."""
        try:
            os.setpgid(0, 0)
            signal.set_wakeup_fd(-1)
            for source, place in ((stdin, 0), (log, 1), (log, 2)):
                os.dup2(source, place)
            # Pipes to other workers would outlive this process's parent.
            for number in {int(name) for name in os.listdir(_DESCRIPTORS)} - {0, 1, 2, descriptor}:
                with contextlib.suppress(OSError):  # that of the folder
                    os.close(number)
            serve(descriptor)
        except BaseException:
            traceback.print_exc()
            _flush()
        finally:
            os._exit(1)

    def kill(self) -> None:
        """Kills it, unless it has been waited for."""
        if self.returncode is None:
            with contextlib.suppress(ProcessLookupError):  # where SIGCHLD is ignored
                os.kill(self.pid, signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code, negative for a signal; `subprocess.TimeoutExpired` after so long [s]."""
        began = time.monotonic()
        while self.returncode is None:
            try:
                pid, status = os.waitpid(self.pid, 0 if timeout is None else os.WNOHANG)
            except ChildProcessError:  # SIGCHLD is ignored, or another has waited; as of Popen
                pid, status = self.pid, 0
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
            elif timeout is not None and time.monotonic() - began > timeout:
                raise subprocess.TimeoutExpired("a worker", timeout)
            else:
                time.sleep(0.01)
        return self.returncode


class LocalWorker:
    """A worker process.

    Attributes:
        process: the process.
        channel: the pipe to it.
        core: the core it is pinned to; None: any.
        ready: whether it has opened the job.
        block: the number of the block that it scores; None: it is free.
        age: time spent on that block, as measured by the executor [s].
    """

    process: subprocess.Popen[bytes] | _Fork

    def __init__(self, core: int | None, cache: Path | None, fork: bool = False) -> None:
        """Starts the process, which waits for its job; OSError if the system refuses."""
        self.core = core
        self.ready = False
        self.block: int | None = None
        self.age = 0.0
        # Appending, so that reading in between does not move the place of writing.
        self._log: IO[bytes] = tempfile.TemporaryFile("a+b")  # noqa: SIM115  (kept open)
        self.channel, theirs = Pipe()
        try:
            # A group of its own: Ctrl-C and Ctrl-Z at the terminal reach only the run's process.
            if fork:
                self.process = _Fork(theirs.fileno(), self._log.fileno())
            else:
                self.process = subprocess.Popen(
                    [sys.executable, "-c", _PROGRAM, str(theirs.fileno()), *sys.path],
                    stdin=subprocess.PIPE, stdout=self._log, stderr=self._log,
                    pass_fds=[theirs.fileno()], process_group=0,
                )  # fmt: skip
        except OSError:
            self.channel.close()
            self._log.close()
            raise
        finally:
            theirs.close()
        self.send((core, str(cache) if cache else None))

    def send(self, message: object) -> None:
        """Sends a message; the worker's death shows when its answer is read."""
        with contextlib.suppress(OSError):
            self.channel.send(message)

    def describe_end(self) -> str:
        """How it ended, in words, waiting a little for it to do so."""
        try:
            code = self.process.wait(2.0)
        except subprocess.TimeoutExpired:
            return "its pipe closed"
        if code < 0:
            with contextlib.suppress(ValueError):
                return f"killed by {signal.Signals(-code).name}"
        self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, self._log.tell() - _TAIL))
        words = self._log.read().decode(errors="replace").strip().split("\n")[-1].strip()
        return f"exit code {code}" + (f": {words}" if words else "")

    def end(self) -> None:
        """Kills it, if need be; a stopped process, too."""
        self.process.kill()
        self.process.wait()
        self.channel.close()
        assert self.process.stdin is not None
        self.process.stdin.close()
        self._log.close()


def start_workers(count: int, cache: Path | None, fork: bool = False) -> list[LocalWorker]:
    """Starts workers, which import what they need and wait for a job.

    Args:
        count: number of workers. If there is one for each core, each is pinned to a core; fewer are
            not pinned, so that several runs on one host do not share the same cores.
        cache: the compilation cache's folder.
        fork: from this process, with what it has imported; see `can_fork`.

    Raises:
        WorkerError: the system refuses to start so many.
    """
    cores = runtime.list_cores()
    pinned = bool(cores) and count >= len(cores)
    workers: list[LocalWorker] = []
    try:
        for index in range(count):
            core = cores[index % len(cores)] if pinned else None
            workers.append(LocalWorker(core, cache, fork))
    except BaseException as error:
        for worker in workers:
            worker.end()
        if not isinstance(error, OSError):
            raise
        raise WorkerError(
            f"expected to start {count} workers; found after {len(workers)}: "
            f"{error.strerror or error}"
        ) from None
    return workers


class ProcessExecutor(WorkerExecutor[LocalWorker]):
    """Scores with worker processes on this machine.

    Attributes:
        workers: the worker processes.
    """

    def __init__(
        self,
        config: Config,
        make_fitness: MakeFitness | None,
        workers: list[LocalWorker],
        cache: Path | None,
    ) -> None:
        """Gives the workers their job.

        Args:
            config: of the run.
            make_fitness: see `executor.make_executor`.
            workers: from `start_workers`; they end with this.
            cache: the compilation cache's folder.
        """
        self.workers = workers
        # The workers' temporary folder, removed by this process, as workers are killed.
        self._scratch = tempfile.TemporaryDirectory(prefix=SCRATCH)
        self._cache = cache
        self._times: deque[float] = deque(maxlen=101)
        self._false_starts = 0
        super().__init__(config, make_fitness)

    def begin(self) -> None:
        """See `WorkerExecutor`."""
        for worker in self.workers:
            worker.send((self.job, self._scratch.name))

    @property
    def num_workers(self) -> int:
        """How many processes score."""
        return len(self.workers)

    def free(self) -> list[LocalWorker]:
        """See `WorkerExecutor`."""
        return [w for w in self.workers if w.ready and w.block is None]

    def send(self, worker: LocalWorker, number: int, block: Block, key: KeyData) -> None:
        """See `WorkerExecutor`."""
        worker.block, worker.age = number, 0.0
        worker.send((block, key))

    def attend(self) -> list[tuple[int, Scored | str | None]]:
        """See `WorkerExecutor`; WorkerError where no worker is left, and none can be started."""
        began = time.monotonic()
        readable = wait([worker.channel for worker in self.workers], _TICK)
        # Bounded, as this process may have been stopped (Ctrl-Z) in between.
        waited = min(time.monotonic() - began, 2 * _TICK)
        news: list[tuple[int, Scored | str | None]] = []
        for worker in list(self.workers):
            idle = worker.ready and worker.block is None
            worker.age += 0.0 if idle else waited
            limits = self.job.limits
            limit = limits.timeout(self._times) if worker.ready else limits.ready
            try:
                if worker.channel in readable:
                    news += self._take(worker, worker.channel.recv())
                elif worker.age > limit:
                    news += self._replace(worker, f"no answer for {worker.age:.0f} s")
            except (EOFError, OSError):
                news += self._replace(worker, worker.describe_end())
        return news

    def _take(self, worker: LocalWorker, message: Any) -> list[tuple[int, Any]]:
        """A worker's scores, or its answer once it is ready or cannot be."""
        if worker.ready:
            assert worker.block is not None
            number, worker.block = worker.block, None
            self._times.append(worker.age)
            return [(number, message)]
        if isinstance(message, dict):
            message = find_difference(self.identity, message)
        if message:
            self._dismiss(worker, message)
        worker.ready, self._false_starts = True, 0
        return []

    def _replace(self, worker: LocalWorker, how: str) -> list[tuple[int, str]]:
        """Starts another worker for one that died or hangs."""
        worker.end()
        self._false_starts += not worker.ready
        if not worker.ready and self._false_starts >= self.job.limits.tries:
            self._dismiss(worker, how)
            return []
        _log.warning("a worker is replaced (%s)", how)
        try:
            another = LocalWorker(worker.core, self._cache)
        except OSError as error:
            self._dismiss(worker, describe_error(error))
        else:
            another.send((self.job, self._scratch.name))
            self.workers[self.workers.index(worker)] = another
        return [] if worker.block is None else [(worker.block, how)]

    def _dismiss(self, worker: LocalWorker, why: str) -> None:
        """Removes a worker; the executor continues with the others."""
        worker.end()
        self.workers.remove(worker)
        if not self.workers:
            raise WorkerError(f"no worker can be started ({why})")
        _log.warning("the run goes on with fewer workers, %d (%s)", len(self.workers), why)

    def close(self) -> None:
        """Ends the workers."""
        self.closed = True
        for worker in self.workers:  # all at once, rather than one after the other
            worker.process.kill()
        while self.workers:
            self.workers.pop().end()
        self._scratch.cleanup()
