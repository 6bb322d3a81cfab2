"""Plausibility checks of parameter sets from any source.

Sets from files, messages, services and saved states pass the same checks: of the statistics that
the set states, and of the force of its law over its stated range.
"""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.periodic_motion import PHASES
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.models.quantities import MODEL_ERROR
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import LARGEST_FORCE

LARGEST_NRMSE = 1.0
"""Upper limit of the NRMSE; at 1 the error is as large as the spread of the force."""

_FORCE_RATIO = 3.0
"""Largest ratio of the law's force to the largest force measured during identification. It exceeds
1, because the fastest motion and the largest current may not have been measured together."""

_USUAL_SPEEDS = (0.01, 0.03, 0.1, 0.3)
"""Peak velocities [m/s] for a law whose range is unbounded or empty."""

_USUAL_CURRENTS = (0.0, 0.5, 1.0, 2.0)
"""Currents [A] for a law whose range is unbounded."""

_FREQUENCIES = (2.0, 0.5, 8.0)
"""Frequencies [Hz] to try, because the range states none; the law must be plausible at one of them.
"""


def check_plausible(parameters: ParameterSet) -> ParameterSet:
    """Return the set if it is plausible; raises ParameterError with :func:`implausible`."""
    reason = implausible(parameters)
    if reason:
        raise ParameterError(reason)
    return parameters


def implausible(parameters: ParameterSet) -> str:
    """Why a set is not plausible for a damper over its stated range; empty if it is plausible.

    The force is computed over cycles at the smallest, middle and largest peak velocity and current
    of the range. It must be dissipative, and must exceed neither the physical limit nor three times
    the largest force of the identification. For an unbounded range, some typical values are
    checked, and one of them must be plausible.
    """
    if not (math.isnan(parameters.nrmse) or 0.0 <= parameters.nrmse <= LARGEST_NRMSE):
        return (
            f"the parameters state an nrmse of {parameters.nrmse:.3g}, but it must be between 0 "
            f"and {LARGEST_NRMSE:g}: identify the damper again"
        )
    reason = ""
    for frequency in _FREQUENCIES:
        if not (reason := _implausible_at(parameters, frequency)):
            break
    return reason


def _points(
    stated: tuple[float, float], usual: tuple[float, ...], least: float = -math.inf
) -> tuple[Array, bool]:
    """Values at which a law is checked, and whether it must be plausible at all of them."""
    low, high = stated
    if not (math.isfinite(low) and math.isfinite(high)) or high <= least:
        return np.array(usual), False
    low = max(low, least)
    return np.unique([low, 0.5 * low + 0.5 * high, high]), True


def _implausible_at(parameters: ParameterSet, frequency: float) -> str:
    """Why the law is not plausible at this frequency [Hz]; empty if it is."""
    speeds, all_speeds = _points(parameters.peak_velocity_range, _USUAL_SPEEDS, least=0.0)
    currents, all_currents = _points(parameters.current_range, _USUAL_CURRENTS)
    peaks, works, most = _cycles(parameters, speeds, currents, frequency)

    def everywhere(sound: np.ndarray) -> bool:
        at_currents = sound.all(axis=0) if all_speeds else sound.any(axis=0)
        return bool(at_currents.all() if all_currents else at_currents.any())

    known = parameters.largest_force > 0.0
    limit = min(_FORCE_RATIO * parameters.largest_force, LARGEST_FORCE) if known else LARGEST_FORCE
    with np.errstate(all="ignore"):
        sizes = peaks <= limit
        if all_speeds:
            # A law for random motion may be inaccurate at low speed, so the work is summed.
            works, most = (np.sum(each, axis=0, keepdims=True) for each in (works, most))
        # A law with the wrong sign returns most of the work, not only its model error.
        damping = works >= -MODEL_ERROR * most
    if everywhere(sizes & damping):
        return ""
    if not everywhere(sizes):
        largest = float(np.max(np.where(np.isfinite(peaks), peaks, math.inf)))
        return (
            f"within their range the parameters give a force of {largest:.3g} N, more than the "
            f"limit of {limit:.3g} N: identify the damper again"
        )
    return (
        "within their range the parameters give a force that is not dissipative: were the signs "
        "of force and displacement right during the identification?"
    )


def _cycles(
    parameters: ParameterSet, speeds: Array, currents: Array, frequency: float
) -> tuple[Array, Array, Array]:
    """Peak force [N] of a settled cycle, its work, and the work of a constant force of this size.

    Each has shape (speeds, currents). The works are in N m/s, summed over the samples.
    """
    rate = 2.0 * math.pi * frequency
    angle = np.arange(2 * PHASES) * (2.0 * math.pi / PHASES)
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
        held = parameters.held(motion)
        force = parameters.law.force(parameters.values, held, current, 1.0 / (frequency * PHASES))
        # The first of the two cycles contains the transient.
        force, velocity = (x.reshape(shape)[..., PHASES:] for x in (force, velocity))
        peaks = np.max(np.abs(force), axis=-1)
        works = np.sum(force * velocity, axis=-1)
        return peaks, works, peaks * np.sum(np.abs(velocity), axis=-1)
