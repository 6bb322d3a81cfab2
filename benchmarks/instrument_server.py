"""An emulated instrument behind a real TCP socket, with the faults of real instruments."""

from __future__ import annotations

import socketserver
import threading
import time
from contextlib import suppress

from mr_damper_ros.emulation.instrument import EmulatedInstrument


class InstrumentServer:
    """Serves SCPI lines on a free port of this computer, in separate threads.

    ``silent``: it executes commands but sends no answers. ``deaf``: it does not receive anything,
    like after an undetected cable break. ``dribble`` [s]: it sends one byte of an answer after each
    such interval and never completes it; meanwhile it reads nothing more from that connection.
    """

    def __init__(self, instrument: EmulatedInstrument) -> None:
        self.instrument = instrument
        self.silent = self.deaf = False
        self.dribble = 0.0
        self.lines: list[str] = []
        self._connections: list[socketserver.StreamRequestHandler] = []
        outer = self

        class _LineConnection(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                outer._connections.append(self)
                with suppress(OSError):  # the client has died
                    for line in self.rfile:
                        outer._hear(self, line)

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

    def _hear(self, connection: socketserver.StreamRequestHandler, line: bytes) -> None:
        if self.deaf:
            return
        text = line.decode("ascii").strip()
        self.lines.append(text)
        answer = self.instrument.process(text)
        if answer is not None and not self.silent:
            while self.dribble:
                connection.wfile.write(b"1")
                time.sleep(self.dribble)
            connection.wfile.write(answer.encode("ascii") + b"\n")
