"""The newest signals, windows, parameters and diagnostics of a running system.

A node fills the record. Any number of viewers read it at their own pace: each viewer requests the
rows after its last row. The record stores nothing per viewer, so viewers need no memory here and
exert no back-pressure.
"""

from __future__ import annotations

import itertools
import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import SAME_CURRENT
from mr_damper_ros.processes.files import json_ready
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import LATE_NS, NANOSECONDS, SILENCE
from mr_damper_ros.tracking.reports import Report

Join = Callable[[Array], Array]
"""Joins pairs of rows: (k, 2, columns) to (k, columns)."""


def first_of_two(pairs: Array) -> Array:
    """The first row of each pair."""
    return pairs[:, 0]


class RollingTable:
    """Rows of numbers with consecutive indices from 0.

    A full table discards its oldest quarter, so that the cost per row is small. With ``join``, it
    joins the pairs of rows of its older half instead, so that the past stays in the table with
    decreasing resolution.
    """

    def __init__(
        self, columns: Sequence[str], capacity: int, join: Join | None = None, generation: int = 0
    ) -> None:
        self.columns = ("index", *columns)
        self.generation = generation
        """Distinguishes the table from tables of earlier runs or with other columns."""
        self._join = join
        # Filling the array allocates all of its memory at once.
        self._rows = np.full((capacity, len(self.columns)), np.nan)
        self._size = 0
        self.next_index = 0

    def extend(self, rows: Sequence[Sequence[float]] | Array) -> None:
        """Add rows (k, columns)."""
        values = np.asarray(rows, dtype=np.float64)
        longest = len(self._rows) // 4
        for first in range(0, len(values), longest):
            part = values[first : first + longest]
            while self._size + len(part) > len(self._rows):
                self._make_room()
            place = self._rows[self._size : self._size + len(part)]
            place[:, 0] = self.next_index + np.arange(len(part))
            place[:, 1:] = part
            self._size += len(part)
            self.next_index += len(part)

    def after(self, index: int) -> Array:
        """The rows after the row ``index``, shape (k, columns); the first column is the index."""
        start = int(np.searchsorted(self._rows[: self._size, 0], index, side="right"))
        return self._rows[start : self._size].copy()

    def _make_room(self) -> None:
        rows = self._rows[: self._size]
        if self._join is None:
            kept = rows[self._size // 4 :].copy()
        else:
            older = 2 * (self._size // 4)
            pairs = rows[:older].reshape(-1, 2, rows.shape[1])
            kept = np.concatenate([self._join(pairs), rows[older:]])
        self._size = len(kept)
        self._rows[: self._size] = kept


SIGNALS = (
    *("time", "displacement", "velocity", "current"),
    *("measured_force", "predicted_force", "force_error"),
    *("current_command", "desired_force", "valid"),
)
"""Columns of the table ``signals`` after the index, in SI units; ``valid`` is 1 or 0."""

SAMPLES = ("time", "displacement", "measured_force", "predicted_force", "valid")
"""Columns of the table ``samples``: the newest samples at the full rate, for the loops."""

_RANGED = SIGNALS[1:7]

HISTORY = ("time", *(f"{name}_{end}" for end in ("low", "high") for name in _RANGED), "valid")
"""Columns of the table ``history``, one row per tenth of a second.

Each row holds the smallest and largest values, and the fraction of valid force. The error is
computed from valid force only.
"""

WINDOWS = (
    *("time", "nrmse_before", "nrmse_after", "force_scale", "force_scale_error"),
    *("temperature", "fluid_temperature", "fluid_temperature_error", "current", "peak_velocity"),
    *("amplitude", "frequency", "fit_duration", "verdict", "accepted"),
)
"""Columns of the table ``windows``; ``accepted`` is 1 or 0."""

UNITS = {
    "time": "s",
    **dict.fromkeys(("displacement", "amplitude"), "m"),
    **dict.fromkeys(("velocity", "peak_velocity"), "m/s"),
    "current": "A",
    "current_command": "A",
    **dict.fromkeys(("measured_force", "predicted_force", "force_error", "desired_force"), "N"),
    **dict.fromkeys(("temperature", "fluid_temperature", "fluid_temperature_error"), "°C"),
    "frequency": "Hz",
    "fit_duration": "s",
}
"""Units of the columns; other columns have no unit."""

SIGNALS_KEPT = 6000
SAMPLES_KEPT = 10_000
HISTORY_KEPT = 36_000
"""Number of rows in one hour; the older half of a longer run is stored at a lower resolution."""

WINDOWS_KEPT = 2000
SETS_KEPT = 1000
SENTENCES_KEPT = 200
CONCERNS_KEPT = 200
"""Largest number of diagnostic names, so that a changing set of nodes cannot fill the memory."""

ENDED = "ended"
"""Value in the last diagnostic of a node that has done its work; its silence is no fault."""


@dataclass(frozen=True)
class Concern:
    """A diagnostic: ``level`` 0 good, 1 warning, 2 error, 3 stale."""

    name: str
    """Node and subject, such as ``model: input``."""
    level: int
    message: str
    values: Mapping[str, str]


@dataclass
class Fault:
    """An error that remains listed until a viewer acknowledges it, even if it has ended.

    ``name`` names the diagnostic or the silent node; ``since`` is a time [s] of the record's clock.
    """

    number: int
    name: str
    message: str
    since: float
    active: bool = True
    seen: bool = False


_ERROR = 2
"""Diagnostic level of an error."""


class Rows(NamedTuple):
    """Rows of a table with its generation and the names of its columns."""

    generation: int
    columns: tuple[str, ...]
    values: Array


class LiveRecord:
    """The record of a running system or a recording; all methods are thread-safe.

    ``clock`` returns the time [s]. ``recorded`` is the name of the recording, empty for a running
    system. ``signals_kept`` is the capacity of the table ``signals``.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        *,
        recorded: str = "",
        signals_kept: int = SIGNALS_KEPT,
    ) -> None:
        self._clock = clock
        self._recorded = recorded
        self._signals_kept = signals_kept
        self._lock = threading.Lock()
        # Numbers of tables, windows, faults and marks. They have a random start, because viewers of
        # an earlier process may still send requests.
        self._numbers = itertools.count(1 + secrets.randbits(31))
        self._sentences: deque[dict[str, Any]] = deque(maxlen=SENTENCES_KEPT)
        self.last_report: Report | None = None
        """The report on the last window; None before the first."""
        self.parameters: ParameterSet | None = None
        """The set in use; None before the first."""
        self._concerns: dict[str, tuple[Concern, float]] = {}
        self._faults: dict[str, Fault] = {}
        self._events: deque[str] = deque(maxlen=SENTENCES_KEPT)
        self._marks: deque[dict[str, Any]] = deque(maxlen=500)
        self._set_points: dict[str, tuple[float, float]] = {}
        self._currents: deque[tuple[float, float]] = deque(maxlen=SAMPLES_KEPT)
        self._current = math.nan
        self._recording: Mapping[str, str] | None = None
        self._heard = -math.inf
        self._begin()

    def _begin(self) -> None:
        self._tables: dict[str, RollingTable] = {}
        self._add_table("signals", SIGNALS, self._signals_kept)
        self._add_table("samples", SAMPLES, SAMPLES_KEPT)
        self._add_table("history", HISTORY, HISTORY_KEPT, _joined_ranges)
        self._add_table("windows", WINDOWS, WINDOWS_KEPT, first_of_two)
        self._tenth: list[tuple[float, ...]] = []
        self._marks.clear()
        # The level of the current, and the candidate for the next level; the start time of the
        # candidate, and the time at which the present level ended.
        self._level = self._next_level = math.nan
        self._level_since = self._level_left = -math.inf
        self._origin = self._last_time = math.nan
        self._recent: Array = np.empty((0, len(SAMPLES)))
        self._tick = -math.inf

    def _add_table(
        self, name: str, columns: Sequence[str], capacity: int, join: Join | None = None
    ) -> None:
        self._tables[name] = RollingTable(columns, capacity, join, next(self._numbers))

    def add_current(self, time_s: float, current: float) -> None:
        """Add a reading of the supply current [A], stamped ``time_s`` [s]."""
        with self._lock:
            if self._currents and time_s < self._currents[-1][0]:
                self._currents.clear()
            self._currents.append((time_s, current))

    def add_samples(
        self,
        start_s: float,
        period: float,
        displacement: Array,
        measured: Array,
        predicted: Array,
        valid: Array,
        velocity: Array | None = None,
    ) -> None:
        """Add contiguous samples (n,) at the full rate, and a row of signals for each hundredth.

        Without ``velocity`` [m/s], the slope of the displacement is used, and the rows of signals
        follow a few milliseconds after the samples.
        """
        times = start_s + period * np.arange(displacement.size)
        rows = np.column_stack([times, displacement, measured, predicted, valid])
        with self._lock:
            if start_s < self._last_time - LATE_NS / NANOSECONDS:  # the stamps have gone back
                self._begin()
                if self.parameters is not None:
                    known = self.parameters.known_parameters
                    self._trace("parameters", math.nan, known, SETS_KEPT)
            self._tables["samples"].extend(rows)
            if velocity is None:
                rows, velocity = self._with_slope(rows, period)
            # 100 rows a second show a motion of a few hertz; seconds since 1970 are rounded to
            # 0.24 µs.
            ticks = np.floor(rows[:, 0] * 100.0 + 1e-3)
            due = np.flatnonzero(np.diff(ticks, prepend=self._tick))
            self._tick = float(ticks[-1]) if ticks.size else self._tick
            chosen = np.column_stack([rows, velocity])[due]
            for time_s, place, force, expected, trusted, speed in chosen.tolist():
                while self._currents and self._currents[0][0] <= time_s:
                    self._current = self._currents.popleft()[1]
                row = (time_s, place, speed, self._current, force, expected)
                self._add_row(row, valid=trusted > 0.0)

    def _with_slope(self, rows: Array, period: float) -> tuple[Array, Array]:
        """The rows (k, columns) with a known velocity, and that velocity (k,).

        It is the slope of a line fitted to the displacement within 4 ms, as in page.js.
        """
        half = max(round(4e-3 / period), 1)
        if self._recent.size and rows[0, 0] - self._recent[-1, 0] > 1.5 * period:
            self._recent = self._recent[:0]
        rows = np.concatenate([self._recent, rows])
        self._recent = rows[-2 * half :]
        if len(rows) <= 2 * half:
            return rows[:0], rows[:0, 0]
        offsets = np.arange(-half, half + 1)
        slope = np.correlate(rows[:, 1], offsets / (period * np.sum(offsets**2)), "valid")
        return rows[half : len(rows) - half], slope

    def _add_row(self, row: tuple[float, ...], *, valid: bool) -> None:
        self._last_time, self._heard = row[0], self._clock()
        if math.isnan(self._origin):
            self._origin = self._last_time
        error = row[5] - row[4]
        wanted = (self._set_point(name) for name in ("current_command", "desired_force"))
        self._tables["signals"].extend([(*row, error, *wanted, float(valid))])
        if self._tenth and self._last_time >= self._tenth[0][0] + 0.1:
            rows, self._tenth = np.array(self._tenth), []
            low, high = (np.fmin.reduce(rows), np.fmax.reduce(rows))
            self._tables["history"].extend([(*low[:7], *high[1:7], rows[:, 7].mean())])
        self._tenth.append((*row, error if valid else math.nan, float(valid)))
        self._follow_current(self._last_time, row[3])

    def _follow_current(self, time_s: float, current: float) -> None:
        """Add a mark for each step of the current from one level to the next.

        A level lasts for half a second, so that a controller's continuous changes do not count.
        """
        if not abs(current - self._next_level) <= SAME_CURRENT:
            if self._next_level == self._level:
                self._level_left = time_s
            self._next_level, self._level_since = current, time_s
        elif self._next_level != self._level and time_s - self._level_since >= 0.5:
            if abs(self._next_level - self._level) > SAME_CURRENT:
                step = f"{self._level:.3g} to {self._next_level:.3g} A"
                self._mark("current", step, self._level_left)
            self._level = self._next_level

    def set_point(self, name: str, value: float) -> None:
        """Set the present ``current_command`` [A] or ``desired_force`` [N]."""
        with self._lock:
            self._set_points[name] = value, self._clock()

    def _set_point(self, name: str) -> float:
        value, heard = self._set_points.get(name, (math.nan, -math.inf))
        return value if self._clock() - heard <= SILENCE else math.nan

    def set_recording(self, recording: Mapping[str, str] | None) -> None:
        """Set the name and the path of the recording in progress, or None."""
        with self._lock:
            self._recording = recording
            self._mark("record", f"recording {'begins' if recording else 'ends'}", self._last_time)

    def _mark(self, kind: str, text: str, time_s: float) -> None:
        """Add an event: a set, a fault, a step of the current, the start or end of a recording."""
        number = next(self._numbers)
        self._marks.append({"number": number, "time": time_s, "kind": kind, "text": text})

    def add_report(self, report: Report, duration: float) -> None:
        """Add the result of a window, whose fit took ``duration`` [s]."""
        figures = {
            "time": report.stamp_ns / NANOSECONDS,
            "force_scale": report.scale.value,
            "force_scale_error": report.scale.standard_error,
            "fluid_temperature": report.fluid.celsius,
            "fluid_temperature_error": report.fluid.standard_error,
            "fit_duration": duration,
        }
        # The report has the other columns under the same name.
        row = [float(figures.get(name, getattr(report, name, math.nan))) for name in WINDOWS]
        with self._lock:
            self._tables["windows"].extend([row])
            self.last_report = report
            self._sentences.append(
                {
                    **dict(zip(WINDOWS, row, strict=True)),
                    "number": next(self._numbers),
                    "verdict": report.verdict.name,
                    "reason": report.reason,
                    "accepted": report.accepted,
                    "parameter_set": report.set_id,
                }
            )
            if known := report.known_coefficients:
                self._trace("coefficients", row[0], known, WINDOWS_KEPT)

    def set_parameters(self, seen: ParameterSet) -> None:
        """Set the parameter set in use."""
        with self._lock:
            self.parameters = seen
            # A set without a stamp was not identified from samples, and is in use from now on.
            since = seen.stamp_ns / NANOSECONDS if seen.stamp_ns else self._last_time
            self._trace("parameters", since, seen.known_parameters, SETS_KEPT)
            self._mark("set", f"{seen.set_id} ({seen.source.replace('_', ' ')})", since)

    def _trace(
        self, name: str, time_s: float, pairs: Mapping[str, tuple[float, float]], capacity: int
    ) -> None:
        """Add values and errors to a table; a change of the names starts a new table.

        The time [s] of a set is NaN if it is in use from the beginning.
        """
        columns = ("time", *pairs, *(f"{key}_error" for key in pairs))
        if name not in self._tables or self._tables[name].columns[1:] != columns:
            self._add_table(name, columns, capacity, first_of_two)
        values, errors = zip(*pairs.values(), strict=True)
        self._tables[name].extend([(time_s, *values, *errors)])

    def add_concern(self, concern: Concern) -> None:
        """Add a diagnostic."""
        with self._lock:
            if concern.name in self._concerns or len(self._concerns) < CONCERNS_KEPT:
                self._judge_silences()
                self._concerns[concern.name] = (concern, self._clock())
                self._judge_silences()
                self._judge(concern.name, concern.message, wrong=concern.level == _ERROR)

    def _judge_silences(self) -> None:
        """List silent nodes as faults."""
        now = self._clock()
        heard: dict[str, float] = {}
        for name, (concern, when) in self._concerns.items():
            node = name.partition(": ")[0]
            when = math.inf if ENDED in concern.values else when
            heard[node] = max(when, heard.get(node, -math.inf))
        for node, when in heard.items():
            self._judge(node, "no messages any more", wrong=now - when > SILENCE)

    def _judge(self, name: str, message: str, *, wrong: bool) -> None:
        """Update the fault of this name.

        A fault that returns before it is acknowledged keeps its start time. A fault that has ended
        is removed when it is acknowledged.
        """
        fault = self._faults.get(name)
        if wrong and fault is not None and fault.active:
            fault.message = message
        elif wrong:
            since = self._clock() if fault is None else fault.since
            self._faults[name] = Fault(next(self._numbers), name, message, since)
            self._mark("fault", f"{name}: {message}", self._last_time)
        elif fault is not None:
            fault.active = False
            self._drop_old_faults()

    def acknowledge(self, number: int) -> None:
        """Acknowledge all faults up to this number."""
        with self._lock:
            for fault in self._faults.values():
                fault.seen |= fault.number <= number
            self._drop_old_faults()

    def _drop_old_faults(self) -> None:
        self._faults = {n: f for n, f in self._faults.items() if f.active or not f.seen}

    def add_event(self, sentence: str) -> None:
        """Add a sentence about an action of this program."""
        with self._lock:
            self._events.append(sentence)

    def rows(self, name: str, after: int, generation: int) -> Rows | None:
        """Rows of a table after the index ``after``.

        Returns all rows if ``generation`` does not match the present table, and None if the table
        does not exist yet.
        """
        with self._lock:
            table = self._tables.get(name)
            if table is None:
                return None
            start = after if generation == table.generation else -1
            return Rows(table.generation, table.columns, table.after(start))

    @property
    def concerns(self) -> list[tuple[Concern, float]]:
        """The newest diagnostics, sorted by name, each with its age [s]."""
        with self._lock:
            now = self._clock()
            return [
                (concern, now - heard) for _, (concern, heard) in sorted(self._concerns.items())
            ]

    @property
    def silence(self) -> float:
        """Time [s] since the last signals; infinite before the first."""
        return self._clock() - self._heard

    def status(self, windows_after: int, marks_after: int = 0) -> dict[str, Any]:
        """The status of the system without the tables, as values for JSON.

        ``windows_after`` and ``marks_after`` are the numbers of the last window and the last mark
        that the viewer has.
        """
        concerns = self.concerns
        with self._lock:
            self._judge_silences()
            now = self._clock()
            status = {
                "tables": {
                    name: {"generation": table.generation, "next": table.next_index}
                    for name, table in self._tables.items()
                },
                **_of_the_set(self.parameters),
                "concerns": [{**vars(each), "silence": silence} for each, silence in concerns],
                "faults": [{**vars(f), "since": now - f.since} for f in self._faults.values()],
                "events": list(self._events),
                "marks": [mark for mark in self._marks if mark["number"] > marks_after],
                "recording": self._recording,
                "recorded": self._recorded,
                "silence": self.silence,
                "silent_after": SILENCE,
                "origin": self._origin,
                "windows": [w for w in self._sentences if w["number"] > windows_after],
            }
        return dict(json_ready(status))


def _joined_ranges(pairs: Array) -> Array:
    """Join pairs of rows of the history; the first column is the index."""
    low, high = np.fmin.reduce(pairs, axis=1), np.fmax.reduce(pairs, axis=1)
    lows, highs = low[:, : 2 + len(_RANGED)], high[:, 2 + len(_RANGED) : -1]
    return np.column_stack([lows, highs, pairs[:, :, -1].mean(axis=1)])


def _of_the_set(seen: ParameterSet | None) -> dict[str, object]:
    """The set in use, and the units of all columns, its parameters and coefficients included."""
    if seen is None:
        return {"units": UNITS, "set": None}
    coefficients = {quantity.name: quantity.unit for quantity in seen.law.at_one_current}
    summary = {
        "set_id": seen.set_id,
        "model": seen.model,
        "source": str(seen.source),
        "nrmse": seen.nrmse,
        "names": list(seen.law.parameter_names),
        "observable": seen.observable.tolist(),
    }
    return {"units": {**UNITS, **coefficients, **seen.law.units}, "set": summary}
