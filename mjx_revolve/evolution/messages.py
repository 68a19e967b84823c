"""Messages between the process that leads a run and its workers, on one host or on several.

A message is a line of JSON and, where there are numbers, one float32 array after it; the standard
library's `Connection` frames it. No pickle: what comes in is data, never code. Both sides prove
that they know the run's secret before anything else is read, by HMAC-SHA256 over both sides' random
numbers (the library's own handshake rests on MD5 before Python 3.12, which hardened hosts refuse).
What follows is neither encrypted nor signed: the network between the hosts of a run is trusted, as
it is with MPI.
"""

from __future__ import annotations

import hmac
import json
import os
import socket
import struct
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

# Raised whenever messages change their meaning.
PROTOCOL = 2
# The longest message [bytes]: a block is [rows, genes] float32.
_LONGEST = 1 << 30
_NONCE = 32
# A connection whose other end is silent for a minute, not even answering the kernel, is dead [s].
_KEEPALIVE = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}


class SecretError(ConnectionError):
    """The other side does not know the secret."""


class Channel(Connection):
    """One end of a connection. No wait for bytes is longer than its patience."""

    def __init__(self, made: socket.socket, patience: float) -> None:
        """Takes a socket over.

        Args:
            made: a connected socket; this object closes it.
            patience: see `set_patience`.
        """
        made.settimeout(None)  # waits are bounded by the system, below the reads of `Connection`
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE.items():
            if hasattr(socket, name):  # not every system has every one
                made.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        super().__init__(made.detach())
        self.set_patience(patience)

    def set_patience(self, seconds: float | None) -> None:
        """How long the next bytes may take from now on; None: for ever.

        Beyond it, whatever sends or receives raises `BlockingIOError`.
        """
        whole, part = divmod(seconds or 0.0, 1.0)
        limit = struct.pack("@ll", int(whole), int(1e6 * part))
        held = socket.socket(fileno=self.fileno())
        held.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
        held.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
        held.detach()

    def send_message(self, header: dict[str, Any], array: np.ndarray | None = None) -> None:
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
        self.send_bytes(json.dumps(header).encode() + b"\n" + body)

    def receive_message(self) -> tuple[dict[str, Any], np.ndarray | None]:
        """Receives a message.

        Returns:
            Its header and its array, if it has one.

        Raises:
            EOFError: the other end closed the connection.
            OSError: it takes too long, or speaks another language.
        """
        import numpy as np

        head, _, body = self.recv_bytes(_LONGEST).partition(b"\n")
        try:
            header = json.loads(head)
            shape = header.pop("shape", None)
            array = None if shape is None else np.frombuffer(body, "<f4").reshape(shape)
        except (ValueError, TypeError, AttributeError) as error:
            raise ConnectionError(f"expected one of our messages; found: {error}") from None
        return header, array

    def prove_secret(self, secret: bytes, leads: bool) -> None:
        """The handshake: each side proves that it knows the secret, the worker first.

        Args:
            secret: of the run.
            leads: whether this is the leader's side.

        Raises:
            SecretError: the other side has another one.
            EOFError: it went away.
            OSError: it takes too long, or speaks another language.
        """
        ours = os.urandom(_NONCE)
        self.send_bytes(ours)
        theirs = self.recv_bytes(_NONCE)
        numbers = ours + theirs if leads else theirs + ours
        # The role keeps one side's proof from being played back as the other's.
        proofs = [hmac.digest(secret, role + numbers, "sha256") for role in (b"worker", b"leader")]
        if not leads:
            self.send_bytes(proofs[0])
        try:
            known = hmac.compare_digest(self.recv_bytes(_NONCE), proofs[0 if leads else 1])
        except (EOFError, ConnectionError):
            if leads:
                raise
            known = False  # what the leader does with a wrong proof
        if not known or len(theirs) != _NONCE:
            raise SecretError("it has another secret")
        if leads:
            self.send_bytes(proofs[1])


def format_address(address: tuple[Any, ...]) -> str:
    """`HOST:PORT` of a socket's address; IPv6 in brackets."""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
