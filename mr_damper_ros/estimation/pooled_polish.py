"""Local search on the samples of many windows, over those parameters of a model that are free."""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.estimation.covariance import correlation_length
from mr_damper_ros.estimation.differential_evolution import ProgressClock
from mr_damper_ros.estimation.free_parameters import FreeParameters
from mr_damper_ros.estimation.local_search import LocalSearch, StopRequestedError
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.operating_points import PooledProblem
from mr_damper_ros.signals.arrays import Array

_MEANINGLESS = 0.01
"""A step that lowers the misfit by so many of its variances is a tenth of a standard error."""

_SMALLEST = 0.05
"""A parameter counts as no smaller than this part of its range or typical size."""

_ON_BOUND = 1e-3
"""A parameter this part of its size from a bound lies on it."""


class PooledPolish:
    """Local searches for a model whose parameters have these ``sizes`` (p,).

    ``clock`` hears of them and may stop them: StopRequestedError is raised, and ``latest`` (p,) is
    how far the search had come. ``exhausted``: whether the latest one ended at its limit of steps;
    ``evaluations`` are those of all.
    """

    def __init__(self, model: Model, sizes: Array, clock: ProgressClock) -> None:
        self._model = model
        self._names = model.parameter_names
        self._sizes = sizes
        self._clock = clock
        self.latest: Array | None = None
        self.exhausted = False
        self.evaluations = 0

    def search(
        self,
        pooled: PooledProblem,
        start: Array,
        free: frozenset[str],
        *,
        nelder_mead: bool = False,
    ) -> Array:
        """The parameters (p,) that the search ends at; never worse than ``start`` (p,)."""
        found = self._polished(pooled, start, free, nelder_mead)
        on_bound = self._nearly_on_bound(found, free)
        if not on_bound:
            return found
        # The best that is allowed lies on the bound, which a search only approaches.
        low, high = self._model.bounds
        moved = found.copy()
        for name in on_bound:
            place = self._names.index(name)
            nearer = abs(found[place] - low[place]) < abs(found[place] - high[place])
            moved[place] = low[place] if nearer else high[place]
        moved = self._polished(pooled, moved, free - on_bound, False)
        return min((moved, start), key=pooled.mean_square)

    def _nearly_on_bound(self, values: Array, free: frozenset[str]) -> frozenset[str]:
        distance = np.minimum(*(np.abs(values - bound) for bound in self._model.bounds))
        near = distance < _ON_BOUND * self._sizes
        return frozenset(name for name in free if near[self._names.index(name)])

    def _polished(
        self, pooled: PooledProblem, start: Array, free: frozenset[str], nelder_mead: bool
    ) -> Array:
        places = [place for place, name in enumerate(self._names) if name in free]
        residual = pooled.residual(start)
        with np.errstate(over="ignore"):
            overflows = not math.isfinite(float(residual @ residual))
        if not places or overflows:
            return start
        sizes = np.maximum(np.abs(start[places]), _SMALLEST * self._sizes[places])
        problem = FreeParameters(pooled, start, places, sizes, self._model.bounds)
        stage = "Nelder-Mead" if nelder_mead else "least squares"
        search = LocalSearch(
            problem,
            problem.start,
            lambda: self._clock.poll(stage, search.best_cost / pooled.sample_count),
        )
        try:
            if nelder_mead:
                search.nelder_mead()
            search.least_squares(tolerance=_MEANINGLESS / _independent(residual))
        except StopRequestedError:
            self.latest = problem.parameters(search.best)
            raise
        finally:
            self.exhausted = search.exhausted
            self.evaluations += search.evaluations
        return problem.parameters(search.best)


def _independent(residual: Array) -> float:
    """How many independent samples (n,) amount to: correlated ones count once together."""
    return residual.size / max(correlation_length(residual), 1)
