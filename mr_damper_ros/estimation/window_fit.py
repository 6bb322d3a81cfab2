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
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.estimation.covariance import (
    CyclePhases,
    ErrorCovariances,
    error_covariances,
    noise_level,
    white_level,
    without_negative_variance,
)
from mr_damper_ros.estimation.local_search import (
    Ending,
    LocalSearch,
    Posterior,
    Prior,
    StopRequestedError,
)
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import UNHELD, WindowProblem
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import LoopReading
from mr_damper_ros.signals.arrays import Array

WINDOW_METHODS = ("nelder_mead", "least_squares")

POOR_START = 0.25
"""Further starts are tried if the start's mean square residual exceeds this part of the
variance."""

_SKIPPED_COST = 1000.0
"""A start is not refined if its sum of squares exceeds the best start's by this factor."""

_CONTRADICTED = 1e-3
"""Significance level below which a change contradicts what was known before the window."""

WORSE_RATIO = 1.25
"""A window with a sine also contradicts the running set if the prior increases its residual by this
factor."""

_MOST_DOUBLINGS = 10

DRIFT_PER_WINDOW = 0.03
"""Standard deviation [1] of the relative change of force between two windows, for each unknown.

Heating changes the force by less (thesis: 26 % in ten minutes). After a sudden change, when the
window contradicts the running set, larger changes are allowed.
"""


