"""One set of the sixteen parameters, or of the nineteen of the extended law, for many windows.

1. Each window gives its seven coefficients (least squares, no dependence on velocity or current
   assumed within it).
2. The laws are fitted to these coefficients: differential evolution over the sixteen parameters
   in their decoupled groups (:mod:`laws`).
3. A local search on the samples themselves, over the parameters that the data determine. It
   begins with the compliance, stiffness and offset of the start; the first two steps take them as
   given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import correlation_length, least_squares_covariance
from mr_damper_ros.estimation.determination import noise_level, plausible_ranges
from mr_damper_ros.estimation.differential_evolution import (
    EvolutionSettings,
    GlobalProgress,
    ProgressClock,
    Report,
    evolve,
)
from mr_damper_ros.estimation.local_search import LocalSearch, StopRequestedError
from mr_damper_ros.estimation.observability import (
    determined_parameters,
    operating_points_within,
    varied_parameters,
)
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.sigmoid.adaptation import adapted
from mr_damper_ros.models.sigmoid.coefficient_laws import (
    CoefficientTable,
    fit_laws,
    searched_laws,
)
from mr_damper_ros.models.sigmoid.extension import (
    COMPLIANCE,
    EXTENDED_NAMES,
    EXTENSION_NAMES,
    SIGMOID_COUNT,
    is_extended,
    name_of_law,
)
from mr_damper_ros.models.sigmoid.law import (
    SCALE_PARAMETER_NAMES,
    SHAPE_PARAMETER_NAMES,
    coefficient_parameter_jacobian,
    operating_point_coefficients,
)
from mr_damper_ros.models.sigmoid.pooled_misfit import PooledMisfit
from mr_damper_ros.models.sigmoid.scale_misfit import Window, longest_lag
from mr_damper_ros.signals.arrays import Array

__all__ = ["GLOBAL_METHODS", "GlobalFit", "GlobalProgress", "identify_global"]

GLOBAL_METHODS = ("global", "nelder_mead", "least_squares", "differential_evolution")

STOPPED = "stopped before it converged: this is the best so far"
"""Message of a fit that ``report`` has stopped."""

_SEARCH_SAMPLES = 8000
_FEWEST_SEARCH_SAMPLES = 250
"""The search thins the windows to so many samples in all, and each to no fewer than that; the
last polish uses all samples."""

_EVOLUTION_SAMPLES = 200
"""Samples per window where differential evolution evaluates thousands of sets."""

_CLEARLY_BETTER = 0.98
"""A search from elsewhere must lower the mean square by this factor to be preferred."""

_USUAL_LAG = 0.02
"""Time constant [s] that a lag of coil and fluid hardly exceeds. Until it is known, what it may
hide at the begin of a window is left out."""

_MOST_ROUNDS = 4
"""So often the extension is found anew, as long as that changes what the windows determine."""

_SHAPES_OF_LAWS = (("a1", "k2", "a2", "I0"), ("k0",), ("a4",), ("k3", "a3", "I1"))

_MEANINGLESS = 0.01
"""A step that lowers the misfit by so many of its variances is a tenth of a standard error."""

_RIDGE = 1e-4
"""Weight that keeps a flat direction from running away: no more than a trace of the misfit."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """Where a local search on the samples began (``origin``), and what it found.

    ``parameters`` (p,); ``cost``: mean square of the weighted residual over the search's samples.
    """

    origin: str
    parameters: Array
    cost: float


@dataclass(frozen=True, eq=False)
class GlobalFit:
    """Result of a global identification.

    ``covariance`` (p, p) of the parameters, zero where a parameter was held; ``nrmse`` (k,):
    RMSE/std of the force, window by window; ``message`` says how it ended. ``noise`` (k,) [N]:
    what each window's own coefficients leave of its force; ``cost``: mean square over all samples
    of the residual in units of it, 1 where nothing but noise is left. ``candidates``: the local
    searches of which this is the outcome.
    """

    parameter_set: ParameterSet
    covariance: Array
    nrmse: Array
    evaluations: int
    success: bool
    message: str
    noise: Array
    cost: float
    candidates: tuple[Candidate, ...] = ()

    def coefficients(self, operating_point: tuple[float, float]) -> tuple[Array, Array]:
        """Coefficients (7,) and their standard errors at (peak velocity [m/s], current [A])."""
        values = self.parameter_set.values[:SIGMOID_COUNT]
        covariance = self.covariance[:SIGMOID_COUNT, :SIGMOID_COUNT]
        coefficients = np.concatenate(operating_point_coefficients(values, *operating_point))
        gradient = coefficient_parameter_jacobian(values, *operating_point)[0]
        errors = np.sqrt(np.einsum("cp,pq,cq->c", gradient, covariance, gradient))
        if coefficients[0] < 0.0:
            # Yield force and steepness may change sign together: the positive pair is meant.
            coefficients[:2] *= -1.0
        return coefficients, errors

    @property
    def median_nrmse(self) -> float:
        """Median over the windows."""
        return float(np.median(self.nrmse))


def neutral_shape(parameters: Array, top_current: float) -> Array:
    """The same scales with coefficients that depend on neither peak velocity nor current.

    ``v_h`` and ``v_d`` stay proportional to the peak velocity. Where k2 or k3 is freed, the
    coefficient rises smoothly up to ``top_current`` [A] and saturates beyond. Shape (16,) or
    (19,), as that of the parameters.
    """
    names = EXTENDED_NAMES[: len(parameters)]
    values = dict(zip(names, np.asarray(parameters, dtype=float), strict=True))
    values.update(dict.fromkeys(("a1", "k0", "a4", "k2", "k3", "I0", "I1"), 0.0))
    values.update(dict.fromkeys(("a2", "a3"), 2.0 / max(top_current, 1e-12)))
    return np.array(list(values.values()))


def identify_global(
    windows: Sequence[Window],
    start: Array,
    settings: EvolutionSettings,
    report: Report | None = None,
    *,
    method: str = "global",
    known: Array | None = None,
) -> GlobalFit:
    """One parameter set for all windows.

    ``start`` (16,) or (19,) tells the law, and the values that undetermined parameters keep (one
    with which the windows cannot be fitted takes that of :func:`neutral_shape`); a compliance
    that would become negative is held at 0 and counts as undetermined. ``method``: "global" as
    described above; "nelder_mead" and "least_squares" search on the samples from the
    laws; "differential_evolution" searches on the samples over all free parameters at once, as
    the thesis does. ``report`` hears of the progress and may stop the search: the best so far is
    then returned with ``success`` False. ``known`` (p,): the outcome of an earlier search, from
    which this one starts as well.

    Raises ValueError where there are no windows, a force does not change, or for an unknown
    method.
    """
    if method not in GLOBAL_METHODS:
        raise ValueError(f"method '{method}' is unknown: use one of {', '.join(GLOBAL_METHODS)}")
    start = np.asarray(start, dtype=float)
    search = _GlobalSearch(windows, start, settings, report, known)
    message = "converged"
    try:
        search.run(method)
        message = search.shortcoming or message
    except StopRequestedError:
        message = STOPPED
        search.best = min((search.best, start), key=search.pooled.mean_square)
    return _result(search, method, message)


class _GlobalSearch:
    """The steps of a global identification, and the best parameters (p,) so far."""

    def __init__(
        self,
        windows: Sequence[Window],
        start: Array,
        settings: EvolutionSettings,
        report: Report | None,
        known: Array | None,
    ) -> None:
        if not windows:
            raise ValueError("there are no windows to identify from")
        self.windows = windows
        self._known = known
        self._start = start
        self._settings = settings
        self._names = EXTENDED_NAMES[: start.size]
        self._thinned = thinned_for_search(windows)
        top_current = max(float(np.max(np.abs(window.current))) for window in windows)
        self._neutral = neutral_shape(start, top_current)
        self.evaluations = 0
        self._fit_windows(self._neutral)
        speeds, currents = operating_points_within(windows)
        self._varied = varied_parameters(speeds, currents)
        self._varied_between = varied_parameters(
            [fit.operating_point[0] for fit in self.fits],
            [fit.operating_point[1] for fit in self.fits],
        )
        self._bounds = parameter_ranges(windows, start)
        if is_extended(start):
            self._varied |= frozenset(EXTENSION_NAMES)
        self._ranges = {name: high - low for name, (low, high) in self._bounds.items()}
        self._report = report
        self.free: frozenset[str] = frozenset()
        self.best = start
        self.shortcoming = ""
        self.candidates: list[Candidate] = []

    def run(self, method: str) -> None:
        # The laws from two starts, and once more if the samples leave parameters open.
        laws = 2 * self._settings.generations * searched_laws(self._varied_between)
        direct = self._settings.generations if method == "differential_evolution" else 0
        self._clock = ProgressClock(max(2 * laws + direct, 1), self._report)
        candidates = self._candidates(self._varied_between)
        self.best = self._best_of(candidates)
        self.free = self._determined(self.best)
        if self._varied <= self.free:
            self._clock.skip(laws)
        else:
            # The scales must adapt to the values that undetermined parameters are held at.
            determined = self._varied_between & self.free
            again = 2 * self._settings.generations * searched_laws(determined)
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
        if is_extended(self.best):
            self._take_in_the_extension()
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
        laws = [[name for name in law if name in moved] for law in _SHAPES_OF_LAWS]
        for names in (moved, *laws, *([name] for name in moved)):
            still = self._moved()
            if names and set(names) <= set(still):
                self._try_start_of(names)

    def _moved(self) -> list[str]:
        """Shape parameters that are not determined and not where the start has them."""
        determined = self._determined(self.best)
        return [
            name
            for name in SHAPE_PARAMETER_NAMES
            if not (name in self.free and name in determined)
            and self.best[self._names.index(name)] != self._start[self._names.index(name)]
        ]

    def _try_start_of(self, names: Sequence[str]) -> None:
        best, free = self.best, self.free
        places = [self._names.index(name) for name in names]
        trial = best.copy()
        trial[places] = self._start[places]
        self.free = free.difference(names)
        linear = self.free.intersection((*SCALE_PARAMETER_NAMES, "k2", "k3"))
        try:
            found = self._local(self.pooled, adapted(self.windows, best, trial, linear), False)
        except StopRequestedError:
            self.best, self.free = best, free
            raise
        if _CLEARLY_BETTER * self.pooled.mean_square(found) <= self.pooled.mean_square(best):
            self.best = found
        else:
            self.free = free

    def _fit_windows(self, start: Array) -> None:
        self.fits = [fit_window(w, start, method="least_squares") for w in self._thinned]
        self.pooled = self._misfit(self._thinned, _USUAL_LAG)
        self.evaluations += sum(fit.evaluations for fit in self.fits)

    def _take_in_the_extension(self) -> None:
        """Fit the windows with the extension that was found, and see what they determine now.

        Before, what the lag does to the force stood for noise, in which much is lost.
        """
        for _ in range(_MOST_ROUNDS):
            before = self.free
            neutral = self._neutral.copy()
            neutral[SIGMOID_COUNT:] = self.best[SIGMOID_COUNT:]
            self._fit_windows(neutral)
            self.free = self._determined(self.best)
            self.best = self._local(self.pooled, self.best, False)
            if self.free == before:
                break

    def whole_misfit(self) -> PooledMisfit:
        """Of all samples, but those where the lag that was found may not have settled."""
        return self._misfit(self.windows, longest_lag(self.windows, self.best))

    def _misfit(self, windows: Sequence[Window], slowest_lag: float) -> PooledMisfit:
        return PooledMisfit(windows, [fit.rmse for fit in self.fits], slowest_lag)

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
        sixteen, rest = np.split(start, [SIGMOID_COUNT])
        parameters, count = fit_laws(table, sixteen, free, self._settings, self._clock)
        self.evaluations += count
        return np.concatenate((parameters, rest))

    def _determined(self, parameters: Array) -> frozenset[str]:
        jacobian = self.pooled.jacobian(parameters) / noise_level(self.pooled, parameters)
        return determined_parameters(jacobian, self._varied, self._ranges)

    def _evolve_samples(self) -> Array:
        names = [name for name in self._names if name in self.free]
        places = [self._names.index(name) for name in names]
        centre = self.best
        bounds = []
        for name, place in zip(names, places, strict=True):
            reach = 3.0 * max(abs(float(centre[place])), 1e-3)
            bounds.append(self._bounds.get(name, (-reach, reach)))
        few = [window.thinned(_EVOLUTION_SAMPLES) for window in self.windows]
        misfit = self._misfit(few, _USUAL_LAG)

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

    def _local(self, pooled: PooledMisfit, start: Array, nelder_mead: bool) -> Array:
        found = self._polish(pooled, start, self.free, nelder_mead)
        if COMPLIANCE in self._names:
            place = self._names.index(COMPLIANCE)
            if found[place] < 0.0:
                # The best that is allowed lies on the bound.
                found[place] = 0.0
                found = self._polish(pooled, found, self.free - {COMPLIANCE}, False)
        return found

    def _polish(
        self, pooled: PooledMisfit, start: Array, free: frozenset[str], nelder_mead: bool
    ) -> Array:
        problem = _FreeProblem(pooled, start, free, self._ranges)
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


def parameter_ranges(
    windows: Sequence[Window], parameters: Array
) -> dict[str, tuple[float, float]]:
    """Plausible ranges of the shape parameters, and of the extension if these (p,) have one."""
    speeds, _ = operating_points_within(windows)
    top_current = max(float(np.max(np.abs(window.current))) for window in windows)
    ranges = plausible_ranges(max(speeds), top_current)
    return {**ranges, **extension_bounds(windows)} if is_extended(parameters) else ranges


def extension_bounds(windows: Sequence[Window]) -> dict[str, tuple[float, float]]:
    """Plausible bounds of the extension, from what the data span.

    The compliance gives way to the force by no more than the amplitude of any window; the stiffness
    and the offset make no more than all of the force in it.
    """
    stiffnesses, forces = [], []
    for window in windows:
        force = float(np.max(np.abs(window.force)))
        stiffnesses.append(force / window.motion.amplitude)
        forces.append(force)
    return {
        COMPLIANCE: (0.0, 1.0 / max(stiffnesses)),
        "stiffness": (-min(stiffnesses), min(stiffnesses)),
        "offset": (-min(forces), min(forces)),
    }


class _FreeProblem:
    """A pooled misfit as a function of its free parameters, each in units of its own size."""

    def __init__(
        self,
        pooled: PooledMisfit,
        start: Array,
        free: frozenset[str],
        ranges: dict[str, float],
    ) -> None:
        self._pooled = pooled
        self._values = np.array(start)
        names = [name for name in EXTENDED_NAMES[: start.size] if name in free]
        self._places = [EXTENDED_NAMES.index(name) for name in names]
        sizes = [
            max(abs(float(start[place])), 0.05 * ranges.get(name, 1.0))
            for name, place in zip(names, self._places, strict=True)
        ]
        self._sizes = np.array(sizes)
        self.start = self._values[self._places] / self._sizes
        self._ridge = _RIDGE * np.sqrt(pooled.sample_count)

    def parameters(self, unknowns: Array) -> Array:
        values = self._values.copy()
        values[self._places] = unknowns * self._sizes
        return values

    def residual(self, unknowns: Array) -> Array:
        # The ridge keeps flat directions where they are.
        return np.concatenate(
            (
                self._pooled.residual(self.parameters(unknowns)),
                self._ridge * (unknowns - self.start),
            )
        )

    def jacobian(self, unknowns: Array) -> Array:
        derivatives = self._pooled.jacobian(self.parameters(unknowns), self._places)
        derivatives *= self._sizes
        return np.concatenate((derivatives, self._ridge * np.eye(len(self._places))))


def _independent(residual: Array) -> float:
    """How many independent samples (n,) amount to: correlated ones count once together."""
    return residual.size / max(correlation_length(residual), 1)


def _result(search: _GlobalSearch, method: str, message: str) -> GlobalFit:
    best = search.best
    names = EXTENDED_NAMES[: best.size]
    places = [
        place
        for place, name in enumerate(names)
        if name in search.free and not (name == COMPLIANCE and best[place] == 0.0)
    ]
    covariance = np.zeros((best.size, best.size))
    errors = np.full(best.size, math.nan)
    misfit = search.whole_misfit()
    if places:
        block = np.ix_(places, places)
        covariance[block] = least_squares_covariance(
            misfit.jacobian(best, places), misfit.residual(best)
        )
        errors[places] = np.sqrt(np.diag(covariance[block]))
    nrmse = []
    for window in search.windows:
        residual = window.predicted_force(best) - window.force
        error = float(np.sqrt(np.mean(residual**2)))
        nrmse.append(error / float(np.std(window.force)))
    speeds = np.concatenate([window.motion.peak_velocity for window in search.windows])
    currents = np.concatenate([window.current for window in search.windows])
    parameter_set = ParameterSet(
        values=best,
        standard_errors=errors,
        observable=np.isfinite(errors),
        set_id=method,
        source=method,
        peak_velocity_range=(float(np.quantile(speeds, 0.05)), float(np.quantile(speeds, 0.95))),
        current_range=(float(currents.min()), float(currents.max())),
        nrmse=float(np.median(nrmse)),
        model=name_of_law(best),
    )
    return GlobalFit(
        parameter_set=parameter_set,
        covariance=covariance,
        nrmse=np.array(nrmse),
        evaluations=search.evaluations,
        success=message == "converged",
        message=message,
        noise=np.array([fit.rmse for fit in search.fits]),
        cost=misfit.mean_square(best),
        candidates=tuple(search.candidates),
    )
