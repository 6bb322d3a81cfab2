"""Reads a laboratory's record, a text, CSV or MAT file, into a recording in SI units."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from mr_damper_ros.io.mat_table import read_mat_table
from mr_damper_ros.io.raw_table import MAXIMUM_SAMPLES, RawTable, RecordError
from mr_damper_ros.io.regular_files import irregularity
from mr_damper_ros.io.text_table import read_text_table
from mr_damper_ros.io.units import Column, parse_columns
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import DEFAULT_START_NS, NotFiniteError, Recording

_JITTER_TO_MENTION = 0.01
"""Deviation of the times from an even pace, in periods, that is mentioned."""

_GAP = 1.5
"""A step of the time this many times the usual one is a gap."""

_EPOCH = 1e9
"""Times above this [s] count from 1970; they are below in any record that starts at zero."""

_VELOCITY_TOLERANCE = 2.0
"""Factor by which a velocity column may differ from the rate of the displacement."""


def read_record(
    path: str | Path,
    columns: str,
    *,
    current: float | None = None,
    period: float | None = None,
    start: float | None = None,
    stop: float | None = None,
    variable: str | None = None,
    maximum_samples: int = MAXIMUM_SAMPLES,
) -> Recording:
    """Read a record file into a recording.

    ``columns`` tells what each column holds and in which unit, see
    :func:`mr_damper_ros.io.units.parse_columns`. Text files may be separated by spaces, tabs,
    semicolons or commas, have decimal commas (unless separated by commas), and any number of
    lines before the first row of numbers; of a MAT file, ``variable`` chooses the matrix, or the
    columns name one variable each.

    ``current`` [A] is that of the whole record where no column holds it; ``period`` [s] the time
    between samples where no column holds the time; ``start`` and ``stop`` [s], from the first
    sample, cut out a part. A velocity column is compared with the displacement and not kept. A
    file with more than ``maximum_samples`` is refused, before it has filled the memory.

    Raises RecordError (or ColumnError, RecordingError), in one sentence that says what to change,
    and OSError where the file cannot be read.
    """
    path = Path(path)
    wanted = parse_columns(columns)
    _check_options({column.quantity for column in wanted}, current, period)
    kind = irregularity(path)
    if kind:
        raise RecordError(f"{path} is {kind}: give a text, CSV or MAT file")
    if path.stat().st_size == 0:
        raise RecordError(f"{path.name} is empty: give a file with at least two rows of numbers")
    read = read_mat_table if path.suffix.lower() == ".mat" else read_text_table
    table = read(path, wanted, variable, maximum_samples)
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
    table: RawTable,
    columns: Sequence[Column],
    description: str,
    current: float | None,
    period: float | None,
    start: float | None,
    stop: float | None,
) -> Recording:
    row_count = table.row_count
    # Taken from the table one by one: a long record is not held twice.
    values = {c.quantity: c.to_si(table.values.pop(c.quantity)) for c in columns}
    if period is None:
        _check_finite(path, "time", values["time"], table.place)
        time = values["time"]
    else:
        time = np.arange(row_count, dtype=np.float64) * period
    part = _part(path, time - time[0], start, stop)
    first, time = part.start, time[part]

    def place(row: int) -> str:
        return table.place(first + row)

    values = {quantity: array[part] for quantity, array in values.items()}
    if "velocity" in values:
        _check_finite(path, "velocity", values["velocity"], place)
    details = {"provenance": f"imported from {path.name}", "columns": description}
    if start is not None or stop is not None:
        details["part"] = f"rows {part.start + 1} to {part.stop}"
    if period is None:
        period, note = _even_pace(path, time, place)
        if note:
            details["note"] = note
    origin = 0 if time[0] > _EPOCH else DEFAULT_START_NS
    try:
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
    except NotFiniteError as error:
        value = values[error.quantity][error.sample]
        raise _not_finite(path, error.quantity, place(error.sample), value) from error
    recording.check_plausible()
    if "velocity" in values:
        _check_velocity(recording, values["velocity"])
    return recording


def _check_finite(path: Path, quantity: str, values: Array, place: Callable[[int], str]) -> None:
    finite = np.isfinite(values)
    if not finite.all():
        row = int(np.argmin(finite))
        raise _not_finite(path, quantity, place(row), values[row])


def _not_finite(path: Path, quantity: str, place: str, value: float) -> RecordError:
    return RecordError(
        f"the {quantity} in {place} of {path.name} is {value}: "
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
