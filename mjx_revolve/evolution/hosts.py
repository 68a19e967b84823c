"""Several hosts in one run: the same command line on each, told apart by its index.

    MJX_REVOLVE_SECRET=... python -m mjx_revolve.evolve CONFIG --hosts 2 --coordinator node1:7777

Host 0 leads: it runs the strategy and writes the run folder. The others build the same fitness
from the same command line, start their workers, which report to the leader, and serve until it
says to stop.
"""

from __future__ import annotations

import argparse
import ipaddress
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_revolve.evolution.crew import Crew
from mjx_revolve.evolution.wire import format_address
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import Config

SECRET = "MJX_REVOLVE_SECRET"
# Guessing eight characters over a network takes years.
_SHORTEST_SECRET = 8
# How often workers are looked after [s].
_TICK = 0.2
# Where launchers say which of a job's processes this one is: Slurm, Open MPI, MPICH and Intel MPI.
_RANKS = ("SLURM_PROCID", "OMPI_COMM_WORLD_RANK", "PMI_RANK")


@dataclass(frozen=True)
class Place:
    """This host's place in a run.

    Attributes:
        hosts: how many there are.
        index: which one this is; 0 leads.
        address: host and port where the leader listens.
        secret: what all hosts of the run know.
    """

    hosts: int
    index: int
    address: tuple[str, int]
    secret: bytes = field(repr=False)

    def listen(self) -> socket.socket:
        """Opens the leader's port: at its address if that is a number or localhost, else at all.

        A host's own name may lead to a loopback address, which the others cannot reach.

        Returns:
            The listening socket.

        Raises:
            InputError: the port is taken, or the address is not this host's.
        """
        host, port = self.address
        options: dict[str, Any] = {"backlog": 1024}
        if not _is_exact(host):
            host = ""
            if socket.has_dualstack_ipv6():
                options |= {"family": socket.AF_INET6, "dualstack_ipv6": True}
        elif ":" in host:
            options["family"] = socket.AF_INET6
        try:
            return socket.create_server((host, port), **options)
        except OSError as error:
            raise InputError(
                f"--coordinator {format_address(self.address)}: expected a free port of this host; "
                f"found: {os.strerror(error.errno) if error.errno else error}"
            ) from None

    def reach(self, listener: socket.socket) -> tuple[str, int]:
        """Where the leader's own workers find it."""
        host = self.address[0] if _is_exact(self.address[0]) else "127.0.0.1"
        return host, listener.getsockname()[1]


