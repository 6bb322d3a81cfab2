"""One parameter set of a model for many windows: the steps of the search.

1. Each window gives its own coefficients (least squares, no dependence on velocity or current
   assumed within it); what these leave of the force is the noise of the window.
2. The laws over operating points are fitted to these coefficients: linear where they are, else by
   differential evolution.
3. A local search on the samples themselves, over the parameters that the data determine. It
   begins with what one run determines besides the coefficients, such as a compliance, as the start
   has it; the first two steps take that as given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import correlation_length
from mr_damper_ros.estimation.differential_evolution import (
    EvolutionSettings,
    ProgressClock,
    evolve,
)
from mr_damper_ros.estimation.local_search import LocalSearch, StopRequestedError
from mr_damper_ros.estimation.observability import (
    current_varies,
    determined_parameters,
    noise_level,
    not_known,
    operating_points_within,
    parameter_ranges,
    varied_parameters,
)
from mr_damper_ros.estimation.record_levels import LevelledProblem, LevelPrior
from mr_damper_ros.estimation.window_fit import WindowFit, fit_window
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.quantities import CoefficientTable
from mr_damper_ros.signals.arrays import Array


def adapted(
    model: Model,
    windows: Sequence[Window],
    reference: Array,
    changed: Array,
    linear: frozenset[str],
) -> Array:
    """The set ``changed`` (p,) with parameters under which the force stays that of ``reference``.

    ``linear`` names those that may follow, of the parameters that are linear in the laws: they are
    solved for at the operating points of the windows.
    """
    speeds, currents = np.array([window.operating_point for window in windows]).T
    coefficients = model.coefficients_at(reference, speeds, currents).T
    table = CoefficientTable(speeds, currents, coefficients, np.zeros_like(coefficients))
    return model.fit_laws(table, changed, linear, no_search)


def no_search(
    cost: Callable[[Array], Array],
    bounds: Sequence[tuple[float, float]],
    start: Array,
    stage: str,
) -> Array:
    """What is not linear stays where it is; see :data:`LawSearch`."""
    return start


_RIDGE = 1e-4
"""Weight that keeps a flat direction from running away: no more than a trace of the misfit."""


class FreeParameters:
    """A pooled problem for unknowns (f,): the parameters at ``places``, each in its own unit.

    ``values`` (p,) are where it starts, ``sizes`` (f,) the units, ``bounds`` those of all
    parameters (p,). A ridge keeps flat directions where they are.
    """

    def __init__(
        self,
        pooled: Misfit,
        values: Array,
        places: Sequence[int],
        sizes: Array,
        bounds: tuple[Array, Array],
    ) -> None:
        self._pooled = pooled
        self._values = np.array(values, dtype=float)
        self._places = list(places)
        self._sizes = sizes
        self._ridge = _RIDGE * np.sqrt(pooled.sample_count)
        self.start = self._values[self._places] / sizes
        low, high = (bound[self._places] / sizes for bound in bounds)
        unbounded = bool(np.all(np.isinf(low)) and np.all(np.isinf(high)))
        self.bounds = None if unbounded else (low, high)

    def parameters(self, unknowns: Array) -> Array:
        """All parameters (p,)."""
        values = self._values.copy()
        values[self._places] = unknowns * self._sizes
        return values

    def residual(self, unknowns: Array) -> Array:
        """Weighted residual of all windows [1], and below it that of the ridge."""
        plain = self._pooled.residual(self.parameters(unknowns))
        return np.concatenate((plain, self._ridge * (unknowns - self.start)))

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual by the unknowns."""
        derivatives = self._pooled.jacobian(self.parameters(unknowns), self._places) * self._sizes
        return np.concatenate((derivatives, self._ridge * np.eye(len(self._places))))


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
        pooled: Misfit,
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
        self, pooled: Misfit, start: Array, free: frozenset[str], nelder_mead: bool
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


_SEARCH_SAMPLES = 8000
_FEWEST_SEARCH_SAMPLES = 250
"""The search thins the windows to so many samples in all, and each to no fewer than that; the
last polish uses all samples."""

_STAGE = "each run by itself"

_OTHER_DIRECTION = 0.1
"""Less than this part of the samples in the other direction does not show the reversal."""


