"""Workers of a Dask cluster, on any number of machines: blocks as tasks.

Dask transports tasks and scores, has TLS, restarts workers that die, and lets them join and leave
at any time. A worker receives blocks once it has opened the job and its program was found to be the
same. When a worker is lost, its blocks are scored again, as on one machine. Each task names its
worker, so that failures are counted for the right block.
"""

from __future__ import annotations

import contextlib
import faulthandler
import functools
import logging
import os
import pickle
import queue
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from mjx_revolve.evolution.block_executor import WorkerExecutor
from mjx_revolve.evolution.fingerprints import find_difference
from mjx_revolve.evolution.jobs import (
    SCRATCH,
    Job,
    Limits,
    MakeFitness,
    WorkerError,
    compile_job,
    describe_error,
    open_job,
)
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.packages import check_package
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    import jax

    from mjx_revolve.episodes.config import Config
    from mjx_revolve.evolution.blocks import Block, KeyData, Scored

# Time between two checks of the list of workers [s].
_TICK = 1.0
# Time limit for fetching a block's scores [s].
_FETCH = 10.0
# Blocks at a worker: the one in progress, and the next, so that it does not wait for messages.
_AT_ONCE = 2
_log = logging.getLogger(__name__)


# ------------------------------------------------------------------ in Dask's workers

# XLA's CPU back end can lock up when two threads run programs at once.
_XLA_LOCK = threading.Lock()


@contextlib.contextmanager
def _watched(seconds: float) -> Iterator[None]:
    """Runs one program at a time; ends a process that hangs, which Dask's nanny starts again."""
    with _XLA_LOCK:
        faulthandler.dump_traceback_later(seconds, exit=True)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()


@functools.lru_cache(maxsize=4)
def _open(pickled: bytes) -> tuple[Any, deque[float], tempfile.TemporaryDirectory[str]]:
    """The fitness of a job, the times of its last blocks [s], and the folder of its files."""
    os.environ["JAX_PLATFORMS"] = "cpu"  # before JAX is imported
    cache, cores = runtime.prepare_process(), runtime.list_cores()
    # Pinned to any one core, so that XLA has one thread: there is a process for each core.
    runtime.prepare_worker(cores[0] if cores else None, str(cache) if cache else None)
    job: Job = pickle.loads(pickled)
    scratch = tempfile.TemporaryDirectory(prefix=SCRATCH)
    fitness = open_job(job, scratch.name)
    compile_job(job, fitness)
    return fitness, deque(maxlen=101), scratch


def prepare(limits: Limits, pickled: bytes) -> tuple[dict[str, object], dict[str, str]]:
    """Opens a job and compiles its fitness, once per process.

    Returns:
        The result of `fingerprints.identify`, and further values that affect the last bits.
    """
    from mjx_revolve.evolution.fingerprints import identify

    with _watched(limits.ready):
        identity = identify(_open(pickled)[0])
    return identity, {"CPUs": runtime.cpu_model(), "XLA_FLAGS": os.environ.get("XLA_FLAGS", "")}


def score(limits: Limits, pickled: bytes, block: Block, key: KeyData) -> Scored:
    """Scores a block."""
    from mjx_revolve.evolution.blocks import evaluate_block, key_from_data

    fitness, times, _ = _open(pickled)
    with _watched(limits.timeout(times)):
        began = time.perf_counter()
        result = evaluate_block(fitness, block, key_from_data(key))
        times.append(time.perf_counter() - began)
    return result


# ------------------------------------------------------------------ in the run's process


@dataclass(eq=False)
class ClusterWorker:
    """A worker of the cluster.

    Attributes:
        address: its address.
        opening: the future that opens the job; None: it is open.
        refused: why it gets no blocks; "": it does.
        blocks: number and future of those that it has.
    """

    address: str
    opening: Any
    refused: str = ""
    blocks: list[tuple[int, Any]] = field(default_factory=list)


