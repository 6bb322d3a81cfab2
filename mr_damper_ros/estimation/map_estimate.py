"""Maximum a posteriori estimate: a window weighed against what the running set already knows.

In a steady sine a window determines its unknowns to a fraction of a percent. In random motion
it may hold two strokes, and what the law cannot follow is correlated over much of it: some
combinations of them are then as good as unknown, and a fit on its own puts them anywhere.
They must stay where they were, and so must one that the window hardly notices, such as the
viscous slope of a direction in which it is slow. So the fit of a window is the most probable set
given both the window and the running set: the samples count by what the law leaves of them at best,
once per correlation length, and the unknowns wander from window to window by no more than a damper
does.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mr_damper_ros.estimation.covariance import correlation_length, normal_inverse
from mr_damper_ros.estimation.local_search import LocalSearch
from mr_damper_ros.estimation.repeatability import samples_per_cycle
from mr_damper_ros.estimation.window_fit import WindowFit, fit_of
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.operating_points import WindowProblem
from mr_damper_ros.signals.arrays import Array

_CONTRADICTED = 1e-3
"""A change so rare, were the running set right, says that it is not."""

_MORE_LEFT = 1.25
"""A running set that makes the fit of a sine leave so many times as much is refuted by it."""

_MOST_DOUBLINGS = 10

WANDER = 0.03
"""Standard deviation of what the change of one scale between two windows does to the force [1].

Heating changes the force by less within a window (thesis: 26 % in ten minutes). A sudden change is
another matter: where the window contradicts the running set, they may wander further.
"""


def with_prior(
    model: Model,
    fit: WindowFit,
    window: Window,
    running: Array,
    *,
    fastest: float = math.inf,
    robust: bool = False,
) -> WindowFit:
    """The fit of a window on its own, weighed against the running set (p,).

    ``fastest`` [m/s] is the largest peak velocity that the running set holds for, infinite where
    that is not known: what an unknown does to the force is seen in the window and in a sine so
    fast. Where the window determines the unknowns, the fit hardly changes.
    """
    from scipy.special import chdtri  # here: see mr_damper_ros.entry_points

    problem = model.window_problem(window, running)
    prior = problem.start
    width = problem.usual_change(WANDER, fastest)
    if not np.isfinite(width).all():
        return fit  # A set without any force knows nothing.
    noise = _effective_noise(problem, fit, window)
    alone = float(np.linalg.norm(problem.residual(fit.scales)))
    evaluations = fit.evaluations
    most = float(chdtri(width.size, _CONTRADICTED))  # of so many squared normal numbers
    for _ in range(_MOST_DOUBLINGS):
        search = LocalSearch(_Weighed(problem, prior, noise / width), prior)
        search.try_out(prior)
        search.try_out(fit.scales)
        search.least_squares()
        if robust:
            search.reweighted_least_squares()
        unknowns = search.best
        evaluations += search.evaluations
        usual = float(np.sum(((unknowns - prior) / width) ** 2)) <= most
        left = float(np.linalg.norm(problem.residual(unknowns)))
        # In random motion a fit on its own leaves less because it follows what no law has.
        if usual and (window.motion.sine is None or left <= _MORE_LEFT * alone):
            break
        # The damper has changed by more than it usually does: less is known than was thought.
        width = 2.0 * width
    covariance, discrepancy = _errors_of_weighed(
        problem.jacobian(unknowns) * width / max(noise, 1e-300), width, fit
    )
    weighed = fit_of(
        problem,
        unknowns,
        covariance,
        discrepancy=discrepancy,
        method=fit.method,
        evaluations=evaluations,
    )
    return replace(weighed, success=fit.success, message=fit.message)


def _effective_noise(problem: WindowProblem, fit: WindowFit, window: Window) -> float:
    """Standard deviation [N] of white noise that would leave the unknowns as uncertain."""
    left = problem.residual(fit.scales)
    if not math.isfinite(samples_per_cycle(window)) or fit.discrepancy is None:
        length = max(correlation_length(left), 1)
        # A fit with as many unknowns leaves less of few independent samples than is there.
        freedom = max(left.size / length - fit.scales.size, 1.0)
        return float(np.sqrt(np.sum(left**2) / freedom))
    white = np.diag(normal_inverse(problem.jacobian(fit.scales)))
    whole = np.diag(fit.covariance) + np.diag(fit.discrepancy)
    known = np.isfinite(whole) & (white > 0.0)
    if not known.any():
        return float(np.sqrt(np.mean(left**2)))
    return math.sqrt(max(float(np.median(whole[known] / white[known])), 0.0))


def _errors_of_weighed(jacobian: Array, width: Array, fit: WindowFit) -> tuple[Array, Array]:
    """Covariances (f, f) of the weighed unknowns: repeatability and discrepancy.

    ``jacobian`` (n, f) by unknowns in units of the prior's ``width`` (f,), residual in units of its
    noise. What the window says comes through to the part ``gain``; the rest is the running set's,
    which is the same from window to window and no nearer to the truth than the prior says.
    """
    information = jacobian.T @ jacobian
    gain = np.linalg.solve(np.eye(width.size) + information, information)
    units = np.outer(width, width)

    def passed_on(covariance: Array) -> Array:
        # What the window leaves open it does not pass on either.
        return gain @ np.nan_to_num(covariance / units) @ gain.T

    held = np.eye(width.size) - gain
    discrepancy = np.zeros_like(units) if fit.discrepancy is None else fit.discrepancy
    return (
        np.asarray(passed_on(fit.covariance) * units),
        np.asarray((passed_on(discrepancy) + held @ held.T) * units),
    )


class _Weighed:
    """Residual of a window, and below it that of the prior, in the unit of the samples' noise."""

    def __init__(self, problem: WindowProblem, prior: Array, weights: Array) -> None:
        self._problem = problem
        self._prior = prior
        self._weights = weights
        self.bounds = problem.bounds

    def residual(self, unknowns: Array) -> Array:
        return np.concatenate(
            (self._problem.residual(unknowns), self._weights * (unknowns - self._prior))
        )

    def jacobian(self, unknowns: Array) -> Array:
        return np.vstack((self._problem.jacobian(unknowns), np.diag(self._weights)))
