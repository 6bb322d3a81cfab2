"""Inertia of the mass between load cell and damper: rod, clevis and half of the load cell.

The load cell measures the force of the damper plus mass * acceleration. The mass belongs to the
rig, not to the law. Its inertia is therefore subtracted from the force before a law is fitted or
validated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mr_damper_ros.api.findings import Estimate
from mr_damper_ros.api.measured_runs import MeasuredRun
from mr_damper_ros.estimation.covariance import least_squares_covariance
from mr_damper_ros.estimation.global_fit import GlobalFit
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.signals.arrays import Array

_SAMPLES = 8000
"""Approximate number of samples over all windows; more samples would not help the fit."""

_MOST_STEPS = 40


def without_inertia(runs: Sequence[MeasuredRun], mass: float) -> tuple[MeasuredRun, ...]:
    """The runs without the inertia of ``mass`` [kg]; raises ValueError if the mass is invalid."""
    if not (math.isfinite(mass) and mass >= 0.0):
        raise ValueError(f"the mass is {mass}: give kilograms, or 0 for none")
    if mass == 0.0:
        return tuple(runs)
    return tuple(replace(run, windows=tuple(_less(w, mass) for w in run.windows)) for run in runs)


def _less(window: Window, mass: float) -> Window:
    return replace(window, force=window.force - mass * window.motion.acceleration)


def fitted_mass(fit: GlobalFit, windows: Sequence[Window], mass: float = 0.0) -> Estimate:
    """The mass [kg], by least squares together with the observable parameters of the law.

    The forces of ``windows`` include the inertia. The search starts from ``mass`` [kg] and the fit.
    """
    from scipy.optimize import least_squares  # imported late: see entry_points

    found = fit.parameter_set
    few = [window.thinned(_SAMPLES // len(windows)) for window in windows]
    misfit = Misfit(found.law, few, fit.noise.tolist(), found.values)
    places = np.flatnonzero(found.observable)
    inertia = misfit.sample_weights * np.concatenate([w.motion.acceleration for w in few])

    def values(unknowns: Array) -> Array:
        changed = found.values.copy()
        changed[places] = unknowns[:-1]
        return changed

    def residual(unknowns: Array) -> Array:
        return np.asarray(misfit.residual(values(unknowns)) + unknowns[-1] * inertia)

    def jacobian(unknowns: Array) -> Array:
        return np.column_stack((misfit.jacobian(values(unknowns), places.tolist()), inertia))

    low, high = (
        np.append(bound[places], end)
        for bound, end in zip(found.law.bounds, (0.0, np.inf), strict=True)
    )
    start = np.clip(np.append(found.values[places], mass), low, high)
    best = least_squares(
        residual, start, jacobian, (low, high), x_scale="jac", max_nfev=_MOST_STEPS
    ).x
    covariance = least_squares_covariance(jacobian(best), residual(best))
    return Estimate(
        float(best[-1]),
        math.sqrt(covariance[-1, -1]),
        "kg",
        meaning="mass between load cell and damper",
    )
