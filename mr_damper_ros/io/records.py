"""Recordings in SI units from record files, which are tables of samples.

A file with several runs is cut at pauses, rests, and changes of current or cycle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from mr_damper_ros.io.binary_tables import FORMATS, read_binary_table
from mr_damper_ros.io.columns import MAXIMUM_SAMPLES, Columns, RawTable, RecordError, parse_columns
from mr_damper_ros.io.text_tables import NO_OPTIONS, Progress, TextOptions, read_text_table
from mr_damper_ros.kinematics.window import turning_points
from mr_damper_ros.models.quantities import SAME_CURRENT
from mr_damper_ros.processes.files import irregularity
from mr_damper_ros.signals.arrays import NOISE_SPAN, Array, white_noise
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.moving_average import pattern_left, undo_average, undo_average_in_motion
from mr_damper_ros.signals.recording import DEFAULT_START_NS, NotFiniteError, Recording

_JITTER_TO_MENTION = 0.01
"""Smallest deviation from uniform sampling, in periods, that a note mentions."""

_SAME_PERIOD = 0.001
"""Largest relative difference of two periods that are the same but for rounding."""

_SAME_STEP = 0.05
"""The same for the step between times that are rounded."""

_GAP = 1.5
"""A time step is a gap if it exceeds this multiple of the median step."""

_SHORT = 0.25
"""A step is short if it is shorter than the usual one by more than this fraction of it."""

_FEW = 0.05
"""Largest fraction of short steps in a record that is otherwise uniform."""

_BRIDGED = 5.0
"""Longest time step that is bridged by interpolation, in median steps."""

_LONGEST_GAP = 1.0
"""Longest time step [s] that is taken for lost samples, and not for a pause between runs."""

_EPOCH = 1e9
"""Times above this value [s] are relative to 1970, smaller ones to the start of the record."""

_VELOCITY_TOLERANCE = 1.2
"""Largest ratio between a velocity column and the derivative of the displacement."""

_AVERAGED = {"displacement", "velocity", "force"}
_REST = 0.02
"""Largest change of a quantity at rest, relative to its range."""

_INTEGRATED = (
    "the displacement is the integral of the velocity without its mean and drift: its absolute "
    "position is unknown"
)


@dataclass(frozen=True, eq=False)
class SampledRecord:
    """Columns (n,) of a file in SI units, by quantity.

    ``time`` [s] is the time column of the file, or starts at 0 with the given ``period`` [s].
    ``place`` describes the location of a row in the file. ``blocks`` are the rows at which the file
    begins a new block of samples. The recordings receive ``details`` and ``gaps``.
    """

    path: Path
    time: Array
    values: dict[str, Array]
    period: float | None
    place: Callable[[int], str]
    blocks: tuple[int, ...] = ()
    details: dict[str, str] = field(default_factory=dict)
    gaps: tuple[slice, ...] = ()

    def part(self, rows: slice) -> SampledRecord:
        """A part of the record."""
        first, place = rows.start, self.place
        return replace(
            self,
            time=self.time[rows],
            values={quantity: array[rows] for quantity, array in self.values.items()},
            place=lambda row: place(first + row),
            blocks=tuple(row - first for row in self.blocks if first < row < rows.stop),
            details={**self.details, "part": f"rows {first + 1} to {rows.stop}"},
        )

    def without_average(self, count: int, in_motion: bool = False) -> SampledRecord:
        """The record without its moving average over ``count`` samples.

        The record must begin at rest, unless ``in_motion``; then the result is approximate, see
        :func:`undo_average_in_motion`. Raises ValueError if the record does not begin at rest, is
        too short for the average, or was averaged over another number of samples.
        """
        if not 2 <= count < self.time.size:
            raise RecordError(
                f"a moving average over {count} samples cannot be undone in a record of "
                f"{self.time.size} samples: average over at least 2 samples, but "
                "not over the whole record"
            )
        values = dict(self.values)
        for quantity in _AVERAGED & set(values):
            smooth = values[quantity]
            if not in_motion and np.ptp(smooth[:count]) > _REST * np.ptp(smooth):
                raise RecordError(
                    f"the {quantity} does not rest in the first {count} samples, so its moving "
                    "average cannot be undone exactly: give the record from its very beginning, or "
                    "say that it begins in motion (--begins-in-motion)"
                )
            undo = undo_average_in_motion if in_motion else undo_average
            values[quantity] = undo(smooth, count)
            if pattern := pattern_left(values[quantity], count):
                raise RecordError(
                    f"without the moving average, a pattern of {count} samples makes up "
                    f"{pattern:.0%} of the {quantity}: it was averaged over another number of "
                    "samples, or not at all, or begins in motion (--begins-in-motion)"
                )
        note = f"a moving average over {count} samples was undone"
        return replace(self, values=values, details={**self.details, "smoothing": note})

    def between(self, start: float | None, stop: float | None) -> SampledRecord:
        """The part between two times [s after the first sample]; None means no limit."""
        # Without limits, decreasing times remain, and a later check reports their row.
        if start is None and stop is None:
            return self
        low = 0.0 if start is None else start
        high = math.inf if stop is None else stop
        if not low < high:
            raise RecordError(
                f"the part from {low:g} s to {high:g} s has no length: give the earlier time first"
            )
        elapsed = self.time - self.time[0]
        inside = np.flatnonzero((elapsed >= low - 1e-9) & (elapsed <= high + 1e-9))
        if inside.size < 2:
            raise RecordError(
                f"{self.path.name} has {inside.size} samples from {low:g} s to "
                f"{'its end' if stop is None else f'{high:g} s'}: it lasts {elapsed[-1]:g} s"
            )
        return self.part(slice(int(inside[0]), int(inside[-1]) + 1))

    def check_finite(self, quantity: str, values: Array) -> None:
        """Raise RecordError if a value of the quantity is not finite."""
        finite = np.isfinite(values)
        if not finite.all():
            row = int(np.argmin(finite))
            raise self._not_finite(quantity, row, values[row])

    def _not_finite(self, quantity: str, row: int, value: float) -> RecordError:
        return RecordError(
            f"the {quantity} in {self.place(row)} of {self.path.name} is {value}: "
            "correct it, or choose a part of the record without it"
        )

    def recording(self, current: float | None, name: str | None = None) -> Recording:
        """The recording; ``current`` [A] applies if no column holds the current.

        Raises RecordError or RecordingError if the sampling is not uniform, or a value is not
        finite.
        """
        if self.period is not None and self.blocks:
            raise RecordError(
                f"{self.path.name} holds {len(self.blocks) + 1} blocks of samples, the second from "
                f"{self.place(self.blocks[0])} on, and no column holds the time: cut it into its "
                "runs (mr-damper import --split)"
            )
        uniform = self._at_uniform_times() if self.period is None else None
        if uniform is not None:
            return uniform.recording(current, name)
        velocity = self.values.get("velocity")
        if velocity is not None:
            self.check_finite("velocity", velocity)
        period, note = self._even_pace() if self.period is None else (self.period, "")
        notes = [self.details["note"]] if "note" in self.details else []
        notes += [note] if note else []
        displacement = self.values.get("displacement")
        if displacement is None:
            assert velocity is not None
            displacement = _integrated(velocity, period)
            notes.append(_INTEGRATED)
        first = float(self.time[0])
        start_ns = (0 if first > _EPOCH else DEFAULT_START_NS) + round(first * NANOSECONDS)
        given = self.values.get("current", np.full(self.time.size, current))
        rows = displacement, self.values["force"], given, self.values.get("temperature")
        details = self.details | ({"note": "; ".join(notes)} if notes else {})
        try:
            recording = Recording(
                name or self.path.stem, start_ns, period, *rows, details, self.gaps
            )
        except NotFiniteError as error:
            value = self.values[error.quantity][error.sample]
            raise self._not_finite(error.quantity, error.sample, value) from error
        if velocity is not None and "displacement" in self.values:
            _check_velocity(recording, velocity)
        return recording

    def _at_uniform_times(self) -> SampledRecord | None:
        """The record at uniform times, if its steps are neither uniform nor long.

        Test machines add a sample at the end of a segment, loggers lose samples, and change their
        rate. None if the steps are uniform, or one is a pause.
        """
        steps = np.diff(self.time)
        if steps.size < 2 or np.any(steps <= 0.0):
            return None
        usual = float(np.median(steps))
        others = np.abs(steps - usual) > _SHORT * usual
        even = self.time[0] + np.arange(self.time.size) * float(np.mean(steps))
        jitters = float(np.max(np.abs(self.time - even))) <= _GAP * usual
        few_short = np.all(steps[others] < usual) and np.count_nonzero(others) > 0
        few_short = few_short and np.count_nonzero(others) <= _FEW * steps.size + 1.0
        if steps.max() > max(_BRIDGED * usual, _LONGEST_GAP):
            return None
        if not few_short and jitters and steps.max() <= _GAP * usual:
            return None
        # Two steps around an additional sample make one.
        kept = steps[~others]
        whole = _plain(float(np.sum(kept)), kept.size, 0.01 * usual) if few_short else usual
        time = np.arange(self.time[0], self.time[-1] + 1e-6 * whole, whole)
        values = {quantity: self._at(quantity, time) for quantity in self.values}
        note = (
            f"{np.count_nonzero(others)} of {steps.size} steps of the time differ from "
            f"{whole:.6g} s: the samples were interpolated to uniform times"
        )
        lost = np.flatnonzero(steps > _BRIDGED * usual)
        starts = np.searchsorted(time, self.time[lost] + 1e-6 * whole, side="right").tolist()
        stops = np.searchsorted(time, self.time[lost + 1] - 1e-6 * whole).tolist()
        gaps = tuple(map(slice, starts, stops))
        return replace(self, time=time, values=values, gaps=gaps)._noted(note)

    def _at(self, quantity: str, time: Array) -> Array:
        """A quantity at other times (m,) [s]: a current is held, others are interpolated."""
        array = self.values[quantity]
        self.check_finite(quantity, array)
        if quantity != "current":
            return np.interp(time, self.time, array)
        rows = np.searchsorted(self.time, time + 1e-6 * _usual_step(self.time), side="right") - 1
        return array[rows.clip(0)]

    def _noted(self, note: str) -> SampledRecord:
        """The record with one more note in its details."""
        notes = [*filter(None, [self.details.get("note")]), note]
        return replace(self, details={**self.details, "note": "; ".join(notes)})

    def on_time(self, quantity: str, late: float) -> SampledRecord:
        """The record with a quantity moved back that was recorded ``late`` [s], early if negative.

        Rows without this quantity are left out. Raises RecordError if none is left, or no column
        holds it.
        """
        if quantity not in self.values:
            raise RecordError(f"no column holds the {quantity}, so it cannot be late")
        at = self.time + late
        inside = np.flatnonzero((at >= self.time[0]) & (at <= self.time[-1]))
        if inside.size < 2:
            raise RecordError(
                f"the {quantity} cannot be {late:g} s late in a record of "
                f"{self.time[-1] - self.time[0]:g} s"
            )
        values = {**self.values, quantity: self._at(quantity, at)}
        moved = replace(self, values=values).part(slice(int(inside[0]), int(inside[-1]) + 1))
        return moved._noted(f"the {quantity}, {late:g} s late, was moved back")

    def _even_pace(self) -> tuple[float, str]:
        """Period [s] of uniform times, and a note if they jitter.

        Raises RecordError if the times do not increase, have gaps, or are not uniform.
        """
        time, name = self.time, self.path.name
        steps = np.diff(time)
        backward = np.flatnonzero(steps <= 0.0)
        if backward.size:
            row = int(backward[0]) + 1
            raise RecordError(
                f"the time in {self.place(row)} of {name} does not increase ({time[row]:.9g} s "
                f"after {time[row - 1]:.9g} s): choose a part without this row, cut the record "
                "into its runs (mr-damper import --split), or give the period instead of the column"
            )
        usual = float(np.median(steps))
        gaps = np.flatnonzero(steps > _GAP * usual)
        if gaps.size:
            row = int(gaps[0]) + 1
            raise RecordError(
                f"the time in {self.place(row)} of {name} increases by {steps[row - 1]:.6g} s "
                f"instead of {usual:.6g} s: choose a part of the record without the gap, or cut it "
                "into its runs (mr-damper import --split)"
            )
        # Unlike the median step, the mean step is not affected by rounding of the printed times.
        period = _plain(float(time[-1] - time[0]), time.size - 1, float(np.spacing(time[-1])))
        even = time[0] + np.arange(time.size) * period
        deviation = float(np.max(np.abs(time - even))) / period
        if deviation > _GAP:
            raise RecordError(
                f"the sampling of {name} is not uniform (the times deviate by {deviation:.1f} "
                f"periods of {period:.6g} s): resample the record, or choose a uniform part of it"
            )
        if deviation > _JITTER_TO_MENTION:
            return period, (
                f"the times deviate by {deviation:.1%} of a period; uniform sampling with a "
                f"period of {period:.6g} s is assumed"
            )
        return period, ""


def _plain(duration: float, steps: int, resolution: float) -> float:
    """The mean step [s], rounded to the digits that the resolution [s] of the times justifies.

    The result has at most nine digits.
    """
    mean = duration / steps
    rounded = (float(f"{mean:.{digits}g}") for digits in range(1, 10))
    tellable = (step for step in rounded if abs(step * steps - duration) <= 2.0 * resolution)
    return next(tellable, float(f"{mean:.9g}"))


def _integrated(velocity: Array, period: float) -> Array:
    """Displacement [m], shape (n,): the integral of the velocity [m/s] without mean and drift.

    The offset of the velocity sensor causes the drift.
    """
    from scipy.integrate import cumulative_trapezoid  # imported late: see entry_points
    from scipy.signal import detrend

    return np.asarray(detrend(cumulative_trapezoid(velocity, dx=period, initial=0.0)))


def _check_velocity(recording: Recording, velocity: Array) -> None:
    from scipy.signal import detrend  # imported late: see entry_points

    # The comparison uses displacements, because integration reduces noise, and differentiation
    # amplifies it.
    travelled = detrend(np.cumsum(velocity) * recording.period)
    moved = detrend(recording.displacement)
    ratio = float(travelled @ moved / (moved @ moved))
    if 1.0 / _VELOCITY_TOLERANCE <= ratio <= _VELOCITY_TOLERANCE:
        return
    raise RecordError(
        f"the velocity column is {ratio:.3g} times the derivative of the displacement: correct the "
        "unit or the sign of time, displacement or velocity (or write - to ignore the velocity)"
    )


def read_record(
    path: str | Path,
    columns: str,
    *,
    current: float | None = None,
    period: float | None = None,
    start: float | None = None,
    stop: float | None = None,
    variable: str | None = None,
    moving_average: int | None = None,
    begins_in_motion: bool = False,
    force_lateness: float = 0.0,
    current_lateness: float = 0.0,
    decimal_mark: str | None = None,
    maximum_samples: int = MAXIMUM_SAMPLES,
    progress: Progress | None = None,
) -> Recording:
    """Read a record file into a recording.

    A velocity column is checked against the displacement and then discarded. Without displacement,
    the velocity is integrated, and ``details["note"]`` says so.

    Parameters
    ----------
    path
        Text, CSV, MAT, XLSX, TDMS or MF4 file. The fields of a text file are separated by spaces,
        tabs, semicolons or commas. The numbers of the whole file show the decimal mark and
        thousands separators; ambiguous ones are refused. Lines above the rows of numbers, between
        blocks of them and below them are left out, and ``details["note"]`` names what could be
        samples.
    columns
        Quantity and unit of each column from the left.

        See :func:`mr_damper_ros.io.columns.parse_columns`.
    current
        Current [A] of the whole record, if no column holds it.
    period
        Time between samples [s], if no column holds it.
    start
        Start of the part to read [s after the first sample].
    stop
        End of the part to read [s after the first sample].
    variable
        Matrix or structure of a MAT file, sheet of a spreadsheet, or group of channels, if there
        are several.
    moving_average
        Undo a moving average over this number of samples; exact if the record begins at rest.

        Other filters cannot be undone.
    begins_in_motion
        Whether the averaged record begins in motion. The result is then approximate: it lacks the
        part that the average removed, which is small in a record of many cycles.
    force_lateness, current_lateness
        Time [s] by which this column was recorded later than the displacement, negative if earlier.

        The column is moved back, and ``details["note"]`` says so.
    decimal_mark
        Decimal mark of a text file, . or , if its numbers do not show it.
    maximum_samples
        Largest number of samples; a file with more is rejected.
    progress
        Receives the fraction of a text file that has been read, several times a second.

    Raises
    ------
    RecordError, ColumnError, RecordingError
        If the file or an option cannot be used; the message says what to change.
    OSError
        If the file cannot be read.
    """
    wanted = parse_columns(columns)
    if "current" not in wanted.quantities and current is None:
        raise RecordError(
            "the coil current is unknown: name its column (current:A), or give one for all samples"
        )
    _check_current(wanted, current)
    text = TextOptions(decimal_mark, progress)
    record = _read_samples(path, wanted, period, variable, maximum_samples, text)
    if moving_average is not None:
        record = record.without_average(moving_average, begins_in_motion)
    for quantity, late in (("force", force_lateness), ("current", current_lateness)):
        record = record.on_time(quantity, late) if late else record
    return record.between(start, stop).recording(current)


def _read_samples(
    path: str | Path,
    wanted: Columns,
    period: float | None,
    variable: str | None,
    maximum_samples: int,
    text: TextOptions,
) -> SampledRecord:
    """The columns of a file in SI units. Raises the exceptions of :func:`read_record`."""
    path = Path(path)
    if "time" in wanted.quantities and period is not None:
        raise RecordError("the time is given twice: by a column and by the period")
    if period is not None and not (math.isfinite(period) and period > 0.0):
        raise RecordError(f"the period is {period} s: it must be positive")
    kind = irregularity(path)
    if kind:
        raise RecordError(f"{path} is {kind}: give a text, CSV, MAT, XLSX, TDMS or MF4 file")
    if path.stat().st_size == 0:
        raise RecordError(f"{path.name} is empty: give a file with at least two rows of numbers")
    if path.suffix.lower() in FORMATS:
        if text.decimal_mark is not None:
            raise RecordError(f"the decimal mark applies to text files: omit it for {path.name}")
        table = read_binary_table(path, wanted, variable, maximum_samples)
    else:
        table = read_text_table(path, wanted, variable, maximum_samples, text)
    if "time" not in wanted.quantities and period is None:
        period = table.period
        if period is None:
            raise RecordError(
                "the time between samples is unknown: name the column of the time (time:s), or "
                "give the period"
            )
    # The table is emptied, so that there is only one copy.
    values = {c.quantity: c.to_si(table.values.pop(c.quantity)) for c in wanted.wanted}
    count = next(iter(values.values())).size
    if count < 2:
        raise RecordError(f"{path.name} holds one row of numbers: at least two are needed")
    notes = list(table.notes)
    if period is not None:
        _check_period(path.name, period, table)
    details = {"provenance": f"imported from {path.name}", "columns": wanted.text}
    if notes:
        details["note"] = "; ".join(notes)
    time = values.pop("time") if period is None else np.arange(count, dtype=np.float64) * period
    record = SampledRecord(path, time, values, period, table.place, table.breaks, details)
    record.check_finite("time", time)
    return record


def _check_period(name: str, period: float, table: RawTable) -> None:
    """Raise RecordError if a sample period [s] is not the one that a file states."""
    if table.period is not None:
        stated, where, tolerance = table.period, name, _SAME_PERIOD
    elif table.shown is not None:
        stated, column = table.shown
        where, tolerance = f"{column} of {name}", _SAME_STEP
    else:
        return
    if abs(period - stated) > tolerance * stated:
        raise RecordError(
            f"{where} states a sample period of {stated:.4g} s, but {period:.4g} s was given: "
            "correct it, or leave it out and name the column of the time (time:s)"
        )


def _check_current(wanted: Columns, current: float | None) -> None:
    """Raise RecordError if a constant current [A] is not finite, or a column holds the current."""
    if current is None:
        return
    if "current" in wanted.quantities:
        raise RecordError("the current is given twice: by a column and as a constant")
    if not math.isfinite(current):
        raise RecordError(f"the current is {current} A: give a finite number")


_BLOCK = 0.1
"""Length of a block [s]. Rests are detected block by block, and a run keeps one block of a rest."""

_SHORTEST_REST = 1.0
"""Shortest duration of a rest [s]."""

_REST_OF_STROKE = 0.3
"""Shortest duration of a rest relative to a stroke, because a slow reversal resembles a rest."""

_STILL = 0.002
"""Largest change of the displacement at rest, relative to its span, unless the noise is larger."""

_SMALLEST_RUN = 0.02
"""Smallest span of a run, relative to the largest span in the file."""

_REVERSAL = 0.1
"""Smallest return of the motion at a reversal, relative to the span."""

_PHASE_CHANGE = 0.2
"""Largest change of the logarithm of height, duration or force within a phase."""

_REFERENCE_STROKES = 4
"""Number of previous strokes whose median is the reference for a change."""

_STROKES = 6
"""Smallest number of strokes of a phase."""

_STEADY = 0.7
"""If the phases cover less than this fraction of a motion, the whole motion is one run."""


def read_runs(
    path: str | Path,
    columns: str,
    *,
    currents: float | Sequence[float | None] | None = None,
    period: float | None = None,
    variable: str | None = None,
    decimal_mark: str | None = None,
    maximum_samples: int = MAXIMUM_SAMPLES,
    progress: Progress | None = None,
) -> list[Recording]:
    """Read a file with several successive runs into one recording per run.

    A run ends where the time jumps or restarts (the logger has paused), where the file repeats its
    headings and has no column of the time, where the rod rests for at
    least one second, where a measured current changes, and where a steady cycle changes its
    amplitude, frequency or force.
    ``currents`` [A] has one value per run, or is one number for all runs, if no column holds the
    current; None omits a run. The other parameters are as in :func:`read_record`.

    Raises the exceptions of :func:`read_record`. For a wrong number of currents, the message lists
    the runs.
    """
    text = TextOptions(decimal_mark, progress)
    return RunsOfFile(path, columns, period, variable, maximum_samples, text).recordings(currents)


class RunsOfFile:
    """The runs of a file, before their currents are known.

    ``summaries``: a description of each run; ``asks``: whether currents are needed. Raises the
    exceptions of :func:`read_runs`.
    """

    def __init__(
        self,
        path: str | Path,
        columns: str,
        period: float | None = None,
        variable: str | None = None,
        maximum_samples: int = MAXIMUM_SAMPLES,
        text: TextOptions = NO_OPTIONS,
    ) -> None:
        self._wanted = wanted = parse_columns(columns)
        self._record = _read_samples(path, wanted, period, variable, maximum_samples, text)
        self._rows = _runs(self._record)
        self._name = Path(path).name
        self.asks = "current" not in wanted.quantities
        self.summaries = [_summary(self._record, rows) for rows in self._rows]
        if not self._rows:
            raise RecordError(f"{self._name} contains no run, because the displacement is constant")

    def recordings(self, currents: float | Iterable[float | None] | None) -> list[Recording]:
        """A recording of each run with a current, or of all runs if a column holds the current."""
        count = len(self._rows)
        if currents is not None:
            currents = list(currents) if isinstance(currents, Iterable) else [currents] * count
            if not self.asks:
                raise RecordError("the current is given twice: by a column and for each run")
        if self.asks and len(currents or ()) != count:
            listed = "; ".join(f"{k}: {text}" for k, text in enumerate(self.summaries, start=1))
            raise RecordError(
                f"{self._name} holds {count} runs, but {len(currents or ())} currents "
                f"are given: give one [A] for each run (currents, --currents), or None (-) to omit "
                f"the run ({listed})"
            )
        recordings = []
        for number, rows in enumerate(self._rows, start=1):
            current = None if currents is None else currents[number - 1]
            if self.asks and current is None:
                continue
            _check_current(self._wanted, current)
            run = self._record.part(rows)
            recordings.append(run.recording(current, f"{Path(self._name).stem}_{number}"))
        return recordings


def _runs(record: SampledRecord) -> list[slice]:
    """Rows of each run of a record, in order; parts without motion are not runs."""
    steps, usual = np.diff(record.time), _usual_step(record.time)
    jumps = np.flatnonzero((steps <= 0.0) | (steps > _GAP * usual)) + 1
    if record.period is not None:
        jumps = np.array(record.blocks, dtype=np.intp)
    length = max(round(_BLOCK / usual), 1)
    motions = [
        motion
        for stretch in _between(jumps.tolist(), slice(0, record.time.size))
        for level in _levels(record, stretch, length)
        for motion in _motions(record, level, length)
    ]
    spans = [float(np.ptp(_position(record, motion))) for motion in motions]
    return [
        phase
        for motion, span in zip(motions, spans, strict=True)
        if span > _SMALLEST_RUN * max(spans)
        for phase in _phases(record, motion)
    ]


def _summary(record: SampledRecord, rows: slice) -> str:
    """Description of a run: its duration, its start in the file, and its loop without spikes."""
    low, high = np.percentile(record.values["force"][rows], (0.5, 99.5))
    position = _position(record, rows)
    turns = _turns(position)
    period = _usual_step(record.time)
    strokes = (turns[-1] - turns[0]) * period / (len(turns) - 1) if len(turns) > 1 else np.inf
    return (
        f"{position.size * period:.3g} s from {record.place(rows.start)}, "
        f"{500.0 * float(np.ptp(position)):.3g} mm, {0.5 / strokes:.2g} Hz, "
        f"±{0.5 * float(high - low):.3g} N"
    )


def _usual_step(time: Array) -> float:
    steps = np.diff(time)
    return float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 1.0


def _position(record: SampledRecord, rows: slice) -> Array:
    """Displacement [m] of some rows; without displacement, the integral of the velocity."""
    if "displacement" in record.values:
        return record.values["displacement"][rows]
    velocity = record.values["velocity"]
    record.check_finite("velocity", velocity)
    return _integrated(velocity[rows], _usual_step(record.time))


def _between(cuts: list[int], rows: slice) -> Iterator[slice]:
    for first, last in pairwise([rows.start, *cuts, rows.stop]):
        if last - first > 1:
            yield slice(first, last)


def _levels(record: SampledRecord, rows: slice, length: int) -> Iterator[slice]:
    """Rows at one current; without a measured current, all rows."""
    current = record.values.get("current")
    cuts: list[int] = []
    if current is not None:
        level = float(np.median(current[rows][:length]))
        for first in range(rows.start, rows.stop, length):
            block = float(np.median(current[first : min(first + length, rows.stop)]))
            if abs(block - level) > SAME_CURRENT:
                cuts.append(first)
                level = block
    yield from _between(cuts, rows)


def _motions(record: SampledRecord, rows: slice, length: int) -> Iterator[slice]:
    """Rows between rests of the rod."""
    position = _position(record, rows)
    count = position.size // length
    window = round(_SHORTEST_REST / _BLOCK)
    span = float(np.ptp(position))
    if count < window or span == 0.0:
        if span > 0.0:
            yield rows
        return
    blocks = position[: count * length].reshape(count, length)
    still = max(_STILL * span, NOISE_SPAN * white_noise(position))
    views = np.lib.stride_tricks.sliding_window_view(blocks, window, axis=0)
    spans = views.max(axis=(1, 2)) - views.min(axis=(1, 2))
    resting = np.convolve(spans < still, np.ones(window)) > 0.0
    strokes = max(len(_turns(position)) - 1, 1)
    least = _REST_OF_STROKE * (count - np.count_nonzero(resting)) / strokes
    rests = np.ma.clump_masked(np.ma.array(resting, mask=resting))  # type: ignore[no-untyped-call]
    for rest in rests:
        if rest.stop - rest.start < least:
            resting[rest] = False
    moves = np.ma.clump_unmasked(np.ma.array(resting, mask=resting))  # type: ignore[no-untyped-call]
    for moved in moves:
        start = rows.start + max(moved.start - 1, 0) * length
        stop = rows.stop if moved.stop == count else rows.start + (moved.stop + 1) * length
        yield slice(start, min(stop, rows.stop))


def _turns(position: Array) -> list[int]:
    """Indices of the reversals of the motion."""
    return turning_points(position.tolist(), _REVERSAL * float(np.ptp(position)))[1:-1].tolist()


def _phases(record: SampledRecord, rows: slice) -> list[slice]:
    """The phases of steady cycles in a motion, or the whole motion if there are none."""
    position, force = _position(record, rows), record.values["force"][rows]
    strokes = list(pairwise(_turns(position)))
    heights = np.array(
        [(abs(position[j] - position[i]), j - i, np.ptp(force[i:j])) for i, j in strokes]
    )
    if len(strokes) < 2 * _STROKES or np.any(heights <= 0.0):
        return [rows]
    features = np.log(heights)
    phases, first = [], 0
    for k in range(1, len(strokes) + 1):
        before = np.median(features[max(first, k - _REFERENCE_STROKES) : k], axis=0)
        if k == len(strokes) or np.max(np.abs(features[k] - before)) > _PHASE_CHANGE:
            if k - first >= _STROKES:
                phases.append(slice(rows.start + strokes[first][0], rows.start + strokes[k - 1][1]))
            first = k
    covered = sum(phase.stop - phase.start for phase in phases)
    if len(phases) < 2 or covered < _STEADY * position.size:
        return [rows]
    return phases
