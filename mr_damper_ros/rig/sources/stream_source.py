"""Lines or binary records as a source: over a serial line, by TCP, or as UDP datagrams."""

from __future__ import annotations

import binascii
import math
import re
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from operator import xor
from typing import Any, NamedTuple

from mr_damper_ros.data_check.findings import Finding, Kind
from mr_damper_ros.io.columns import REST, SKIPPED, ColumnError, Columns, parse_columns
from mr_damper_ros.rig.blocks import Measured
from mr_damper_ros.rig.sources.device_source import (
    POLL,
    CountedRows,
    DeviceSource,
    Portion,
    Portions,
    Row,
    RowTimes,
    StampedRows,
    library,
)
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.blocks import SILENCE

_COUNT = re.compile(r"count(?::(?P<bits>\d+))?")


@dataclass(frozen=True)
class RowFormat(Columns):
    """The columns of a sender.

    ``count`` is the index of the column with the sender's count, None without one; the count has
    ``bits`` bits.
    """

    count: int | None
    bits: int

    @property
    def time_unit(self) -> float | None:
        """The unit [s] of the sender's time; None without a time."""
        return next((item.factor for item in self.wanted if item.quantity == "time"), None)

    def row(self, values: Sequence[float | bytes]) -> Row | None:
        """The row with these cells; None if they do not match the format."""
        if len(values) != self.width and (self.width is not None or len(values) < self.least):
            return None
        found: dict[str, float] = {}
        try:
            for column in self.wanted:
                value = float(values[column.position])
                found[column.quantity] = value * column.factor + column.offset
            number = None if self.count is None else _whole(values[self.count])
        except (ValueError, OverflowError):
            return None
        time = found.pop("time", None)
        measured = Measured(**found)
        if not measured.possible or (time is not None and not 0.0 <= time < 2.0**31):
            return None
        return Row(measured, number, time)

    @property
    def least(self) -> int:
        """Smallest number of cells."""
        return max([column.position for column in self.wanted] + [self.count or 0]) + 1


def parse_row_format(text: str) -> RowFormat:
    """The format from a description such as ``count:16,displacement:mm,-,force:kN``.

    The columns are described as in a record (:func:`mr_damper_ros.io.columns.parse_columns`); the
    sender increments the additional column ``count``. Its number of bits follows after a colon
    (default: 32). Raises ColumnError, with a sentence that says what to change.
    """
    entries = [entry.strip() for entry in text.split(",")]
    counts = {k: match for k, entry in enumerate(entries) if (match := _COUNT.fullmatch(entry))}
    if len(counts) > 1:
        raise ColumnError("the columns contain count twice: use it once")
    count, bits = None, 32
    for count, match in counts.items():
        bits = int(match["bits"] or bits)
        if bits not in (8, 16, 32, 64):
            raise ColumnError(f"a count of {bits} bits is not supported: use 8, 16, 32 or 64")
        entries[count] = SKIPPED
    columns = parse_columns(",".join(entries))
    for column in columns.wanted:
        if column.header:
            raise ColumnError(
                f"the column '{column.header}' is selected by a header, which a stream does not "
                "have: list the columns in order, such as displacement:mm,force:N"
            )
        if column.holds_dates:
            raise ColumnError("a stream cannot hold dates: send the time in seconds")
    if "displacement" not in columns.quantities:
        raise ColumnError(
            "no column holds the displacement: a velocity does not suffice for a stream"
        )
    if counts and "time" in columns.quantities:
        raise ColumnError(
            f"the columns hold a count and a time, but only one is needed: write {SKIPPED} for the "
            "other one"
        )
    wanted = tuple(column for column in columns.wanted if column.quantity != "velocity")
    assert columns.width is not None or entries[-1] == REST
    return RowFormat(wanted, columns.width, text, count, bits)


def _whole(cell: float | bytes) -> int:
    """The count in a cell, also written as 12.000000. Raises ValueError for any other cell."""
    if isinstance(cell, bytes) and b"." in cell:
        cell = cell.rstrip(b" 0").removesuffix(b".")
    return int(cell)


_LONGEST_LINE = 1024
"""Largest number of bytes in a line of numbers."""

_RETURNS = 3
"""Number of carriage returns without a line feed from which they must be the ends of lines."""

_LAYOUT = re.compile(r"[<>](?:\d*x|[bBhHiIqQefd])+")
_SURE = 3
"""Number of records in a row that must match before the decoder is synchronised again."""


