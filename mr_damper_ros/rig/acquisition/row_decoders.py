"""Bytes as they come become rows: lines of text, or binary records."""

from __future__ import annotations

import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable

from mr_damper_ros.rig.acquisition.row_format import Row, RowFormat

_LONGEST_LINE = 1024
"""Bytes; what is longer is no line of numbers."""

_SHOWN = 40

_LAYOUT = re.compile(r"[<>](?:\d*x|[bBhHiIqQefd])+")
_SURE = 3
"""Records in a row that must fit before a stream that was out of step is believed."""


class RowDecoder(ABC):
    """Takes bytes in as they come. ``example`` is the last that could not be read, for people."""

    def __init__(self, form: RowFormat) -> None:
        self._form = form
        self.example = ""

    @abstractmethod
    def begin(self, *, whole: bool) -> None:
        """Forget what has begun. ``whole``: what comes next begins with a row."""

    @abstractmethod
    def feed(self, data: bytes) -> list[Row | None]:
        """The rows that are complete now; None for each that was there and cannot be read."""

    def _unreadable(self, data: bytes) -> None:
        shown = data[:_SHOWN].decode("ascii", "replace")
        self.example = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in shown)


class LineDecoder(RowDecoder):
    """Numbers in lines, between commas, semicolons, tabs or blanks; a line of # is a remark."""

    def __init__(self, form: RowFormat) -> None:
        super().__init__(form)
        self._rest = b""
        self._skips = True

    def begin(self, *, whole: bool) -> None:
        """Forget the line that has begun; the next may be the end of one that is not wanted."""
        self._rest, self._skips = b"", not whole

    def feed(self, data: bytes) -> list[Row | None]:
        """The rows of the lines that are complete now."""
        *lines, rest = (self._rest + data).split(b"\n")
        rows = [row for line in lines for row in self._rows_of(line)]
        if len(rest) > _LONGEST_LINE:
            # The end of it is no line either.
            if not self._skips:
                self._unreadable(rest)
                rows.append(None)
            rest, self._skips = b"", True
        self._rest = rest
        return rows

    def _rows_of(self, line: bytes) -> list[Row | None]:
        """The row of a line; none of an empty one, of a remark, of the end of a line."""
        if self._skips:
            self._skips = False
            return []
        line = line.strip()
        if not line or line.startswith(b"#"):
            return []
        row = self._form.row(line.split(_separator(line))) if len(line) <= _LONGEST_LINE else None
        if row is None:
            self._unreadable(line)
        return [row]


def _separator(line: bytes) -> bytes | None:
    """What separates the cells; blanks around it belong to none of them."""
    return next((mark for mark in (b";", b",", b"\t") if mark in line), None)


class RecordDecoder(RowDecoder):
    """Records of a fixed ``layout`` (as of :mod:`struct`), each after the bytes ``mark``.

    ``check`` is a sum over the record, and stands behind it. Bytes that were lost or added show by
    mark and sum: what comes then is believed when several records in a row fit.
    """

    def __init__(self, form: RowFormat, layout: str, mark: bytes, check: str) -> None:
        super().__init__(form)
        self._struct = struct.Struct(layout)
        self._mark = mark
        self._size, self._check = CHECKS[check]
        self._whole = len(mark) + self._struct.size + self._size
        self._rest = b""
        self._in_step = True

    def begin(self, *, whole: bool) -> None:
        """Forget the record that has begun."""
        self._rest, self._in_step = b"", whole or not (self._mark or self._size)

    def feed(self, data: bytes) -> list[Row | None]:
        """The rows of the records that are complete now."""
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
                self._unreadable(data[at : at + self._whole].hex(" ").encode())
                continue
            row = self._form.row(self._struct.unpack_from(data, at + len(self._mark)))
            if row is None:
                self._unreadable(data[at : at + self._whole].hex(" ").encode())
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


def _sum8(data: bytes) -> bytes:
    return bytes([sum(data) & 0xFF])


def _xor8(data: bytes) -> bytes:
    value = 0
    for byte in data:
        value ^= byte
    return bytes([value])


def _crc16(data: bytes) -> bytes:
    """CRC-16/XMODEM, the high byte first."""
    import binascii

    return binascii.crc_hqx(data, 0).to_bytes(2, "big")


CHECKS: dict[str, tuple[int, Callable[[bytes], bytes]]] = {
    "none": (0, bytes),
    "sum8": (1, _sum8),
    "xor8": (1, _xor8),
    "crc16": (2, _crc16),
}
"""Bytes of each check, and how it is reckoned over mark and record."""


def check_layout(layout: str, form: RowFormat) -> None:
    """Raise ValueError, with a sentence, where a layout is none or does not have these columns."""
    if _LAYOUT.fullmatch(layout) is None:
        raise ValueError(
            f"the layout '{layout}' cannot be used: begin with < (low byte first) or > and write a "
            "letter for each column, such as <Hff, with those of Python's struct: b B h H i I q Q "
            "e f d, x for a byte to skip"
        )
    count = len(struct.unpack(layout, bytes(struct.calcsize(layout))))
    if form.width is None or count != form.width:
        raise ValueError(
            f"the layout '{layout}' holds {count} numbers, and the columns '{form.text}' are "
            f"{form.width or 'open-ended'}: describe each of them"
        )
    if form.count is not None:
        letter = re.sub(r"[<>]|\d*x", "", layout)[form.count]
        bits = 8 * struct.calcsize("<" + letter)
        if letter in "efd" or bits != form.bits:
            raise ValueError(
                f"the count has {form.bits} bits, and {letter} in the layout '{layout}' is "
                + ("no integer" if letter in "efd" else f"one of {bits}: write count:{bits}")
            )
