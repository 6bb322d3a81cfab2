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
    """Residual of a problem, then of the prior, for unknowns (f,) in units of the prior's width.

    ``noise``, the standard deviation of one independent sample of the problem's residual, sets the
    weight of the prior.
    """

    def __init__(self, problem: P, prior: Prior, noise: float) -> None:
        self.problem = problem
        self.widths = prior.width
        self.noise = noise
        self.start = problem.start / self.widths
        self._centre = prior.centre / self.widths
        bounds = problem.bounds
        self.bounds = None if bounds is None else (bounds[0] / self.widths, bounds[1] / self.widths)

    def parameters(self, unknowns: Array) -> Array:
        """All parameters (p,)."""
        return self.problem.parameters(unknowns * self.widths)

    def residual(self, unknowns: Array) -> Array:
        """Residual of the problem, then of the prior (f,)."""
        plain = self.problem.residual(unknowns * self.widths)
        return np.concatenate((plain, self.noise * (unknowns - self._centre)))

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual with respect to the unknowns."""
        derivatives = self.problem.jacobian(unknowns * self.widths)
        prior = self.noise * np.eye(unknowns.size)
        return np.concatenate((derivatives * self.widths, prior))

    def cost(self, parameters: Array) -> float:
        """Sum of squares of the residual for parameters (p,)."""
        residual = self.residual(self.problem.unknowns(parameters) / self.widths)
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
        units = np.outer(self.widths, self.widths)
        return (covariance + np.nan_to_num(discrepancy)) * units, discrepancy * units
