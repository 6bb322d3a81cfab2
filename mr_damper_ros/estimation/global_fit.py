"""One parameter set of a model for many windows, with its standard errors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mr_damper_ros.estimation.covariance import (
    error_covariances,
    samples_per_cycle,
    without_negative_variance,
)
from mr_damper_ros.estimation.differential_evolution import (
    EvolutionSettings,
    ProgressClock,
    Report,
)
from mr_damper_ros.estimation.global_search import Candidate, Excerpts, GlobalSearch
from mr_damper_ros.estimation.local_search import MOST_STEPS, Ending, StopRequestedError
from mr_damper_ros.estimation.record_levels import (
    Level,
    LevelledProblem,
    LevelPrior,
    counted_samples,
)
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.parameter_set import GLOBAL_SOURCE, ParameterSet
from mr_damper_ros.models.quantities import LoopReading
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.error_sums import ErrorSums, pooled

_TINY = float(np.finfo(float).eps)

GLOBAL_METHODS = (GLOBAL_SOURCE, "nelder_mead", "least_squares", "differential_evolution")


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
    to it in squares per e-fold of frequency away from ``frequency`` [Hz].
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
            np.sqrt(np.einsum("cp,pq,cq->c", gradient, each[block], gradient) + spread)
            for each in (self.covariance, self.discrepancy)
        )
        return coefficients, errors, discrepancies

    def force_error(self, window: Window) -> Array:
        """Standard error (n,) [N] of the set's force in a motion that was not measured.

        It combines the errors of the parameters and the model error of the law.
        """
        model, values = self.parameter_set.law, self.parameter_set.values
        free = np.flatnonzero(np.diag(self.covariance) > 0.0)
        jacobian = Misfit(model, [window], [1.0], values).jacobian(values, free.tolist())
        by_parameters = np.sum(jacobian @ self.covariance[np.ix_(free, free)] * jacobian, axis=1)
        # The force of a fit is orthogonal to the residual, and so smaller than the measured force.
        squares = np.mean(self.nrmse**2 / np.maximum(1.0 - self.nrmse**2, _TINY))
        left = float(squares * np.var(model.window_force(window, values)))
        return np.asarray(np.sqrt(by_parameters + left))

    def misfit(self, windows: Sequence[Window]) -> Misfit:
        """The misfit that the search of the set minimised."""
        found = self.parameter_set
        return Excerpts(found.law, windows).misfit(self.noise, self.levels, found.values)

    def record_levels(self, windows: Sequence[Window]) -> list[Level]:
        """Gain and offset of each record, in order of its number; empty without record levels."""
        if self.levels is None:
            return []
        misfit = self.misfit(windows)
        assert isinstance(misfit, LevelledProblem)
        return misfit.levels(self.parameter_set.values, self.covariance)


def error_of_set(found: ParameterSet, windows: Iterable[Window]) -> ErrorSums:
    """Error of a set of any model over the samples of all windows together."""
    return pooled(ErrorSums.of(found.window_force(window), window.force) for window in windows)


def identify_global(
    model: Model,
    windows: Sequence[Window],
    start: Array,
    settings: EvolutionSettings,
    report: Report | None = None,
    *,
    method: str = GLOBAL_SOURCE,
    known: Array | None = None,
    levels: LevelPrior | None = None,
) -> GlobalFit:
    """Identify one parameter set from all windows.

    ``start`` (p,) holds the values that undetermined parameters keep. If the windows cannot be
    fitted with such a value, the parameter gets the value of :meth:`Model.without_dependence`. A
    parameter that would leave its bounds is held at the bound and counts as undetermined.
    ``method``: "global" is described in :mod:`global_search`; "nelder_mead" and "least_squares"
    search on the samples, starting from the laws of the coefficients of that module;
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
        search = GlobalSearch(model, windows, start, settings, clock, earlier=known, levels=levels)
        try:
            search.run(method)
            ending = Ending.EXHAUSTED if search.exhausted else Ending.CONVERGED
        except StopRequestedError:
            ending = Ending.STOPPED
        return replace(_result(search, method, ending), levels=levels)

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


