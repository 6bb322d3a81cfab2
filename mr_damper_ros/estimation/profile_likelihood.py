"""Profile likelihood of a parameter: the misfit over its values, all others refitted.

Unlike a standard error, it shows intervals that are not symmetric and parameters that the data do
not bound. See Bates and Watts, "Nonlinear Regression Analysis and Its Applications", 1988, chapter
6, and Raue et al., Bioinformatics 25, 2009. If a profile reveals a lower minimum, the fit starts
again from there.

The interval follows from the likelihood ratio. If the residual is autocorrelated, the ratio is
scaled so that its curvature at the minimum agrees with the covariance for autocorrelated residuals
(Chandler and Bate, Biometrika 94, 2007).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from mr_damper_ros.estimation.covariance import (
    independent_samples,
    least_squares_covariance,
    normal_inverse,
)
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings, ProgressClock, Report
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global, with_linear_refitted
from mr_damper_ros.estimation.local_search import LocalSearch, Posterior, Prior, StopRequestedError
from mr_damper_ros.estimation.observability import SURE, parameter_ranges, parameter_spans
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.misfit import ChosenParameters, Misfit
from mr_damper_ros.processes.process_pool import Notify, ProcessPool
from mr_damper_ros.signals.arrays import Array

_BOUND = math.sqrt(float(chdtri(1, 0.05)))
"""Root of the likelihood ratio at the ends of an interval of 95 % confidence."""

_STEP_RISE = 0.5
"""Intended increase of the root of the likelihood ratio in one step."""

_MOST_STEPS = 30

_WEAK_PRIOR = 1e-4
"""Relative weight of the prior that keeps undetermined directions at their start. Without it, the
last digits of the data decide where they end."""


@dataclass(frozen=True, eq=False)
class Profile:
    """The profile likelihood of parameter ``name``.

    ``ratio`` (m,): twice the decrease of the log-likelihood at the increasing ``values`` (m,). At
    the true value, the ratio is chi-squared with one degree of freedom. ``best``: the value at the
    minimum; ``lowest`` (p,): all parameters there. ``interval``: the values that are not rejected
    at 95 % confidence, infinite on a side without a bound within the plausible range.
    """

    name: str
    values: Array
    ratio: Array
    best: float
    lowest: Array
    interval: tuple[float, float]

    def contains(self, value: float) -> bool:
        """Whether the value is inside the confidence interval."""
        return self.interval[0] <= value <= self.interval[1]


class ProfileLikelihood:
    """Profiles of the parameters (p,) that were fitted with ``misfit``.

    ``observable`` (p,) marks the determined parameters; ``ranges`` are the plausible ranges of the
    shape parameters.
    """

    def __init__(
        self,
        misfit: Misfit,
        parameters: Array,
        observable: np.ndarray,
        ranges: Mapping[str, tuple[float, float]],
    ) -> None:
        self._model = misfit.model
        self._misfit = misfit
        self._should_stop: Callable[[], bool] | None = None
        self._start = np.array(parameters, dtype=float)
        self._ranges = ranges
        jacobian, residual = misfit.jacobian(self._start), misfit.residual(self._start)
        self._spans = parameter_spans(self._model, jacobian, self._start, ranges)
        # Standard errors (p,), and the ratio of the variances for white noise to the actual ones.
        # A parameter that is not determined has a larger error.
        self._errors = SURE * self._spans
        shrinkage = np.full(self._start.size, independent_samples(residual) / residual.size)
        if np.any(observable):
            seen = jacobian[:, observable]
            variances = np.diag(least_squares_covariance(seen, residual, misfit.prior_variances))
            freedom = max(residual.size - variances.size, 1)
            white = np.diag(normal_inverse(seen)) * float(residual @ residual) / freedom
            known = np.isfinite(variances) & (variances > 0.0)
            places = np.flatnonzero(observable)[known]
            self._errors[places] = np.sqrt(variances[known])
            shrinkage[places] = white[known] / variances[known]
        self._scales = max(misfit.sample_count - int(np.sum(observable)), 1) * shrinkage

    def of(self, name: str, should_stop: Callable[[], bool] | None = None) -> Profile:
        """Profile of one parameter.

        ``should_stop`` is called at every evaluation; if it returns True, StopRequestedError is
        raised.
        """
        self._should_stop = should_stop
        place = self._model.parameter_names.index(name)
        parameter, value = self._model.parameters[place], float(self._start[place])
        scale, span = float(self._scales[place]), float(self._spans[place])
        step = _STEP_RISE * float(self._errors[place])
        # The value itself may lie outside the range that is plausible for these data.
        low, high = self._ranges.get(name, (-math.inf, math.inf))
        low = max(min(low, value - span), parameter.low)
        high = min(max(high, value + span), parameter.high)
        # Visited sets and their costs. The given parameters may not be at the minimum over the
        # other parameters, so they are refitted first.
        visited = [self._refitted(place, [self._refitted(place, [self._start])[0]])]
        self._walk(visited, place, step, high)
        self._walk(visited, place, -step, low)
        ordered = sorted(visited, key=lambda each: float(each[0][place]))
        values, first = np.unique([each[place] for each, _ in ordered], return_index=True)
        roots = _roots(np.minimum.reduceat([cost for _, cost in ordered], first), scale)
        best = int(np.argmin(roots))
        return Profile(
            name=name,
            values=values,
            ratio=roots**2,
            best=float(values[best]),
            lowest=min(visited, key=lambda each: each[1])[0],
            interval=(
                _crossing(values[best::-1], roots[best::-1], -math.inf),
                _crossing(values[best:], roots[best:], math.inf),
            ),
        )

    def _refitted(
        self, place: int, starts: Sequence[Array], enough: float = math.inf
    ) -> tuple[Array, float]:
        """Best set with the other parameters refitted, and its cost; below ``enough`` suffices."""
        best, least = starts[0], math.inf
        weak = _WEAK_PRIOR * math.sqrt(self._misfit.sample_count)
        others = [other for other in range(self._start.size) if other != place]
        for values in sorted(starts, key=self._cost):
            free = ChosenParameters(self._misfit, values, others)
            problem = Posterior(free, Prior(values, self._spans).at(others), weak)
            search = LocalSearch(problem, problem.start, self._should_stop)
            search.least_squares(tolerance=self._model.effort.tolerance)
            found = problem.parameters(search.best)
            cost = self._cost(found)
            if cost < least:
                best, least = found, cost
            if least <= enough:
                break
        return best, least

    def _cost(self, parameters: Array) -> float:
        residual = self._misfit.residual(parameters)
        return float(residual @ residual)

    def _walk(
        self, visited: list[tuple[Array, float]], place: int, step: float, limit: float
    ) -> None:
        """Step away from the minimum until the ratio exceeds its quantile, or to ``limit``.

        A step starts from the extrapolation of the last one, from the present parameters, or from
        these with the linear ones refitted.
        """
        linear = frozenset(self._model.linear) - {self._model.parameter_names[place]}
        here = before = visited[0][0]
        scale = float(self._scales[place])
        root = _roots([cost for _, cost in visited], scale)[0]
        for _ in range(_MOST_STEPS):
            value, moved = float(here[place]), float(here[place] - before[place])
            if root > _BOUND or value == limit:
                return
            target = min(value + step, limit) if step > 0.0 else max(value + step, limit)
            ahead = here + (here - before) * ((target - value) / moved if moved else 0.0)
            plain = np.array(here)
            ahead[place] = plain[place] = target
            windows = self._misfit.windows
            refitted = with_linear_refitted(self._model, windows, here, plain, linear)
            enough = min(cost for _, cost in visited) * (1.0 + _BOUND**2 / scale)
            visited.append(self._refitted(place, [ahead, plain, refitted], enough))
            last, root = root, _roots([cost for _, cost in visited], scale)[-1]
            before, here = here, visited[-1][0]
            step *= min(max(_STEP_RISE / max(root - last, 1e-9), 0.5), 3.0)


def _roots(costs: ArrayLike, scale: float) -> Array:
    """Roots (m,) of the likelihood ratios at these costs (m,)."""
    every = np.asarray(costs, dtype=float)
    rise = every - every.min()
    # Without noise, any increase of the cost is extremely unlikely.
    least = max(float(every.min()), 1e-24)
    return np.asarray(np.sqrt(scale * rise / least))


def _crossing(values: Array, roots: Array, otherwise: float) -> float:
    """Value at which the root of the ratio crosses its quantile, by linear interpolation."""
    beyond = np.flatnonzero(roots > _BOUND)
    if not beyond.size:
        return otherwise
    last = int(beyond[0])
    part = (_BOUND - roots[last - 1]) / (roots[last] - roots[last - 1])
    return float(values[last - 1] + part * (values[last] - values[last - 1]))


def check_profiled(names: Sequence[str], known: Sequence[str]) -> None:
    """Raise ValueError for a parameter to profile that is not among the ``known`` ones."""
    for name in names:
        if name not in known:
            raise ValueError(f"there is no parameter '{name}' to profile: use {', '.join(known)}")


def profiles_of(
    fit: GlobalFit,
    windows: Sequence[Window],
    names: Sequence[str],
    processes: ProcessPool,
    report: Report | None = None,
) -> list[Profile]:
    """Profile likelihoods of the named parameters; a stop omits the profiles not begun.

    Raises ValueError for a name that the law does not have.
    """
    found, law = fit.parameter_set, fit.parameter_set.law
    check_profiled(names, law.parameter_names)
    # The ranges of thinned windows, as in the misfit, may lack the extremes.
    likelihood = ProfileLikelihood(
        fit.misfit(windows), found.values, found.observable, parameter_ranges(law, windows)
    )
    listen = None if report is None else lambda _, news: report(news)
    tasks = [(likelihood, name) for name in names]
    return [profile for profile in processes.map(_profile, tasks, listen) if profile]


def profiled(
    fit: GlobalFit,
    windows: Sequence[Window],
    names: Sequence[str],
    settings: EvolutionSettings,
    processes: ProcessPool,
    report: Report | None = None,
) -> tuple[GlobalFit, list[Profile]]:
    """Profiles of the named parameters, and the fit that they belong to.

    If a value lies outside its own interval, the fit is repeated from the lower minimum that the
    profile revealed. Raises ValueError for a name that the law does not have.
    """
    while True:
        found = profiles_of(fit, windows, names, processes, report)
        values, cost = fit.parameter_set.as_dict(), fit.misfit(windows).mean_square
        lower = [each.lowest for each in found if not each.contains(values[each.name])]
        if not lower:
            return fit, found
        start, law = min(lower, key=cost), fit.parameter_set.law
        again = identify_global(
            law, windows, start, settings, report, known=start, levels=fit.levels
        )
        if not cost(again.parameter_set.values) < cost(fit.parameter_set.values):
            return fit, found
        fit = again


def _profile(task: tuple[ProfileLikelihood, str], notify: Notify) -> Profile | None:
    (likelihood, name), clock = task, ProgressClock(1, notify)
    try:
        return likelihood.of(name, lambda: clock.poll(f"profile of {name}", math.nan))
    except StopRequestedError:
        return None
