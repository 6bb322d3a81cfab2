"""Links to an instrument that speaks SCPI: a TCP socket, VISA, an object in this process."""

from __future__ import annotations

import math
import re
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

_PORT = 5025
"""Usual port of instruments for SCPI over plain TCP."""

_LONGEST_ANSWER = 4096

_LINE_END = re.compile(rb"[\r\n]")

_IDENTIFY = "*IDN?"

_MOST_GREETINGS = 4

_MOST_PARTS = 64


class LinkLostError(OSError):
    """The instrument does not answer, or cannot be reached; the message is a sentence."""


class Patience:
    """Time limit for answers: ``timeout`` [s] for each of them, and ``end`` for all.

    Another thread may set ``end``, a time of ``time.monotonic``, while an answer is awaited; minus
    infinity ends all waits for good.
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self.end = math.inf

    @property
    def ended(self) -> bool:
        """Whether all waits have been ended for good."""
        return self.end == -math.inf

    def left(self, since: float) -> float:
        """Time [s] left for an answer requested at ``since``; not positive after the time limit."""
        return min(since + self.timeout, self.end) - time.monotonic()


class Transport(Protocol):
    """Sends and receives lines; each method raises LinkLostError."""

    name: str
    longest_wait: float
    """Longest time [s] to wait at a time, so that a reduced time limit takes effect."""

    def send(self, line: str, timeout: float) -> None:
        """Send a line within ``timeout`` [s]."""

    def receive(self, timeout: float) -> str | None:
        """The next complete line, which may be empty; None after ``timeout`` [s]."""

    def drain(self) -> None:
        """Discard everything that has arrived."""

    def close(self) -> None:
        """Close the connection; the instrument keeps its state."""


class SocketTransport:
    """A plain TCP connection ("SCPI-RAW"), opened within ``timeout`` [s].

    CR, LF or both end an answer.
    """

    longest_wait = 0.05

    def __init__(self, host: str, port: int, timeout: float) -> None:
        self.name = f"{host}:{port}"
        self._rest = b""
        with _failures_of(self.name):
            self._socket = socket.create_connection((host, port), timeout)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, line: str, timeout: float) -> None:
        """Send a line."""
        with _failures_of(self.name):
            self._socket.settimeout(timeout)
            self._socket.sendall(line.encode("ascii") + b"\n")

    def receive(self, timeout: float) -> str | None:
        """The next complete line."""
        end = time.monotonic() + timeout
        while not (found := _LINE_END.search(self._rest)):
            if len(self._rest) > _LONGEST_ANSWER:
                raise LinkLostError(f"{self.name} sends an unterminated answer")
            left = end - time.monotonic()
            if left <= 0.0 or not self._read(left):
                return None
        line, self._rest = self._rest[: found.start()], self._rest[found.end() :]
        return line.decode("ascii", "replace").strip()

    def drain(self) -> None:
        """Discard everything that has arrived."""
        for _ in range(_MOST_PARTS):
            if not self._read(0.0):
                self._rest = b""
                return
        raise LinkLostError(f"{self.name} sends without end, although nothing is asked")

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def _read(self, timeout: float) -> bool:
        """Read what arrives within ``timeout`` [s]; returns False if nothing does."""
        with _failures_of(self.name):
            self._socket.settimeout(timeout)
            try:
                part = self._socket.recv(_LONGEST_ANSWER)
            except (TimeoutError, BlockingIOError):
                return False
            if not part:
                raise ConnectionError("it has closed the connection")
            self._rest += part
            return True


class VisaTransport:
    """An instrument by its VISA resource name, through PyVISA with PyVISA-py or a vendor's VISA.

    On some interfaces, a read that is abandoned loses the answer, so that it is never cut short.
    """

    longest_wait = math.inf

    def __init__(self, resource: str, timeout: float) -> None:
        try:
            import pyvisa
        except ImportError as error:
            raise LinkLostError(
                f"{resource} needs PyVISA: pip install PyVISA==1.16.2 PyVISA-py==0.8.1"
            ) from error
        self.name = resource
        self._timed_out = pyvisa.constants.StatusCode.error_timeout
        with _failures_of(resource):
            self._manager = pyvisa.ResourceManager()
            self._resource: Any = self._manager.open_resource(
                resource, open_timeout=_milliseconds(timeout)
            )
            self._resource.read_termination = self._resource.write_termination = "\n"

    def send(self, line: str, timeout: float) -> None:
        """Send a line."""
        with _failures_of(self.name):
            self._resource.timeout = _milliseconds(timeout)
            self._resource.write(line)

    def receive(self, timeout: float) -> str | None:
        """The next complete line."""
        with _failures_of(self.name):
            self._resource.timeout = _milliseconds(timeout)
            try:
                return str(self._resource.read()).strip()
            except Exception as error:
                if getattr(error, "error_code", None) == self._timed_out:
                    return None
                raise

    def drain(self) -> None:
        """Discard what has arrived on a serial line; on other interfaces nothing arrives unasked.

        A device clear would also discard lines that the instrument has not executed yet.
        """
        with _failures_of(self.name):
            while count := getattr(self._resource, "bytes_in_buffer", 0):
                self._resource.read_bytes(count)

    def close(self) -> None:
        """Close the connection."""
        with _failures_of(self.name):
            self._resource.close()
            self._manager.close()


class DirectTransport:
    """An instrument in this process: ``process`` takes a line and returns its answer or None."""

    name = "the instrument"
    longest_wait = math.inf

    def __init__(self, process: Callable[[str], str | None]) -> None:
        self._process = process
        self._answers: deque[str] = deque()

    def send(self, line: str, timeout: float) -> None:
        """Process a line."""
        answer = self._process(line)
        if answer is not None:
            self._answers.append(answer)

    def receive(self, timeout: float) -> str | None:
        """The oldest answer."""
        if not self._answers:
            raise LinkLostError(f"{self.name} does not answer")
        return self._answers.popleft()

    def drain(self) -> None:
        """Discard all answers."""
        self._answers.clear()

    def close(self) -> None:
        """Do nothing, because there is no connection."""


class ScpiLink:
    """Lines to an instrument and their answers, of which at most one is awaited.

    Each complete answer must arrive within the time limit of ``patience``. Lines are at least
    ``pause`` [s] apart, and a line without an answer at least ``command_pause`` [s] after the line
    before. Echoes of sent lines are skipped. After a missing answer, and on a new
    link, answers are believed only after the instrument has answered ``*IDN?`` with ``identity``,
    if it is known: an earlier answer may arrive late. Each method raises LinkLostError.
    """

    def __init__(self, transport: Transport, patience: Patience, identity: str = "") -> None:
        self.pause = self.command_pause = 0.0
        self.identity = identity
        self._transport = transport
        self._patience = patience
        self._in_step = False
        self._recent: deque[str] = deque(maxlen=8)
        self._sent_at = -math.inf

    def write(self, line: str) -> None:
        """Send a line without an answer."""
        self._send(line, max(self.pause, self.command_pause))

    def query(self, line: str) -> str:
        """Send a line and return its answer."""
        if self.identity and not self._in_step:
            self.synchronise()
        return self._answer(self._ask(line))

    def identify(self) -> str:
        """Learn the identity of the instrument and return it.

        Two consecutive answers must agree, because the first one may be a greeting.
        """
        self.identity = answer = before = ""
        for _ in range(_MOST_GREETINGS):
            answer = self.query(_IDENTIFY)
            if answer == before:
                self.identity = answer
                self.synchronise()
                return answer
            before = answer
        raise LinkLostError(
            f"{self._transport.name} answers {_IDENTIFY} differently each time, last '{answer}'"
        )

    def synchronise(self) -> None:
        """Skip lines until the instrument answers with its identity."""
        asked = self._ask(_IDENTIFY)
        while self._answer(asked) != self.identity:
            pass
        self._in_step = True

    def close(self) -> None:
        """Close the connection; the instrument keeps its state."""
        self._transport.close()

    def _ask(self, line: str) -> float:
        """Send a query; returns the time of sending."""
        self._transport.drain()
        self._send(line, self.pause)
        return self._sent_at

    def _send(self, line: str, pause: float) -> None:
        time.sleep(max(self._sent_at + pause - time.monotonic(), 0.0))
        self._transport.send(line, self._left(time.monotonic()))
        self._recent.append(line)
        self._sent_at = time.monotonic()

    def _answer(self, asked: float) -> str:
        self._in_step = False
        while True:
            left = self._left(asked)
            line = self._transport.receive(min(left, self._transport.longest_wait))
            if line and line not in self._recent:
                self._in_step = True
                return line

    def _left(self, since: float) -> float:
        left = self._patience.left(since)
        if left <= 0.0:
            raise LinkLostError(
                f"{self._transport.name} has not answered within {time.monotonic() - since:.3g} s"
            )
        return left


def _milliseconds(seconds: float) -> int:
    return max(round(1e3 * seconds), 1)


@contextmanager
def _failures_of(name: str) -> Iterator[None]:
    """Convert any error of a link of this name to LinkLostError."""
    try:
        yield
    except LinkLostError:
        raise
    except Exception as error:
        told = getattr(error, "strerror", None) or str(error)
        raise LinkLostError(f"{name}: {' '.join(told.split())}") from error


_VISA_SOCKET = re.compile(r"TCPIP\d*::(?P<host>[^:]+)::(?P<port>\d{1,5})::SOCKET", re.IGNORECASE)


def connect(address: str, patience: Patience, identity: str = "") -> ScpiLink:
    """The link to an address: ``host``, ``host:port``, or a VISA resource name with ``::`` in it.

    A VISA name of a plain socket is opened without VISA: PyVISA-py 0.8.1 waits endlessly for a
    socket whose answer comes byte by byte. ``identity``: see :class:`ScpiLink`. Raises
    LinkLostError if the instrument cannot be reached, ValueError if the address is invalid.
    """
    plain = _VISA_SOCKET.fullmatch(address)
    if plain is not None:
        address = f"{plain['host']}:{plain['port']}"
    timeout = patience.left(time.monotonic())
    if "::" in address:
        return ScpiLink(VisaTransport(address, timeout), patience, identity)
    match = re.fullmatch(r"(?P<host>[^\s:/]+)(?::(?P<port>\d{1,5}))?", address)
    if match is None or int(match["port"] or _PORT) > 65535:
        raise ValueError(
            f"the address '{address}' cannot be used: give host:port (port {_PORT} for most "
            "instruments), or a VISA resource name such as USB0::0x2A8D::0x1202::MY1::INSTR"
        )
    transport = SocketTransport(match["host"], int(match["port"] or _PORT), timeout)
    return ScpiLink(transport, patience, identity)
