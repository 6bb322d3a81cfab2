"""One parameter set of a model for many windows: the steps of the search.

1. Each window gives its own coefficients (least squares, no dependence on velocity or current
   assumed within it).
2. The laws over operating points are fitted to these coefficients: linear where they are, else by
   differential evolution.
3. A local search on the samples themselves, over the parameters that the data determine. It
   begins with what one run determines besides the coefficients, such as a compliance, as the start
   has it; the first two steps take that as given.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.adaptation import adapted
from mr_damper_ros.estimation.covariance import correlation_length
from mr_damper_ros.estimation.determination import noise_level
from mr_damper_ros.estimation.differential_evolution import (
    EvolutionSettings,
    ProgressClock,
    Report,
    evolve,
)
from mr_damper_ros.estimation.free_parameters import FreeParameters
from mr_damper_ros.estimation.local_search import LocalSearch, StopRequestedError
from mr_damper_ros.estimation.observability import (
    current_varies,
    determined_parameters,
    operating_points_within,
    parameter_ranges,
    varied_parameters,
)
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.operating_points import CoefficientTable, PooledProblem
from mr_damper_ros.signals.arrays import Array

_SEARCH_SAMPLES = 8000
_FEWEST_SEARCH_SAMPLES = 250
"""The search thins the windows to so many samples in all, and each to no fewer than that; the
last polish uses all samples."""

_EVOLUTION_SAMPLES = 200
"""Samples per window where differential evolution evaluates thousands of sets."""

_CLEARLY_BETTER = 0.98
"""A search from elsewhere must lower the mean square by this factor to be preferred."""

_MOST_ROUNDS = 4
"""So often the extension is found anew, as long as that changes what the windows determine."""

_MEANINGLESS = 0.01
"""A step that lowers the misfit by so many of its variances is a tenth of a standard error."""

_SMALLEST = 0.05
"""A parameter counts as no smaller than this part of its range or typical size."""

_ON_BOUND = 1e-3
"""A parameter this part of its size from a bound lies on it."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """Where a local search on the samples began (``origin``), and what it found.

    ``parameters`` (p,); ``cost``: mean square of the weighted residual over the search's samples.
    """

    origin: str
    parameters: Array
    cost: float


class GlobalSearch:
    """The steps of a global identification, and the best parameters (p,) so far."""

    def __init__(
        self,
        model: Model,
        windows: Sequence[Window],
        start: Array,
        settings: EvolutionSettings,
        report: Report | None,
        known: Array | None,
    ) -> None:
        """Raises ValueError where there are no windows, or a force does not change."""
        if not windows:
            raise ValueError("there are no windows to identify from")
        self.model = model
        self.windows = windows
        self._known = known
        self._start = start
        self._settings = settings
        self._names = model.parameter_names
        self._thinned = thinned_for_search(windows)
        top_current = max(float(np.max(np.abs(window.current))) for window in windows)
        self._neutral = model.without_dependence(start, top_current)
        self.evaluations = 0
        self._fit_windows(self._neutral)
        speeds, currents = operating_points_within(windows)
        self._varied = varied_parameters(model, speeds, currents)
        self._varied_between = varied_parameters(
            model,
            [fit.operating_point[0] for fit in self.fits],
            [fit.operating_point[1] for fit in self.fits],
        )
        self._bounds = parameter_ranges(model, windows)
        self._ranges = {name: high - low for name, (low, high) in self._bounds.items()}
        # What one run determines besides the coefficients, such as a compliance.
        self._common = model.common_names
        self._current_varies = any(map(current_varies, windows))
        # The range of a parameter that has one tells its size, if it has none itself.
        self._sizes = np.array(
            [
                self._ranges.get(name, size)
                for name, size in zip(self._names, model.typical_sizes(windows), strict=True)
            ]
        )
        self._report = report
        self.free: frozenset[str] = frozenset()
        self.best = start
        self.shortcoming = ""
        self.candidates: list[Candidate] = []

    def run(self, method: str) -> None:
        """Search by one of the methods of :func:`identify_global`.

        Raises StopRequestedError where the report has stopped it; ``best`` then is the best so far.
        """
        # The laws from two starts, and once more if the samples leave parameters open.
        laws = 2 * self._settings.generations * self.model.searched_laws(self._varied_between)
        again = laws if self._current_varies else 0
        direct = self._settings.generations if method == "differential_evolution" else 0
        self._clock = ProgressClock(max(2 * laws + direct + again, 1), self._report)
        candidates = self._candidates(self._varied_between)
        self.best = self._best_of(candidates)
        self.free = self._determined(self.best)
        if self._varied <= self.free:
            self._clock.skip(laws)
        else:
            # The scales must adapt to the values that undetermined parameters are held at.
            determined = self._varied_between & self.free
            again = 2 * self._settings.generations * self.model.searched_laws(determined)
            self._clock.skip(laws - again)
            candidates = self._candidates(determined)
        if method == "differential_evolution":
            self.best = self._best_of(candidates)
            by_laws = self.pooled.mean_square(self.best)
            candidates = {"all free parameters": self._evolve_samples()}
        if self._clock.stopped:
            self.best = self._best_of({"laws": self.best, **candidates})
            raise StopRequestedError
        for origin, parameters in candidates.items():
            polished = self._local(self.pooled, parameters, method == "nelder_mead")
            cost = self.pooled.mean_square(polished)
            self.candidates.append(Candidate(origin, polished, cost))
            self.best = self._best_of({"so far": self.best, origin: polished})
        first, best = self.candidates[0], min(self.candidates, key=lambda found: found.cost)
        # The first keeps most of the start: the others must be better, not just different.
        self.best = (best if best.cost < _CLEARLY_BETTER * first.cost else first).parameters
        if self._current_varies:
            self._search_again()
        if self._common or self._current_varies:
            self._take_in_what_is_common()
        self._return_to_start()
        self.best = self._local(self.whole_misfit(), self.best, False)
        if method == "differential_evolution" and self.pooled.mean_square(self.best) > by_laws:
            self.shortcoming = (
                "differential evolution ended in a poorer minimum than the laws of the method "
                "global give: allow more generations, or use that method"
            )

    def _return_to_start(self) -> None:
        """Give what is not determined the start's value, as far as the windows agree with it.

        A search from elsewhere, which was better, holds it elsewhere.
        """
        moved = self._moved()
        laws = [[name for name in law if name in moved] for law in self.model.shape_groups]
        for names in (moved, *laws, *([name] for name in moved)):
            still = self._moved()
            if names and set(names) <= set(still):
                self._try_start_of(names)

    def _moved(self) -> list[str]:
        """Shape parameters that are not determined and not where the start has them."""
        determined = self._determined(self.best)
        return [
            name
            for name in self.model.shape_names
            if not (name in self.free and name in determined)
            and self.best[self._names.index(name)] != self._start[self._names.index(name)]
        ]

    def _try_start_of(self, names: Sequence[str]) -> None:
        best, free = self.best, self.free
        places = [self._names.index(name) for name in names]
        trial = best.copy()
        trial[places] = self._start[places]
        self.free = free.difference(names)
        linear = self.free.intersection(self.model.linear)
        try:
            follows = adapted(self.model, self.windows, best, trial, linear)
            found = self._local(self.pooled, follows, False)
        except StopRequestedError:
            self.best, self.free = best, free
            raise
        if _CLEARLY_BETTER * self.pooled.mean_square(found) <= self.pooled.mean_square(best):
            self.best = found
        else:
            self.free = free

    def _fit_windows(self, start: Array, known: Array | None = None) -> None:
        """Fit each window from ``start``; that of varying current from ``known``, if it is better.

        Without its dependence on the current no law comes near to the force of such a window.
        """
        self.fits = []
        for window in self._thinned:
            starts = [start]
            if known is not None and current_varies(window):
                starts.append(known)
            fits = [fit_window(self.model, window, each, method="least_squares") for each in starts]
            self.fits.append(min(fits, key=lambda fit: fit.rmse))
        self.pooled = self._misfit(self._thinned)
        self.evaluations += sum(fit.evaluations for fit in self.fits)

    def _search_again(self) -> None:
        """From the laws over coefficients that the varying current no longer blurs.

        All that was varied may move: what of it is determined, only a good fit can tell.
        """
        self._fit_windows(self._neutral, self.best)
        self.best = self._best_of({found.origin: found.parameters for found in self.candidates})
        self.free = self._varied
        for origin, parameters in self._candidates(self._varied_between).items():
            found = self._local(self.pooled, parameters, False)
            self.best = self._best_of({"so far": self.best, origin: found})
        self.free = self._determined(self.best)

    def _take_in_what_is_common(self) -> None:
        """Fit the windows with what was found for all of them, and see what they determine now.

        Before, what a lag, for one, or a varying current does to the force stood for noise, in
        which much is lost.
        """
        places = self.model.places(self._common)
        for _ in range(_MOST_ROUNDS):
            before = self.free
            neutral = self._neutral.copy()
            neutral[places] = self.best[places]
            self._fit_windows(neutral, self.best)
            self.free = self._determined(self.best)
            self.best = self._local(self.pooled, self.best, False)
            if self.free == before:
                break

    def whole_misfit(self) -> PooledProblem:
        """Of all samples, but those that with the best set still depend on an unknown past."""
        return self._misfit(self.windows, self.best)

    def _misfit(self, windows: Sequence[Window], known: Array | None = None) -> PooledProblem:
        return self.model.pooled_problem(windows, [fit.rmse for fit in self.fits], known)

    def _candidates(self, free: frozenset[str]) -> dict[str, Array]:
        """Where to start on the samples, by origin.

        The laws, with the start's values for what is not free or with none of its dependences;
        and the best of the windows' own fits, which assume no dependence at all.
        """
        candidates = {
            "laws, as the start has the rest": self._fit_laws(self._start, free),
            "laws, no other dependence": self._fit_laws(self._neutral, free),
            "coefficients of one window": min(
                (fit.parameters for fit in self.fits), key=self.pooled.mean_square
            ),
        }
        if self._known is not None:
            candidates["an earlier search"] = self._known
        return candidates

    def _best_of(self, candidates: Mapping[str, Array]) -> Array:
        return min(candidates.values(), key=self.pooled.mean_square)

    def _fit_laws(self, start: Array, free: frozenset[str]) -> Array:
        table = CoefficientTable(
            peak_velocity=np.array([fit.operating_point[0] for fit in self.fits]),
            current=np.array([fit.operating_point[1] for fit in self.fits]),
            coefficients=np.array([fit.coefficients for fit in self.fits]),
            errors=np.array([np.sqrt(np.diag(fit.coefficient_covariance)) for fit in self.fits]),
        )
        return self.model.fit_laws(table, start, free, self._search_law)

    def _search_law(
        self,
        cost: Callable[[Array], Array],
        bounds: Sequence[tuple[float, float]],
        start: Array,
        stage: str,
    ) -> Array:
        if self._clock.stopped:
            return start
        best, _, count = evolve(cost, bounds, self._settings, self._clock, stage=stage, start=start)
        self.evaluations += count
        return best

    def _determined(self, parameters: Array) -> frozenset[str]:
        jacobian = self.pooled.jacobian(parameters) / noise_level(self.pooled, parameters)
        return determined_parameters(self.model, jacobian, self._varied, self._ranges)

    def _evolve_samples(self) -> Array:
        names = [name for name in self._names if name in self.free]
        places = [self._names.index(name) for name in names]
        centre = self.best
        bounds = []
        for name, place in zip(names, places, strict=True):
            reach = 3.0 * max(abs(float(centre[place])), 1e-3)
            low, high = self._bounds.get(name, (-reach, reach))
            parameter = self.model.parameters[place]
            bounds.append((max(low, parameter.low), min(high, parameter.high)))
        few = [window.thinned(_EVOLUTION_SAMPLES) for window in self.windows]
        misfit = self._misfit(few)

        def cost(individuals: Array) -> Array:
            sets = np.repeat(centre[np.newaxis], individuals.shape[1], axis=0)
            sets[:, places] = individuals.T
            return misfit.population_cost(sets)

        found, _, count = evolve(
            cost,
            bounds,
            self._settings,
            self._clock,
            stage="all free parameters",
            start=None if self._known is None else self._known[places],
        )
        self.evaluations += count
        result = centre.copy()
        result[places] = found
        return result

    def _local(self, pooled: PooledProblem, start: Array, nelder_mead: bool) -> Array:
        found = self._polish(pooled, start, self.free, nelder_mead)
        on_bound = self._nearly_on_bound(found)
        if on_bound:
            # The best that is allowed lies on the bound, which a search only approaches.
            low, high = self.model.bounds
            for name in on_bound:
                place = self._names.index(name)
                nearer = abs(found[place] - low[place]) < abs(found[place] - high[place])
                found[place] = low[place] if nearer else high[place]
            found = self._polish(pooled, found, self.free - on_bound, False)
        return found

    def _nearly_on_bound(self, values: Array) -> frozenset[str]:
        distance = np.minimum(*(np.abs(values - bound) for bound in self.model.bounds))
        near = distance < _ON_BOUND * self._sizes
        return frozenset(name for name in self.free if near[self._names.index(name)])

    def _polish(
        self, pooled: PooledProblem, start: Array, free: frozenset[str], nelder_mead: bool
    ) -> Array:
        places = [place for place, name in enumerate(self._names) if name in free]
        sizes = np.maximum(np.abs(start[places]), _SMALLEST * self._sizes[places])
        problem = FreeParameters(pooled, start, places, sizes, self.model.bounds)
        stage = "Nelder-Mead" if nelder_mead else "least squares"
        search = LocalSearch(
            problem,
            problem.start,
            lambda: self._clock.poll(stage, search.best_cost / pooled.sample_count),
        )
        try:
            if nelder_mead:
                search.nelder_mead()
            independent = _independent(pooled.residual(start))
            search.least_squares(tolerance=_MEANINGLESS / independent)
        except StopRequestedError:
            found = problem.parameters(search.best)
            self.best = min((self.best, found), key=pooled.mean_square)
            raise
        finally:
            self.evaluations += search.evaluations
        return problem.parameters(search.best)


def thinned_for_search(windows: Sequence[Window]) -> list[Window]:
    """The windows with as many samples as a search needs."""
    most = max(_SEARCH_SAMPLES // len(windows), _FEWEST_SEARCH_SAMPLES)
    return [window.thinned(most) for window in windows]


def _independent(residual: Array) -> float:
    """How many independent samples (n,) amount to: correlated ones count once together."""
    return residual.size / max(correlation_length(residual), 1)
