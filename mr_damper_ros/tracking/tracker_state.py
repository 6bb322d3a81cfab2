"""The state of a tracker in a folder: read at the start, written after every new set.

The file contains the running set and the tracker's memory. The memory is one line of JSON. Arrays
are stored as base64 of their doubles, so all digits are preserved. No content is ever executed. The
reader checks types and numbers against the declarations of the dataclasses, and rejects entries
that do not fit each other.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import json
import math
import types
import typing
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.models.plausibility import implausible
from mr_damper_ros.processes.files import BackgroundWriter, FolderLock
from mr_damper_ros.processes.worker import GRACE
from mr_damper_ros.tracking.force_scale import is_plausible
from mr_damper_ros.tracking.state_directory import (
    StateDirectory,
    StateError,
    is_of_a_node,
    lock_file,
    mark_asides_read,
    remove_unfinished,
    set_aside,
    unread_asides,
)
from mr_damper_ros.tracking.tracker import TrackerMemory, WindowTracker

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
        memory = _read(TrackerMemory, json.loads(text), "memory")
        _check(memory, model)
        return memory
    except (RecursionError, ValueError, OverflowError, TypeError, LookupError) as error:
        raise StateError(f"the memory of the tracker cannot be used: {error}") from error


def _plain(value: Any) -> Any:
    """Convert a value to types that JSON supports."""
    if isinstance(value, ParameterSet):
        return value.to_yaml()
    if isinstance(value, np.ndarray):
        data = np.ascontiguousarray(value, dtype="<f8").tobytes()
        return {"shape": list(value.shape), _DATA: base64.b64encode(data).decode("ascii")}
    if dataclasses.is_dataclass(value):
        return {each.name: _plain(getattr(value, each.name)) for each in dataclasses.fields(value)}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _read(kind: Any, data: Any, where: str) -> Any:
    """Convert parsed JSON to a type; ``where`` names the value in errors (ValueError).

    A float is finite, an integer is a count or a stamp, and a vector has finite entries.
    """
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        value = _read(arguments[0], data, where)
        _require(value > 0, f"{where} is not positive")
        return value
    if origin in (types.UnionType, typing.Union):  # all unions here are optional types
        return None if data is None else _read(arguments[0], data, where)
    if origin is np.ndarray:
        values = np.frombuffer(base64.b64decode(data[_DATA], validate=True), "<f8")
        values = values.astype(float).reshape(data["shape"])
        _require(values.ndim > 1 or bool(np.isfinite(values).all()), f"{where} is not finite")
        return values
    if origin is tuple:
        _require(isinstance(data, list), f"{where} is not a list")
        kinds = arguments[:1] * len(data) if arguments[1:] == (Ellipsis,) else arguments
        return tuple(_read(each, item, where) for each, item in zip(kinds, data, strict=True))
    if kind is ParameterSet:
        return ParameterSet.from_yaml(_read(str, data, where))
    if dataclasses.is_dataclass(kind):
        return _dataclass(kind, data, where)
    value = float(data) if kind is float and type(data) is int else data
    _require(type(value) is kind, f"{where} has the wrong type")
    if kind is int:
        least = -_LARGEST if where.endswith("_ns") else 0
        _require(least <= value <= _LARGEST, f"{where} is out of range")
    _require(kind is not float or math.isfinite(value), f"{where} is not finite")
    return value


_LARGEST = int(np.iinfo(np.int64).max)

_hints = cache(partial(typing.get_type_hints, include_extras=True))


def _dataclass(kind: Any, data: Any, where: str) -> Any:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    sound = isinstance(data, dict) and data.keys() == fields.keys()
    _require(sound, f"{where} does not have the entries {', '.join(sorted(fields))}")
    found = {}
    for name, item in data.items():
        # A number that is NaN by default may be unknown.
        unknown = item != item and fields[name].default != fields[name].default
        found[name] = math.nan if unknown else _read(_hints(kind)[name], item, f"{where}.{name}")
    return kind(**found)


def _require(sound: bool, fault: str) -> None:
    if not sound:
        raise ValueError(fault)


def _check(memory: TrackerMemory, model: Model) -> None:
    """Raise ValueError if entries do not fit each other or the model."""
    rival, watch = memory.rival, memory.watch
    sound = memory.global_patience > 0 and (watch is None or watch.block > 0)
    _require(sound, "a count is zero")
    if rival is not None:
        sound = rival.model == model.name and not implausible(rival)
        _require(sound, "the set to be confirmed is not plausible")
    _require(all(len(each) in (2, 4) for each in memory.residuals), "a residual is incomplete")
    for record in memory.points.records:
        seen, baseline = record.temperatures, record.baseline
        sound = seen.ndim == 2 and seen.shape[1] == 3 and is_plausible(seen)
        _require(sound, "a temperature or force scale is not plausible")
        _require((record.window is None) == (record.number == 0), "a window has no number")
        if record.window is not None:
            _check_window(record.window)
        right = baseline is None or baseline.shape == (len(model.parameters),)
        _require(right, "a baseline has the wrong number of parameters")


def _check_window(window: Window) -> None:
    motion, places, whole = window.motion, window.places, window.whole
    arrays = (*motion.arrays, *(() if places is None else (places,)))
    sound = window.force.size > 0 and all(each.shape == window.force.shape for each in arrays)
    _require(sound, "the arrays of a window differ in length")
    _require(bool(np.all(motion.peak_velocity >= 0.0)), "a peak velocity is negative")
    if whole is not None:
        _check_window(whole)
    if places is None:
        _require(whole is None, "a part of a window has no places")
    else:
        last = math.inf if whole is None else whole.sample_count - 1
        inside = bool(np.all((places >= 0.0) & (places <= last)))
        _require(inside, "a place is outside its window")
        _require(whole is not None or window.steady, "the whole of a part of a window is missing")


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
        if (path := self.path) is None:
            return ""
        self._lock = lock_file(path)
        if unread := unread_asides(path):
            self.set_aside = "at an earlier start, unusable files were set aside as " + (
                ", ".join(map(str, unread))
            )
        remove_unfinished(path)
        if not path.exists():
            self._directory.save(self._name, tracker.parameters)
            return ""
        try:
            parameters, memory = self._directory.load(self._name)
            parameters.of_model(tracker.parameters.model)
        except (StateError, ParameterError) as error:
            self._set_aside(path, str(error))
            return ""
        try:
            learnt = from_text(memory, parameters.law) if memory else None
        except StateError as error:
            tracker.replace(parameters)
            self._set_aside(path, f"{error}; continuing with {parameters.set_id} alone")
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
        text = to_text(memory)
        from_text(text, parameters.law)
        self._directory.save(self._name, parameters, text)

    def _set_aside(self, path: Path, why: str) -> None:
        try:
            why += f"; set aside as {set_aside(path)}"
        except StateError as error:
            why += f"; {error}"
        self.set_aside = "; ".join(filter(None, (why, self.set_aside)))

    def acknowledge(self) -> str:
        """Acknowledge the files set aside, so that they are no longer reported.

        Returns the message about them. The files are renamed, not deleted. Raises StateError if
        they cannot be renamed.
        """
        if self.path is not None:
            mark_asides_read(self.path)
        taken, self.set_aside = self.set_aside, ""
        return taken

    def keep(self, tracker: WindowTracker) -> None:
        """Write the running set and the memory in the background; needs :meth:`resume`."""
        if self._lock is not None:
            self.writer.keep((tracker.parameters, tracker.memory))

    def keep_now(self, tracker: WindowTracker) -> str:
        """Write the state and wait for the disk; returns why this failed, or an empty text."""
        self.keep(tracker)
        if not self.writer.wait(GRACE):
            return f"writing to state_dir takes more than {GRACE:g} s"
        return self.writer.fault

    def save(self, name: str, tracker: WindowTracker) -> Path:
        """Store the running set under a name, "" for the tracker's own; returns its file.

        Raises StateError if this is not possible, or if another node stores its state under that
        name.
        """
        path = self._directory.file(name or self._name)
        if path != self.path:
            if is_of_a_node(path):
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
        return self._directory.load(name or self._name)[0]

    def close(self) -> None:
        """Write the states that wait for the disk, release the lock and end."""
        self.writer.wait(GRACE)
        if self._lock is not None:
            self._lock.release()
