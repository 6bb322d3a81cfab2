"""The most probable parameter set of a model for many windows, with its standard errors.

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
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import compress
from typing import NamedTuple

import numpy as np

from mr_damper_ros.estimation.covariance import (
    SAME_MOTION,
    SIGNIFICANT,
    CyclePhases,
    error_covariances,
    independent_samples,
    noise_level,
    prior_root,
    triangular_factor,
    without_negative_variance,
)
from mr_damper_ros.estimation.differential_evolution import (
    EvolutionSettings,
    ProgressClock,
    Report,
    evolve,
)
from mr_damper_ros.estimation.local_search import (
    MARGIN,
    MOST_STEPS,
    Ending,
    LocalSearch,
    Posterior,
    Prior,
    StopRequestedError,
)
from mr_damper_ros.estimation.observability import (
    SURE,
    current_varies,
    determination_of,
    operating_points_within,
    parameter_ranges,
    parameter_spans,
    varied_parameters,
)
from mr_damper_ros.estimation.record_levels import (
    Level,
    LevelledProblem,
    LevelPrior,
    counted_samples,
)
from mr_damper_ros.estimation.window_fit import WindowFit, fit_window
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import FEWER_PER_CYCLE, Window, following_stride, holds_cycle
from mr_damper_ros.models.domain import Origin
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import ChosenParameters, Misfit
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import MODEL_ERROR, CoefficientTable, LoopReading
from mr_damper_ros.signals.arrays import NEGLIGIBLE, Array
from mr_damper_ros.signals.error_sums import ErrorSums, pooled

_TINY = float(np.finfo(float).eps)

GLOBAL_METHOD = "global"
"""The default method of a global identification."""

GLOBAL_METHODS = (GLOBAL_METHOD, "nelder_mead", "least_squares", "differential_evolution")


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

FEW_SAMPLES = 250
"""Smallest number of samples of a thinned window or piece, if it has them."""


class ExcerptSize(NamedTuple):
    """Size of reduced windows: ``samples`` in total, but at least ``fewest`` of each window.

    For a law with memory, ``samples`` also limits the steps of all pieces.
    """

    samples: int
    fewest: int


_SEARCHED = ExcerptSize(8000, FEW_SAMPLES)
"""For the search."""

_FITTED = ExcerptSize(100_000, 20_000)
"""For the last fit. More samples hardly change a set, but take longer (``thinned_nrmse_ratio``)."""

_PIECE = 600
"""Length of a piece of a window in steps that resolve the motion, for a law with memory. A piece
holds about three cycles, and the effect of the unknown past ends within the first."""

_MOST_PIECES = 10
"""Largest length of a stretch in pieces. The force is computed for all of it, and in longer records
stretches at random places represent them as well."""

_SEED = 0
"""Seed of the places of stretches and pieces."""

_SEPARATE = 1e-3
"""Relative decrease of the sum of squares below which the separate fit of a window ends."""

_ONE_SIDED = 0.1
"""A window with less than this part of its samples in one direction of motion is one-sided."""


class UnseenErrors(NamedTuple):
    """Errors of a set over samples of a window that its fit has ``seen``, and over as many others.

    ``chance``: standard deviation [N²] of the difference between the mean squares by chance, where
    squared errors within a correlation length count as one.
    """

    seen: ErrorSums
    unseen: ErrorSums
    chance: float

    @property
    def significant(self) -> bool:
        """Whether chance does not explain the larger error of the unseen samples.

        Their mean square then exceeds that of the seen ones by more than :data:`AS_GOOD` and
        :data:`SIGNIFICANT` standard deviations.
        """
        allowed = AS_GOOD * self.seen.rmse**2 + SIGNIFICANT * self.chance
        return self.unseen.rmse**2 > allowed


class Excerpts:
    """Reduced windows: thinned, or cut into pieces for a law with memory.

    Piece k is ``few[k]``; it represents ``stretches[k]``, a part of the window with index
    ``owners[k]``.
    """

    def __init__(self, model: Model, windows: Sequence[Window], size: ExcerptSize) -> None:
        most = max(size.samples // len(windows), size.fewest)
        steps = size.samples // len(windows)
        rng = np.random.default_rng(_SEED)
        self.few: list[Window] = []
        self._others: list[Callable[[], Window | None]] = []
        self.stretches: list[Window] = []
        owners = []
        for place, window in enumerate(windows):
            parts = _pieces(model, window, steps, rng)
            fewest = max(most // len(parts), FEW_SAMPLES)
            for stretch, piece, other in parts:
                self.stretches.append(stretch.thinned(fewest))
                self.few.append(self.stretches[-1] if piece is stretch else piece.thinned(fewest))
                self._others.append(partial(other.thinned if other else piece.left_out, fewest))
            owners += [place] * len(parts)
        self.owners = np.array(owners)
        self._model = model

    def misfit(
        self, noise: Array, levels: LevelPrior | None = None, known: Array | None = None
    ) -> Misfit:
        """Misfit of one set to the pieces; ``noise`` (k,) [N] is the noise of each window."""
        pooled = Misfit(self._model, self.few, noise[self.owners].tolist(), known)
        return _levelled(pooled, None if levels is None else levels.of_pieces(self.owners))

    def unseen_errors(self, sets: Sequence[Array]) -> list[UnseenErrors]:
        """Errors in each window with samples that the excerpts leave out.

        ``sets`` holds the parameters (p,) of each piece.
        """
        model, found = self._model, []
        for owner in np.unique(self.owners):
            places = np.flatnonzero(self.owners == owner).tolist()
            seen = [(self.few[place], sets[place]) for place in places]
            others = [(other, sets[p]) for p in places if (other := self._others[p]()) is not None]
            if others:
                (first, variance), (second, more) = (_errors_of(model, e) for e in (seen, others))
                found.append(UnseenErrors(first, second, math.sqrt(variance + more)))
        return found


def _errors_of(model: Model, pairs: Sequence[tuple[Window, Array]]) -> tuple[ErrorSums, float]:
    """Errors of windows with their parameters (p,), and the variance [N⁴] of the mean square."""
    found = []
    for window, values in pairs:
        settled = model.settled(window, values)
        found.append((model.window_force(window, values)[settled], window.force[settled]))
    with np.errstate(over="ignore", invalid="ignore"):  # of a separate fit that failed
        squares = np.concatenate([(force - measured) ** 2 for force, measured in found])
        variance = float(np.var(squares)) / independent_samples(squares)
        return pooled(ErrorSums.of(*pair) for pair in found), variance


def _pieces(
    model: Model, window: Window, steps: int, rng: np.random.Generator
) -> list[tuple[Window, Window, Window | None]]:
    """Stretches of a window, each with a piece at a random place in it, and another piece.

    The pieces have about this number of ``steps`` in total. The stretch and the piece are the
    window itself if it is short or the law needs no past.
    """
    alone = window, window, None
    if window.steady or not model.needs_past(window):
        return [alone]
    history = window.history
    length = _PIECE * following_stride(history.motion, history.period, FEWER_PER_CYCLE)
    count = max(steps * history.coarse_stride // length, 1)
    if history.current.size <= 2 * count * length:
        return [alone]
    edges = np.linspace(0, history.current.size, count + 1).astype(int)
    found: list[tuple[Window, Window, Window | None]] = []
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        # In a periodic motion or current, pieces at equal distances could all be the same.
        reach = min(end - begin, _MOST_PIECES * length)
        begin += int(rng.integers(0, end - begin - reach + 1))
        stretch = window if reach == history.current.size else window.stretch(begin, reach)
        free = reach // 2 - length
        first, second = begin + rng.integers(0, free + 1, 2) + rng.permutation([0, free + length])
        piece, other = window.stretch(int(first), length), window.stretch(int(second), length)
        if min(piece.sample_count, other.sample_count) > 1 and np.ptp(piece.force) > 0.0:
            found.append((stretch, piece, other))
    return found or [alone]


def _levelled(pooled: Misfit, levels: LevelPrior | None) -> Misfit:
    """The misfit with the record levels integrated out; unchanged without levels."""
    return pooled if levels is None else LevelledProblem(pooled, levels)


# -- the result ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Candidate:
    """The start of a local search on the samples (``origin``) and its result.

    ``parameters`` (p,); ``cost``: mean square of the weighted residual over the search's samples.
    """

    origin: str
    parameters: Array
    cost: float


@dataclass(frozen=True, eq=False)
class GlobalFit:
    """Result of a global identification.

    ``covariance`` (p, p) belongs to the parameters and is zero for held ones. ``discrepancy`` (p,
    p) is the part of it that comes from model error, NaN if unknown (:mod:`covariance`). ``nrmse``
    (k,): RMSE/std of the force of each window. ``message``: how the search ended. ``noise`` (k,)
    [N]: RMSE of the separate fit of each window. ``cost``: mean square of the residual over all
    samples in units of this noise; it is 1 if only noise is left. ``candidates``: results of the
    local searches from which the set was selected. ``stopped``: whether the search was stopped
    before its end. ``levels``: the prior of the record levels, None without record levels.
    ``spread`` (2, c): standard deviation of the coefficients of single windows about the laws,
    beyond their errors, relative to their sizes (:func:`coefficient_sizes`) [1]; then what is added
    to it in squares per e-fold of frequency away from ``frequency`` [Hz]. ``only_with``: the
    parameters that the windows determine only jointly with the named others. Their variances hold
    for fixed values of the others, so the set gives no standard error for them.
    """

    parameter_set: ParameterSet
    covariance: Array
    discrepancy: Array
    nrmse: Array
    evaluations: int
    success: bool
    message: str
    noise: Array
    cost: float
    candidates: tuple[Candidate, ...] = ()
    stopped: bool = False
    levels: LevelPrior | None = None
    spread: Array = field(default_factory=lambda: np.zeros((2, 1)))
    frequency: float = 1.0
    only_with: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def coefficients(
        self, operating_point: tuple[float, float], frequency: float = math.nan
    ) -> tuple[Array, Array, Array]:
        """Coefficients (c,) at (peak velocity [m/s], current [A]), with their errors in a motion.

        Returns the coefficients, their standard errors and the part of these that comes from model
        error. Both include the spread, because no law follows the coefficients exactly. They hold
        for a motion of this ``frequency`` [Hz], by default the typical one of the windows.
        """
        model, values = self.parameter_set.law, self.parameter_set.values
        coefficients = model.coefficients_at(values, *operating_point)[:, 0]
        gradient = model.coefficient_gradient(values, *operating_point)
        # Parameters without influence on the coefficients must not make the errors NaN.
        used = np.any(gradient != 0.0, axis=0)
        block, gradient = np.ix_(used, used), gradient[:, used]
        if math.isnan(frequency):
            frequency = self.frequency
        cycle = Window.of_sine(operating_point[0], frequency, operating_point[1])
        cycle = replace(cycle, force=model.window_force(cycle, values))
        sizes = coefficient_sizes(model, coefficients, LoopReading.of(cycle))
        near, growth = self.spread * sizes
        spread = near**2 + (growth * math.log(frequency / self.frequency)) ** 2
        errors, discrepancies = (
            np.sqrt(np.einsum("cp,pq,cq->c", gradient, each[block], gradient).clip(0.0) + spread)
            for each in (self.covariance, self.discrepancy)
        )
        return coefficients, errors, discrepancies

    def force_error(self, window: Window) -> Array:
        """Standard error (n,) [N] of the set's force in a motion that was not measured.

        It combines the errors of the parameters and the model error of the law.
        """
        model, values = self.parameter_set.law, self.parameter_set.values
        free = np.flatnonzero(np.diag(self.covariance) > 0.0)
        window = self.parameter_set.held(window)
        jacobian = Misfit(model, [window], [1.0], values).jacobian(values, free.tolist())
        by_parameters = np.sum(jacobian @ self.covariance[np.ix_(free, free)] * jacobian, axis=1)
        # The force of a fit is orthogonal to the residual, and so smaller than the measured force.
        squares = np.mean(self.nrmse**2 / np.maximum(1.0 - self.nrmse**2, _TINY))
        left = float(squares * np.var(model.window_force(window, values)))
        # Rounding may make the first part slightly negative.
        return np.asarray(np.sqrt(np.maximum(by_parameters, 0.0) + left))

    def misfit(self, windows: Sequence[Window]) -> Misfit:
        """The misfit that the search of the set minimised."""
        found = self.parameter_set
        return Excerpts(found.law, windows, _SEARCHED).misfit(self.noise, self.levels, found.values)

    def record_levels(self, windows: Sequence[Window]) -> list[Level]:
        """Gain and offset of each record, in order of its number; empty without record levels."""
        if self.levels is None:
            return []
        misfit = self.misfit(windows)
        assert isinstance(misfit, LevelledProblem)
        return misfit.levels(self.parameter_set.values, self.covariance)


def error_of_set(found: ParameterSet, windows: Iterable[Window]) -> ErrorSums:
    """Error of a set of any model over the settled samples of all windows together."""

    def error_in(window: Window) -> ErrorSums:
        settled = found.settled(window)
        return ErrorSums.of(found.window_force(window)[settled], window.force[settled])

    return pooled(map(error_in, windows))


def coefficient_sizes(model: Model, coefficients: Array, loop: LoopReading) -> Array:
    """Sizes (c,) of coefficients (c,) in a motion, in their units.

    A force that the law does not follow changes a stiffness by this force over the amplitude, a
    viscosity by this force over the speed. The typical size of a coefficient is therefore that of
    its unit in the loop of the motion.
    """
    units = [loop.size(each.unit) for each in model.at_one_current]
    return np.hypot(coefficients, units)


def _excess(squares: Array, variances: Array, apart: Array) -> Array:
    """Variance of deviations beyond their ``variances`` (k,), and its growth with ``apart`` (k,).

    The most likely values for ``squares`` (k,) of normal deviations, by Fisher's scoring. The
    frequency of a motion is not in the laws, so the deviations grow with the distance. If all
    frequencies are equal, an e-fold counts like another motion.
    """
    from scipy.optimize import nnls  # imported late: see entry_points

    columns = np.stack((np.ones_like(apart), apart), axis=1)
    found = np.full(2, np.median(squares))
    for _ in range(MOST_STEPS):
        weights = 1.0 / (variances + columns @ found + _TINY)
        before = found
        found = nnls(columns * weights[:, np.newaxis], (squares - variances) * weights)[0]
        if np.allclose(found, before, rtol=1e-6, atol=0.0):
            break
    return found if np.ptp(apart) > 0.0 else found[[0, 0]]


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


@dataclass(eq=False)
class GlobalSearch:
    """The steps of a global identification, and the best parameters (p,) so far.

    ``free`` (p,) marks, before the search, the parameters that the windows may separate, after it,
    those that they determine. If the windows allow it, the other parameters have their start
    values, or values that describe no dependence on velocity and current. ``noise`` (k,) [N]: RMSE
    of the separate fit of each window; ``fits``: separate fits of the windows or their pieces,
    whose ``loops`` are known; ``pooled``: the misfit that the search minimises; ``evaluations`` of
    the force, or of cheaper approximations. Raises DataError if there are no windows.
    """

    model: Model
    windows: Sequence[Window]
    start: Array
    settings: EvolutionSettings
    clock: ProgressClock
    earlier: Array | None = None
    levels: LevelPrior | None = None

    def __post_init__(self) -> None:
        model, windows, start = self.model, self.windows, self.start
        if not windows:
            raise DataError("there are no windows to identify from")
        speeds, currents = operating_points_within(windows)
        top_current = max(map(abs, currents))
        self._neutral = model.without_dependence(start, top_current)
        self._own_neutral = model.without_dependence(model.initial_values()[0], top_current)
        self.free = self.model.marked(varied_parameters(model, speeds, currents))
        self._ranges = parameter_ranges(model, windows)
        self._excerpts = Excerpts(model, windows, _SEARCHED)
        self._fitted = Excerpts(model, windows, _FITTED)
        # Parameters that one run determines besides the coefficients (such as a compliance), and
        # the effect of a current that varies within a run, are known only after a first search.
        self._again = bool(model.common_names) or any(map(current_varies, windows))
        self.evaluations = 0
        self.fits: list[WindowFit] = []
        self.loops = [LoopReading.of(stretch) for stretch in self._excerpts.stretches]
        self._tolerance = 0.0
        self.best = start
        self.exhausted = False
        self._tried: set[tuple[bytes, bytes]] = set()
        self.shortcoming = ""
        self.candidates: list[Candidate] = []

    def _named(self, marked: np.ndarray) -> frozenset[str]:
        return frozenset(compress(self.model.parameter_names, marked))

    def last_misfit(self) -> Misfit:
        """Misfit over the samples of the last fit, except those that depend on the unknown past."""
        return self._fitted.misfit(self.noise, self.levels, self.best)

    def run(self, method: str) -> Ending:
        """Search by one of the methods of :func:`identify_global`; returns how the search ended.

        If the report stops the search, ``best`` is the best set so far.
        """
        try:
            self.search(method)
            self._finish()
        except StopRequestedError:
            known = (self.best, self.start, *(fit.parameters for fit in self.fits))
            self.best = min(known, key=self.pooled.mean_square)
            self.free = self._determined(self.pooled)
            return Ending.STOPPED
        return Ending.EXHAUSTED if self.exhausted else Ending.CONVERGED

    def refit(self, whole: GlobalSearch, owners: Sequence[int]) -> None:
        """Fit the windows from the result of a finished search, without searching for starts.

        Window k is the window ``owners[k]`` of ``whole``, or a part of it, and reuses its noise and
        separate fits. Raises StopRequestedError when the report stops the search.
        """
        self._tolerance = _SEPARATE
        pairs = zip(whole.fits, whole._excerpts.owners, strict=True)
        self.fits = [fit for fit, owner in pairs if owner in owners]
        self._weigh(whole.noise[list(owners)])
        self.best = self._rough(np.where(self.free, whole.best, self._prior().centre), self.free)
        self._finish()

    def search(self, method: str) -> None:
        """Find the best set on the thinned windows."""
        laws = self.model.searched_laws(self._named(self.free))
        evolutions = (1 + self._again) * (laws + (method == "differential_evolution"))
        self.clock.expect(evolutions * self.settings.generations)
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
        if not (self.clock.stopped and self.fits):
            self.fits, owners = found, self._excerpts.owners
            left, sizes, one_sided = np.array(squares).T
            # Nearly any law fits a part of a stroke, so its residual is too small.
            usual = np.sum(left) / np.sum(sizes) * sizes
            left = np.where(one_sided > 0.0, np.maximum(left, usual), left)
            self._weigh(np.sqrt(np.bincount(owners, left) / np.bincount(owners)))
        if self.clock.stopped:
            raise StopRequestedError

    def _fit_window(self, window: Window, start: Array) -> WindowFit:
        fit = fit_window(
            self.model,
            window,
            start,
            method="least_squares",
            tolerance=_SEPARATE,
            should_stop=lambda: self.clock.poll("separate fits of the runs", math.nan),
        )
        self.evaluations += fit.evaluations
        return fit

    def _weigh(self, noise: Array) -> None:
        """Weight the windows in the ``pooled`` misfit by their ``noise`` (k,) [N]."""
        self.noise = noise
        self.pooled = self._excerpts.misfit(noise, self.levels)

    def _starts(self) -> dict[str, Array]:
        """Starts for the search on the samples, by origin."""
        fits = [*self.fits, *self._fits_by_speed]
        speeds, currents = np.array([fit.operating_point for fit in fits]).T
        table = CoefficientTable(
            speeds,
            currents,
            np.array([fit.coefficients for fit in fits]),
            # Rounding may make the variance of a weakly determined coefficient negative.
            np.sqrt([np.diag(fit.coefficient_covariance).clip(min=0.0) for fit in fits]),
        )
        varied = varied_parameters(self.model, speeds.tolist(), currents.tolist())
        starts = {
            "the laws of the coefficients": self.model.fit_laws(
                table, self._prior().centre, varied & self._named(self.free), self._evolved
            ),
            "the coefficients of one window": min(
                (fit.parameters for fit in fits), key=self.pooled.mean_square
            ),
            "the start": self.start,
        }
        return starts if self.earlier is None else {**starts, "an earlier search": self.earlier}

    @cached_property
    def _fits_by_speed(self) -> list[WindowFit]:
        """Separate fits of the parts of each window with low, medium and high peak velocity.

        A whole window of varying peak velocity has no common coefficients. With a varying current,
        its parts have none either.
        """
        fits: list[WindowFit] = []
        fewest = self.model.unknown_indices.size
        if not self.model.knows_speeds(self.free):
            return fits
        for window in self._excerpts.stretches:
            speeds = window.motion.peak_velocity
            low, *limits, high = np.quantile(speeds, (0.1, 1 / 3, 2 / 3, 0.9)).tolist()
            if high <= low * (1.0 + SAME_MOTION) or current_varies(window):
                continue
            place = np.searchsorted(limits, speeds, side="right")
            parts = [window.part(place == k) for k in range(len(limits) + 1)]
            for part in parts:
                if part.sample_count <= fewest or np.ptp(part.force) == 0.0:
                    continue
                starts = [self._neutral, *(fit.parameters for fit in fits[-1:])]
                left = [self.model.window_force(part, each) - part.force for each in starts]
                start = starts[int(np.argmin(np.linalg.norm(left, axis=-1)))]
                fits.append(self._fit_window(part, start))
        return fits

    def _evolved(
        self,
        cost: Callable[[Array], Array],
        bounds: Sequence[tuple[float, float]],
        start: Array | None,
        stage: str,
    ) -> Array:
        """The result of differential evolution; after a stop, the start, which is then given."""
        if start is not None and self.clock.stopped:
            return start
        best, count = evolve(cost, bounds, self.settings, self.clock, stage=stage, start=start)
        self.evaluations += count
        return best

    def _prior(self) -> Prior:
        """The prior of the parameters, centred on the start where it is plausible."""
        model = self.model
        sizes = MODEL_ERROR * model.typical_sizes(self.windows)
        if self.fits:
            of_fits = np.abs([fit.parameters for fit in self.fits])
            sizes = np.maximum(sizes, np.median(of_fits, axis=0))
        centre, width = np.zeros(sizes.size), _SCALE_WIDTH * np.maximum(sizes, np.abs(self.start))
        for place, name in enumerate(model.parameter_names):
            if name in self._ranges:
                low, high = self._ranges[name]
                plausible = low <= self.start[place] <= high
                centre[place] = (self.start if plausible else self._neutral)[place]
                width[place] = SURE * (high - low)
        return Prior(centre, width)

    def _search_from(self, starts: Mapping[str, Array], method: str) -> None:
        """Coarse least squares from each start, then a full search from the best result."""
        by_laws = math.inf
        self.best = min((self.best, *starts.values()), key=self.pooled.mean_square)
        if self.clock.stopped:
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
            # How good a start is shows only at its minimum.
            ended = self._most_probable(self.pooled, ended, self.free)
            found.append(Candidate(origin, ended, self.pooled.mean_square(ended)))
        least = min(candidate.cost for candidate in found)
        cycles = any(holds_cycle(window.motion.displacement) for window in self.windows)
        if least > _POOR_COST and not cycles and method != "differential_evolution":
            # If windows hold only parts of strokes, the separate fit of one of them may be a better
            # start than the laws.
            scales = self.free & self.model.marked(self.model.linear)
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
        """Reset undetermined parameters to the start, then search once with many samples."""
        open_ = ~self._determined(self.pooled)
        # Holding a parameter may make others undetermined, so repeat. If the misfit does not allow
        # a parameter to be reset, the windows determine it.
        while (returned := self._reset(open_)).any():
            self.free = self.free & ~returned
            open_ = self.free & ~self._determined(self.pooled)
        last = self.last_misfit()
        self.best = self._most_probable(last, self.best, self.free)
        # A search only approaches an optimum on a bound.
        near, (low, high) = MARGIN * self._prior().width, self.model.bounds
        moved = np.where(self.free & (self.best - low < near), low, self.best)
        moved = np.where(self.free & (high - moved < near), high, moved)
        others = self.free & (moved == self.best)
        if np.any(moved != self.best):
            noise, exhausted = noise_level(last.residual(moved)), self.exhausted
            moved = self._least_squares(last, moved, others, noise=noise, most_steps=_BOUND_STEPS)
            self.exhausted = exhausted  # of the search, which this only corrects
            posterior = self._posterior(last, self.free)
            allowed = NEGLIGIBLE * posterior.noise**2
            if posterior.cost(moved) <= posterior.cost(self.best) + allowed:
                self.best = moved

    def _reset(self, marked: np.ndarray) -> np.ndarray:
        """The ``marked`` parameters (p,) that were reset to the start or to no dependence.

        They are reset all together, law by law, or one by one, if the misfit hardly increases.
        """
        held = np.zeros_like(marked)
        singles = ({name} for name in sorted(self._named(marked)))
        groups = [marked & self.model.marked(law) for law in (*self.model.shape_groups, *singles)]
        searched = self.free & self.model.marked(self._ranges)
        for target in (np.where(searched, self._prior().centre, self.start), self._neutral):
            for group in (marked, *groups):
                asked = group & ~held
                if not np.array_equal(self.best[asked], target[asked]):
                    trial, others = np.where(asked, target, self.best), self.free & ~held & ~asked
                    if (key := (trial.tobytes(), others.tobytes())) in self._tried:
                        continue
                    self._tried.add(key)
                    linear = self._named(others).intersection(self.model.linear)
                    trial = with_linear_refitted(self.model, self.windows, self.best, trial, linear)
                    # A few rough steps show whether the misfit increases.
                    trial = self._rough(trial, others)
                    left = self.pooled.mean_square(trial)
                    if not left <= AS_GOOD * self.pooled.mean_square(self.best):
                        continue
                    self.best = self._most_probable(self.pooled, trial, others)
                held = held | asked
        return held

    def _determined(self, misfit: Misfit) -> np.ndarray:
        """Mask (p,) of free parameters on which the windows hold more information than the prior.

        The standard error must also be below the span of the parameter.
        """
        known, places = np.zeros_like(self.free), np.flatnonzero(self.free)
        if places.size:
            width = self._prior().width[places]
            level = noise_level(misfit.residual(self.best))
            factor = triangular_factor(misfit.jacobian(self.best, places.tolist()) / level)
            spans = parameter_spans(self.model, factor, self.best, self._ranges, places.tolist())
            errors = np.linalg.norm(prior_root(factor * width), axis=1)
            known[places] = errors < np.minimum(spans / width, _MORE_THAN_PRIOR)
        return known

    def _posterior(self, misfit: Misfit, free: np.ndarray) -> Posterior[ChosenParameters]:
        """Posterior of the ``free`` parameters, linearised about the best set."""
        places = np.flatnonzero(free).tolist()
        chosen = ChosenParameters(misfit, self.best, places)
        return Posterior(chosen, self._prior().at(places), noise_level(misfit.residual(self.best)))

    def _most_probable(self, pooled: Misfit, start: Array, free: np.ndarray) -> Array:
        """The most probable parameters (p,); only the ``free`` ones are searched."""
        noise = noise_level(pooled.residual(start))
        return self._least_squares(pooled, start, free, noise=noise)

    def _rough(self, start: Array, free: np.ndarray) -> Array:
        """The result (p,) of a few steps of least squares on the thinned windows."""
        tolerance, most_steps = self.model.effort.rough_tolerance, self.model.effort.rough_steps
        return self._least_squares(
            self.pooled, start, free, tolerance=tolerance, most_steps=most_steps
        )

    def _least_squares(
        self,
        pooled: Misfit,
        start: Array,
        free: np.ndarray,
        *,
        noise: float = 1.0,
        tolerance: float | None = None,
        most_steps: int = MOST_STEPS,
        simplex: bool = False,
    ) -> Array:
        """The result (p,) of a local search over the ``free`` parameters."""
        places = np.flatnonzero(free).tolist()
        residual = pooled.residual(start)
        with np.errstate(over="ignore"):
            overflows = not math.isfinite(float(residual @ residual))
        if not places or overflows:
            return start
        chosen = ChosenParameters(pooled, start, places)
        problem = Posterior(chosen, self._prior().at(places), noise)
        stage = "Nelder-Mead" if simplex else "least squares"
        search = LocalSearch(
            problem,
            problem.start,
            lambda: self.clock.poll(stage, search.best_cost / pooled.sample_count),
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
        places, centre = np.flatnonzero(self.free), self.best
        names = self.model.parameter_names
        reach = 3.0 * np.maximum(np.abs(centre), 1e-3)
        ranges = [self._ranges.get(names[k], (-reach[k], reach[k])) for k in places]
        lowest, highest = np.array(ranges).T
        low, high = (bound[places] for bound in self.model.bounds)
        bounds = np.column_stack((np.maximum(lowest, low), np.minimum(highest, high)))
        few = [window.thinned(FEW_SAMPLES) for window in self.windows]
        misfit = _levelled(Misfit(self.model, few, self.noise.tolist()), self.levels)

        def cost(individuals: Array) -> Array:
            sets = np.repeat(centre[np.newaxis], individuals.shape[1], axis=0)
            sets[:, places] = individuals.T
            return misfit.population_cost(sets)

        result, earlier = centre.copy(), None if self.earlier is None else self.earlier[places]
        result[places] = self._evolved(cost, bounds.tolist(), earlier, "all free parameters")
        return result

    def result(self, method: str, ending: Ending) -> GlobalFit:
        """The result of the search, with its standard errors."""
        best, (low, high) = self.best, self.model.bounds
        free = self.free & (best != low) & (best != high)
        covariance, discrepancy = np.zeros((2, best.size, best.size))
        errors = np.full(best.size, math.nan)
        misfit = self.last_misfit()
        if free.any():
            block = np.ix_(free, free)
            covariance[block], discrepancy[block] = self._errors(misfit, free)
            errors[free] = np.sqrt(np.diag(covariance[block]).clip(min=0.0))
            lost = np.isnan(np.diag(covariance))
            covariance[lost] = covariance[:, lost] = 0.0
        parameter_set = self.parameter_set(errors, np.sqrt(np.diag(discrepancy)), method)
        known = self._excerpts.misfit(self.noise, self.levels, best)
        only_with = determination_of(known, self.windows, best).partners(
            dict(zip(self.model.parameter_names, errors.tolist(), strict=True))
        )
        joint = self.model.marked(only_with)
        spread, frequency = self._spread(free)
        errors_of_set = [error_of_set(parameter_set, [window]) for window in self.windows]
        shortcoming = self.shortcoming
        if ending is not Ending.STOPPED:  # who stops a search wants its result at once
            shortcoming = shortcoming or self._unrepresented()
        return GlobalFit(
            parameter_set=replace(
                parameter_set,
                nrmse=pooled(errors_of_set).nrmse,
                standard_errors=np.where(joint, math.nan, parameter_set.standard_errors),
                discrepancies=np.where(joint, math.nan, parameter_set.discrepancies),
            ),
            covariance=covariance,
            discrepancy=discrepancy,
            nrmse=np.array([error.nrmse for error in errors_of_set]),
            evaluations=self.evaluations,
            success=ending is Ending.CONVERGED and not shortcoming,
            message=shortcoming or ending.value,
            noise=self.noise,
            cost=misfit.mean_square(best),
            candidates=tuple(self.candidates),
            stopped=ending is Ending.STOPPED,
            levels=self.levels,
            spread=spread,
            frequency=frequency,
            only_with=only_with,
        )

    def _unrepresented(self) -> str:
        """Why the samples of a fit do not represent the windows; empty if they do.

        The separate fits are checked, too, because the search starts from them.
        """
        separate = [fit.parameters for fit in self.fits]
        errors = [
            *self._excerpts.unseen_errors(separate),
            *self._fitted.unseen_errors([self.best] * len(self._fitted.few)),
        ]
        errors = [each for each in errors if each.significant]
        if not errors:
            return ""
        worst = max(errors, key=lambda each: each.unseen.nrmse)
        return (
            f"the NRMSE is {worst.unseen.nrmse:.2%} on samples that the fit has not used, but "
            f"{worst.seen.nrmse:.2%} on those that it has used: identify parts of the record "
            "separately"
        )

    def parameter_set(self, errors: Array, discrepancies: Array, name: str) -> ParameterSet:
        """The best set; ``errors`` and ``discrepancies`` (p,) are NaN for held parameters."""
        windows, observable = self.windows, np.isfinite(errors)
        speeds = np.concatenate([window.motion.peak_velocity for window in windows])
        slow, fast = np.quantile(speeds, [0.05, 0.95]).tolist()
        # Unless the data determine the current dependence, the law is arbitrary between currents.
        known = windows if self.model.knows_currents(observable) else windows[-1:]
        currents = np.concatenate([window.current for window in known])
        return ParameterSet(
            values=self.best,
            standard_errors=errors,
            discrepancies=np.where(observable, discrepancies, math.nan),
            observable=observable,
            set_id=name,
            source=name,
            peak_velocity_range=(slow, fast),
            dependence_range=(slow, float(speeds.max())),
            current_range=(float(currents.min()), float(currents.max())),
            model=self.model.name,
            largest_force=max(window.largest_force for window in windows),
            origin=Origin.GLOBAL,
        )

    def _errors(self, misfit: Misfit, free: np.ndarray) -> tuple[Array, Array]:
        """Covariance (f, f) of the ``free`` parameters, and the discrepancy in it."""
        if len(misfit.windows) == 1 and self.levels is None:
            jacobian = misfit.jacobian(self.best, np.flatnonzero(free).tolist())
            phases = CyclePhases.of(misfit.windows[0])
            errors = error_covariances(jacobian, misfit.residual(self.best), phases)
            both = np.add(*map(without_negative_variance, errors))
            return both, np.full_like(both, math.nan)  # one motion shows no scatter between motions
        return self._posterior(misfit, free).covariances()

    def _spread(self, free: np.ndarray) -> tuple[Array, float]:
        """The spread (2, c) of a result with these ``free`` parameters, and its frequency.

        It is zero for a law with as many free parameters as windows, and with record levels, which
        account for differences between windows.
        """
        model, fits = self.model, self.fits
        spread = np.zeros((2, len(model.coefficient_names)))
        if self.levels is not None or not fits:
            return spread, 1.0
        gradient = np.any(
            [model.coefficient_gradient(self.best, *fit.operating_point) for fit in fits], axis=0
        )
        freedom = len(fits) - np.count_nonzero(gradient[:, free], axis=1)
        points = np.array([fit.operating_point for fit in fits]).T
        laws = model.coefficients_at(self.best, *points).T
        pairs = zip(laws, self.loops, strict=True)
        sizes = np.array([coefficient_sizes(model, *pair) for pair in pairs])
        squares = ((np.array([fit.coefficients for fit in fits]) - laws) / sizes) ** 2
        variances = np.array([np.diag(fit.coefficient_errors) for fit in fits]) / sizes**2
        finite = np.isfinite(squares + variances)
        squares = np.where(finite, squares, 0.0).clip(max=1.0 / _TINY)
        variances = np.where(finite, variances, math.inf).clip(0.0, 1.0 / _TINY)
        logarithms = np.log([loop.frequency for loop in self.loops])
        apart = (logarithms - np.mean(logarithms)) ** 2
        for place in np.flatnonzero(freedom > 0).tolist():
            larger = squares[:, place] * len(fits) / freedom[place]
            spread[:, place] = np.sqrt(_excess(larger, variances[:, place], apart))
        return spread, math.exp(float(np.mean(logarithms)))


def identify_global(
    model: Model,
    windows: Sequence[Window],
    start: Array,
    settings: EvolutionSettings,
    report: Report | None = None,
    *,
    method: str = GLOBAL_METHOD,
    known: Array | None = None,
    levels: LevelPrior | None = None,
) -> GlobalFit:
    """Identify one parameter set from all windows.

    ``start`` (p,) holds the values that undetermined parameters keep. If the windows cannot be
    fitted with such a value, the parameter gets the value of :meth:`Model.without_dependence`. A
    parameter that would leave its bounds is held at the bound and counts as undetermined.
    ``method``: "global" is described at the top of this module; "nelder_mead" and
    "least_squares" search on the samples, starting from the laws of its coefficients;
    "differential_evolution" searches on the samples over all free parameters at once, like the
    thesis. ``report`` receives the progress and may stop the search, which then returns the best
    set so far with ``success`` False. ``known`` (p,): the result of an earlier search, used as an
    additional start. ``levels``: each record has its own gain and offset. A search without levels
    then comes first, because the weight of their prior follows from the residual of an approximate
    set.

    Raises DataError if there are no windows or a force is constant, ValueError for an unknown
    method.
    """
    if method not in GLOBAL_METHODS:
        raise ValueError(f"method '{method}' is unknown: use one of {', '.join(GLOBAL_METHODS)}")
    # A C library that has freed such an array keeps the memory of all smaller ones for reuse;
    # returning and mapping it again takes 8 % of the time of a search.
    np.empty(31 << 20, np.uint8)
    start = np.asarray(start, dtype=float)
    clock = ProgressClock(1, report)

    def searched(known: Array | None, levels: LevelPrior | None) -> GlobalFit:
        search = GlobalSearch(model, windows, start, settings, clock, known, levels)
        return search.result(method, search.run(method))

    fit = searched(known, None)
    if levels is None:
        return fit
    # The set without levels gives a rough count of the samples, the set with them a better one.
    for _ in range(2):
        found = fit.parameter_set
        misfit = Misfit(model, windows, fit.noise.tolist(), found.values)
        levels = replace(levels, counted_samples=counted_samples(misfit, levels, found.values))
        if fit.stopped:
            break
        fit = searched(found.values, levels)
    return replace(fit, levels=fit.levels or levels)
