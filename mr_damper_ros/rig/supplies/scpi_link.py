"""Links to an instrument that speaks SCPI: a TCP socket, VISA, an object in this process."""

from __future__ import annotations

import math
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

_PORT = 5025
"""Usual port of instruments for SCPI over plain TCP."""

_LONGEST_ANSWER = 4096


class LinkLostError(OSError):
    """The instrument does not answer, or cannot be reached; the message is a sentence."""


class Patience:
    """Time limit for answers: ``timeout`` [s] for each of them, and ``end`` for all.

    Another thread may set ``end``, a time of ``time.monotonic``, while an answer is awaited.
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self.end = math.inf

    def left(self, since: float) -> float:
        """Time [s] left for an answer requested at ``since``; not positive after the time limit."""
        return min(since + self.timeout, self.end) - time.monotonic()


class SocketLink:
    """A plain TCP connection ("SCPI-RAW").

    ``patience`` limits the time for the connection, and for each complete answer. After a timeout
    the link is abandoned, because a late answer would be taken for the answer to the next line.
    """

    def __init__(self, host: str, port: int, patience: Patience) -> None:
        self._name = f"{host}:{port}"
        self._patience = patience
        self._rest = b""
        with _failures_of(self._name):
            self._socket = socket.create_connection((host, port), self._left(time.monotonic()))
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def write(self, line: str) -> None:
        """Send a line without an answer."""
        with _failures_of(self._name):
            self._socket.settimeout(self._left(time.monotonic()))
            self._socket.sendall(line.encode("ascii") + b"\n")

    def query(self, line: str) -> str:
        """Send a line and return its answer."""
        asked = time.monotonic()
        self.write(line)
        with _failures_of(self._name):
            while b"\n" not in self._rest:
                self._socket.settimeout(min(self._left(asked), 0.05))
                with suppress(TimeoutError):
                    part = self._socket.recv(_LONGEST_ANSWER)
                    if not part:
                        raise ConnectionError("it has closed the connection")
                    self._rest += part
                if len(self._rest) > _LONGEST_ANSWER:
                    raise ConnectionError("it sends an unterminated answer")
        answer, _, self._rest = self._rest.partition(b"\n")
        return answer.decode("ascii", "replace").strip()

    def close(self) -> None:
        """Close the connection; the instrument keeps its state."""
        self._socket.close()

    def _left(self, since: float) -> float:
        left = self._patience.left(since)
        if left <= 0.0:
            raise LinkLostError(
                f"{self._name} has not answered within {time.monotonic() - since:.3g} s"
            )
        return left


class VisaLink:
    """An instrument by its VISA resource name, through PyVISA with PyVISA-py or a vendor's VISA.

    VISA applies its timeout to each answer; it cannot be shortened during the wait.
    """

    def __init__(self, resource: str, patience: Patience) -> None:
        try:
            import pyvisa
        except ImportError as error:
            raise LinkLostError(
                f"{resource} needs PyVISA: pip install PyVISA==1.16.2 PyVISA-py==0.8.1"
            ) from error
        self._name = resource
        self._patience = patience
        with _failures_of(resource):
            self._manager = pyvisa.ResourceManager()
            self._resource: Any = self._manager.open_resource(
                resource, open_timeout=self._milliseconds()
            )
            self._resource.read_termination = self._resource.write_termination = "\n"

    def write(self, line: str) -> None:
        """Send a line without an answer."""
        with _failures_of(self._name):
            self._resource.timeout = self._milliseconds()
            self._resource.write(line)

    def query(self, line: str) -> str:
        """Send a line and return its answer."""
        with _failures_of(self._name):
            self._resource.timeout = self._milliseconds()
            return str(self._resource.query(line)).strip()

    def close(self) -> None:
        """Close the connection; the instrument keeps its state."""
        with _failures_of(self._name):
            self._resource.close()
            self._manager.close()

    def _milliseconds(self) -> int:
        return max(round(1e3 * self._patience.left(time.monotonic())), 1)


class DirectLink:
    """An instrument in this process: ``process`` takes a line and returns its answer or None."""

    def __init__(self, process: Callable[[str], str | None]) -> None:
        self._process = process

    def write(self, line: str) -> None:
        """Send a line without an answer."""
        self._process(line)

    def query(self, line: str) -> str:
        """Send a line and return its answer."""
        answer = self._process(line)
        if answer is None:
            raise LinkLostError(f"the instrument does not answer {line}")
        return answer

    def close(self) -> None:
        """Do nothing, because there is no connection."""


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


def connect(address: str, patience: Patience) -> ScpiLink:
    """The link to an address: ``host``, ``host:port``, or a VISA resource name with ``::`` in it.

    A VISA name of a plain socket is opened without VISA: PyVISA-py 0.8.1 waits endlessly for a
    socket whose answer comes byte by byte. Raises LinkLostError if the instrument does not answer,
    ValueError if the address is invalid.
    """
    plain = _VISA_SOCKET.fullmatch(address)
    if plain is not None:
        address = f"{plain['host']}:{plain['port']}"
    if "::" in address:
        return VisaLink(address, patience)
    match = re.fullmatch(r"(?P<host>[^\s:/]+)(?::(?P<port>\d{1,5}))?", address)
    if match is None or int(match["port"] or _PORT) > 65535:
        raise ValueError(
            f"the address '{address}' cannot be used: give host:port (port {_PORT} for most "
            "instruments), or a VISA resource name such as USB0::0x2A8D::0x1202::MY1::INSTR"
        )
    return SocketLink(match["host"], int(match["port"] or _PORT), patience)


ScpiLink = SocketLink | VisaLink | DirectLink
"""A connection to an instrument by lines; each method raises LinkLostError."""
