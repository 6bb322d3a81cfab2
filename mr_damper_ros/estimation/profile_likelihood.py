"""Profile likelihood of a parameter: the misfit over its values, all others refitted.

It shows intervals that are not symmetric and parameters that the data do not bound, both of which a
standard error cannot show. Bates and Watts, "Nonlinear Regression Analysis and Its Applications",
1988, chapter 6; Raue et al., Bioinformatics 25, 2009. If a profile reveals a lower minimum, the fit
starts again from there.

The interval is that of the likelihood ratio. If the residual is autocorrelated, the ratio is scaled
so that its curvature at the minimum agrees with the covariance for autocorrelated residuals
(Chandler and Bate, Biometrika 94, 2007).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from mr_damper_ros.estimation.covariance import (
    correlation_length,
    least_squares_covariance,
    normal_inverse,
)
from mr_damper_ros.estimation.differential_evolution import (
    EvolutionSettings,
    GlobalProgress,
    Report,
)
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.estimation.global_search import (
    Excerpts,
    Posterior,
    Prior,
    adapted,
)
from mr_damper_ros.estimation.local_search import LocalSearch, StopRequestedError
from mr_damper_ros.estimation.observability import parameter_ranges, parameter_spans
from mr_damper_ros.estimation.record_levels import Level, LevelledProblem
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.process_pool import ProcessPool, Tell
from mr_damper_ros.signals.arrays import Array

CONFIDENCE = 0.95

_WANTED_RISE = 0.5
"""Intended increase of the root of the likelihood ratio from value to value."""

_MOST_STEPS = 30
_FIRST_STEP = 0.5
"""First step in standard errors; without a standard error it is ``_BLIND_STEP`` of a span."""

_BLIND_STEP = 0.01
_FARTHEST = 1e3
"""Largest distance in spans for a parameter without a plausible range."""

_TOLERANCE = 1e-7
"""Relative decrease of the sum of squares below which the fit of the other parameters has
converged."""


@dataclass(frozen=True, eq=False)
class Profile:
    """The profile likelihood of parameter ``name``.

    ``ratio`` (m,): twice the decrease of the log-likelihood at the increasing ``values`` (m,). At
    the true value it is chi-squared with one degree of freedom. ``best``: the value at the minimum;
    ``lowest`` (p,): all parameters there. ``interval``: the values that are not rejected at 95 %
    confidence, infinite on a side without a bound within the plausible range.
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
    shape parameters. ``should_stop`` is called at every evaluation; if it returns True,
    StopRequestedError is raised.
    """

    def __init__(
        self,
        model: Model,
        misfit: Misfit,
        parameters: Array,
        observable: np.ndarray,
        ranges: Mapping[str, tuple[float, float]],
        should_stop: Callable[[], bool] | None = None,
    ) -> None:
        self._model = model
        self._misfit = misfit
        self._names = model.parameter_names
        self._ranges = ranges
        self._should_stop = should_stop
        self._start = np.array(parameters, dtype=float)
        jacobian = misfit.jacobian(self._start)
        self._spans = parameter_spans(model, jacobian, self._start, ranges)
        self._seen = np.flatnonzero(observable)
        residual = misfit.residual(self._start)
        self._length = max(correlation_length(residual), 1)
        self._errors, self._shrinkage = self._curvatures(jacobian[:, self._seen], residual)

    def _curvatures(self, jacobian: Array, residual: Array) -> tuple[Array, Array]:
        """Standard errors (q,) of the observable parameters; white-noise over full variances."""
        if not self._seen.size:
            return np.empty(0), np.empty(0)
        covariance = least_squares_covariance(jacobian, residual, prior=self._misfit.prior)
        variances = np.diag(covariance)
        freedom = max(residual.size - self._seen.size, 1)
        white = np.diag(normal_inverse(jacobian)) * float(residual @ residual) / freedom
        return np.sqrt(variances), white / variances

    def of(self, name: str) -> Profile:
        """Profile of one parameter; raises ValueError if the law has no parameter of this name."""
        if name not in self._names:
            raise ValueError(
                f"there is no parameter '{name}' to profile: use one of {', '.join(self._names)}"
            )
        place = self._names.index(name)
        seen = np.flatnonzero(self._seen == place)
        shrinkage, step = 1.0 / self._length, _BLIND_STEP * float(self._spans[place])
        if seen.size and np.isfinite(self._errors[seen[0]]):
            shrinkage = float(self._shrinkage[seen[0]])
            step = _FIRST_STEP * float(self._errors[seen[0]])
        walk = _Walk(
            self._model,
            self._misfit,
            self._start,
            self._spans,
            name,
            self._seen,
            self._should_stop,
        )
        scale = shrinkage * max(self._misfit.sample_count - self._seen.size, 1)
        low, high = self._limits(name, place)
        walk.go(step, high, scale)
        walk.go(-step, low, scale)
        return walk.profile(name, scale)

    def _limits(self, name: str, place: int) -> tuple[float, float]:
        value, span = float(self._start[place]), float(self._spans[place])
        low, high = self._ranges.get(name, (value - _FARTHEST * span, value + _FARTHEST * span))
        # A start value may lie outside the range that is plausible for these data.
        parameter = self._model.parameters[place]
        return max(min(low, value - span), parameter.low), min(
            max(high, value + span), parameter.high
        )


class _Walk:
    """Fits of all other parameters at the visited values of one parameter."""

    def __init__(
        self,
        model: Model,
        misfit: Misfit,
        start: Array,
        spans: Array,
        name: str,
        seen: np.ndarray,
        should_stop: Callable[[], bool] | None,
    ) -> None:
        self._model = model
        self._misfit = misfit
        self._place = model.parameter_names.index(name)
        self._places = [place for place in range(start.size) if place != self._place]
        self._spans = spans
        self._linear = frozenset(model.linear) - {name}
        self._held = np.isin(np.arange(start.size), [*seen, self._place])
        self._top_current = max(float(np.max(np.abs(w.current))) for w in misfit.windows)
        self._should_stop = should_stop
        self._sets: list[Array] = []
        self._costs: list[float] = []
        self._visit([start])
        # The given parameters need not be at the minimum over the other parameters.
        self._visit([self._sets[0]])

    def _visit(self, starts: Sequence[Array], enough: float = math.inf) -> float:
        """Refit the others from the starts, best first, until the cost is at most ``enough``."""
        best, least = starts[0], math.inf
        for values in sorted(starts, key=self._cost):
            # A weak prior keeps flat directions at their start.
            others = Posterior(self._misfit, values, self._places, Prior(values, self._spans))
            search = LocalSearch(others, others.start, self._should_stop)
            search.try_out(others.start)
            search.least_squares(tolerance=_TOLERANCE)
            found = others.parameters(search.best)
            cost = self._cost(found)
            if cost < least:
                best, least = found, cost
            if least <= enough:
                break
        self._sets.append(best)
        self._costs.append(least)
        return least

    def _cost(self, parameters: Array) -> float:
        residual = self._misfit.residual(parameters)
        return float(residual @ residual)

    def _adapted(self, values: Array, reference: Array) -> Array:
        return adapted(self._model, self._misfit.windows, reference, values, self._linear)

    def _root(self, cost: float, scale: float) -> float:
        """Root of the likelihood ratio at a cost."""
        least = min(self._costs)
        return math.sqrt(max(scale * (cost - least) / least, 0.0)) if least > 0.0 else math.inf

    def go(self, step: float, limit: float, scale: float) -> None:
        """Step away from the minimum until the ratio exceeds its quantile, or to ``limit``."""
        bound = math.sqrt(float(chdtri(1, 1.0 - CONFIDENCE)))
        here = before = self._sets[0]
        root = self._root(self._costs[0], scale)
        for _ in range(_MOST_STEPS):
            value = float(here[self._place])
            if root > bound or value == limit:
                return
            target = min(value + step, limit) if step > 0.0 else max(value + step, limit)
            moved = float(value - before[self._place])
            # The starts are an extrapolation of the last step, the present parameters, and these
            # with the linear parameters refitted.
            ahead = here + (here - before) * ((target - value) / moved if moved else 0.0)
            plain = np.array(here)
            ahead[self._place] = plain[self._place] = target
            soft = self._model.softened(plain, self._held, self._top_current)
            starts = [ahead, plain, *(self._adapted(s, here) for s in (plain, soft))]
            enough = min(self._costs) * (1.0 + bound**2 / scale)
            rise = self._root(self._visit(starts, enough), scale) - root
            before, here, root = here, self._sets[-1], root + rise
            step *= min(max(_WANTED_RISE / max(rise, 1e-9), 0.5), 3.0)

    def profile(self, name: str, scale: float) -> Profile:
        order = np.argsort([values[self._place] for values in self._sets], kind="stable")
        values = np.array([self._sets[k][self._place] for k in order])
        costs = np.array([self._costs[k] for k in order])
        values, first = np.unique(values, return_index=True)
        costs = np.minimum.reduceat(costs, first)
        least = float(costs.min())
        ratio = scale * (costs - least) / least if least > 0.0 else np.where(costs > 0, math.inf, 0)
        best = int(np.argmin(costs))
        roots = np.sqrt(ratio)
        return Profile(
            name=name,
            values=values,
            ratio=ratio,
            best=float(values[best]),
            lowest=self._sets[int(np.argmin(self._costs))],
            interval=(
                _crossing(values[best::-1], roots[best::-1], -math.inf),
                _crossing(values[best:], roots[best:], math.inf),
            ),
        )


def _crossing(values: Array, roots: Array, otherwise: float) -> float:
    """Value at which the root of the ratio crosses its quantile, by linear interpolation."""
    bound = math.sqrt(float(chdtri(1, 1.0 - CONFIDENCE)))
    beyond = np.flatnonzero(roots > bound)
    if not beyond.size:
        return otherwise
    last = int(beyond[0])
    part = (bound - roots[last - 1]) / (roots[last] - roots[last - 1])
    return float(values[last - 1] + part * (values[last] - values[last - 1]))


_MOST_RESTARTS = 3
"""Largest number of restarts of a fit from a lower minimum that a profile revealed."""

_POLL = 0.2
"""Interval [s] between checks whether a profile is to be stopped."""

_Ranges = Mapping[str, tuple[float, float]]


def search_misfit(fit: GlobalFit, windows: Sequence[Window]) -> Misfit:
    """The misfit that the search of the set minimised."""
    found = fit.parameter_set
    return Excerpts(found.law, windows).misfit(fit.noise, fit.levels, found.values)


def record_levels(fit: GlobalFit, windows: Sequence[Window]) -> list[Level]:
    """Level of each record in order of its number; empty without record levels."""
    misfit = search_misfit(fit, windows)
    if not isinstance(misfit, LevelledProblem):
        return []
    return misfit.levels(fit.parameter_set.values, fit.covariance)


def profiles_of(
    fit: GlobalFit,
    windows: Sequence[Window],
    names: Sequence[str],
    processes: ProcessPool,
    report: Report | None = None,
) -> list[Profile]:
    """Profile likelihoods of the named parameters; after a stop, those not begun are omitted.

    Raises ValueError for a name that the law does not have.
    """
    law = fit.parameter_set.law.parameter_names
    for name in names:
        if name not in law:
            raise ValueError(f"there is no parameter '{name}' to profile: use {', '.join(law)}")
    misfit = search_misfit(fit, windows)
    ranges = parameter_ranges(fit.parameter_set.law, windows)
    listen = None if report is None else lambda _, news: report(news)
    tasks = [(fit.parameter_set, misfit, ranges, name) for name in names]
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

    The fit differs from the given one if a value lies outside its own interval. The fit then starts
    again from the lower minimum that the profile revealed. Raises ValueError for a name that the
    law does not have.
    """
    for restarts in range(_MOST_RESTARTS + 1):
        found = profiles_of(fit, windows, names, processes, report)
        values, misfit = fit.parameter_set.as_dict(), search_misfit(fit, windows)
        lower = [each.lowest for each in found if not each.contains(values[each.name])]
        if not lower or restarts == _MOST_RESTARTS:
            break
        start = min(lower, key=misfit.mean_square)
        again = identify_global(
            fit.parameter_set.law,
            windows,
            start,
            settings,
            report,
            known=start,
            levels=fit.levels,
        )
        before, after = (misfit.mean_square(each.parameter_set.values) for each in (fit, again))
        if not after < before:
            break
        fit = again
    return fit, found


def _profile(task: tuple[ParameterSet, Misfit, _Ranges, str], tell: Tell) -> Profile | None:
    found, misfit, ranges, name = task
    told = time.monotonic()
    stopped = False

    def should_stop() -> bool:
        nonlocal told, stopped
        if time.monotonic() - told > _POLL:
            told = time.monotonic()
            stopped = not tell(GlobalProgress(f"profile of {name}", 0, 1, math.nan, math.nan))
        return stopped

    try:
        return ProfileLikelihood(
            found.law, misfit, found.values, found.observable, ranges, should_stop
        ).of(name)
    except StopRequestedError:
        return None
