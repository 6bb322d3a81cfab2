"""Columns from text files.

A file may be of any size: it is read in blocks of lines, and only the numbers are kept in memory.
NumPy reads the blocks of regular rows; every other row is read by itself and strictly, so that no
number is taken for another one.
"""

from __future__ import annotations

import csv
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import lru_cache
from itertools import repeat
from pathlib import Path
from typing import TextIO, TypeVar

import numpy as np

from mr_damper_ros.io.columns import Columns, RawTable, RecordError, parse_unit, too_long
from mr_damper_ros.io.headings import (
    Unit,
    check_unit,
    is_row_of_units,
    quantity_of,
    unit_of_heading,
    unit_of_word,
)
from mr_damper_ros.io.layouts import Layout, layout_of
from mr_damper_ros.io.number_marks import (
    REMEDY,
    Evidence,
    Marks,
    MarksError,
    looks_numeric,
    number_of,
)
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

_BLOCK = 1 << 19
"""Number of characters that are read at a time."""

_HEAD = 1 << 18
"""Number of characters at the start of a file within which its samples must begin."""

_SAMPLE_ROWS = 400
"""Number of rows from which the form of a table is determined."""

_CONTINUED = 10
"""Number of successive rows of numbers that begin a table, if the file holds so many."""

_SUMMARY = 0.1
"""Largest size of a table below the samples, relative to them, that counts as their summary."""

_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?$|[+-]?\d+$")

Row = tuple[int, list[str]]
"""Number of a line (from 1) and its fields."""

Progress = Callable[[float], None]
"""Receives the fraction of a file that has been read."""


@dataclass(frozen=True)
class TextOptions:
    """Options for text files: the decimal mark, if the numbers do not show it, and a listener."""

    decimal_mark: str | None = None
    progress: Progress | None = None


NO_OPTIONS = TextOptions()
"""No decimal mark, no listener."""


def read_text_table(
    path: Path,
    columns: Columns,
    variable: str | None,
    maximum_samples: int,
    options: TextOptions = NO_OPTIONS,
) -> RawTable:
    """Read columns by position or header; lines before the first row of numbers are skipped.

    Raises RecordError.
    """
    if variable is not None:
        raise RecordError(f"{path.name} is a text file and has no variables: choose no variable")
    return of_text_file(path, lambda text: text.table(columns, maximum_samples, options))


_Result = TypeVar("_Result")


def of_text_file(path: Path, read: Callable[[TextFile], _Result]) -> _Result:
    """What ``read`` returns for a text file, in the encoding of the file. Raises RecordError."""
    with path.open("rb") as file:
        start = file.read(4096)
    if start.startswith(b"PK"):
        raise RecordError(
            f"{path.name} is an archive, or a spreadsheet with another ending: first save it as "
            "XLSX or CSV"
        )

    def text(encoding: str, errors: str = "strict") -> TextFile:
        size = path.stat().st_size
        return TextFile(lambda: path.open(encoding=encoding, errors=errors), path.name, size=size)

    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        return read(text("utf-16", "replace"))
    if b"\0" in start:
        raise RecordError(f"{path.name} is not a text file: export it as text, CSV or MAT")
    try:
        return read(text("utf-8-sig"))
    except UnicodeDecodeError:
        return read(text("latin-1"))


@dataclass(frozen=True)
class Outline:
    """The form of a table of samples in a text.

    ``separator`` separates the fields. ``first_line`` is the line of the first sample, ``width``
    the number of fields of a row, and ``numeric`` the columns of numbers. ``headings`` and
    ``units`` belong to the columns from the left; both may be shorter than a row. ``repeated`` are
    the rows of headings that a further block of samples repeats, ``keyed`` the rows of units and
    periods by their first cell. ``sample`` holds the first rows.
    ``period`` is the sample period [s] that the file states, if any.
    """

    layout: Layout
    separator: str
    first_line: int
    width: int
    numeric: tuple[int, ...]
    dates: tuple[int, ...]
    headings: tuple[str, ...]
    units: tuple[str, ...]
    repeated: tuple[tuple[str, ...], ...]
    keyed: dict[str, list[str]]
    sample: tuple[Row, ...]
    period: float | None
    notes: tuple[str, ...]

    def is_labelled(self, fields: list[str]) -> bool:
        """Whether a row begins with a word, where the samples have a number or nothing."""
        first = self.numeric[0]
        places = [first, *(p for p in range(first) if not _holds(self.sample[0][1], p))]
        words = (fields[place] for place in places if _holds(fields, place))
        return any(not looks_numeric(word) and not _is_date(word) for word in words)

    def heading(self, column: int) -> str:
        """The heading of a column; empty if it has none."""
        return self.headings[column] if column < len(self.headings) else ""

    def unit(self, column: int) -> Unit | None:
        """The unit of a column, from the row of units or from its heading."""
        stated = unit_of_word(self.units[column]) if column < len(self.units) else None
        if stated is not None:
            return replace(stated, sure=True)
        word = self.layout.units.get(self.heading(column), "")
        return unit_of_heading(self.heading(column)) or unit_of_word(word)

    def quantity(self, column: int) -> str | None:
        """The quantity that the heading of a column names."""
        return quantity_of(self.heading(column))