class SeparateFits:
    """Fits of the windows one by one, thinned; what they leave of the force is the noise of each.

    ``pooled``: the misfit of one set to all of the thinned windows, weighed by their noise, with
    the ``levels`` of their records if they have any.
    """

    pooled: Misfit

    def __init__(
        self,
        model: Model,
        windows: Sequence[Window],
        clock: ProgressClock,
        levels: LevelPrior | None = None,
    ) -> None:
        self._model = model
        self._levels = levels
        self._thinned = thinned_for_search(windows)
        self._clock = clock
        self.fits: list[WindowFit] = []
        self.evaluations = 0

    def fit(self, start: Array, known: Array | None = None) -> None:
        """Fit each window from ``start``; that of varying current from ``known``, if it is better.

        Without its dependence on the current no law comes near to the force of such a window.
        Raises StopRequestedError where the clock has stopped it; what was known before then stays.
        """
        found = []
        for window in self._thinned:
            starts = [start]
            if known is not None and current_varies(window):
                starts.append(known)
            fits = [
                fit_window(
                    self._model, window, each, method="least_squares", should_stop=self._stops
                )
                for each in starts
            ]
            found.append(min(fits, key=lambda fit: fit.rmse))
        self.evaluations += sum(fit.evaluations for fit in found)
        if not (self._clock.stopped and self.fits):
            self.fits = found
            self.pooled = self.misfit(self._thinned)
        if self._clock.stopped:
            raise StopRequestedError

    def _stops(self) -> bool:
        return self._clock.poll(_STAGE, math.nan)

    def misfit(self, windows: Sequence[Window], known: Array | None = None) -> Misfit:
        """The misfit of one set to these windows, the same ones, thinned or not."""
        return levelled(Misfit(self._model, windows, self._noise(), known), self._levels)

    def _noise(self) -> list[float]:
        """RMSE [N] of the fit of each window, for those of one direction at least a usual share.

        A part of a stroke is fitted by nearly any law: what that leaves is not what the law leaves.
        """
        rmse = np.array([fit.rmse for fit in self.fits])
        size = np.array([np.sqrt(np.mean(window.force**2)) for window in self._thinned])
        share = float(np.linalg.norm(rmse) / np.linalg.norm(size))
        rising = np.array([np.mean(window.motion.velocity > 0.0) for window in self._thinned])
        one_sided = np.abs(rising - 0.5) > 0.5 - _OTHER_DIRECTION
        return np.where(one_sided, np.maximum(rmse, share * size), rmse).tolist()

    @property
    def operating_points(self) -> tuple[list[float], list[float]]:
        """Peak velocities [m/s] and currents [A] of the windows."""
        return _points(self.fits)

    def table(self) -> CoefficientTable:
        """The coefficients of all windows."""
        return _table(self.fits)

    def without_search(self, start: Array) -> list[Array]:
        """Parameters (p,) from those windows that were fitted before a stop, as far as they go.

        Those of one of them, and the laws over all as far as they are linear.
        """
        fitted = [fit for fit in self.fits if fit.success] or self.fits[:1]
        free = varied_parameters(self._model, *_points(fitted))
        laws = self._model.fit_laws(_table(fitted), start, free, no_search)
        return [fitted[0].parameters, laws]


def _points(fits: Sequence[WindowFit]) -> tuple[list[float], list[float]]:
    speeds, currents = zip(*(fit.operating_point for fit in fits), strict=True)
    return list(speeds), list(currents)


def _table(fits: Sequence[WindowFit]) -> CoefficientTable:
    speeds, currents = _points(fits)
    return CoefficientTable(
        peak_velocity=np.array(speeds),
        current=np.array(currents),
        coefficients=np.array([fit.coefficients for fit in fits]),
        errors=np.array([np.sqrt(np.diag(fit.coefficient_covariance)) for fit in fits]),
    )


def levelled(pooled: Misfit, levels: LevelPrior | None) -> Misfit:
    """The problem with the levels of its records integrated out, or as it is where None."""
    return pooled if levels is None else LevelledProblem(pooled, levels)


