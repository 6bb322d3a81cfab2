"""Web server of the live page and its record, in a thread with its own event loop.

Viewers request new data regularly. A slow viewer receives more data with each request, and no data
is stored for a disconnected viewer. The page loads nothing from other servers.
"""

from __future__ import annotations

import asyncio
import json
import re
import socket
import threading
from collections.abc import Callable, Collection, Mapping
from ipaddress import ip_address
from pathlib import Path
from typing import cast

from aiohttp import web
from aiohttp.typedefs import Handler

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
"""Time limit [s] for an answer and the next request of a connection."""

_REQUEST = 5.0
"""Longest time [s] from the first byte of a request to the last."""

_LONGEST_BODY = 1000
"""Largest number of bytes in the body of a request."""

_RECEIVED = 1 << 15
"""Largest number of bytes received through one connection, which limits the memory for requests.

After half of them, the server asks the client to continue with another connection.
"""

LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})
"""Hosts to which only this computer can connect."""

_NETLOC = re.compile(r"(?:\[([0-9A-Fa-f:.]+(?:%[\w.-]+)?)\]|([\w.-]+))(?::[0-9]{1,5})?", re.ASCII)
_WHOLE_NUMBER = re.compile(r"-?[0-9]{1,15}", re.ASCII)

_VERDICTS = {int(verdict): verdict.name.lower().replace("_", " ") for verdict in Verdict}
"""Verdicts in words, by their codes in the table ``windows``."""

_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; "
    "style-src 'self' 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Server": "mr_damper_ros",
}
"""Headers of every answer."""


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


