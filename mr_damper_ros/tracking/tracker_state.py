"""The state of a tracker in a folder: read at the start, written after every new set.

The file contains the running set and the tracker's memory. The memory is one line of JSON. Arrays
are stored as base64 of their doubles, so all digits are preserved. No content is ever executed. The
reader checks the types against the dataclasses, and rejects impossible shapes and values.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import json
import math
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.models.plausibility import implausible
from mr_damper_ros.processes.deferred import BackgroundWriter
from mr_damper_ros.processes.files import FolderLock
from mr_damper_ros.tracking.force_scale import is_plausible
from mr_damper_ros.tracking.operating_point import KnownPoints, PointRecord, nearest_same
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError
from mr_damper_ros.tracking.tracker import TrackerMemory, WindowTracker

T = TypeVar("T")

_DATA = "float64"
"""Key of an array's doubles (little endian, base64); the shape has a separate key."""


def to_text(memory: TrackerMemory) -> str:
    """The memory as one line of text; :func:`from_text` reads it back exactly."""
    return json.dumps(_plain(memory), separators=(",", ":"))


def from_text(text: str, model: Model) -> TrackerMemory:
    """Read the memory of a tracker of this model from a line of text.

    Raises StateError if the text is malformed or contains impossible values.
    """
    try:
        data = json.loads(text)
        if isinstance(data, dict) and "points" not in data:
            data = _with_records(data)
        memory = _read(TrackerMemory, data, "memory")
        # An older version may have had fewer parameters, and numbers of windows from 0 on.
        records = memory.points.records
        first = min((each.number for each in records if each.window is not None), default=1)
        read = []
        for each in records:
            number = 0 if each.window is None else each.number + (first == 0)
            if (fit := each.baseline) is not None:
                fit = dataclasses.replace(fit, parameters=model.completed(fit.parameters))
            read.append(dataclasses.replace(each, number=number, baseline=fit))
        memory.points = KnownPoints(tuple(read))
        return check(memory, model)
    except RecursionError as error:
        raise StateError("the memory of the tracker is nested too deeply") from error
    except StateError:
        raise
    except (ValueError, OverflowError, TypeError, LookupError) as error:
        raise StateError(f"the memory of the tracker cannot be used: {error}") from error


_EARLIER_TABLES = ("baselines", "reservoir", "reservoir_points", "reservoir_stamps", "temperatures")


def _with_records(data: dict[str, Any]) -> dict[str, Any]:
    """Convert the data of an earlier version, one table per kind of entry, to point records."""
    fits, windows, points, stamps, temperatures = (data.get(name, []) for name in _EARLIER_TABLES)
    history = data.get("history", {})
    found = [(fit["operating_point"], {"baseline": fit}) for fit in fits]
    stamps = stamps or [0] * len(windows)
    for number, (window, point, stamp) in enumerate(zip(windows, points, stamps, strict=True)):
        found.append((point, {"window": window, "stamp_ns": stamp, "number": number}))
    for each in temperatures:
        found.append((each["operating_point"], {"temperatures": each["seen"]}))
    for force in history.get("forces", []):
        found.append(([force["peak_velocity"], force["current"]], {"force": force}))
    records: list[dict[str, Any]] = []
    for point, entries in found:
        place = nearest_same([each["point"] for each in records], point)
        if place is None:
            place = len(records)
            nothing = np.empty((0, 3))
            records.append({"point": point, "temperatures": _plain(nothing)})
        records[place] |= entries
    gone = {*_EARLIER_TABLES, "history", "kept_ns"}
    kept = {name: value for name, value in data.items() if name not in gone}
    names = ("residuals", "refused_for_residual", "level")
    kept |= {name: history[name] for name in names if name in history}
    return {**kept, "points": {"records": records}}


