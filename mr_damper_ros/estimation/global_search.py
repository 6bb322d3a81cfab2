"""The most probable parameter set of a model for many windows.

1. Least squares estimates the coefficients of each window separately, as constants within the
   window. The residual of this fit is the noise of the window.
2. The laws of the coefficients over peak velocity and current are fitted to these values, by linear
   least squares where they are linear and by differential evolution otherwise.
3. From the result and a few other starts, least squares on the samples estimates all parameters
   that the windows can separate. A prior describes the plausible range and size of the parameters
   as stated by the model. The samples within a correlation length count as one.

The windows determine a parameter if the data contain more information on it than the prior. If the
windows share a parameter besides the coefficients, such as a compliance, or if the current varies
within a window, step 1 is repeated with the parameters found so far.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import independent_samples, noise_level, triangular_factor
from mr_damper_ros.estimation.differential_evolution import (
    EvolutionSettings,
    ProgressClock,
    evolve,
)
from mr_damper_ros.estimation.local_search import (
    MARGIN,
    MOST_STEPS,
    LocalSearch,
    StopRequestedError,
)
from mr_damper_ros.estimation.observability import (
    SURE,
    current_varies,
    operating_points_within,
    parameter_ranges,
    parameter_spans,
    varied_parameters,
)
from mr_damper_ros.estimation.posterior import Posterior, Prior
from mr_damper_ros.estimation.record_levels import LevelledProblem, LevelPrior
from mr_damper_ros.estimation.window_fit import WindowFit, fit_window
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import Window, holds_cycle
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import ChosenParameters, Misfit
from mr_damper_ros.models.quantities import MODEL_ERROR, CoefficientTable, LoopReading
from mr_damper_ros.signals.arrays import NEGLIGIBLE, Array


def with_linear_refitted(
    model: Model,
    windows: Sequence[Window],
    reference: Array,
    changed: Array,
    linear: frozenset[str],
) -> Array:
    """The set ``changed`` (p,) with its linear parameters refitted to the force of ``reference``.

    ``linear`` names the linear parameters that may change. Least squares at the operating points of
    the windows gives their values.
    """
    speeds, currents = np.array([window.operating_point for window in windows]).T
    coefficients = model.coefficients_at(reference, speeds, currents).T
    table = CoefficientTable(speeds, currents, coefficients, np.zeros_like(coefficients))
    return model.fit_laws(table, changed, linear, lambda cost, bounds, start, stage: start)


# -- separate fit of each window -----------------------------------------------------------------

_SEARCH_SAMPLES = 8000
FEW_SAMPLES = 250
"""A search thins the windows to the first number of samples or steps in total, or to the second
number per window if that is more. The last search uses all samples."""

_PIECE = 600
"""Length of a piece of a window in steps, for a law with memory. A piece holds about three cycles,
and the effect of the unknown past ends within the first."""

_SEPARATE = 1e-3
"""Relative decrease of the sum of squares below which the separate fit of a window ends."""

_STAGE = "separate fits of the runs"


_ONE_SIDED = 0.1
"""A window with less than this part of its samples in one direction of motion is one-sided."""


class Excerpts:
    """Reduced windows for a search: thinned, or cut into pieces for a law with memory.

    Piece k is ``few[k]``; it represents ``stretches[k]``, a part of the window with index
    ``owners[k]``.
    """

    def __init__(self, model: Model, windows: Sequence[Window]) -> None:
        most = max(_SEARCH_SAMPLES // len(windows), FEW_SAMPLES)
        count = max(_SEARCH_SAMPLES // _PIECE // len(windows), 1)
        self.few: list[Window] = []
        self.stretches: list[Window] = []
        owners = []
        for place, window in enumerate(windows):
            pairs = _pieces(model, window, count)
            fewest = max(most // len(pairs), FEW_SAMPLES)
            for stretch, piece in pairs:
                self.stretches.append(stretch.thinned(fewest))
                same = piece is stretch
                self.few.append(self.stretches[-1] if same else piece.thinned(fewest))
            owners += [place] * len(pairs)
        self.owners = np.array(owners)
        self._model = model

    def misfit(
        self, noise: Array, levels: LevelPrior | None = None, known: Array | None = None
    ) -> Misfit:
        """Misfit of one set to the pieces; ``noise`` (k,) [N] is the noise of each window."""
        pooled = Misfit(self._model, self.few, noise[self.owners].tolist(), known)
        return levelled(pooled, None if levels is None else levels.of_pieces(self.owners))


def _pieces(model: Model, window: Window, count: int) -> list[tuple[Window, Window]]:
    """Equal stretches of a window, each with the piece at its centre."""
    if window.steady or not model.needs_past(window):
        return [(window, window)]
    history = window.history
    length = round(_PIECE * history.coarse.period / history.period)
    if history.current.size <= 2 * count * length:
        return [(window, window)]
    edges = np.linspace(0, history.current.size, count + 1).astype(int)
    found = []
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        stretch = window if count == 1 else window.stretch(begin, end - begin)
        piece = window.stretch((begin + end - length) // 2, length)
        if piece.sample_count > 1 and np.ptp(piece.force) > 0.0:
            found.append((stretch, piece))
    return found or [(window, window)]


def levelled(pooled: Misfit, levels: LevelPrior | None) -> Misfit:
    """The problem with the record levels integrated out; unchanged without levels."""
    return pooled if levels is None else LevelledProblem(pooled, levels)


# -- the search ----------------------------------------------------------------------------------

AS_GOOD = 1.02
"""Two sets are equally good if their mean squares differ by at most this factor."""

_SCALE_WIDTH = 3.0
"""Prior standard deviation of a scale about zero, relative to its median size in the separate fits.
"""

_BOUND_STEPS = 2
"""Least-squares steps after a parameter was moved to its bound, from nearly optimal others. With a
whole search, an identification takes a fifth longer."""

_MORE_THAN_PRIOR = math.sqrt(0.5)
"""Standard error relative to the prior at which the windows contain as much information as it."""

_POOR_COST = 4.0
"""Further starts are tried above this mean square of the weighted residual (twice the noise)."""

_MOST_SEPARATE = 4
"""Number of separate fits that serve as further starts."""

_SKIPPED_COST = 30.0
"""A start whose misfit exceeds the best one by this factor is skipped."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """The start of a local search on the samples (``origin``) and its result.

    ``parameters`` (p,); ``cost``: mean square of the weighted residual over the search's samples.
    """

    origin: str
    parameters: Array
    cost: float


class GlobalSearch:
    """The steps of a global identification, and the best parameters (p,) so far.

    ``free``: before the search, the parameters that the windows may separate; after the search, the
    parameters that they determine. If the windows allow it, the other parameters have their start
    values, or values that describe no dependence on velocity and current. ``noise`` (k,) [N]: RMSE
    of the separate fit of each window; ``fits``: separate fits of the windows or their pieces,
    whose ``loops`` are known; ``pooled``: the misfit that the search minimises; ``evaluations`` of
    the force, or of cheaper approximations.
    """

    def __init__(
        self,
        model: Model,
        windows: Sequence[Window],
        start: Array,
        settings: EvolutionSettings,
        clock: ProgressClock,
        earlier: Array | None = None,
        levels: LevelPrior | None = None,
    ) -> None:
        """Raises DataError if there are no windows."""
        if not windows:
            raise DataError("there are no windows to identify from")
        self.model = model
        self.windows = windows
        self._earlier = earlier
        self._start = start
        self._settings = settings
        self._clock = clock
        self.levels = levels
        top_current = max(float(np.max(np.abs(window.current))) for window in windows)
        self._neutral = model.without_dependence(start, top_current)
        self._own_neutral = model.without_dependence(model.initial_values()[0], top_current)
        self.free = varied_parameters(model, *operating_points_within(windows))
        self._ranges = parameter_ranges(model, windows)
        self._excerpts = Excerpts(model, windows)
        # Parameters that one run determines besides the coefficients (such as a compliance), and
        # the effect of a current that varies within a run, are known only after a first search.
        self._again = bool(model.common_names) or any(map(current_varies, windows))
        self.evaluations = 0
        self.fits: list[WindowFit] = []
        self.loops = [LoopReading.of(stretch) for stretch in self._excerpts.stretches]
        self._tolerance = 0.0
        self.best = start
        self.exhausted = False
        self._tried: set[tuple[bytes, frozenset[str]]] = set()
        self.shortcoming = ""
        self.candidates: list[Candidate] = []

    def whole_misfit(self) -> Misfit:
        """Misfit over all samples except those that still depend on the unknown past."""
        misfit = Misfit(self.model, self.windows, self.noise.tolist(), self.best)
        return levelled(misfit, self.levels)

    def run(self, method: str) -> None:
        """Search by one of the methods of :func:`identify_global`.

        Raises StopRequestedError when the report stops the search; ``best`` is then the best set so
        far.
        """
        try:
            self.search(method)
            self._finish()
        except StopRequestedError:
            known = (self.best, self._start, *(fit.parameters for fit in self.fits))
            self.best = min(known, key=self.pooled.mean_square)
            self.free = self._determined(self.pooled)
            raise

    def refit(self, whole: GlobalSearch, owners: Sequence[int]) -> None:
        """Fit the windows from the result of a finished search, without searching for starts.

        Window k is the window ``owners[k]`` of ``whole``, or a part of it, and reuses its noise and
        separate fits. Raises StopRequestedError when the report stops the search.
        """
        self._tolerance = _SEPARATE
        pairs = zip(whole.fits, whole._excerpts.owners, strict=True)
        self.fits = [fit for fit, owner in pairs if owner in owners]
        self._weigh(whole.noise[list(owners)])
        free = np.isin(self.model.parameter_names, list(self.free))
        self.best = np.where(free, whole.best, self._prior().centre)
        self.best = self._rough(self.best, self.free)
        self._finish()

    def search(self, method: str) -> None:
        """Find the best set on the thinned windows."""
        generations = self._settings.generations * self.model.searched_laws(self.free)
        direct = self._settings.generations if method == "differential_evolution" else 0
        self._clock.expect((1 + self._again) * (generations + direct))
        self._fit_windows(self._neutral)
        self._search_from(self._starts(), method)
        if self._again:
            neutral = self._own_neutral.copy()
            places = self.model.places(self.model.common_names)
            neutral[places] = self.best[places]
            self._fit_windows(neutral, self.best)
            self._search_from({"the windows fitted before": self.best, **self._starts()}, method)

    def _fit_windows(self, start: Array, known: Array | None = None) -> None:
        """Fit each thinned window separately; the residual is the noise of its window.

        A window with varying current needs the current dependence of ``known`` (p,); it is fitted
        from there, too, and the better fit is kept. Raises StopRequestedError when the clock stops
        the fits; earlier results are then kept.
        """
        found: list[WindowFit] = []
        squares: list[tuple[float, float, bool]] = []
        scales = self.model.unknown_indices
        for few, whole in zip(self._excerpts.few, self._excerpts.stretches, strict=True):
            starts = np.tile(start, (1 + len(found), 1))
            starts[1:, scales] = [other.parameters[scales] for other in found] or 0.0
            # Start from the best result so far; other starts are not tried.
            left = [self.model.window_force(few, each) - few.force for each in starts]
            fit = self._fit_window(few, starts[int(np.argmin(np.linalg.norm(left, axis=-1)))])
            if known is not None and current_varies(few):
                fit = min(fit, self._fit_window(few, known), key=lambda each: each.rmse)
            found.append(fit if whole is few else self._fit_window(whole, fit.parameters))
            values = found[-1].parameters
            residual = self.model.window_force(whole, values) - whole.force
            square = float(np.mean(residual[self.model.settled(whole, values)] ** 2))
            rising = float(np.mean(whole.motion.velocity > 0.0))
            one_sided = abs(rising - 0.5) > 0.5 - _ONE_SIDED
            squares.append((square, float(np.mean(whole.force**2)), one_sided))
        if not (self._clock.stopped and self.fits):
            self.fits, owners = found, self._excerpts.owners
            left, sizes, one_sided = np.array(squares).T
            # Nearly any law fits a part of a stroke, so its residual is too small.
            usual = np.sum(left) / np.sum(sizes) * sizes
            left = np.where(one_sided > 0.0, np.maximum(left, usual), left)
            self._weigh(np.sqrt(np.bincount(owners, left) / np.bincount(owners)))
        if self._clock.stopped:
            raise StopRequestedError

    def _fit_window(self, window: Window, start: Array) -> WindowFit:
        fit = fit_window(
            self.model,
            window,
            start,
            method="least_squares",
            tolerance=_SEPARATE,
            should_stop=lambda: self._clock.poll(_STAGE, math.nan),
        )
        self.evaluations += fit.evaluations
        return fit

    def _weigh(self, noise: Array) -> None:
        """Weight the windows in the ``pooled`` misfit by their ``noise`` (k,) [N]."""
        self.noise = noise
        self.pooled = self._excerpts.misfit(noise, self.levels)

    def _starts(self) -> dict[str, Array]:
        """Starts for the search on the samples, by origin."""
        speeds, currents = np.array([fit.operating_point for fit in self.fits]).T
        table = CoefficientTable(
            speeds,
            currents,
            np.array([fit.coefficients for fit in self.fits]),
            # Rounding may make the variance of a weakly determined coefficient negative.
            np.sqrt([np.diag(fit.coefficient_covariance).clip(min=0.0) for fit in self.fits]),
        )
        between = self.free & varied_parameters(self.model, speeds.tolist(), currents.tolist())
        starts = {
            "the laws of the coefficients": self.model.fit_laws(
                table, self._prior().centre, between, self._search_law
            ),
            "the coefficients of one window": min(
                (fit.parameters for fit in self.fits), key=self.pooled.mean_square
            ),
            "the start": self._start,
        }
        return starts if self._earlier is None else {**starts, "an earlier search": self._earlier}

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

    def _prior(self) -> Prior:
        """The prior of the parameters, centred on the start where it is plausible."""
        model = self.model
        sizes = MODEL_ERROR * model.typical_sizes(self.windows)
        if self.fits:
            of_fits = np.abs([fit.parameters for fit in self.fits])
            sizes = np.maximum(sizes, np.median(of_fits, axis=0))
        centre, width = np.zeros(sizes.size), _SCALE_WIDTH * np.maximum(sizes, np.abs(self._start))
        for place, name in enumerate(model.parameter_names):
            if name in self._ranges:
                low, high = self._ranges[name]
                plausible = low <= self._start[place] <= high
                centre[place] = (self._start if plausible else self._neutral)[place]
                width[place] = SURE * (high - low)
        return Prior(centre, width)

    def _search_from(self, starts: Mapping[str, Array], method: str) -> None:
        """Coarse least squares from each start, then a full search from the best result."""
        by_laws = math.inf
        self.best = min((self.best, *starts.values()), key=self.pooled.mean_square)
        if self._clock.stopped:
            raise StopRequestedError
        if method == "differential_evolution":
            by_laws = self.pooled.mean_square(self.best)
            starts = {"all free parameters": self._evolve_samples()}
        found: list[Candidate] = []
        costs = {origin: self.pooled.mean_square(start) for origin, start in starts.items()}
        for origin in sorted(costs, key=costs.__getitem__):
            least = min((each.cost for each in found), default=math.inf)
            if not costs[origin] < _SKIPPED_COST * least:
                continue
            ended = self._rough(starts[origin], self.free)
            found.append(Candidate(origin, ended, self.pooled.mean_square(ended)))
        least = min(candidate.cost for candidate in found)
        cycles = any(holds_cycle(window.motion.displacement) for window in self.windows)
        if least > _POOR_COST and not cycles and method != "differential_evolution":
            # If windows hold only parts of strokes, the separate fit of one of them may be a better
            # start than the laws.
            scales = self.free.intersection(self.model.linear)
            own = [self._least_squares(self.pooled, fit.parameters, scales) for fit in self.fits]
            for start in sorted(own, key=self.pooled.mean_square)[:_MOST_SEPARATE]:
                ended = self._least_squares(self.pooled, start, self.free)
                found.append(Candidate("one window", ended, self.pooled.mean_square(ended)))
        self.candidates += found
        self.best = min(found, key=lambda candidate: candidate.cost).parameters
        if method == "nelder_mead":
            self.best = self._least_squares(self.pooled, self.best, self.free, simplex=True)
        self.best = self._most_probable(self.pooled, self.best, self.free)
        self.shortcoming = ""
        if self.pooled.mean_square(self.best) > by_laws:
            self.shortcoming = (
                "differential evolution ended in a poorer minimum than a fit of the laws: allow "
                "more generations, or use method global"
            )

    def _finish(self) -> None:
        """Reset undetermined parameters to the start, then search once with all samples."""
        open_ = frozenset(self.model.parameter_names) - self._determined(self.pooled)
        # Holding a parameter may make others undetermined, so repeat. If the misfit does not allow
        # a parameter to be reset, the windows determine it.
        while returned := self._reset(open_):
            self.free -= returned
            open_ = self.free - self._determined(self.pooled)
        whole = self.whole_misfit()
        self.best = self._most_probable(whole, self.best, self.free)
        # A search only approaches an optimum on a bound.
        near, (low, high) = MARGIN * self._prior().width, self.model.bounds
        free = np.isin(self.model.parameter_names, list(self.free))
        moved = np.where(free & (self.best - low < near), low, self.best)
        moved = np.where(free & (high - moved < near), high, moved)
        if np.any(changed := moved != self.best):
            held = {self.model.parameter_names[place] for place in np.flatnonzero(changed)}
            others, noise = self.free - held, noise_level(whole.residual(moved))
            exhausted = self.exhausted  # of the search, which this only corrects
            moved = self._least_squares(whole, moved, others, noise=noise, most_steps=_BOUND_STEPS)
            self.exhausted = exhausted
            posterior = self.posterior(whole, np.flatnonzero(free).tolist())
            allowed = NEGLIGIBLE * posterior.noise**2
            if posterior.cost(moved) <= posterior.cost(self.best) + allowed:
                self.best = moved

    def _reset(self, names: frozenset[str]) -> frozenset[str]:
        """The parameters among ``names`` that were reset to the start or to no dependence.

        They are reset all together, law by law, or one by one, if the misfit hardly increases.
        """
        held: frozenset[str] = frozenset()
        laws = [names.intersection(law) for law in self.model.shape_groups]
        prior, names_of_law = self._prior(), self.model.parameter_names
        shapes = np.array([name in self._ranges and name in self.free for name in names_of_law])
        for target in (np.where(shapes, prior.centre, self._start), self._neutral):
            for group in (names, *laws, *(frozenset({name}) for name in sorted(names))):
                asked = group - held
                places = self.model.places(sorted(asked))
                if not np.array_equal(self.best[places], target[places]):
                    trial, others = self.best.copy(), self.free - held - asked
                    trial[places] = target[places]
                    if (key := (trial.tobytes(), others)) in self._tried:
                        continue
                    self._tried.add(key)
                    linear = others.intersection(self.model.linear)
                    trial = with_linear_refitted(self.model, self.windows, self.best, trial, linear)
                    # A few rough steps show whether the misfit increases.
                    trial = self._rough(trial, others)
                    left = self.pooled.mean_square(trial)
                    if not left <= AS_GOOD * self.pooled.mean_square(self.best):
                        continue
                    self.best = self._most_probable(self.pooled, trial, others)
                held |= asked
        return held

    def _determined(self, misfit: Misfit) -> frozenset[str]:
        """The free parameters for which the windows contain more information than the prior.

        The standard error must also be below the span of the parameter.
        """
        places = [k for k, name in enumerate(self.model.parameter_names) if name in self.free]
        if not places:
            return frozenset()
        width = self._prior().width[places]
        jacobian = misfit.jacobian(self.best, places) / noise_level(misfit.residual(self.best))
        factor = triangular_factor(jacobian)
        spans = parameter_spans(self.model, factor, self.best, self._ranges, places)
        information = (factor * width).T @ (factor * width)
        errors = np.sqrt(np.diag(np.linalg.inv(information + np.eye(len(places)))))
        known = errors < np.minimum(spans / width, _MORE_THAN_PRIOR)
        return frozenset(self.model.parameter_names[k] for k in np.array(places)[known].tolist())

    def posterior(self, misfit: Misfit, places: Sequence[int]) -> Posterior[ChosenParameters]:
        """Posterior of the parameters at these places, linearised about the best set."""
        free = ChosenParameters(misfit, self.best, places)
        return Posterior(free, self._prior().at(places), noise_level(misfit.residual(self.best)))

    def _most_probable(self, pooled: Misfit, start: Array, names: frozenset[str]) -> Array:
        """The most probable parameters (p,); only the named ones are free."""
        noise = noise_level(pooled.residual(start))
        return self._least_squares(pooled, start, names, noise=noise)

    def _rough(self, start: Array, names: frozenset[str]) -> Array:
        """The result (p,) of a few steps of least squares on the thinned windows."""
        tolerance, most_steps = self.model.effort.rough_tolerance, self.model.effort.rough_steps
        return self._least_squares(
            self.pooled, start, names, tolerance=tolerance, most_steps=most_steps
        )

    def _least_squares(
        self,
        pooled: Misfit,
        start: Array,
        names: frozenset[str],
        *,
        noise: float = 1.0,
        tolerance: float | None = None,
        most_steps: int = MOST_STEPS,
        simplex: bool = False,
    ) -> Array:
        """The result (p,) of a local search over the named parameters."""
        places = [place for place, name in enumerate(self.model.parameter_names) if name in names]
        residual = pooled.residual(start)
        with np.errstate(over="ignore"):
            overflows = not math.isfinite(float(residual @ residual))
        if not places or overflows:
            return start
        free = ChosenParameters(pooled, start, places)
        problem = Posterior(free, self._prior().at(places), noise)
        stage = "Nelder-Mead" if simplex else "least squares"
        search = LocalSearch(
            problem,
            problem.start,
            lambda: self._clock.poll(stage, search.best_cost / pooled.sample_count),
        )
        try:
            if simplex:
                search.nelder_mead()
            else:
                # The default ends with steps of a tenth of a standard error.
                search.least_squares(
                    tolerance=tolerance
                    or self._tolerance
                    or NEGLIGIBLE / independent_samples(residual),
                    most_steps=most_steps,
                )
        except StopRequestedError:
            ended = problem.parameters(search.best)
            self.best = min((self.best, ended), key=pooled.mean_square)
            raise
        finally:
            self.exhausted = search.exhausted
            self.evaluations += search.evaluations
        return problem.parameters(search.best)

    def _evolve_samples(self) -> Array:
        names = [name for name in self.model.parameter_names if name in self.free]
        places = self.model.places(names)
        centre = self.best
        reach = 3.0 * np.maximum(np.abs(centre[places]), 1e-3)
        ranges = [self._ranges.get(n, (-r, r)) for n, r in zip(names, reach, strict=True)]
        low, high = (bound[places] for bound in self.model.bounds)
        lowest, highest = np.array(ranges).T
        bounds = np.column_stack((np.maximum(lowest, low), np.minimum(highest, high)))
        few = [window.thinned(FEW_SAMPLES) for window in self.windows]
        misfit = levelled(Misfit(self.model, few, self.noise.tolist()), self.levels)

        def cost(individuals: Array) -> Array:
            sets = np.repeat(centre[np.newaxis], individuals.shape[1], axis=0)
            sets[:, places] = individuals.T
            return misfit.population_cost(sets)

        found, _, count = evolve(
            cost,
            bounds.tolist(),
            self._settings,
            self._clock,
            stage="all free parameters",
            start=None if self._earlier is None else self._earlier[places],
        )
        self.evaluations += count
        result = centre.copy()
        result[places] = found
        return result
