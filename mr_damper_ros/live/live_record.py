"""What is known of a running system: the newest signals, windows, parameters and diagnostics.

A node fills it, any number of viewers read it, each as fast as it can: they ask for what came after
the row that they have. Nothing is kept for a viewer, so that none costs memory or delays another.
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
"""A full table loses so large a part of its rows at once: making room costs little per row."""


class RollingTable:
    """Rows of numbers, counted from 0 since the beginning.

    A full table loses its oldest quarter. One that ``thins`` loses every second row of its older
    half instead: what lies far back stays in view, ever more coarsely.
    """

    def __init__(self, columns: Sequence[str], capacity: int, *, thins: bool = False) -> None:
        if capacity < 2 * _PART:
            raise ValueError(f"capacity must be at least {2 * _PART}, not {capacity}")
        self.columns = ("index", *columns)
        self._thins = thins
        # Filled, so that all of the memory is taken at once.
        self._rows = np.full((capacity, len(self.columns)), np.nan)
        self._size = 0
        self.next_index = 0
        """The number that the next row will have."""

    def __len__(self) -> int:
        return self._size

    def append(self, values: Sequence[float]) -> None:
        """Add a row; raises ValueError where the values are not as many as the columns."""
        if len(values) != len(self.columns) - 1:
            raise ValueError(f"{len(values)} values do not fill {len(self.columns) - 1} columns")
        if self._size == len(self._rows):
            self._make_room()
        row = self._rows[self._size]
        row[0] = self.next_index
        row[1:] = values
        self._size += 1
        self.next_index += 1

    def after(self, index: int) -> Array:
        """The rows after the one of this number, shape (k, columns), their numbers first."""
        start = int(np.searchsorted(self._rows[: self._size, 0], index, side="right"))
        return self._rows[start : self._size].copy()

    def _make_room(self) -> None:
        half = self._size // 2
        if self._thins:
            kept = np.concatenate([self._rows[:half:2], self._rows[half : self._size]])
        else:
            kept = self._rows[self._size // _PART : self._size].copy()
        self._size = len(kept)
        self._rows[: self._size] = kept


SIGNALS = (
    *("time", "displacement", "velocity", "current"),
    *("measured_force", "predicted_force", "force_error", "valid"),
)
"""Columns of the table ``signals`` after the index, in SI units; ``valid`` is 1 or 0."""

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
    **dict.fromkeys(("measured_force", "predicted_force", "force_error"), "N"),
    **dict.fromkeys(("temperature", "fluid_temperature", "fluid_temperature_error"), "°C"),
    "frequency": "Hz",
    "fit_duration": "s",
}
"""Of the columns of both; those that are not here have none."""

SIGNALS_KEPT = 6000
WINDOWS_KEPT = 2000
SETS_KEPT = 1000
SENTENCES_KEPT = 200
CONCERNS_KEPT = 200
"""Names of diagnostics; nodes that come and go must not fill the memory."""

SILENT_AFTER = 2.0
"""Seconds after which what was last heard is no longer shown as the present state."""

_ERROR = 2
"""The level of an error."""

_JUMP = 1.0
"""Stamps that fall back by more than this [s] are those of another recording."""


@dataclass(frozen=True)
class WindowSeen:
    """What became of a window; times [s] since the epoch, by the data's stamps."""

    figures: Mapping[str, float]
    """By the names of :data:`WINDOWS`; what is missing is not known."""
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
    """Node and what it is about: ``model: input``."""
    level: int
    message: str
    values: Mapping[str, str]


@dataclass(frozen=True)
class Fault:
    """An error that stays listed until somebody has seen it, also where it is over by then."""

    number: int
    name: str
    """Of the diagnostic, or of a node that is not heard any more."""
    message: str
    since: float
    """By the record's clock [s]."""
    active: bool = True
    seen: bool = False