def _plain(value: Any) -> Any:
    """Convert a value to types that JSON supports."""
    if isinstance(value, ParameterSet):
        return value.to_yaml()
    if isinstance(value, np.ndarray):
        data = np.ascontiguousarray(value, dtype="<f8").tobytes()
        return {"shape": list(value.shape), _DATA: base64.b64encode(data).decode("ascii")}
    if dataclasses.is_dataclass(value):
        return {
            field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _read(kind: type[T], data: Any, where: str) -> T:
    """Convert parsed JSON to a type; ``where`` names the value in errors (ValueError)."""
    value: Any
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):  # all unions here are optional types
        value = None if data is None else _read(arguments[0], data, where)
    elif kind is ParameterSet:
        value = ParameterSet.from_yaml(_read(str, data, where))
    elif origin is np.ndarray:
        value = _array(data, where)
    elif origin is tuple:
        value = _tuple(arguments, data, where)
    elif dataclasses.is_dataclass(kind):
        value = _dataclass(kind, data, where)
    elif kind is float and type(data) is int:
        value = float(data)
    elif type(data) is kind:
        value = data
    else:
        raise ValueError(f"{where} has the wrong type")
    return typing.cast("T", value)


def _array(data: Any, where: str) -> np.ndarray:
    if not isinstance(data, dict) or data.keys() != {"shape", _DATA}:
        raise ValueError(f"{where} is not an array")
    shape = _read(tuple[int, ...], data["shape"], f"{where}.shape")
    values = np.frombuffer(base64.b64decode(_read(str, data[_DATA], where), validate=True), "<f8")
    if min(shape, default=0) < 0 or math.prod(shape) != values.size:
        raise ValueError(f"the data of {where} do not match its shape")
    return values.astype(float).reshape(shape)


