"""Serves the page and the record behind it, in threads of its own.

Viewers pull: a slow one gets more at once, later, and a viewer that is gone leaves nothing behind.
Only the standard library is needed, and nothing is fetched from anywhere else.
"""

from __future__ import annotations

import contextlib
import json
import socket
import sys
import threading
from collections.abc import Callable, Collection
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from mr_damper_ros.live.live_record import LiveRecord

PAGE = Path(__file__).parent / "page"

FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/charts.js": ("charts.js", "text/javascript; charset=utf-8"),
    "/downloads.js": ("downloads.js", "text/javascript; charset=utf-8"),
    "/style.css": ("style.css", "text/css; charset=utf-8"),
    "/uplot.js": ("vendor/uplot/uPlot.iife.min.js", "text/javascript; charset=utf-8"),
    "/uplot.css": ("vendor/uplot/uPlot.min.css", "text/css; charset=utf-8"),
    "/uplot-licence.txt": ("vendor/uplot/LICENSE", "text/plain; charset=utf-8"),
}
"""All that is served from disk, by address."""

CONNECTIONS = 64
"""At once, of all viewers together; a browser opens up to six."""

_IDLE = 30.0
"""Seconds after which a connection that nothing passes through is closed."""

_LONGEST_COMMAND = 1000

_LOCAL = {"localhost", "127.0.0.1", "::1"}

_SECURITY = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; "
    "style-src 'self' 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


def is_local(host: str) -> bool:
    """Whether only this computer reaches what is served at such an address."""
    return host in _LOCAL


Command = Callable[[str], bool]
"""Takes the name of a command; whether there was room for it."""


class PageServer:
    """The page of a record at ``address``; port 0 takes any that is free.

    ``commands`` are the names that POST /command accepts and hands to ``command``; without
    any the page is read-only. Raises OSError where the port cannot be had.
    """

    def __init__(
        self,
        record: LiveRecord,
        host: str,
        port: int,
        title: str = "",
        commands: Collection[str] = (),
        command: Command = lambda _: False,
    ) -> None:
        page = _Page(record, is_local(host), title, tuple(commands), command)

        class Handler(_Handler):
            served = page

        self._server = _Server((host, port), Handler)
        shown = f"[{host}]" if ":" in host else host
        self.address = f"http://{shown}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop serving; viewers see that the page is gone."""
        self._server.shutdown()
        self._server.server_close()
        self._server.hang_up()
        self._thread.join()


class _Page:
    """What all connections share."""

    def __init__(
        self,
        record: LiveRecord,
        local: bool,
        title: str,
        commands: tuple[str, ...],
        command: Command,
    ) -> None:
        self.record = record
        self.local = local
        self.title = title
        self.commands = commands
        self.command = command
        self.files = {
            path: ((PAGE / name).read_bytes(), kind) for path, (name, kind) in FILES.items()
        }


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 32

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self._free = threading.BoundedSemaphore(CONNECTIONS)
        self._open: set[socket.socket] = set()
        super().__init__(address, handler)

    def server_bind(self) -> None:
        # The library's own looks the host's name up, which may take long without a network.
        socket_address = self.server_address
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(socket_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        self._open.add(request)
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._open.discard(request)
            self._free.release()

    def hang_up(self) -> None:
        """End all connections: their viewers would go on asking."""
        for request in list(self._open):
            with contextlib.suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say what went wrong; that a viewer has left in the midst of an answer is no fault."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    wbufsize = 1 << 16  # head and body go together
    timeout = _IDLE
    served: _Page

    def do_GET(self) -> None:
        """Serve a file of the page, the status or rows of a table."""
        if not self._is_for_this_host():
            return
        path, query = self._address()
        record = self.served.record
        if path in self.served.files:
            body, kind = self.served.files[path]
            self._answer(HTTPStatus.OK, body, kind)
        elif path == "/status":
            fixed = {"title": self.served.title, "commands": self.served.commands}
            status = record.status(_number(query, "windows", 0))
            body = json.dumps(fixed).encode()[:-1] + b"," + status[1:]
            self._answer(HTTPStatus.OK, body, "application/json")
        elif path.startswith("/tables/"):
            name = path.removeprefix("/tables/")
            rows = record.rows(name, _number(query, "after", -1), _number(query, "generation", -1))
            if rows is None:
                self._answer(HTTPStatus.NO_CONTENT)
                return
            self._answer(
                HTTPStatus.OK,
                rows.values.astype("<f8", copy=False).tobytes(),
                "application/octet-stream",
                {"X-Generation": str(rows.generation), "X-Columns": ",".join(rows.columns)},
            )
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "there is nothing here")

    def do_POST(self) -> None:
        """Take a command, from this page alone."""
        length = _length(self.headers.get("Content-Length"))
        # What is not read would be taken for the next request; closing on it would lose the answer.
        self.close_connection = True
        body = self.rfile.read(min(length, _LONGEST_COMMAND + 1))
        if not self._is_for_this_host():
            return
        origin = self.headers.get("Origin", "")
        if urlsplit(origin).netloc != self.headers.get("Host", ""):
            self._refuse(HTTPStatus.FORBIDDEN, "commands are taken from the page itself alone")
        elif self._address()[0] != "/command" or not self.served.commands:
            self._refuse(HTTPStatus.FORBIDDEN, "the page is read-only: allow_commands is not set")
        elif not 0 < length <= _LONGEST_COMMAND:
            self._refuse(HTTPStatus.BAD_REQUEST, "a command is a few letters")
        else:
            name = body.decode("utf-8", "replace")
            if name not in self.served.commands:
                known = ", ".join(self.served.commands)
                self._refuse(HTTPStatus.BAD_REQUEST, f"the commands are {known}")
            elif not self.served.command(name):
                self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, "too many commands wait already")
            else:
                self._answer(HTTPStatus.ACCEPTED)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing: thirty requests a second are no news."""

    def _address(self) -> tuple[str, dict[str, list[str]]]:
        parts = urlsplit(self.path)
        return parts.path, parse_qs(parts.query)

    def _is_for_this_host(self) -> bool:
        """Refuse what a page from elsewhere asks by a name that it has made point here."""
        host = self.headers.get("Host", "")
        if not self.served.local or urlsplit(f"//{host}").hostname in _LOCAL:
            return True
        self._refuse(HTTPStatus.FORBIDDEN, "this page is served as localhost alone")
        return False

    def _refuse(self, status: HTTPStatus, sentence: str) -> None:
        self._answer(status, f"{sentence}\n".encode(), "text/plain; charset=utf-8")

    def _answer(
        self,
        status: HTTPStatus,
        body: bytes = b"",
        kind: str = "",
        extra: dict[str, str] | None = None,
    ) -> None:
        self.send_response_only(status)
        for name, value in {**_SECURITY, **(extra or {})}.items():
            self.send_header(name, value)
        if kind:
            self.send_header("Content-Type", kind)
        if self.close_connection:
            self.send_header("Connection", "close")
        if status != HTTPStatus.NO_CONTENT:
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)


def _number(query: dict[str, list[str]], name: str, default: int) -> int:
    try:
        return int(query[name][0])
    except (KeyError, ValueError):
        return default


def _length(text: str | None) -> int:
    return int(text) if text and text.isdigit() else 0
