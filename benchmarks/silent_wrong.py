"""Corrupted records: what the package says of them, and wrong results without a word.

Every case is a sound record of an emulated damper with one corruption. Its result is wrong if the
identified set has a much larger error on the sound record than a set identified from it.

``python -m benchmarks.silent_wrong --list`` prints every case.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from benchmarks.figure import PROCESSES, Measured, in_processes
from benchmarks.sound_records import Channels, Plan, SoundRecord, sound_record
from benchmarks.told_findings import Answer, Given, answer, unchecked
from mr_damper_ros.api.causes import LARGEST_NRMSE
from mr_damper_ros.api.comparison import compare
from mr_damper_ros.api.measured_runs import MeasuredRun
from mr_damper_ros.io.columns import UNITS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.error_sums import pooled
from mr_damper_ros.signals.recording import Recording
from studies.recordings import window_of

WRONG_RATIO, WRONG_MORE = 1.5, 0.02
"""A result is wrong if its NRMSE on the sound record exceeds that of the sound fit by this factor
and by this difference."""

GENERAL = frozenset({"unexplained", "negative_slope", "reader", "unknown"})
"""Findings that name no cause."""

LEFT_OUT = {
    "a factor below 1000 of force or stroke, without the unit in the file": (
        "the record is that of a stronger or weaker damper"
    ),
    "a factor of 1000 of the force that stays between 5 N and 10 MN": "dampers of both sizes exist",
    "a wrong sampling rate, with neither times nor velocities": (
        "the record is that of a slower or faster motion"
    ),
    "a wrong current of a single record": "the force at one current says nothing of others",
    "a constant offset of the load cell in a single record": "a gas preload looks the same",
    "a force that is early by less than its lag behind the motion": (
        "the record is that of a damper with less hysteresis"
    ),
    "a force that is late in a sine": "the loop is that of a damper with more hysteresis",
    "a force that is late in random motion, where the law explains the record as well": (
        "the set that is found is a damper with these signals; computed for each case"
    ),
    "currents of records whose forces differ by less than a factor of 1.35": (
        "the difference is that of a damper heated to 70 degrees; computed for each case"
    ),
    "a slow drift of the load cell": "a damper that heats up looks the same",
    "a law that explains 70 % or more of the force": "its misfit is a note by definition",
}
"""Corruptions that the data cannot show, with the reason."""

# -- plans -----------------------------------------------------------------------------------------

_DAMPERS = {
    "sine": ("sigmoid", "gas_bouc_wen", "springs", "shim_valves"),
    "random": ("sigmoid", "modified_bouc_wen", "springs", "shim_valves"),
}
"""Dampers by the motion: the sigmoid law explains each of them sufficiently."""

_SINES = ("5 mm 1 Hz", "18 mm 0.5 Hz", "2 mm 5 Hz")
_SLOW_SINES = _SINES[:2]
_RANDOM = ("random 0.2-3 Hz", "random 0.5-8 Hz")
_MOTIONS = (*_SINES, *_RANDOM)
_SLOW = (*_SLOW_SINES, _RANDOM[0])
_DURATIONS = {"5 mm 1 Hz": 5.0, "18 mm 0.5 Hz": 8.0, "2 mm 5 Hz": 2.0}


def _plan(damper: str, motion: str, number: int, seed: int, **values: Any) -> Plan:
    """A plan whose current, rate and noise depend on its number."""
    usual = {
        "current": (0.3, 0.8, 1.2)[number % 3],
        "rate": (1000.0, 500.0, 1000.0, 300.0)[number % 4],
        "duration": _DURATIONS.get(motion, 8.0),
        "force_noise": (0.005, 0.015)[number % 2],
        "jitter": (0.0, 0.1)[number % 2],
        "seed": 1000 * seed + number,
    }
    return Plan(damper, motion, **(usual | values))


def _plans(motions: Sequence[str], seed: int) -> list[Plan]:
    """Plans of all dampers in these motions, each at one current."""
    return [
        _plan(damper, motion, 5 * place + _MOTIONS.index(motion), seed)
        for motion in motions
        for place, damper in enumerate(_DAMPERS["random" if motion in _RANDOM else "sine"])
    ]


def _changing(motions: Sequence[str], seed: int) -> list[Plan]:
    """Plans of all dampers with a changing current."""
    return [
        replace(each, current=None, rate=500.0, duration=10.0) for each in _plans(motions, seed)
    ]


# -- corruptions -----------------------------------------------------------------------------------


class Spoilt(NamedTuple):
    """What the user gives, and the plans of the sound records with which it is compared.

    ``law`` identifies the sound records.
    """

    given: Given
    sound: tuple[Plan, ...]
    law: str = DEFAULT_MODEL


Maker = Callable[[SoundRecord, Any, np.random.Generator], Spoilt]


def _one(sound: SoundRecord, channels: Channels, **given: Any) -> Spoilt:
    """One record of the corrupted channels."""
    return Spoilt(Given([channels.recording(sound.period)], **given), (sound.plan,))


def _with(channels: Channels, channel: str, values: Array) -> Channels:
    changed: dict[str, Any] = {channel: values}
    return replace(channels, **changed)


def _hum(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: channel, amplitude [m] or part of the largest force, and frequency [Hz]."""
    channel, amplitude, frequency = size
    made = sound.sampled()
    if channel == "force":
        amplitude *= sound.peak
    wave = np.sin(2.0 * np.pi * (frequency * made.time + rng.random()))
    return _one(sound, _with(made, channel, getattr(made, channel) + amplitude * wave))


