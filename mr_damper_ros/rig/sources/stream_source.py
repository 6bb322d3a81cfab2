"""Lines or binary records as a source: over a serial line, by TCP, or as UDP datagrams."""

from __future__ import annotations

import math
import re
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from mr_damper_ros.rig.sources.device_source import (
    POLL,
    SILENCE,
    CountedRows,
    DeviceSource,
    Portion,
    Portions,
    RowTimes,
    StampedRows,
    TimedSample,
    library,
)
from mr_damper_ros.rig.sources.rows import (
    LineDecoder,
    RecordDecoder,
    RowDecoder,
    RowFormat,
    SimulatedSender,
    check_layout,
    parse_row_format,
)
from mr_damper_ros.settings.option_table import ParameterTable, option

_LARGEST = 65535
"""Largest number of bytes in one read: the size of the largest datagram."""

_KEEP_ALIVE = (("TCP_KEEPIDLE", 2), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 3))
"""TCP keep-alive options, to detect that the cable of a silent sender is disconnected."""

_FORM = re.compile(
    r"serial:(?P<port>\S+)|(?P<kind>tcp|udp):(?P<host>\[[0-9a-fA-F:.]+\]|[^\s:\[\]]+):"
    r"(?P<number>\d{1,5})"
)


@dataclass(frozen=True)
class LinkAddress:
    """``kind`` is serial, tcp, udp or simulated; ``host`` is also the name of a serial port."""

    kind: str
    host: str
    number: int = 0

    def __str__(self) -> str:
        return f"{self.host}:{self.number}" if self.number else self.host


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


def connector(address: LinkAddress, baud: int) -> Callable[[], Portions[bytes]]:
    """A function that connects to an address; raises ValueError if a library is missing."""
    if address.kind == "serial":
        serial = library("serial", f"the serial line {address}", "pyserial==3.5")
        return partial(_serial_line, serial, address.host, baud)
    return partial(_tcp_connection if address.kind == "tcp" else _datagrams, address)


def _serial_line(serial: Any, port: str, baud: int) -> Portions[bytes]:
    with serial.Serial(port, baud, timeout=POLL, exclusive=True) as line:
        yield None
        while True:
            first = line.read(1)
            yield first + line.read(min(line.in_waiting, _LARGEST)) if first else None


def _tcp_connection(address: LinkAddress) -> Portions[bytes]:
    with socket.create_connection((address.host, address.number), SILENCE) as connection:
        connection.settimeout(POLL)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEP_ALIVE:
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        yield None
        while True:
            try:
                data = connection.recv(_LARGEST)
            except TimeoutError:
                yield None
                continue
            if not data:
                raise ConnectionError("it has closed the connection")
            yield data


def _datagrams(address: LinkAddress) -> Portions[bytes]:
    """Datagrams of one sender at a time; datagrams of two senders would be mixed up."""
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as receiver:
        receiver.bind((address.host, address.number))
        receiver.settimeout(POLL)
        yield None
        known, heard = None, 0.0
        while True:
            try:
                data, sender = receiver.recvfrom(_LARGEST)
            except TimeoutError:
                yield None
                continue
            if sender == known or time.monotonic() - heard >= SILENCE:
                known, heard = sender, time.monotonic()
                yield data or None


_MANY = 0.05
"""Fraction of unreadable rows above which a fault is reported."""


