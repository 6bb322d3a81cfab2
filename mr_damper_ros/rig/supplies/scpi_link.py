"""Links to an instrument that takes lines of SCPI and answers some: a TCP socket, or VISA."""

from __future__ import annotations

import re
import socket
from typing import Any, Protocol

_PORT = 5025
"""Where instruments listen for SCPI over plain TCP."""

_LONGEST_ANSWER = 4096


class LinkLostError(OSError):
    """The instrument does not answer, or cannot be reached; the message is a sentence."""


class ScpiLink(Protocol):
    """Lines to an instrument and back; each method raises LinkLostError."""

    def write(self, line: str) -> None:
        """Send a line that is not answered."""

    def query(self, line: str) -> str:
        """Send a line and return the answer to it."""

    def close(self) -> None:
        """Let the instrument go."""


class SocketLink:
    """A plain TCP connection ("SCPI-RAW"), made within ``timeout`` [s], in which each answer comes.

    What has not answered in time is given up: a late answer would be taken for that to the next
    line.
    """

    def __init__(self, host: str, port: int, timeout: float) -> None:
        self._name = f"{host}:{port}"
        self._timeout = timeout
        self._rest = b""
        try:
            self._socket = socket.create_connection((host, port), timeout)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            raise self._lost(error) from error

    def write(self, line: str) -> None:
        """Send a line that is not answered."""
        try:
            self._socket.sendall(line.encode("ascii") + b"\n")
        except OSError as error:
            raise self._lost(error) from error

    def query(self, line: str) -> str:
        """Send a line and return the answer to it."""
        self.write(line)
        while b"\n" not in self._rest:
            try:
                part = self._socket.recv(_LONGEST_ANSWER)
            except OSError as error:
                raise self._lost(error) from error
            if not part or len(self._rest) > _LONGEST_ANSWER:
                raise LinkLostError(f"{self._name} has closed the connection")
            self._rest += part
        answer, _, self._rest = self._rest.partition(b"\n")
        return answer.decode("ascii", "replace").strip()

    def close(self) -> None:
        """Let the instrument go."""
        self._socket.close()

    def _lost(self, error: OSError) -> LinkLostError:
        if isinstance(error, TimeoutError):
            return LinkLostError(f"{self._name} has not answered within {self._timeout:g} s")
        return LinkLostError(f"{self._name}: {error.strerror or error}")


class VisaLink:
    """An instrument by its VISA resource name, through PyVISA with PyVISA-py or a vendor's VISA."""

    def __init__(self, resource: str, timeout: float) -> None:
        try:
            import pyvisa
        except ImportError as error:
            raise LinkLostError(
                f"{resource} needs PyVISA: pip install PyVISA==1.16.2 PyVISA-py==0.8.1"
            ) from error
        self._name = resource
        self._failures: tuple[type[Exception], ...] = (pyvisa.errors.Error, OSError, ValueError)
        try:
            self._manager = pyvisa.ResourceManager()
            self._resource: Any = self._manager.open_resource(
                resource, open_timeout=round(1e3 * timeout)
            )
            self._resource.timeout = round(1e3 * timeout)
            self._resource.read_termination = self._resource.write_termination = "\n"
        except self._failures as error:
            raise self._lost(error) from error

    def write(self, line: str) -> None:
        """Send a line that is not answered."""
        try:
            self._resource.write(line)
        except self._failures as error:
            raise self._lost(error) from error

    def query(self, line: str) -> str:
        """Send a line and return the answer to it."""
        try:
            return str(self._resource.query(line)).strip()
        except self._failures as error:
            raise self._lost(error) from error

    def close(self) -> None:
        """Let the instrument go."""
        try:
            self._resource.close()
            self._manager.close()
        except self._failures as error:
            raise self._lost(error) from error

    def _lost(self, error: Exception) -> LinkLostError:
        return LinkLostError(f"{self._name}: {' '.join(str(error).split())}")


def connect(address: str, timeout: float) -> ScpiLink:
    """The link to an address: ``host``, ``host:port``, or a VISA resource name with ``::`` in it.

    Raises LinkLostError where nobody answers, ValueError where it is none of these.
    """
    if "::" in address:
        return VisaLink(address, timeout)
    match = re.fullmatch(r"(?P<host>[^\s:/]+)(?::(?P<port>\d{1,5}))?", address)
    if match is None or int(match["port"] or _PORT) > 65535:
        raise ValueError(
            f"the address '{address}' cannot be used: give host:port (port {_PORT} for most "
            "instruments), or a VISA resource name such as USB0::0x2A8D::0x1202::MY1::INSTR"
        )
    return SocketLink(match["host"], int(match["port"] or _PORT), timeout)
