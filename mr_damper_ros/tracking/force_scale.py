"""How the force has changed against a baseline, with its standard error."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.models.sigmoid.law import (
    Coefficients,
    coefficient_jacobian,
    force_from_coefficients,
)
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.reservoir import OperatingPoint, nearest_same

_POINTS = 256


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


def force_scale(baselines: Baselines, fit: WindowFit) -> ForceScale:
    """Scale that maps the baseline's loop onto the loop of a fit, in the least-squares sense.

    Both loops are evaluated over the same sinusoidal cycle of the fit's peak velocity, so noise
    and phase of the window play no part. The standard error carries the covariance of the fit;
    that of the baseline is common to all reports and left out.
    """
    baseline = baselines.get(fit.operating_point)
    if baseline is None:
        return ForceScale()
    phase = 2.0 * np.pi * np.arange(_POINTS) / _POINTS
    velocity = fit.operating_point[0] * np.cos(phase)
    branch = -np.sin(phase)
    reference = _loop(baseline.coefficients, velocity, branch)
    present = _loop(fit.coefficients, velocity, branch)
    jacobian = coefficient_jacobian(Coefficients(*fit.coefficients), velocity, branch)
    return scale_between(reference, present, jacobian, fit.coefficient_covariance)


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


def _loop(coefficients: Array, velocity: Array, branch: Array) -> Array:
    return force_from_coefficients(Coefficients(*coefficients), velocity, branch)