@dataclass(frozen=True)
class StreamOptions(ParameterTable):
    """The sender of ``source: stream`` and the format of its rows."""

    address: str = option(
        "",
        "Address of the sender: serial:/dev/ttyACM0, tcp:192.168.1.30:5000 (this computer "
        "connects), udp:0.0.0.0:5000 (the local address that receives datagrams), or "
        "simulated.",
    )
    baud: int = option(115200, "Speed of a serial line [Bd].", within=(50, 20_000_000))
    columns: str = option(
        "",
        "Columns of a line or record in order, with units, such as "
        "time:us,displacement:mm,force:N or count:16,displacement:mm,force:-0.5*N,current:A; "
        "a minus sign skips a column. count is a running sample number of 8, 16, 32 or 64 "
        "bits.",
    )
    rate: float = option(
        math.nan, "Sample rate [Hz] of a stream without a time column, from 1 to 100000."
    )
    layout: str = option(
        "",
        "Layout of binary records in the syntax of Python's struct: < (little-endian) or > "
        "and one letter per column, such as <Hff; empty: lines of text.",
    )
    mark: str = option("", "Bytes before each binary record, in hexadecimal, such as AA55.")
    check: str = option(
        "none",
        "Checksum after each binary record, over its bytes and the mark: none, their sum (sum8), "
        "their exclusive or (xor8), or their CRC-16/XMODEM (crc16, high byte first).",
        choices=("none", "sum8", "xor8", "crc16"),
    )

    def objection(self) -> str:
        """Return the reason if options are missing or contradictory, or an empty string."""
        if not self.address:
            return "source is stream, but stream.address is empty: give the address of the sender"
        if not self.columns:
            return (
                "source is stream, but stream.columns is empty: name the columns of a line and "
                "their units, such as time:us,displacement:mm,force:N"
            )
        try:
            address = parse_address(self.address)
            form = self.row_format()
        except ValueError as error:
            return f"stream: {error}"
        if form.time_unit is None and math.isnan(self.rate):
            return "stream.columns contains no time: give stream.rate, the samples per second"
        if not (math.isnan(self.rate) or 1.0 <= self.rate <= 1e5):
            return f"stream.rate is {self.rate:g} Hz: it must be from 1 to 100000 Hz"
        if form.time_unit is not None and not math.isnan(self.rate):
            return "stream.columns contains a time, but stream.rate is also given: omit one of them"
        if not self.layout and (self.mark or self.check != "none"):
            return "stream.mark and stream.check need binary records, but stream.layout is empty"
        if address.kind == "serial" and self.layout and not self.mark and self.check == "none":
            return (
                "binary records over a serial line need stream.mark or stream.check to detect "
                "lost bytes"
            )
        return ""

    def row_format(self) -> RowFormat:
        """The format of the rows; raises ValueError, with a sentence."""
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
    """Samples from any sender; the source reconnects if the link is lost."""

    options = StreamOptions
    prefix = "stream."

    counted = ("readable", "unreadable")

    def open(self) -> list[str]:
        """Check the options; the connection is made when the streaming starts."""
        given: StreamOptions = self.settings
        self._address = parse_address(given.address)
        self._form = given.row_format()
        if self._address.kind == "simulated":
            mark = bytes.fromhex(given.mark)
            sender = SimulatedSender(self._form, given.rate, given.layout, mark, given.check)
            self._connect: Callable[[], Portions[bytes]] = sender.portions
        else:
            self._connect = connector(self._address, given.baud)
        self._decoder: RowDecoder = (
            RecordDecoder(self._form, given.layout, bytes.fromhex(given.mark), given.check)
            if given.layout
            else LineDecoder(self._form)
        )
        self._name = str(self._address)
        self.silence = f"nothing arrives from {given.address}: is its sender running?"
        kind = f"records {given.layout}" if given.layout else "lines"
        return [f"{kind} from {given.address}: {given.columns}"]

    def _new_times(self) -> RowTimes:
        form = self._form
        if form.time_unit is not None:
            return StampedRows(form.time_unit)
        counts = None if form.count is None else 2**form.bits
        return CountedRows(self.settings.rate, counts)

    def _samples(self, portion: Portion[bytes], *, begins: bool) -> Iterator[TimedSample]:
        datagrams = self._address.kind == "udp"
        self._times = times = self._times or self._new_times()
        if begins or datagrams:
            # Reading from a serial line starts in the middle of a row.
            self._decoder.begin(whole=self._address.kind != "serial")
        end = b"\n" if datagrams and not self.settings.layout else b""
        for row in self._decoder.feed(portion.data + end):
            self._counts["readable" if row else "unreadable"] += 1
            if row is None:
                times.skip()
            else:
                yield from times.timed(row, portion.arrival_ns)

    def _fault_of(self, new: Counter[str]) -> str:
        unread, total = new["unreadable"], new.total()
        if unread <= _MANY * total:
            return ""
        return (
            f"{unread} of {total} rows cannot be read as {self.settings.columns}, such as "
            f"'{self._decoder.example}'"
        )