class _Layout(NamedTuple):
    """How a text file is written: names and units of its columns, and where the units stand."""

    names: dict[str, str]
    units: dict[str, str]
    in_own_row: bool = False
    separator: str = ","

    def text(self, columns: dict[str, Array]) -> str:
        """The file; the columns (n,) are in SI units."""
        kept = {quantity: columns[quantity] for quantity in self.names}
        heads = [self.names[quantity] for quantity in kept]
        units = [self.units[quantity] for quantity in kept]
        if self.in_own_row:
            rows = [heads, units]
        else:
            rows = [[f"{head} [{unit}]" for head, unit in zip(heads, units, strict=True)]]
        scaled = [
            values / UNITS[quantity][self.units[quantity]] for quantity, values in kept.items()
        ]
        rows += [[f"{value:.9g}" for value in row] for row in np.transpose(scaled).tolist()]
        return "\n".join(self.separator.join(row) for row in rows) + "\n"


_NAMES = {"time": "Time", "displacement": "Displacement", "force": "Force"}
_UNITS = {"time": "s", "displacement": "mm", "velocity": "mm/s", "force": "N", "current": "A"}


def _columns_of(channels: Channels) -> dict[str, Array]:
    return {name: getattr(channels, name) for name in ("time", "displacement", "force", "current")}


