"""Reads a laboratory's record, a text, CSV or MAT file, into a recording in SI units."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mr_damper_ros.io.mat import MatError, Matrices, read_matrices
from mr_damper_ros.io.units import Column, parse_columns
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import DEFAULT_START_NS, Recording

_JITTER_TO_MENTION = 0.01
"""Deviation of the times from an even pace, in periods, that is mentioned."""

_GAP = 1.5
"""A step of the time this many times the usual one is a gap."""

_EPOCH = 1e9
"""Times above this [s] count from 1970; they are below in any record that starts at zero."""

_VELOCITY_TOLERANCE = 2.0
"""Factor by which a velocity column may differ from the rate of the displacement."""

_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?$|[+-]?\d+$")


class RecordError(ValueError):
    """A record that cannot be read; the message says what to change."""


@dataclass(frozen=True, eq=False)
class _Table:
    """Raw values by quantity; ``place`` says in words where a row is, for messages."""

    values: dict[str, Array]
    place: Callable[[int], str]

    @property
    def row_count(self) -> int:
        return int(next(iter(self.values.values())).size)


def read_record(
    path: str | Path,
    columns: str,
    *,
    current: float | None = None,
    period: float | None = None,
    start: float | None = None,
    stop: float | None = None,
    variable: str | None = None,
) -> Recording:
    """Read a record file into a recording.

    ``columns`` tells what each column holds and in which unit, see
    :func:`mr_damper_ros.io.units.parse_columns`. Text files may be separated by spaces, tabs,
    semicolons or commas, have decimal commas (unless separated by commas), and any number of
    lines before the first row of numbers; of a MAT file, ``variable`` chooses the matrix, or the
    columns name one variable each.

    ``current`` [A] is that of the whole record where no column holds it; ``period`` [s] the time
    between samples where no column holds the time; ``start`` and ``stop`` [s], from the first
    sample, cut out a part. A velocity column is compared with the displacement and not kept.

    Raises RecordError (or ColumnError, RecordingError), in one sentence that says what to change,
    and OSError where the file cannot be read.
    """
    path = Path(path)
    wanted = parse_columns(columns)
    _check_options({column.quantity for column in wanted}, current, period)
    if path.is_dir():
        raise RecordError(f"{path} is a folder: give a text, CSV or MAT file")
    if path.stat().st_size == 0:
        raise RecordError(f"{path.name} is empty: give a file with at least two rows of numbers")
    table = (
        _read_mat(path, wanted, variable)
        if path.suffix.lower() == ".mat"
        else _read_text(path, wanted, variable)
    )
    if table.row_count < 2:
        raise RecordError(f"{path.name} holds one row of numbers: at least two are needed")
    return _recording(path, table, wanted, columns, current, period, start, stop)


def _check_options(quantities: set[str], current: float | None, period: float | None) -> None:
    if "current" in quantities and current is not None:
        raise RecordError("the current is given twice: by a column and as a constant")
    if "current" not in quantities and current is None:
        raise RecordError(
            "the coil current is not known: name its column (current:A) or give one for all samples"
        )
    if "time" in quantities and period is not None:
        raise RecordError("the time is given twice: by a column and by the period")
    if "time" not in quantities and period is None:
        raise RecordError(
            "the time between samples is not known: name the column of the time (time:s) "
            "or give the period"
        )
    if period is not None and not (math.isfinite(period) and period > 0.0):
        raise RecordError(f"the period is {period} s: it must be positive")
    if current is not None and not math.isfinite(current):
        raise RecordError(f"the current is {current} A: give a finite number")


def _recording(
    path: Path,
    table: _Table,
    columns: Sequence[Column],
    description: str,
    current: float | None,
    period: float | None,
    start: float | None,
    stop: float | None,
) -> Recording:
    values = {column.quantity: column.to_si(table.values[column.quantity]) for column in columns}
    if period is None:
        _check_finite(path, "time", values["time"], table.place)
        time = values["time"]
    else:
        time = np.arange(table.row_count, dtype=np.float64) * period
    part = _part(path, time - time[0], start, stop)
    first, time = part.start, time[part]

    def place(row: int) -> str:
        return table.place(first + row)

    values = {quantity: array[part] for quantity, array in values.items()}
    for quantity, array in values.items():
        _check_finite(path, quantity, array, place)
    details = {"provenance": f"imported from {path.name}", "columns": description}
    if start is not None or stop is not None:
        details["part"] = f"rows {part.start + 1} to {part.stop}"
    if period is None:
        period, note = _even_pace(path, time, place)
        if note:
            details["note"] = note
    origin = 0 if time[0] > _EPOCH else DEFAULT_START_NS
    recording = Recording(
        name=path.stem,
        start_ns=origin + round(float(time[0]) * NANOSECONDS),
        period=period,
        displacement=values["displacement"],
        force=values["force"],
        current=values.get("current", np.full(time.size, current)),
        temperature=values.get("temperature"),
        details=details,
    )
    recording.check_plausible()
    if "velocity" in values:
        _check_velocity(recording, values["velocity"])
    return recording


def _check_finite(path: Path, quantity: str, values: Array, place: Callable[[int], str]) -> None:
    finite = np.isfinite(values)
    if not finite.all():
        row = int(np.argmin(finite))
        raise RecordError(
            f"the {quantity} in {place(row)} of {path.name} is {values[row]}: "
            "mend it, or choose a part of the record without it"
        )


def _part(path: Path, elapsed: Array, start: float | None, stop: float | None) -> slice:
    low = 0.0 if start is None else start
    high = math.inf if stop is None else stop
    if not low < high:
        raise RecordError(
            f"the part from {low:g} s to {high:g} s has no length: give the earlier time first"
        )
    # Without a cut, times that run backward are left for the check that names the row.
    if start is None and stop is None:
        return slice(0, elapsed.size)
    inside = np.flatnonzero((elapsed >= low - 1e-9) & (elapsed <= high + 1e-9))
    if inside.size < 2:
        raise RecordError(
            f"{path.name} has {inside.size} samples from {low:g} s to "
            f"{'its end' if stop is None else f'{high:g} s'}: it lasts {elapsed[-1]:g} s"
        )
    return slice(int(inside[0]), int(inside[-1]) + 1)


def _even_pace(path: Path, time: Array, place: Callable[[int], str]) -> tuple[float, str]:
    """Period [s] of times that rise evenly, and a remark where they waver."""
    steps = np.diff(time)
    backward = np.flatnonzero(steps <= 0.0)
    if backward.size:
        row = int(backward[0]) + 1
        raise RecordError(
            f"the time in {place(row)} of {path.name} does not rise ({time[row]:.9g} s after "
            f"{time[row - 1]:.9g} s): choose a part without it, or give the "
            "period instead of the column"
        )
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > _GAP * usual)
    if gaps.size:
        row = int(gaps[0]) + 1
        raise RecordError(
            f"the time in {place(row)} of {path.name} jumps by {steps[row - 1]:.6g} s where "
            f"{usual:.6g} s is usual: choose a part of the record without the gap"
        )
    # The mean step, unlike the usual one, does not mind times that were rounded when printed.
    # More than nine digits of it are noise.
    period = float(f"{float(time[-1] - time[0]) / (time.size - 1):.9g}")
    deviation = float(np.max(np.abs(time - time[0] - np.arange(time.size) * period))) / period
    if deviation > _GAP:
        raise RecordError(
            f"the times in {path.name} are not evenly spaced (off by {deviation:.1f} periods of "
            f"{period:.6g} s): resample the record, or choose an even part of it"
        )
    if deviation > _JITTER_TO_MENTION:
        return period, (
            f"the times waver by {deviation:.1%} of a period; "
            f"samples are taken as evenly spaced, {period:.6g} s apart"
        )
    return period, ""


def _check_velocity(recording: Recording, velocity: Array) -> None:
    # Compared as displacements: integrating quietens the noise that differentiating would raise.
    travelled = np.cumsum(velocity) * recording.period
    moved = recording.displacement
    trend = np.stack([np.ones(moved.size), recording.time], axis=1)
    travelled = travelled - trend @ np.linalg.lstsq(trend, travelled, rcond=None)[0]
    moved = moved - trend @ np.linalg.lstsq(trend, moved, rcond=None)[0]
    ratio = float(travelled @ moved / (moved @ moved))
    if 1.0 / _VELOCITY_TOLERANCE <= ratio <= _VELOCITY_TOLERANCE:
        return
    raise RecordError(
        f"the velocity column is {ratio:.3g} times the rate of the displacement: the unit or the "
        "sign of the time, the displacement or the velocity is wrong (write - for the velocity "
        "to ignore it)"
    )


# ---------------------------------------------------------------------------------------------
# Text
# ---------------------------------------------------------------------------------------------


def _read_text(path: Path, columns: Sequence[Column], variable: str | None) -> _Table:
    if variable is not None:
        raise RecordError(f"{path.name} is a text file and has no variables: choose no variable")
    lines = _decoded(path).splitlines()
    separator = _separator(lines)
    rows = list(_rows(lines, separator))
    positions, rows = _positions(path, rows, columns)
    first = next(
        (k for k, (_, fields) in enumerate(rows) if _numbers(fields, positions, separator)), None
    )
    if first is None:
        raise RecordError(
            f"{path.name} holds no row with numbers in columns "
            f"{', '.join(str(p + 1) for p in positions)}: {_first_row(rows)}"
        )
    numbers, line_numbers = [], []
    for line_number, fields in rows[first:]:
        row = _numbers(fields, positions, separator)
        if row is None:
            raise RecordError(_unreadable(path, line_number, fields, positions, separator))
        numbers.append(row)
        line_numbers.append(line_number)
    array = np.array(numbers, dtype=np.float64)
    return _Table(
        {column.quantity: array[:, k] for k, column in enumerate(columns)},
        lambda row: f"line {line_numbers[row]}",
    )


def _decoded(path: Path) -> str:
    content = path.read_bytes()
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", errors="replace")
    if content.startswith(b"PK"):
        raise RecordError(f"{path.name} is a spreadsheet or an archive: save it as CSV first")
    if b"\0" in content[:4096]:
        raise RecordError(f"{path.name} is not a text file: export it as text, CSV or MAT")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _separator(lines: Sequence[str]) -> str:
    """What separates fields: ";", tab, "," or "" for white space. Headers do not matter."""
    # The last lines hold numbers, whatever the header looks like.
    filled = [line for line in lines if line.strip()]
    sample = filled[len(filled) // 2 :][-50:]
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


def _rows(lines: Sequence[str], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Line numbers, from 1, and fields of the lines that are neither empty nor a comment."""
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        if separator:
            fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
            yield number, [field.strip() for field in fields]
        else:
            yield number, line.split()