def fault_after(
    fault: Fault | None, name: str, message: str, now: float, number: int, *, wrong: bool
) -> Fault | None:
    """What a fault, or none, has become at ``now`` [s]; a new one has this number.

    One that comes back before it was seen keeps its time. A fault that is over goes once it is
    seen.
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
    """Rows of a table, of which run and shape, with the names of the columns."""

    generation: int
    columns: tuple[str, ...]
    values: Array


class LiveRecord:
    """Collects what comes; all methods may be called from any thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        # Not those of the process before: a viewer that stays asks this one, too.
        self._generations = secrets.randbits(31)
        self._tables: dict[str, tuple[int, RollingTable]] = {}
        self._sentences: deque[tuple[int, bytes]] = deque(maxlen=SENTENCES_KEPT)
        self._windows_seen = 0
        self.last_window: WindowSeen | None = None
        """What became of the last window; None before the first."""
        self.parameters: SetSeen | None = None
        """The set in use; None before the first."""
        self._concerns: dict[str, tuple[Concern, float]] = {}
        self._faults: dict[str, Fault] = {}
        self._fault_count = 0
        self._events: deque[str] = deque(maxlen=SENTENCES_KEPT)
        self._origin = math.nan
        self._last_time = -math.inf
        self._heard = -math.inf
        self._fluid = (math.nan, math.nan)
        self._begin()

    def _begin(self) -> None:
        self._tables = {}
        self._add_table("signals", RollingTable(SIGNALS, SIGNALS_KEPT))
        self._add_table("windows", RollingTable(WINDOWS, WINDOWS_KEPT, thins=True))
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
        """Add what was measured and predicted at one stamp [s]; SI units."""
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
            self._tables["signals"][1].append((*row, predicted - measured, float(valid)))

    def add_fluid_temperature(self, celsius: float, error: float) -> None:
        """Take note of the temperature [°C] that the force of the next window tells."""
        with self._lock:
            self._fluid = (celsius, error)

    def add_window(self, window: WindowSeen) -> None:
        """Add what became of a window."""
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
        """Take note of the set in use from now on."""
        with self._lock:
            self.parameters = seen
            # What comes from no samples holds from now on.
            self._trace_set(seen, seen.time if seen.time > 0.0 else self._last_time)

    def _trace_set(self, seen: SetSeen, since: float) -> None:
        """Add a set to the table; ``since`` is infinite where it holds from the beginning."""
        named = zip(seen.names, seen.values, seen.standard_errors, seen.observable, strict=True)
        pairs = {
            name: (value, error if determined else math.nan)
            for name, value, error, determined in named
        }
        self._trace("parameters", since if math.isfinite(since) else math.nan, pairs, SETS_KEPT)

    def _trace(
        self, name: str, time_s: float, pairs: Mapping[str, tuple[float, float]], capacity: int
    ) -> None:
        """Add values with their errors to a table that has two columns for each of these names."""
        columns = ("time", *pairs, *(f"{key}_error" for key in pairs))
        _, table = self._tables.get(name, (0, None))
        if table is None or table.columns[1:] != columns:
            table = RollingTable(columns, capacity, thins=True)
            self._add_table(name, table)
        values = [value for value, _ in pairs.values()]
        errors = [error for _, error in pairs.values()]
        table.append((time_s, *values, *errors))

    def add_concern(self, concern: Concern) -> None:
        """Take note of how something stands."""
        with self._lock:
            if concern.name in self._concerns or len(self._concerns) < CONCERNS_KEPT:
                self._judge_silences()
                self._concerns[concern.name] = (concern, self._clock())
                self._judge_silences()
                self._judge(concern.name, concern.message, wrong=concern.level == _ERROR)

    def _judge_silences(self) -> None:
        """List the nodes that are not heard any more as faults."""
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
        self._faults[name] = fault
        self._fault_count = max(self._fault_count, fault.number)

    def acknowledge(self, number: int) -> None:
        """Take the faults up to this number as seen."""
        with self._lock:
            seen = {
                name: replace(fault, seen=fault.seen or fault.number <= number)
                for name, fault in self._faults.items()
            }
            self._faults = {
                name: fault for name, fault in seen.items() if fault.active or not fault.seen
            }

    def add_event(self, sentence: str) -> None:
        """Take note of what was done from here."""
        with self._lock:
            self._events.append(sentence)

    def rows(self, name: str, after: int, generation: int) -> Rows | None:
        """Rows of a table after that of a number; all where ``generation`` is another one's.

        None where there is no such table (yet).
        """
        with self._lock:
            if name not in self._tables:
                return None
            present, table = self._tables[name]
            return Rows(present, table.columns, table.after(after if generation == present else -1))

    @property
    def concerns(self) -> list[tuple[Concern, float]]:
        """The newest diagnostics, by name, and the seconds since each was heard."""
        with self._lock:
            now = self._clock()
            return [
                (concern, now - heard) for _, (concern, heard) in sorted(self._concerns.items())
            ]

    @property
    def silence(self) -> float:
        """Seconds since the last signals; infinite before the first."""
        return self._clock() - self._heard

    def status(self, windows_after: int) -> bytes:
        """All that is no table, as JSON: what the page asks for now and then.

        ``windows_after``: number of the last window that the viewer knows.
        """
        with self._lock:
            tables = {
                name: {"generation": generation, "next": table.next_index}
                for name, (generation, table) in self._tables.items()
            }
            sentences = [text for number, text in self._sentences if number > windows_after]
            seen, events = self.parameters, list(self._events)
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
            "silence": _json(self.silence),
            "silent_after": _json(SILENT_AFTER),
            "origin": _json(self._origin),
            "windows": b"[" + b",".join(sentences) + b"]",
        }
        return b"{" + b",".join(b'"%s":%s' % (k.encode(), v) for k, v in parts.items()) + b"}"


def _units(seen: SetSeen | None) -> dict[str, str]:
    """Units of all columns by name, also of the parameters and coefficients of a set."""
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
    """JSON, in which what is no number is null."""
    return json.dumps(json_ready(value), separators=(",", ":"), allow_nan=False).encode()