class ClusterExecutor(WorkerExecutor[ClusterWorker]):
    """Scores with the workers of a Dask scheduler.

    Attributes:
        place: the scheduler's address, or the path of its scheduler file.
        workers: all workers, also refused ones and those that still open the job, by address.
    """

    def __init__(self, config: Config, make_fitness: MakeFitness | None, place: str) -> None:
        """Connects to the scheduler.

        Args:
            config: of the run.
            make_fitness: see `executor.make_executor`.
            place: the scheduler's address, or the path of its scheduler file.

        Raises:
            InputError: there is none, or Dask is not installed.
        """
        check_package("--cluster", "distributed")
        import distributed

        is_file = place.endswith(".json") or os.path.isfile(place)
        if is_file and not os.path.isfile(place):  # Dask would wait for it
            raise InputError("--cluster", "a scheduler file", f"none at {place}")

        class Client(distributed.Client):  # type: ignore[misc]  # Dask has no types
            """Lets go at once of what could not be connected; Dask's own waits for a minute."""

            def __init__(self, **settings: object) -> None:
                try:
                    super().__init__(**settings)
                except Exception:
                    with contextlib.suppress(Exception):  # it may have hardly begun
                        self.close(timeout=1)
                    raise

        try:
            where = {"scheduler_file" if is_file else "address": place}
            self._client = Client(**where, set_as_default=False)
        except Exception as error:  # Dask raises anything about addresses, files and TLS
            found = describe_error(error)
            raise InputError(f"--cluster {place}", "a Dask scheduler", found) from None
        self.place = place
        self.workers: dict[str, ClusterWorker] = {}
        self._facts: dict[str, set[str]] = {}
        self._done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._next_look = 0.0
        self._at_once = _AT_ONCE
        self._deserted = False
        super().__init__(config, make_fitness)

    def begin(self) -> None:
        """See `WorkerExecutor`; they fetch it with their first task."""
        self._pickled = pickle.dumps(self.job)

    @property
    def num_workers(self) -> int:
        """How many processes score."""
        return len(self._fit())

    def describe(self) -> dict[str, object]:
        """See `Executor`; workers of a cluster come and go."""
        return {"cluster": self.place, "block": self.block}

    def _fit(self) -> list[ClusterWorker]:
        return [w for w in self.workers.values() if w.opening is None and not w.refused]

    def _score(self, blocks: Sequence[Block], key: jax.Array) -> list[Scored]:
        self._at_once = _AT_ONCE
        return super()._score(blocks, key)

    def free(self) -> list[ClusterWorker]:
        """See `WorkerExecutor`; one that has room for two blocks stands there twice."""
        return [w for k in range(self._at_once) for w in self._fit() if len(w.blocks) <= k]

    def send(self, worker: ClusterWorker, number: int, block: Block, key: KeyData) -> None:
        """See `WorkerExecutor`."""
        worker.blocks.append((number, self._submit(worker.address, score, block, key)))

    def _submit(self, address: str, function: Any, *arguments: Any) -> Any:
        with self._lost_if_closed():
            future = self._client.submit(
                function, self.job.limits, self._pickled, *arguments,
                workers=[address], pure=False,
            )  # fmt: skip
        future.add_done_callback(self._done.put)
        return future

    @contextlib.contextmanager
    def _lost_if_closed(self) -> Iterator[None]:
        """Turns Dask's errors after the loss of the scheduler into a `WorkerError`."""
        try:
            yield
        except Exception:  # of any kind, where the connection breaks
            if self._client.status not in ("connecting", "running"):
                raise WorkerError(f"the scheduler at {self.place} is lost") from None
            raise

    def attend(self) -> list[tuple[int, Scored | str | None]]:
        """See `WorkerExecutor`; WorkerError where the scheduler is lost, or no worker fits."""
        news = self._look() if time.monotonic() >= self._next_look else []
        with contextlib.suppress(queue.Empty):
            done = self._done.get(timeout=max(0.0, self._next_look - time.monotonic()))
            for worker in list(self.workers.values()):
                if worker.opening is done:
                    self._admit(worker)
                for entry in list(worker.blocks):
                    if entry[1] is done:
                        worker.blocks.remove(entry)
                        news.append((entry[0], self._fetch(worker, done)))
        return news

    def _look(self) -> list[tuple[int, Any]]:
        """Finds workers that have joined or left, and the blocks of the latter."""
        self._next_look = time.monotonic() + _TICK
        while self._client.status == "connecting":  # until its timeout
            time.sleep(0.1)
        there: dict[str, int] | None = None
        with contextlib.suppress(OSError), self._lost_if_closed():
            there = self._client.nthreads()
        if there is None:  # it tries to reach the scheduler again
            return []
        news: list[tuple[int, Any]] = []
        for address in [address for address in self.workers if address not in there]:
            worker = self.workers.pop(address)
            _log.warning("the worker at %s is gone", address)
            # One of two blocks may be at fault: from here on they are sent one at a time.
            self._at_once = 1
            how = f"the worker at {address} is gone" if len(worker.blocks) == 1 else None
            news += [(number, how) for number, _ in worker.blocks]
        if not there and not self._deserted:
            _log.warning("waiting for workers at %s", self.place)
        self._deserted = not there
        for address in there:
            if address not in self.workers:
                self.workers[address] = ClusterWorker(address, self._submit(address, prepare))
        return news

    def _admit(self, worker: ClusterWorker) -> None:
        """Accepts a worker that has opened the job, if it has the run's program."""
        opening, worker.opening = worker.opening, None
        if opening.status not in ("finished", "error"):  # the connection broke meanwhile
            del self.workers[worker.address]
            return
        try:
            identity, facts = opening.result(timeout=_FETCH)
            worker.refused = find_difference(self.identity, identity)
        except Exception as error:
            worker.refused = describe_error(error)
        if worker.refused:
            words = f"the worker at {worker.address} is refused: {worker.refused}"
            if not self._facts and all(w.refused for w in self.workers.values()):
                raise WorkerError(words)  # there never was another
            _log.warning("%s", words)
            return
        for what, value in facts.items():
            others = self._facts.setdefault(what, set())
            if others and value not in others:
                _log.warning(
                    "the workers have different %s (%s): the last bits of scores may depend on "
                    "which of them computes them", what, "; ".join(sorted(others | {value})),
                )  # fmt: skip
            others.add(value)

    def _fetch(self, worker: ClusterWorker, future: Any) -> Scored | str | None:
        if future.status not in ("finished", "error"):  # the connection broke meanwhile
            return None
        try:
            return future.result(timeout=_FETCH)
        except Exception as error:
            return f"{describe_error(error)} at {worker.address}"

    def close(self) -> None:
        """Disconnects; the cluster's workers stay."""
        self.closed = True
        self.workers.clear()
        with contextlib.suppress(Exception):  # the scheduler may be lost
            self._client.close(timeout=_FETCH)
