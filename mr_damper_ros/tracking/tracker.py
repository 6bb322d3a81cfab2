"""Follows a damper window by window: the pure object behind the identifier node.

``WindowTracker`` holds what is known (the running set, the baselines, the reservoir) and makes
tasks; ``run_fit`` and ``run_global`` do the work of a task and may run in another process;
``complete`` and ``complete_global`` decide. Tasks are built one after another, each from the
running set that the one before it left, so the same windows always give the same sets.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import (
    GlobalFit,
    GlobalProgress,
    identify_global,
)
from mr_damper_ros.estimation.map_estimate import with_prior
from mr_damper_ros.estimation.model_fit import model_force, unsettled_samples
from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.models import MODELS, Model
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet, known_model
from mr_damper_ros.models.sigmoid.extension import SIGMOID_COUNT
from mr_damper_ros.models.sigmoid.scale_misfit import Window
from mr_damper_ros.models.sigmoid.sigmoid_model import is_sigmoid
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import (
    NO_BETTER,
    AcceptanceSettings,
    Evidence,
    Gatekeeper,
)
from mr_damper_ros.tracking.cusum import ChangeWatch, change_point, fit_scale
from mr_damper_ros.tracking.fluid_temperature import FluidTemperature, TemperatureMaps
from mr_damper_ros.tracking.following import (
    STRENGTH,
    fit_to_window,
    fitted_errors,
    lasting_force,
    scale_of_force,
    shape_is_known,
    strengthened,
)
from mr_damper_ros.tracking.force_scale import Baselines, ForceScale
from mr_damper_ros.tracking.reservoir import OperatingPoint, Reservoir, nearest_same
from mr_damper_ros.tracking.screening import (
    Screening,
    fault_of_motion,
    fault_of_samples,
)
from mr_damper_ros.tracking.tracker_memory import TrackerMemory
from mr_damper_ros.tracking.unscented_filter import (
    METHOD,
    FilterState,
    UnscentedFilter,
    as_fit,
    state_of,
)
from mr_damper_ros.tracking.window_assembler import RawWindow

_CHUNKS = 40
_HELD_BACK_EVERY = 4
"""Of the chunks into which a window is cut, every fourth is held back from the fit."""

_FEWEST_EARLY = 40
"""An early fit needs as many samples: so that each held-back chunk has one."""

EARLY_METHOD = "force_scale"
"""Method of a fit that came early because the force had changed."""

_ASTRAY = 2.0
"""A filter is wrong where held-back samples differ by more than so many times their noise."""

TRACKERS = ("window", METHOD)
"""How the scales are followed: each window on its own, or by a recursive filter."""


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of the identification of windows.

    ``model``: name of the force law; ``tracker``: "window" fits every window; "unscented" is an
    unscented Kalman filter, which uses every sample once and starts from the fit of a window.
    ``method`` of that fit: "nelder_mead" or "least_squares"; ``robust``: bound the influence of
    outliers;
    ``drift_rate`` [1/sqrt(s)]: how fast the filter expects the force to change, see
    :class:`UnscentedFilter`; ``smallest_change`` [1]: a relative change of the force between two
    windows that is worth an early fit; ``global_period``: a global identification after this
    many accepted windows, 0 for never.

    Raises ValueError for an unknown model or tracker, a filter for another model than the sigmoid
    law, or a drift rate or smallest change that is not positive.
    """

    model: str = DEFAULT_MODEL
    tracker: str = "window"
    method: str = "nelder_mead"
    robust: bool = False
    drift_rate: float = 1e-3
    smallest_change: float = 0.02
    global_period: int = 20
    screening: Screening = field(default_factory=Screening)
    acceptance: AcceptanceSettings = field(default_factory=AcceptanceSettings)
    evolution: EvolutionSettings = field(default_factory=EvolutionSettings)

    def __post_init__(self) -> None:
        if self.tracker not in TRACKERS:
            raise ValueError(
                f"tracker '{self.tracker}' is unknown: use one of {', '.join(TRACKERS)}"
            )
        known_model(self.model)
        if self.tracker == METHOD and self.model != DEFAULT_MODEL:
            raise ValueError(
                f"tracker '{METHOD}' follows model '{DEFAULT_MODEL}' only: "
                f"choose tracker 'window' for model '{self.model}'"
            )
        for name in ("drift_rate", "smallest_change"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be positive")


@dataclass(frozen=True, eq=False)
class FitTask:
    """One window, or a look, and the parameters (p,) to start from.

    ``baselines`` are those of the force scale; ``state`` is where the filter stood and ``watch``
    that of the detector of changes, if they run; samples stamped before ``changed_ns`` are of the
    damper before its last sudden change. ``known``: the start is a set of this very damper, and
    holds up to the peak velocity ``fastest`` [m/s], infinite where that is not known.
    """

    window: RawWindow
    start: Array
    settings: TrackerSettings
    state: FilterState | None = None
    watch: ChangeWatch | None = None
    changed_ns: int = 0
    baselines: tuple[WindowFit, ...] = ()
    known: bool = False
    fastest: float = math.inf

    @property
    def model(self) -> Model:
        """The force law."""
        return MODELS[self.settings.model]


@dataclass(frozen=True, eq=False)
class FitResult:
    """What the fit of a task found: ``fault`` says why nothing was fitted, else it is empty."""

    task: FitTask
    fault: str
    window: Window | None = None
    fit: WindowFit | None = None
    evidence: Evidence | None = None
    state: FilterState | None = None
    watch: ChangeWatch | None = None
    scale: ForceScale = field(default_factory=ForceScale)


@dataclass(frozen=True, eq=False)
class GlobalTask:
    """The reservoir's windows and the parameters (p,) of a model to start from."""

    windows: tuple[Window, ...]
    start: Array
    settings: EvolutionSettings
    stamp_ns: int
    model: str = DEFAULT_MODEL


@dataclass(frozen=True, eq=False)
class GlobalResult:
    """What a global identification found; ``fault`` says why nothing, else it is empty."""

    task: GlobalTask
    fault: str
    fit: GlobalFit | None = None
    nrmse_before: float = math.nan


@dataclass(frozen=True, eq=False)
class Report:
    """Outcome of one window or one global identification, as published; SI units.

    ``temperature`` is the measured one; where there is none, ``fluid`` is what the force tells of
    it, once a map of force over temperature has been learnt at the operating point.
    """

    window_start_ns: int
    stamp_ns: int
    sample_count: int
    method: str
    evaluations: int
    nrmse_before: float
    nrmse_after: float
    accepted: bool
    reason: str
    set_id: str
    scale: ForceScale
    peak_velocity: float
    amplitude: float
    frequency: float
    current: float
    temperature: float
    coefficients: Array
    coefficient_errors: Array
    global_due: bool
    fluid: FluidTemperature = field(default_factory=FluidTemperature)


def run_fit(task: FitTask, should_stop: Callable[[], bool] | None = None) -> FitResult:
    """Fit the window of a task; every fault of the data comes back as a sentence.

    Of a look only the watch comes back as long as nothing has changed.
    """
    raw, settings = task.window, task.settings
    fault = fault_of_samples(raw.displacement, raw.force, raw.current, settings.screening)
    if fault:
        return FitResult(task, fault)
    try:
        window = Window.from_samples(
            raw.displacement, raw.force, raw.current, raw.period, raw.peak_velocity
        )
        fault = fault_of_motion(window.motion.velocity, window.force)
        if fault:
            return FitResult(task, fault)
        if raw.look:
            return _look(task, window)
        before_change = math.ceil((task.changed_ns - raw.start_ns) / (raw.period * NANOSECONDS))
        if before_change > 0.5 * window.sample_count:
            return FitResult(task, "most of the window lies before the change of the force")
        window = window.part(slice(max(before_change, 0), None))
        state = _usable(task, window)
        filtered = None if state is None else _filtered(task, window, state)
        if filtered is not None:
            return filtered
        held_back = held_back_samples(window.sample_count)
        model = task.model
        trained = fit_to_window(
            model,
            window.part(~held_back),
            task.start,
            method=settings.method,
            robust=settings.robust,
            should_stop=should_stop,
        )
        if task.known:
            part = window.part(~held_back)
            trained = with_prior(
                model, trained, part, task.start, fastest=task.fastest, robust=settings.robust
            )
        evidence = _evidence(model, held_back, window, task.start, trained.parameters)
        # What is published uses every sample; the held-back part only judged whether to.
        final = fit_to_window(
            model, window, trained.parameters, method="least_squares", robust=settings.robust
        )
        if task.known:
            final = with_prior(
                model, final, window, task.start, fastest=task.fastest, robust=settings.robust
            )
    except ValueError as error:
        return FitResult(task, str(error))
    final = replace(
        final,
        method=settings.method,
        evaluations=trained.evaluations + final.evaluations,
        success=trained.success,
        message=trained.message,
    )
    begun = state_of(final, raw.end_ns) if settings.tracker == METHOD else None
    return _fitted(task, window, final, evidence, begun)


def _usable(task: FitTask, window: Window) -> FilterState | None:
    """The state from which the filter can go on into a window, if there is one.

    A jump in time, or to another operating point, is a new start.
    """
    state = task.state
    if state is None or not state.stamp_ns < task.window.end_ns:
        return None
    same = nearest_same([state.operating_point], window.operating_point)
    return None if same is None else state


def _filtered(task: FitTask, window: Window, state: FilterState) -> FitResult | None:
    """The filter's state after the samples of a window that it has not seen yet.

    None where it has gone astray, as it may where it knew too little of the scales: then it is
    started again from a fit.
    """
    raw, settings = task.window, task.settings
    unseen = round((raw.end_ns - state.stamp_ns) / (raw.period * NANOSECONDS))
    new = window.part(slice(max(window.sample_count - unseen, 0), None))
    held_back = held_back_samples(new.sample_count)
    follower = UnscentedFilter(
        state,
        new,
        task.start,
        raw.end_ns,
        drift_rate=settings.drift_rate,
        robust=settings.robust,
    )
    follower.take_in(~held_back)
    trained = as_fit(follower.state, new, task.start, follower.evaluations).parameters
    evidence = _evidence(task.model, held_back, new, task.start, trained)
    if evidence.rmse_after > _ASTRAY * follower.noise_level:
        return None
    follower.take_in(held_back)
    fit = as_fit(follower.state, window, task.start, follower.evaluations)
    return _fitted(task, window, fit, evidence, follower.state)


def _fitted(
    task: FitTask, window: Window, fit: WindowFit, evidence: Evidence, state: FilterState | None
) -> FitResult:
    """The result of a fit: with its force scale, and a watch for changes from its window on."""
    settled = ~unsettled_samples(task.model, window, fit.parameters)
    predicted = model_force(task.model, window, fit.parameters)
    watch = ChangeWatch.after_fit(
        predicted[settled],
        window.force[settled],
        fit.operating_point,
        task.settings.smallest_change,
    )
    scale = scale_of_force(task.model, window, fit, Baselines(task.baselines))
    return FitResult(task, "", window, fit, evidence, state, watch, scale)


def _look(task: FitTask, window: Window) -> FitResult:
    """See whether the newest samples fit the running set; if not, fit the force scale to them."""
    raw, watch = task.window, task.watch
    if watch is None:
        return FitResult(task, "")
    newest = slice(window.sample_count - raw.look, None)
    here = window.part(newest).operating_point
    if nearest_same([watch.operating_point], here) is None:
        return FitResult(task, "", watch=watch.quiet())
    predicted = model_force(task.model, window, task.start)
    watch = watch.follow(predicted[newest], window.force[newest])
    count = min(watch.samples_since_change, window.sample_count)
    if not watch.changed or count < _FEWEST_EARLY:
        return FitResult(task, "", watch=watch)
    since = slice(window.sample_count - count, None)
    count -= change_point(predicted[since], window.force[since], _FEWEST_EARLY)
    since = slice(window.sample_count - count, None)
    changed, predicted = window.part(since), predicted[since]
    lasting = lasting_force(task.model, changed, task.start)
    own, measured = predicted - lasting, changed.force - lasting
    held_back = held_back_samples(count)
    trained = fit_scale(own[~held_back], measured[~held_back]).factor
    spread = float(np.std(window.force))
    before, after = (
        float(np.sqrt(np.mean((factor * own - measured)[held_back] ** 2)))
        for factor in (1.0, trained)
    )
    evidence = Evidence(before / spread, after / spread, after, trained - 1.0)
    found = fit_scale(own, measured)
    if not found.factor > 0.0 or np.ptp(changed.force) == 0.0:
        return FitResult(task, "", watch=watch)  # a sensor has failed, no damper does that
    fit = strengthened(task.model, changed, task.start, found, EARLY_METHOD)
    state = task.state
    if state is not None:
        factors = np.where(STRENGTH, found.factor, 1.0)
        state = FilterState(
            state.scales * factors,
            state.covariance * np.outer(factors, factors) + fit.covariance,
            raw.end_ns,
            here,
        )
    scale = scale_of_force(task.model, changed, fit, Baselines(task.baselines))
    return FitResult(task, "", changed, fit, evidence, state, watch, scale)


def run_global(
    task: GlobalTask, report: Callable[[GlobalProgress], bool] | None = None
) -> GlobalResult:
    """Global identification of a task's windows; ``report`` returning False stops it early."""
    if not is_sigmoid(MODELS[task.model]):
        return GlobalResult(
            task,
            f"model '{task.model}' does not tell how the force depends on the current: "
            "it has no global identification, every window is fitted on its own",
        )
    try:
        fit = identify_global(task.windows, task.start, task.settings, report)
    except ValueError as error:
        return GlobalResult(task, str(error))
    before = [_nrmse(window, task.start) for window in task.windows]
    return GlobalResult(task, "", fit, float(np.median(before)))


def held_back_samples(count: int) -> np.ndarray:
    """Mask (n,) of the samples that are held back: chunks spread over the whole window."""
    chunk = np.arange(count) * _CHUNKS // max(count, 1)
    return np.asarray(chunk % _HELD_BACK_EVERY == _HELD_BACK_EVERY - 1)


def _nrmse(window: Window, parameters: Array) -> float:
    residual = window.predicted_force(parameters) - window.force
    return float(np.sqrt(np.mean(residual**2)) / np.std(window.force))


def _evidence(
    model: Model, held_back: np.ndarray, window: Window, before: Array, after: Array
) -> Evidence:
    """What the held-back samples (mask, shape (n,)) of a window say of two sets (p,)."""
    settled = ~unsettled_samples(model, window, after)
    spread = float(np.std(window.force))
    old, new = (model_force(model, window, set_) for set_ in (before, after))
    if not np.isfinite(old).all():
        # Whatever was loaded there, anything is better.
        old = np.full(old.size, math.inf)
    rmse_before, rmse_after = (
        float(np.sqrt(np.mean((force - window.force)[held_back & settled] ** 2)))
        for force in (old, new)
    )
    power = float(old[settled] @ old[settled])
    change = math.inf
    if 0.0 < power < math.inf:
        change = float(new[settled] @ old[settled]) / power - 1.0
    return Evidence(rmse_before / spread, rmse_after / spread, rmse_after, change)


class WindowTracker:
    """The running parameter set and all that is needed to judge the next one."""

    def __init__(self, settings: TrackerSettings, initial: ParameterSet) -> None:
        """Raises ParameterError where the initial set is not of the model in the settings."""
        self._settings = settings
        self._initial = initial.of_model(settings.model)
        self._model = initial.law
        self.parameters = initial
        self._remember(TrackerMemory())

    @property
    def memory(self) -> TrackerMemory:
        """All that has been learnt besides the running set."""
        return TrackerMemory(
            windows=self._windows,
            accepted=self._accepted,
            accepted_since_global=self._accepted_since_global,
            history=self._gatekeeper.history,
            baselines=self._baselines.fits,
            reservoir=self._reservoir.windows,
            reservoir_points=self._reservoir.points,
            state=self._state,
            watch=self._watch,
            changed_ns=self._changed_ns,
            temperatures=self._temperatures.histories,
        )

    def _remember(self, memory: TrackerMemory) -> None:
        self._windows = memory.windows
        self._accepted = memory.accepted
        self._accepted_since_global = memory.accepted_since_global
        self._gatekeeper = Gatekeeper(self._settings.acceptance, memory.history)
        self._baselines = Baselines(memory.baselines)
        self._reservoir = Reservoir(memory.reservoir, memory.reservoir_points)
        self._state = memory.state
        self._watch = memory.watch
        self._changed_ns = memory.changed_ns
        self._temperatures = TemperatureMaps(memory.temperatures)
        self._seen_ns = 0

    def resume(self, parameters: ParameterSet, memory: TrackerMemory) -> None:
        """Go on where another tracker was, which may have had other settings.

        Raises ParameterError where the set is of another model.
        """
        self.parameters = parameters.of_model(self._settings.model)
        self._remember(memory)
        if self._settings.tracker != METHOD:
            self._state = None
        if self._watch and self._watch.smallest_change != self._settings.smallest_change:
            self._watch = None

    def _start_again(self) -> None:
        # The number of windows names the sets, so it goes on.
        self._remember(TrackerMemory(windows=self._windows))

    def _forget_scales(self) -> None:
        """What was known of the scales went with another set."""
        self._state = None
        self._watch = None
        self._changed_ns = 0

    @property
    def accepted_windows(self) -> int:
        """Windows accepted since the start or the last reset."""
        return self._accepted

    @property
    def reservoir(self) -> Reservoir:
        """Windows kept for the global identification."""
        return self._reservoir

    def reset(self) -> None:
        """Back to the initial set; baselines and reservoir are forgotten."""
        self.parameters = self._initial
        self._start_again()

    def replace(self, parameters: ParameterSet) -> None:
        """Run with this set (loaded by the user) from now on; it also starts a new baseline.

        Raises ParameterError where the set is of another model.
        """
        self.parameters = parameters.of_model(self._settings.model)
        self._start_again()

    def window_task(self, window: RawWindow) -> FitTask:
        """The task of a window or a look, starting from the running set."""
        if window.end_ns < self._changed_ns:
            self._changed_ns = 0  # time was set back
        return FitTask(
            window,
            self.parameters.values,
            self._settings,
            self._state,
            self._watch,
            self._changed_ns,
            self._baselines.fits,
            known=bool(self.parameters.observable.any()),
            fastest=self.parameters.peak_velocity_range[1],
        )

    def complete(self, result: FitResult) -> Report:
        """Judge the result of a window's task and, if it is accepted, run with it."""
        self._windows += 1
        self._paused_before(result.task.window)
        if result.fit is None or result.window is None or result.evidence is None:
            return self._report(result, result.fault, ForceScale())
        reason = self._gatekeeper.judge(result.evidence)
        if reason in ("", NO_BETTER):
            # The filter learns from every good window, the running set from those that help.
            self._state = result.state
            self._watch = self._watch or result.watch
        if not reason:
            self._watch = result.watch
            self._accept(result.window, result.fit, result)
        report = self._report(result, reason, result.scale)
        if reason not in ("", NO_BETTER):
            return report
        return replace(report, fluid=self._fluid_temperature(result, result.fit.operating_point))

    def _paused_before(self, window: RawWindow) -> bool:
        """Whether a window has no sample in common with those before it; it is the last now."""
        paused = not window.start_ns <= self._seen_ns <= window.end_ns
        self._seen_ns = window.end_ns
        return paused

    def _fluid_temperature(self, result: FitResult, point: OperatingPoint) -> FluidTemperature:
        """Learn from a window whose temperature was measured; estimate that of any other."""
        celsius = result.task.window.temperature
        if math.isnan(celsius):
            return self._temperatures.temperature(point, result.scale)
        self._temperatures.add(point, celsius, result.scale)
        return FluidTemperature()

    def complete_look(self, result: FitResult) -> Report | None:
        """Take in what a look has seen; a report where it led to an early fit that is in use."""
        self._watch = result.watch or self._watch
        paused = self._paused_before(result.task.window)
        fit, evidence, watch = result.fit, result.evidence, result.watch
        if fit is None or evidence is None or watch is None:
            return None
        if not self._gatekeeper.may_be_early(evidence):
            return None
        raw = result.task.window
        self._windows += 1
        self._state = result.state
        # A law that is not exact swings about the force: the next change shows against a window.
        self._watch = None
        if not paused:
            # Nothing warms or cools so fast: the same force now means another temperature.
            self._temperatures = TemperatureMaps()
        length = round((fit.sample_count - 1) * raw.period * NANOSECONDS)
        self._changed_ns = raw.end_ns - length
        errors = self.parameters.standard_errors.copy()
        # The other parameters keep what is known of them.
        changed = self._model.strength_indices
        fitted = np.full(errors.size, math.nan)
        places, found = fitted_errors(self._model, fit)
        fitted[places] = found
        errors[changed] = np.hypot(errors[changed] * (1.0 + evidence.force_change), fitted[changed])
        self.parameters = replace(
            self.parameters,
            values=fit.parameters,
            standard_errors=errors,
            set_id=f"early-{self._windows}",
            source=fit.method,
            nrmse=evidence.nrmse_after,
            stamp_ns=raw.end_ns,
        )
        reason = (
            f"the force changed by {evidence.force_change:+.0%} at "
            f"t = {self._changed_ns / NANOSECONDS:.2f} s: fitted early"
        )
        report = self._report(result, "", result.scale)
        unknown = np.full(7, math.nan)
        return replace(report, reason=reason, coefficient_errors=unknown)

    def _accept(self, window: Window, fit: WindowFit, result: FitResult) -> None:
        self._accepted += 1
        self._accepted_since_global += 1
        errors = self.parameters.standard_errors.copy()
        places, found = fitted_errors(self._model, fit)
        errors[places] = found
        observable = self.parameters.observable.copy()
        observable[places] = np.isfinite(found)
        velocity_range, current_range = self._range_with(window)
        self.parameters = ParameterSet(
            values=fit.parameters,
            standard_errors=errors,
            observable=observable,
            set_id=f"window-{self._windows}",
            source=fit.method,
            peak_velocity_range=velocity_range,
            current_range=current_range,
            nrmse=result.evidence.nrmse_after if result.evidence else math.nan,
            stamp_ns=result.task.window.end_ns,
            model=self._model.name,
        )
        self._baselines.add(fit)
        self._reservoir.add(window, fit)

    def _range_with(self, window: Window) -> tuple[tuple[float, float], tuple[float, float]]:
        """Range of validity: the window's, widened by the reservoir's once shapes are known."""
        speed, current = window.motion.peak_velocity, window.current
        top = float(np.quantile(speed, 0.95))
        bottom = float(np.quantile(speed, 0.05))
        velocity_range = (bottom, top)
        current_range = (float(current.min()), float(current.max()))
        if shape_is_known(self._model, self.parameters.observable):
            old_v, old_i = self.parameters.peak_velocity_range, self.parameters.current_range
            velocity_range = (min(bottom, old_v[0]), max(top, old_v[1]))
            current_range = (min(current_range[0], old_i[0]), max(current_range[1], old_i[1]))
        return velocity_range, current_range

    def _report(self, result: FitResult, reason: str, scale: ForceScale) -> Report:
        raw, fit, window = result.task.window, result.fit, result.window
        evidence = result.evidence
        coefficients, errors = np.full((2, 7), math.nan)
        if fit and fit.coefficients.size:
            coefficients = fit.coefficients
            errors = np.sqrt(np.diag(fit.coefficient_covariance))
        return Report(
            window_start_ns=raw.start_ns,
            stamp_ns=raw.end_ns,
            sample_count=raw.force.size,
            method=fit.method if fit else self._settings.method,
            evaluations=fit.evaluations if fit else 0,
            nrmse_before=evidence.nrmse_before if evidence else math.nan,
            nrmse_after=evidence.nrmse_after if evidence else math.nan,
            accepted=not reason,
            reason=reason,
            set_id=self.parameters.set_id,
            scale=scale,
            peak_velocity=fit.operating_point[0] if fit else math.nan,
            amplitude=window.motion.amplitude if window else math.nan,
            frequency=window.motion.frequency if window else math.nan,
            current=float(np.mean(raw.current)),
            temperature=raw.temperature,
            coefficients=coefficients,
            coefficient_errors=errors,
            global_due=self._global_is_due(),
        )

    def _global_is_due(self) -> bool:
        period = self._settings.global_period
        if period == 0 or not is_sigmoid(self._model):
            return False
        extension = slice(SIGMOID_COUNT, None)
        if self._model.name != DEFAULT_MODEL and not self.parameters.observable[extension].any():
            # No window fit finds the lag, the stiffness and the offset; one operating point does.
            return self._accepted_since_global > 0
        return self._accepted_since_global >= period and self._reservoir.operating_points > 1

    def global_task(self, evolution: EvolutionSettings | None = None) -> GlobalTask:
        """Task of a global identification of the reservoir, with other settings if given."""
        self._accepted_since_global = 0
        return GlobalTask(
            windows=self._reservoir.windows,
            start=self.parameters.values,
            settings=evolution or self._settings.evolution,
            stamp_ns=self.parameters.stamp_ns,
            model=self._model.name,
        )

    def complete_global(self, result: GlobalResult) -> Report:
        """Judge a global identification and, if it is accepted, run with it."""
        fit = result.fit
        reason = result.fault
        if fit is not None and not fit.median_nrmse < result.nrmse_before:
            reason = "the running set predicts the reservoir as well"
        if fit is not None and not reason:
            self.parameters = replace(
                fit.parameter_set, set_id=f"global-{self._windows}", stamp_ns=result.task.stamp_ns
            )
            self._forget_scales()
        unknown = np.full(7, math.nan)
        return Report(
            window_start_ns=result.task.stamp_ns,
            stamp_ns=result.task.stamp_ns,
            sample_count=sum(window.sample_count for window in result.task.windows),
            method="differential_evolution",
            evaluations=fit.evaluations if fit else 0,
            nrmse_before=result.nrmse_before,
            nrmse_after=fit.median_nrmse if fit else math.nan,
            accepted=not reason,
            reason=reason,
            set_id=self.parameters.set_id,
            scale=ForceScale(),
            peak_velocity=math.nan,
            amplitude=math.nan,
            frequency=math.nan,
            current=math.nan,
            temperature=math.nan,
            coefficients=unknown,
            coefficient_errors=unknown,
            global_due=False,
        )
