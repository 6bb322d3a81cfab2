"""What a tracker has learnt besides the running set, as plain data and as text.

The text is JSON, arrays in it as base64 of their doubles: to the last digit, and nothing in it is
ever executed. What is read back is checked against the types of the dataclasses, and for shapes
and values that no identification leaves behind.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import math
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.tracking.acceptance import AcceptanceHistory
from mr_damper_ros.tracking.cusum import ChangeWatch
from mr_damper_ros.tracking.fluid_temperature import TemperatureHistory, can_be_seen
from mr_damper_ros.tracking.force_scale import SeenScale
from mr_damper_ros.tracking.reservoir import OperatingPoint
from mr_damper_ros.tracking.running_set import SteadyMotion
from mr_damper_ros.tracking.state_directory import StateError
from mr_damper_ros.tracking.unscented_filter import FilterState

T = TypeVar("T")

_DATA = "float64"
"""Key of an array's doubles (little endian, base64); its shape goes with it."""

_STAMP_LIMIT = 2**63
"""Stamps [ns] have 64 bits."""


@dataclass(frozen=True, eq=False)
class TrackerMemory:
    """All of a tracker but its settings and its running set; see ``WindowTracker``.

    ``windows`` judged so far (they number the sets); ``accepted`` since the start or reset;
    ``accepted_since_global``: good windows since the last global identification, whether their set
    was taken or the one in use confirmed; ``history`` of acceptance; ``baselines`` of the force
    scale; ``reservoir`` windows and their operating points (peak velocity [m/s], current [A]);
    ``state`` of the recursive filter; ``watch`` for changes; ``changed_ns``: begin of the last
    sudden change; ``temperatures`` with the force scales that came with them; ``searched_points``:
    operating points that the last global identification had; ``scales`` seen in motions that were
    no sine; ``global_patience``: good windows until the next search; ``other_damper``: whether the
    damper may be another one than that of the running set; ``motion`` of the newest good windows;
    ``kept_ns``: stamp of the newest window in the reservoir; ``reservoir_stamps``: that of each;
    ``unexplained_windows``: windows whose dependence on the current the law did not explain since
    the last search, and ``unexplained_patience``: after how many the next one follows, 0 for the
    usual number.
    """

    windows: int = 0
    accepted: int = 0
    accepted_since_global: int = 0
    history: AcceptanceHistory = dataclasses.field(default_factory=AcceptanceHistory)
    baselines: tuple[WindowFit, ...] = ()
    reservoir: tuple[Window, ...] = ()
    reservoir_points: tuple[OperatingPoint, ...] = ()
    state: FilterState | None = None
    watch: ChangeWatch | None = None
    changed_ns: int = 0
    temperatures: tuple[TemperatureHistory, ...] = ()
    searched_points: int = 0
    scales: tuple[SeenScale, ...] = ()
    global_patience: int = 1
    other_damper: bool = False
    motion: SteadyMotion = dataclasses.field(default_factory=SteadyMotion)
    kept_ns: int = 0
    reservoir_stamps: tuple[int, ...] = ()
    unexplained_windows: int = 0
    unexplained_patience: int = 0


def to_text(memory: TrackerMemory) -> str:
    """One line that :func:`from_text` reads back to the last digit."""
    return json.dumps(_plain(memory), separators=(",", ":"))


def from_text(text: str, model: Model) -> TrackerMemory:
    """The memory in a line of text, of a tracker of the model.

    Raises StateError where the text is not one, or holds what no tracker has learnt.
    """
    try:
        memory = _read(TrackerMemory, json.loads(text), "memory")
        # An older version may have known fewer parameters.
        baselines = tuple(
            dataclasses.replace(fit, parameters=model.completed(fit.parameters))
            for fit in memory.baselines
        )
        memory = check(dataclasses.replace(memory, baselines=baselines), model)
    except RecursionError as error:
        raise StateError("the memory of the tracker is nested too deeply") from error
    except StateError:
        raise
    except (ValueError, OverflowError) as error:
        raise StateError(f"the memory of the tracker cannot be used: {error}") from error
    return memory


def _plain(value: Any) -> Any:
    """The value as JSON can hold it."""
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
    """The value of a type in what JSON gave; ``where`` names it in errors (ValueError)."""
    value: Any
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):  # with None, there are no others here
        value = None if data is None else _read(arguments[0], data, where)
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
        raise ValueError(f"{where} is of a wrong type")
    return typing.cast("T", value)


def _array(data: Any, where: str) -> np.ndarray:
    if not isinstance(data, dict) or data.keys() != {"shape", _DATA}:
        raise ValueError(f"{where} is no array")
    shape = _read(tuple[int, ...], data["shape"], f"{where}.shape")
    values = np.frombuffer(base64.b64decode(_read(str, data[_DATA], where), validate=True), "<f8")
    if min(shape, default=0) < 0 or math.prod(shape) != values.size:
        raise ValueError(f"{where} does not have its shape")
    return values.astype(float).reshape(shape)


