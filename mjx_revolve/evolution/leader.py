"""The leader's side of a pool of workers: who is there, who does what, and who has gone silent.

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
import selectors
import socket
import statistics
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjx_revolve.evolution.crew import Crew, WorkerError
from mjx_revolve.evolution.wire import PROTOCOL, Channel, SecretError
from mjx_revolve.inputs.errors import InputError

# How long a handshake may hold the leader up, and how long any later message may take [s].
_HANDSHAKE, _MESSAGE = 5.0, 30.0
# How often it looks for what sends no news: processes that ended, time that passed [s].
_TICK = 0.25
# Number of the block that only warms a worker up.
_WARM_UP = 0


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
    """Hands out blocks to workers. Whoever makes one closes it."""

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
            identity: entries of the workers' hello that must be equal to these.
            hosts: how many there are, this one included.
            limits: how long to wait.
        """
        self._listener: socket.socket | None = listener
        self._crew = crew
        self._secret = secret
        self._identity = identity
        self._hosts = hosts
        self._limits = limits
        self._workers: dict[tuple[int, int], _Worker] = {}
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ, None)
        self._number = _WARM_UP
        self._times: deque[float] = deque(maxlen=101)
        self._warm_up: tuple[np.ndarray, list[int], str] | None = None

    # --- who is there ---

    def gather(self, rows: int, genes: int, key: list[int], kind: str) -> None:
        """Waits until all workers have reported, and has the first of each host compile.

        The others of a host with a compilation cache wait for that one and read what it compiled;
        compiling it at the same time would take all of them longer.

        Args:
            rows: of every block.
            genes: of every individual.
            key: data of a key like those that will come.
            kind: the name of its implementation.

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
        self._warm_up = np.zeros((rows, genes), np.float32), key, kind
        for worker in self._workers.values():
            if worker.place[1] == 0 or not worker.hello["cached"]:
                self._warm(worker)

    def _missing(self) -> str:
        """Which workers have not reported, in words; nothing if all have."""
        names = []
        for host in range(self._hosts):
            there = [w for place, w in self._workers.items() if place[0] == host]
            expected = len(self._crew.workers) if host == 0 else 0
            if there:
                expected = there[0].hello["workers"]
            if host and not there:
                names.append(f"host {host}")
            elif len(there) < expected:
                count = expected - len(there)
                words = f"{count} of {expected} workers"
                names.append(f"{words} of host {host}" if self._hosts > 1 else words)
        return ", ".join(names)

    def _name(self, host: int, worker: int, workers: int, node: str = "") -> str:
        name = f"worker {worker + 1} of {workers}"
        if self._hosts > 1:
            name += f" of host {host}" + (f" ({node})" if node else "")
        return name

    def _admit(self) -> None:
        """Lets one more worker in, if it is one of this run's."""
        assert self._listener is not None
        connection, address = self._listener.accept()
        channel = Channel(connection, _HANDSHAKE)
        try:
            channel.admit(self._secret)
            hello, _ = channel.receive()
            channel.set_patience(_MESSAGE)
        except (EOFError, OSError) as error:
            channel.close()
            # Whoever does not know the secret is a stranger, and must not be able to end the run.
            reason = "no worker of ours"
            if isinstance(error, SecretError):
                reason = "it has another MJX_REVOLVE_SECRET"
            peer = address[0].removeprefix("::ffff:")  # an IPv4 address on an IPv6 socket
            print(f"note: refused a connection from {peer}: {reason}", file=sys.stderr)
            return
        problem = self._check(hello)
        if problem:
            with contextlib.suppress(OSError):
                channel.send({"type": "refused", "reason": problem})
            channel.close()
            raise InputError(problem)
        name = self._name(hello["host"], hello["worker"], hello["workers"], hello["node"])
        worker = _Worker(name, channel, hello)
        self._workers[worker.place] = worker
        self._selector.register(channel, selectors.EVENT_READ, worker)
        with self._blaming(worker):
            channel.send({"type": "welcome"})

    def _check(self, hello: dict[str, Any]) -> str:
        """What is wrong with a worker, in words that its host prints, too; nothing if all is well.

        Messages name the host only where there are several.
        """
        if hello.get("protocol") != PROTOCOL:
            return (
                f"expected workers of the leader's version of mjx_revolve; found protocol "
                f"{hello.get('protocol')} rather than {PROTOCOL}"
            )
        host = hello["host"]
        who = f"host {host} ({hello['node']})" if self._hosts > 1 else f"worker {hello['worker']}"
        # This host has the same files, unless somebody is at work on them.
        versions = self._identity["versions"] if host else {}
        for package, version in versions.items():
            found = hello["versions"].get(package)
            if found != version:
                what = "source" if package == "mjx_revolve" else "version"
                return f"{who}: {package}: expected the leader's {what} {version}; found {found}"
        if hello["hosts"] != self._hosts:
            return f"{who}: --hosts: expected {self._hosts} as on host 0; found {hello['hosts']}"
        if hello["settings_hash"] != self._identity["settings_hash"]:
            return (
                f"{who}: expected the leader's configuration (the same command line and the same "
                "files on each host); found another"
            )
        if hello["model_hash"] != self._identity["model_hash"]:
            return (
                f"{who}: expected the leader's robot and world (the same files on each host); "
                "found others"
            )
        if (host, hello["worker"]) in self._workers:
            return f"{who}: --host-index: expected each host once; found {host} twice"
        if not 0 <= host < self._hosts:
            return f"{who}: --host-index: expected 0 to {self._hosts - 1}; found {host}"
        return ""

    def describe(self) -> list[dict[str, Any]]:
        """The hosts: name, CPU, XLA's flags and the number of workers of each."""
        heads = [worker for place, worker in sorted(self._workers.items()) if place[1] == 0]
        names = ("node", "cpu", "xla_flags", "workers")
        return [{name: worker.hello[name] for name in names} for worker in heads]

    # --- who does what ---

    def score(
        self, blocks: Sequence[np.ndarray], key: list[int], kind: str
    ) -> tuple[list[np.ndarray], list[str]]:
        """Scores blocks.

        Args:
            blocks: `[rows, genes]` each.
            key: the key's data.
            kind: the name of the key's implementation.

        Returns:
            `[1 + measures, rows]` scores and measures of each block, and the measures' names.

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
                    self._send(worker, number, blocks[number - first], key, kind)
            for number, names_, scores in self._attend():
                if number >= first:  # an older one is from a call that was interrupted
                    results[number], names = scores, names_
        return [results[number] for number in range(first, self._number + 1)], names

    def _warm(self, worker: _Worker) -> None:
        assert self._warm_up is not None
        self._send(worker, _WARM_UP, *self._warm_up)

    def _send(
        self, worker: _Worker, number: int, block: np.ndarray, key: list[int], kind: str
    ) -> None:
        with self._blaming(worker):
            worker.channel.send({"type": "block", "block": number, "key": key, "kind": kind}, block)
        worker.block, worker.age = number, 0.0

    @contextlib.contextmanager
    def _blaming(self, worker: _Worker) -> Iterator[None]:
        """Turns a broken connection into a `WorkerError` that says whose."""
        try:
            yield
        except TimeoutError:
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
        events = self._selector.select(_TICK)
        # Not more, even if this process was itself stopped meanwhile: nobody else is to blame.
        waited = min(time.monotonic() - began, 2 * _TICK)
        for worker in self._workers.values():
            if worker.block is not None:
                worker.age += waited
        news = []
        for event, _ in events:
            if event.data is None:
                self._admit()
            else:
                news += self._receive(event.data)
        for worker in self._workers.values():
            if worker.block is not None:
                self._check_age(worker)
        return news

    def _receive(self, worker: _Worker) -> list[tuple[int, list[str], np.ndarray]]:
        with self._blaming(worker):
            header, scores = worker.channel.receive()
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
        if worker.age <= limit:
            return
        if worker.done and self._times:
            limit = max(limit, self._limits.factor * statistics.median(self._times))
        if worker.age > limit:
            raise WorkerError(f"{worker.name} hangs (no answer for {worker.age:.0f} s)")

    # --- the end ---

    def _stop_listening(self) -> None:
        if self._listener is not None:
            self._selector.unregister(self._listener)
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
                worker.channel.send({"type": "stop", "reason": reason or ""})
            worker.channel.close()
        self._workers.clear()
        self._selector.close()
        if reason is None:
            self._crew.close()
        else:
            self._crew.close(0.0)
