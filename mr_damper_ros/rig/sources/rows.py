"""Rows of numbers from a sender: their format, as lines of text or binary records."""

from __future__ import annotations

import binascii
import math
import re
import struct
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import NamedTuple

from mr_damper_ros.io.columns import REST, SKIPPED, Column, ColumnError, parse_columns
from mr_damper_ros.rig.blocks import Measured

_COUNT = re.compile(r"count(?::(?P<bits>\d+))?")
_BITS = (8, 16, 32, 64)


class Row(NamedTuple):
    """A line or a record: measured values, the sender's count and its time [s]; None if absent."""

    measured: Measured
    number: int | None
    time: float | None


@dataclass(frozen=True)
class RowFormat:
    """The columns of a sender.

    ``width`` is the number of columns, None if others may follow. ``count`` is the index of the
    column with the sender's count, None without one; the count has ``bits`` bits.
    """

    columns: tuple[Column, ...]
    width: int | None
    count: int | None
    bits: int
    text: str

    @property
    def time_unit(self) -> float | None:
        """The unit [s] of the sender's time; None without a time."""
        return next((item.factor for item in self.columns if item.quantity == "time"), None)

    def row(self, values: Sequence[float | bytes]) -> Row | None:
        """The row with these cells; None if they do not match the format."""
        if len(values) != self.width and (self.width is not None or len(values) < self.least):
            return None
        found: dict[str, float] = {}
        try:
            for column in self.columns:
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
        return max([column.position for column in self.columns] + [self.count or 0]) + 1


def parse_row_format(text: str) -> RowFormat:
    """The format from a description such as ``count:16,displacement:mm,-,force:kN``.

    The columns are described as in a record (:func:`mr_damper_ros.io.columns.parse_columns`); the
    sender increments the additional column ``count``. Its number of bits follows after a colon
    (default: 32). Raises ColumnError, with a sentence that says what to change.
    """
    entries = [entry.strip() for entry in text.split(",")]
    counting = [place for place, entry in enumerate(entries) if _COUNT.fullmatch(entry)]
    if len(counting) > 1:
        raise ColumnError("the columns contain count twice: use it once")
    bits = 32
    if counting:
        match = _COUNT.fullmatch(entries[counting[0]])
        assert match
        bits = int(match["bits"] or bits)
        if bits not in _BITS:
            raise ColumnError(f"a count of {bits} bits is not supported: use 8, 16, 32 or 64")
        entries[counting[0]] = SKIPPED
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
    if counting and "time" in columns.quantities:
        raise ColumnError(
            f"the columns hold a count and a time, but only one is needed: write {SKIPPED} for the "
            "other one"
        )
    wanted = tuple(column for column in columns.wanted if column.quantity != "velocity")
    assert columns.width is not None or entries[-1] == REST
    return RowFormat(wanted, columns.width, counting[0] if counting else None, bits, text)


def _whole(cell: float | bytes) -> int:
    """The count in a cell, also written as 12.000000. Raises ValueError for any other cell."""
    if isinstance(cell, bytes) and b"." in cell:
        cell = cell.rstrip(b" 0").removesuffix(b".")
    return int(cell)


_LONGEST_LINE = 1024
"""Largest number of bytes in a line of numbers."""

_LAYOUT = re.compile(r"[<>](?:\d*x|[bBhHiIqQefd])+")
_SURE = 3
"""Number of records in a row that must match before the decoder is synchronised again."""


class LineDecoder:
    """Decodes lines of numbers, separated by commas, semicolons, tabs or blanks.

    A line with # is a comment. ``example`` is the last unreadable line, for messages.
    """

    def __init__(self, form: RowFormat) -> None:
        self._form = form
        self.example = ""
        self._rest = b""
        self._skips = True

    def begin(self, *, whole: bool) -> None:
        """Discard incomplete data. ``whole``: the next data begins at the start of a line."""
        self._rest, self._skips = b"", not whole

    def feed(self, data: bytes) -> list[Row | None]:
        """Add data; returns the rows of the complete lines, None for each unreadable one."""
        *lines, rest = (self._rest + data).split(b"\n")
        rows = [row for line in lines for row in self._rows_of(line)]
        if len(rest) > _LONGEST_LINE:
            # The end of an overlong line is also discarded.
            if not self._skips:
                self.example = _shown(rest)
                rows.append(None)
            rest, self._skips = b"", True
        self._rest = rest
        return rows

    def _rows_of(self, line: bytes) -> list[Row | None]:
        """The row of a line; none for an empty line, a comment or the rest of a line."""
        if self._skips:
            self._skips = False
            return []
        line = line.strip()
        if not line or line.startswith(b"#"):
            return []
        separator = next((mark for mark in (b";", b",", b"\t") if mark in line), None)
        row = self._form.row(line.split(separator)) if len(line) <= _LONGEST_LINE else None
        if row is None:
            self.example = _shown(line)
        return [row]


def _shown(data: bytes) -> str:
    """The beginning of unreadable data, as text."""
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
        self._size, self._check = CHECKS[check]
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
        if not data.startswith(self._mark, at):
            return False
        end = at + self._whole - self._size
        return self._size == 0 or self._check(data[at:end]) == data[end : end + self._size]


RowDecoder = LineDecoder | RecordDecoder

CHECKS: dict[str, tuple[int, Callable[[bytes], bytes]]] = {
    "none": (0, bytes),
    "sum8": (1, lambda data: bytes([sum(data) & 0xFF])),
    "xor8": (1, lambda data: bytes([reduce(xor, data, 0)])),
    "crc16": (2, lambda data: binascii.crc_hqx(data, 0).to_bytes(2, "big")),
}
"""Length in bytes of each check, and its function of mark and record. The CRC is CRC-16/XMODEM."""


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
        letter = re.sub(r"[<>]|\d*x", "", layout)[form.count]
        bits = 8 * struct.calcsize("<" + letter)
        if letter in "efd" or bits != form.bits:
            raise ValueError(
                f"the count has {form.bits} bits, but {letter} in the layout '{layout}' "
                + ("is no integer" if letter in "efd" else f"has {bits}: write count:{bits}")
            )


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
        cells = self._cells(k)
        if not self._layout:
            return ",".join(f"{cell:.10g}" for cell in cells).encode() + b"\n"
        letters = re.sub(r"[<>]|\d*x", "", self._layout)
        values = [
            cell if letter in "efd" else round(cell)
            for cell, letter in zip(cells, letters, strict=True)
        ]
        data = self._mark + struct.pack(self._layout, *values)
        size, check = self._check
        return data + check(data)[:size]

    def _cells(self, k: int) -> list[float]:
        form, time = self._form, k / self._rate
        measured = {
            "time": time,
            "displacement": 0.005 * math.sin(2.0 * math.pi * time),
            "force": 1000.0 * math.tanh(3.0 * math.cos(2.0 * math.pi * time)),
            "current": 1.5,
            "temperature": 25.0,
        }
        cells = [0.0] * (form.width or form.least)
        for column in form.columns:
            value = (measured[column.quantity] - column.offset) / column.factor
            cells[column.position] = value
        if form.count is not None:
            cells[form.count] = k % 2**form.bits
        return cells
