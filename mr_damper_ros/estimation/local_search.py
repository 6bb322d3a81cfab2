"""The posterior of parameters, and local search by SciPy's Nelder-Mead and least-squares methods.

Nelder-Mead uses coordinates in which the sum of squares is nearly spherical, derived from the
Jacobian at the start. In these coordinates a simplex in seven dimensions converges in a few hundred
evaluations instead of thousands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, TypeVar

import numpy as np

from mr_damper_ros.estimation.covariance import (
    discrepancy_between,
    least_squares_covariance,
    motion_numbers,
    triangular_factor,
)
from mr_damper_ros.models.formulas import LIMIT
from mr_damper_ros.models.misfit import ChosenParameters
from mr_damper_ros.signals.arrays import Array

HUBER = 1.345
"""Huber's constant, which gives 95 % efficiency for normal noise."""

MOST_STEPS = 300

_LAST_DIGITS = math.sqrt(np.finfo(float).eps)
"""Relative tolerance: half of the digits of double precision."""

MARGIN = 1e-3
"""Smallest distance of a start from a bound, relative to the value. An optimum that is closer,
relative to the width of its prior, counts as being on the bound."""


class Ending(Enum):
    """The reason why a search ended, in words."""

    CONVERGED = "converged"
    STOPPED = "stopped before it converged: this is the best result so far"
    EXHAUSTED = "reached its limit of steps before it converged: this is the best result so far"


class StopRequestedError(Exception):
    """Raised when the caller stops a search; the search keeps its best unknowns so far."""


@dataclass(frozen=True, eq=False)
class Prior:
    """The plausible range of dampers: a mean (``centre``) and a deviation (``width``), (p,)."""

    centre: Array
    width: Array

    def at(self, places: Sequence[int]) -> Prior:
        """The prior (f,) of the parameters at these places."""
        return Prior(self.centre[places], self.width[places])


C = TypeVar("C", bound=ChosenParameters)


class Posterior(Generic[C]):
    """Residual of a problem, then of the prior, for unknowns (f,) in a ``unit``.

    The unit is the width of the prior, or 1 for the unknowns of the problem themselves.

    ``noise``, the standard deviation of one independent sample of the problem's residual, sets the
    weight of the prior.
    """

    def __init__(
        self, problem: C, prior: Prior, noise: float, unit: Array | float | None = None
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


P = TypeVar("P", bound="ChosenParameters | Posterior[Any]")


@dataclass(eq=False)
class LocalSearch(Generic[P]):
    """A problem, its best unknowns so far and the number of evaluations.

    ``should_stop`` is called at every evaluation; if it returns True, StopRequestedError is raised.
    ``exhausted``: whether the latest least-squares search reached its limit of steps.
    """

    problem: P
    best: Array
    should_stop: Callable[[], bool] | None = None
    best_cost: float = math.inf
    evaluations: int = 0
    exhausted: bool = False

    def residual(self, unknowns: Array) -> Array:
        """Evaluate and count the residual (n,) of the problem."""
        if self.should_stop is not None and self.should_stop():
            raise StopRequestedError
        self.evaluations += 1
        return self.problem.residual(unknowns)

    def try_out(self, unknowns: Array) -> float:
        """Evaluate the sum of squares; if it is the lowest so far, the unknowns are the best."""
        residual = self.residual(unknowns)
        with np.errstate(over="ignore"):  # a cost that overflows is never accepted
            cost = float(residual @ residual)
        if cost < self.best_cost:
            self.best, self.best_cost = unknowns, cost
        return cost

    @np.errstate(over="ignore", invalid="ignore")  # a cost that overflows is never accepted
    def nelder_mead(self) -> None:
        """Nelder-Mead from the best unknowns."""
        from scipy import optimize  # imported late: see entry_points

        if math.isinf(self.best_cost):
            self.try_out(self.best)
        centre = self.best
        residual, jacobian = self.problem.residual(centre), self.problem.jacobian(centre)
        noise_power = self.best_cost / residual.size
        axes = _standard_error_axes(jacobian, math.sqrt(noise_power))
        # The simplex extends to the minimum of the linearised problem.
        reach = -(axes.T @ (jacobian.T @ residual)) / noise_power
        reach = np.where(np.abs(reach) < 1.0, np.copysign(1.0, reach), reach)
        simplex = np.vstack((np.zeros(centre.size), np.diag(reach)))
        # The simplex stops at the size of a standard error, near the minimum; least squares
        # locates it exactly.
        optimize.minimize(
            lambda steps: self.try_out(centre + axes @ steps),
            simplex[0],
            method="Nelder-Mead",
            options={
                "initial_simplex": simplex,
                "xatol": 1.0,
                "fatol": noise_power,
                "maxfev": MOST_STEPS * centre.size,
            },
        )

    @np.errstate(over="ignore", invalid="ignore")
    def least_squares(
        self, *, tolerance: float = _LAST_DIGITS, most_steps: int = MOST_STEPS
    ) -> None:
        """Least squares from the best unknowns.

        Without bounds it uses Levenberg-Marquardt (MINPACK). With bounds it uses the trust-region
        method of Branch, Coleman and Li (SIAM J. Scientific Computing 21, 1999), which takes
        several times as long if evaluations are cheap. The search ends when a step reduces the sum
        of squares by less than the relative ``tolerance``.
        """
        from scipy import optimize  # imported late: see entry_points

        if math.isinf(self.best_cost):
            self.try_out(self.best)
        bounds = self.problem.bounds
        if bounds is None:
            found, _, counts, *_ = optimize.leastsq(
                self.residual,
                self.best,
                Dfun=self.problem.jacobian,
                full_output=True,
                ftol=tolerance,
                xtol=_LAST_DIGITS,
                maxfev=most_steps,
            )
            self.exhausted = counts["nfev"] >= most_steps
        elif math.isfinite(self.best_cost):
            result = optimize.least_squares(
                self.residual,
                _inside(self.best, *bounds),
                lambda x: _without_overflow(self.problem.jacobian(x)),
                bounds=bounds,
                x_scale="jac",
                ftol=tolerance,
                xtol=_LAST_DIGITS,
                max_nfev=most_steps,
            )
            found = result.x
            self.exhausted = result.nfev >= most_steps
        else:
            return
        self.try_out(found)


def _without_overflow(jacobian: Array) -> Array:
    """The Jacobian with values that cannot overflow; large ones occur far from any damper."""
    return np.where(np.abs(jacobian) < LIMIT, jacobian, 0.0)


def _inside(values: Array, low: Array, high: Array) -> Array:
    """The values, moved slightly inside where they are on a bound or beyond it."""
    margin = np.minimum(MARGIN * np.maximum(np.abs(values), 1e-6), 0.25 * (high - low))
    return np.clip(values, low + margin, high - margin)


def _standard_error_axes(jacobian: Array, noise: float) -> Array:
    """Axes (p, p) along which a unit step increases the sum of squares by the noise variance.

    Steps along weakly determined directions are limited, so that the simplex does not drift along
    them.
    """
    lengths = np.linalg.norm(jacobian, axis=0)
    safe = np.where(lengths > 0.0, lengths, 1.0)[:, np.newaxis]
    triangular = triangular_factor(jacobian) / safe.T
    _, singular, vt = np.linalg.svd(triangular, full_matrices=False)
    step = noise / np.maximum(singular, 1e-4 * max(float(singular.max()), 1e-300))
    return np.asarray(vt.T * step / safe)
