"""Columns from text files.

The files may be of any size: they are read line by line, and only the numbers are kept in memory.
"""

from __future__ import annotations

import csv
import re
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import datetime, timezone
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import TextIO

import numpy as np

from mr_damper_ros.io.columns import Columns, RawTable, RecordError, too_long
from mr_damper_ros.signals.arrays import Array

_DATE_AND_TIME = re.compile(
    r"\s*(\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4})[ T]+(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?"
    r"\s*(?:([AaPp])\.?[Mm]\.?)?\s*(Z|[+-]\d{2}:?\d{2})?\s*"
)
"""Date, hour, minute, second, AM or PM, time zone."""


def seconds_since_1970(text: str) -> float | None:
    """Parse a date with the time of day; returns seconds since 1970, or None for other text.

    Without a time zone, the time is UTC. If the first number is above 31, the order of the date is
    year, month, day. Otherwise, with slashes and a first number of at most 12, it is month, day,
    year; in all other cases, it is day, month, year.
    """
    found = _DATE_AND_TIME.fullmatch(text)
    if found is None:
        return None
    begins = _minute(*found.group(1, 2, 3, 5, 6))
    seconds = float((found[4] or "0").replace(",", "."))
    return None if begins is None or seconds >= 61.0 else begins + seconds


@lru_cache(maxsize=64)
def _minute(calendar: str, hour: str, minute: str, half: str, zone: str) -> float | None:
    """Seconds from 1970 to the start of a minute; None for an invalid date."""
    a, b, c = (int(part) for part in re.split(r"[-/.]", calendar))
    if a > 31:
        year, month, day = a, b, c
    elif "/" in calendar and a <= 12:
        year, month, day = c, a, b
    else:
        year, month, day = c, b, a
    hours, year = int(hour), year + (2000 if year < 100 else 0)
    # Some loggers write AM or PM even if the hour is above 12.
    if half and hours <= 12:
        hours = hours % 12 + (12 if half in "Pp" else 0)
    offset = 0
    if zone and zone != "Z":
        offset = int(f"{zone[0]}1") * (3600 * int(zone[1:3]) + 60 * int(zone[-2:]))
    try:
        begins = datetime(year, month, day, hours, int(minute), tzinfo=timezone.utc)
    except ValueError:
        return None
    return begins.timestamp() - offset


_LONGEST_LINE = 100_000
"""Largest number of characters of a line.

Lines of tables are far shorter, and the library limits the length of a field.
"""

_LAST_LINES = 50
"""Number of lines at the end of a file from which the separator is detected."""

_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?$|[+-]?\d+$")

Row = tuple[int, list[str]]
"""Number of a line (from 1) and its fields."""

Cell = tuple[int, Callable[[str], float | None]]
"""Position of a field in a row, and the function that reads its number."""


def read_text_table(
    path: Path, columns: Columns, variable: str | None, maximum_samples: int
) -> RawTable:
    """Read columns by position or header; lines before the first row of numbers are skipped.

    Raises RecordError.
    """
    if variable is not None:
        raise RecordError(f"{path.name} is a text file and has no variables: choose no variable")
    with path.open("rb") as file:
        start = file.read(4096)
    if start.startswith(b"PK"):
        raise RecordError(
            f"{path.name} is an archive, or a spreadsheet with another ending: first save it as "
            "XLSX or CSV"
        )

    def text(encoding: str, errors: str = "strict") -> TextFile:
        return TextFile(lambda: path.open(encoding=encoding, errors=errors), path.name)

    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        lines = text("utf-16", "replace")
    elif b"\0" in start:
        raise RecordError(f"{path.name} is not a text file: export it as text, CSV or MAT")
    else:
        try:
            lines = text("utf-8-sig")
        except UnicodeDecodeError:
            lines = text("latin-1")
    return lines.table(columns, maximum_samples)