class LineDecoder:
    """Decodes lines of numbers, separated by commas, semicolons, tabs or blanks.

    A line with # is a comment. ``example`` is the last unreadable line, for messages. ``unended``
    is the number of bytes, and ``returns`` of carriage returns, since the last line feed.
    """

    def __init__(self, form: RowFormat) -> None:
        self._form = form
        self.example = ""
        self.unended = self.returns = 0
        self._rest = b""
        self._skips = True

    def begin(self, *, whole: bool) -> None:
        """Discard incomplete data. ``whole``: the next data begins at the start of a line."""
        self._rest, self._skips = b"", not whole

    def feed(self, data: bytes) -> list[Row | None]:
        """Add data; returns the rows of the complete lines, None for each unreadable one."""
        *lines, rest = (self._rest + data).split(b"\n")
        if lines:
            self.unended = self.returns = 0
        tail = data.rpartition(b"\n")[2]
        self.unended += len(tail)
        self.returns += tail.count(b"\r")
        if self._skips and lines:
            self._skips = False
            del lines[0]
        filled = (line for line in map(bytes.strip, lines) if line and not line.startswith(b"#"))
        rows = [self._row(line) for line in filled]
        if len(rest) > _LONGEST_LINE:
            # The end of an overlong line is also discarded.
            if not self._skips:
                rows.append(self._row(rest))
            rest, self._skips = b"", True
        self._rest = rest
        return rows

    def _row(self, line: bytes) -> Row | None:
        separator = next((mark for mark in (b";", b",", b"\t") if mark in line), None)
        row = self._form.row(line.split(separator)) if len(line) <= _LONGEST_LINE else None
        if row is None:
            self.example = _shown(line)
        return row


def _shown(data: bytes) -> str:
    text = data[:40].decode("ascii", "replace")
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


class RecordDecoder:
    """Decodes records of a fixed ``layout`` (as in :mod:`struct`), each after the bytes ``mark``.

    ``check`` is the checksum at the end of a record. Mark and checksum show lost or additional
    bytes. After an error, the decoder skips data until several records in a row match. ``example``
    is the last unreadable record, for messages.
    """

    def __init__(self, form: RowFormat, layout: str, mark: bytes, check: str) -> None:
        self._form = form
        self.example = ""
        self._struct = struct.Struct(layout)
        self._mark = mark
        self._check = CHECKS[check]
        self._size = len(self._check(b""))
        self._whole = len(mark) + self._struct.size + self._size
        self._rest = b""
        self._in_step = True

    def begin(self, *, whole: bool) -> None:
        """Discard incomplete data. ``whole``: the next data begins at the start of a record."""
        self._rest, self._in_step = b"", whole or not (self._mark or self._size)

    def feed(self, data: bytes) -> list[Row | None]:
        """Add data; returns the rows of the complete records, None for each unreadable one."""
        data, at, skipped = self._rest + data, 0, 0
        rows: list[Row | None] = []
        while len(data) - at >= self._whole:
            if not self._in_step:
                if len(data) - at < _SURE * self._whole:
                    break
                if not all(self._fits(data, at + k * self._whole) for k in range(_SURE)):
                    begins = data.find(self._mark, at + 1)
                    begins = len(data) if begins < 0 else begins
                    at, skipped = begins, skipped + begins - at
                    continue
                self._in_step = True
            if not self._fits(data, at):
                self._in_step = False
                self.example = data[at : at + self._whole].hex(" ")[:40]
                continue
            row = self._form.row(self._struct.unpack_from(data, at + len(self._mark)))
            if row is None:
                self.example = data[at : at + self._whole].hex(" ")[:40]
            rows += [None] * round(skipped / self._whole)
            rows.append(row)
            at, skipped = at + self._whole, 0
        self._rest = data[at:]
        rows += [None] * round(skipped / self._whole)
        return rows

    def _fits(self, data: bytes, at: int) -> bool:
        end = at + self._whole
        checked, check = data[at : end - self._size], data[end - self._size : end]
        return data.startswith(self._mark, at) and self._check(checked) == check


RowDecoder = LineDecoder | RecordDecoder

CHECKS: dict[str, Callable[[bytes], bytes]] = {
    "none": lambda _: b"",
    "sum8": lambda data: bytes([sum(data) & 0xFF]),
    "xor8": lambda data: bytes([reduce(xor, data, 0)]),
    "crc16": lambda data: binascii.crc_hqx(data, 0).to_bytes(2, "big"),
}
"""Each check as a function of mark and record. The CRC is CRC-16/XMODEM."""


def check_layout(layout: str, form: RowFormat) -> None:
    """Raise ValueError, with a sentence, if a layout is invalid or does not match the columns."""
    if _LAYOUT.fullmatch(layout) is None:
        raise ValueError(
            f"the layout '{layout}' cannot be used: begin with < (low byte first) or >, and write "
            "a letter of Python's struct for each column, such as <Hff: one of b B h H i I q Q e f "
            "d, or x for a byte to skip"
        )
    count = len(struct.unpack(layout, bytes(struct.calcsize(layout))))
    if form.width is None or count != form.width:
        raise ValueError(
            f"the layout '{layout}' holds {count} numbers, but the number of columns in "
            f"'{form.text}' is {form.width or 'open'}: describe each number by one column"
        )
    if form.count is not None:
        letter = _letters(layout)[form.count]
        bits = 8 * struct.calcsize("<" + letter)
        if letter in "efd" or bits != form.bits:
            raise ValueError(
                f"the count has {form.bits} bits, but {letter} in the layout '{layout}' "
                + ("is no integer" if letter in "efd" else f"has {bits}: write count:{bits}")
            )


def _letters(layout: str) -> str:
    """The letter of each number in a layout."""
    return re.sub(r"[<>]|\d*x", "", layout)


