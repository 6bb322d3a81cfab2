"""Fit of the seven scales of one window: Nelder-Mead or least squares, with covariance.

Nelder-Mead is SciPy's, the method of MATLAB's fminsearch that the thesis uses. It searches in
coordinates in which the sum of squares is nearly a sphere (from the Jacobian at the start), where
a simplex of seven dimensions converges in a few hundred evaluations instead of thousands. A
Levenberg-Marquardt polish then sits on the very minimum and gives the Jacobian, so the
covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import leastsq, minimize

from mr_damper_ros.damper.sigmoid import Array
from mr_damper_ros.identification.uncertainty import least_squares_covariance
from mr_damper_ros.identification.window import ScaleMisfit, Window

METHODS = ("nelder_mead", "least_squares")

_COLD_STEEPNESS = (2.0, 6.0, 20.0, 60.0)
_COLD_HYSTERESIS = (0.0, -0.2, -0.4)

_POOR_START = 0.25
"""Where the start leaves more than this part of the force's variance, others are tried too."""

_SIMPLEX_TOLERANCE = 1e-2
"""Nelder-Mead stops where the simplex is this many standard errors wide."""

_FAR = 30.0
"""A search that moved by more standard errors than this starts again with new axes."""

_HUBER = 1.345
"""Huber's constant: 95 % efficiency where the noise is normal after all."""


@dataclass(frozen=True, eq=False)
class WindowFit:
    """Result of the fit of one window.

    ``scales`` (7,) and their ``covariance`` (7, 7) are in the order of ``COEFFICIENT_NAMES`` (see
    :class:`ScaleMisfit`); ``parameters`` (16,) have the shape of the start. ``coefficients`` (7,)
    and ``coefficient_covariance`` (7, 7) hold at ``operating_point`` (peak velocity [m/s],
    current [A]). ``rmse`` [N]; ``nrmse`` = RMSE/std of the force.
    """

    scales: Array
    covariance: Array
    parameters: Array
    coefficients: Array
    coefficient_covariance: Array
    operating_point: tuple[float, float]
    rmse: float
    nrmse: float
    sample_count: int
    method: str
    evaluations: int
    success: bool
    message: str


def fit_window(
    window: Window,
    start: Array,
    *,
    method: str = "nelder_mead",
    robust: bool = False,
    should_stop: Callable[[], bool] | None = None,
) -> WindowFit:
    """Scales of a window, searched from the parameters ``start`` of shape (16,).

    A start that leaves more than a quarter of the force's variance competes with a few starts
    read off the data (peak force and peak velocity). ``robust`` bounds the influence of outliers
    (Huber's weights). ``should_stop`` is asked at every evaluation; where it says so, the best
    so far is returned with ``success`` False.

    Raises ValueError for an unknown method or a force that does not change.
    """
    if method not in METHODS:
        raise ValueError(f"method '{method}' is unknown: use one of {', '.join(METHODS)}")
    spread = float(np.std(window.force))
    if spread == 0.0:
        raise ValueError("the force does not change: there is nothing to identify")
    search = _Search(ScaleMisfit(window, start), should_stop)
    weights = np.ones(window.sample_count)
    message = "converged"
    try:
        search.start(spread)
        if method == "nelder_mead":
            search.nelder_mead()
        search.least_squares(weights)
        if robust:
            weights = search.reweighted_least_squares()
    except _Stopped:
        message = "stopped before it converged: this is the best so far"
    return _result(search, weights, spread, method, message)


def _result(
    search: _Search, weights: Array, spread: float, method: str, message: str
) -> WindowFit:
    misfit, scales = search.misfit, search.best
    window = misfit.window
    residual = misfit.residual(scales)
    covariance = least_squares_covariance(misfit.jacobian(scales), residual, weights)
    to_coefficients = misfit.base_at(window.operating_point)
    if scales[0] * to_coefficients[0] < 0.0:
        # Yield force and steepness may change sign together: the positive pair is meant.
        to_coefficients[:2] *= -1.0
    rmse = math.sqrt(float(np.mean(residual**2)))
    return WindowFit(
        scales=scales,
        covariance=covariance,
        parameters=misfit.parameters(scales),
        coefficients=scales * to_coefficients,
        coefficient_covariance=covariance * np.outer(to_coefficients, to_coefficients),
        operating_point=window.operating_point,
        rmse=rmse,
        nrmse=rmse / spread,
        sample_count=window.sample_count,
        method=method,
        evaluations=search.evaluations,
        success=message == "converged",
        message=message,
    )