def _result(search: GlobalSearch, method: str, ending: Ending) -> GlobalFit:
    model, best = search.model, search.best
    places = [
        place
        for place, (parameter, value) in enumerate(zip(model.parameters, best, strict=True))
        if parameter.name in search.free and value not in (parameter.low, parameter.high)
    ]
    covariance = np.zeros((best.size, best.size))
    discrepancy = np.zeros_like(covariance)
    errors = np.full(best.size, math.nan)
    misfit = search.whole_misfit()
    if places:
        block = np.ix_(places, places)
        covariance[block], discrepancy[block] = _errors(search, misfit, places)
        errors[places] = np.sqrt(np.diag(covariance[block]))
    parameter_set = set_of(search, errors, np.sqrt(np.diag(discrepancy)), method)
    spread, frequency = _spread(search, places)
    errors_of_set = [error_of_set(parameter_set, [window]) for window in search.windows]
    return GlobalFit(
        parameter_set=replace(parameter_set, nrmse=pooled(errors_of_set).nrmse),
        covariance=covariance,
        discrepancy=discrepancy,
        nrmse=np.array([error.nrmse for error in errors_of_set]),
        evaluations=search.evaluations,
        success=ending is Ending.CONVERGED and not search.shortcoming,
        message=search.shortcoming or ending.value,
        noise=search.noise,
        cost=misfit.mean_square(best),
        candidates=tuple(search.candidates),
        stopped=ending is Ending.STOPPED,
        spread=spread,
        frequency=frequency,
    )


def coefficient_sizes(model: Model, coefficients: Array, loop: LoopReading) -> Array:
    """Sizes (c,) of coefficients (c,) in a motion, in their units.

    A force that the law does not follow changes a stiffness by this force over the amplitude, a
    viscosity by this force over the speed. The typical size of a coefficient is therefore that of
    its unit in the loop of the motion.
    """
    units = [loop.size(each.unit) for each in model.at_one_current]
    return np.hypot(coefficients, units)


def _spread(search: GlobalSearch, places: Sequence[int]) -> tuple[Array, float]:
    """The spread (2, c) of a search whose parameters at ``places`` are free, and its frequency.

    It is zero for a law with as many free parameters as windows, and with record levels, which
    account for differences between windows.
    """
    model, fits = search.model, search.fits
    spread = np.zeros((2, len(model.coefficient_names)))
    if search.levels is not None or not fits:
        return spread, 1.0
    gradient = np.any(
        [model.coefficient_gradient(search.best, *fit.operating_point) for fit in fits], axis=0
    )
    freedom = len(fits) - np.count_nonzero(gradient[:, list(places)], axis=1)
    points = np.array([fit.operating_point for fit in fits]).T
    laws = model.coefficients_at(search.best, *points).T
    pairs = zip(laws, search.loops, strict=True)
    sizes = np.array([coefficient_sizes(model, *pair) for pair in pairs])
    squares = ((np.array([fit.coefficients for fit in fits]) - laws) / sizes) ** 2
    variances = np.array([np.diag(fit.coefficient_errors) for fit in fits]) / sizes**2
    finite = np.isfinite(squares + variances)
    squares = np.where(finite, squares, 0.0).clip(max=1.0 / _TINY)
    variances = np.where(finite, variances, math.inf).clip(0.0, 1.0 / _TINY)
    logarithms = np.log([loop.frequency for loop in search.loops])
    apart = (logarithms - np.mean(logarithms)) ** 2
    for place in np.flatnonzero(freedom > 0).tolist():
        larger = squares[:, place] * len(fits) / freedom[place]
        spread[:, place] = np.sqrt(_excess(larger, variances[:, place], apart))
    return spread, math.exp(float(np.mean(logarithms)))


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


def set_of(search: GlobalSearch, errors: Array, discrepancies: Array, name: str) -> ParameterSet:
    """The best set of a search; ``errors`` and ``discrepancies`` (p,), NaN for held parameters."""
    windows, observable = search.windows, np.isfinite(errors)
    speeds = np.concatenate([window.motion.peak_velocity for window in windows])
    # Unless the data determine the current dependence, the law is arbitrary between the measured
    # currents.
    known = windows if search.model.knows_currents(observable) else windows[-1:]
    currents = np.concatenate([window.current for window in known])
    return ParameterSet(
        values=search.best,
        standard_errors=errors,
        discrepancies=np.where(observable, discrepancies, math.nan),
        observable=observable,
        set_id=name,
        source=name,
        peak_velocity_range=(float(np.quantile(speeds, 0.05)), float(np.quantile(speeds, 0.95))),
        current_range=(float(currents.min()), float(currents.max())),
        model=search.model.name,
        largest_force=max(window.largest_force for window in windows),
    )


def _errors(search: GlobalSearch, misfit: Misfit, places: Sequence[int]) -> tuple[Array, Array]:
    """Covariance (f, f) of the parameters at these places, and the discrepancy in it."""
    if len(misfit.windows) == 1 and search.levels is None:
        jacobian = misfit.jacobian(search.best, places)
        residual = misfit.residual(search.best)
        errors = error_covariances(jacobian, residual, samples_per_cycle(misfit.windows[0]))
        discrepancy = without_negative_variance(errors.discrepancy)
        both = without_negative_variance(errors.repeatability) + discrepancy
        return both, np.full_like(both, math.nan)  # one motion shows no scatter between motions
    return search.posterior(misfit, places).covariances()