def _is_exact(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return host == "localhost"
    return True


def parse_workers(text: str | None) -> int | None:
    """The value of `--workers`.

    Args:
        text: as typed, or None.

    Returns:
        The number, or None.

    Raises:
        InputError: it is no number, or less than 1.
    """
    return None if text is None else _parse_number("--workers", text, 1)


def _parse_number(option: str, text: str, low: int, high: int | None = None) -> int:
    value = int(text) if text.isascii() and text.isdigit() else None
    if value is None or value < low or (high is not None and value > high):
        bounds = f">= {low}" if high is None else f"from {low} to {high}"
        raise InputError(f"{option}: expected a whole number {bounds}; found {text!r}")
    return value


def parse_place(
    arguments: argparse.Namespace, environment: Mapping[str, str] = os.environ
) -> Place | None:
    """This host's place, from `--hosts`, `--coordinator`, `--host-index` and the environment.

    Args:
        arguments: with `hosts`, `coordinator` and `host_index`, as typed.
        environment: a launcher's variables and the secret.

    Returns:
        The place, or None without `--hosts`.

    Raises:
        InputError: one of them is wrong or missing.
    """
    if arguments.hosts is None:
        for option, value in (
            ("--coordinator", arguments.coordinator),
            ("--host-index", arguments.host_index),
        ):
            if value is not None:
                raise InputError(f"{option} {value}: expected --hosts N beside it; found none")
        return None
    hosts = _parse_number("--hosts", arguments.hosts, 1)
    if arguments.coordinator is None:
        raise InputError("--hosts: expected --coordinator HOST:PORT beside it; found none")
    host, _, port = arguments.coordinator.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not (port.isascii() and port.isdigit()) or not 0 < int(port) < 65536:
        raise InputError(f"--coordinator: expected HOST:PORT; found {arguments.coordinator!r}")
    name, index = "--host-index", arguments.host_index
    if index is None:
        name = next((name for name in _RANKS if name in environment), "--host-index")
        index = environment.get(name)
    if index is None:
        raise InputError(
            f"--host-index: expected a number from 0 to {hosts - 1}, or one of {', '.join(_RANKS)} "
            "in the environment; found none"
        )
    secret = environment.get(SECRET, "")
    if len(secret) < _SHORTEST_SECRET:
        found = "a shorter one" if secret else "none"
        raise InputError(
            f"{SECRET}: expected a secret of {_SHORTEST_SECRET} or more characters, the same in "
            f"the environment of each host; found {found}"
        )
    number = _parse_number(name, index, 0, hosts - 1)
    return Place(hosts, number, (host, int(port)), secret.encode())


def _load_served_config(arguments: argparse.Namespace, settings: Sequence[str]) -> Config:
    """The leader's configuration, from the same command line."""
    from mjx_revolve.episodes.config import load_config, override_config

    if arguments.resume is not None:
        path = Path(arguments.resume) / "config.yaml"
        if path.is_file():
            return override_config(load_config(path), settings)
        if arguments.config is None:
            raise InputError(
                f"--resume {arguments.resume}: expected the run folder, or CONFIG beside it, on "
                "each host; found neither"
            )
    if arguments.config is None:
        raise InputError("expected a CONFIG, or --resume DIR; found neither")
    return load_config(arguments.config, settings)


def serve(
    arguments: argparse.Namespace,
    settings: Sequence[str],
    make_fitness: Callable[[Config], Any] | None,
    workers: int | None,
    place: Place,
    cache: Path | None,
    patience: float = 300.0,
) -> int:
    """Runs this host's workers until the leader stops them.

    Args:
        arguments: with `config` and `resume`, as typed.
        settings: what was typed to change the configuration.
        make_fitness: see `pool.make_pool`.
        workers: how many to start; None: one for each core.
        place: this host's place; not 0.
        cache: the compilation cache's folder.
        patience: how long to wait for the leader to appear [s].

    Returns:
        The exit code: 0 when the run is done, 1 when it failed, 130 or 143 when interrupted.

    Raises:
        InputError: the configuration is wrong, or the leader has another one, another program or
            another secret.
        WorkerError: workers cannot be started.
    """
    from mjx_revolve.evolution.pool import make_job, name_function

    config = _load_served_config(arguments, settings)
    make, address = name_function(make_fitness), place.address
    job = make_job(config, make, address, place.secret, cache, place.index, place.hosts, patience)
    crew = Crew(workers or runtime.usable_cores(), job)
    count = "1 worker" if len(crew.workers) == 1 else f"{len(crew.workers)} workers"
    where = format_address(address)
    print(f"host {place.index} of {place.hosts}: {count} for the leader at {where}", flush=True)
    interrupted: list[int] = []

    def interrupt(number: int, _: object) -> None:
        # Schedulers and launchers signal all processes of a job: the leader is to decide.
        interrupted.append(number)
        for each in previous:
            signal.signal(each, signal.SIG_DFL)
        os.write(2, b"\nserving until the leader stops; press Ctrl-C again to quit at once\n")

    previous: dict[int, Any] = {}
    try:
        for each in (signal.SIGINT, signal.SIGTERM):
            previous[each] = signal.signal(each, interrupt)
        return _watch(crew) or (128 + interrupted[0] if interrupted else 0)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        crew.close(0.0)


def _watch(crew: Crew) -> int:
    """Waits for the workers to end; the first that fails ends them all."""
    while True:
        codes = [worker.process.poll() for worker in crew.workers]
        if any(codes):
            break
        if None not in codes:
            return 0
        time.sleep(_TICK)
    # Of several that fail together, those that were refused know best why.
    time.sleep(_TICK)
    codes = [worker.process.poll() for worker in crew.workers]
    index = codes.index(2) if 2 in codes else next(i for i, code in enumerate(codes) if code)
    worker = crew.workers[index]
    words = worker.last_words().removeprefix("error: ")
    if codes[index] == 2:
        raise InputError(words)
    if codes[index] != 1 or not words:
        words = f"worker {index + 1} of {len(codes)} died ({worker.describe_end()})"
    print(f"error: {words}", file=sys.stderr)
    return 1
