"""Web server of the live page and its record, in separate threads.

Viewers request new data regularly. A slow viewer receives more data with each request, and no data
is stored for a disconnected viewer. The server needs only the standard library. The page loads
nothing from other servers.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Collection, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from ipaddress import ip_address
from pathlib import Path
from socketserver import ThreadingTCPServer
from typing import Any
from urllib.parse import parse_qs

from mr_damper_ros.live.live_record import LiveRecord
from mr_damper_ros.tracking.acceptance import Verdict

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
"""Files that are served from disk, by URL path: name and media type."""

CONNECTIONS = 64
"""Largest number of simultaneous connections; a browser opens up to six."""

CONNECTIONS_EACH = 24
"""Largest number of simultaneous connections of one client, so that others can connect."""

_IDLE = 30.0
"""Time limit [s] for the next request of a connection, and for an answer."""

_REQUEST = 5.0
"""Longest time [s] from the first byte of a request to the last."""

_LONGEST_BODY = 1000
_LARGEST_REJECTED_BODY = 1 << 16
"""Largest number of bytes read from a rejected body. If a connection is closed with unread bytes,
the answer is lost."""

LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})
"""Hosts to which only this computer can connect."""


_NETLOC = re.compile(r"(?:\[([0-9A-Fa-f:.]+(?:%[\w.-]+)?)\]|([\w.-]+))(?::[0-9]{1,5})?", re.ASCII)
_WHOLE_NUMBER = re.compile(r"-?[0-9]{1,15}", re.ASCII)

_VERDICTS = {int(verdict): verdict.name.lower().replace("_", " ") for verdict in Verdict}
"""Verdicts in words, by their codes in the table ``windows``."""

_SECURITY = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; "
    "style-src 'self' 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


def host_of(netloc: str) -> str:
    """The normalised name or address in ``HOST`` or ``HOST:PORT``.

    Raises ValueError if it is neither a name nor an address.
    """
    found = _NETLOC.fullmatch(netloc)
    if found is None:
        raise ValueError(f"{netloc!r} is neither a name nor an address")
    return _spelling(found[1] or found[2])


def _spelling(host: str) -> str:
    try:
        address = ip_address(host.partition("%")[0])
    except ValueError:
        return host.lower().rstrip(".")
    return str(getattr(address, "ipv4_mapped", None) or address)


Command = Callable[[str, Mapping[str, str]], bool]
"""Handler of a command; receives its name and arguments, returns False if the queue is full."""


class PageServer(ThreadingTCPServer):  # an HTTPServer looks up its name, slow without a network
    """Serves the page of a record at ``address``; port 0 selects a free port.

    The server answers only requests to the names of this computer, to the address of the connection
    and to ``allowed_hosts``. This protects against DNS rebinding, by which another site points its
    own name to this computer. POST /command accepts the names in ``commands`` and passes them to
    ``command``; without commands, the page is read-only.

    Raises OSError if the port is not available, and ValueError if an allowed host is neither a name
    nor an address.
    """

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    request_queue_size = 32

    def __init__(
        self,
        record: LiveRecord,
        host: str,
        port: int,
        title: str = "",
        commands: Collection[str] = (),
        command: Command = lambda *_: False,
        allowed_hosts: Collection[str] = (),
    ) -> None:
        self.record, self.title = record, title
        self.commands, self.command = tuple(commands), command
        name = _spelling(socket.gethostname())
        short = name.partition(".")[0]
        own = {*LOCAL, name, short, f"{short}.local", _spelling(host)}
        self.hosts = own | {host_of(name) for name in allowed_hosts}
        self.files = {
            path: ((PAGE / name).read_bytes(), kind) for path, (name, kind) in FILES.items()
        }
        # Address of each client, and the deadline [s] of its present action.
        self._open: dict[socket.socket, tuple[str, float]] = {}
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((host, port), _Handler)
        everywhere = host in ("0.0.0.0", "::")
        shown = socket.gethostname() if everywhere else f"[{host}]" if ":" in host else host
        self.address = f"http://{shown}:{self.server_address[1]}/"
        self._thread = threading.Thread(
            target=self.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop the server and close all connections."""
        self.shutdown()
        self.server_close()
        self._hang_up(math.inf)
        self._thread.join()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Accept a connection, unless there are too many."""
        address = _spelling(client_address[0])
        shared = sum(known == address for known, _ in list(self._open.values()))
        if len(self._open) >= CONNECTIONS or shared >= CONNECTIONS_EACH:
            self.shutdown_request(request)
            return
        self._open[request] = address, time.monotonic() + _IDLE
        super().process_request(request, client_address)

    def grant(self, request: socket.socket, seconds: float) -> None:
        """Extend the deadline of a connection to ``seconds`` from now."""
        if request in self._open:
            self._open[request] = self._open[request][0], time.monotonic() + seconds

    def service_actions(self) -> None:
        """Close connections past their deadline; called ten times a second."""
        self._hang_up(time.monotonic())

    def shutdown_request(self, request: Any) -> None:
        """End a connection."""
        self._open.pop(request, None)
        super().shutdown_request(request)

    def _hang_up(self, now: float) -> None:
        for request, (_, deadline) in list(self._open.items()):
            if deadline < now:
                with contextlib.suppress(OSError):
                    request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error; a viewer that disconnects during an answer is not an error."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _RequestError(Exception):
    """A rejected request, with the HTTP status and a sentence for the client."""

    def __init__(self, sentence: str, status: HTTPStatus = HTTPStatus.BAD_REQUEST) -> None:
        super().__init__(sentence)
        self.status = status


class _Handler(BaseHTTPRequestHandler):
    protocol_version = default_request_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    wbufsize = 1 << 16  # headers and body are sent together
    server: PageServer

    def handle_one_request(self) -> None:
        """Wait for a request and handle it within its time limit."""
        self.close_connection = True
        self.server.grant(self.connection, _IDLE)
        if self.rfile.peek(1):  # type: ignore[attr-defined]
            self.server.grant(self.connection, _REQUEST)
            super().handle_one_request()

    def do_GET(self) -> None:
        """Serve a file of the page, the status or rows of a table, or take what the page posts."""
        try:
            body = self._body()
            self._check_host()
            if self.command == "POST":
                self._take_post(body)
            else:
                self._read()
        except _RequestError as error:
            self._refuse(error.status, str(error))

    do_POST = do_GET  # noqa: N815  # http.server looks for this name

    def _read(self) -> None:
        (path, query), page = self._target(), self.server
        if path in page.files:
            content, kind = page.files[path]
            self._answer(HTTPStatus.OK, content, kind)
        elif path == "/status":
            status = {
                "title": page.title,
                "commands": page.commands,
                "verdicts": _VERDICTS,
                **page.record.status(_number(query, "windows", 0), _number(query, "marks", 0)),
            }
            content = json.dumps(status, separators=(",", ":"), allow_nan=False).encode()
            self._answer(HTTPStatus.OK, content, "application/json")
        elif path.startswith("/tables/"):
            name = path.removeprefix("/tables/")
            rows = page.record.rows(
                name, _number(query, "after", -1), _number(query, "generation", -1)
            )
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
            raise _RequestError("there is nothing here", HTTPStatus.NOT_FOUND)

    def _take_post(self, body: bytes) -> None:
        """Accept a command or an acknowledgement of faults, only from this page."""
        self._check_origin()
        (path, query), page = self._target(), self.server
        if path == "/seen":
            page.record.acknowledge(_number({"fault": [body.decode("latin-1")]}, "fault", 0))
            self._answer(HTTPStatus.NO_CONTENT)
            return
        if path != "/command" or not page.commands:
            raise _RequestError(
                "the page is read-only: allow_commands is not set", HTTPStatus.FORBIDDEN
            )
        name = body.decode("utf-8", "replace")
        if name not in page.commands:
            raise _RequestError(f"the commands are {', '.join(page.commands)}")
        if not page.command(name, {key: values[0] for key, values in query.items()}):
            raise _RequestError("too many commands are waiting", HTTPStatus.SERVICE_UNAVAILABLE)
        self._answer(HTTPStatus.ACCEPTED)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing, because there are thirty requests a second."""

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Send the error that the base class found in a request."""
        status = HTTPStatus(code)
        self.close_connection = True
        self._refuse(status, message or explain or status.phrase)

    def _target(self) -> tuple[str, dict[str, list[str]]]:
        path, _, query = self.path.partition("?")
        if not path.startswith("/"):
            raise _RequestError(f"the target {path!r} of the request does not begin with a slash")
        return path, parse_qs(query)

    def _body(self) -> bytes:
        lengths = self.headers.get_all("Content-Length", ["0"])
        if len(lengths) > 1 or not _WHOLE_NUMBER.fullmatch(lengths[0]) or int(lengths[0]) < 0:
            raise _RequestError(
                f"Content-Length must be one whole number, not {', '.join(lengths)!r}"
            )
        if "Transfer-Encoding" in self.headers:
            raise _RequestError("a body needs a Content-Length, and no Transfer-Encoding")
        body = self.rfile.read(min(int(lengths[0]), _LARGEST_REJECTED_BODY))
        if int(lengths[0]) > _LONGEST_BODY:
            raise _RequestError(f"a body may have at most {_LONGEST_BODY} bytes, not {lengths[0]}")
        return body

    def _check_host(self) -> None:
        """Reject requests with a foreign host name (DNS rebinding)."""
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1:
            raise _RequestError(f"a request must have one Host, not {len(hosts)}")
        host = _host_in("Host", hosts[0])
        own = _spelling(self.connection.getsockname()[0])
        if host not in self.server.hosts and host != own:
            raise _RequestError(
                f"the page is not served as {host}: use localhost, or the name or address of "
                "the computer that it runs on, or add this name to the parameter allowed_hosts",
                HTTPStatus.FORBIDDEN,
            )

    def _check_origin(self) -> None:
        """Reject commands from pages of other sites; requires :meth:`_check_host` first."""
        origin = self.headers.get("Origin", "")
        scheme, _, netloc = origin.partition("://")
        if origin not in ("", "null"):
            _host_in("Origin", netloc)
        if scheme not in ("http", "https") or netloc.lower() != self.headers["Host"].lower():
            raise _RequestError(
                "commands are accepted only from the page itself", HTTPStatus.FORBIDDEN
            )

    def _refuse(self, status: HTTPStatus, sentence: str) -> None:
        # The connection is closed, because further bytes may belong to the malformed request.
        self.close_connection |= status == HTTPStatus.BAD_REQUEST
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


def _host_in(header: str, netloc: str) -> str:
    try:
        return host_of(netloc)
    except ValueError as error:
        raise _RequestError(f"{header}: {error}") from None


def _number(query: dict[str, list[str]], name: str, default: int) -> int:
    text = query.get(name, [str(default)])[0]
    if not _WHOLE_NUMBER.fullmatch(text):
        raise _RequestError(f"{name} must be a whole number, not {text!r}")
    return int(text)
