"""Local search of a least-squares problem: Nelder-Mead and least squares, both SciPy's.

Nelder-Mead searches in coordinates in which the sum of squares is nearly a sphere, taken from the
Jacobian at its start; there a simplex of seven dimensions converges in a few hundred evaluations
instead of thousands.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum
from typing import Generic, Protocol, TypeVar

import numpy as np

from mr_damper_ros.estimation.covariance import triangular_factor
from mr_damper_ros.signals.arrays import Array

_SIMPLEX_TOLERANCE = 1.0
"""Nelder-Mead stops where the simplex is this many standard errors wide: in the valley of the
minimum, at whose bottom least squares then ends."""

_FAR = 30.0
"""A search that moved by more standard errors than this starts again with new axes."""

_MOST_RESTARTS = 5

_HUBER = 1.345
"""Huber's constant: 95 % efficiency where the noise is normal after all."""

MOST_STEPS = 300

_MINPACK_LIMIT, _TRUST_REGION_LIMIT = 5, 0
"""What the two solvers say where they end at their limit of evaluations."""

_LAST_DIGITS = 1.5e-8
"""Relative tolerance of MINPACK: half of the digits there are."""

_BEYOND = 1e100
"""Derivatives from here on overflow where they are squared and summed."""

_MARGIN = 1e-3
"""Distance from a bound at which a search starts at least, relative to the value."""


class Ending(Enum):
    """How a search ended, in words."""

    CONVERGED = "converged"
    STOPPED = "stopped before it converged: this is the best so far"
    EXHAUSTED = "ended at its limit of steps before it converged: this is the best so far"


