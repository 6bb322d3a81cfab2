"""Fit of the unknowns that one window determines, alone or with the running set as prior.

Nelder-Mead is SciPy's, the method of MATLAB's fminsearch that the thesis uses. Least squares then
refines the minimum and gives the Jacobian for the covariance.

In a steady sine a window determines its unknowns to a fraction of a percent. In random motion a
window may contain only two strokes, and the model error is correlated over much of the window. Some
combinations of the unknowns are then practically undetermined, and so is an unknown with little
effect in the window, such as the viscous slope of a direction in which the motion is slow. A fit of
the window alone would give them arbitrary values. The fit is therefore the most probable set given
the window and the running set, so that they keep their values. The samples are weighted by the
residual of the best fit and by their correlation length. The prior allows changes of the unknowns
as large as a damper changes from window to window.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import (
    ErrorCovariances,
    correlation_length,
    error_covariances,
    normal_inverse,
    samples_per_cycle,
    without_negative_variance,
)
from mr_damper_ros.estimation.local_search import Ending, LocalSearch, StopRequestedError
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import WindowProblem
from mr_damper_ros.signals.arrays import Array

WINDOW_METHODS = ("nelder_mead", "least_squares")

POOR_START = 0.25
"""Further starts are tried if the start's mean square residual exceeds this part of the
variance."""

_SKIPPED_COST = 1000.0
"""A start is not refined if its sum of squares exceeds the best start's by this factor."""

_CONTRADICTED = 1e-3
"""Significance level below which a change contradicts the running set."""

_WORSE_RATIO = 1.25
"""A window with a sine also contradicts the running set if the prior increases its residual by this
factor."""

_MOST_DOUBLINGS = 10

DRIFT_PER_WINDOW = 0.03
"""Standard deviation [1] of the relative change of force between two windows, for each unknown.

Heating changes the force by less (thesis: 26 % in ten minutes). After a sudden change, when the
window contradicts the running set, larger changes are allowed.
"""


@dataclass(frozen=True, eq=False)
class WindowPrior:
    """The prior of a window: the running set with parameters (p,).

    ``fastest`` [m/s] is the largest peak velocity of its range, infinite if unknown. The effect of
    an unknown on the force is evaluated in the window, and in a sine of this peak velocity.
    """

    parameters: Array
    fastest: float = math.inf