class _UnreadableError(RecordError):
    """A row cannot be read; ``marks``: whether other marks of the numbers may be the reason."""

    def __init__(self, message: str, marks: bool) -> None:
        super().__init__(message)
        self.marks = marks


class TextFile:
    """A text of lines with fields.

    ``opened`` opens the text and is called repeatedly. ``name`` is its name in messages.
    ``separator`` separates the fields; by default, it is detected. ``size`` is the approximate
    number of characters.
    """

    def __init__(
        self,
        opened: Callable[[], TextIO],
        name: str,
        separator: str | None = None,
        size: int = 0,
    ) -> None:
        self._open = opened
        self._name = name
        self._size = size
        self._head: list[tuple[int, str]] = []
        self._whole = True
        count = 0
        for number, lines, _ in self._blocks():
            self._head += [row for row in enumerate(lines, start=number) if row[1].strip()]
            count += sum(map(len, lines))
            if count >= _HEAD:
                self._whole = False
                break
        if separator is None:
            # The later lines hold numbers and no header.
            later = self._head[len(self._head) // 2 :][:_SAMPLE_ROWS]
            separator = _separator([line for _, line in later])
        self._separator = separator
        self._rows = list(self._split(self._head))

    def outline(self) -> Outline:
        """The form of the table; raises RecordError if the file holds no table of numbers."""
        later = self._rows[len(self._rows) // 2 :][:_SAMPLE_ROWS]
        counts = Counter(
            place
            for _, fields in later
            for place, text in enumerate(fields)
            if looks_numeric(text) or seconds_since_1970(text) is not None
        )
        most = max(counts.values(), default=0)
        numeric = sorted(place for place, count in counts.items() if count > 0.9 * most)
        if most < 0.5 * len(later) or len(numeric) < 2:
            raise RecordError(f"{self._name} holds no table of numbers: {self._example(0)}")
        dates = {
            place
            for place in numeric
            if sum(_holds(fields, place, _is_date) for _, fields in later) > 0.5 * len(later)
        }
        outline = self._outline(numeric, dates, 0)
        self._check_width(list(outline.headings), list(outline.sample), numeric)
        return outline

    def table(
        self,
        columns: Columns,
        maximum_samples: int,
        options: TextOptions = NO_OPTIONS,
    ) -> RawTable:
        """The numbers in the columns; raises RecordError."""
        after, positions = 0, [column.position for column in columns.wanted]
        if columns.by_header:
            after, positions = self._find_header([c.header for c in columns.wanted])
        dates = {
            p for p, column in zip(positions, columns.wanted, strict=True) if column.holds_dates
        }
        outline = self._outline(positions, dates, after)
        columns.check_width(self._name, max(outline.numeric, default=-1) + 1)
        for position, column in zip(positions, columns.wanted, strict=True):
            heading = outline.heading(position)
            check_unit(self._name, column, position, heading, outline.unit(position))
        samples = self._read(outline, positions, dates, maximum_samples, options)
        table = samples.values()
        period = outline.period if "time" not in columns.quantities else None
        return RawTable(
            {column.quantity: table[:, k] for k, column in enumerate(columns.wanted)},
            lambda row: f"line {samples.line(row)}",
            period,
            (*outline.notes, *_other_sets(outline, positions), *samples.notes()),
            tuple(samples.breaks),
            None if "time" in columns.quantities else _shown_period(outline, positions),
        )

    # -- the form of the table ---------------------------------------------------------------------

    def _outline(self, positions: list[int], dates: set[int], after: int) -> Outline:
        """The form of the table whose rows have numbers at some positions.

        The table begins with the first rows that go on. ``after`` is the number of rows above it
        that belong to its header.
        """
        rows = self._rows

        def whole(fields: list[str]) -> bool:
            return all(
                _holds(fields, p, _is_date if p in dates else looks_numeric) for p in positions
            )

        flags = [whole(fields) for _, fields in rows]
        stretches = _stretches(flags, after)
        if not stretches:
            listed = ", ".join(str(position + 1) for position in positions)
            raise RecordError(
                f"{self._name} holds no row with numbers in columns {listed}: "
                f"{self._example(after)}"
            )
        enough = min(_CONTINUED, max(stop - start for start, stop in stretches))
        start = next(start for start, stop in stretches if stop - start >= enough)
        if start > after + 1 and flags[start - 2] and self._is_torn(rows[start - 1][1], positions):
            raise RecordError(self._unreadable(*rows[start - 1], positions, dates, Marks()))
        sample = [row for row, flag in zip(rows[start:], flags[start:], strict=True) if flag]
        sample = sample[:_SAMPLE_ROWS]
        odd = _odd_rows(sample, positions)
        numeric = [
            place
            for place in range(max(len(fields) for _, fields in sample))
            if 2 * sum(_holds(fields, place, looks_numeric) for _, fields in sample) >= len(sample)
        ]
        head = [fields for _, fields in rows[:start]]
        layout = layout_of(line for _, line in self._head[:start])
        headings, units = _headings(head[max(after - 1, 0) :] if after else head, positions, after)
        repeated = tuple(tuple(row) for row in (headings, units) if row)
        if not self._separator and not after:
            # Headings of several words do not show their columns.
            headings = headings if len(headings) == _width(sample) else []
            units = units if len(units) == _width(sample) else []
        keys = [key for key in (layout.unit_row, layout.period_row) if key]
        keyed = {key: row for key in keys if (row := _row_of(head, key))}
        stated = keyed.get(layout.unit_row or "", [])
        if after:
            self._check_width(headings, sample, numeric)
        return Outline(
            layout,
            self._separator,
            sample[odd][0],
            _width(sample),
            tuple(numeric),
            tuple(sorted(dates)),
            tuple(headings),
            tuple((stated[1:] and ["", *stated[1:]]) or units),
            repeated,
            keyed,
            tuple(sample[odd:]),
            _period(keyed.get(layout.period_row or "", [])),
            tuple(self._left_out_above(rows[after:start], sample, odd, positions)),
        )

    def _left_out_above(
        self, above: list[Row], sample: list[Row], odd: int, positions: list[int]
    ) -> list[str]:
        """Notes on rows above the samples that could be samples."""
        # Rows of a header have texts where all samples are empty.
        empty = [p for p in range(_width(sample)) if not any(_holds(f, p) for _, f in sample)]
        doubtful = [
            (line, fields, "is no whole row of numbers")
            for line, fields in above[-1:]
            if self._is_torn(fields, positions)
        ]
        doubtful += [
            (line, fields, "has numbers, but does not belong to the table")
            for line, fields in above
            if all(_holds(fields, p, looks_numeric) for p in positions)
            and not any(_holds(fields, p) for p in empty)
        ][-1:]
        doubtful += [
            (line, fields, "has another form than the rows below it")
            for line, fields in sample[:odd]
        ]
        return [
            f"line {line} of {self._name} ('{_shown(fields)}') {what} and was left out"
            for line, fields, what in doubtful
        ]

    def _check_width(self, headings: list[str], sample: list[Row], numeric: list[int]) -> None:
        """Raise RecordError if headings that select columns do not belong to the columns."""
        width = len(headings)
        line, fields = sample[0]
        if not headings or (width == len(fields) if not self._separator else width > max(numeric)):
            return
        reason = {
            "": "spaces separate the columns, and headings of several words do not show theirs",
            ",": "commas separate the columns, and other commas are decimal marks or thousands "
            "separators, or a column has no heading",
        }
        raise RecordError(
            f"line {line} of {self._name} has {len(fields)} columns below {width} headings: "
            f"{reason.get(self._separator, 'a column has no heading')}; export the file with "
            "another separator, or select the columns by position"
        )

    def _find_header(self, names: list[str]) -> tuple[int, list[int]]:
        """The number of rows up to the header, and the positions of the columns."""
        best: list[str] = []
        for number, (line, fields) in enumerate(self._rows, start=1):
            if all(name in fields for name in names):
                self._check_header(line, fields, names)
                return number, [fields.index(name) for name in names]
            # The line with the most matching names is probably the header.
            if not best or sum(n in fields for n in names) > sum(n in best for n in names):
                best = fields
        missing = ", ".join(name for name in names if name not in best)
        raise RecordError(
            f"no line of {self._name} names the columns {', '.join(names)}: "
            f"'{'; '.join(best)}' lacks {missing}"
        )

    def _check_header(self, line: int, fields: list[str], names: list[str]) -> None:
        """Raise RecordError if a heading stands above several columns."""
        for name in names:
            places = [str(place + 1) for place, text in enumerate(fields) if text == name]
            if len(places) > 1:
                raise RecordError(
                    f"line {line} of {self._name} has the heading '{name}' {len(places)} times "
                    f"(columns {', '.join(places)}): select the columns by position, such as "
                    "time:s,force:N,displacement:mm,..."
                )

    def _example(self, skipped: int) -> str:
        """Description of a row in the middle of the file, as an example for a message."""
        if skipped == len(self._rows):
            return "its header is its last line" if skipped else "it is empty"
        line, fields = self._rows[(skipped + len(self._rows)) // 2]
        dates = any(_is_date(text) for text in fields)
        hint = " (the unit of a date is time:datetime)" if dates else ""
        return f"its line {line} has {len(fields)} columns, '{_shown(fields)}'{hint}"

    def _is_torn(self, fields: list[str], positions: list[int]) -> bool:
        """Whether some, but not all, of the needed fields are numbers."""
        numbers = sum(_holds(fields, place, looks_numeric) for place in positions)
        return 0 < numbers < len(positions)

    # -- the samples -------------------------------------------------------------------------------

    def _read(
        self,
        outline: Outline,
        positions: list[int],
        dates: set[int],
        maximum_samples: int,
        options: TextOptions,
    ) -> _Samples:
        """The samples, under the marks that the numbers of the file show."""
        evidence = Evidence()
        plain = [place for place in outline.numeric if place not in dates]
        for _, fields in outline.sample:
            evidence.add(fields, plain)
        if not evidence.decided and not self._whole:
            evidence = self._all_evidence(outline, plain)
        marks = self._marks(evidence, options.decimal_mark)
        try:
            return self._samples(
                outline, positions, dates, marks, maximum_samples, options.progress
            )
        except _UnreadableError as error:
            if not error.marks:
                raise
            evidence = self._all_evidence(outline, plain)
            other = self._marks(evidence, options.decimal_mark)
            if other == marks:
                raise
        return self._samples(outline, positions, dates, other, maximum_samples, options.progress)

    def _marks(self, evidence: Evidence, decimal_mark: str | None) -> Marks:
        if decimal_mark not in (None, ".", ","):
            raise RecordError(f"the decimal mark is '{decimal_mark}': give . or ,")
        try:
            return evidence.marks(decimal_mark)
        except MarksError as error:
            raise RecordError(f"the numbers in {self._name} are ambiguous: {error}") from None

    def _all_evidence(self, outline: Outline, plain: list[int]) -> Evidence:
        """The marks of all numbers of the file."""
        evidence = Evidence()
        for number, lines, _ in self._blocks():
            rows = enumerate(lines, start=number)
            marked = ((n, line) for n, line in rows if n >= outline.first_line and line.strip())
            for _, fields in self._split(marked):
                evidence.add(fields, plain)
        return evidence

    def _samples(
        self,
        outline: Outline,
        positions: list[int],
        dates: set[int],
        marks: Marks,
        maximum_samples: int,
        progress: Progress | None,
    ) -> _Samples:
        samples = _Samples(self._name, outline, len(positions), marks)
        done, last = 0, ""
        for number, lines, ended in self._blocks():
            done += sum(map(len, lines)) + len(lines)
            if progress is not None and self._size:
                progress(min(done / self._size, 1.0))
            skipped = max(outline.first_line - number, 0)
            if skipped >= len(lines):
                continue
            lines, number = lines[skipped:], number + skipped
            block = self._regular(lines, outline, positions, dates, marks) if ended else None
            if block is not None:
                samples.add(block, number)
            else:
                self._add_rows(samples, number, lines, ended, positions, dates, marks, last)
            last = lines[-1]
            if samples.count > maximum_samples:
                raise too_long(self._name, maximum_samples)
        samples.finish()
        return samples

    def _regular(
        self,
        lines: list[str],
        outline: Outline,
        positions: list[int],
        dates: set[int],
        marks: Marks,
    ) -> Array | None:
        """Numbers (n, columns) of a block of regular rows; None if there is any other line."""
        separator, width = self._separator, outline.width
        if separator:
            if max(map(str.count, lines, repeat(separator))) >= width:
                return None
        elif any(len(line.split()) != width for line in lines):
            return None
        if marks.thousands:
            return None
        if marks.decimal != ".":
            if dates or any("." in line for line in lines):
                return None
            lines = [line.replace(marks.decimal, ".") for line in lines]
        key = outline.numeric[0]
        usecols = positions if key in positions else [*positions, key]
        try:
            numbers = np.loadtxt(
                lines,
                delimiter=separator or None,
                quotechar='"' if separator else None,
                comments=None,
                usecols=usecols,
                converters=dict.fromkeys(dates, seconds_since_1970) or None,
                encoding=None,
                ndmin=2,
            )
        except (ValueError, TypeError) as error:
            # numpy.loadtxt takes an interrupt within a converter for a wrong value.
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise KeyboardInterrupt from None
            return None
        return numbers[:, : len(positions)] if len(numbers) == len(lines) else None

    def _add_rows(
        self,
        samples: _Samples,
        number: int,
        lines: list[str],
        ended: bool,
        positions: list[int],
        dates: set[int],
        marks: Marks,
        previous: str,
    ) -> None:
        """Read rows one by one: numbers, text between blocks of samples, or an incomplete row."""
        outline = samples.outline
        filled = [row for row in enumerate(lines, start=number) if row[1].strip()]
        values: list[list[float]] = []
        where: list[int] = []
        for line, fields in self._split(filled):
            found = [
                (seconds_since_1970(fields[p]) if p in dates else number_of(fields[p], marks))
                if p < len(fields)
                else None
                for p in positions
            ]
            numbers = [value for value in found if value is not None]
            labelled = outline.is_labelled(fields)
            if len(numbers) == len(positions) and not labelled:
                self._check_fields(line, fields, outline)
                if not ended and not self._is_complete(
                    outline, lines[-1], fields, positions, previous
                ):
                    samples.flush(values, where)
                    samples.torn(line, fields, "")
                    continue
                if samples.waiting:
                    samples.flush(values, where)
                    values, where = [], []
                values.append(numbers)
                where.append(line)
                continue
            samples.flush(values, where)
            values, where = [], []
            if labelled or not any(_holds(fields, p, looks_numeric) for p in positions):
                samples.text(line, fields)
            else:
                samples.torn(line, fields, self._unreadable(line, fields, positions, dates, marks))
        samples.flush(values, where)

    def _is_complete(
        self,
        outline: Outline,
        line: str,
        fields: list[str],
        positions: list[int],
        previous: str,
    ) -> bool:
        """Whether the needed fields of the last row are whole, although its line has no end.

        A field is whole if another one or a quotation mark follows it, if it equals the field
        above, or if all fields above have the same number of decimals.
        """
        last = max(positions)
        if len(fields) > last + 1 or line.rstrip().endswith('"'):
            return True
        above = [other[last] for _, other in self._split([(0, previous)]) if last < len(other)]
        if fields[last] in above:
            return True
        forms = {_form(other[last]) for _, other in outline.sample if last < len(other)}
        return forms == {_form(fields[last])} and forms != {(0, 0)}

    def _check_fields(self, line: int, fields: list[str], outline: Outline) -> None:
        """Raise RecordError if a row has more numbers, or fewer words, than the others."""
        surplus = any(looks_numeric(text) for text in fields[outline.width :])
        if surplus or (not self._separator and len(fields) != outline.width):
            raise _UnreadableError(
                f"line {line} of {self._name} has {len(fields)} columns, the other rows have "
                f"{outline.width} ('{_shown(fields)}'): is a comma or a space in it a thousands "
                f"separator or a decimal mark? If so, {REMEDY}",
                marks=False,
            )

    def _unreadable(
        self, line: int, fields: list[str], positions: list[int], dates: set[int], marks: Marks
    ) -> str:
        last = max(positions)
        if len(fields) <= last:
            return (
                f"line {line} of {self._name} has {len(fields)} columns, but column {last + 1} is "
                "needed: correct the line, or cut the file before it"
            )
        wrong = next(
            p
            for p in positions
            if (_is_date(fields[p]) if p in dates else number_of(fields[p], marks) is not None)
            is False
        )
        if wrong not in dates and looks_numeric(fields[wrong]):
            return (
                f"column {wrong + 1} in line {line} of {self._name} is '{fields[wrong]}', but the "
                f"decimal mark of other numbers is '{marks.decimal}': {REMEDY}"
            )
        kind = "date with the time of day" if wrong in dates else "number"
        return (
            f"column {wrong + 1} in line {line} of {self._name} is '{fields[wrong]}', not a "
            f"{kind}: correct the line, or cut the file before it"
        )

    # -- lines and fields --------------------------------------------------------------------------

    def _blocks(self) -> Iterator[tuple[int, list[str], bool]]:
        """Blocks of lines: the number of the first one, the lines, and whether all have an end."""
        number, rest = 1, ""
        with self._open() as file:
            while block := file.read(_BLOCK):
                lines = (rest + block).split("\n")
                rest = lines.pop()
                self._check_length(number, [*lines, rest])
                if lines:
                    yield number, lines, True
                number += len(lines)
        if rest.strip():
            yield number, [rest], False

    def _check_length(self, number: int, lines: list[str]) -> None:
        if max(map(len, lines)) <= _LONGEST_LINE:
            return
        long = next(k for k, line in enumerate(lines) if len(line) > _LONGEST_LINE)
        raise RecordError(
            f"line {number + long} of {self._name} has more than {_LONGEST_LINE} characters: "
            "is it a text table with one row in each line?"
        )

    def _split(self, lines: Iterable[tuple[int, str]]) -> Iterator[Row]:
        separator = self._separator
        for number, line in lines:
            if not separator:
                yield number, line.split()
            elif '"' not in line:
                yield number, [text.strip() for text in line.split(separator)]
            else:
                reader = csv.reader([line], delimiter=separator, skipinitialspace=True)
                try:
                    fields = next(reader, [])
                except csv.Error as error:
                    raise RecordError(
                        f"line {number} of {self._name} cannot be split into fields: {error}"
                    ) from error
                yield number, [text.strip() for text in fields]


class _Samples:
    """The samples of a table as they are read, with what stands between and below them."""

    def __init__(self, name: str, outline: Outline, width: int, marks: Marks) -> None:
        self.outline = outline
        self.count = 0
        self.breaks: list[int] = []
        self._name = name
        self._width = width
        self._marks = marks
        self._parts: list[Array] = []
        self._starts: list[int] = []
        self._lines: list[int | Array] = []
        self._between: list[Row] = []
        self._torn: tuple[int, list[str], str] | None = None
        self._other: Row | None = None
        self._remarks: list[str] = []

    @property
    def waiting(self) -> bool:
        """Whether the next sample begins a new block."""
        return bool(self._between or self._torn)

    def add(self, numbers: Array, line: int | Array) -> None:
        """Add samples (n, columns); ``line`` is the line of the first, or the lines of all."""
        if len(numbers) == 0:
            return
        if self._torn is not None:
            raise self._unreadable()
        if self._between and self.count:
            self._begin_block()
        self._between = []
        self._parts.append(numbers)
        self._starts.append(self.count)
        self._lines.append(line)
        self.count += len(numbers)

    def flush(self, values: list[list[float]], lines: list[int]) -> None:
        """Add samples row by row."""
        if values:
            self.add(np.array(values), np.array(lines))
            values.clear()
            lines.clear()

    def text(self, line: int, fields: list[str]) -> None:
        """Take a line without numbers."""
        if self._torn is not None:
            self._between.append(self._torn[:2])
            self._torn = None
        self._between.append((line, fields))

    def torn(self, line: int, fields: list[str], message: str) -> None:
        """Take a row with some of the numbers; ``message`` is the error if others follow it."""
        if self._torn is not None:
            raise self._unreadable()
        self._torn = line, fields, message

    def _unreadable(self) -> _UnreadableError:
        assert self._torn is not None
        return _UnreadableError(self._torn[2], marks="decimal mark" in self._torn[2])

    def _begin_block(self) -> None:
        """Begin a block of samples below repeated headings or a remark."""
        repeated = self.outline.repeated
        for line, fields in self._between:
            if fields[0] and fields != self.outline.keyed.get(fields[0], fields):
                raise RecordError(
                    f"line {line} of {self._name} ('{_shown(fields)}') differs from the one above "
                    "the first samples: save the blocks in files of their own"
                )
        rows = [tuple(fields) for _, fields in self._between]
        same = bool(repeated) and rows[-len(repeated) :] == list(repeated)
        if not same and any(self._is_header(fields) for _, fields in self._between):
            if self._other is not None:
                raise self._two_tables()
            self._other = self._between[0]
        elif not same:
            line, fields = self._between[0]
            self._remarks.append(
                f"{_lines(line, self._between[-1][0])} of {self._name} ('{_shown(fields)}') "
                "between the samples holds no numbers"
            )
        self.breaks.append(self.count)

    def _is_header(self, fields: list[str]) -> bool:
        """Whether a row could be headings: as many texts as the rows have numbers."""
        return sum(map(bool, fields)) >= max(2, len(self.outline.numeric))

    def _two_tables(self) -> RecordError:
        assert self._other is not None
        line, fields = self._other
        return RecordError(
            f"{self._name} holds a second table from line {line} on ('{_shown(fields)}') with "
            "other headings: save the tables in files of their own"
        )

    def finish(self) -> None:
        """Judge what stands below the last samples."""
        if self._other is not None:
            last = self.breaks[-1] if self.breaks else 0
            if self.count - last > _SUMMARY * self.count:
                raise self._two_tables()
            self._remarks.append(self._left_out(self._other[0], self._other[1], "summary"))
            self._cut(last)
            self.breaks.pop()
        if self._torn is not None:
            line, fields, _ = self._torn
            self._remarks.append(
                f"the last row of {self._name} (line {line}, '{_shown(fields)}') is incomplete and "
                "was left out: the file is cut"
            )
        if self._between:
            self._remarks.append(self._left_out(*self._between[0], "text"))

    def _left_out(self, line: int, fields: list[str], kind: str) -> str:
        return (
            f"the lines of {self._name} from {line} on ('{_shown(fields)}') hold no samples and "
            "were left out"
        )

    def _cut(self, count: int) -> None:
        while self._starts and self._starts[-1] >= count:
            self._starts.pop()
            self._lines.pop()
            self.count -= len(self._parts.pop())

    def values(self) -> Array:
        """The samples, shape (n, columns)."""
        joined = np.concatenate(self._parts) if self._parts else np.empty((0, self._width))
        self._parts = []
        return joined

    def line(self, row: int) -> int:
        """The line of a sample."""
        part = bisect_right(self._starts, row) - 1
        lines, place = self._lines[part], row - self._starts[part]
        return lines + place if isinstance(lines, int) else int(lines[place])

    def notes(self) -> list[str]:
        """What was left out, and how the numbers were read."""
        notes = list(self._remarks)
        if len(notes) > _MOST_REMARKS:
            notes = [*notes[:_MOST_REMARKS], f"and {len(notes) - _MOST_REMARKS} more such lines"]
        if set(self._marks.thousands) & set(".,"):
            other = "points" if "." in self._marks.thousands else "commas"
            notes.append(
                f"{other} in {self._name} are thousands separators, because other numbers have the "
                f"decimal mark '{self._marks.decimal}'"
            )
        return notes


_MOST_REMARKS = 3
"""Largest number of remarks on lines between the samples."""


def _is_date(text: str) -> bool:
    return seconds_since_1970(text) is not None


def _holds(fields: list[str], place: int, kind: Callable[[str], bool] = bool) -> bool:
    """Whether a row has a field of a kind at a place; by default, a field that is not empty."""
    return place < len(fields) and kind(fields[place])


def _stretches(flags: list[bool], first: int) -> list[tuple[int, int]]:
    """First and last index + 1 of successive true flags, from the index ``first`` on."""
    edges = np.flatnonzero(np.diff(np.array([False, *flags[first:], False]).astype(int))) + first
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _form(text: str) -> tuple[int, int]:
    """Number of decimals of a number, and number of characters of its exponent."""
    mantissa, _, exponent = text.lower().partition("e")
    mark = max(mantissa.rfind("."), mantissa.rfind(","))
    return (len(mantissa) - mark - 1 if mark >= 0 else 0, len(exponent))


_FIXED_ROWS = 12
"""Number of rows with the same numbers of decimals that show a fixed format."""


def _odd_rows(sample: list[Row], positions: list[int]) -> int:
    """How many of the first rows are not samples: a row of channel numbers or factors.

    The rows below have a fixed format, which the first row does not have.
    """
    for count in (2, 1):
        forms = [tuple(_form(fields[p]) for p in positions) for _, fields in sample]
        below = set(forms[count : count + _FIXED_ROWS])
        if len(forms) < count + _FIXED_ROWS or len(below) != 1:
            continue
        (fixed,) = below
        odd = [
            any(
                _form(fields[p]) != form and fields[p].strip("+-0.,")
                for p, form in zip(positions, fixed, strict=True)
            )
            for _, fields in sample[:count]
        ]
        if all(odd):
            return count
    return 0


def _width(sample: Sequence[Row]) -> int:
    """The usual number of fields of the rows."""
    return Counter(len(fields) for _, fields in sample).most_common(1)[0][0]


_EVEN = 0.1
"""Largest relative deviation from the mean step of the first times of a uniform column."""


def _shown_period(outline: Outline, positions: Sequence[int]) -> tuple[float, str] | None:
    """The step [s] of a column of times among the others, and its name; None if there is none."""
    for column in outline.numeric:
        unit = outline.unit(column)
        if column in positions or outline.quantity(column) != "time" or unit is None:
            continue
        cells = [fields[column] for _, fields in outline.sample if column < len(fields)]
        marks = Marks(decimal="," if any("," in cell for cell in cells) else ".")
        times = [number_of(cell, marks) for cell in cells]
        steps = np.diff([time for time in times if time is not None])
        usual = float(np.mean(steps)) if steps.size else 0.0
        if usual > 0.0 and np.all(np.abs(steps - usual) <= _EVEN * usual):
            factor = parse_unit("time", unit.text)[0]
            return usual * factor, f"column {column + 1}, '{outline.heading(column)}',"
    return None


def _headings(
    head: list[list[str]], positions: list[int], after: int
) -> tuple[list[str], list[str]]:
    """The row of headings and the row of units in the rows above the samples."""

    def texts(row: list[str]) -> int:
        return sum(
            _holds(row, p, lambda text: bool(text) and not looks_numeric(text)) for p in positions
        )

    if after:
        return head[0], head[1] if len(head) > 1 and is_row_of_units(head[1]) else []
    last = head[-1] if head else []
    if len(head) > 1 and is_row_of_units(last) and 2 * texts(head[-2]) >= len(positions):
        return head[-2], last
    return (last if 2 * texts(last) >= len(positions) else []), []


def _row_of(head: list[list[str]], key: str) -> list[str]:
    """The last row whose first cell is a key."""
    return next((row for row in reversed(head) if row and row[0] == key), [])


def _period(row: list[str]) -> float | None:
    """The sample period [s] in a row of equal periods."""
    stated = {text.replace(",", ".") for text in row[1:] if text}
    if len(stated) != 1:
        return None
    period = number_of(stated.pop(), Marks())
    return period if period is not None and period > 0.0 else None


def _other_sets(outline: Outline, positions: list[int]) -> list[str]:
    """A note on further columns with the same headings."""
    chosen = {outline.heading(p) for p in positions if outline.heading(p)}
    others = [
        str(place + 1)
        for place in outline.numeric
        if place not in positions and outline.heading(place) in chosen
    ]
    if not others:
        return []
    return [f"columns {', '.join(others)} have the same headings and were not read"]


def _shown(fields: Sequence[str]) -> str:
    text = "; ".join(fields)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _lines(first: int, last: int) -> str:
    return f"line {first}" if first == last else f"lines {first} to {last}"


def _separator(sample: Sequence[str]) -> str:
    """The separator of fields: ";", tab, ",", or "" for white space."""
    for separator in (";", "\t"):
        if 2 * sum(separator in line.strip() for line in sample) > len(sample):
            return separator
    if 2 * sum("," in line for line in sample) <= len(sample):
        return ""
    # "0,001 2,5" is two numbers with decimal commas; "1,2" is two fields.
    decimal = sum(
        len(line.split()) > 1 and all(_DECIMAL_COMMA.match(word) for word in line.split())
        for line in sample
    )
    return "" if 2 * decimal > len(sample) else ","
