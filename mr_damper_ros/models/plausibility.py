"""Whether a parameter set, wherever it comes from, can be that of a damper.

A file, a message, a service and a saved state are judged alike: the figures that the set states of
itself, and the force that its law gives where the set says that it holds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.signals.arrays import Array

LARGEST_FORCE = 1e6
"""Newtons that no damper gives: the largest MR dampers, those of buildings, give 400 kN."""

LARGEST_NRMSE = 1.0
"""A law whose error is as large as the spread of the force says nothing of the force."""

_EXCESS = 3.0
"""The law may give so many times the largest force that was measured while it was identified: the
fastest motion and the largest current of its range need not have come together."""

_DRIVES = 0.02
"""Part of the work of a constant force that a law may seem to give back: the samples of a cycle are
few. A law of reversed sign gives back most of it."""

_USUAL_SPEEDS = (0.01, 0.03, 0.1, 0.3)
"""Peak velocities [m/s] at which a law is tried whose range is open or empty."""

_USUAL_CURRENTS = (0.0, 0.5, 1.0, 2.0)
"""Currents [A] at which a law is tried whose range is open."""

_FREQUENCIES = (2.0, 0.5, 8.0)
"""Hertz. The range says nothing of the frequency: one of these must be plausible."""

_SAMPLES = 32
"""Samples of a cycle."""


def check_plausible(parameters: ParameterSet) -> ParameterSet:
    """The set itself, where it can be that of a damper over the range that it states.

    Its force over cycles of the smallest, a middle and the largest peak velocity and current of
    the range must be no larger than a damper's, nor than three times the largest force that it
    states to have been identified from, and it must take energy out of the motion. Where the range
    is open some usual values are tried, one of which must be plausible.

    Raises ParameterError with one sentence otherwise.
    """
    if not (math.isnan(parameters.nrmse) or 0.0 <= parameters.nrmse <= LARGEST_NRMSE):
        raise ParameterError(
            f"the parameters state an nrmse of {parameters.nrmse:.3g}, where it must lie in 0 to "
            f"{LARGEST_NRMSE:g}: identify the damper again"
        )
    speeds = _places(parameters.peak_velocity_range, _USUAL_SPEEDS, least=0.0)
    currents = _places(parameters.current_range, _USUAL_CURRENTS)
    reason = ""
    for frequency in _FREQUENCIES:
        reason = _doubt(parameters, speeds, currents, frequency)
        if not reason:
            return parameters
    raise ParameterError(reason)


def implausible(parameters: ParameterSet) -> str:
    """Why a set cannot be that of a damper, in a sentence; empty where it can."""
    try:
        check_plausible(parameters)
    except ParameterError as error:
        return str(error)
    return ""


class _Places(NamedTuple):
    """Where a law is tried, and whether it must be plausible everywhere there."""

    values: Array
    all_count: bool


def _places(
    stated: tuple[float, float], usual: tuple[float, ...], least: float = -math.inf
) -> _Places:
    low, high = stated
    if not (math.isfinite(low) and math.isfinite(high)) or high <= least:
        return _Places(np.array(usual), all_count=False)
    low = max(low, least)
    return _Places(np.unique([low, 0.5 * low + 0.5 * high, high]), all_count=True)


def _doubt(parameters: ParameterSet, speeds: _Places, currents: _Places, frequency: float) -> str:
    """Why the law cannot be a damper's at this frequency [Hz]; empty where it can."""
    peaks, works, most = _cycles(parameters, speeds.values, currents.values, frequency)
    known = parameters.largest_force > 0.0
    limit = min(_EXCESS * parameters.largest_force, LARGEST_FORCE) if known else LARGEST_FORCE
    with np.errstate(invalid="ignore"):
        sizes = peaks <= limit
        damping = works >= -_DRIVES * most
    if speeds.all_count:
        # A law that follows random motion need not be right in its slowest parts.
        with np.errstate(all="ignore"):
            damping[:] = np.sum(works, axis=0) >= -_DRIVES * np.sum(most, axis=0)
    sound = _everywhere(sizes & damping, speeds, currents)
    if sound:
        return ""
    if not _everywhere(sizes, speeds, currents):
        largest = float(np.max(np.where(np.isfinite(peaks), peaks, math.inf)))
        return (
            f"within their range the parameters give a force of {largest:.3g} N, more than the "
            f"possible {limit:.3g} N: identify the damper again"
        )
    return (
        "within their range the parameters give a force that is not dissipative: were the signs "
        "of force and displacement right during the identification?"
    )


def _everywhere(sound: np.ndarray, speeds: _Places, currents: _Places) -> bool:
    """Whether it is so everywhere, or somewhere where the range does not say where it holds."""
    of_currents = sound.all(axis=0) if speeds.all_count else sound.any(axis=0)
    return bool(of_currents.all() if currents.all_count else of_currents.any())


def _cycles(
    parameters: ParameterSet, speeds: Array, currents: Array, frequency: float
) -> tuple[Array, Array, Array]:
    """Peak force [N] of a settled cycle, its work, and that of the peak force against the motion.

    Each of shape (speeds, currents); the works in N m/s, summed over the samples.
    """
    rate = 2.0 * math.pi * frequency
    angle = np.arange(2 * _SAMPLES) * (2.0 * math.pi / _SAMPLES)
    shape = (speeds.size, currents.size, angle.size)
    speed, current, phase = (
        np.broadcast_to(values, shape).reshape(-1)
        for values in (speeds[:, None, None], currents[:, None], angle)
    )
    velocity = speed * np.cos(phase)
    motion = Motion(
        displacement=speed / rate * np.sin(phase),
        velocity=velocity,
        acceleration=-speed * rate * np.sin(phase),
        peak_velocity=speed,
        sine=None,
    )
    with np.errstate(all="ignore"):
        force = parameters.law.force(
            parameters.values, motion, current, 1.0 / (frequency * _SAMPLES)
        )
        # The first of two cycles is there to settle in.
        force, velocity = (x.reshape(shape)[..., _SAMPLES:] for x in (force, velocity))
        peaks = np.max(np.abs(force), axis=-1)
        works = np.sum(force * velocity, axis=-1)
        return peaks, works, peaks * np.sum(np.abs(velocity), axis=-1)
