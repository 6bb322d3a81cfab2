"""The run that was wanted, cut out of the recording of whoever made it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mr_damper_ros.estimation.planned_run import PlannedRun
from mr_damper_ros.kinematics.periodic_motion import MotionKind
from mr_damper_ros.kinematics.repeated_match import RepeatedMatch
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.rig.run_driver import STEADY, DriveSettings, sine_of_cycle
from mr_damper_ros.signals.recording import Recording

_PLACES = 8
"""In every cycle, the run may begin at so many places."""

_MOST_PLACES = 2000
"""No more places are looked at in a long recording."""

_SETTINGS = DriveSettings()
"""A run is as wanted where it would be on a machine that is driven."""


class RunNotFoundError(ValueError):
    """A recording does not hold the run; the message says why."""


def cut_run(run: PlannedRun, recording: Recording) -> Recording:
    """The part of a recording in which a run was made, without what was before and after.

    Where the current is stepped, its first step tells where the run begins; else it is the part in
    which the motion is steadiest, or most as wanted. Raises RunNotFoundError where there is none.
    """
    if len(run.currents) == 1 and run.kind is not MotionKind.SINE:
        return _most_as_wanted(run, recording)
    return _from_step(run, recording) if len(run.currents) > 1 else _steadiest(run, recording)


def run_as_made(recording: Recording) -> PlannedRun:
    """The run that a recording is, which nobody has planned: a steady sine at one current.

    Raises RunNotFoundError where it is none.
    """
    sine = Window.from_samples(
        recording.displacement, recording.force, recording.current, recording.period
    ).motion.sine
    current = float(np.median(recording.current))
    if sine is None or np.ptp(recording.current) > 2.0 * _SETTINGS.current_tolerance:
        raise RunNotFoundError(f"{recording.name} is no steady sine at one current")
    cycles = math.floor(recording.duration * sine.frequency)
    return PlannedRun(sine.amplitude, sine.frequency, (current,), cycles / sine.frequency)


def _steadiest(run: PlannedRun, recording: Recording) -> Recording:
    period = recording.period
    count, cycle = round(run.duration / period), round(1.0 / (run.frequency * period))
    best, least = None, STEADY
    for begin in range(0, recording.sample_count - count + 1, max(cycle // _PLACES, 1)):
        first, last = (
            sine_of_cycle(recording.displacement[place : place + cycle])
            for place in (begin, begin + count - cycle)
        )
        current = float(np.median(recording.current[begin : begin + count]))
        off = max(abs(one.size - run.amplitude) for one in (first, last)) / run.amplitude
        change = abs(first.size - last.size) / run.amplitude
        as_wanted = (
            off <= _SETTINGS.amplitude_tolerance
            and abs(current - run.currents[0]) <= _SETTINGS.current_tolerance
        )
        if as_wanted and change < least:
            best, least = begin, change
    if best is None:
        raise RunNotFoundError(
            f"{recording.name} does not hold the run: it needs {run.duration:.3g} s of "
            f"{run.motion.sentence} at {run.currents[0]:g} A; its motion reaches "
            f"{500.0 * np.ptp(recording.displacement):.3g} mm within {recording.duration:.3g} s at "
            f"{np.median(recording.current):.3g} A"
        )
    return _part(recording, best, count)


def _most_as_wanted(run: PlannedRun, recording: Recording) -> Recording:
    match = RepeatedMatch(run.motion, recording.period)
    count = max(round(run.duration / recording.period), match.count)
    stride = max(round(1.0 / (_PLACES * run.highest_frequency * recording.period)), 1)
    stride = max(stride, recording.sample_count // _MOST_PLACES)
    best, least, seen = None, _SETTINGS.amplitude_tolerance, math.inf
    for begin in range(0, recording.sample_count - count + 1, stride):
        part = slice(begin, begin + count)
        left = match.left_of(recording.displacement[part])
        seen = min(seen, left)
        off = abs(float(np.median(recording.current[part])) - run.currents[0])
        if off <= _SETTINGS.current_tolerance and left < least:
            best, least = begin, left
    if best is None:
        nearest = (
            f"the nearest leaves {seen:.0%} of it" if math.isfinite(seen) else "it is too short"
        )
        raise RunNotFoundError(
            f"{recording.name} does not hold the run: it needs {run.duration:.3g} s of "
            f"{run.kind.description} as wanted at {run.currents[0]:g} A, and {nearest}, or the "
            "current is another"
        )
    return _part(recording, best, count)


def _from_step(run: PlannedRun, recording: Recording) -> Recording:
    first, second = run.currents[:2]
    beyond = (recording.current - 0.5 * (first + second)) * np.sign(second - first) > 0.0
    steps = np.flatnonzero(np.diff(beyond.astype(np.int8)) > 0) + 1
    stretch = round(run.stretch / recording.period)
    count = round(run.duration / recording.period)
    for step in steps.tolist():
        begin = step - stretch
        if begin >= 0 and begin + count <= recording.sample_count:
            return _part(recording, begin, count)
    raise RunNotFoundError(
        f"{recording.name} does not hold the run: the current does not go from {first:g} to "
        f"{second:g} A with {run.stretch:.3g} s before that"
    )


def _part(recording: Recording, begin: int, count: int) -> Recording:
    part = slice(begin, begin + count)
    celsius = recording.temperature
    return replace(
        recording,
        start_ns=recording.stamp_ns(begin),
        displacement=recording.displacement[part],
        force=recording.force[part],
        current=recording.current[part],
        temperature=None if celsius is None else celsius[part],
    )