class Problem(Protocol):
    """Something to fit: residual (n,) and its Jacobian (n, p) for unknowns (p,)."""

    @property
    def bounds(self) -> tuple[Array, Array] | None:
        """Lower and upper bounds (p,) of the unknowns, None where there are none."""

    def residual(self, unknowns: Array) -> Array:
        """Model minus measurement, shape (n,)."""

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual, shape (n, p)."""


class StopRequestedError(Exception):
    """The caller wants no further evaluation; the best so far stays in the search."""


P = TypeVar("P", bound=Problem)
Q = TypeVar("Q", bound=Problem)


class LocalSearch(Generic[P]):
    """A problem with the best unknowns found so far and the number of evaluations.

    ``should_stop`` is asked at every evaluation; where it says so, StopRequestedError is raised.
    ``exhausted``: whether the latest least squares ended at its limit of steps.
    """

    def __init__(
        self, problem: P, start: Array, should_stop: Callable[[], bool] | None = None
    ) -> None:
        self.problem = problem
        self.best = start
        self.best_cost = math.inf
        self.evaluations = 0
        self.exhausted = False
        self._should_stop = should_stop

    def of(self, problem: Q, start: Array) -> LocalSearch[Q]:
        """A search of another problem, that may be stopped like this one; it counts on its own."""
        return LocalSearch(problem, start, self._should_stop)

    def residual(self, unknowns: Array) -> Array:
        """Residual (n,) of the problem, counted."""
        if self._should_stop is not None and self._should_stop():
            raise StopRequestedError
        self.evaluations += 1
        return self.problem.residual(unknowns)

    def try_out(self, unknowns: Array) -> float:
        """Sum of squares; becomes the best if it is."""
        residual = self.residual(unknowns)
        with np.errstate(over="ignore"):  # beyond all numbers is never the best
            cost = float(residual @ residual)
        if cost < self.best_cost:
            self.best, self.best_cost = unknowns, cost
        return cost

    def nelder_mead(self) -> None:
        """Nelder-Mead from the best so far, with new axes as long as it moves far."""
        from scipy import optimize  # here: see mr_damper_ros.entry_points

        if math.isinf(self.best_cost):
            self.try_out(self.best)
        for _ in range(_MOST_RESTARTS):
            centre = self.best
            residual = self.problem.residual(centre)
            jacobian = self.problem.jacobian(centre)
            noise_power = self.best_cost / residual.size
            axes = _standard_error_axes(jacobian, math.sqrt(noise_power))
            # The simplex spans the way to where the linear problem has its minimum.
            reach = -(axes.T @ (jacobian.T @ residual)) / noise_power
            reach = np.where(np.abs(reach) < 1.0, np.copysign(1.0, reach), reach)
            simplex = np.vstack((np.zeros(centre.size), np.diag(reach)))

            def cost(steps: Array, centre: Array = centre, axes: Array = axes) -> float:
                return self.try_out(centre + axes @ steps)

            result = optimize.minimize(
                cost,
                simplex[0],
                method="Nelder-Mead",
                options={
                    "initial_simplex": simplex,
                    "xatol": _SIMPLEX_TOLERANCE,
                    "fatol": _SIMPLEX_TOLERANCE * noise_power,
                    "maxfev": 300 * centre.size,
                },
            )
            if np.max(np.abs(result.x)) < _FAR:
                return

    def least_squares(
        self,
        weights: Array | None = None,
        tolerance: float = _LAST_DIGITS,
        most_steps: int = MOST_STEPS,
    ) -> None:
        """Least squares from the best so far; ``weights`` (n,) on the squares.

        Levenberg-Marquardt (MINPACK) where the unknowns have no bounds; else the trust-region
        method that keeps them (Branch, Coleman and Li, SIAM J. Scientific Computing 21, 1999),
        which takes several times as long where evaluations are cheap. It ends where a step lowers
        the sum of squares by less than the part ``tolerance`` of it.
        """
        root = None if weights is None else np.sqrt(weights)

        def residual(unknowns: Array) -> Array:
            plain = self.residual(unknowns)
            return plain if root is None else plain * root

        def jacobian(unknowns: Array) -> Array:
            plain = self.problem.jacobian(unknowns)
            return plain if root is None else plain * root[:, np.newaxis]

        from scipy import optimize  # here: see mr_damper_ros.entry_points

        if weights is None and math.isinf(self.best_cost):
            self.try_out(self.best)
        bounds = self.problem.bounds
        if bounds is None:
            found, *_, status = optimize.leastsq(
                residual,
                self.best,
                Dfun=jacobian,
                full_output=True,
                ftol=tolerance,
                xtol=_LAST_DIGITS,
                maxfev=most_steps,
            )
            self.exhausted = status == _MINPACK_LIMIT
        elif math.isfinite(self.best_cost):
            result = optimize.least_squares(
                residual,
                _inside(self.best, *bounds),
                lambda x: _without_overflow(jacobian(x)),
                bounds=bounds,
                x_scale="jac",
                ftol=tolerance,
                xtol=_LAST_DIGITS,
                max_nfev=most_steps,
            )
            found = result.x
            self.exhausted = result.status == _TRUST_REGION_LIMIT
        else:
            return
        if weights is not None:
            self.best = found
            return
        self.try_out(found)

    def reweighted_least_squares(self) -> Array:
        """Huber's weights (n,), found with the unknowns by a few rounds of reweighting."""
        weights = np.ones(self.problem.residual(self.best).size)
        for _ in range(10):
            residual = self.problem.residual(self.best)
            deviation = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
            bound = _HUBER * deviation
            if bound == 0.0:
                break
            updated = bound / np.maximum(np.abs(residual), bound)
            if np.max(np.abs(updated - weights)) < 1e-3:
                break
            weights = updated
            self.least_squares(weights)
        return weights


def _without_overflow(jacobian: Array) -> Array:
    """The Jacobian without what a set far from any damper overflows by: it is left alone."""
    return np.where(np.abs(jacobian) < _BEYOND, jacobian, 0.0)


def _inside(values: Array, low: Array, high: Array) -> Array:
    """The values, those on a bound or beyond moved a little inside, where a search can start."""
    margin = np.minimum(_MARGIN * np.maximum(np.abs(values), 1e-6), 0.25 * (high - low))
    return np.clip(values, low + margin, high - margin)


def _standard_error_axes(jacobian: Array, noise: float) -> Array:
    """Axes (p, p) along which a step of 1 raises the sum of squares by the noise variance.

    Directions that the samples hardly determine are cut short, so that a simplex does not wander
    off along them.
    """
    lengths = np.linalg.norm(jacobian, axis=0)
    safe = np.where(lengths > 0.0, lengths, 1.0)[:, np.newaxis]
    triangular = triangular_factor(jacobian) / safe.T
    _, singular, vt = np.linalg.svd(triangular, full_matrices=False)
    step = noise / np.maximum(singular, 1e-4 * max(float(singular.max()), 1e-300))
    return np.asarray(vt.T * step / safe)
