"""How the force has changed against a baseline, with its standard error."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.window_fit import WindowFit, fit_of
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.cusum import ScaleFit
from mr_damper_ros.tracking.reservoir import OperatingPoint, nearest_same


@dataclass(frozen=True)
class ForceScale:
    """Force against the baseline, 1 = unchanged; NaN where there is no baseline to compare with."""

    value: float = math.nan
    standard_error: float = math.nan


class Baselines:
    """The first accepted fit at each operating point."""

    def __init__(self, fits: Iterable[WindowFit] = ()) -> None:
        """Begin with these fits, each of another operating point."""
        self._fits = list(fits)

    @property
    def fits(self) -> tuple[WindowFit, ...]:
        """All baselines, oldest first."""
        return tuple(self._fits)

    def add(self, fit: WindowFit) -> None:
        """Keep a fit unless its operating point has a baseline already."""
        if self.get(fit.operating_point) is None:
            self._fits.append(fit)

    def get(self, operating_point: OperatingPoint) -> WindowFit | None:
        """The baseline of an operating point (peak velocity [m/s], current [A]), if any."""
        index = nearest_same([fit.operating_point for fit in self._fits], operating_point)
        return None if index is None else self._fits[index]


def force_scale(model: Model, window: Window, fit: WindowFit, baselines: Baselines) -> ForceScale:
    """Scale that maps the force of the baseline onto that of a fit, in the least-squares sense.

    Both are the forces that the sets predict over the motion of the window, so that its noise plays
    no part. The standard error carries the covariance of the fit; that of the baseline is common to
    all reports and left out.
    """
    baseline = baselines.get(fit.operating_point)
    if baseline is None:
        return ForceScale()
    problem = model.window_problem(window, fit.parameters)
    settled = problem.settled
    reference, present = (
        model.window_force(window, parameters)[settled]
        for parameters in (baseline.parameters, fit.parameters)
    )
    return scale_between(reference, present, problem.jacobian(fit.scales)[settled], fit.covariance)


def with_strength(
    model: Model, window: Window, start: Array, found: ScaleFit, method: str
) -> WindowFit:
    """Parameters ``start`` (p,) with the strength of the damper changed, as a fit of the window."""
    # What follows the current rises and falls too, and no window is fitted with it.
    rest = np.setdiff1d(model.strength_indices, model.free_indices)
    start = start.copy()
    start[rest] *= found.factor
    problem = model.window_problem(window, start)
    moved = np.where(problem.strength, problem.start, 0.0)
    return fit_of(
        problem,
        problem.start + moved * (found.factor - 1.0),
        np.outer(moved, moved) * found.standard_error**2,
        method=method,
        evaluations=2,
    )


def scale_between(
    reference: Array, present: Array, jacobian: Array, covariance: Array
) -> ForceScale:
    """Scale that maps one force (n,) [N] onto another in the least-squares sense.

    ``jacobian`` (n, k) is that of the present force by unknowns of this ``covariance`` (k, k).
    """
    power = float(reference @ reference)
    if power == 0.0:
        return ForceScale()
    # An unknown that the samples do not determine does not change the force either.
    determined = ~np.isnan(np.diag(covariance))
    gradient = (reference @ jacobian / power)[determined]
    variance = float(gradient @ covariance[np.ix_(determined, determined)] @ gradient)
    return ForceScale(float(present @ reference) / power, math.sqrt(max(variance, 0.0)))
