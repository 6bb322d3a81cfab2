"""Causes of a poor fit: another law, a shift in time, a gain or a zero that changes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mr_damper_ros.data_check.findings import NOTE, WARN, Finding, Kind
from mr_damper_ros.data_check.samples import skew_finding
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array

LARGEST_NRMSE = 0.3
"""Largest acceptable NRMSE of a run; above it, the set explains too little of the force."""

_POOR = 0.08
"""NRMSE above which fits of other laws and at other times are tried."""

_MUCH_BETTER = 0.6
"""A cause is named if the NRMSE without it is at most this part of the NRMSE with it."""

_SAMPLES = 1500
"""Approximate number of samples that are fitted to find a cause."""

_SHIFTS = np.array([1.0, 2.0, 4.0, 7.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0]) * 1e-3
"""Shifts [s] of the force that are tried in both directions."""

_PARTS = 10
"""Parts of a window whose gains and zeros are compared."""

_STEP_OF_GAIN, _STEP_OF_ZERO = 0.2, 0.15
"""Smallest step that is named: of the gain, and of the zero relative to the force."""

_MOVING = 0.3
"""Smallest standard deviation of the force in a part, relative to that of the window."""

_ABRUPT = 0.9
"""Part of the variance that a step explains. A steady drift is explained to three quarters."""


def cause_of(model: str, window: Window, nrmse: float) -> list[Finding]:
    """The best explanation of a poor fit of a law to a ``window``, as one finding; empty if none.

    The trials fit the unknowns of the window. A shift in time can be told only from a motion of
    several frequencies, since in a sine the hysteresis makes up for it.
    """
    if nrmse <= _POOR:
        return []
    here = _nrmse(model, window)
    causes = _other_law(model, window, here, nrmse)
    if window.motion.sine is None:
        causes += _shift(model, window, here)
    return [finding for _, finding in sorted(causes, key=lambda each: each[0])[:1]]


def _nrmse(model: str, window: Window) -> float:
    """NRMSE of the window fit of a law; infinite if it fails."""
    law = MODELS[model]
    start = law.initial_values()[0]
    try:
        return fit_window(law, window.thinned(_SAMPLES), start, method="least_squares").nrmse
    except (ValueError, ArithmeticError):
        return math.inf


def _other_law(
    model: str, window: Window, here: float, nrmse: float
) -> list[tuple[float, Finding]]:
    """NRMSE of the best other law, with a finding, if it is much better."""
    trials = {other: _nrmse(other, window) for other in MODELS if other != model}
    other = min(trials, key=trials.__getitem__)
    if not trials[other] <= _MUCH_BETTER * min(here, nrmse):
        return []
    better = trials[other]
    found = Kind.OTHER_LAW.found(
        value=better, other=other, better=better, model=model, nrmse=min(here, nrmse)
    )
    return [(better, replace(found, severity=WARN if nrmse > LARGEST_NRMSE else NOTE))]


def _shift(model: str, window: Window, here: float) -> list[tuple[float, Finding]]:
    """NRMSE with the best shift in time, with a finding, if it is much better."""
    shifts = np.concatenate((-_SHIFTS[::-1], [0.0], _SHIFTS))
    errors = [
        _nrmse(model, _with_shifted_force(window, shift)) if shift else here
        for shift in shifts.tolist()
    ]
    place = int(np.argmin(errors))
    if errors[place] > _MUCH_BETTER * here:
        return []
    late = float(shifts[place])
    near = shifts[max(place - 1, 0) : place + 2]
    doubt = 0.5 * float(np.ptp(near)) / (near.size - 1)
    return [(errors[place], skew_finding(late, doubt))]


def _with_shifted_force(window: Window, late: float) -> Window:
    """The window with the force that was recorded ``late`` [s] moved back to its motion."""
    places = np.arange(window.sample_count) + round(late / window.period)
    inside = (places >= 0) & (places < window.sample_count)
    moved = replace(window, force=window.force[places.clip(0, window.sample_count - 1)])
    return moved.part(inside)


def steps_within(found: ParameterSet, window: Window) -> list[Finding]:
    """Findings on a gain or a zero of the force that changes at once within a window."""
    predicted = found.window_force(window)
    usual = float(np.std(predicted))
    gains, zeros = [], []
    for own, measured in zip(
        np.array_split(predicted, _PARTS), np.array_split(window.force, _PARTS), strict=True
    ):
        if not float(np.std(own)) > _MOVING * usual:
            return []  # at rest or in another motion, gain and zero say nothing
        around = own - own.mean()
        gains.append(float(around @ measured) / float(around @ around))
        zeros.append(float(measured.mean()) - gains[-1] * float(own.mean()))
    size = float(np.std(window.force))
    steps = []
    gain_step, zero_step = _step(np.array(gains)), _step(np.array(zeros))
    if abs(zero_step) > _STEP_OF_ZERO * size:
        steps.append(Kind.ZERO_CHANGES.found("force", value=zero_step, step=zero_step))
    elif abs(gain_step) > _STEP_OF_GAIN:
        steps.append(Kind.GAIN_CHANGES.found("force", value=gain_step, step=gain_step))
    return steps


def _step(values: Array) -> float:
    """Size of the step in values (n,) if it explains most of their variance, otherwise 0."""
    whole = float(np.sum((values - values.mean()) ** 2))
    best, size = whole, 0.0
    for place in range(2, values.size - 1):
        before, after = values[:place], values[place:]
        left = float(np.sum((before - before.mean()) ** 2) + np.sum((after - after.mean()) ** 2))
        if left < best:
            best, size = left, float(after.mean() - before.mean())
    return size if best < (1.0 - _ABRUPT) * whole else 0.0
