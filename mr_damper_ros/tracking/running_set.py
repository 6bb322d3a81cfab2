"""The parameter set that is in use after a window: what it takes over, and what it keeps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.tracking.acceptance import Evidence
from mr_damper_ros.tracking.tasks import WindowSummary


def set_of_window(
    running: ParameterSet,
    fit: WindowFit,
    evidence: Evidence,
    summary: WindowSummary,
    *,
    set_id: str,
    stamp_ns: int,
) -> ParameterSet:
    """The set after a window whose fit was accepted; ``stamp_ns`` is that of its last sample.

    Parameters that the window was not fitted with keep what is known of them.
    """
    model = running.law
    errors = running.standard_errors.copy()
    observable = running.observable.copy()
    places, found = model.fitted_errors(fit.scales, fit.covariance)
    errors[places] = found
    observable[places] = np.isfinite(found)
    velocity_range, current_range = summary.peak_velocity_range, summary.current_range
    largest_force = summary.largest_force
    if model.knows_shape(running.observable):
        velocity_range = _wider(velocity_range, running.peak_velocity_range)
        current_range = _wider(current_range, running.current_range)
        largest_force = _larger(largest_force, running.largest_force)
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
    """The set after an early fit, which has found the strength of the damper changed."""
    model = running.law
    errors = running.standard_errors.copy()
    fitted = np.full(errors.size, math.nan)
    places, found = model.fitted_errors(fit.scales, fit.covariance)
    fitted[places] = found
    # The other parameters keep what is known of them.
    changed = model.strength_indices
    errors[changed] = np.hypot(errors[changed] * (1.0 + evidence.force_change), fitted[changed])
    return replace(
        running,
        values=fit.parameters,
        standard_errors=errors,
        set_id=set_id,
        source=fit.method,
        nrmse=evidence.nrmse_after,
        stamp_ns=stamp_ns,
        largest_force=_larger(summary.largest_force, running.largest_force),
    )


def _larger(known: float, other: float) -> float:
    """The larger of two forces [N], of which the other may be unknown (NaN)."""
    return known if math.isnan(other) else max(known, other)


def _wider(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    return min(one[0], other[0]), max(one[1], other[1])
