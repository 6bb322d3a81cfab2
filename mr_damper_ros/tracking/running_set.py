"""The new parameter set after a window: values from the fit and values from the running set."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.acceptance import Evidence
from mr_damper_ros.tracking.operating_point import (
    SAME_CURRENT,
    SAME_SPEED,
    KnownForce,
    OperatingPoint,
)

_AGREES = 0.1
"""If the force changes by at most this fraction, the law of the running set also holds where it has
not been identified."""

_SAME_FREQUENCY = 0.05
_SAME_AMPLITUDE = 0.3
"""Relative tolerances of the same motion. The tolerance of the amplitude is wide because a sensor
with a delay may also attenuate the motion. Within it, the loop keeps its shape."""


@dataclass(frozen=True)
class WindowSummary:
    """Figures of a fitted window for the report, and the range that the window covers.

    ``amplitude`` is in m; ``frequency`` in Hz, NaN if the motion is not a sine. The range of the
    peak velocity [m/s] omits the lowest and the highest twentieth; that of the current is in A.
    ``largest_force`` [N] and ``spread`` [N], the standard deviation, are those of the force.
    """

    amplitude: float
    frequency: float
    peak_velocity_range: tuple[float, float]
    current_range: tuple[float, float]
    largest_force: float
    spread: float

    @classmethod
    def of(cls, window: Window) -> WindowSummary:
        """The summary of a window."""
        current = window.current
        return cls(
            amplitude=window.motion.amplitude,
            frequency=window.motion.frequency,
            peak_velocity_range=window.peak_velocity_range,
            current_range=(float(current.min()), float(current.max())),
            largest_force=window.largest_force,
            spread=float(np.std(window.force)),
        )


@dataclass(frozen=True)
class SteadyMotion:
    """The sine of the newest good windows, and the number of such windows in a row.

    ``amplitude`` is in m, ``frequency`` in Hz and ``current`` in A.
    """

    windows: int = 0
    amplitude: float = math.nan
    frequency: float = math.nan
    current: float = math.nan

    def windows_of(self, summary: WindowSummary) -> int:
        """Number of good windows in a row with the motion of this window; 0 if it is not a sine."""
        low, high = summary.current_range
        same = (
            math.isclose(summary.amplitude, self.amplitude, rel_tol=_SAME_AMPLITUDE)
            and math.isclose(summary.frequency, self.frequency, rel_tol=_SAME_FREQUENCY)
            and max(abs(low - self.current), abs(high - self.current)) <= SAME_CURRENT
        )
        return self.windows if same else 0

    def followed_by(self, summary: WindowSummary) -> SteadyMotion:
        """The motion after a good window."""
        current = 0.5 * sum(summary.current_range)
        return SteadyMotion(
            self.windows_of(summary) + 1, summary.amplitude, summary.frequency, current
        )


def holds_at(running: ParameterSet, point: OperatingPoint) -> bool:
    """Whether a set has been identified at an operating point."""
    speed, current = point
    return bool(
        running.observable.any()
        and _is_within((speed, speed), running.peak_velocity_range, SAME_SPEED)
        and _is_within((current, current), running.current_range, 1.0, SAME_CURRENT)
    )


def known_force(fit: WindowFit, summary: WindowSummary) -> KnownForce:
    """The size of the force of a window, without the residual of the fit."""
    speed, current = fit.operating_point
    size = summary.spread * math.sqrt(max(1.0 - fit.nrmse**2, 0.0))
    return KnownForce(speed, current, size, summary.largest_force)


def candidate(running: ParameterSet, values: Array, window: Window) -> ParameterSet:
    """A set with the values (p,) fitted to a window, and the peak velocity range it would have."""
    speeds = window.peak_velocity_range
    if running.law.knows_speeds(running.observable):
        speeds = _wider_speeds(running, speeds, window.motion.frequency)
    return replace(running, values=values, peak_velocity_range=speeds)


def _wider_speeds(
    running: ParameterSet, found: tuple[float, float], frequency: float
) -> tuple[float, float]:
    """Peak velocity range [m/s] of the running set, extended by the range ``found`` of a window.

    If ``frequency`` is NaN, the motion is not a sine, and the lower end of the range stays.
    """
    slowest = running.peak_velocity_range[0]
    if math.isnan(frequency):
        # In a motion other than a sine, low values contain no information on the law at low speed.
        found = max(found[0], slowest), max(found[1], slowest)
    return _wider(found, running.peak_velocity_range)


def set_of_window(
    running: ParameterSet,
    fit: WindowFit,
    evidence: Evidence,
    summary: WindowSummary,
    *,
    set_id: str,
    stamp_ns: int,
) -> ParameterSet:
    """The set of a window fit; ``stamp_ns`` is that of the window's last sample.

    Parameters that were not fitted keep their values and errors. The range is that of the window.
    If the dependence on the peak velocity, or on the current, has been determined and agrees with
    the window, the range also includes that of the running set. A window that is not a sine does
    not change the lower end of a known range.
    """
    model = running.law
    errors = running.standard_errors.copy()
    observable = running.observable.copy()
    places, found = model.fitted_errors(fit.scales, fit.whole_covariance)
    errors[places] = found
    observable[places] = np.isfinite(found)
    discrepancies = running.discrepancies.copy()
    discrepancies[places] = math.nan
    if fit.discrepancy is not None:
        discrepancies[places] = model.fitted_errors(fit.scales, fit.discrepancy)[1]
    # The running set predicted the force here, so its range stays valid.
    agrees = abs(evidence.force_change) <= _AGREES
    velocity_range, current_range = summary.peak_velocity_range, summary.current_range
    largest_force = summary.largest_force
    known = (
        model.knows_speeds(running.observable)
        and (agrees or _is_within(velocity_range, running.peak_velocity_range, SAME_SPEED)),
        model.knows_currents(running.observable)
        and (agrees or _is_within(current_range, running.current_range, 1.0, SAME_CURRENT)),
    )
    if known[0]:
        velocity_range = _wider_speeds(running, velocity_range, summary.frequency)
    if known[1]:
        current_range = _wider(current_range, running.current_range)
    if any(known):
        # If the largest force over the running set's range is unknown, so is that of the new set.
        unknown = math.isnan(running.largest_force)
        largest_force = math.nan if unknown else max(largest_force, running.largest_force)
    return ParameterSet(
        values=fit.parameters,
        standard_errors=errors,
        observable=observable,
        set_id=set_id,
        source=fit.method,
        peak_velocity_range=velocity_range,
        current_range=current_range,
        nrmse=evidence.nrmse_after,
        stamp_ns=stamp_ns,
        model=model.name,
        largest_force=largest_force,
        discrepancies=discrepancies,
    )


def set_of_change(
    running: ParameterSet,
    fit: WindowFit,
    evidence: Evidence,
    summary: WindowSummary,
    *,
    set_id: str,
    stamp_ns: int,
) -> ParameterSet:
    """The set after an early fit, which scales the gain parameters of the running set."""
    model = running.law
    errors = running.standard_errors.copy()
    fitted = np.full(errors.size, math.nan)
    places, found = model.fitted_errors(fit.scales, fit.covariance)
    fitted[places] = found
    # The other parameters keep their errors.
    changed = model.strength_indices
    factor = abs(1.0 + evidence.force_change)
    errors[changed] = np.hypot(errors[changed] * factor, fitted[changed])
    discrepancies = running.discrepancies.copy()
    discrepancies[changed] *= factor
    return replace(
        running,
        values=fit.parameters,
        standard_errors=errors,
        set_id=set_id,
        source=fit.method,
        nrmse=evidence.nrmse_after,
        stamp_ns=stamp_ns,
        largest_force=_larger(summary.largest_force, running.largest_force),
        discrepancies=discrepancies,
    )


def _larger(known: float, other: float) -> float:
    """The larger of two forces [N]; ``other`` may be unknown (NaN)."""
    return known if math.isnan(other) else max(known, other)


def _wider(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    return min(one[0], other[0]), max(one[1], other[1])


def _is_within(
    one: tuple[float, float], other: tuple[float, float], factor: float, margin: float = 0.0
) -> bool:
    return other[0] / factor - margin <= one[0] and one[1] <= other[1] * factor + margin
