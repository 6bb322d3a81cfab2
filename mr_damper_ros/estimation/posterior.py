"""The posterior of parameters: samples of windows and a prior in one least-squares problem."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import (
    correlation_length,
    discrepancy_between,
    least_squares_covariance,
    motion_numbers,
)
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.signals.arrays import Array


def noise_level(misfit: Misfit, parameters: Array) -> float:
    """Standard deviation [1] of one independent sample of the residual at parameters (p,).

    It is larger for a correlated residual, so that model error does not average out like noise.
    """
    residual = misfit.residual(parameters)
    power = float(np.mean(residual**2)) * correlation_length(residual)
    return math.sqrt(max(power, 1e-300))


@dataclass(frozen=True, eq=False)
class Prior:
    """The plausible range of dampers: a mean (``centre``) and a deviation (``width``), (p,)."""

    centre: Array
    width: Array


class Posterior:
    """Residual of a pooled problem, then of the prior, for unknowns (f,).

    The unknowns are the parameters at ``places``, each in units of the width of its prior. All
    other parameters keep their ``values`` (p,). ``noise`` [1], the standard deviation of one
    independent sample of the residual, sets the weight of the prior.
    """

    def __init__(
        self, pooled: Misfit, values: Array, places: Sequence[int], prior: Prior, noise: float
    ) -> None:
        self._pooled = pooled
        self._values = np.array(values, dtype=float)
        self._places = list(places)
        self.widths = prior.width[self._places]
        self._centre = prior.centre[self._places] / self.widths
        self.noise = noise
        self.start = self._values[self._places] / self.widths
        low, high = (bound[self._places] / self.widths for bound in pooled.model.bounds)
        unbounded = bool(np.all(np.isinf(low)) and np.all(np.isinf(high)))
        self.bounds = None if unbounded else (low, high)

    def parameters(self, unknowns: Array) -> Array:
        """All parameters (p,)."""
        values = self._values.copy()
        values[self._places] = unknowns * self.widths
        return values

    def residual(self, unknowns: Array) -> Array:
        """Weighted residual of all windows [1], then of the prior (f,)."""
        plain = self._pooled.residual(self.parameters(unknowns))
        return np.concatenate((plain, self.noise * (unknowns - self._centre)))

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual with respect to the unknowns."""
        derivatives = self._pooled.jacobian(self.parameters(unknowns), self._places)
        prior = self.noise * np.eye(len(self._places))
        return np.concatenate((derivatives * self.widths, prior))

    def cost(self, parameters: Array) -> float:
        """Sum of squares of the residual for parameters (p,)."""
        residual = self.residual(parameters[self._places] / self.widths)
        return float(residual @ residual)

    def covariances(self) -> tuple[Array, Array]:
        """Covariance (f, f) of the parameters at the start, and the discrepancy in it.

        The discrepancy is NaN if unknown.
        """
        jacobian, residual = self.jacobian(self.start), self.residual(self.start)
        known = self._pooled.prior_variances
        variances = np.append(known, np.full(self.start.size, self.noise**2))
        covariance = least_squares_covariance(jacobian, residual, variances)
        by_noise = least_squares_covariance(jacobian, residual, np.zeros_like(variances))
        # The rows of the prior belong to no motion.
        motions = np.full(residual.size, -1)
        windows = self._pooled.row_windows
        motions[: windows.size] = motion_numbers(self._pooled.windows)[windows]
        discrepancy = discrepancy_between(jacobian, residual, motions, by_noise)
        units = np.outer(self.widths, self.widths)
        return (covariance + np.nan_to_num(discrepancy)) * units, discrepancy * units