@dataclass(frozen=True, eq=False)
class WindowFit:
    """Result of the fit of one window.

    ``scales`` (f,) are the unknowns of the model's window problem: the seven scales of the sigmoid
    law, or for another law the parameters that one run determines. Their ``covariance`` (f, f)
    describes the scatter between windows of the same motion, and ``discrepancy`` (f, f) the model
    error, None if unknown (see :mod:`covariance`). ``parameters`` (p,) are all parameters.
    ``coefficients`` (c,) and their covariances ``coefficient_covariance`` and
    ``coefficient_discrepancy`` (c, c) hold at ``operating_point`` (peak velocity [m/s], current
    [A]); they are empty for a model without coefficients. ``rmse`` [N] covers the ``sample_count``
    samples with a known past; ``nrmse`` = RMSE/std of the force.
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
        """Covariance (f, f) of both kinds of error together, without an unknown discrepancy."""
        if self.discrepancy is None:
            return self.covariance
        return np.asarray(self.covariance + self.discrepancy)

    @property
    def coefficient_errors(self) -> Array:
        """Covariance (c, c) of the coefficients from both kinds of error, as far as known."""
        if self.coefficient_discrepancy is None:
            return self.coefficient_covariance
        return np.asarray(self.coefficient_covariance + self.coefficient_discrepancy)


def fit_window(
    model: Model,
    window: Window,
    start: Array,
    *,
    method: str = "nelder_mead",
    robust: bool = False,
    prior: WindowPrior | None = None,
    tolerance: float | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> WindowFit:
    """Fit the unknowns that one window determines, from the parameters ``start`` of shape (p,).

    If the mean square residual of the start exceeds a quarter of the force variance, starts that
    the model derives from the window are also tried. ``robust`` limits the influence of outliers
    (Huber's weights). ``prior`` adds a prior to the samples. It must agree with the start in all
    parameters that a window does not determine. If the window determines the unknowns, the prior
    has little effect. ``tolerance``: relative decrease of the sum of squares at which the search
    ends (None: the model's value). ``should_stop`` is called at every evaluation; if it returns
    True, the best fit so far is returned with ``success`` False.

    Raises DataError for a constant force, ValueError for an unknown method.
    """
    if method not in WINDOW_METHODS:
        raise ValueError(f"method '{method}' is unknown: use one of {', '.join(WINDOW_METHODS)}")
    spread = float(np.std(window.force))
    if spread == 0.0:
        raise DataError("the force does not change: there is nothing to identify")
    contest = _StartSelection(model, window, should_stop)
    cycle = samples_per_cycle(window)
    weights = np.ones(window.sample_count)
    with_prior: _PriorProblem | None = None
    ending = Ending.CONVERGED
    try:
        search = contest.enter(start)
        # "not <=" is also true for a NaN cost.
        if not _mean_square(search) <= POOR_START * spread**2:
            search = contest.settle()
        problem, effort = search.problem, model.effort
        if method == "nelder_mead":
            search.nelder_mead()
        if prior is not None:
            with_prior = _PriorProblem.of(model, window, prior, cycle)
        if with_prior is None:
            search.least_squares(
                tolerance=tolerance or effort.tolerance, most_steps=effort.most_steps
            )
            exhausted, unknowns = search.exhausted, search.best
            if robust:
                weights = search.reweighted_least_squares()
                unknowns = search.best
        else:
            unknowns, exhausted = with_prior.most_probable(search, robust=robust)
        if exhausted:
            ending = Ending.EXHAUSTED
    except StopRequestedError:
        ending = Ending.STOPPED
        problem, unknowns, with_prior = contest.best.problem, contest.best.best, None
    if with_prior is not None:
        problem, errors = with_prior.problem, with_prior.errors_at(unknowns)
    else:
        settled = problem.settled
        jacobian, residual = problem.jacobian(unknowns), problem.residual(unknowns)
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
    """Make the fit of a window from unknowns (f,) and their covariances (f, f)."""
    window = problem.window
    residual = problem.residual(unknowns)[problem.settled]
    rmse = math.sqrt(float(np.mean(residual**2)))
    covariance = without_negative_variance(covariance)
    coefficients, gradient = problem.coefficients(unknowns)
    by_discrepancy = None
    if discrepancy is not None:
        discrepancy = without_negative_variance(discrepancy)
        by_discrepancy = gradient @ discrepancy @ gradient.T
    return WindowFit(
        scales=unknowns,
        covariance=covariance,
        parameters=problem.parameters(unknowns),
        coefficients=coefficients,
        coefficient_covariance=gradient @ covariance @ gradient.T,
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


class _StartSelection:
    """Searches from several starts; the best one continues."""

    def __init__(
        self, model: Model, window: Window, should_stop: Callable[[], bool] | None
    ) -> None:
        self._model = model
        self._window = window
        self._should_stop = should_stop
        self._searches: list[LocalSearch[WindowProblem]] = []

    def enter(self, parameters: Array) -> LocalSearch[WindowProblem]:
        """Add a search from parameters (p,), and evaluate its start."""
        return self._enter(WindowProblem(self._model, self._window, parameters))

    def _enter(self, problem: WindowProblem) -> LocalSearch[WindowProblem]:
        search = LocalSearch(problem, problem.start, self._should_stop)
        self._searches.append(search)
        search.try_out(problem.start)
        return search

    def settle(self) -> LocalSearch[WindowProblem]:
        """Refine the first start and the best window-based starts for a few steps; return the best.

        The costs of the starts alone do not show which of them leads to the lowest minimum.
        """
        first = self._searches[0]
        cold = [self._enter(first.problem.restarted(s)) for s in first.problem.cold_starts()]
        effort = self._model.effort
        cold = sorted(cold, key=_mean_square)[: effort.polished_starts]
        hopeful = [
            search
            for search in (first, *cold)
            if _mean_square(search) < _SKIPPED_COST * _mean_square(cold[0])
        ]
        if len(hopeful) > 1:
            for search in hopeful:
                search.least_squares(
                    tolerance=effort.rough_tolerance, most_steps=effort.rough_steps
                )
        return self.best

    @property
    def best(self) -> LocalSearch[WindowProblem]:
        """The search with the lowest mean square."""
        return min(self._searches, key=_mean_square)

    @property
    def evaluations(self) -> int:
        """Number of evaluations of the force in all searches."""
        return sum(each.evaluations + each.problem.differences for each in self._searches)


def _mean_square(search: LocalSearch[WindowProblem]) -> float:
    """Mean square residual [N²] over the settled samples."""
    return search.best_cost / max(int(np.count_nonzero(search.problem.settled)), 1)


class _PriorProblem:
    """Residual of a window, then of the prior, in the unit of the samples' noise.

    ``width`` (f,): prior standard deviation of the unknowns; ``noise`` [N]: standard deviation of
    white noise that gives the same uncertainty of the unknowns.
    """

    def __init__(self, problem: WindowProblem, width: Array, cycle: float) -> None:
        self.bounds = problem.bounds
        self.problem = problem
        self._known = problem.start
        self._width = width
        self._cycle = cycle
        self._noise = 0.0

    @classmethod
    def of(
        cls, model: Model, window: Window, prior: WindowPrior, cycle: float
    ) -> _PriorProblem | None:
        """The weighted problem; None if the force of the running set is zero."""
        running = WindowProblem(model, window, prior.parameters)
        width = running.usual_change(DRIFT_PER_WINDOW, prior.fastest)
        return cls(running, width, cycle) if np.isfinite(width).all() else None

    def residual(self, unknowns: Array) -> Array:
        """Residual of the samples [N] (n,), then of the prior (f,)."""
        apart = (unknowns - self._known) / self._width
        return np.concatenate((self.problem.residual(unknowns), self._noise * apart))

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives (n + f, f) of the residual."""
        return np.vstack((self.problem.jacobian(unknowns), np.diag(self._noise / self._width)))

    def most_probable(
        self, search: LocalSearch[WindowProblem], *, robust: bool
    ) -> tuple[Array, bool]:
        """Unknowns (f,), and whether the last search was exhausted.

        The weight of the samples follows from the residual of their best fit, so ``search`` first
        finds the minimum without the prior.
        """
        from scipy.special import chdtri  # imported late: see entry_points

        effort = self.problem.model.effort
        # Quantile of the sum of squares of standard normal variables.
        most = float(chdtri(self._width.size, _CONTRADICTED))
        search.least_squares(tolerance=effort.tolerance, most_steps=effort.most_steps)
        at_best = float(np.linalg.norm(self.problem.residual(search.best)))
        self._errors, self._noise = self._at_best(search.best)
        for _ in range(_MOST_DOUBLINGS):
            with_prior = search.of(self, search.best)
            for start in (self._known, search.best):
                with_prior.try_out(start)
            with_prior.least_squares()
            if robust:
                with_prior.reweighted_least_squares()
            unknowns = with_prior.best
            usual = float(np.sum(((unknowns - self._known) / self._width) ** 2)) <= most
            left = float(np.linalg.norm(self.problem.residual(unknowns)))
            # In random motion a smaller residual proves nothing, because a fit without a prior
            # follows the model error.
            steady = self.problem.window.motion.sine is not None
            if usual and not (steady and left > _WORSE_RATIO * at_best):
                break
            # The damper has changed by more than usual, so the prior is widened.
            self._width = 2.0 * self._width
        return unknowns, with_prior.exhausted

    def _at_best(self, unknowns: Array) -> tuple[ErrorCovariances, float]:
        """Covariances of the fit (f,) to the samples alone, and the noise [N]."""
        problem, settled = self.problem, self.problem.settled
        jacobian, left = problem.jacobian(unknowns), problem.residual(unknowns)
        errors = error_covariances(jacobian[settled], left[settled], self._cycle)
        if math.isfinite(self._cycle):
            white = np.diag(normal_inverse(jacobian))
            whole = np.diag(errors.repeatability) + np.diag(errors.discrepancy)
            known = np.isfinite(whole) & (white > 0.0)
            ratio = np.median(whole[known] / white[known]) if known.any() else np.mean(left**2)
            return errors, math.sqrt(max(float(ratio), 0.0))
        length = max(correlation_length(left), 1)
        # With few independent samples, the noise is corrected for the degrees of freedom.
        freedom = max(left.size / length - self._width.size, 1.0)
        return errors, float(np.sqrt(np.sum(left**2) / freedom))

    def errors_at(self, unknowns: Array) -> ErrorCovariances:
        """The errors of the most probable unknowns (f,).

        Errors of the window enter with the matrix ``gain``. The rest is the error of the running
        set, which does not change from window to window and has the covariance of the prior.
        """
        errors = self._errors
        jacobian = self.problem.jacobian(unknowns)
        scaled = jacobian * self._width / max(self._noise, 1e-300)
        information = scaled.T @ scaled
        held = np.linalg.inv(np.eye(self._width.size) + information)
        gain = held @ information
        units = np.outer(self._width, self._width)

        def scaled_by_gain(covariance: Array) -> Array:
            # Directions that the window does not determine have no gain, so NaN counts as zero.
            return gain @ np.nan_to_num(covariance / units) @ gain.T

        return ErrorCovariances(
            scaled_by_gain(errors.repeatability) * units,
            (scaled_by_gain(errors.discrepancy) + held @ held.T) * units,
        )
