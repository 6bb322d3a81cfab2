"""Columns from a text or CSV file, read line by line.

Files may be of any size: what is kept in memory is the numbers.
"""

from __future__ import annotations

import codecs
import csv
import re
from array import array
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from mr_damper_ros.io.raw_table import RawTable, RecordError, too_long
from mr_damper_ros.io.units import Column
from mr_damper_ros.signals.arrays import Array

_LONGEST_LINE = 100_000
"""Characters; a line of a table is far shorter, and a field may have no more for the library."""

_LOOKED_AT = 50
"""Lines at the end of a file that tell what separates its fields."""

_CHUNK = 1 << 20

_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?$|[+-]?\d+$")

Row = tuple[int, list[str]]
"""Number of a line, from 1, and its fields."""


def read_text_table(
    path: Path, columns: Sequence[Column], variable: str | None, maximum_samples: int
) -> RawTable:
    """Read columns by their place or header; lines before the first row of numbers are skipped.

    Raises RecordError.
    """
    if variable is not None:
        raise RecordError(f"{path.name} is a text file and has no variables: choose no variable")
    return _TextFile(path).table(columns, maximum_samples)


class _TextFile:
    """A file with its encoding, what separates its fields, and its number of filled lines."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._name = path.name
        self._encoding = _encoding(path)
        last: deque[str] = deque(maxlen=_LOOKED_AT)
        self._row_count = 0
        for _, line in self._filled_lines():
            self._row_count += 1
            last.append(line)
        # The last lines hold numbers, whatever the header looks like.
        self._separator = _separator(list(last)[-(self._row_count - self._row_count // 2) :])

    def table(self, columns: Sequence[Column], maximum_samples: int) -> RawTable:
        """The numbers in these columns."""
        rows = self._rows()
        skipped, positions = 0, [column.position for column in columns]
        if columns[0].header:
            skipped, positions = self._find_header([column.header for column in columns], rows)
        first = self._first_row(rows, positions, skipped)
        if self._row_count - first > maximum_samples:
            raise too_long(self._name, maximum_samples)
        numbers = self._numbers(first, positions)
        return RawTable(
            {column.quantity: numbers[:, k] for k, column in enumerate(columns)},
            lambda row: f"line {self._line_of(first + row)}",
        )

    def _first_row(self, rows: Iterator[Row], positions: Sequence[int], skipped: int) -> int:
        """Index of the first row with numbers, where so many have been taken already."""
        for index, (_, fields) in enumerate(rows, start=skipped):
            if _numbers(fields, positions, self._separator):
                return index
        raise RecordError(
            f"{self._name} holds no row with numbers in columns "
            f"{', '.join(str(p + 1) for p in positions)}: {self._middle_row(skipped)}"
        )

    def _numbers(self, first: int, positions: Sequence[int]) -> Array:
        """Numbers (n, columns) of the rows from the first one on."""
        lines = (line for _, line in islice(self._filled_lines(), first, None))
        try:
            numbers = np.loadtxt(
                lines,
                delimiter=self._separator or None,
                quotechar='"' if self._separator else None,
                comments=None,
                usecols=positions,
                ndmin=2,
            )
        except ValueError:
            numbers = np.empty((0, len(positions)))
        # It knows no decimal comma, and not which line it could not read.
        if len(numbers) != self._row_count - first:
            return self._numbers_row_by_row(first, positions)
        return numbers

    def _numbers_row_by_row(self, first: int, positions: Sequence[int]) -> Array:
        values = array("d")
        for line, fields in islice(self._rows(), first, None):
            row = _numbers(fields, positions, self._separator)
            if row is None:
                raise RecordError(_unreadable(self._name, line, fields, positions, self._separator))
            values.extend(row)
        return np.frombuffer(values).reshape(-1, len(positions))

    def _line_of(self, row: int) -> int:
        """Number of the line of a row; only those who are told of it must wait for it."""
        return next(islice(self._filled_lines(), row, None))[0]

    def _find_header(self, names: list[str], rows: Iterator[Row]) -> tuple[int, list[int]]:
        """Take rows up to the header; their number, and where the columns are."""
        best: list[str] = []
        for number, (_, fields) in enumerate(rows, start=1):
            if all(name in fields for name in names):
                return number, [fields.index(name) for name in names]
            # The line that holds most of the names is the header that was meant.
            if not best or sum(n in fields for n in names) > sum(n in best for n in names):
                best = fields
        missing = ", ".join(name for name in names if name not in best)
        raise RecordError(
            f"no line of {self._name} names the columns {', '.join(names)}: missing {missing} "
            f"in '{'; '.join(best)}'"
        )

    def _middle_row(self, skipped: int) -> str:
        """In words, a row from the middle of those after the first ones, as an example."""
        middle = skipped + (self._row_count - skipped) // 2
        for index, (line, fields) in enumerate(self._rows()):
            if index == middle:
                return f"its line {line} has {len(fields)} columns, '{'; '.join(fields)}'"
        return "it is empty"

    def _filled_lines(self) -> Iterator[tuple[int, str]]:
        """Line numbers, from 1, and the lines that are not empty."""
        with self._path.open(encoding=self._encoding, errors="replace") as file:
            number = 0
            while line := file.readline(_LONGEST_LINE + 1):
                number += 1
                if len(line) > _LONGEST_LINE:
                    raise RecordError(
                        f"line {number} of {self._name} has more than {_LONGEST_LINE} characters: "
                        "is it a table of text with a row in each line?"
                    )
                if line.strip():
                    yield number, line

    def _rows(self) -> Iterator[Row]:
        for number, line in self._filled_lines():
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


def _encoding(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(4096)
        if start.startswith((b"\xff\xfe", b"\xfe\xff")):
            return "utf-16"
        if start.startswith(b"PK"):
            raise RecordError(f"{path.name} is a spreadsheet or an archive: save it as CSV first")
        if b"\0" in start:
            raise RecordError(f"{path.name} is not a text file: export it as text, CSV or MAT")
        decoder = codecs.getincrementaldecoder("utf-8")()
        try:
            while start:
                decoder.decode(start)
                start = file.read(_CHUNK)
            decoder.decode(b"", final=True)
        except UnicodeDecodeError:
            return "latin-1"
    return "utf-8-sig"


def _separator(sample: Sequence[str]) -> str:
    """What separates fields: ";", tab, "," or "" for white space. Headers do not matter."""
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


def _number(field: str, separator: str) -> float | None:
    if separator != ",":
        field = field.replace(",", ".")
    try:
        return float(field)
    except ValueError:
        return None


def _numbers(fields: list[str], positions: Sequence[int], separator: str) -> list[float] | None:
    if len(fields) <= max(positions):
        return None
    numbers = [_number(fields[position], separator) for position in positions]
    return None if None in numbers else numbers  # type: ignore[return-value]


def _unreadable(
    name: str, line: int, fields: list[str], positions: Sequence[int], separator: str
) -> str:
    if len(fields) <= max(positions):
        return (
            f"line {line} of {name} has {len(fields)} columns, but column "
            f"{max(positions) + 1} is wanted: mend the line or cut the file before it"
        )
    wrong = next(p for p in positions if _number(fields[p], separator) is None)
    return (
        f"column {wrong + 1} in line {line} of {name} is '{fields[wrong]}', not a number: "
        "mend the line or cut the file before it"
    )
