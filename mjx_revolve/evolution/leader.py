"""The leader of a pool of workers: who is there, who does what, and who has gone silent.

Work goes out in blocks, to whichever worker is free, so that faster cores do more of it. A worker
that ends, fails or keeps a block for too long ends the run at once by a `WorkerError`: the caller
saves what it has. Nothing waits without bound.

Why this and not `jax.distributed`: its processes fail together by design (when one dies, the
others are made to abort: https://docs.jax.dev/en/latest/fault_tolerance.html), and then nobody is
left to save the run. Individuals do not talk to each other, so all that it offers (collectives)
would go unused.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import statistics
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any

import jax
import numpy as np

from mjx_revolve.evolution.blocks import Scored
from mjx_revolve.evolution.crew import Crew, WorkerError
from mjx_revolve.evolution.messages import PROTOCOL, Channel, SecretError
from mjx_revolve.inputs.errors import InputError

# How long a handshake may hold the leader up, and how long any later message may take [s].
_HANDSHAKE, _MESSAGE = 5.0, 30.0
# How often it looks for what sends no news: processes that ended, time that passed [s].
_TICK = 0.25
# Number of the block that only warms a worker up.
_WARM_UP = 0
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Limits:
    """How long the leader waits before it gives a worker up [s].

    Attributes:
        start: for all workers of all hosts to report.
        first: for a worker's first block, which it compiles.
        later: for any other block, and at least ...
        factor: ... this many times the median block.
    """

    start: float = 300.0
    first: float = 900.0
    later: float = 120.0
    factor: float = 50.0


LIMITS = Limits()


@dataclass(eq=False)
class _Worker:
    """A worker that has reported.

    Attributes:
        name: what messages call it.
        channel: the connection to it.
        hello: what it said of itself.
        block: the number of the block that it scores; None: it is free.
        age: how long it has been at it, as far as the leader watched [s].
        done: how many blocks it has scored, the warm-up included.
    """

    name: str
    channel: Channel
    hello: dict[str, Any]
    block: int | None = None
    age: float = 0.0
    done: int = 0

    @property
    def place(self) -> tuple[int, int]:
        """Its host's and its own number."""
        return self.hello["host"], self.hello["worker"]