def _positions(
    path: Path, rows: list[tuple[int, list[str]]], columns: Sequence[Column]
) -> tuple[list[int], list[tuple[int, list[str]]]]:
    """Where the columns are, and the rows from which numbers may start."""
    if not columns[0].header:
        return [column.position for column in columns], rows
    names = [column.header for column in columns]
    for k, (_, fields) in enumerate(rows):
        if all(name in fields for name in names):
            return [fields.index(name) for name in names], rows[k + 1 :]
    # The line that holds most of the names is the header that was meant.
    best = max((fields for _, fields in rows), key=lambda f: sum(n in f for n in names))
    missing = ", ".join(name for name in names if name not in best)
    raise RecordError(
        f"no line of {path.name} names the columns {', '.join(names)}: missing {missing} "
        f"in '{'; '.join(best)}'"
    )


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


def _first_row(rows: list[tuple[int, list[str]]]) -> str:
    if not rows:
        return "it is empty"
    number, fields = rows[len(rows) // 2]
    return f"its line {number} has {len(fields)} columns, '{'; '.join(fields)}'"


def _unreadable(
    path: Path, line: int, fields: list[str], positions: Sequence[int], separator: str
) -> str:
    if len(fields) <= max(positions):
        return (
            f"line {line} of {path.name} has {len(fields)} columns, but column "
            f"{max(positions) + 1} is wanted: mend the line or cut the file before it"
        )
    wrong = next(p for p in positions if _number(fields[p], separator) is None)
    return (
        f"column {wrong + 1} in line {line} of {path.name} is '{fields[wrong]}', not a number: "
        "mend the line or cut the file before it"
    )


# ---------------------------------------------------------------------------------------------
# MAT
# ---------------------------------------------------------------------------------------------


def _read_mat(path: Path, columns: Sequence[Column], variable: str | None) -> _Table:
    try:
        variables = read_matrices(path)
    except MatError as error:
        raise RecordError(f"{path.name} {error}") from error
    if columns[0].header:
        if variable is not None:
            raise RecordError(
                "the columns name variables of the MAT file themselves: choose no variable"
            )
        return _vectors(path, variables, columns)
    matrix = _matrix(path, variables, columns, variable)
    return _Table(
        {c.quantity: matrix[:, c.position] for c in columns}, lambda row: f"row {row + 1}"
    )


def _listed(variables: Matrices) -> str:
    shapes = [f"{name} ({v.shape[0]} x {v.shape[1]})" for name, v in variables.items()]
    return ", ".join(shapes) or "no matrix of numbers"


def _matrix(
    path: Path, variables: Matrices, columns: Sequence[Column], variable: str | None
) -> Array:
    # Samples may run down or across.
    upright = {n: v.T if v.shape[0] < v.shape[1] else v for n, v in variables.items()}
    needed = 1 + max(column.position for column in columns)
    if variable is None:
        fitting = [n for n, v in upright.items() if v.shape[1] >= needed and v.shape[0] > 1]
        if len(fitting) != 1:
            raise RecordError(
                f"{path.name} holds {len(fitting)} matrices with {needed} columns or more: "
                f"choose one as the variable; it holds {_listed(variables)}"
            )
        variable = fitting[0]
    if variable not in upright:
        raise RecordError(
            f"{path.name} has no variable '{variable}': it holds {_listed(variables)}"
        )
    matrix = np.asarray(upright[variable], dtype=np.float64)
    if matrix.shape[1] < needed:
        raise RecordError(
            f"the variable '{variable}' in {path.name} has {matrix.shape[1]} columns, but column "
            f"{needed} is wanted"
        )
    return matrix


def _vectors(path: Path, variables: Matrices, columns: Sequence[Column]) -> _Table:
    values = {}
    for column in columns:
        vector = variables.get(column.header)
        if vector is None or min(vector.shape) != 1:
            raise RecordError(
                f"{path.name} has no variable '{column.header}' that is one row or column: "
                f"it holds {_listed(variables)}"
            )
        values[column.quantity] = np.asarray(vector, dtype=np.float64).ravel()
    lengths = {column.header: values[column.quantity].size for column in columns}
    if len(set(lengths.values())) > 1:
        raise RecordError(
            f"the variables in {path.name} differ in length: "
            + ", ".join(f"{name} has {length}" for name, length in lengths.items())
        )
    return _Table(values, lambda row: f"row {row + 1}")
