"""The newest signals, windows, parameters and diagnostics of a running system.

A node fills the record. Any number of viewers read it at their own pace: each viewer requests the
rows after its last row. The record stores nothing per viewer, so viewers need no memory here and
exert no back-pressure.
"""

from __future__ import annotations

import json
import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mr_damper_ros.models import MODELS
from mr_damper_ros.processes.files import json_ready
from mr_damper_ros.signals.arrays import Array

_PART = 4
"""A full table frees 1 / ``_PART`` of its rows at once, so that the cost per row is small."""

Join = Callable[[Array], Array]
"""Joins pairs of rows: (k, 2, columns) to (k, columns)."""


def first_of_two(pairs: Array) -> Array:
    """The first row of each pair."""
    return pairs[:, 0]


class RollingTable:
    """Rows of numbers with consecutive indices from 0.

    A full table discards its oldest quarter. With ``join``, it joins the pairs of rows of its older
    half instead, so that the past stays in the table with decreasing resolution.
    """

    def __init__(self, columns: Sequence[str], capacity: int, join: Join | None = None) -> None:
        if capacity < 2 * _PART:
            raise ValueError(f"capacity must be at least {2 * _PART}, not {capacity}")
        self.columns = ("index", *columns)
        self._join = join
        # Filling the array allocates all of its memory at once.
        self._rows = np.full((capacity, len(self.columns)), np.nan)
        self._size = 0
        self.next_index = 0
        """Index of the next row."""

    def __len__(self) -> int:
        return self._size

    def append(self, values: Sequence[float]) -> None:
        """Add a row; raises ValueError if the number of values is wrong."""
        self.extend(np.array([values], dtype=np.float64))

    def extend(self, values: Array) -> None:
        """Add rows (k, columns); raises ValueError if the number of columns is wrong."""
        if values.ndim != 2 or values.shape[1] != len(self.columns) - 1:
            given = values.shape[-1]
            raise ValueError(f"{given} values do not fill {len(self.columns) - 1} columns")
        longest = len(self._rows) // _PART
        for first in range(0, len(values), longest):
            part = values[first : first + longest]
            while self._size + len(part) > len(self._rows):
                self._make_room()
            rows = self._rows[self._size : self._size + len(part)]
            rows[:, 0] = self.next_index + np.arange(len(part))
            rows[:, 1:] = part
            self._size += len(part)
            self.next_index += len(part)

    def after(self, index: int) -> Array:
        """The rows after the row ``index``, shape (k, columns); the first column is the index."""
        start = int(np.searchsorted(self._rows[: self._size, 0], index, side="right"))
        return self._rows[start : self._size].copy()

    def _make_room(self) -> None:
        rows = self._rows[: self._size]
        if self._join is None:
            kept = rows[self._size // _PART :].copy()
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

HISTORY = ("time", *(f"{name}_{end}" for name in _RANGED for end in ("low", "high")), "valid")
"""Columns of the table ``history``, one row per tenth of a second.

They hold the smallest and largest values and the fraction of valid force. The error is that of
valid force only.
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
"""Rows of one hour; the older half of a longer run is kept at a lower resolution."""

_HISTORY_STEP = 0.1
MARKS_KEPT = 500

_LEVEL = 0.05
"""Smallest difference [A] between two levels of the current."""

_HELD = 0.5
"""Shortest duration [s] of a level; it excludes the continuous changes of a controller."""

WINDOWS_KEPT = 2000
SETS_KEPT = 1000
SENTENCES_KEPT = 200
CONCERNS_KEPT = 200
"""Largest number of diagnostic names, so that a changing set of nodes cannot fill the memory."""

SILENT_AFTER = 2.0
"""Age [s] from which the last values are no longer shown as the present state."""

_ERROR = 2
"""Diagnostic level of an error."""

_JUMP = 1.0
"""Stamps that go back by more than this time [s] start a new recording."""


@dataclass(frozen=True)
class WindowSeen:
    """The result of a window; times [s] since the epoch, by the stamps of the data."""

    figures: Mapping[str, float]
    """Values by the names of :data:`WINDOWS`; unknown values are missing."""
    verdict: str
    reason: str
    parameter_set: str
    accepted: bool
    coefficients: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Value and standard error by name."""


@dataclass(frozen=True)
class SetSeen:
    """A parameter set in use; the arrays have one entry per parameter."""

    time: float
    set_id: str
    model: str
    source: str
    node: str
    nrmse: float
    names: Sequence[str]
    units: Sequence[str]
    values: Sequence[float]
    standard_errors: Sequence[float]
    observable: Sequence[bool]
    peak_velocity_range: tuple[float, float]
    current_range: tuple[float, float]


@dataclass(frozen=True)
class Concern:
    """A diagnostic: ``level`` 0 good, 1 warning, 2 error, 3 stale."""

    name: str
    """Node and subject, such as ``model: input``."""
    level: int
    message: str
    values: Mapping[str, str]


@dataclass(frozen=True)
class Mark:
    """An event at ``time`` [s since the epoch]: a set, a fault or a step of the current."""

    number: int
    time: float
    kind: str
    text: str


@dataclass(frozen=True)
class Fault:
    """An error that stays listed until a viewer acknowledges it, even if it is over."""

    number: int
    name: str
    """Name of the diagnostic, or of the silent node."""
    message: str
    since: float
    """Time [s] on the clock of the record."""
    active: bool = True
    seen: bool = False


def fault_after(
    fault: Fault | None, name: str, message: str, now: float, number: int, *, wrong: bool
) -> Fault | None:
    """The fault after a new diagnostic at ``now`` [s]; None if there is no fault to list.

    ``wrong``: whether the error is present; ``number``: the number of a new fault. A fault that
    returns before it is acknowledged keeps its start time. A fault that is over is removed when it
    is acknowledged.
    """
    if wrong and fault is not None and fault.active:
        return replace(fault, message=message)
    if wrong:
        return Fault(number, name, message, now if fault is None else fault.since)
    if fault is None or fault.seen:
        return None
    return replace(fault, active=False)


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a table with the names of its columns.

    ``generation`` identifies the table among those of earlier runs and other columns.
    """

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
        # The random start differs from that of an earlier process, whose viewers may still ask.
        self._generations = secrets.randbits(31)
        self._tables: dict[str, tuple[int, RollingTable]] = {}
        self._sentences: deque[tuple[int, bytes]] = deque(maxlen=SENTENCES_KEPT)
        self._windows_seen = 0
        self.last_window: WindowSeen | None = None
        """The result of the last window; None before the first."""
        self.parameters: SetSeen | None = None
        """The set in use; None before the first."""
        self._concerns: dict[str, tuple[Concern, float]] = {}
        self._faults: dict[str, Fault] = {}
        self._fault_count = 0
        self._events: deque[str] = deque(maxlen=SENTENCES_KEPT)
        self._marks: deque[Mark] = deque(maxlen=MARKS_KEPT)
        self._mark_count = 0
        self._set_points: dict[str, tuple[float, float]] = {}
        self._recording: Mapping[str, str] | None = None
        self._origin = math.nan
        self._last_time = -math.inf
        self._heard = -math.inf
        self._fluid = (math.nan, math.nan)
        self._begin()

    def _begin(self) -> None:
        self._tables = {}
        self._add_table("signals", RollingTable(SIGNALS, self._signals_kept))
        self._add_table("samples", RollingTable(SAMPLES, SAMPLES_KEPT))
        self._add_table("history", RollingTable(HISTORY, HISTORY_KEPT, _joined_ranges))
        self._add_table("windows", RollingTable(WINDOWS, WINDOWS_KEPT, first_of_two))
        self._tenth: list[tuple[float, ...]] = []
        self._marks.clear()
        # Level of the current and candidate for the next level; start time of the candidate, and
        # time at which the present level was left.
        self._level = self._next_level = math.nan
        self._level_since = self._level_left = -math.inf
        self._origin = math.nan
        self._last_time = -math.inf

    def _add_table(self, name: str, table: RollingTable) -> None:
        self._generations += 1
        self._tables[name] = (self._generations, table)

    def add_signals(
        self,
        time_s: float,
        displacement: float,
        velocity: float,
        current: float,
        measured: float,
        predicted: float,
        *,
        valid: bool,
    ) -> None:
        """Add the measured and predicted signals at one stamp [s]; SI units."""
        row = (time_s, displacement, velocity, current, measured, predicted)
        with self._lock:
            if time_s < self._last_time - _JUMP:
                self._begin()
                if self.parameters is not None:
                    self._trace_set(self.parameters, -math.inf)
            if math.isnan(self._origin):
                self._origin = time_s
            self._last_time = time_s
            self._heard = self._clock()
            wanted = (self._set_point(name) for name in ("current_command", "desired_force"))
            self._tables["signals"][1].append((*row, predicted - measured, *wanted, float(valid)))
            self._summarise((*row, predicted - measured if valid else math.nan, float(valid)))
            self._follow_current(time_s, current)

    def _summarise(self, row: tuple[float, ...]) -> None:
        if self._tenth and row[0] >= self._tenth[0][0] + _HISTORY_STEP:
            self._tables["history"][1].append(_range_of(np.array(self._tenth)).tolist())
            self._tenth = []
        self._tenth.append(row)

    def _follow_current(self, time_s: float, current: float) -> None:
        """Add a mark for each step of the current from one level to the next."""
        if not abs(current - self._next_level) <= _LEVEL:
            if self._next_level == self._level:
                self._level_left = time_s
            self._next_level, self._level_since = current, time_s
        elif self._next_level != self._level and time_s - self._level_since >= _HELD:
            if abs(self._next_level - self._level) > _LEVEL:
                step = f"{self._level:.3g} to {self._next_level:.3g} A"
                self._mark("current", step, self._level_left)
            self._level = self._next_level

    def add_samples(self, start_s: float, period: float, *columns: Array) -> None:
        """Add samples at the full rate: the columns (n,) of :data:`SAMPLES` except the time."""
        time_s = start_s + period * np.arange(columns[0].size)
        with self._lock:
            self._tables["samples"][1].extend(np.column_stack([time_s, *columns]))

    def set_point(self, name: str, value: float) -> None:
        """Set the present ``current_command`` [A] or ``desired_force`` [N]."""
        with self._lock:
            self._set_points[name] = value, self._clock()

    def _set_point(self, name: str) -> float:
        value, heard = self._set_points.get(name, (math.nan, -math.inf))
        return value if self._clock() - heard <= SILENT_AFTER else math.nan

    def set_recording(self, recording: Mapping[str, str] | None) -> None:
        """Set the name and the path of the recording in progress, or None."""
        with self._lock:
            self._recording = recording
            self._mark("record", f"recording {'begins' if recording else 'ends'}", self._last_time)

    def _mark(self, kind: str, text: str, time_s: float) -> None:
        self._mark_count += 1
        self._marks.append(Mark(self._mark_count, time_s, kind, text))

    def add_fluid_temperature(self, celsius: float, error: float) -> None:
        """Set the fluid temperature [°C] of the next window, estimated from the force."""
        with self._lock:
            self._fluid = (celsius, error)

    def add_window(self, window: WindowSeen) -> None:
        """Add the result of a window."""
        figures = {
            "fluid_temperature": self._fluid[0],
            "fluid_temperature_error": self._fluid[1],
            "accepted": float(window.accepted),
            **window.figures,
        }
        with self._lock:
            self._fluid = (math.nan, math.nan)
            self._tables["windows"][1].append([figures.get(name, math.nan) for name in WINDOWS])
            self._windows_seen += 1
            self.last_window = window
            told = {
                **figures,
                "number": self._windows_seen,
                "verdict": window.verdict,
                "reason": window.reason,
                "accepted": window.accepted,
                "parameter_set": window.parameter_set,
            }
            self._sentences.append((self._windows_seen, _json(told)))
            if window.coefficients:
                pairs = window.coefficients
                self._trace("coefficients", figures.get("time", math.nan), pairs, WINDOWS_KEPT)

    def set_parameters(self, seen: SetSeen) -> None:
        """Set the parameter set in use."""
        with self._lock:
            self.parameters = seen
            # A set without a stamp was not identified from samples; it is in use from now on.
            since = seen.time if seen.time > 0.0 else self._last_time
            self._trace_set(seen, since)
            self._mark("set", f"{seen.set_id} ({seen.source.replace('_', ' ')})", since)

    def _trace_set(self, seen: SetSeen, since: float) -> None:
        """Add a set to the table; ``since`` [s] is infinite if it is in use from the beginning."""
        named = zip(seen.names, seen.values, seen.standard_errors, seen.observable, strict=True)
        pairs = {
            name: (value, error if determined else math.nan)
            for name, value, error, determined in named
        }
        self._trace("parameters", since if math.isfinite(since) else math.nan, pairs, SETS_KEPT)

    def _trace(
        self, name: str, time_s: float, pairs: Mapping[str, tuple[float, float]], capacity: int
    ) -> None:
        """Add values and errors to a table; a change of the names starts a new table."""
        columns = ("time", *pairs, *(f"{key}_error" for key in pairs))
        _, table = self._tables.get(name, (0, None))
        if table is None or table.columns[1:] != columns:
            table = RollingTable(columns, capacity, first_of_two)
            self._add_table(name, table)
        values = [value for value, _ in pairs.values()]
        errors = [error for _, error in pairs.values()]
        table.append((time_s, *values, *errors))

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
        for name, (_, when) in self._concerns.items():
            node = name.partition(": ")[0]
            heard[node] = max(when, heard.get(node, -math.inf))
        for node, when in heard.items():
            self._judge(node, "not heard any more", wrong=now - when > SILENT_AFTER)

    def _judge(self, name: str, message: str, *, wrong: bool) -> None:
        before, number = self._faults.get(name), self._fault_count + 1
        fault = fault_after(before, name, message, self._clock(), number, wrong=wrong)
        if fault is None:
            self._faults.pop(name, None)
            return
        if fault.active and not (before is not None and before.active):
            self._mark("fault", f"{name}: {message}", self._last_time)
        self._faults[name] = fault
        self._fault_count = max(self._fault_count, fault.number)

    def acknowledge(self, number: int) -> None:
        """Acknowledge all faults up to this number."""
        with self._lock:
            seen = {
                name: replace(fault, seen=fault.seen or fault.number <= number)
                for name, fault in self._faults.items()
            }
            self._faults = {
                name: fault for name, fault in seen.items() if fault.active or not fault.seen
            }

    def add_event(self, sentence: str) -> None:
        """Add a sentence about an action of this program."""
        with self._lock:
            self._events.append(sentence)

    def rows(self, name: str, after: int, generation: int) -> Rows | None:
        """Rows of a table after the index ``after``.

        Returns all rows if ``generation`` is not that of the present table, and None if there is no
        such table yet.
        """
        with self._lock:
            if name not in self._tables:
                return None
            present, table = self._tables[name]
            return Rows(present, table.columns, table.after(after if generation == present else -1))

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

    def status(self, windows_after: int, marks_after: int = 0) -> bytes:
        """The status of the system without the tables, as JSON.

        ``windows_after`` and ``marks_after`` are the numbers of the last window and the last mark
        that the viewer has.
        """
        with self._lock:
            tables = {
                name: {"generation": generation, "next": table.next_index}
                for name, (generation, table) in self._tables.items()
            }
            sentences = [text for number, text in self._sentences if number > windows_after]
            seen, events, recording = self.parameters, list(self._events), self._recording
            marks = [vars(mark) for mark in self._marks if mark.number > marks_after]
            self._judge_silences()
            now = self._clock()
            faults = [
                {**vars(fault), "since": now - fault.since} for fault in self._faults.values()
            ]
        parts = {
            "tables": _json(tables),
            "units": _json(_units(seen)),
            "set": _json(None if seen is None else vars(seen)),
            "concerns": _json(
                [{**vars(concern), "silence": silence} for concern, silence in self.concerns]
            ),
            "faults": _json(faults),
            "events": _json(events),
            "marks": _json(marks),
            "recording": _json(recording),
            "recorded": _json(self._recorded),
            "silence": _json(self.silence),
            "silent_after": _json(SILENT_AFTER),
            "origin": _json(self._origin),
            "windows": b"[" + b",".join(sentences) + b"]",
        }
        return b"{" + b",".join(b'"%s":%s' % (k.encode(), v) for k, v in parts.items()) + b"}"


def _range_of(rows: Array) -> Array:
    """A row of the history from signals (n, 8): time, six signals, validity of the force."""
    low, high = np.fmin.reduce(rows[:, 1:7]), np.fmax.reduce(rows[:, 1:7])
    ranges = np.stack([low, high], axis=1).ravel()
    return np.concatenate([rows[:1, 0], ranges, [rows[:, 7].mean()]])


def _joined_ranges(pairs: Array) -> Array:
    """Join pairs of rows of the history; the first column is the index."""
    joined = pairs[:, 0].copy()
    joined[:, 2:-1:2] = np.fmin(pairs[:, 0, 2:-1:2], pairs[:, 1, 2:-1:2])
    joined[:, 3:-1:2] = np.fmax(pairs[:, 0, 3:-1:2], pairs[:, 1, 3:-1:2])
    joined[:, -1] = pairs[:, :, -1].mean(axis=1)
    return joined


def _units(seen: SetSeen | None) -> dict[str, str]:
    """Units of all columns by name, including the parameters and coefficients of a set."""
    if seen is None:
        return UNITS
    law = MODELS.get(seen.model)
    coefficients = law.coefficient_quantities if law else ()
    return {
        **UNITS,
        **{quantity.name: quantity.unit for quantity in coefficients},
        **dict(zip(seen.names, seen.units, strict=True)),
    }


def _json(value: object) -> bytes:
    """JSON with null for values that are not finite."""
    return json.dumps(json_ready(value), separators=(",", ":"), allow_nan=False).encode()
