"""Fit of the seven scales of one window: Nelder-Mead or least squares, with covariance.

Nelder-Mead is SciPy's, the method of MATLAB's fminsearch that the thesis uses. A
Levenberg-Marquardt polish then sits on the very minimum and gives the Jacobian, so the
covariance.

A window of general motion may leave scales open that another determines. Where the start has been
identified before, it can serve as a prior, so that such scales do not wander: the fit is then the
most probable one (maximum a posteriori), with correlated samples counted once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from mr_damper_ros.damper.sigmoid import Array
from mr_damper_ros.identification.search import LocalSearch, StopRequestedError
from mr_damper_ros.identification.uncertainty import correlation_length, least_squares_covariance
from mr_damper_ros.identification.window import ScaleMisfit, Window

CONVERGED = "converged"
"""Message of a fit that came to its end."""

METHODS = ("nelder_mead", "least_squares")

_COLD_STEEPNESS = (2.0, 6.0, 20.0, 60.0)
_COLD_HYSTERESIS = (0.0, -0.2, -0.4)

_SMALLEST_SHARE = 0.1
"""A scale near zero is expected to change by what changes the force by this part of it."""

POOR_START = 0.25
"""Where the start leaves more than this part of the force's variance, others are tried too."""


@dataclass(frozen=True, eq=False)
class WindowFit:
    """Result of the fit of one window.

    ``scales`` (7,) and their ``covariance`` (7, 7) are in the order of ``COEFFICIENT_NAMES`` (see
    :class:`ScaleMisfit`); ``parameters`` (16,) or (20,) have the shape of the start.
    ``coefficients`` (7,) and ``coefficient_covariance`` (7, 7) hold at ``operating_point`` (peak
    velocity [m/s], current [A]). ``rmse`` [N]; ``nrmse`` = RMSE/std of the force.
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
    start_is_known: bool = False,
    should_stop: Callable[[], bool] | None = None,
) -> WindowFit:
    """Scales of a window, searched from the parameters ``start`` of shape (16,) or (20,).

    A start that leaves more than a quarter of the force's variance competes with a few starts
    read off the data (peak force and peak velocity). ``robust`` bounds the influence of outliers
    (Huber's weights). ``start_is_known``: the start has been identified before, and each scale is
    expected to be what it was within its own size. The covariance is that of the window alone.
    ``should_stop`` is asked at every evaluation; where it says so, the best
    so far is returned with ``success`` False.

    Raises ValueError for an unknown method or a force that does not change.
    """
    if method not in METHODS:
        raise ValueError(f"method '{method}' is unknown: use one of {', '.join(METHODS)}")
    spread = float(np.std(window.force))
    if spread == 0.0:
        raise ValueError("the force does not change: there is nothing to identify")
    misfit = ScaleMisfit(window, start)
    search = LocalSearch(misfit, misfit.start, should_stop)
    weights = np.ones(window.sample_count)
    message = CONVERGED
    try:
        _start(search, misfit, spread)
        if method == "nelder_mead":
            search.nelder_mead()
        search.least_squares()
        if start_is_known:
            search = _with_prior(search, misfit, should_stop)
        if robust:
            weights = search.reweighted_least_squares()[: window.sample_count]
    except StopRequestedError:
        message = "stopped before it converged: this is the best so far"
    return _result(misfit, search, weights, spread, method, message)


def _result(
    misfit: ScaleMisfit,
    search: LocalSearch,
    weights: Array,
    spread: float,
    method: str,
    message: str,
) -> WindowFit:
    scales = search.best
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
        success=message == CONVERGED,
        message=message,
    )


def _start(search: LocalSearch, misfit: ScaleMisfit, spread: float) -> None:
    """Start from the given scales, or from better ones read off the data."""
    cost = search.try_out(misfit.start)
    # "not <=" also holds for a cost that is not a number.
    if not cost <= POOR_START * spread**2 * misfit.window.sample_count:
        for candidate in _cold_starts(misfit):
            search.try_out(candidate)


def _with_prior(
    search: LocalSearch, misfit: ScaleMisfit, should_stop: Callable[[], bool] | None
) -> LocalSearch:
    """The search, gone on with the start as a prior; raises StopRequestedError."""
    residual = misfit.residual(search.best)
    # Correlated samples count once: so much less do they weigh against the prior.
    noise = math.sqrt(float(np.mean(residual**2)) * max(correlation_length(residual), 1))
    effect = np.sqrt(np.mean(misfit.jacobian(misfit.start) ** 2, axis=0))
    power = math.sqrt(float(np.mean(misfit.window.force**2)))
    smallest = _SMALLEST_SHARE * power / np.where(effect > 0.0, effect, np.inf)
    deviations = np.maximum(np.abs(misfit.start), smallest)
    safe = np.where(deviations > 0.0, deviations, 1.0)
    found = LocalSearch(_Expected(misfit, noise / safe), search.best, should_stop)
    found.evaluations = search.evaluations
    for scales in (search.best, misfit.start):
        found.try_out(scales)
    found.least_squares()
    return found


class _Expected:
    """A misfit and, in the same unit, how far the scales are from where they are expected."""

    def __init__(self, misfit: ScaleMisfit, weights: Array) -> None:
        """``weights`` (7,): residual [N] of a scale that is off by 1."""
        self._misfit = misfit
        self._weights = weights

    def residual(self, scales: Array) -> Array:
        off = self._weights * (scales - self._misfit.start)
        return np.concatenate((self._misfit.residual(scales), off))

    def jacobian(self, scales: Array) -> Array:
        return np.concatenate((self._misfit.jacobian(scales), np.diag(self._weights)))


def _cold_starts(misfit: ScaleMisfit) -> list[Array]:
    """Scales read off the data: a yield force near the peaks, some steepness and hysteresis."""
    window = misfit.window
    top, bottom = float(window.force.max()), float(window.force.min())
    top_speed = float(np.max(np.abs(window.motion.velocity)))
    base = misfit.base_at(window.operating_point)
    base = np.where(base == 0.0, 1.0, base)
    return [
        np.array(
            [
                *(0.4 * (top - bottom), steepness / top_speed, 0.2 / top_speed),
                *(0.2 / top_speed, hysteresis * top_speed, 0.0, -0.5 * (top + bottom)),
            ]
        )
        / base
        for steepness, hysteresis in product(_COLD_STEEPNESS, _COLD_HYSTERESIS)
    ]
