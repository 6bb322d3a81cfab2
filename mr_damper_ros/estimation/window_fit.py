"""Fit of what one window determines: Nelder-Mead or least squares, with covariance.

Nelder-Mead is SciPy's, the method of MATLAB's fminsearch that the thesis uses. A least-squares
polish then sits on the very minimum and gives the Jacobian, so the covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import without_negative_variance
from mr_damper_ros.estimation.local_search import Ending, LocalSearch, StopRequestedError
from mr_damper_ros.estimation.repeatability import error_covariances, samples_per_cycle
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.operating_points import WindowProblem
from mr_damper_ros.signals.arrays import Array

WINDOW_METHODS = ("nelder_mead", "least_squares")

POOR_START = 0.25
"""Where the start leaves more than this part of the force's variance, others are tried too."""

_HOPELESS = 1000.0
"""A start that leaves so many times the sum of squares of the other is not worth polishing."""


@dataclass(frozen=True, eq=False)
class WindowFit:
    """Result of the fit of one window.

    ``scales`` (f,) are the unknowns of the model's window problem, with their ``covariance``
    (f, f): the seven scales of the sigmoid law, the parameters that one run determines of another.
    It is that of their repeatability from window to window of the same motion; ``discrepancy``
    (f, f), where it is known, is that of what another motion or law would say, see
    :mod:`repeatability`.
    ``parameters`` (p,) are all of them. ``coefficients`` (c,) and their covariances
    ``coefficient_covariance`` and ``coefficient_discrepancy`` (c, c) hold at ``operating_point``
    (peak velocity [m/s], current [A]); they are empty for a model without. ``rmse`` [N] over the
    ``sample_count`` samples whose past is known; ``nrmse`` = RMSE/std of the force.
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
    discrepancy: Array | None = None
    coefficient_discrepancy: Array | None = None

    @property
    def whole_covariance(self) -> Array:
        """Covariance (f, f) by both kinds of error, as far as they are known."""
        if self.discrepancy is None:
            return self.covariance
        return np.asarray(self.covariance + self.discrepancy)


def fit_window(
    model: Model,
    window: Window,
    start: Array,
    *,
    method: str = "nelder_mead",
    robust: bool = False,
    should_stop: Callable[[], bool] | None = None,
) -> WindowFit:
    """Fit what of a model one window determines, from the parameters ``start`` of shape (p,).

    A start that leaves more than a quarter of the force's variance competes with those that the
    model reads off the window. ``robust`` bounds the influence of outliers (Huber's weights).
    ``should_stop`` is asked at every evaluation; where it says so, the best so far is returned with
    ``success`` False.

    Raises DataError for a force that does not change, ValueError for an unknown method.
    """
    if method not in WINDOW_METHODS:
        raise ValueError(f"method '{method}' is unknown: use one of {', '.join(WINDOW_METHODS)}")
    spread = float(np.std(window.force))
    if spread == 0.0:
        raise DataError("the force does not change: there is nothing to identify")
    contest = _Contest(model, window, should_stop)
    weights = np.ones(window.sample_count)
    ending = Ending.CONVERGED
    try:
        search = contest.enter(start)
        # "not <=" also holds for a cost that is not a number.
        if not _mean_square(search) <= POOR_START * spread**2:
            search = contest.settle()
        effort = search.problem.effort
        if method == "nelder_mead":
            search.nelder_mead()
        search.least_squares(tolerance=effort.tolerance, most_steps=effort.most_steps)
        if search.exhausted:
            ending = Ending.EXHAUSTED
        if robust:
            weights = search.reweighted_least_squares()
    except StopRequestedError:
        ending = Ending.STOPPED
        search = contest.best
    problem, unknowns = search.problem, search.best
    settled = problem.settled
    jacobian, residual = problem.jacobian(unknowns), problem.residual(unknowns)
    cycle = samples_per_cycle(window)
    errors = error_covariances(jacobian[settled], residual[settled], cycle, weights[settled])
    return fit_of(
        problem,
        unknowns,
        errors.repeatability,
        discrepancy=errors.discrepancy,
        method=method,
        evaluations=contest.evaluations,
        ending=ending,
    )


def fit_of(
    problem: WindowProblem,
    unknowns: Array,
    covariance: Array,
    *,
    method: str,
    evaluations: int,
    ending: Ending = Ending.CONVERGED,
    discrepancy: Array | None = None,
) -> WindowFit:
    """Unknowns (f,) and their covariances (f, f), however found, as the fit of a window."""
    window = problem.window
    residual = problem.residual(unknowns)[problem.settled]
    rmse = math.sqrt(float(np.mean(residual**2)))
    covariance = without_negative_variance(covariance)
    coefficients, coefficient_covariance = problem.coefficients(unknowns, covariance)
    by_discrepancy = None
    if discrepancy is not None:
        discrepancy = without_negative_variance(discrepancy)
        _, by_discrepancy = problem.coefficients(unknowns, discrepancy)
    return WindowFit(
        scales=unknowns,
        covariance=covariance,
        parameters=problem.parameters(unknowns),
        coefficients=coefficients,
        coefficient_covariance=coefficient_covariance,
        operating_point=window.operating_point,
        rmse=rmse,
        nrmse=rmse / float(np.std(window.force)),
        sample_count=window.sample_count,
        method=method,
        evaluations=evaluations,
        success=ending is Ending.CONVERGED,
        message=ending.value,
        discrepancy=discrepancy,
        coefficient_discrepancy=by_discrepancy,
    )


class _Contest:
    """Searches from several starts, of which the best goes on."""

    def __init__(
        self, model: Model, window: Window, should_stop: Callable[[], bool] | None
    ) -> None:
        self._model = model
        self._window = window
        self._should_stop = should_stop
        self._searches: list[LocalSearch[WindowProblem]] = []

    def enter(self, parameters: Array) -> LocalSearch[WindowProblem]:
        """A search from parameters (p,), its start tried out."""
        return self._enter(self._model.window_problem(self._window, parameters))

    def _enter(self, problem: WindowProblem) -> LocalSearch[WindowProblem]:
        search = LocalSearch(problem, problem.start, self._should_stop)
        self._searches.append(search)
        search.try_out(problem.start)
        return search

    def settle(self) -> LocalSearch[WindowProblem]:
        """A few steps from the first start and from the best read off the window; the better one.

        Their costs alone would not tell which of them leads to the deepest minimum.
        """
        first = self._searches[0]
        cold = [self._enter(first.problem.restarted(s)) for s in first.problem.cold_starts()]
        effort = first.problem.effort
        cold = sorted(cold, key=_mean_square)[: effort.polished_starts]
        hopeful = [
            search
            for search in (first, *cold)
            if _mean_square(search) < _HOPELESS * _mean_square(cold[0])
        ]
        if len(hopeful) > 1:
            for search in hopeful:
                search.least_squares(
                    tolerance=effort.rough_tolerance, most_steps=effort.rough_steps
                )
        return self.best

    @property
    def best(self) -> LocalSearch[WindowProblem]:
        """The search that has come lowest."""
        return min(self._searches, key=_mean_square)

    @property
    def evaluations(self) -> int:
        """Of the force, in all searches."""
        return sum(each.evaluations + each.problem.differences for each in self._searches)


def _mean_square(search: LocalSearch[WindowProblem]) -> float:
    """Mean square residual [N²] over the samples that have one."""
    return search.best_cost / max(int(np.count_nonzero(search.problem.settled)), 1)