def thinned_for_search(windows: Sequence[Window]) -> list[Window]:
    """The windows with as many samples as a search needs."""
    most = max(_SEARCH_SAMPLES // len(windows), _FEWEST_SEARCH_SAMPLES)
    return [window.thinned(most) for window in windows]


_EVOLUTION_SAMPLES = 200
"""Samples per window where differential evolution evaluates thousands of sets."""

_CLEARLY_BETTER = 0.98
"""A search from elsewhere must lower the mean square by this factor to be preferred."""

_MOST_ROUNDS = 4
"""So often the extension is found anew, as long as that changes what the windows determine."""

_POOR = 4.0
"""Mean square of the weighted residual above which one looks further: twice the noise."""

_KNOWN = "an earlier search"


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
        clock: ProgressClock,
        known: Array | None,
        later: int = 0,
        levels: LevelPrior | None = None,
    ) -> None:
        """``later`` generations follow this search; DataError where there are no windows."""
        self._levels = levels
        if not windows:
            raise DataError("there are no windows to identify from")
        self.model = model
        self.windows = windows
        self._known = known
        self._start = start
        self._settings = settings
        self._names = model.parameter_names
        top_current = max(float(np.max(np.abs(window.current))) for window in windows)
        self._neutral = model.without_dependence(start, top_current)
        self._own_neutral = model.without_dependence(model.initial_values()[0], top_current)
        self._varied = varied_parameters(model, *operating_points_within(windows))
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
        self._clock = clock
        self._later = later
        self._polish = PooledPolish(model, self._sizes, self._clock)
        self._evaluations = 0
        self.free: frozenset[str] = frozenset()
        self.best = start
        self.shortcoming = ""
        self.candidates: list[Candidate] = []
        self._separate = SeparateFits(model, windows, clock, levels)

    @property
    def evaluations(self) -> int:
        """Of the force, or of its cheaper stand-ins, so far."""
        return self._evaluations + self._polish.evaluations + self._separate.evaluations

    @property
    def fits(self) -> list[WindowFit]:
        """Of each window by itself."""
        return self._separate.fits

    @property
    def pooled(self) -> Misfit:
        """The misfit that is searched with."""
        return self._separate.pooled

    @property
    def exhausted(self) -> bool:
        """Whether the last local search ended at its limit of steps."""
        return self._polish.exhausted

    def run(self, method: str) -> None:
        """Search by one of the methods of :func:`identify_global`.

        Raises StopRequestedError where the report has stopped it; ``best`` then is the best so far.
        """
        try:
            self._run(method)
        except StopRequestedError:
            known = [self.best, self._start, *self._separate.without_search(self._neutral)]
            if self._polish.latest is not None:
                known.append(self._polish.latest)
            self.best = min(known, key=self.pooled.mean_square)
            raise

    def _run(self, method: str) -> None:
        # The laws from two starts, and once more if the samples leave parameters open.
        direct = self._settings.generations if method == "differential_evolution" else 0
        most = self._most_generations + direct
        self._clock.expect(2 * most if self.model.simpler else most)
        self._separate.fit(self._neutral)
        simple = self._by_simpler_law(method, later=most)
        self._varied_between = varied_parameters(self.model, *self._separate.operating_points)
        laws = 2 * self._generations(self._varied_between)
        again = laws if self._current_varies else 0
        self._clock.expect(2 * laws + direct + again + self._later)
        candidates = self._candidates(self._varied_between)
        self.best = self._best_of(candidates)
        self.free = self._determined(self.best)
        if self._varied <= self.free:
            self._clock.skip(laws)
        else:
            # The scales must adapt to the values that undetermined parameters are held at.
            determined = self._varied_between & self.free
            again = 2 * self._generations(determined)
            self._clock.skip(laws - again)
            candidates = self._candidates(determined)
        if method == "differential_evolution":
            self.best = self._best_of(candidates)
            by_laws = self.pooled.mean_square(self.best)
            candidates = {"all free parameters": self._evolve_samples()}
        self.best = self._best_of({"laws": self.best, **candidates})
        if self._clock.stopped:
            raise StopRequestedError
        for origin, parameters in {**candidates, **simple}.items():
            polished = self._polish.search(
                self.pooled, parameters, self.free, nelder_mead=method == "nelder_mead"
            )
            cost = self.pooled.mean_square(polished)
            self.candidates.append(Candidate(origin, polished, cost))
            self.best = self._best_of({"so far": self.best, origin: polished})
        first, best = self.candidates[0], min(self.candidates, key=lambda found: found.cost)
        # The first keeps most of the start: the others must be better, not just different.
        clearly = best.cost < _CLEARLY_BETTER * first.cost or best.origin == _KNOWN
        self.best = (best if clearly else first).parameters
        if self._current_varies:
            self._search_again()
        elif not self._varied <= self.free:
            self._let_all_move()
        if self._common or self._current_varies:
            self._take_in_what_is_common()
        self._return_to_start()
        self.best = self._polish.search(self.whole_misfit(), self.best, self.free)
        self._let_go_of_what_is_not_known()
        whole = self.whole_misfit()
        for contained in simple.values():
            if whole.mean_square(contained) < whole.mean_square(self.best):
                self.best = self._polish.search(whole, contained, self.free)
        if method == "differential_evolution" and self.pooled.mean_square(self.best) > by_laws:
            self.shortcoming = (
                "differential evolution ended in a poorer minimum than method global: allow "
                "more generations, or use method global"
            )

    def _by_simpler_law(self, method: str, later: int) -> dict[str, Array]:
        """What the law finds that this one contains, as a candidate; none where it contains none.

        A law with more freedom has more minima, of which the simpler one leads to a good one.
        """
        simpler = self.model.simpler
        if simpler is None:
            return {}
        start = self.model.to_simpler(self._start)
        search = GlobalSearch(
            simpler, self.windows, start, self._settings, self._clock, None, later, self._levels
        )
        try:
            search.run(method)
        finally:
            self._evaluations += search.evaluations
            self.best = self.model.from_simpler(search.best)
        return {f"the simpler law {simpler.name}": self.best}

    @property
    def _most_generations(self) -> int:
        fits = 6 if self._current_varies else 4
        return fits * self._generations(frozenset(self._names))

    def _generations(self, free: frozenset[str]) -> int:
        """At most so many of a fit of the laws."""
        return self._settings.generations * self.model.searched_laws(free)

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

    def _let_go_of_what_is_not_known(self) -> None:
        """Hold what all samples, at the very minimum, do not determine after all.

        At its start's value, where the windows agree with that; else where it is. Of those that
        trade with each other the one is held that can be at its start.
        """
        while self.free:
            whole = self.whole_misfit()
            names = not_known(self.model, whole, self.best, self.free, self._ranges)
            if not names:
                return
            possible = (name for name in names if self._try_start_of([name]))
            self.free -= {next(possible, names[0])}
            self.best = self._polish.search(self.whole_misfit(), self.best, self.free)

    def _moved(self) -> list[str]:
        """Shape parameters that are not determined and not where the start has them."""
        determined = self._determined(self.best)
        return [
            name
            for name in self.model.shape_names
            if not (name in self.free and name in determined)
            and self.best[self._names.index(name)] != self._start[self._names.index(name)]
        ]

    def _try_start_of(self, names: Sequence[str]) -> bool:
        """Give the named parameters the start's values; False where the windows do not agree."""
        best, free = self.best, self.free
        places = [self._names.index(name) for name in names]
        trial = best.copy()
        trial[places] = self._start[places]
        self.free = free.difference(names)
        linear = self.free.intersection(self.model.linear)
        try:
            follows = adapted(self.model, self.windows, best, trial, linear)
            found = self._polish.search(self.pooled, follows, self.free)
        except StopRequestedError:
            self.best, self.free = best, free
            raise
        if _CLEARLY_BETTER * self.pooled.mean_square(found) <= self.pooled.mean_square(best):
            self.best = found
            return True
        self.free = free
        return False

    def _let_all_move(self) -> None:
        """Search over all that was varied: what of it is determined, only a good fit can tell.

        Where the outcome is poor, too from what every window by itself has found, which is good
        where one of them shows more than the others, such as the reversal; the scales first.
        """
        starts = [found.parameters for found in self.candidates]
        best = self._best_polished(starts, self._varied)
        if self.pooled.mean_square(best) > _POOR:
            scales = self._varied.intersection(self.model.linear)
            own = [self._polish.search(self.pooled, fit.parameters, scales) for fit in self.fits]
            best = min(best, self._best_polished(own, self._varied), key=self.pooled.mean_square)
        if self.pooled.mean_square(best) < _CLEARLY_BETTER * self.pooled.mean_square(self.best):
            self.best = best
            self.free = self._determined(best)

    def _search_again(self) -> None:
        """From the laws over coefficients that the varying current no longer blurs.

        All that was varied may move: what of it is determined, only a good fit can tell.
        """
        self._separate.fit(self._neutral, self.best)
        self.best = self._best_of({found.origin: found.parameters for found in self.candidates})
        self.free = self._varied
        for origin, parameters in self._candidates(self._varied_between).items():
            found = self._polish.search(self.pooled, parameters, self.free)
            self.best = self._best_of({"so far": self.best, origin: found})
        self.free = self._determined(self.best)

    def _take_in_what_is_common(self) -> None:
        """Fit the windows with what was found for all of them, and see what they determine now.

        Before, what a lag, for one, or a varying current does to the force stood for noise, in
        which much is lost. The fits begin with the model's own initial set: the noise that weighs
        the windows must not depend on where this search began.
        """
        places = self.model.places(self._common)
        for _ in range(_MOST_ROUNDS):
            before = self.free
            neutral = self._own_neutral.copy()
            neutral[places] = self.best[places]
            self._separate.fit(neutral, self.best)
            self.free = self._determined(self.best)
            self.best = self._polish.search(self.pooled, self.best, self.free)
            if self.free == before:
                break

    def whole_misfit(self) -> Misfit:
        """Of all samples, but those that with the best set still depend on an unknown past."""
        return self._separate.misfit(self.windows, self.best)

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
            candidates[_KNOWN] = self._known
        return candidates

    def _best_polished(self, starts: Sequence[Array], free: frozenset[str]) -> Array:
        found = (self._polish.search(self.pooled, start, free) for start in starts)
        return min(found, key=self.pooled.mean_square)

    def _best_of(self, candidates: Mapping[str, Array]) -> Array:
        return min(candidates.values(), key=self.pooled.mean_square)

    def _fit_laws(self, start: Array, free: frozenset[str]) -> Array:
        table = self._separate.table()
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
        self._evaluations += count
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
        misfit = self._separate.misfit(few)

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
        self._evaluations += count
        result = centre.copy()
        result[places] = found
        return result