def _tuple(arguments: tuple[Any, ...], data: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(data, list):
        raise ValueError(f"{where} is no list")
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
    # What a later version added has a default.
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
    """The memory itself; StateError for what is of the right types, yet of no tracker."""
    for sound, what in _soundness(memory, len(model.parameters)):
        if not sound:
            raise StateError(f"the memory of the tracker cannot be used: {what} cannot be")
    return memory


def _soundness(memory: TrackerMemory, parameter_count: int) -> Iterator[tuple[bool, str]]:
    history, watch, state = memory.history, memory.watch, memory.state
    counts = (
        *(memory.windows, memory.accepted, memory.accepted_since_global),
        *(memory.searched_points, memory.motion.windows, memory.global_patience - 1),
        *(memory.unexplained_windows, memory.unexplained_patience),
    )
    yield min(*counts, history.refused_for_residual) >= 0, "a negative count"
    stamps = (memory.changed_ns, memory.kept_ns, *memory.reservoir_stamps)
    yield max(map(abs, stamps)) < _STAMP_LIMIT, "such a stamp"
    for residual in history.residuals:
        sound = len(residual) in (2, 4) and all(map(math.isfinite, residual))
        yield sound and min(residual[:3]) >= 0.0, "such a residual"
    yield 0.0 <= history.level < math.inf, "such a level of the force"
    for known in history.forces:
        of_force = (known.peak_velocity, known.size, known.largest)
        yield min(of_force) > 0.0 and all(map(math.isfinite, of_force)), "such a known force"
    windows, points_of_windows = len(memory.reservoir), len(memory.reservoir_points)
    yield windows == points_of_windows, "a window without its point"
    yield len(memory.reservoir_stamps) in (0, windows), "a window without its stamp"
    for fit in memory.baselines:
        yield fit.parameters.shape == (parameter_count,), "another number of parameters"
        yield _square(fit.scales, fit.covariance), "such a covariance"
        yield _square(fit.coefficients, fit.coefficient_covariance), "such a covariance"
        for vector, matrix in (
            (fit.scales, fit.discrepancy),
            (fit.coefficients, fit.coefficient_discrepancy),
        ):
            yield matrix is None or _square(vector, matrix), "such a discrepancy"
        for array in (fit.parameters, fit.scales, fit.coefficients):
            yield bool(np.all(np.isfinite(array))), "a value that is not finite"
    points = [fit.operating_point for fit in memory.baselines] + list(memory.reservoir_points)
    points += [known.operating_point for known in history.forces]
    for window in memory.reservoir:
        yield from _window_soundness(window)
    for warming in memory.temperatures:
        points.append(warming.operating_point)
        seen = warming.seen
        sound = seen.ndim == 2 and seen.shape[0] > 0 and seen.shape[1] == 3
        yield sound, "such a temperature history"
        yield can_be_seen(seen), "such a temperature or force scale"
    for scale in memory.scales:
        yield max(abs(scale.start_ns), abs(scale.end_ns)) < _STAMP_LIMIT, "such a stamp"
        numbers = [scale.value, scale.standard_error]
        yield all(map(math.isfinite, numbers)) and scale.standard_error > 0.0, "such a force scale"
    if state is not None:
        yield _square(state.scales, state.covariance), "such a covariance"
        yield bool(np.all(np.isfinite(state.scales))), "a value that is not finite"
        yield abs(state.stamp_ns) < _STAMP_LIMIT, "such a stamp"
        points.append(state.operating_point)
    if watch is not None:
        points.append(watch.operating_point)
        sizes = (watch.noise, watch.block_norm, watch.smallest_change, watch.threshold)
        yield min(sizes) > 0.0 and watch.block > 0, "such a watch for changes"
        sums = (watch.rising, watch.falling, watch.top, watch.rising_samples, watch.falling_samples)
        yield min(sums) >= 0 and all(map(math.isfinite, (*sizes, *sums))), "such a sum"
    yield all(map(math.isfinite, [x for point in points for x in point])), "such a point"


def _window_soundness(window: Window) -> Iterator[tuple[bool, str]]:
    motion = window.motion
    yield window.force.ndim == 1 and window.force.size > 0, "a window without samples"
    for array in (motion.displacement, motion.velocity, motion.acceleration, motion.peak_velocity):
        yield array.shape == window.force.shape, "a window of unequal lengths"
        yield bool(np.all(np.isfinite(array))), "a motion that is not finite"
    yield bool(np.all(motion.peak_velocity >= 0.0)), "a negative speed"
    yield math.isnan(window.period) or 0.0 < window.period < math.inf, "such a period"
    places, whole = window.places, window.whole
    if whole is not None:
        yield from _window_soundness(whole)
    if places is None:
        yield whole is None, "a part of a window without its places"
    else:
        last = math.inf if whole is None else whole.sample_count - 1
        yield places.shape == window.force.shape, "a window of unequal lengths"
        yield bool(np.all((places >= 0.0) & (places <= last))), "such a place"
        yield whole is not None or window.steady, "a part without the whole"


def _square(vector: np.ndarray, matrix: np.ndarray) -> bool:
    """Whether a matrix can be the covariance of a vector."""
    fits = vector.ndim == 1 and matrix.shape == vector.shape * 2
    return fits and not bool(np.any(np.diagonal(matrix) < 0.0))
