"""A small HTTP server, for this machine alone: one page, a stream of events, and commands.

The page's address is enough to watch and to post commands: it holds a random token, and is printed
for the user only. Other web pages in the user's browser do not have it; what they post all the same
is refused by its `Origin`, as are requests to another name of this machine (`Host`).
"""

from __future__ import annotations

import json
import queue
import secrets
import threading
from concurrent.futures import TimeoutError as NotYet
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NoReturn

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.live.commands import read_command
from mjx_revolve.view.live.simulation import LiveSimulation

HOST = "127.0.0.1"
_MAX_CONTENT = 4096  # of what is posted [bytes]
# Connections at once, of which a browser opens six at most; and how long one of them may be idle,
# or leave unread what is sent to it [s]. Choices.
_MAX_CONNECTIONS, _MAX_IDLE = 32, 20.0
_ANSWER_TIMEOUT = 1.5  # for an answer; the page shows that a longer one is under way [s]
_BEAT = 0.5  # from one state event to the next, at least [s]
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",  # the address is a secret
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class LiveServer(ThreadingHTTPServer):
    """Serves a running world.

    Attributes:
        simulation: runs the world.
        page: the text of the page.
        token: what all paths begin with.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, simulation: LiveSimulation, page: str, port: int = 0) -> None:
        super().__init__((HOST, port), _Handler)
        self.simulation, self.page = simulation, page.encode()
        self.token = secrets.token_urlsafe(16)
        self.closing = threading.Event()
        self._room = threading.Semaphore(_MAX_CONNECTIONS)

    def process_request(self, request: Any, client_address: object) -> None:
        """Answers in a thread of its own, as long as there are not too many."""
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            with suppress(OSError):
                request.sendall(b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\n\r\n")
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: object) -> None:
        """Answers, and makes room for another connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    @property
    def origins(self) -> tuple[str, ...]:
        """The server's addresses in a browser's `Origin` header."""
        port = self.server_address[1]
        end = "" if port == 80 else f":{port}"  # browsers leave out the usual one
        return tuple(f"http://{name}{end}" for name in (HOST, "localhost"))

    @property
    def address(self) -> str:
        """Of the page."""
        return f"{self.origins[0]}/{self.token}/"

    def handle_error(self, request: object, client_address: object) -> None:
        """Logs no pages that were closed."""


class _Handler(BaseHTTPRequestHandler):
    server: LiveServer
    protocol_version = "HTTP/1.1"
    timeout = _MAX_IDLE
    server_version, sys_version = "mjx_revolve", ""

    def log_message(self, format: str, *args: object) -> None:
        """Logs no requests."""

    def do_GET(self) -> None:
        place = self._place()
        if place == "" and not self.path.endswith("/"):
            # The page's files are beside it.
            there = f"/{self.server.token}/"
            self._send(b"", "text/plain", HTTPStatus.PERMANENT_REDIRECT, Location=there)
        elif place == "":
            self._send(self.server.page, "text/html; charset=utf-8")
        elif place == "events":
            self._stream()
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "expected the page's own address; found another")

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        size = int(length) if length.isascii() and length.isdigit() and len(length) < 9 else -1
        if not 0 <= size <= _MAX_CONTENT:
            self.close_connection = True
            why = f"expected at most {_MAX_CONTENT} bytes; found others"
            self._refuse(HTTPStatus.BAD_REQUEST, why)
            return
        text = self.rfile.read(size)
        origin, kind = self.headers.get("Origin"), self.headers.get_content_type()
        if self._place() != "command":
            self._refuse(HTTPStatus.NOT_FOUND, "expected the page's own address; found another")
        elif origin is not None and origin not in self.server.origins:
            self._refuse(HTTPStatus.FORBIDDEN, f"Origin: expected our own page; found {origin!r}")
        elif kind != "application/json":  # what another page may post without asking first
            why = f"expected application/json; found {kind}"
            self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, why)
        else:
            self._obey(text)

    def _obey(self, text: bytes) -> None:
        """Does what was posted, and answers."""
        try:
            command = read_command(_read_json(text))
            answer = self.server.simulation.ask(command).result(_ANSWER_TIMEOUT)
        except NotYet:
            self._send(b'{"ok":true,"later":true}', "application/json", HTTPStatus.ACCEPTED)
        except InputError as error:
            self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        else:
            self._send(json.dumps({"ok": True, "key": answer}).encode(), "application/json")

    def _place(self) -> str | None:
        """The path after the token; None where the token or the host is wrong."""
        hosts = {origin.removeprefix("http://") for origin in self.server.origins}
        first, _, rest = self.path.lstrip("/").partition("/")
        known = secrets.compare_digest(first.encode(), self.server.token.encode())
        return rest if known and self.headers.get("Host") in hosts else None

    def _stream(self) -> None:
        """Events until the page is closed, or the world ends."""
        simulation = self.server.simulation
        self.close_connection = True
        self._head(HTTPStatus.OK, "text/event-stream")
        listener = simulation.listen()
        try:
            while not self.server.closing.is_set():
                try:
                    text = listener.get(timeout=_BEAT)
                except queue.Empty:
                    text = simulation.state_event()
                if text is None:
                    break
                self.wfile.write(text.encode())
                self.wfile.flush()
        except OSError:  # the page was closed
            pass
        finally:
            simulation.leave(listener)

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self._send(json.dumps({"error": why}).encode(), "application/json", status)

    def _send(
        self, content: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK, **headers: str
    ) -> None:
        with suppress(OSError):
            self._head(status, kind, **{"Content-Length": str(len(content)), **headers})
            self.wfile.write(content)

    def _head(self, status: HTTPStatus, kind: str, **headers: str) -> None:
        self.send_response(status)
        for name, value in {**_HEADERS, "Content-Type": kind, **headers}.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()


def _read_json(text: bytes) -> Any:
    """What was posted.

    Raises:
        InputError: it is no JSON.
    """
    try:
        return json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"expected JSON; found none: {reason}") from None


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number of JSON")