class SimulatedSender:
    """Simulates a sender: 5 mm at 1 Hz, 1 kN, 1.5 A and 25 °C; records follow the ``mark``."""

    def __init__(
        self, form: RowFormat, rate: float, layout: str = "", mark: bytes = b"", check: str = "none"
    ) -> None:
        self._form = form
        self._rate = 1000.0 if math.isnan(rate) else rate
        self._layout, self._mark, self._check = layout, mark, CHECKS[check]

    def portions(self) -> Generator[bytes | None, None, None]:
        """Yield the data that is due at each request."""
        began, sent = time.monotonic(), 0
        while True:
            until = math.floor((time.monotonic() - began) * self._rate)
            yield b"".join(self.row(k) for k in range(sent, until)) or None
            sent = until

    def row(self, k: int) -> bytes:
        """Line or record number ``k``."""
        form, time = self._form, k / self._rate
        measured = {
            "time": time,
            "displacement": 0.005 * math.sin(2.0 * math.pi * time),
            "force": 1000.0 * math.tanh(3.0 * math.cos(2.0 * math.pi * time)),
            "current": 1.5,
            "temperature": 25.0,
        }
        cells = [0.0] * (form.width or form.least)
        for column in form.wanted:
            cells[column.position] = (measured[column.quantity] - column.offset) / column.factor
        if form.count is not None:
            cells[form.count] = k % 2**form.bits
        if not self._layout:
            return ",".join(f"{cell:.10g}" for cell in cells).encode() + b"\n"
        values = [
            cell if letter in "efd" else round(cell)
            for cell, letter in zip(cells, _letters(self._layout), strict=True)
        ]
        data = self._mark + struct.pack(self._layout, *values)
        return data + self._check(data)


_LARGEST = 65535
"""Largest number of bytes in one read: the size of the largest datagram."""

_KEEP_ALIVE = (("TCP_KEEPIDLE", 2), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 3))
"""TCP keep-alive options, to detect that the cable of a silent sender is disconnected."""

_FORM = re.compile(
    r"serial:(?P<port>\S+)|(?P<kind>tcp|udp):(?P<host>\[[0-9a-fA-F:.]+\]|[^\s:\[\]]+):"
    r"(?P<number>\d{1,5})"
)


class LinkAddress(NamedTuple):
    """``kind`` is serial, tcp, udp or simulated; ``host`` is also the name of a serial port."""

    kind: str
    host: str = ""
    number: int = 0


def parse_address(text: str) -> LinkAddress:
    """The address in a text; raises ValueError with a sentence."""
    if text.strip() == "simulated":
        return LinkAddress("simulated")
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
        serial = library("serial", f"the serial line {address.host}", "pyserial==3.5")
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


_CARRIAGE_RETURNS = (
    ", but with carriage returns (CR): let the sender end each line by a line feed (LF or CR LF)"
)
_NO_LINES = (
    ": correct stream.baud, let the sender end each line by a line feed, or describe binary "
    "records by stream.layout"
)

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
        choices=tuple(CHECKS),
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
        mark = bytes.fromhex(given.mark)
        if self._address.kind == "simulated":
            sender = SimulatedSender(self._form, given.rate, given.layout, mark, given.check)
            self._connect: Callable[[], Portions[bytes]] = sender.portions
        else:
            self._connect = connector(self._address, given.baud)
        self._decoder: RowDecoder = LineDecoder(self._form)
        if given.layout:
            self._decoder = RecordDecoder(self._form, given.layout, mark, given.check)
        self._name = given.address.partition(":")[2]
        self.sender = given.address
        kind = f"records {given.layout}" if given.layout else "lines"
        return [f"{kind} from {given.address}: {given.columns}"]

    def _new_times(self, data: bytes) -> RowTimes:
        form = self._form
        if form.time_unit is not None:
            return StampedRows(form.time_unit)
        return CountedRows(self.settings.rate, None if form.count is None else 2**form.bits)

    def _rows(self, portion: Portion[bytes], *, begins: bool) -> Iterator[tuple[Row | None, int]]:
        datagrams = self._address.kind == "udp"
        if begins or datagrams:
            # Reading from a serial line starts in the middle of a row.
            self._decoder.begin(whole=self._address.kind != "serial")
        end = b"\n" if datagrams and not self.settings.layout else b""
        for row in self._decoder.feed(portion.data + end):
            self._counts["readable" if row else "unreadable"] += 1
            yield row, portion.arrival_ns

    def _finding_of(self, counts: Counter[str]) -> Finding | None:
        decoder = self._decoder
        if isinstance(decoder, LineDecoder) and (
            decoder.unended > _LONGEST_LINE or decoder.returns >= _RETURNS
        ):
            how = _CARRIAGE_RETURNS if decoder.returns >= _RETURNS else _NO_LINES
            return Kind.NO_LINE_END.found(sender=self.sender, count=decoder.unended, how=how)
        unread, total = counts["unreadable"], counts["unreadable"] + counts["readable"]
        if unread <= _MANY * total:
            return None
        columns = self.settings.columns
        return Kind.UNREADABLE.found(
            count=unread, whole=total, columns=columns, example=decoder.example
        )
