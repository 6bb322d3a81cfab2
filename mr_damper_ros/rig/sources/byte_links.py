"""Links that bring bytes: a serial line, a TCP connection, UDP datagrams."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from mr_damper_ros.rig.sources.device_source import POLL, SILENCE, Device

_LARGEST = 65535
"""Bytes that are read at once: those of the largest datagram."""

_KEEP_ALIVE = (("TCP_KEEPIDLE", 2), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 3))
"""A silent peer is asked whether it is there: a cable that was pulled says nothing by itself."""

_FORM = re.compile(
    r"serial:(?P<port>\S+)|(?P<kind>tcp|udp):(?P<host>\[[0-9a-fA-F:.]+\]|[^\s:\[\]]+):"
    r"(?P<number>\d{1,5})"
)


@dataclass(frozen=True)
class LinkAddress:
    """``kind`` is serial, tcp, udp or simulated; ``host`` is the name of a serial line's port."""

    kind: str
    host: str
    number: int = 0

    def __str__(self) -> str:
        return self.host if self.kind == "serial" else f"{self.host}:{self.number}"


def parse_address(text: str) -> LinkAddress:
    """The address in a text; raises ValueError with a sentence."""
    if text.strip() == "simulated":
        return LinkAddress("simulated", "")
    match = _FORM.fullmatch(text.strip())
    if match is None or int(match["number"] or 1) not in range(1, 65536):
        raise ValueError(
            f"the address '{text}' cannot be used: write serial:/dev/ttyACM0, "
            "tcp:192.168.1.30:5000, or udp:0.0.0.0:5000 with the address of this computer at "
            "which datagrams arrive"
        )
    if match["port"]:
        return LinkAddress("serial", match["port"])
    return LinkAddress(match["kind"], match["host"].strip("[]"), int(match["number"]))


def connector(address: LinkAddress, baud: int) -> Callable[[], Device[bytes]]:
    """What connects to an address; raises ValueError where a library is missing."""
    if address.kind == "serial":
        try:
            serial: Any = import_module("serial")
        except ImportError as error:
            raise ValueError(
                f"the serial line {address} needs pyserial: pip install pyserial==3.5"
            ) from error
        return lambda: _SerialLine(serial, address.host, baud)
    if address.kind == "tcp":
        return lambda: _TcpConnection(address)
    return lambda: _Datagrams(address)


class _SerialLine:
    def __init__(self, serial: Any, port: str, baud: int) -> None:
        self._name = port
        # Its SerialException is an OSError; termios has an error of its own.
        self._failures: tuple[type[Exception], ...] = (
            *(OSError, ValueError, TypeError),
            *_termios_error(),
        )
        try:
            self._port = serial.Serial(port, baud, timeout=POLL, exclusive=True)
        except self._failures as error:
            raise OSError(f"{port}: {_why(error)}") from error

    def read(self) -> bytes | None:
        try:
            data = self._port.read(1)
            if data:
                data += self._port.read(min(self._port.in_waiting, _LARGEST))
        except self._failures as error:
            raise ConnectionError(f"{self._name} was lost: {_why(error)}") from error
        return data or None

    def close(self) -> None:
        with suppress(*self._failures):
            self._port.close()


class _TcpConnection:
    def __init__(self, address: LinkAddress) -> None:
        self._name = str(address)
        try:
            self._socket = socket.create_connection((address.host, address.number), SILENCE)
            self._socket.settimeout(POLL)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for name, value in _KEEP_ALIVE:
                if hasattr(socket, name):
                    self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        except (OSError, UnicodeError) as error:
            raise OSError(f"nobody answers at {self._name}: {_why(error)}") from error

    def read(self) -> bytes | None:
        try:
            data = self._socket.recv(_LARGEST)
        except TimeoutError:
            return None
        except OSError as error:
            raise ConnectionError(f"{self._name} was lost: {_why(error)}") from error
        if not data:
            raise ConnectionError(f"{self._name} has closed the connection")
        return data

    def close(self) -> None:
        self._socket.close()


class _Datagrams:
    """Datagrams of one sender at a time: two would be mixed up."""

    def __init__(self, address: LinkAddress) -> None:
        family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        self._name = str(address)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.bind((address.host, address.number))
        except (OSError, UnicodeError) as error:
            self._socket.close()
            raise OSError(f"no datagrams can be received at {address}: {_why(error)}") from error
        self._socket.settimeout(POLL)
        self._sender: Any = None
        self._heard = 0.0

    def read(self) -> bytes | None:
        try:
            data, sender = self._socket.recvfrom(_LARGEST)
        except TimeoutError:
            return None
        except OSError as error:
            raise ConnectionError(f"{self._name} was lost: {_why(error)}") from error
        now = time.monotonic()
        if sender != self._sender and now - self._heard < SILENCE:
            return None
        self._sender, self._heard = sender, now
        return data or None

    def close(self) -> None:
        self._socket.close()


def _termios_error() -> tuple[type[Exception], ...]:
    try:
        import termios
    except ImportError:  # Windows
        return ()
    return (termios.error,)


def _why(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__
