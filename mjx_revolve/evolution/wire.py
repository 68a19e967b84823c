"""Messages between the process that leads a run and its workers, on one host or on several.

A message is a small JSON header and, where there are numbers, one float32 array. No pickle: what
comes in is data, never code. Both sides prove that they know the run's secret before anything else
is read (HMAC-SHA256 over both sides' random numbers; the standard library's own handshake rests on
MD5 before Python 3.12, which hardened hosts refuse). What follows is neither encrypted nor signed:
the network between the hosts of a run is trusted, as it is with MPI.

Every wait is bounded, so that nobody can keep anybody for ever.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import socket
import struct
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

# Raised whenever messages change their meaning.
PROTOCOL = 1
# Lengths of a message's header and of its array [bytes].
_LENGTHS = struct.Struct("!II")
# A header is a few hundred bytes; the array of a block is [rows, genes] float32.
_MAX_HEADER, _MAX_ARRAY = 1 << 20, 1 << 30
_NONCE = 32
# A connection whose other end is silent for a minute, not even answering the kernel, is dead [s].
_KEEPALIVE = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}


class SecretError(ConnectionError):
    """The other side does not know the secret."""


class Channel:
    """One end of a connection; each message is sent and received within `patience` seconds."""

    def __init__(self, connection: socket.socket, patience: float) -> None:
        self._socket = connection
        self.set_patience(patience)
        self._option(socket.IPPROTO_TCP, "TCP_NODELAY", 1)
        self._option(socket.SOL_SOCKET, "SO_KEEPALIVE", 1)
        for name, value in _KEEPALIVE.items():
            self._option(socket.IPPROTO_TCP, name, value)

    def _option(self, level: int, name: str, value: int) -> None:
        if hasattr(socket, name):  # not every system has every one
            self._socket.setsockopt(level, getattr(socket, name), value)

    def set_patience(self, seconds: float | None) -> None:
        """How long a message may take from now on; None: for ever."""
        self._socket.settimeout(seconds)

    def fileno(self) -> int:
        """For selectors."""
        return self._socket.fileno()

    @property
    def peer(self) -> str:
        """The other end's address."""
        return format_address(self._socket.getpeername())

    def send(self, header: dict[str, Any], array: np.ndarray | None = None) -> None:
        """Sends a message.

        Args:
            header: plain values; `type` says what it is.
            array: numbers to go with it; any shape.

        Raises:
            OSError: the other end is gone, or takes too long.
        """
        body = b""
        if array is not None:
            header = header | {"shape": array.shape}
            body = array.astype("<f4").tobytes()
        head = json.dumps(header).encode()
        self._socket.sendall(_LENGTHS.pack(len(head), len(body)) + head + body)

    def receive(self) -> tuple[dict[str, Any], np.ndarray | None]:
        """Receives a message.

        Returns:
            Its header and its array, if it has one.

        Raises:
            EOFError: the other end closed the connection.
            OSError: it takes too long, or speaks another language.
        """
        sizes = _LENGTHS.unpack(self._read(_LENGTHS.size))
        if sizes[0] > _MAX_HEADER or sizes[1] > _MAX_ARRAY:
            raise ConnectionError(f"expected one of our messages from {self.peer}; found another")
        import numpy as np

        try:
            header = json.loads(self._read(sizes[0]))
            body = self._read(sizes[1])
            array = None
            if "shape" in header:
                array = np.frombuffer(body, "<f4").reshape(header.pop("shape"))
            return header, array
        except (ValueError, TypeError) as error:
            raise ConnectionError(f"expected one of our messages; found: {error}") from None

    def _read(self, size: int) -> bytes:
        chunks = bytearray()
        while len(chunks) < size:
            chunk = self._socket.recv(size - len(chunks))
            if not chunk:
                raise EOFError
            chunks += chunk
        return bytes(chunks)

    def close(self) -> None:
        """Ends the connection."""
        self._socket.close()

    def admit(self, secret: bytes) -> None:
        """The leader's part of the handshake.

        Args:
            secret: of the run.

        Raises:
            SecretError: the worker has another one.
            EOFError: it went away.
            OSError: it takes too long.
        """
        ours = os.urandom(_NONCE)
        self._socket.sendall(ours)
        theirs = self._read(_NONCE)
        proof = self._read(hashlib.sha256().digest_size)
        if not hmac.compare_digest(proof, _proof(secret, b"worker", ours, theirs)):
            raise SecretError("it has another secret")
        self._socket.sendall(_proof(secret, b"leader", ours, theirs))

    def introduce(self, secret: bytes) -> None:
        """The worker's part of the handshake; raises as `admit`."""
        theirs = self._read(_NONCE)
        ours = os.urandom(_NONCE)
        self._socket.sendall(ours + _proof(secret, b"worker", theirs, ours))
        try:
            proof = self._read(hashlib.sha256().digest_size)
        except (EOFError, ConnectionError):  # what `admit` does with a wrong proof
            raise SecretError("it has another secret") from None
        if not hmac.compare_digest(proof, _proof(secret, b"leader", theirs, ours)):
            raise SecretError("it has another secret")


def _proof(secret: bytes, role: bytes, leader: bytes, worker: bytes) -> bytes:
    # The role keeps one side's proof from being played back as the other's.
    return hmac.digest(secret, role + leader + worker, "sha256")


def format_address(address: tuple[Any, ...]) -> str:
    """`HOST:PORT` of a socket's address; IPv6 in brackets."""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
