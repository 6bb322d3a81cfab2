"""Fit of the seven scales of one window: Nelder-Mead or least squares, with covariance.

Nelder-Mead is SciPy's, the method of MATLAB's fminsearch that the thesis uses. A
Levenberg-Marquardt polish then sits on the very minimum and gives the Jacobian, so the
covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from mr_damper_ros.estimation.covariance import least_squares_covariance
from mr_damper_ros.estimation.local_search import LocalSearch, StopRequestedError
from mr_damper_ros.models.sigmoid.scale_misfit import ScaleMisfit, Window
from mr_damper_ros.signals.arrays import Array

CONVERGED = "converged"
"""Message of a fit that came to its end."""

WINDOW_METHODS = ("nelder_mead", "least_squares")

_COLD_STEEPNESS = (2.0, 6.0, 20.0, 60.0)
_COLD_HYSTERESIS = (0.0, -0.2, -0.4)

POOR_START = 0.25
"""Where the start leaves more than this part of the force's variance, others are tried too."""

_ROUGHLY, _FEW_STEPS = 0.01, 20
"""Relative tolerance of the sum of squares, and steps, after which two starts are compared."""

_HOPELESS = 1000.0
"""A start that leaves so many times the sum of squares of the other is not worth these steps."""


@dataclass(frozen=True, eq=False)
class WindowFit:
    """Result of the fit of one window.

    ``scales`` (7,) and their ``covariance`` (7, 7) are in the order of ``COEFFICIENT_NAMES`` (see
    :class:`ScaleMisfit`); ``parameters`` (16,) or (19,) have the shape of the start.
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
    should_stop: Callable[[], bool] | None = None,
) -> WindowFit:
    """Scales of a window, searched from the parameters ``start`` of shape (16,) or (19,).

    A start that leaves more than a quarter of the force's variance competes with the best of a few
    starts read off the data (peak force and peak velocity). ``robust`` bounds the influence of
    outliers (Huber's weights). ``should_stop`` is asked at every evaluation; where it says so, the
    best so far is returned with ``success`` False.

    Raises ValueError for an unknown method or a force that does not change.
    """
    if method not in WINDOW_METHODS:
        raise ValueError(f"method '{method}' is unknown: use one of {', '.join(WINDOW_METHODS)}")
    spread = float(np.std(window.force))
    if spread == 0.0:
        raise ValueError("the force does not change: there is nothing to identify")
    misfit = ScaleMisfit(window, start)
    search = LocalSearch(misfit, misfit.start, should_stop)
    weights = np.ones(window.sample_count)
    message = CONVERGED
    try:
        # "not <=" also holds for a cost that is not a number.
        if not search.try_out(misfit.start) <= POOR_START * spread**2 * window.sample_count:
            _compete(search, misfit, should_stop)
        if method == "nelder_mead":
            search.nelder_mead()
        search.least_squares()
        if robust:
            weights = search.reweighted_least_squares()
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


def _compete(
    search: LocalSearch, misfit: ScaleMisfit, should_stop: Callable[[], bool] | None
) -> None:
    """A few steps from the given start, and from the best read off the data; the better stays.

    Their costs alone would not tell which of them leads to the deeper minimum.
    """
    other = LocalSearch(misfit, misfit.start, should_stop)
    try:
        for candidate in _cold_starts(misfit):
            other.try_out(candidate)
        if search.best_cost < _HOPELESS * other.best_cost < math.inf:
            for each in (search, other):
                each.least_squares(tolerance=_ROUGHLY, most_steps=_FEW_STEPS)
    finally:
        search.take_over(other)


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
