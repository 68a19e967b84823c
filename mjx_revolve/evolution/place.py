"""A host's place among several in one run: how many, which one, where the leader is, the secret."""

from __future__ import annotations

import argparse
import ipaddress
import os
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from mjx_revolve.evolution.messages import format_address
from mjx_revolve.inputs.commands import whole
from mjx_revolve.inputs.errors import InputError

SECRET = "MJX_REVOLVE_SECRET"
# Guessing eight characters over a network takes years.
_SHORTEST_SECRET = 8
# Where launchers say which of a job's processes this one is: Slurm, Open MPI, MPICH and Intel MPI.
RANKS = ("SLURM_PROCID", "OMPI_COMM_WORLD_RANK", "PMI_RANK")


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

    def seen_from_here(self, listener: socket.socket) -> Place:
        """The same, with the address at which the leader's own workers find it."""
        host = self.address[0] if _is_exact(self.address[0]) else "127.0.0.1"
        return replace(self, address=(host, listener.getsockname()[1]))


def alone() -> Place:
    """The place of a host that works alone."""
    return Place(1, 0, ("127.0.0.1", 0), secrets.token_hex(32).encode())


def _is_exact(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return host == "localhost"
    return True


def read_place(
    hosts: int | None,
    coordinator: str | None,
    host_index: str | None,
    environment: Mapping[str, str] = os.environ,
) -> Place | None:
    """This host's place, from what was typed and the environment.

    Args:
        hosts: the value of `--hosts`; None: a single host.
        coordinator: the value of `--coordinator`.
        host_index: the value of `--host-index`; None: the launcher's rank.
        environment: a launcher's variables and the secret.

    Returns:
        The place, or None without `--hosts`.

    Raises:
        InputError: one of them is wrong or missing.
    """
    if hosts is None:
        for option, value in (("--coordinator", coordinator), ("--host-index", host_index)):
            if value is not None:
                raise InputError(f"{option} {value}: expected --hosts N beside it; found none")
        return None
    if coordinator is None:
        raise InputError("--hosts: expected --coordinator HOST:PORT beside it; found none")
    host, _, port = coordinator.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not (port.isascii() and port.isdigit()) or not 0 < int(port) < 65536:
        raise InputError(f"--coordinator: expected HOST:PORT; found {coordinator!r}")
    name, index = "--host-index", host_index
    if index is None:
        name = next((name for name in RANKS if name in environment), name)
        index = environment.get(name)
    if index is None:
        raise InputError(
            f"--host-index: expected a number from 0 to {hosts - 1}, or one of {', '.join(RANKS)} "
            "in the environment; found none"
        )
    secret = environment.get(SECRET, "")
    if len(secret) < _SHORTEST_SECRET:
        found = "a shorter one" if secret else "none"
        raise InputError(
            f"{SECRET}: expected a secret of {_SHORTEST_SECRET} or more characters, the same in "
            f"the environment of each host; found {found}"
        )
    try:
        number = whole(0, hosts - 1)(index)
    except argparse.ArgumentTypeError as error:
        raise InputError(f"{name}: {error}") from None
    return Place(hosts, number, (host, int(port)), secret.encode())