class PageServer:
    """Serves the page of a record at ``address``; port 0 selects a free port.

    The server answers only requests to the names of this computer, to the address of the connection
    and to ``allowed_hosts``. This protects against DNS rebinding, by which another site points its
    own name to this computer. POST /command accepts the names in ``commands`` and passes them to
    ``command``; without commands, the page is read-only.

    Raises OSError if the port is not available, and ValueError if an allowed host is neither a name
    nor an address.
    """

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
        self._record, self._title = record, title
        self._commands, self._command = tuple(commands), command
        name = _spelling(socket.gethostname())
        short = name.partition(".")[0]
        own = {*LOCAL, name, short, f"{short}.local", _spelling(host)}
        self._hosts = own | {host_of(name) for name in allowed_hosts}
        self._files = {
            path: ((PAGE / name).read_bytes(), kind) for path, (name, kind) in FILES.items()
        }
        family, both = socket.AF_INET, False
        if ":" in host:
            family, both = socket.AF_INET6, socket.has_dualstack_ipv6()
        listening = socket.create_server((host, port), family=family, dualstack_ipv6=both)
        everywhere = host in ("0.0.0.0", "::")
        shown = socket.gethostname() if everywhere else f"[{host}]" if ":" in host else host
        self.address = f"http://{shown}:{listening.getsockname()[1]}/"
        self._loop, self._end = asyncio.new_event_loop(), asyncio.Event()
        self._thread = threading.Thread(
            target=self._loop.run_until_complete, args=[self._serve(listening)], daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop the server and close all connections."""
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()
        self._loop.close()

    async def _serve(self, listening: socket.socket) -> None:
        app = web.Application(middlewares=[self._guard], client_max_size=_LONGEST_BODY)
        app.add_routes([web.get(path, self._send_file) for path in FILES])
        app.router.add_get("/status", self._send_status)
        app.router.add_get("/tables/{name}", self._send_table)
        app.router.add_post("/seen", self._take_seen)
        app.router.add_post("/command", self._take_command)
        runner = web.AppRunner(app)
        await runner.setup()
        http, present = runner.server, set[_Connection]()
        assert http is not None
        server = await self._loop.create_server(
            lambda: _Connection(http, self._loop, present), sock=listening
        )
        await self._end.wait()
        server.close()
        for connection in present:
            connection.hang_up()
        await runner.cleanup()
        for task in asyncio.all_tasks() - {asyncio.current_task()}:
            task.cancel()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Read and check a request before its handler, and limit the time of the answer."""
        answer: web.StreamResponse
        try:
            await request.read()
            self._check_host(request)
            if request.method not in ("GET", "HEAD"):
                _check_origin(request)
            answer = await handler(request)
        except web.HTTPException as error:
            answer = _refusal(error.status, error.text or error.reason)
        answer.headers.update(_HEADERS)
        connection = cast(_Connection, request.protocol)
        connection.limit(_IDLE, reading=False)
        if connection.received > _RECEIVED // 2:
            answer.force_close()
        return answer

    def _check_host(self, request: web.Request) -> None:
        """Reject requests with a foreign host name (DNS rebinding)."""
        hosts = request.headers.getall("Host", [])
        if len(hosts) != 1:
            raise web.HTTPBadRequest(text=f"a request must have one Host, not {len(hosts)}")
        try:
            host = host_of(hosts[0])
        except ValueError as error:
            raise web.HTTPBadRequest(text=f"Host: {error}") from error
        if host not in self._hosts and host != _address(request, "sockname"):
            raise web.HTTPForbidden(
                text=f"the page is not served as {host}: use localhost, or the name or address of "
                "the computer that it runs on, or add this name to the parameter allowed_hosts"
            )

    async def _send_file(self, request: web.Request) -> web.Response:
        content, kind = self._files[request.path]
        return web.Response(body=content, headers={"Content-Type": kind})

    async def _send_status(self, request: web.Request) -> web.Response:
        status = {
            "title": self._title,
            "commands": self._commands,
            "verdicts": _VERDICTS,
            **self._record.status(_number(request, "windows", 0), _number(request, "marks", 0)),
        }
        text = json.dumps(status, separators=(",", ":"), allow_nan=False)
        return web.Response(text=text, content_type="application/json")

    async def _send_table(self, request: web.Request) -> web.Response:
        after, generation = _number(request, "after", -1), _number(request, "generation", -1)
        rows = self._record.rows(request.match_info["name"], after, generation)
        if rows is None:
            return web.Response(status=204)
        return web.Response(
            body=rows.values.astype("<f8", copy=False).tobytes(),
            headers={"X-Generation": str(rows.generation), "X-Columns": ",".join(rows.columns)},
        )

    async def _take_seen(self, request: web.Request) -> web.Response:
        """Acknowledge the faults up to the number in the body."""
        self._record.acknowledge(_whole_number("fault", await _body(request)))
        return web.Response(status=204)

    async def _take_command(self, request: web.Request) -> web.Response:
        if not self._commands:
            raise web.HTTPForbidden(text="the page is read-only: allow_commands is not set")
        name = await _body(request)
        if name not in self._commands:
            raise web.HTTPBadRequest(text=f"the commands are {', '.join(self._commands)}")
        if not self._command(name, {**request.query}):
            raise web.HTTPServiceUnavailable(text="too many commands are waiting")
        return web.Response(status=202)


def _check_origin(request: web.Request) -> None:
    """Reject commands from pages of other sites; requires a valid Host."""
    own = request.headers["Host"].lower()
    if request.headers.get("Origin", "").lower() not in (f"http://{own}", f"https://{own}"):
        raise web.HTTPForbidden(text="commands are accepted only from the page itself")


async def _body(request: web.Request) -> str:
    # Unlike request.text(), which raises an exception for a wrong or unknown encoding.
    return (await request.read()).decode("utf-8", "replace")


def _number(request: web.Request, name: str, default: int) -> int:
    return _whole_number(name, request.query.get(name, str(default)))


def _whole_number(name: str, text: str) -> int:
    if not _WHOLE_NUMBER.fullmatch(text):
        raise web.HTTPBadRequest(text=f"{name} must be a whole number, not {text!r}")
    return int(text)


def _refusal(status: int, sentence: str) -> web.Response:
    answer = web.Response(status=status, text=f"{sentence}\n", headers=_HEADERS)
    if status == 400:  # further bytes may belong to the malformed request
        answer.force_close()
    return answer


def _address(peer: web.Request | asyncio.BaseTransport, end: str) -> str:
    """The address of an ``end`` of a connection: "sockname" or "peername"."""
    return _spelling((peer.get_extra_info(end) or ("",))[0])


class _Connection(web.RequestHandler):
    """A connection with the limits that aiohttp lacks: of its time, its bytes and its number."""

    def __init__(
        self, server: web.Server, loop: asyncio.AbstractEventLoop, present: set[_Connection]
    ) -> None:
        super().__init__(server, loop=loop, access_log=None)  # type: ignore[arg-type]
        self._call_later, self._present = loop.call_later, present
        self._deadline = loop.call_later(_IDLE, self.hang_up)
        self._reading = False
        self.received = 0
        """Number of bytes received."""

    def limit(self, seconds: float, *, reading: bool) -> None:
        """Set the time limit of reading a request, or of its answer and the wait for the next."""
        self._reading = reading
        self._deadline.cancel()
        self._deadline = self._call_later(seconds, self.hang_up)

    def hang_up(self) -> None:
        """End the connection, whatever is still to be sent."""
        if self.transport is not None:
            self.transport.abort()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin, unless there are too many connections."""
        self.address = _address(transport, "peername")
        shared = sum(other.address == self.address for other in self._present)
        if len(self._present) >= CONNECTIONS or shared >= CONNECTIONS_EACH:
            cast(asyncio.Transport, transport).abort()
            return
        self._present.add(self)
        super().connection_made(transport)

    def connection_lost(self, exc: BaseException | None) -> None:
        """Make room for another connection."""
        self._present.discard(self)
        self._deadline.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Read a part of a request."""
        self.received += len(data)
        if self.received > _RECEIVED:
            self.hang_up()
            return
        if not self._reading:
            self.limit(_REQUEST, reading=True)
        try:
            super().data_received(data)
        except ValueError:  # aiohttp 3.9 fails on the target http://[
            self.hang_up()

    def handle_error(
        self,
        request: web.BaseRequest,
        status: int = 500,
        exc: BaseException | None = None,
        message: str | None = None,
    ) -> web.StreamResponse:
        """Answer a malformed request; an error of this program is also logged."""
        if status == 500 and not isinstance(exc, OSError):
            return super().handle_error(request, status, exc, message)
        return _refusal(400, "this is not a valid HTTP request")
