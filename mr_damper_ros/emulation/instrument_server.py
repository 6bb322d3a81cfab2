"""An emulated instrument behind a real TCP socket, with the faults of real instruments."""

from __future__ import annotations

import math
import socketserver
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress

from mr_damper_ros.emulation.instrument import EmulatedInstrument
from mr_damper_ros.emulation.instrument_faults import INSTRUMENT_FAULTS, InstrumentFault

_GREETING_DELAY = 0.02
"""Time [s] after which a greeting is sent."""


class InstrumentServer:
    """Serves SCPI lines on a free port of this computer, in separate threads.

    ``fault`` may be set at any time. ``lines`` are the lines received.
    """

    def __init__(
        self, instrument: EmulatedInstrument, fault: InstrumentFault = INSTRUMENT_FAULTS["none"]
    ) -> None:
        self.instrument = instrument
        self.fault = fault
        self.lines: list[str] = []
        self._connections: list[socketserver.StreamRequestHandler] = []
        self._session = threading.Lock()
        self._received_at = -math.inf
        self._before = ""
        outer = self

        class _LineConnection(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                outer._serve(self)

        class _SocketServer(socketserver.ThreadingTCPServer):
            daemon_threads = allow_reuse_address = True

        self._server = _SocketServer(("127.0.0.1", 0), _LineConnection)
        self.address = "{}:{}".format(*self._server.server_address[:2])
        serve = self._server.serve_forever
        self._thread = threading.Thread(target=serve, args=(0.02,), daemon=True)
        self._thread.start()

    def cut(self) -> None:
        """Close the present connections; new ones are accepted."""
        for connection in self._connections:
            with suppress(OSError):  # it was closed before
                connection.request.shutdown(2)
        self._connections.clear()

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()
        self.cut()
        self._thread.join()

    def _serve(self, connection: socketserver.StreamRequestHandler) -> None:
        with self._session if self.fault.one_session else nullcontext():
            self._connections.append(connection)
            if self.fault.greeting:
                self._send_later(_GREETING_DELAY, self.fault.greeting)
            if self.fault.cut_after:
                self._later(self.fault.cut_after, self.cut)
            with suppress(OSError):  # the client has died
                for line in connection.rfile:
                    self._receive(connection, line)

    def _receive(self, connection: socketserver.StreamRequestHandler, line: bytes) -> None:
        fault = self.fault
        if fault.deaf:
            return
        text = line.decode("ascii").strip()
        self.lines.append(text)
        if fault.echo:
            connection.wfile.write(line)
        answer = self._execute(text)
        if answer is None or fault.silent:
            return
        if fault.shifted:
            answer, self._before = self._before, answer
        time.sleep(fault.slow)
        while self.fault.dribble:
            connection.wfile.write(b"1")
            time.sleep(self.fault.dribble)
        if fault.late:
            self._send_later(fault.late, answer)
        else:
            connection.wfile.write((answer + fault.terminator).encode("ascii"))

    def _execute(self, text: str) -> str | None:
        fault, now = self.fault, time.monotonic()
        elapsed, self._received_at = now - self._received_at, now
        if not text.endswith("?"):
            if fault.ignores or elapsed < fault.loses_within:
                self.instrument.process("")
                return None
            if text.startswith(fault.refused):
                text = "REFUSED"
        elif fault.no_number and text.startswith("MEAS"):
            return "9.91E37"
        return self.instrument.process(text)

    def _send_later(self, delay: float, text: str) -> None:
        def send() -> None:
            with suppress(OSError, IndexError, ValueError):  # there is no connection any more
                newest = self._connections[-1]
                newest.wfile.write((text + self.fault.terminator).encode("ascii"))

        self._later(delay, send)

    @staticmethod
    def _later(delay: float, act: Callable[[], None]) -> None:
        timer = threading.Timer(delay, act)
        timer.daemon = True
        timer.start()
