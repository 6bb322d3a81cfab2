"""Follows a damper window by window: the pure object behind the identifier node.

``WindowTracker`` holds what is known (the running set, the baselines, the reservoir), makes tasks
and decides on what they found; the work of a task (:mod:`window_task`, :mod:`global_task`) may run
in another process. Tasks are built one after another, each from the running set that the one
before it left, so the same windows always give the same sets.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.plausibility import implausible
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import (
    Gatekeeper,
    Judgement,
    Verdict,
    fault_of_data,
)
from mr_damper_ros.tracking.fluid_temperature import FluidTemperature, TemperatureMaps
from mr_damper_ros.tracking.force_scale import Baselines, ScaleScatter
from mr_damper_ros.tracking.global_task import run_global
from mr_damper_ros.tracking.reports import Report, report_of_global, report_of_window
from mr_damper_ros.tracking.reservoir import Reservoir
from mr_damper_ros.tracking.running_set import (
    holds_at,
    known_force,
    set_of_change,
    set_of_window,
)
from mr_damper_ros.tracking.tasks import FitResult, FitTask, GlobalResult, GlobalTask
from mr_damper_ros.tracking.tracker_memory import TrackerMemory
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.trackers import TRACKERS
from mr_damper_ros.tracking.window_assembler import RawWindow
from mr_damper_ros.tracking.window_task import run_fit

_GROWTH = 1.5
"""Another global identification is worth while where so many times the operating points are known.
"""


_PATIENCE = 3
"""So many windows that the law over the current does not explain are worth another search."""

_ESTABLISHED = 3
"""So many windows of one motion establish the shape of its force."""


class WindowTracker:
    """The running parameter set and all that is needed to judge the next one."""

    def __init__(self, settings: TrackerSettings, initial: ParameterSet) -> None:
        """See :meth:`TrackerSettings.following` for what it raises."""
        self._settings = settings.following(initial)
        self._initial = initial.as_given()
        self._model = initial.law
        self.parameters = self._initial
        self._remember(TrackerMemory())

    @property
    def memory(self) -> TrackerMemory:
        """All that has been learnt besides the running set."""
        return TrackerMemory(
            windows=self._windows,
            accepted=self._accepted,
            accepted_since_global=self._good_since_global,
            history=self._gatekeeper.history,
            baselines=self._baselines.fits,
            reservoir=self._reservoir.windows,
            reservoir_points=self._reservoir.points,
            reservoir_stamps=self._reservoir.stamps,
            unexplained_windows=self._unexplained_windows,
            unexplained_patience=self._unexplained_patience,
            state=self._state,
            watch=self._watch,
            changed_ns=self._changed_ns,
            temperatures=self._temperatures.histories,
            scales=self._scatter.seen,
            searched_points=self._searched_points,
            global_patience=self._global_patience,
            other_damper=self._other_damper,
            motion=self._motion,
            kept_ns=self._kept_ns,
        )

    def _remember(self, memory: TrackerMemory) -> None:
        self._windows = memory.windows
        self._accepted = memory.accepted
        self._good_since_global = memory.accepted_since_global
        self._gatekeeper = Gatekeeper(self._settings.acceptance, memory.history)
        self._baselines = Baselines(memory.baselines)
        self._reservoir = Reservoir(
            memory.reservoir, memory.reservoir_points, memory.reservoir_stamps
        )
        self._state = memory.state
        self._watch = memory.watch
        self._changed_ns = memory.changed_ns
        self._temperatures = TemperatureMaps(memory.temperatures)
        self._scatter = ScaleScatter(memory.scales)
        self._searched_points = memory.searched_points
        # Good windows until the next search: the first know little, each waits half as long again.
        self._global_patience = memory.global_patience
        self._other_damper = memory.other_damper
        self._motion = memory.motion
        self._kept_ns = memory.kept_ns
        self._seen_ns = 0
        # Whether the law over the current does not explain the newest window, how many of them came
        # since the last search, and after how many the next one follows.
        self._unexplained = False
        self._unexplained_windows = memory.unexplained_windows
        self._unexplained_patience = memory.unexplained_patience or _PATIENCE

    def resume(self, parameters: ParameterSet, memory: TrackerMemory) -> None:
        """Go on where another tracker was, which may have had other settings.

        Raises ParameterError where the set is of another model.
        """
        self.parameters = parameters.of_model(self._settings.model)
        self._remember(memory)
        if not TRACKERS[self._settings.tracker].remembers:
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
        # Who resets says that what was known of the damper need not hold any more.
        self._other_damper = True

    def replace(self, parameters: ParameterSet) -> None:
        """Run with this set (loaded by the user) from now on; it also starts a new baseline.

        Raises ParameterError where the set is of another model.
        """
        self.parameters = parameters.of_model(self._settings.model).as_given()
        self._start_again()

    @one_thread()
    def follow(self, window: RawWindow) -> Report | None:
        """Fit a window, or take a look, in this process; None of a look that changes nothing."""
        task = self.window_task(window)
        result = run_fit(task)
        return self.complete_look(task, result) if window.look else self.complete(task, result)

    @one_thread()
    def identify(self, evolution: EvolutionSettings | None = None) -> Report:
        """Identify globally, from the reservoir, in this process; see :meth:`global_task`."""
        task = self.global_task(evolution)
        return self.complete_global(task, run_global(task))

    def window_task(self, window: RawWindow) -> FitTask:
        """The task of a window or a look, starting from the running set."""
        if window.end_ns < self._changed_ns:
            self._changed_ns = 0  # time was set back
        return FitTask(
            window,
            self.parameters,
            self._settings,
            self._state,
            self._watch,
            self._changed_ns,
            self._baselines.fits,
            () if window.look else self._reservoir.recent(window.start_ns),
        )

    def complete(self, task: FitTask, result: FitResult) -> Report:
        """Judge the result of a window's task and, if it is accepted, run with it."""
        self._windows += 1
        self._paused_before(task.window)
        judgement = self._judge(task, result)
        raw = task.window
        scale = self._scatter.widened(result.scale, raw.start_ns, raw.end_ns)
        result = replace(result, scale=scale)
        report = report_of_window(
            task, result, judgement, self.parameters.set_id, global_due=self._global_is_due()
        )
        if result.fit is None or not report.confirms:
            return report
        return replace(report, fluid=self._fluid_temperature(task, result))

    def _judge(self, task: FitTask, result: FitResult) -> Judgement:
        """Judge a window, and take over what it brings."""
        fit, evidence, summary, parts = result.fit, result.evidence, result.summary, result.parts
        self._unexplained = False
        if fit is None or evidence is None or summary is None:
            return result.refusal or fault_of_data("the window could not be fitted")
        if parts is not None and not parts.explained:
            # Judged before the window is: its own residual is that of a wrong law.
            self._unexplained = self._gatekeeper.is_usual(parts.rmse, parts.nrmse)
        force = known_force(fit, summary)
        holds = not self._other_damper and holds_at(self.parameters, fit.operating_point)
        known_motion = self._motion.windows_of(summary) >= _ESTABLISHED
        found = set_of_window(
            self.parameters,
            fit,
            evidence,
            summary,
            set_id=f"window-{self._windows}",
            stamp_ns=task.window.end_ns,
        )
        judgement = self._gatekeeper.judge(
            evidence,
            force,
            holds=holds,
            same_motion=known_motion,
            one_point=parts is None,
            objection=partial(implausible, found),
        )
        if self._unexplained and judgement.verdict is Verdict.DISTURBED:
            judgement = Judgement(
                Verdict.POOR_FIT,
                "the force does not follow the current as the running set has it: the window goes "
                "into the next global identification",
            )
        if judgement.verdict.confirms:
            # All but the running set learns from every good window; that from those that help.
            self._state = result.state
            self._watch = self._watch or result.watch
            self._motion = self._motion.followed_by(summary)
            if parts is None or parts.explained:
                # A wrong law over the current is nothing to compare other windows with.
                self._baselines.add(fit)
        if judgement.verdict.accepted:
            self._watch = result.watch
            self._other_damper = False
            self._accepted += 1
            self.parameters = found
        if judgement.verdict is Verdict.BEYOND_LIMITS:
            self._unexplained = False
        self._unexplained_windows += self._unexplained
        if judgement.verdict.confirms or self._unexplained:
            self._kept_ns = task.window.end_ns
            self._good_since_global += judgement.verdict.confirms
            for kept in result.kept:
                self._reservoir.add(kept, task.window.end_ns)
        return judgement

    def _paused_before(self, window: RawWindow) -> bool:
        """Whether a window has no sample in common with those before it; it is the last now."""
        paused = not window.start_ns <= self._seen_ns <= window.end_ns
        self._seen_ns = window.end_ns
        return paused

    def _fluid_temperature(self, task: FitTask, result: FitResult) -> FluidTemperature:
        """Learn from a window whose temperature was measured; estimate that of any other."""
        assert result.fit is not None
        point, celsius = result.fit.operating_point, task.window.temperature
        if math.isnan(celsius):
            return self._temperatures.temperature(point, result.scale)
        self._temperatures.add(point, celsius, result.scale)
        return FluidTemperature()

    def complete_look(self, task: FitTask, result: FitResult) -> Report | None:
        """Take in what a look has seen; a report where it led to an early fit that is in use."""
        self._watch = result.watch or self._watch
        raw = task.window
        paused = self._paused_before(raw)
        fit, evidence, summary, watch = result.fit, result.evidence, result.summary, result.watch
        if fit is None or evidence is None or summary is None or watch is None:
            return None
        if not self._gatekeeper.may_be_early(evidence):
            return None
        set_id = f"early-{self._windows + 1}"
        found = set_of_change(
            self.parameters, fit, evidence, summary, set_id=set_id, stamp_ns=raw.end_ns
        )
        if implausible(found):
            return None
        self._windows += 1
        self.parameters = found
        self._gatekeeper.follow_change(evidence)
        self._state = result.state
        # A law that is not exact swings about the force: the next change shows against a window.
        self._watch = None
        if not paused:
            # Nothing warms or cools so fast: the same force now means another temperature.
            self._temperatures = TemperatureMaps()
        length = round((fit.sample_count - 1) * raw.period * NANOSECONDS)
        self._changed_ns = raw.end_ns - length
        judgement = Judgement(
            Verdict.ACCEPTED_EARLY,
            f"the force changed by {evidence.force_change:+.0%} at "
            f"t = {self._changed_ns / NANOSECONDS:.2f} s: fitted early",
        )
        report = report_of_window(task, result, judgement, set_id, global_due=self._global_is_due())
        # One factor says nothing of the coefficients' own errors.
        unknown = np.full_like(report.coefficients, math.nan)
        return replace(report, coefficient_errors=unknown, coefficient_discrepancies=unknown)

    def _global_is_due(self) -> bool:
        period, points = self._settings.global_period, self._reservoir.operating_points
        if period == 0:
            return False
        has_grown = points >= _GROWTH * self._searched_points
        waited = self._unexplained_windows >= self._unexplained_patience
        if self._unexplained and points > 1 and (has_grown or waited):
            return True
        common = self._model.places(self._model.common_names)
        known = bool(self.parameters.observable[common].any())
        if common.size and has_grown and (not known or 0 < self._searched_points < self._accepted):
            # No window fit finds a lag, a stiffness or an offset. One operating point does, but it
            # may be a poor one: the next few may correct what it has led to.
            return self._good_since_global > 0 and self._accepted <= period
        return self._good_since_global >= min(period, self._global_patience) and points > 1

    def global_task(self, evolution: EvolutionSettings | None = None) -> GlobalTask:
        """Task of a global identification of the reservoir, with other settings if given."""
        self._good_since_global = 0
        self._unexplained_windows = 0
        self._global_patience += max(self._global_patience // 2, 1)
        self._searched_points = self._reservoir.operating_points
        settings = evolution or self._settings.evolution
        stamp_ns = max(self._kept_ns, self.parameters.stamp_ns)
        recent = len(self._reservoir.recent(self._kept_ns))
        return GlobalTask(self._reservoir.windows, self.parameters, settings, stamp_ns, recent)

    def complete_global(self, task: GlobalTask, result: GlobalResult) -> Report:
        """Judge a global identification and, if it is accepted, run with it."""
        judgement = self._judge_global(result)
        # A law that cannot follow the current is not searched for again and again.
        accepted = judgement.verdict.accepted
        self._unexplained_patience = _PATIENCE if accepted else 2 * self._unexplained_patience
        if judgement.verdict.accepted and result.fit is not None:
            self.parameters = replace(
                result.fit.parameter_set,
                set_id=f"global-{self._windows}",
                stamp_ns=task.stamp_ns,
            )
            self._forget_scales()
        return report_of_global(task, result, judgement, self.parameters.set_id)

    def _judge_global(self, result: GlobalResult) -> Judgement:
        if result.fit is None:
            return result.refusal or fault_of_data("the windows could not be fitted")
        return self._gatekeeper.judge_global(
            result.nrmse_before,
            result.nrmse_after,
            result.recent,
            result.lead,
            objection=partial(implausible, result.fit.parameter_set),
        )