class TextFile:
    """A text of lines with fields.

    ``opened`` opens the text and is called repeatedly. ``name`` is its name in messages.
    ``separator`` separates the fields; by default, it is detected.
    """

    def __init__(
        self, opened: Callable[[], TextIO], name: str, separator: str | None = None
    ) -> None:
        self._open = opened
        self._name = name
        last: deque[tuple[int, str]] = deque(maxlen=_LAST_LINES)
        self._row_count = 0
        for row in self._filled_lines():
            self._row_count += 1
            last.append(row)
        # The last lines hold numbers and no header.
        self._last = list(last)[-(self._row_count - self._row_count // 2) :]
        if separator is None:
            separator = _separator([line for _, line in self._last])
        self._separator = separator

    def table(self, columns: Columns, maximum_samples: int) -> RawTable:
        """The numbers in the columns; raises RecordError."""
        rows = self._rows()
        skipped, positions = 0, [column.position for column in columns.wanted]
        if columns.by_header:
            skipped, positions = self._find_header([c.header for c in columns.wanted], rows)
        cells = [
            (position, seconds_since_1970 if column.holds_dates else self._number)
            for position, column in zip(positions, columns.wanted, strict=True)
        ]
        numbers = (_numbers_of(fields, cells) for _, fields in rows)
        first = next((k for k, row in enumerate(numbers, start=skipped) if row), None)
        if first is None:
            listed = ", ".join(str(position + 1) for position in positions)
            raise RecordError(
                f"{self._name} holds no row with numbers in columns {listed}: "
                f"{self._example(skipped)}"
            )
        # The table ends at the last column that has a number in each of the last rows.
        numeric = [
            {place for place, field in enumerate(fields) if self._number(field) is not None}
            for _, fields in self._split(self._last)
        ]
        columns.check_width(self._name, max(set.intersection(*numeric), default=-1) + 1)
        if self._row_count - first > maximum_samples:
            raise too_long(self._name, maximum_samples)
        table = self._table(first, cells)
        return RawTable(
            {column.quantity: table[:, k] for k, column in enumerate(columns.wanted)},
            lambda row: f"line {next(islice(self._filled_lines(), first + row, None))[0]}",
        )

    def _number(self, field: str) -> float | None:
        try:
            return float(field if self._separator == "," else field.replace(",", "."))
        except ValueError:
            return None

    def _table(self, first: int, cells: Sequence[Cell]) -> Array:
        """Numbers (n, columns) of the rows from the index ``first`` on."""
        try:
            numbers = np.loadtxt(
                (line for _, line in islice(self._filled_lines(), first, None)),
                delimiter=self._separator or None,
                quotechar='"' if self._separator else None,
                comments=None,
                usecols=[position for position, _ in cells],
                converters={p: read for p, read in cells if read is seconds_since_1970} or None,
                encoding=None,
                ndmin=2,
            )
        except (ValueError, TypeError) as error:
            # numpy.loadtxt takes an interrupt within a converter for a wrong value.
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            numbers = np.empty((0, len(cells)))
        if len(numbers) == self._row_count - first:
            return numbers
        # numpy.loadtxt cannot read decimal commas, and does not report the line of an error.
        values = array("d")
        for line, fields in islice(self._rows(), first, None):
            row = _numbers_of(fields, cells)
            if row is None:
                raise RecordError(_unreadable_line(self._name, line, fields, cells))
            values.extend(row)
        return np.frombuffer(values).reshape(-1, len(cells))

    def _find_header(self, names: list[str], rows: Iterator[Row]) -> tuple[int, list[int]]:
        """Read rows up to the header; returns their number and the positions of the columns."""
        best: list[str] = []
        for number, (_, fields) in enumerate(rows, start=1):
            if all(name in fields for name in names):
                return number, [fields.index(name) for name in names]
            # The line with the most matching names is probably the header.
            if not best or sum(n in fields for n in names) > sum(n in best for n in names):
                best = fields
        missing = ", ".join(name for name in names if name not in best)
        raise RecordError(
            f"no line of {self._name} names the columns {', '.join(names)}: "
            f"'{'; '.join(best)}' lacks {missing}"
        )

    def _example(self, skipped: int) -> str:
        """Description of a row in the middle of the file, as an example for a message."""
        if skipped == self._row_count:
            return "its header is its last line" if skipped else "it is empty"
        line, fields = next(islice(self._rows(), (skipped + self._row_count) // 2, None))
        dates = any(seconds_since_1970(field) is not None for field in fields)
        hint = " (the unit of a date is time:datetime)" if dates else ""
        return f"its line {line} has {len(fields)} columns, '{'; '.join(fields)}'{hint}"

    def _filled_lines(self) -> Iterator[tuple[int, str]]:
        """Line numbers (from 1) and text of the lines that are not empty."""
        with self._open() as file:
            lines = iter(lambda: file.readline(_LONGEST_LINE + 1), "")
            for number, line in enumerate(lines, start=1):
                if len(line) > _LONGEST_LINE:
                    raise RecordError(
                        f"line {number} of {self._name} has more than {_LONGEST_LINE} characters: "
                        "is it a text table with one row in each line?"
                    )
                if line.strip():
                    yield number, line

    def _rows(self) -> Iterator[Row]:
        return self._split(self._filled_lines())

    def _split(self, lines: Iterable[tuple[int, str]]) -> Iterator[Row]:
        for number, line in lines:
            if not self._separator:
                yield number, line.split()
                continue
            reader = csv.reader([line], delimiter=self._separator, skipinitialspace=True)
            try:
                fields = next(reader, [])
            except csv.Error as error:
                raise RecordError(
                    f"line {number} of {self._name} cannot be split into fields: {error}"
                ) from error
            yield number, [field.strip() for field in fields]


def _separator(sample: Sequence[str]) -> str:
    """The separator of fields: ";", tab, ",", or "" for white space."""
    for separator in (";", "\t"):
        if any(separator in line.strip() for line in sample):
            return separator
    if not any("," in line for line in sample):
        return ""
    # "0,001 2,5" is two numbers with decimal commas; "1,2" is two fields.
    decimal = all(
        len(line.split()) > 1 and all(_DECIMAL_COMMA.match(word) for word in line.split())
        for line in sample
    )
    return "" if decimal else ","


def _numbers_of(fields: list[str], cells: Sequence[Cell]) -> list[float] | None:
    """The numbers in the cells of a row; None if one is missing."""
    found = [read(fields[p]) if p < len(fields) else None for p, read in cells]
    numbers = [number for number in found if number is not None]
    return numbers if len(numbers) == len(cells) else None


def _unreadable_line(name: str, line: int, fields: list[str], cells: Sequence[Cell]) -> str:
    last = max(position for position, _ in cells)
    if len(fields) <= last:
        return (
            f"line {line} of {name} has {len(fields)} columns, but column {last + 1} is needed: "
            "correct the line, or cut the file before it"
        )
    wrong, read = next((p, read) for p, read in cells if read(fields[p]) is None)
    kind = "date with the time of day" if read is seconds_since_1970 else "number"
    return (
        f"column {wrong + 1} in line {line} of {name} is '{fields[wrong]}', not a {kind}: correct "
        "the line, or cut the file before it"
    )