def _unit_in_file(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: quantity, its unit in the file, and the unit that is stated."""
    quantity, true, stated = size
    made = sound.sampled()
    layout = _Layout(_NAMES, _UNITS | {quantity: true}, bool(rng.integers(2)))
    told = _UNITS | {quantity: stated}
    factor = UNITS[quantity][stated] / UNITS[quantity][true]
    options = {
        "columns": ",".join(f"{name}:{told[name]}" for name in _NAMES),
        "current": sound.plan.current,
    }
    spoilt = _with(made, quantity, factor * getattr(made, quantity))
    return _one(sound, spoilt, text=layout.text(_columns_of(made)), options=options)


def _unit(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: channel, factor, and size of the damper."""
    channel, factor, large = size
    sound = sound_record(replace(sound.plan, size=large))
    made = sound.sampled()
    return _one(sound, _with(made, channel, factor * getattr(made, channel)))


def _clipped(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: channel, share of the samples at the limit, and sides."""
    channel, share, sides = size
    made = sound.sampled()
    values = getattr(made, channel)
    part = share / sides
    high = float(np.quantile(values, 1.0 - part))
    low = float(np.quantile(values, part)) if sides == 2 else -math.inf
    return _one(sound, _with(made, channel, np.clip(values, low, high)))


def _spikes(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: channel, rate [1/s], height relative to the largest value, and samples."""
    channel, rate, height, length = size
    made = sound.sampled()
    values = getattr(made, channel).copy()
    count = max(round(rate * sound.plan.duration), 2)
    largest = float(np.max(np.abs(values)))
    for place in rng.choice(values.size - length, count, replace=False).tolist():
        way = rng.choice((-1.0, 1.0)) * rng.uniform(0.6, 1.4)
        values[place : place + length] += way * height * largest
    return _one(sound, _with(made, channel, values))


def _dropped(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: channel, rate of readings of 0 [1/s], and samples of a reading."""
    channel, rate, length = size
    made = sound.sampled()
    values = getattr(made, channel).copy()
    count = max(round(rate * sound.plan.duration), 2)
    for place in rng.choice(values.size - length, count, replace=False).tolist():
        values[place : place + length] = 0.0
    return _one(sound, _with(made, channel, values))


def _reversed(sound: SoundRecord, channel: str, rng: np.random.Generator) -> Spoilt:
    made = sound.sampled()
    return _one(sound, _with(made, channel, -getattr(made, channel)))


def _skewed(sound: SoundRecord, seconds: float, rng: np.random.Generator) -> Spoilt:
    """The force late by some time [s]."""
    return _one(sound, sound.sampled(force_late=seconds))


def _backward(sound: SoundRecord, seconds: float, rng: np.random.Generator) -> Spoilt:
    """The force so early that it leads the direction of the motion by some time [s]."""
    return _one(sound, sound.sampled(force_late=-seconds - sound.lag))


def _current_skewed(sound: SoundRecord, seconds: float, rng: np.random.Generator) -> Spoilt:
    """The current late by some time [s], or early."""
    return _one(sound, sound.sampled(current_late=seconds))


def _rate(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: what shows the true rate, and the factor of the stated period.

    The true rate is shown by a column of times that is not read, by a column of velocities, or by
    the unit of the times.
    """
    shown, factor = size
    made = sound.sampled()
    columns = _columns_of(made)
    columns["velocity"] = sound.motion.at(made.time).velocity
    names, units, stated = dict(_NAMES), dict(_UNITS), dict(_UNITS)
    options: dict[str, Any] = {"current": sound.plan.current}
    if shown == "unit":
        true = next(unit for unit, scale in UNITS["time"].items() if scale * factor == 1.0)
        units["time"] = true
    else:
        options["period"] = factor * sound.period
    if shown == "velocity":
        names = {name: name.title() for name in ("displacement", "velocity", "force")}
    described = [f"{name}:{stated[name]}" for name in names]
    if shown == "time":
        described[0] = "-"
    options["columns"] = ",".join(described)
    text = _Layout(names, units, bool(rng.integers(2))).text(columns)
    raw = made.recording(factor * sound.period)
    return Spoilt(Given([raw], text, options), (sound.plan,))


def _held(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: channel, and the rate at which it is renewed [Hz]."""
    channel, rate = size
    made = sound.sampled()
    values = getattr(made, channel)
    length = round(sound.plan.rate / rate)
    renewed = np.maximum(np.arange(values.size) // length * length, 0)
    return _one(sound, _with(made, channel, values[renewed]))


def _uneven(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: kind and amount, in a file with its true times."""
    kind, amount = size
    grid, period = sound.grid, sound.period
    if kind == "jitter":  # in periods
        time = np.sort(grid + amount * period * rng.uniform(-1.0, 1.0, grid.size))
    elif kind == "change":  # factor of the period in the second half
        steps = np.where(np.arange(grid.size) < grid.size // 2, 1.0, amount) * period
        time = np.concatenate([[0.0], np.cumsum(steps[1:])])
        time = time[time < sound.plan.duration]
    else:  # lost times [s], each second
        time = grid[np.mod(grid, 0.83) >= amount]
    made = sound.sampled(time)
    text = _Layout(_NAMES, _UNITS).text(_columns_of(made))
    columns = ",".join(f"{name}:{_UNITS[name]}" for name in _NAMES)
    options = {"columns": columns, "current": sound.plan.current}
    raw = made.recording(float(time[-1] - time[0]) / (time.size - 1))
    return Spoilt(Given([raw], text, options), (sound.plan,))


def _lost(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: samples lost at a time, and losses per second; the record holds no times."""
    length, rate = size
    kept = np.ones(sound.grid.size, dtype=bool)
    count = max(round(rate * sound.plan.duration), 2)
    for place in rng.choice(kept.size - length, count, replace=False).tolist():
        kept[place : place + length] = False
    return _one(sound, sound.sampled(sound.grid[kept]))


def _fragment(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: duration [s] of a fragment and of the gap that follows, and the container."""
    short, gap, container = size
    plan = replace(sound.plan, begins=3.0)  # in motion
    early = replace(plan, begins=plan.begins - gap - short, duration=short)
    first = replace(sound_record(early).recording(), name="fragment")
    raw = [first, sound_record(plan).recording()]
    return Spoilt(Given(raw, container=container), (plan,))


def _swapped(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: whether a file holds the names, and the factor of the displacement [m/N]."""
    named, factor = size
    made = sound.sampled()
    exchanged = replace(made, displacement=factor * made.force, force=made.displacement / factor)
    if not named:
        return _one(sound, exchanged)
    text = _Layout(_NAMES, _UNITS).text(_columns_of(made))
    options = {"columns": "time:s,force:N,displacement:mm", "current": sound.plan.current}
    return _one(sound, exchanged, text=text, options=options)


def _several(sound: SoundRecord, currents: Any, rng: np.random.Generator) -> Spoilt:
    """One record of several currents, said to be of one."""
    which = np.arange(sound.grid.size) * len(currents) // sound.grid.size
    true = np.array(currents)[which]
    return _one(sound, sound.sampled(at_currents=true))


def _mixed_up(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """Three records; ``size``: the true currents and the stated ones."""
    true, stated = size
    plans = [replace(sound.plan, current=each, seed=sound.plan.seed + 1) for each in true]
    raw = []
    for place, (plan, current) in enumerate(zip(plans, stated, strict=True)):
        made = sound_record(plan).recording()
        told = np.full(made.sample_count, current)
        raw.append(replace(made, name=f"run {place + 1}", current=told))
    return Spoilt(Given(raw), tuple(plans))


def _stuck(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: channel, and part of the record."""
    channel, part = size
    made = sound.sampled()
    values = getattr(made, channel).copy()
    first = round(values.size * (1.0 - part) * rng.uniform(0.2, 0.8))
    values[first : first + round(part * values.size)] = values[first]
    return _one(sound, _with(made, channel, values))


def _offset(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: where the zero of the load cell changes, by a part of the largest force."""
    where, part = size
    made = sound.sampled()
    if where == "within":
        step = np.where(np.arange(made.time.size) < 0.6 * made.time.size, 0.0, part * sound.peak)
        return _one(sound, _with(made, "force", made.force + step))
    plans = [replace(sound.plan, current=each) for each in (0.3, 0.8, 1.2)]
    raw = []
    for place, plan in enumerate(plans):
        each = sound_record(plan).recording()
        zero = (0.0, 1.0, -1.0)[place] * part * sound.peak
        raw.append(replace(each, name=f"run {place + 1}", force=each.force + zero))
    return Spoilt(Given(raw), tuple(plans))


def _averaged(values: Array, count: int) -> Array:
    padded = np.concatenate([np.full(count - 1, values[0]), values])
    sums = np.cumsum(np.concatenate([[0.0], padded]))
    return np.asarray((sums[count:] - sums[:-count]) / count)


def _smoothed(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: channels, and duration [s] of their moving average."""
    channels, seconds = size
    made, count = sound.sampled(), round(seconds * sound.plan.rate)
    for channel in channels:
        made = _with(made, channel, _averaged(getattr(made, channel), count))
    return _one(sound, made)


def _other_law(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: the damper, the law that the user names, and a law that fits."""
    damper, named, fits = size
    sound = sound_record(replace(sound.plan, damper=damper))
    return _one(sound, sound.sampled(), model=named)._replace(law=fits)


def _short(sound: SoundRecord, cycles: float, rng: np.random.Generator) -> Spoilt:
    """The record cut to a part of a cycle."""
    made = sound.sampled()
    frequency = float(sound.plan.motion.split()[2])
    end = round(cycles / frequency * sound.plan.rate)
    first = round(0.13 / frequency * sound.plan.rate)
    parts = {name: values[first : first + end] for name, values in _columns_of(made).items()}
    return _one(sound, Channels(**parts))


def _noisy(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: channel, and standard deviation [m] or relative to the largest force."""
    channel, amount = size
    made = sound.sampled()
    if channel == "force":
        amount *= sound.peak
    values = getattr(made, channel)
    return _one(sound, _with(made, channel, values + amount * rng.standard_normal(values.size)))


def _coarse(sound: SoundRecord, size: Any, rng: np.random.Generator) -> Spoilt:
    """``size``: channel, and its step [m] or relative to the largest force."""
    channel, step = size
    made = sound.sampled()
    if channel == "force":
        step *= sound.peak
    values = getattr(made, channel)
    return _one(sound, _with(made, channel, step * np.round(values / step)))


# -- what data cannot show -------------------------------------------------------------------------

_AS_WELL = 1.2
"""The NRMSE of a law on a corrupted record, relative to that on the sound one, with which another
damper explains the record as well."""

_HEATING = 1.35
"""Ratio of the forces at 28 and 70 degrees Celsius."""

Hidden = Callable[[Spoilt, ParameterSet | None, float], bool]
"""Whether the data of a case show no corruption: from the unchecked result, and the NRMSE of the
sound fit."""


def _another_damper(spoilt: Spoilt, found: ParameterSet | None, sound: float) -> bool:
    """Whether the damper of the set that is found gives the signals as well."""
    return _error(found, _runs_of(spoilt.given.raw)) <= _AS_WELL * sound


def _sufficient(spoilt: Spoilt, found: ParameterSet | None, sound: float) -> bool:
    """Whether the law explains the force sufficiently."""
    return _error(found, _runs_of(spoilt.given.raw)) <= LARGEST_NRMSE


def _heated(spoilt: Spoilt, found: ParameterSet | None, sound: float) -> bool:
    """Whether the forces differ from those at the stated currents by less than heating explains."""

    def size(recording: Recording) -> float:
        return float(np.std(recording.force))

    true = {plan.current: size(sound_record(plan).recording()) for plan in spoilt.sound}
    ratios = (size(each) / true[float(each.current[0])] for each in spoilt.given.raw)
    return all(1.0 / _HEATING <= ratio <= _HEATING for ratio in ratios)


# -- cases -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """A kind of corruption.

    ``right``: names of the findings that name the cause; ``sizes``: sizes of the corruption, one a
    case; ``motions``: motions of the records; ``changing``: whether the current changes;
    ``hidden``: which cases are left out.
    """

    name: str
    make: Maker
    right: frozenset[str]
    sizes: tuple[Any, ...]
    motions: tuple[str, ...] = _MOTIONS
    changing: bool = False
    hidden: Hidden | None = None


def _kind(name: str, make: Maker, right: str, sizes: Sequence[Any], *more: Any) -> Kind:
    return Kind(name, make, frozenset(right.split()), tuple(sizes), *more)


_HUM_FREQUENCIES = (50.0, 51.0, 60.0, 100.0, 37.0, 83.0)
_SPIKE_SIZES = ((0.3, 3.0, 1), (2.0, 0.5, 1), (2.0, 3.0, 1), (5.0, 10.0, 1), (1.0, 1.5, 4))

KINDS: tuple[Kind, ...] = (
    _kind(
        "hum of the displacement",
        _hum,
        "hum",
        [("displacement", 1e-6 * a, f) for a, f in product((30, 50, 75), _HUM_FREQUENCIES)]
        + [("displacement", 1e-6 * a, f) for a, f in ((30, 51.5), (150, 50.0), (15, 50.0))],
        (*_SLOW_SINES, *_RANDOM),
    ),
    _kind(
        "hum of the force",
        _hum,
        "hum",
        [("force", 0.02, 50.0), ("force", 0.05, 60.0), ("force", 0.1, 50.0)],
    ),
    _kind(
        "unit, named in the file",
        _unit_in_file,
        "unit",
        [
            *(("force", "kN", "N"), ("force", "N", "kN"), ("force", "kgf", "N")),
            *(("force", "N", "kgf"), ("force", "lbf", "N"), ("force", "N", "lbf")),
            *(("force", "kgf", "lbf"), ("displacement", "in", "mm"), ("displacement", "mm", "in")),
            *(("displacement", "m", "mm"), ("displacement", "mm", "m")),
            *(("displacement", "cm", "mm"), ("displacement", "mm", "cm")),
        ],
    ),
    _kind(
        "factor of 1000",
        _unit,
        "unit",
        [("force", 1e-3, 1.0)] * 3
        + [("force", 1e3, 20.0)] * 2
        + [("displacement", 1e3, 1.0)] * 2
        + [("displacement", 1e-3, 1.0)] * 3,
    ),
    _kind(
        "clipped force",
        _clipped,
        "clipped",
        [
            ("force", share, sides)
            for sides in (1, 2)
            for share in (0.03, 0.06, 0.1, 0.15, 0.2, 0.27, 0.33, 0.42, 0.5, 0.6)
        ],
    ),
    _kind(
        "clipped displacement",
        _clipped,
        "clipped",
        [("displacement", share, sides) for sides in (1, 2) for share in (0.05, 0.15, 0.3)],
    ),
    _kind("spikes of the force", _spikes, "spikes", [("force", *s) for s in _SPIKE_SIZES]),
    _kind(
        "spikes of the displacement",
        _spikes,
        "spikes",
        [("displacement", *s) for s in (*_SPIKE_SIZES, (0.5, 0.05, 1), (2.0, 0.1, 1))],
    ),
    _kind("force reversed", _reversed, "inverted", ["force"] * 4),
    _kind("displacement reversed", _reversed, "inverted", ["displacement"] * 4),
    _kind(
        "hysteresis backward",
        _backward,
        "skew backward",
        [1e-3 * ms for ms in (5, 10, 20, 30, 45, 60)],
        _SLOW,
    ),
    _kind(
        "hysteresis backward in a fast motion",
        _backward,
        "skew backward",
        [2e-3, 5e-3, 10e-3, 20e-3],
        ("2 mm 5 Hz", _RANDOM[1]),
    ),
    _kind(
        "force late in random motion",
        _skewed,
        "skew",
        [1e-3 * ms for ms in (2, 5, 10, 20, 30)],
        _RANDOM,
        False,
        _another_damper,
    ),
    _kind(
        "current late",
        _current_skewed,
        "current_skew",
        [0.02, 0.05, 0.1, 0.2],
        (_SINES[0], *_RANDOM),
        True,
    ),
    _kind(
        "current early",
        _current_skewed,
        "current_skew",
        [-0.02, -0.05, -0.1, -0.2],
        (_SINES[0], *_RANDOM),
        True,
    ),
    _kind(
        "rate",
        _rate,
        "rate unit",
        [
            *(("time", 2.0), ("time", 0.5), ("time", 1.2), ("time", 10.0), ("time", 0.1)),
            *(("velocity", 2.0), ("velocity", 0.5), ("velocity", 1.3), ("velocity", 5.0)),
            *(("unit", 1e3), ("unit", 1.0 / 60.0), ("unit", 1e3)),
        ],
    ),
    _kind(
        "held displacement",
        _held,
        "held",
        [("displacement", hertz) for hertz in (25.0, 50.0, 50.0, 100.0, 50.0, 50.0)],
    ),
    _kind("held force", _held, "held", [("force", 25.0), ("force", 50.0), ("force", 50.0)]),
    _kind(
        "glitches of the current",
        _dropped,
        "spikes",
        [("current", 0.5, 1), ("current", 2.0, 1), ("current", 1.0, 10), ("current", 5.0, 3)],
    ),
    _kind(
        "glitches of the displacement",
        _dropped,
        "spikes",
        [("displacement", 0.3, 1), ("displacement", 2.0, 1), ("displacement", 1.0, 5)],
    ),
    _kind(
        "glitches of the force",
        _dropped,
        "spikes",
        [("force", 0.5, 1), ("force", 2.0, 2), ("force", 5.0, 3)],
    ),
    _kind(
        "uneven times in a file",
        _uneven,
        "uneven_time missing",
        [
            *(("jitter", 0.1), ("jitter", 0.4), ("jitter", 0.8), ("change", 3.0)),
            *(("change", 1.5), ("change", 1.001), ("change", 1.0003), ("change", 2.0)),
            *(("lost", 0.05), ("lost", 0.2), ("lost", 0.4), ("lost", 0.02)),
        ],
    ),
    _kind(
        "lost samples without times",
        _lost,
        "uneven_time missing",
        [(10, 0.3), (50, 0.5), (20, 1.0), (100, 0.5), (2, 1.0), (50, 1.0)],
    ),
    _kind(
        "fragment",
        _fragment,
        "fragment short",
        [
            *((0.1, 0.9, "bag"), (0.05, 0.3, "bag"), (0.2, 0.5, "bag"), (0.02, 1.0, "bag")),
            *((0.1, 0.9, "list"), (0.3, 0.5, "list"), (0.03, 0.5, "list"), (0.1, 0.9, "bag")),
        ],
        (*_SLOW_SINES, *_RANDOM),
    ),
    _kind(
        "swapped channels",
        _swapped,
        "swapped",
        [(False, 1e-5), (False, 1e-5), (False, 3e-6), (False, 1e-4), (False, 1e-5)],
    ),
    _kind("swapped columns with names", _swapped, "swapped unit", [(True, 1e-3)] * 3),
    _kind(
        "several currents in a record",
        _several,
        "several_currents contradicting gain_changes",
        [(0.2, 0.7, 1.4), (0.8, 1.2), (0.0, 1.0), (1.2, 1.2, 1.2, 0.0), (0.4, 0.6), (1.4, 0.3)],
    ),
    _kind(
        "currents of records mixed up",
        _mixed_up,
        "contradicting several_currents",
        [
            ((0.1, 0.6, 1.3), (1.3, 0.6, 0.1)),
            ((0.1, 0.6, 1.3), (0.6, 0.1, 1.3)),
            ((0.1, 0.6, 1.3), (0.1, 0.1, 0.1)),
            ((0.3, 0.4, 1.2), (0.4, 0.3, 1.2)),
        ],
        _MOTIONS,
        False,
        _heated,
    ),
    _kind(
        "stuck",
        _stuck,
        "stuck",
        [(channel, part) for channel in ("force", "displacement") for part in (0.05, 0.2, 0.4)]
        + [("force", 0.3), ("displacement", 0.3)],
    ),
    _kind(
        "zero of the load cell changes",
        _offset,
        "offset contradicting zero_changes zero_differs",
        [("within", 0.05), ("within", 0.3), ("within", 0.6), ("between", 0.2), ("between", 0.4)],
    ),
    _kind(
        "moving average of a channel",
        _smoothed,
        "smoothed skew backward",
        [(("force",), seconds) for seconds in (0.02, 0.05, 0.1, 0.3)]
        + [(("displacement",), seconds) for seconds in (0.05, 0.1)],
    ),
    _kind(
        "moving average of both channels",
        _smoothed,
        "smoothed",
        [
            (("displacement", "force"), 0.05),
            (("displacement", "force"), 0.1),
            (("displacement", "force"), 0.3),
        ],
    ),
    _kind(
        "law that does not fit, sine",
        _other_law,
        "other_law",
        [
            ("gas_bouc_wen", "bingham", "sigmoid"),
            ("fluid_inertia", "bingham", "hyperbolic_tangent"),
            ("air_pocket", "bingham", "series_springs"),
        ],
        _SINES[:1],
        False,
        _sufficient,
    ),
    _kind(
        "law that does not fit, random",
        _other_law,
        "other_law",
        [
            ("gas_bouc_wen", "sigmoid", "bouc_wen"),
            ("modified_bouc_wen", "hyperbolic_tangent", "modified_bouc_wen"),
            ("fluid_inertia", "nonlinear_biviscous", "bouc_wen"),
            ("springs", "bingham", "series_springs"),
        ],
        _RANDOM[1:],
        False,
        _sufficient,
    ),
    _kind("less than a cycle", _short, "short fragment", [0.2, 0.3, 0.4, 0.5], _SLOW_SINES),
    _kind(
        "noise",
        _noisy,
        "noise",
        [("displacement", 1e-6 * um) for um in (10, 30, 100, 300)]
        + [("force", part) for part in (0.05, 0.1, 0.15)],
    ),
    _kind(
        "coarse",
        _coarse,
        "coarse",
        [("displacement", 1e-6 * um) for um in (10, 50, 200, 500)]
        + [("force", part) for part in (0.02, 0.1, 0.4)],
    ),
)
"""All kinds of corruption."""

_FEW = 12
"""Kinds with fewer sizes have each size in two records."""


class Case(NamedTuple):
    """A case: its kind, its size, the plan of the sound record, and the seed of the corruption."""

    kind: int
    size: Any
    plan: Plan
    seed: int


def cases(seed: int = 0) -> list[Case]:
    """All cases; the plans rotate over the sizes of a kind."""
    found = []
    for place, kind in enumerate(KINDS):
        plans = (_changing if kind.changing else _plans)(kind.motions, seed)
        rng = np.random.default_rng((seed, place))
        order = rng.permutation(len(plans))
        twice = 2 if len(kind.sizes) < _FEW else 1
        for number, size in enumerate(kind.sizes * twice):
            again, which = divmod(number, len(plans))
            plan = plans[order[which]]
            found.append(Case(place, size, replace(plan, seed=plan.seed + 500 * again), number))
    return found


# -- judgement -------------------------------------------------------------------------------------


class Judged(NamedTuple):
    """A judged case: NRMSE of the sound fit and of the unchecked result on the sound record.

    ``given``: NRMSE of the result that the user gets, NaN if the case is refused.
    """

    kind: str
    size: str
    plan: str
    sound: float
    unchecked: float
    given: float
    findings: str
    verdict: str


_SILENT, _UNNAMED = "SILENT", "UNNAMED"
_RIGHT, _WRONGLY = "right", "WRONG NAME"
_REPAIRED = "repaired"
_FINE, _NEEDLESS = "fine", "NEEDLESS"
_HIDDEN = "hidden"


@lru_cache(maxsize=64)
def _sound_fit(plans: tuple[Plan, ...], law: str) -> tuple[tuple[MeasuredRun, ...], float]:
    """The sound records, and the NRMSE of a set identified from them."""
    records = [sound_record(plan).recording() for plan in plans]
    runs = _runs_of(records)
    return runs, _error(unchecked(records, law), runs)


def _runs_of(records: Sequence[Recording]) -> tuple[MeasuredRun, ...]:
    """The recordings as runs that no check has seen."""
    return tuple(MeasuredRun("run", (record,), (window_of(record),)) for record in records)


def _error(found: ParameterSet | None, runs: Sequence[MeasuredRun]) -> float:
    """NRMSE of a set on the sound records; infinite without a set."""
    if found is None:
        return math.inf
    return pooled(compare(found, run).error for run in runs).nrmse


def judge(case: Case) -> Judged:
    """Corrupt, identify and compare."""
    kind = KINDS[case.kind]
    rng = np.random.default_rng((case.plan.seed, case.kind, case.seed))
    spoilt = kind.make(sound_record(case.plan), case.size, rng)
    given, plans, law = spoilt
    runs, sound = _sound_fit(plans, law)
    told = answer(given)
    found = None if told.result is None else told.result.parameter_set
    received = _error(found, runs)
    same = told.result is not None and not told.findings
    raw = found if same and kind.hidden is None else unchecked(given.raw, given.model)
    plain = _error(raw, runs)
    verdict = _verdict(kind, told, sound, plain, received)
    harmless = verdict in (_FINE, _NEEDLESS)
    if kind.hidden is not None and not harmless and kind.hidden(spoilt, raw, sound):
        verdict = _HIDDEN
    return Judged(
        kind.name,
        _shown(case.size),
        case.plan.name,
        sound,
        plain,
        math.nan if told.result is None else received,
        "; ".join(f"{each.name} ({each.severity})" for each in told.findings),
        verdict,
    )


def _shown(size: Any) -> str:
    if isinstance(size, tuple):
        return " ".join(map(_shown, size))
    return f"{size:g}" if isinstance(size, float) else str(size)


def _is_wrong(error: float, sound: float) -> bool:
    return error > WRONG_RATIO * sound and error > sound + WRONG_MORE


def _verdict(kind: Kind, told: Answer, sound: float, plain: float, received: float) -> str:
    """The verdict of a case from its errors; a repair may help or harm."""
    harmed = told.result is not None and _is_wrong(received, sound)
    if not (harmed or _is_wrong(plain, sound)):
        return _NEEDLESS if told.named else _FINE
    if told.result is not None and not harmed:
        return _REPAIRED
    if told.named & kind.right and not told.clean_exit:
        return _RIGHT
    if told.clean_exit:
        return _SILENT
    return _WRONGLY if told.named - GENERAL else _UNNAMED


def _judged(chosen: Sequence[Case]) -> list[Judged]:
    return [judge(case) for case in chosen]


def _groups(chosen: Sequence[Case]) -> list[list[Case]]:
    """The cases in groups that share their sound records, in about equal parts."""
    ordered = sorted(chosen, key=lambda case: (case.plan.damper, case.plan.name, case.kind))
    size = math.ceil(len(ordered) / (4 * PROCESSES))
    return [ordered[first : first + size] for first in range(0, len(ordered), size)]


def judge_all(every: int = 1, seed: int = 0, kinds: Sequence[str] = ("",)) -> list[Judged]:
    """All judged cases, or one in ``every``, sorted by their kind.

    Only those of kinds whose names contain one of the given words.
    """
    chosen = [case for case in cases(seed) if any(word in KINDS[case.kind].name for word in kinds)]
    groups = _groups(chosen[seed % every :: every])
    order = [kind.name for kind in KINDS]
    found = [one for group in in_processes(_judged, groups) for one in group]
    return sorted(found, key=lambda one: order.index(one.kind))


def figures(every: int = 1, seed: int = 0) -> Measured:
    """The figures of the corrupted records."""
    found = [one for one in judge_all(every, seed) if one.verdict != _HIDDEN]
    wrong = [one for one in found if one.verdict not in (_FINE, _NEEDLESS)]
    others = len(found) - len(wrong)

    def count(*verdicts: str) -> int:
        return sum(one.verdict in verdicts for one in found)

    def percent(part: int, whole: int) -> float:
        return 100.0 * part / max(whole, 1)

    note = f"Of {len(found)} cases, {len(wrong)} wrong."
    unnamed = [one for one in wrong if one.verdict in (_UNNAMED, _WRONGLY)]
    warned = sum(not math.isnan(one.given) for one in unnamed)
    return {
        "silent_wrong": ([float(count(_SILENT)), float(warned)], note),
        "wrong_named_percent": (percent(count(_RIGHT, _REPAIRED), len(wrong)), note),
        "wrong_misnamed_percent": (percent(count(_WRONGLY), len(wrong)), note),
        "harmless_refused_percent": (percent(count(_NEEDLESS), others), note),
    }


def _listed(found: Sequence[Judged]) -> Iterator[str]:
    """The cases and the counts of their verdicts, kind by kind."""
    for name in dict.fromkeys(one.kind for one in found):
        of_kind = [one for one in found if one.kind == name]
        verdicts = [one.verdict for one in of_kind]
        counts = ", ".join(f"{verdicts.count(v)} {v}" for v in dict.fromkeys(verdicts))
        yield f"\n{name}: {counts}"
        for one in of_kind:
            errors = " ".join(f"{100 * e:6.1f}" for e in (one.sound, one.unchecked, one.given))
            yield (f"  {one.verdict:10s} {errors} %  {one.size:28s} {one.plan:48s} {one.findings}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the figures, and every case with ``--list``."""
    parser = argparse.ArgumentParser(prog="silent_wrong", description=__doc__)
    parser.add_argument("--list", action="store_true", help="print every case")
    parser.add_argument("--every", type=int, default=1, help="of so many cases, one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", default=[""], help="only kinds with these words")
    options = parser.parse_args(arguments)
    if options.list:
        print("left out, because the data cannot show them:")
        print(*(f"  {what}: {why}" for what, why in LEFT_OUT.items()), sep="\n", end="\n\n")
        print("verdict, NRMSE of the sound fit, unchecked, given; size; record; findings")
        print(*_listed(judge_all(options.every, options.seed, options.kinds)), sep="\n")
    else:
        for key, value in figures(options.every, options.seed).items():
            print(key, value)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