class _Stopped(Exception):
    """The caller wants no further evaluation."""


class _Search:
    """A misfit with the best scales found so far and the number of evaluations."""

    def __init__(self, misfit: ScaleMisfit, should_stop: Callable[[], bool] | None) -> None:
        self.misfit = misfit
        self.evaluations = 0
        self.best = misfit.start
        self.best_cost = math.inf
        self._should_stop = should_stop

    def residual(self, scales: Array) -> Array:
        if self._should_stop is not None and self._should_stop():
            raise _Stopped
        self.evaluations += 1
        return self.misfit.residual(scales)

    def cost(self, scales: Array) -> float:
        residual = self.residual(scales)
        cost = float(residual @ residual)
        if cost < self.best_cost:
            self.best, self.best_cost = scales, cost
        return cost

    def start(self, spread: float) -> None:
        """Start from the given scales, or from better ones read off the data."""
        variance = spread**2 * self.misfit.window.sample_count
        # "not <=" also holds for a cost that is not a number.
        if not self.cost(self.misfit.start) <= _POOR_START * variance:
            for candidate in _cold_starts(self.misfit):
                self.cost(candidate)

    def nelder_mead(self) -> None:
        n = self.misfit.window.sample_count
        for _ in range(5):
            centre, before = self.best, self.best_cost
            noise = math.sqrt(before / n)
            axes = _standard_error_axes(self.misfit.jacobian(centre), noise)
            size = np.sum(np.abs(axes), axis=0) > 0.0
            simplex = np.vstack((np.zeros(centre.size), np.diag(np.where(size, 1.0, 1e-3))))
            result = minimize(
                lambda z, centre=centre, axes=axes: self.cost(centre + axes @ z),
                simplex[0],
                method="Nelder-Mead",
                options={
                    "initial_simplex": simplex,
                    "xatol": _SIMPLEX_TOLERANCE,
                    "fatol": 1e-3 * noise**2,
                    "maxfev": 2000,
                },
            )
            if np.max(np.abs(result.x)) < _FAR:
                return

    def least_squares(self, weights: Array) -> None:
        root = np.sqrt(weights)

        def residual(scales: Array) -> Array:
            return self.residual(scales) * root

        def jacobian(scales: Array) -> Array:
            return self.misfit.jacobian(scales) * root[:, np.newaxis]

        found, *_ = leastsq(residual, self.best, Dfun=jacobian, full_output=True, maxfev=200)
        if np.all(np.isfinite(found)):
            self.best = found

    def reweighted_least_squares(self) -> Array:
        """Huber's weights, found with the scales by a few rounds of reweighting."""
        weights = np.ones(self.misfit.window.sample_count)
        for _ in range(10):
            residual = self.misfit.residual(self.best)
            deviation = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
            if deviation == 0.0:
                break
            bound = _HUBER * deviation
            updated = bound / np.maximum(np.abs(residual), bound)
            if np.max(np.abs(updated - weights)) < 1e-3:
                break
            weights = updated
            self.least_squares(weights)
        return weights


def _cold_starts(misfit: ScaleMisfit) -> list[Array]:
    """Scales read off the data: a yield force near the peaks, some steepness and hysteresis."""
    window = misfit.window
    top, bottom = float(window.force.max()), float(window.force.min())
    top_speed = float(np.max(np.abs(window.motion.velocity)))
    base = misfit.base_at(window.operating_point)
    base = np.where(base == 0.0, 1.0, base)
    return [
        np.array(
            [0.4 * (top - bottom), steepness / top_speed, 0.2 / top_speed, 0.2 / top_speed]
            + [hysteresis * top_speed, 0.0, -0.5 * (top + bottom)]
        )
        / base
        for steepness, hysteresis in product(_COLD_STEEPNESS, _COLD_HYSTERESIS)
    ]


def _standard_error_axes(jacobian: Array, noise: float) -> Array:
    """Axes (7, 7) in which a step of 1 raises the sum of squares by the noise variance.

    Directions that the samples hardly determine are cut short, so that a simplex does not wander
    off along them.
    """
    lengths = np.linalg.norm(jacobian, axis=0)
    safe = np.where(lengths > 0.0, lengths, 1.0)
    _, singular, vt = np.linalg.svd(jacobian / safe, full_matrices=False)
    step = noise / np.maximum(singular, 1e-4 * singular[0])
    return np.asarray((vt.T * step) / safe[:, np.newaxis])

