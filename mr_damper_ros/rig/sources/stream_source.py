"""Lines or binary records as a source: over a serial line, by TCP, or as UDP datagrams."""

from __future__ import annotations

import math
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from mr_damper_ros.rig.sources.device_source import POLL, SILENCE, Device, DeviceSource, Portion
from mr_damper_ros.rig.sources.source import SourceState, StreamSettings
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.blocks import RigBlock
from mr_damper_ros.signals.clocks import CountedTimes

if TYPE_CHECKING:
    from mr_damper_ros.rig.sources.row_times import RowTimes, TimedSample
    from mr_damper_ros.rig.sources.rows import RowDecoder, RowFormat


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


_MANY = 0.05
"""Part of the rows that cannot be read which is told."""


@dataclass(frozen=True)
class StreamOptions(ParameterTable):
    """What comes in by ``source: stream``."""

    address: str = option(
        "",
        "Where it comes from: serial:/dev/ttyACM0, tcp:192.168.1.30:5000 (this computer connects), "
        "udp:0.0.0.0:5000 (the address of this computer at which datagrams arrive), or simulated.",
    )
    baud: int = option(115200, "Speed of a serial line [Bd].", minimum=50, maximum=20_000_000)
    columns: str = option(
        "",
        "What a line or a record holds, in its order, and the units, such as "
        "time:us,displacement:mm,force:N or count:16,displacement:mm,force:-0.5*N,current:A; a "
        "minus sign is a column to skip. count is a number that counts up, and has 8, 16, 32 or 64 "
        "bits.",
    )
    rate: float = option(
        math.nan, "Samples per second [Hz], where no column holds the time; from 1 to 100000."
    )
    layout: str = option(
        "",
        "Of binary records: < (low byte first) or > and a letter for each column, as of Python's "
        "struct, such as <Hff; empty for lines of text.",
    )
    mark: str = option("", "Bytes before each binary record, in hexadecimal, such as AA55.")
    check: str = option(
        "none",
        "What follows each binary record: none, the sum of its bytes and those of the mark "
        "(sum8), their exclusive or (xor8), or their CRC-16/XMODEM (crc16, high byte first).",
        choices=("none", "sum8", "xor8", "crc16"),
    )

    def objection(self) -> str:
        """Say what is missing, or does not go together."""
        if not self.address:
            return "source is stream, but stream.address is empty: say where the stream comes from"
        if not self.columns:
            return (
                "source is stream, but stream.columns is empty: say what a line holds, such as "
                "time:us,displacement:mm,force:N"
            )
        try:
            address = parse_address(self.address)
            form = self.row_format()
        except ValueError as error:
            return f"stream: {error}"
        if form.time_unit is None and math.isnan(self.rate):
            return "stream.columns hold no time: give stream.rate, the samples per second"
        if not (math.isnan(self.rate) or 1.0 <= self.rate <= 1e5):
            return f"stream.rate is {self.rate:g} Hz: it must be from 1 to 100000 Hz"
        if form.time_unit is not None and not math.isnan(self.rate):
            return "stream.columns hold the time, and stream.rate is given, too: leave one out"
        if not self.layout and (self.mark or self.check != "none"):
            return "stream.mark and stream.check are of binary records, but stream.layout is empty"
        if address.kind == "serial" and self.layout and not self.mark and self.check == "none":
            return (
                "binary records over a serial line need stream.mark or stream.check, else a lost "
                "byte is never noticed"
            )
        return ""

    def row_format(self) -> RowFormat:
        """The format of the rows; raises ValueError, with a sentence."""
        from mr_damper_ros.rig.sources.rows import check_layout, parse_row_format

        form = parse_row_format(self.columns)
        if self.layout:
            check_layout(self.layout, form)
        try:
            bytes.fromhex(self.mark)
        except ValueError as error:
            raise ValueError(
                f"the mark '{self.mark}' is not hexadecimal: write it like AA55"
            ) from error
        return form


class StreamSource(DeviceSource[bytes]):
    """Samples from whatever sends them; a link that is lost is made again."""

    options = StreamOptions
    prefix = "stream."

    def __init__(self, settings: StreamOptions, stream: StreamSettings) -> None:
        super().__init__(settings, stream)
        self._address = parse_address("udp:[::]:1")
        self._decoder: RowDecoder | None = None
        # Rows that could and could not be read: in all, and when that was last told.
        self._readable, self._unreadable = 0, 0
        self._told = (0, 0)

    def open(self) -> list[str]:
        """See what is to be read; the link is made when the streaming starts."""
        given: StreamOptions = self.settings
        self._address = parse_address(given.address)
        self._form = given.row_format()
        self._connect = self._connector()
        kind = f"records {given.layout}" if given.layout else "lines"
        return [f"{kind} from {given.address}: {given.columns}"]

    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """The samples as they come."""
        self._decoder, self._times = self._new_decoder(), self._new_times()
        self._readable, self._unreadable, self._told = 0, 0, (0, 0)
        return self._read(self._connect, start_ns)

    def state(self) -> SourceState:
        """How the link is, what of it could not be read, and what is wrong with the times."""
        reader, times = self._reader, self._times
        if reader is None or times is None:
            return SourceState("", {})
        values = {"connections": reader.connections, "unreadable": self._unreadable}
        return SourceState(self._fault(reader.fault, times), {**values, **times.values()})

    def _samples(self, portion: Portion[bytes], *, begins: bool) -> Iterator[TimedSample]:
        decoder, times, datagrams = self._decoder, self._times, self._address.kind == "udp"
        assert decoder is not None
        assert times is not None
        if begins or datagrams:
            # A serial line is joined in the middle of something.
            decoder.begin(whole=self._address.kind != "serial")
        end = b"\n" if datagrams and not self.settings.layout else b""
        for row in decoder.feed(portion.data + end):
            if row is None:
                self._unreadable += 1
                times.skip()
            else:
                self._readable += 1
                yield from times.add(row, portion.arrival_ns)

    def _connector(self) -> Callable[[], Device[bytes]]:
        given: StreamOptions = self.settings
        if self._address.kind != "simulated":
            return connector(self._address, given.baud)
        from mr_damper_ros.rig.sources.rows import SimulatedSender

        mark = bytes.fromhex(given.mark)
        return lambda: SimulatedSender(self._form, given.rate, given.layout, mark, given.check)

    def _new_decoder(self) -> RowDecoder:
        from mr_damper_ros.rig.sources.rows import LineDecoder, RecordDecoder

        given: StreamOptions = self.settings
        if not given.layout:
            return LineDecoder(self._form)
        return RecordDecoder(self._form, given.layout, bytes.fromhex(given.mark), given.check)

    def _new_times(self) -> RowTimes:
        from mr_damper_ros.rig.sources.row_times import CountedRows, StampedRows

        unit = self._form.time_unit
        if unit is not None:
            return StampedRows(unit)
        counts = None if self._form.count is None else 2**self._form.bits
        return CountedRows(CountedTimes(self.settings.rate, counts))

    def _fault(self, of_link: str, times: RowTimes) -> str:
        """What is wrong, in a sentence; empty for nothing."""
        told, self._told = self._told, (self._readable, self._unreadable)
        read, unread = self._readable - told[0], self._unreadable - told[1]
        if of_link:
            return of_link
        if self._silent:
            return f"nothing arrives from {self.settings.address}: does its sender send?"
        if unread > _MANY * (read + unread):
            assert self._decoder is not None
            return (
                f"{unread} of {read + unread} rows cannot be read as {self.settings.columns}, such "
                f"as '{self._decoder.example}'"
            )
        return times.fault()