@dataclass(frozen=True, eq=False)
class WindowFit:
    """Result of the fit of one window.

    ``scales`` (f,) are the unknowns of the window problem, the scale parameters of the model. Their
    ``covariance`` (f, f) describes the scatter between windows of the same motion, and
    ``discrepancy`` (f, f) the model error, None if unknown (see :mod:`covariance`). ``parameters``
    (p,) are all parameters.
    ``coefficients`` (c,) and their covariances ``coefficient_covariance`` and
    ``coefficient_discrepancy`` (c, c) hold at ``operating_point`` (peak velocity [m/s], current
    [A]). ``rmse`` [N] covers the ``sample_count`` samples with a known past; ``nrmse`` = RMSE/std
    of the force. The peak velocity was limited to the range ``held`` [m/s].
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
    held: tuple[float, float] = UNHELD

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
    prior: ParameterSet | None = None,
    held: tuple[float, float] = UNHELD,
    tolerance: float | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> WindowFit:
    """Fit the unknowns that one window determines, from the parameters ``start`` of shape (p,).

    If the mean square residual of the start exceeds a quarter of the force variance, starts that
    the model derives from the window are also tried. ``prior``, the running set, adds a prior to
    the samples. The effect of an unknown on the force is evaluated in the window and in a sine of
    its largest peak velocity. The set must agree with the start in all parameters that a window
    does not determine. If the window determines the unknowns, the prior has little effect. ``held``
    [m/s]: the range to which the set of the fit limits the peak velocity. ``tolerance``: relative
    decrease of the sum of squares at which the search ends (None: the model's value).
    ``should_stop`` is called at every evaluation; if it returns True, the best fit so far is
    returned with ``success`` False.

    Raises DataError for a constant force, ValueError for an unknown method.
    """
    if method not in WINDOW_METHODS:
        raise ValueError(f"method '{method}' is unknown: use one of {', '.join(WINDOW_METHODS)}")
    spread = float(np.std(window.force))
    if spread == 0.0:
        raise DataError("the force does not change: there is nothing to identify")
    phases, effort = CyclePhases.of(window), model.effort
    searches: list[LocalSearch[WindowProblem]] = []
    problem: WindowProblem | None = None
    ending = Ending.CONVERGED

    forces = model.window_forces([window.held_within(*held)])

    def enter(parameters: Array) -> LocalSearch[WindowProblem]:
        problem = WindowProblem(model, window, parameters, held=held, forces=forces)
        searches.append(LocalSearch(problem, problem.start, should_stop))
        searches[-1].try_out(problem.start)
        return searches[-1]

    try:
        search = enter(start)
        # "not <=" is also true for a NaN cost.
        if not _mean_square(search) <= POOR_START * spread**2:
            # The costs of the starts alone do not show which of them leads to the lowest minimum.
            cold = [enter(each) for each in model.cold_starts(window, search.problem.given)]
            cold = sorted(cold, key=_mean_square)[: effort.polished_starts]
            limit = _SKIPPED_COST * _mean_square(cold[0])
            hopeful = [each for each in (search, *cold) if _mean_square(each) < limit]
            for each in hopeful if len(hopeful) > 1 else []:
                each.least_squares(tolerance=effort.rough_tolerance, most_steps=effort.rough_steps)
            search = min(searches, key=_mean_square)
        if method == "nelder_mead":
            search.nelder_mead()
        search.least_squares(tolerance=tolerance or effort.tolerance, most_steps=effort.most_steps)
        exhausted = search.exhausted
        if prior is not None:
            running = WindowProblem(model, window, prior.values, held=held)
            width = _usual_change(running, prior.peak_velocity_range[1])
            # Without a force of the running set, there is no prior.
            if np.isfinite(width).all():
                unknowns, errors, exhausted = _with_prior(
                    running, width, search, phases, should_stop
                )
                problem = running
        if exhausted:
            ending = Ending.EXHAUSTED
    except StopRequestedError:
        ending = Ending.STOPPED
        search = min(searches, key=_mean_square)
    if problem is None:
        problem, unknowns, settled = search.problem, search.best, search.problem.settled
        jacobian = problem.jacobian(unknowns)[settled]
        errors = error_covariances(jacobian, problem.residual(unknowns)[settled], phases)
    return fit_of(
        problem,
        unknowns,
        *errors,
        method=method,
        evaluations=forces.differences + sum(each.evaluations for each in searches),
        ending=ending,
    )


def fit_of(
    problem: WindowProblem,
    unknowns: Array,
    covariance: Array,
    discrepancy: Array | None = None,
    *,
    method: str,
    evaluations: int,
    ending: Ending = Ending.CONVERGED,
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
        held=problem.held,
    )


def _mean_square(search: LocalSearch[WindowProblem]) -> float:
    """Mean square residual [N²] over the settled samples."""
    return search.best_cost / max(int(np.count_nonzero(search.problem.settled)), 1)


def _usual_change(running: WindowProblem, fastest: float) -> Array:
    """Change (f,) of each unknown that changes the force by :data:`DRIFT_PER_WINDOW`.

    The force is evaluated in the window and, if ``fastest`` [m/s] is finite, in a sine of this peak
    velocity. The change is infinite if the force is zero.
    """
    problems = [running]
    if math.isfinite(fastest):
        window, model = running.window, running.model
        frequency = LoopReading.of(window).frequency
        sine = Window.of_sine(fastest, frequency, window.operating_point[1])
        force = model.window_force(sine.held_within(*running.held), running.given)
        sine = replace(sine, force=force)
        problems.append(WindowProblem(model, sine, running.given, held=running.held))
    changes = []
    for problem in problems:
        effect = np.sqrt(np.mean(problem.jacobian(problem.start) ** 2, axis=0))
        force = problem.residual(problem.start) + problem.window.force
        strength = float(np.sqrt(np.mean(force**2)))
        if strength > 0.0:
            changes.append(DRIFT_PER_WINDOW / np.maximum(effect / strength, 1e-12))
        else:
            changes.append(np.full(effect.size, np.inf))
    return np.asarray(np.min(changes, axis=0))


def _contradicting(count: int) -> float:
    """Sum of squares of ``count`` standard normal variables that contradicts their prior."""
    from scipy.special import chdtri  # late: see mr_damper_ros.entry_points

    return float(chdtri(count, _CONTRADICTED))


def _with_prior(
    running: WindowProblem,
    width: Array,
    without: LocalSearch[WindowProblem],
    phases: CyclePhases | None,
    should_stop: Callable[[], bool] | None,
) -> tuple[Array, ErrorCovariances, bool]:
    """The most probable unknowns (f,), their errors, and whether the search was exhausted.

    The problem ``running`` has the running set as its start; ``width`` (f,) is the prior standard
    deviation of the unknowns. The weight of the samples follows from the residual of their best
    fit, so ``without`` is at the minimum without the prior.
    """
    most = _contradicting(width.size)
    at_best = float(np.linalg.norm(running.residual(without.best)))
    noise, of_samples = _noise(running, without.best, phases)
    for _ in range(_MOST_DOUBLINGS):
        posterior = Posterior(running, Prior(running.start, width), noise, 1.0)
        search = LocalSearch(posterior, without.best, should_stop)
        for start in (posterior.start, search.best):
            search.try_out(start)
        search.least_squares()
        apart = (search.best - posterior.start) / width
        left = float(np.linalg.norm(running.residual(search.best)))
        # In random motion a smaller residual proves nothing, because a fit without a prior follows
        # the model error.
        steady = running.window.motion.sine is not None
        if apart @ apart <= most and not (steady and left > WORSE_RATIO * at_best):
            break
        # The damper has changed by more than usual, so the prior is widened.
        width = 2.0 * width
    errors = _errors(posterior, search.best, of_samples)
    return search.best, errors, search.exhausted


def _noise(
    problem: WindowProblem, unknowns: Array, phases: CyclePhases | None
) -> tuple[float, ErrorCovariances]:
    """Standard deviation [N] of white noise that gives the uncertainty of a fit to samples alone.

    Also returns the errors of the unknowns (f,) of this fit.
    """
    settled = problem.settled
    jacobian, left = problem.jacobian(unknowns), problem.residual(unknowns)
    errors = error_covariances(jacobian[settled], left[settled], phases)
    if phases is None:
        return noise_level(left, unknowns.size), errors
    size = float(np.sqrt(np.mean(left**2)))
    level = white_level(jacobian, errors.repeatability + errors.discrepancy, size)
    return max(level, 1e-150), errors


def _errors(
    posterior: Posterior[WindowProblem], unknowns: Array, of_samples: ErrorCovariances
) -> ErrorCovariances:
    """The errors of the most probable unknowns (f,), from those of a fit to the samples alone.

    Errors of the window enter with the matrix ``gain``. The rest is the error of the running set,
    which does not change from window to window and has the covariance of the prior.
    """
    samples = posterior.jacobian(unknowns)[: -unknowns.size] * posterior.widths / posterior.noise
    # The inverse of 1 + information has these axes; it exists however large the information is.
    information, axes = np.linalg.eigh(samples.T @ samples)
    share = 1.0 / (1.0 + information.clip(0.0))
    held, gain = ((axes * part) @ axes.T for part in (share, information.clip(0.0) * share))
    units = np.outer(posterior.widths, posterior.widths)
    # Directions that the window does not determine have no gain, so NaN counts as zero.
    repeatability, discrepancy = (
        gain @ np.nan_to_num(covariance / units) @ gain.T for covariance in of_samples
    )
    return ErrorCovariances(repeatability * units, (discrepancy + held @ held.T) * units)
