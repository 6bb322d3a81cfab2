"""Links to an instrument that speaks SCPI: a TCP socket, VISA, an emulated instrument."""

from __future__ import annotations

import math
import re
import socket
import threading
import time
from collections import deque
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


_SWITCH = {"ON": "1", "OFF": "0"}

_DELAY, _WATCHDOG = "OUTP:PROT:WDOG:DEL", "OUTP:PROT:WDOG"


class EmulatedInstrument:
    """One output of up to 5 A on a coil of ``time_constant`` [s].

    ``clock`` returns seconds. The object is instrument and link at once; several threads may use
    it.
    """

    def __init__(
        self, time_constant: float = 0.02, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._time_constant = time_constant
        self._clock = clock
        self._lock = threading.Lock()
        self._errors: deque[str] = deque()
        self._values = {"CURR": 0.0, "VOLT": 0.0, "VOLT:LIM": 0.0, _DELAY: 60.0}
        self._values |= {"OUTP": 0.0, _WATCHDOG: 0.0}
        self._ranges = {"CURR": (0.0, 5.0), _DELAY: (1e-3, 3600.0)}
        self._tripped = False
        self._coil = 0.0
        self._at = self._received_at = clock()

    def current(self) -> float:
        """The present current in the coil [A]."""
        with self._lock:
            self._advance(self._clock())
            return self._coil

    @property
    def is_off(self) -> bool:
        """Whether the output is off, by a command or by the watchdog."""
        with self._lock:
            self._advance(self._clock())
            return self._tripped or not self._values["OUTP"]

    def write(self, line: str) -> None:
        """Send a line without an answer."""
        self.process(line)

    def query(self, line: str) -> str:
        """Send a line and return its answer."""
        answer = self.process(line)
        if answer is None:
            raise LinkLostError(f"the emulated instrument does not answer {line}")
        return answer

    def close(self) -> None:
        """Do nothing, because there is no connection."""

    def process(self, line: str) -> str | None:
        """Process a line; returns the answer, None if there is none."""
        with self._lock:
            now = self._clock()
            self._advance(now)
            self._received_at = now
            command, _, argument = line.strip().upper().partition(" ")
            answers = {
                "*IDN?": "mr_damper_ros,emulated instrument,0,0",
                "CURR?": f"{self._values['CURR']:.4f}",
                "OUTP?": f"{self._values['OUTP']:.0f}",
                "MEAS:CURR?": f"{self._coil:.4E}",
            }
            if command in answers:
                return answers[command]
            if command == "SYST:ERR?":
                return self._errors.popleft() if self._errors else '+0,"No error"'
            if command == "OUTP:PROT:CLE":
                self._tripped = False
            elif command == "*CLS":
                self._errors.clear()
            elif command in self._values:
                self._set(command, _SWITCH.get(argument, argument))
            elif (command, argument) != ("FUNC", "CURR"):
                self._complain('-113,"Undefined header"')
            return None

    def _set(self, command: str, argument: str) -> None:
        low, high = self._ranges.get(command, (-math.inf, math.inf))
        try:
            value = float(argument)
        except ValueError:
            self._complain('-104,"Data type error"')
            return
        if low <= value <= high:
            self._values[command] = value
        else:
            self._complain('-222,"Data out of range"')

    def _complain(self, error: str) -> None:
        if len(self._errors) >= 10:  # a full queue ends with an entry for lost errors
            self._errors[-1] = '-350,"Queue overflow"'
        else:
            self._errors.append(error)

    def _advance(self, now: float) -> None:
        """Advance the coil current to ``now``, and trip the watchdog at its due time."""
        due = self._received_at + self._values[_DELAY]
        if self._values["OUTP"] and self._values[_WATCHDOG] and not self._tripped and now > due:
            self._follow(due)
            self._tripped = True
        self._follow(now)

    def _follow(self, now: float) -> None:
        target = 0.0 if self._tripped or not self._values["OUTP"] else self._values["CURR"]
        elapsed, self._at = max(now - self._at, 0.0), max(now, self._at)
        self._coil = target + (self._coil - target) * math.exp(-elapsed / self._time_constant)


ScpiLink = SocketLink | VisaLink | EmulatedInstrument
"""A connection to an instrument by lines; each method raises LinkLostError."""
