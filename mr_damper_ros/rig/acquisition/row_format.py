"""What a sender puts into a line or a record, as users describe it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from mr_damper_ros.io.columns import REST, SKIPPED, Column, ColumnError, parse_columns
from mr_damper_ros.rig.acquisition.block_maker import Measured

_COUNT = re.compile(r"count(?::(?P<bits>\d+))?")
_BITS = (8, 16, 32, 64)
_LONGEST = 2.0**31
"""Seconds: no clock shows more that stamps can hold."""


class Row(NamedTuple):
    """A line or a record: what was measured, the sender's count or its time [s]; None without."""

    measured: Measured
    number: int | None
    time: float | None


@dataclass(frozen=True)
class RowFormat:
    """The columns of a sender. ``width`` is how many there are, None where others may follow.

    ``count`` is the place of the sender's count, None without, which has ``bits``.
    """

    columns: tuple[Column, ...]
    width: int | None
    count: int | None
    bits: int
    text: str

    @property
    def time_unit(self) -> float | None:
        """What the sender's time counts in [s]; None where it has none."""
        return next((item.factor for item in self.columns if item.quantity == "time"), None)

    def row(self, values: Sequence[float | bytes]) -> Row | None:
        """The row of these cells; None where they are not such."""
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
        if not measured.possible or (time is not None and not 0.0 <= time < _LONGEST):
            return None
        return Row(measured, number, time)

    @property
    def least(self) -> int:
        """How many cells there must be."""
        places = [column.position for column in self.columns]
        return max([*places, -1 if self.count is None else self.count]) + 1


def parse_row_format(text: str) -> RowFormat:
    """The format from a description such as ``count:16,displacement:mm,-,force:kN``.

    That of the columns of a record (:func:`mr_damper_ros.io.columns.parse_columns`), with ``count``
    for a number that the sender counts up, and after a colon how many bits it has (32 where that is
    left out). Raises ColumnError, in one sentence that says what to change.
    """
    entries = [entry.strip() for entry in text.split(",")]
    counting = [place for place, entry in enumerate(entries) if _COUNT.fullmatch(entry)]
    if len(counting) > 1:
        raise ColumnError("the columns name count twice: name it once")
    bits = 32
    if counting:
        match = _COUNT.fullmatch(entries[counting[0]])
        assert match
        bits = int(match["bits"] or bits)
        if bits not in _BITS:
            raise ColumnError(f"a count of {bits} bits is none: use 8, 16, 32 or 64")
        entries[counting[0]] = SKIPPED
    columns = parse_columns(",".join(entries))
    for column in columns.wanted:
        if column.header:
            raise ColumnError(
                f"the column '{column.header}' is named by a header: name the columns of a stream "
                "by their order, such as displacement:mm,force:N"
            )
        if column.holds_dates:
            raise ColumnError("a stream cannot hold dates: send the time in seconds")
    if "displacement" not in columns.quantities:
        raise ColumnError("no column holds the displacement: a velocity does not do for a stream")
    if counting and "time" in columns.quantities:
        raise ColumnError(
            f"the columns hold a count and a time, and only one is needed: write {SKIPPED} for the "
            "other"
        )
    wanted = tuple(column for column in columns.wanted if column.quantity != "velocity")
    assert columns.width is not None or entries[-1] == REST
    return RowFormat(wanted, columns.width, counting[0] if counting else None, bits, text)


def _whole(cell: float | bytes) -> int:
    """The count in a cell; some programs write 12.000000. Raises ValueError for other cells."""
    if isinstance(cell, bytes) and b"." in cell:
        cell = cell.rstrip(b" 0").removesuffix(b".")
    return int(cell)