class Leader:
    """Hands out blocks to workers; a `blocks.Workplace`. Whoever makes one closes it."""

    def __init__(
        self,
        listener: socket.socket,
        crew: Crew,
        secret: bytes,
        identity: dict[str, Any],
        hosts: int,
        limits: Limits,
    ) -> None:
        """Takes over.

        Args:
            listener: where workers report.
            crew: this host's workers, started already.
            secret: of the run.
            identity: what a worker must have in common with the leader; see
                `fingerprints.identify`.
            hosts: how many there are, this one included.
            limits: how long to wait.
        """
        self._listener: socket.socket | None = listener
        self._crew = crew
        self._secret = secret
        self._identity = identity
        self._num_hosts = hosts
        self._limits = limits
        self._workers: dict[tuple[int, int], _Worker] = {}
        self._number = _WARM_UP
        self._times: deque[float] = deque(maxlen=101)
        self._warm_up = np.zeros((0, 0), np.float32)

    # --- who is there ---

    @property
    def hosts(self) -> list[dict[str, Any]]:
        """See `blocks.Workplace`."""
        heads = [worker for place, worker in sorted(self._workers.items()) if place[1] == 0]
        names = ("node", "cpu", "xla_flags", "workers")
        return [{name: worker.hello[name] for name in names} for worker in heads]

    def gather(self, rows: int, genes: int) -> None:
        """Waits until all workers have reported, and has the first of each host compile.

        The others of a host with a compilation cache wait for that one and read what it compiled;
        compiling it at the same time would take all of them longer.

        Args:
            rows: of every block.
            genes: of every individual.

        Raises:
            InputError: a worker runs another program or another configuration.
            WorkerError: one ended, or is missing after `limits.start`.
        """
        deadline = time.monotonic() + self._limits.start
        while missing := self._missing():
            if time.monotonic() > deadline:
                raise WorkerError(
                    f"expected all workers within {self._limits.start:.0f} s; found {missing} "
                    "missing"
                )
            self._attend()
            ended = self._crew.find_ended()
            if ended is not None and (0, ended) not in self._workers:
                how = self._crew.workers[ended].describe_end()
                raise WorkerError(f"{self._name(0, ended, len(self._crew.workers))} ended ({how})")
        self._stop_listening()
        self._warm_up = np.zeros((rows, genes), np.float32)
        for worker in self._workers.values():
            if worker.place[1] == 0 or not worker.hello["cached"]:
                self._warm(worker)

    def _missing(self) -> str:
        """Which workers have not reported, in words; nothing if all have."""
        names = []
        for host in range(self._num_hosts):
            there = [worker for place, worker in self._workers.items() if place[0] == host]
            if host and not there:
                names.append(f"host {host}")
                continue
            expected = there[0].hello["workers"] if there else len(self._crew.workers)
            if len(there) < expected:
                words = f"{expected - len(there)} of {expected} workers"
                names.append(f"{words} of host {host}" if self._num_hosts > 1 else words)
        return ", ".join(names)

    def _name(self, host: int, worker: int, workers: int, node: str = "") -> str:
        name = f"worker {worker + 1} of {workers}"
        if self._num_hosts > 1:
            name += f" of host {host}" + (f" ({node})" if node else "")
        return name

    def _admit(self) -> None:
        """Lets one more worker in, if it is one of this run's."""
        assert self._listener is not None
        connection, address = self._listener.accept()
        channel = Channel(connection, _HANDSHAKE)
        try:
            channel.prove_secret(self._secret, leads=True)
            hello, _ = channel.receive_message()
            channel.set_patience(_MESSAGE)
        except (EOFError, OSError) as error:
            channel.close()
            # Whoever does not know the secret is a stranger, and must not be able to end the run.
            reason = "no worker of ours"
            if isinstance(error, SecretError):
                reason = "it has another MJX_REVOLVE_SECRET"
            peer = address[0].removeprefix("::ffff:")  # an IPv4 address on an IPv6 socket
            _log.warning("refused a connection from %s: %s", peer, reason)
            return
        problem = self._check(hello)
        if problem:
            with contextlib.suppress(OSError):
                channel.send_message({"type": "refused", "reason": problem})
            channel.close()
            raise InputError(problem)
        name = self._name(hello["host"], hello["worker"], hello["workers"], hello["node"])
        worker = _Worker(name, channel, hello)
        self._workers[worker.place] = worker

    def _check(self, hello: dict[str, Any]) -> str:
        """What is wrong with a worker, in words that its host prints, too; nothing if all is well.

        Messages name the host only where there are several.
        """
        if hello.get("protocol") != PROTOCOL:
            return (
                f"expected workers of the leader's version of mjx_revolve; found protocol "
                f"{hello.get('protocol')} rather than {PROTOCOL}"
            )
        ours, hosts, host = self._identity, self._num_hosts, hello["host"]
        who = f"host {host} ({hello['node']})" if hosts > 1 else f"worker {hello['worker']}"
        # This host has the same files, unless somebody is at work on them.
        for package, version in (ours["versions"] if host else {}).items():
            found = hello["versions"].get(package)
            if found != version:
                what = "source" if package == "mjx_revolve" else "version"
                return f"{who}: {package}: expected the leader's {what} {version}; found {found}"
        checks = (
            (hello["hosts"] == hosts,
             f"--hosts: expected {hosts} as on host 0; found {hello['hosts']}"),
            (hello["settings_hash"] == ours["settings_hash"],
             "expected the leader's configuration (the same command line and the same files on "
             "each host); found another"),
            (hello["model_hash"] == ours["model_hash"],
             "expected the leader's robot and world (the same files on each host); found others"),
            ((host, hello["worker"]) not in self._workers,
             f"--host-index: expected each host once; found {host} twice"),
            (0 <= host < hosts, f"--host-index: expected 0 to {hosts - 1}; found {host}"),
        )  # fmt: skip
        return next((f"{who}: {text}" for right, text in checks if not right), "")

    # --- who does what ---

    def score(self, blocks: Sequence[np.ndarray], key: jax.Array) -> Scored:
        """See `blocks.Workplace`.

        Raises:
            WorkerError: a worker died, failed or hangs.
        """
        results: dict[int, np.ndarray] = {}
        names: list[str] = []
        first = self._number + 1
        self._number += len(blocks)
        pending = deque(range(first, self._number + 1))
        while len(results) < len(blocks):
            for worker in self._workers.values():
                if pending and worker.block is None and worker.done:
                    number = pending.popleft()
                    self._send(worker, number, blocks[number - first], key)
            for number, names_, scores in self._attend():
                if number >= first:  # an older one is from a call that was interrupted
                    results[number], names = scores, names_
        return [results[number] for number in range(first, self._number + 1)], names

    def _warm(self, worker: _Worker) -> None:
        self._send(worker, _WARM_UP, self._warm_up, jax.random.key(0))

    def _send(self, worker: _Worker, number: int, block: np.ndarray, key: jax.Array) -> None:
        data, kind = np.asarray(jax.random.key_data(key)).tolist(), str(jax.random.key_impl(key))
        order = {"type": "block", "block": number, "key": data, "kind": kind}
        with self._blaming(worker):
            worker.channel.send_message(order, block)
        worker.block, worker.age = number, 0.0

    @contextlib.contextmanager
    def _blaming(self, worker: _Worker) -> Iterator[None]:
        """Turns a broken connection into a `WorkerError` that says whose."""
        try:
            yield
        except BlockingIOError:
            raise WorkerError(f"{worker.name} hangs in the middle of a message") from None
        except (EOFError, OSError) as error:
            host, index = worker.place
            how = "its connection closed" if isinstance(error, EOFError) else str(error)
            if host == 0:
                how = self._crew.workers[index].describe_end()
            raise WorkerError(f"{worker.name} died ({how})") from None

    def _attend(self) -> list[tuple[int, list[str], np.ndarray]]:
        """Waits for news, but not for long, and takes it in.

        Returns:
            Number, measures and scores of each block that came back.
        """
        began = time.monotonic()
        sources: list[Any] = [worker.channel for worker in self._workers.values()]
        ready = wait(sources + ([self._listener] if self._listener else []), _TICK)
        # Not more, even if this process was itself stopped meanwhile: nobody else is to blame.
        waited = min(time.monotonic() - began, 2 * _TICK)
        busy = [worker for worker in self._workers.values() if worker.block is not None]
        for worker in busy:
            worker.age += waited
        news = []
        for worker in list(self._workers.values()):
            if worker.channel in ready:
                news += self._receive(worker)
        if self._listener in ready:
            self._admit()
        for worker in busy:
            if worker.block is not None:
                self._check_age(worker)
        return news

    def _receive(self, worker: _Worker) -> list[tuple[int, list[str], np.ndarray]]:
        with self._blaming(worker):
            header, scores = worker.channel.receive_message()
        if header["type"] == "failed":
            raise WorkerError(f"{worker.name} failed ({header['reason']})")
        number, worker.block = worker.block, None
        worker.done += 1
        if number == _WARM_UP:
            for other in self._workers.values():
                if other.place[0] == worker.place[0] and other.block is None and not other.done:
                    self._warm(other)
            return []
        self._times.append(worker.age)
        assert number is not None and scores is not None
        return [(number, header["measures"], scores)]

    def _check_age(self, worker: _Worker) -> None:
        limit = self._limits.later if worker.done else self._limits.first
        if worker.done and self._times:
            limit = max(limit, self._limits.factor * statistics.median(self._times))
        if worker.age > limit:
            raise WorkerError(f"{worker.name} hangs (no answer for {worker.age:.0f} s)")

    # --- the end ---

    def _stop_listening(self) -> None:
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def close(self, reason: str | None = None) -> None:
        """Ends all workers, those of other hosts by a message.

        Args:
            reason: None: all went well, and workers get time to leave. Otherwise this host's are
                killed, and the other hosts print this.
        """
        self._stop_listening()
        for worker in self._workers.values():
            with contextlib.suppress(OSError):
                worker.channel.set_patience(1.0)
                worker.channel.send_message({"type": "stop", "reason": reason or ""})
            worker.channel.close()
        self._workers.clear()
        if reason is None:
            self._crew.close()
        else:
            self._crew.close(0.0)
