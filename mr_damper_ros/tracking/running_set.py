"""The new parameter set after a window: values from the fit and values from the running set."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.estimation.covariance import SAME_MOTION
from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import NOTICED, SAME_CURRENT
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.acceptance import LARGE_SHAPE_CHANGE, Evidence
from mr_damper_ros.tracking.operating_point import (
    SAME_SPEED,
    KnownForce,
    OperatingPoint,
    nearest_comparable,
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

    @classmethod
    def of(cls, window: Window) -> SteadyMotion:
        """The motion of one window; NaN if it is not a sine at one current."""
        current = window.current
        constant = float(np.ptp(current)) <= 2.0 * SAME_CURRENT
        middle = 0.5 * float(current.min() + current.max()) if constant else math.nan
        return cls(1, window.motion.amplitude, window.motion.frequency, middle)

    def windows_before(self, motion: SteadyMotion) -> int:
        """Number of good windows in a row with this motion; 0 if it is not a sine."""
        # A sensor with a delay may also attenuate the motion; the loop keeps its shape.
        points = ((each.amplitude * each.frequency, each.current) for each in (self, motion))
        before, now = points
        same = math.isclose(motion.frequency, self.frequency, rel_tol=SAME_MOTION)
        same = same and nearest_comparable([before], now) is not None
        return self.windows if same else 0

    def followed_by(self, motion: SteadyMotion) -> SteadyMotion:
        """The motion after a good window."""
        return replace(motion, windows=self.windows_before(motion) + 1)


def holds_at(running: ParameterSet, point: OperatingPoint) -> bool:
    """Whether a set has been identified at an operating point."""
    speed, current = point
    return bool(
        running.observable.any()
        and _is_within((speed, speed), running.peak_velocity_range, SAME_SPEED)
        and _is_within((current, current), running.current_range, 1.0, SAME_CURRENT)
    )


def known_force(fit: WindowFit, window: Window) -> KnownForce:
    """The size of the force of a window, without the residual of the fit."""
    size = float(np.std(window.force)) * math.sqrt(max(1.0 - fit.nrmse**2, 0.0))
    return KnownForce(*fit.operating_point, size, window.largest_force)


def candidate(running: ParameterSet, values: Array, window: Window) -> ParameterSet:
    """A set with the values (p,) fitted to a window, and the peak velocity range it would get."""
    speeds = window.peak_velocity_range
    if running.law.knows_speeds(running.observable):
        speeds = _wider_speeds(running, speeds, window.motion.frequency)
    return replace(running, values=values, peak_velocity_range=speeds)


def _wider_speeds(
    running: ParameterSet, found: tuple[float, float], frequency: float
) -> tuple[float, float]:
    """Peak velocity range [m/s] of the running set, extended by the range ``found`` of a window.

    If ``frequency`` is NaN, the motion is not a sine, and the lower end stays.
    """
    slowest = running.peak_velocity_range[0]
    if math.isnan(frequency):
        # In a motion other than a sine, low values contain no information on the law at low speed.
        found = max(found[0], slowest), max(found[1], slowest)
    return _wider(found, running.peak_velocity_range)


def new_set(
    running: ParameterSet,
    fit: WindowFit,
    evidence: Evidence,
    window: Window,
    *,
    set_id: str,
    stamp_ns: int,
) -> ParameterSet:
    """The set of a window fit; ``stamp_ns`` is the stamp of the window's last sample.

    Parameters that were not fitted keep their values and errors. The set holds in the range of the
    window, and in that of the running set if its dependence on the peak velocity, or on the
    current, is known and agrees with the window. A window that is not a sine does not change the
    lower end of a known range.
    """
    model = running.law
    errors, discrepancies = running.standard_errors.copy(), running.discrepancies.copy()
    places = model.unknown_indices
    errors[places] = found = np.sqrt(np.diag(fit.whole_covariance))
    observable = running.observable.copy()
    observable[places] = np.isfinite(found)
    discrepancies[places] = math.nan
    if fit.discrepancy is not None:
        discrepancies[places] = np.sqrt(np.diag(fit.discrepancy))
    # The running set predicted the force here, or its shape, so its range stays valid.
    similar = evidence.shape_change <= LARGE_SHAPE_CHANGE
    agrees = abs(evidence.force_change) <= NOTICED
    velocity_range, largest_force = window.peak_velocity_range, window.largest_force
    current_range = float(window.current.min()), float(window.current.max())
    known = (
        model.knows_speeds(running.observable)
        and similar
        and (agrees or _is_within(velocity_range, running.peak_velocity_range, SAME_SPEED)),
        model.knows_currents(running.observable)
        and similar
        and (agrees or _is_within(current_range, running.current_range, 1.0, SAME_CURRENT)),
    )
    if known[0]:
        velocity_range = _wider_speeds(running, velocity_range, window.motion.frequency)
    if known[1]:
        current_range = _wider(current_range, running.current_range)
    if any(known):
        # If the largest force is unknown for the running set, it is also unknown for the new set.
        largest_force = float(np.maximum(largest_force, running.largest_force))
    return replace(
        running,
        values=fit.parameters,
        set_id=set_id,
        source=fit.method,
        nrmse=evidence.nrmse_after,
        stamp_ns=stamp_ns,
        standard_errors=errors,
        discrepancies=discrepancies,
        observable=observable,
        peak_velocity_range=velocity_range,
        current_range=current_range,
        largest_force=largest_force,
    )


def _wider(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    return min(one[0], other[0]), max(one[1], other[1])


def _is_within(
    one: tuple[float, float], other: tuple[float, float], factor: float, margin: float = 0.0
) -> bool:
    return other[0] / factor - margin <= one[0] and one[1] <= other[1] * factor + margin
