"""The posterior of parameters: samples of windows and a prior in one least-squares problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from mr_damper_ros.estimation.covariance import (
    discrepancy_between,
    least_squares_covariance,
    motion_numbers,
)
from mr_damper_ros.models.misfit import ChosenParameters
from mr_damper_ros.signals.arrays import Array


@dataclass(frozen=True, eq=False)
class Prior:
    """The plausible range of dampers: a mean (``centre``) and a deviation (``width``), (p,)."""

    centre: Array
    width: Array

    def at(self, places: Sequence[int]) -> Prior:
        """The prior (f,) of the parameters at these places."""
        return Prior(self.centre[list(places)], self.width[list(places)])


P = TypeVar("P", bound=ChosenParameters)


class Posterior(Generic[P]):
    """Residual of a problem, then of the prior, for unknowns (f,) in a ``unit``.

    The unit is the width of the prior, or 1 for the unknowns of the problem themselves.

    ``noise``, the standard deviation of one independent sample of the problem's residual, sets the
    weight of the prior.
    """

    def __init__(
        self, problem: P, prior: Prior, noise: float, unit: Array | float | None = None
    ) -> None:
        self.problem = problem
        self.widths = prior.width
        self.noise = noise
        self.unit = unit = prior.width if unit is None else unit
        self.start = problem.start / unit
        self._centre, self._width = prior.centre / unit, prior.width / unit
        bounds = problem.bounds
        self.bounds = None if bounds is None else (bounds[0] / unit, bounds[1] / unit)

    def parameters(self, unknowns: Array) -> Array:
        """All parameters (p,)."""
        return self.problem.parameters(unknowns * self.unit)

    def residual(self, unknowns: Array) -> Array:
        """Residual of the problem, then of the prior (f,)."""
        plain = self.problem.residual(unknowns * self.unit)
        return np.concatenate((plain, self.noise * ((unknowns - self._centre) / self._width)))

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual with respect to the unknowns."""
        derivatives = self.problem.jacobian(unknowns * self.unit)
        # Each column is contiguous in memory.
        rows = np.empty((unknowns.size, len(derivatives) + unknowns.size))
        np.multiply(derivatives, self.unit, out=rows.T[: len(derivatives)])
        rows[:, len(derivatives) :] = np.diag(self.noise / self._width)
        return rows.T

    def cost(self, parameters: Array) -> float:
        """Sum of squares of the residual for parameters (p,)."""
        residual = self.residual(self.problem.unknowns(parameters) / self.unit)
        return float(residual @ residual)

    def covariances(self) -> tuple[Array, Array]:
        """Covariance (f, f) of the parameters at the start, and the discrepancy in it.

        The discrepancy is NaN if unknown.
        """
        misfit = self.problem.misfit
        jacobian, residual = self.jacobian(self.start), self.residual(self.start)
        variances = np.append(misfit.prior_variances, np.full(self.start.size, self.noise**2))
        covariance = least_squares_covariance(jacobian, residual, variances)
        by_noise = least_squares_covariance(jacobian, residual, np.zeros_like(variances))
        # The rows of the prior belong to no motion.
        motions = np.full(residual.size, -1)
        windows = misfit.row_windows
        motions[: windows.size] = motion_numbers(misfit.windows)[windows]
        discrepancy = discrepancy_between(jacobian, residual, motions, by_noise)
        units = np.outer(self.unit, self.unit)
        return (covariance + np.nan_to_num(discrepancy)) * units, discrepancy * units