def _tuple(arguments: tuple[Any, ...], data: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(data, list):
        raise ValueError(f"{where} is not a list")
    if arguments[1:] == (Ellipsis,):
        arguments = arguments[:1] * len(data)
    if len(arguments) != len(data):
        raise ValueError(f"{where} has {len(data)} entries instead of {len(arguments)}")
    return tuple(
        _read(kind, item, f"{where}[{index}]")
        for index, (kind, item) in enumerate(zip(arguments, data, strict=True))
    )


def _dataclass(kind: Any, data: Any, where: str) -> Any:
    hints = typing.get_type_hints(kind)
    fields = dataclasses.fields(kind)
    # Fields added by a later version have a default.
    needed = {
        field.name
        for field in fields
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    }
    names = {field.name for field in fields}
    if not isinstance(data, dict) or not needed <= data.keys() <= names:
        raise ValueError(f"{where} does not have the entries {', '.join(sorted(names))}")
    return kind(**{name: _read(hints[name], data[name], f"{where}.{name}") for name in data})


def check(memory: TrackerMemory, model: Model) -> TrackerMemory:
    """Return the memory unchanged; raises StateError if it contains impossible values."""
    for sound, what in _checks_of_memory(memory, model):
        if not sound:
            raise StateError(f"the memory of the tracker contains an invalid {what}")
    return memory


def _checks_of_memory(memory: TrackerMemory, model: Model) -> Iterator[tuple[bool, str]]:
    watch, state, records = memory.watch, memory.state, memory.points.records
    largest = np.iinfo(np.int64).max
    counts = (
        *(memory.windows, memory.accepted, memory.accepted_since_global),
        *(memory.searched_points, memory.motion.windows, memory.global_patience - 1),
        *(memory.unexplained_windows, memory.unexplained_patience, memory.refused_for_residual),
    )
    yield 0 <= min(counts) <= max(counts) <= largest, "count"
    if (rival := memory.rival) is not None:
        yield rival.model == model.name and not implausible(rival), "set to be confirmed"
    stamps = [memory.changed_ns, memory.seen_ns]
    stamps += [stamp for scale in memory.scales for stamp in (scale.start_ns, scale.end_ns)]
    stamps += [number for record in records for number in (record.stamp_ns, record.number)]
    stamps += [] if state is None else [state.stamp_ns]
    yield max(map(abs, stamps)) <= largest, "stamp"
    for residual in memory.residuals:
        sound = len(residual) in (2, 4) and _finite(*residual)
        yield sound and min(residual[:3]) >= 0.0, "residual"
    yield 0.0 < memory.level < math.inf, "force level"
    for scale in memory.scales:
        sound = _finite(scale.value, scale.standard_error) and scale.standard_error > 0.0
        yield sound, "force scale"
    points = [record.point for record in records]
    if state is not None:
        yield _square(state.scales, state.covariance), "covariance"
        fits = state.scales.size == model.unknown_indices.size
        yield fits and _finite(*state.scales), "state of the filter"
        points.append(state.operating_point)
    if watch is not None:
        points.append(watch.operating_point)
        sizes = (watch.noise, watch.block_norm, watch.smallest_change, watch.threshold)
        sums = (watch.rising, watch.falling, watch.top, watch.rising_samples, watch.falling_samples)
        yield min(*sizes, watch.block) > 0.0 and _finite(*sizes), "state of the change detection"
        yield min(sums) >= 0 and _finite(*sums), "sum of the change detection"
    yield _finite(*(number for point in points for number in point)), "operating point"
    for record in records:
        yield from _checks_of_record(record, len(model.parameters))


def _checks_of_record(record: PointRecord, parameter_count: int) -> Iterator[tuple[bool, str]]:
    seen, force, fit = record.temperatures, record.force, record.baseline
    sound = seen.ndim == 2 and seen.shape[1] == 3 and is_plausible(seen)
    yield sound, "temperature or force scale"
    if force is not None:
        sizes = (force.peak_velocity, force.size, force.largest)
        yield min(sizes) > 0.0 and _finite(*sizes, force.current), "known force"
    if fit is not None:
        yield fit.parameters.shape == (parameter_count,), "number of parameters"
        for vector, matrix in (
            (fit.scales, fit.covariance),
            (fit.scales, fit.discrepancy),
            (fit.coefficients, fit.coefficient_covariance),
            (fit.coefficients, fit.coefficient_discrepancy),
        ):
            yield matrix is None or _square(vector, matrix), "covariance"
        for array in (fit.parameters, fit.scales, fit.coefficients, fit.operating_point):
            yield bool(np.all(np.isfinite(array))), "value in a fit"
    if record.window is not None:
        yield from _checks_of_window(record.window)


def _checks_of_window(window: Window) -> Iterator[tuple[bool, str]]:
    motion, shape = window.motion, window.force.shape
    yield len(shape) == 1 and window.force.size > 0, "window without samples"
    for array in (motion.displacement, motion.velocity, motion.acceleration, motion.peak_velocity):
        yield array.shape == shape, "window: its arrays differ in length"
        yield bool(np.all(np.isfinite(array))), "motion: it is not finite"
    yield bool(np.all(motion.peak_velocity >= 0.0)), "peak velocity"
    yield math.isnan(window.period) or 0.0 < window.period < math.inf, "sample period"
    places, whole = window.places, window.whole
    if whole is not None:
        yield from _checks_of_window(whole)
    if places is None:
        yield whole is None, "part of a window: it has no places"
    else:
        last = math.inf if whole is None else whole.sample_count - 1
        yield places.shape == shape, "window: its arrays differ in length"
        yield bool(np.all((places >= 0.0) & (places <= last))), "place in a window"
        yield whole is not None or window.steady, "part of a window: the whole is missing"


def _finite(*values: float) -> bool:
    return all(map(math.isfinite, values))


def _square(vector: np.ndarray, matrix: np.ndarray) -> bool:
    """Whether a matrix can be the covariance of a vector."""
    fits = vector.ndim == 1 and matrix.shape == vector.shape * 2
    return fits and not bool(np.any(np.diagonal(matrix) < 0.0))


DISK_PATIENCE = 1.0
"""Seconds to wait for the disk to write a state before continuing without it."""


class TrackerState:
    """The file of a tracker's state, under its own name in the folder with the sets of the user.

    Without a ``directory`` nothing is stored. ``writer`` writes the state in the background.
    ``set_aside`` is a message about unusable files that were set aside; empty once acknowledged.
    """

    def __init__(self, directory: StateDirectory | None = None, name: str = "tracker") -> None:
        self._directory = directory or StateDirectory("")
        self._name = name
        self._lock: FolderLock | None = None
        self.writer: BackgroundWriter[tuple[ParameterSet, TrackerMemory]]
        self.writer = BackgroundWriter(self._write)
        self.set_aside = ""

    @property
    def path(self) -> Path | None:
        """The file of the tracker's own state; None if state is not stored."""
        return self._directory.file(self._name) if self._directory.keeps else None

    def resume(self, tracker: WindowTracker) -> str:
        """Continue a tracker from the stored state of this name, which can be kept from now on.

        Returns a description of the state found, empty for none. An unusable file is reported by
        :attr:`set_aside`. Raises StateError if the folder cannot be used, or if another process
        stores its state there under this name.
        """
        if not self._directory.keeps:
            return ""
        self._lock = self._directory.lock(self._name)
        if unread := self._directory.unread_asides(self._name):
            self.set_aside = "at an earlier start, unusable files were set aside as " + (
                ", ".join(map(str, unread))
            )
        self._directory.remove_unfinished(self._name)
        if not self._directory.file(self._name).exists():
            self._directory.save(self._name, tracker.parameters)
            return ""
        try:
            parameters, memory = self._directory.load_with_memory(self._name)
            parameters.of_model(tracker.parameters.model)
        except (StateError, ParameterError) as error:
            self._set_aside(str(error))
            return ""
        try:
            learnt = from_text(memory, parameters.law) if memory else None
        except StateError as error:
            tracker.replace(parameters)
            self._set_aside(f"{error}; continuing with {parameters.set_id} alone")
            with contextlib.suppress(StateError):
                self._directory.save(self._name, parameters)
            return ""
        if learnt is None:
            tracker.replace(parameters)
            return f"parameters {parameters.set_id} and a new baseline"
        tracker.resume(parameters, learnt)
        return (
            f"parameters {parameters.set_id} and {len(learnt.points.baselines)} baselines, "
            f"{len(learnt.points.windows)} windows"
        )

    def _write(self, item: tuple[ParameterSet, TrackerMemory]) -> None:
        """Write a state; raises StateError if the next start would reject it."""
        parameters, memory = item
        self._directory.save(self._name, parameters, to_text(check(memory, parameters.law)))

    def _set_aside(self, why: str) -> None:
        try:
            why += f"; set aside as {self._directory.set_aside(self._name)}"
        except StateError as error:
            why += f"; {error}"
        self.set_aside = "; ".join(filter(None, (why, self.set_aside)))

    def acknowledge(self) -> str:
        """Acknowledge the files set aside, so that they are no longer reported.

        Returns the message about them. The files are renamed, not deleted. Raises StateError if
        they cannot be renamed.
        """
        if self._directory.keeps:
            self._directory.mark_asides_read(self._name)
        taken, self.set_aside = self.set_aside, ""
        return taken

    def keep(self, tracker: WindowTracker) -> None:
        """Write the running set and the memory in the background; needs :meth:`resume`."""
        if self._lock is not None:
            self.writer.keep((tracker.parameters, tracker.memory))

    def keep_now(self, tracker: WindowTracker) -> str:
        """Write the state and wait for the disk; returns why this failed, or an empty text."""
        self.keep(tracker)
        if not self.writer.wait(DISK_PATIENCE):
            return f"writing to state_dir takes more than {DISK_PATIENCE:g} s"
        return self.writer.fault

    def save(self, name: str, tracker: WindowTracker) -> Path:
        """Store the running set under a name, "" for the tracker's own; returns its file.

        Raises StateError if this is not possible, or if another node stores its state under that
        name.
        """
        path = self._directory.file(name or self._name)
        if path != self._directory.file(self._name):
            if self._directory.is_of_a_node(name):
                raise StateError(
                    f"{path} is the state of another node, which would load this set: give "
                    "another name"
                )
            return self._directory.save(name, tracker.parameters)
        if fault := self.keep_now(tracker):
            raise StateError(fault)
        return path

    def load(self, name: str) -> ParameterSet:
        """The set stored under a name, "" for the tracker's own.

        Raises StateError if there is no usable set.
        """
        return self._directory.load(name or self._name)

    def close(self) -> None:
        """Write the states that wait for the disk, release the lock and end."""
        self.writer.close(DISK_PATIENCE)
        if self._lock is not None:
            self._lock.release()
