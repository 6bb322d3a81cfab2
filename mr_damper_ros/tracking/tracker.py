"""Follows a damper window by window: the pure object behind the identifier node.

``WindowTracker`` holds what is known (the running set, the baselines, the reservoir), makes tasks
and decides on what they found; the work of a task (:mod:`window_task`, :mod:`global_task`) may run
in another process. Tasks are built one after another, each from the running set that the one
before it left, so the same windows always give the same sets.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet
from mr_damper_ros.models.sigmoid.extension import SIGMOID_COUNT
from mr_damper_ros.models.sigmoid.scale_misfit import Window
from mr_damper_ros.models.sigmoid.sigmoid_model import is_sigmoid
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import NO_BETTER, Gatekeeper
from mr_damper_ros.tracking.fluid_temperature import FluidTemperature, TemperatureMaps
from mr_damper_ros.tracking.following import fitted_errors, shape_is_known
from mr_damper_ros.tracking.force_scale import Baselines, ForceScale
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.reservoir import OperatingPoint, Reservoir
from mr_damper_ros.tracking.tasks import FitResult, FitTask, GlobalResult, GlobalTask
from mr_damper_ros.tracking.tracker_memory import TrackerMemory
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.unscented_filter import METHOD
from mr_damper_ros.tracking.window_assembler import RawWindow


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
