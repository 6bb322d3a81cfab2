"""The tracker: the running set, its records, and the decisions on each window.

``WindowTracker`` creates the jobs (:mod:`jobs`), which may run in another process, and decides on
their outcomes. Jobs are created one after another, each from the running set after the previous
one. The same windows therefore always give the same sets.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet, start_set
from mr_damper_ros.models.plausibility import implausible
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.settings.option_table import group, option
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import (
    GOOD_NRMSE,
    Experience,
    Gatekeeper,
    Judgement,
    Verdict,
    fault_of_data,
)
from mr_damper_ros.tracking.cusum import ChangeWatch
from mr_damper_ros.tracking.force_scale import (
    FluidTemperature,
    ForceScale,
    WindowScale,
    temperature_map,
    widened,
    with_temperature,
)
from mr_damper_ros.tracking.jobs import TRACKERS, FitOptions, Job, Outcome, blank_report, run
from mr_damper_ros.tracking.operating_point import KnownPoints
from mr_damper_ros.tracking.recursive_tracker import FilterState
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.running_set import SteadyMotion, holds_at
from mr_damper_ros.tracking.window_assembler import RawWindow

OF_THE_SET = "auto"
"""Option value: use the law of the initial set."""


_POINT_GROWTH = 1.5
"""A global identification is due early if the number of operating points has grown by this factor.
"""


_KNOWN_AFTER = 3
"""Number of windows of one motion after which the shape of its force is known. Initially, a search
also starts after this many windows that the law's dependence on the current does not explain."""

_SENSOR_VERDICTS = (Verdict.FAULT_OF_DATA, Verdict.DISTURBED, Verdict.BEYOND_LIMITS)
"""Verdicts that a sensor fault may cause. A window with such a verdict does not select a set."""


@dataclass(frozen=True)
class TrackerSettings(FitOptions):
    """Settings of the identification of windows; raises ValueError for values out of range."""

    model: str = option(
        OF_THE_SET,
        f"Force law to identify; {OF_THE_SET}: the law of the initial parameters, or "
        f"{DEFAULT_MODEL} without initial parameters.",
        choices=(OF_THE_SET, *MODELS),
    )
    global_period: int = option(
        20,
        "Number of good windows between two global identifications, with shorter intervals at "
        "the start (after 1, 2, 3, 4, 6, 9 and so on); 0: never. A global identification needs "
        "windows at two operating points. It runs sooner if the dependence on current does not "
        "fit, and with model sigmoid_lag after the first accepted window, because window fits do "
        "not determine the lag.",
        within=(0, 1_000_000),
    )
    evolution: EvolutionSettings = group(EvolutionSettings)

    @property
    def law(self) -> str:
        """Name of the force law if there are no initial parameters."""
        return DEFAULT_MODEL if self.model == OF_THE_SET else self.model

    def following(self, initial: ParameterSet) -> TrackerSettings:
        """The settings with the law of the initial set.

        Raises ParameterError if the settings name another law.
        """
        if self.model != OF_THE_SET:
            initial.of_model(self.model)
            return self
        return replace(self, model=initial.model)


@dataclass(eq=False)
class TrackerMemory(Experience):
    """State of a tracker without its settings and its running set; see ``WindowTracker``.

    - ``windows``: number of windows judged so far, which numbers the sets;
    - ``accepted``: number of windows accepted since the start or reset;
    - ``accepted_since_global``: number of good windows since the last global identification, whose
      set was accepted or which confirmed the running set;
    - ``state``: state of the recursive filter;
    - ``watch``: state of the change detection;
    - ``changed_ns``: stamp of the start of the last sudden change;
    - ``searched_points``: number of operating points in the last global identification;
    - ``scales``: force scales in motions other than a sine;
    - ``global_patience``: number of good windows until the next search;
    - ``other_damper``: whether the running set may describe another damper;
    - ``motion``: motion of the newest good windows;
    - ``unexplained_windows``: number of windows since the last search that the law's dependence on
      the current did not explain;
    - ``unexplained_patience``: number of such windows until the next search, 0 for the default.
    """

    windows: int = 0
    accepted: int = 0
    accepted_since_global: int = 0
    state: FilterState | None = None
    watch: ChangeWatch | None = None
    changed_ns: int = 0
    searched_points: int = 0
    scales: tuple[WindowScale, ...] = ()
    global_patience: int = 1
    other_damper: bool = False
    motion: SteadyMotion = field(default_factory=SteadyMotion)
    unexplained_windows: int = 0
    unexplained_patience: int = 0


class WindowTracker:
    """The running parameter set, and the records that the acceptance test needs."""

    def __init__(
        self, settings: TrackerSettings | None = None, initial: ParameterSet | None = None
    ) -> None:
        """Start with the set ``initial``; None takes the start set of the law in the settings.

        Raises ParameterError as :meth:`TrackerSettings.following` does.
        """
        settings = settings or TrackerSettings()
        initial = initial or start_set(settings.law)
        self._settings = settings.following(initial)
        self._initial = initial.as_given()
        self._model = initial.law
        self.parameters = self._initial
        self._remember(TrackerMemory())

    @property
    def memory(self) -> TrackerMemory:
        """A copy of the present state, without the running set."""
        return replace(self._now)

    def _remember(self, memory: TrackerMemory) -> None:
        self._now = replace(memory)
        self._now.unexplained_patience = memory.unexplained_patience or _KNOWN_AFTER
        self._gatekeeper = Gatekeeper(self._settings.acceptance, self._now)
        self._seen_ns = 0
        # Whether the law's dependence on the current does not explain the newest window.
        self._unexplained = False
        # A set of a search, or of a large sudden change, that the next window must confirm.
        self._rival: ParameterSet | None = None

    def resume(self, parameters: ParameterSet, memory: TrackerMemory) -> None:
        """Continue from the state of a tracker, which may have had other settings.

        Raises ParameterError if the set belongs to another law.
        """
        self.parameters = parameters.of_model(self._settings.model)
        self._remember(memory)
        if TRACKERS[self._settings.tracker] is None:
            self._now.state = None
        if self._now.watch and self._now.watch.smallest_change != self._settings.smallest_change:
            self._now.watch = None

    def _start_again(self) -> None:
        # The names of sets contain the number of windows, so the count continues.
        self._remember(TrackerMemory(windows=self._now.windows))

    def _forget_scales(self) -> None:
        """Discard the states of filter and change detection, which belong to another set."""
        self._now.state = None
        self._now.watch = None
        self._now.changed_ns = 0

    @property
    def accepted_windows(self) -> int:
        """Windows accepted since the start or the last reset."""
        return self._now.accepted

    @property
    def points(self) -> KnownPoints:
        """The records of the operating points, with the windows for the global identification."""
        return self._now.points

    def reset(self) -> None:
        """Return to the initial set; baselines and reservoir are discarded."""
        self.parameters = self._initial
        self._start_again()
        # The damper may have been replaced.
        self._now.other_damper = True

    def replace(self, parameters: ParameterSet) -> None:
        """Use this set, loaded by the user, from now on; records and baselines are deleted.

        Raises ParameterError if the set belongs to another law.
        """
        self.parameters = parameters.of_model(self._settings.model).as_given()
        self._start_again()

    @one_thread()
    def follow(self, window: RawWindow) -> Report | None:
        """Fit a window, or run a change check, in this process.

        Returns None for a change check without an early fit.
        """
        job = self.job_of(window)
        return self.complete(job, run(job))

    @one_thread()
    def identify(self, evolution: EvolutionSettings | None = None) -> Report:
        """Run a global identification of the reservoir in this process; see :meth:`search`."""
        job = self.search(evolution)
        report = self.complete(job, run(job))
        assert report is not None
        return report

    def job_of(self, window: RawWindow) -> Job:
        """The job of a window fit or a change check, starting from the running set."""
        now, look = self._now, window.look > 0
        if window.end_ns < now.changed_ns:
            now.changed_ns = 0  # the clock was set back
        return Job(
            self.parameters,
            self._settings,
            window,
            now.windows + 1,
            rival=None if look else self._rival,
            windows=() if look else self.points.recent(window.start_ns),
            baselines=self.points.baselines,
            state=now.state,
            watch=now.watch,
            changed_ns=now.changed_ns,
        )

    def search(self, evolution: EvolutionSettings | None = None, *, asked: bool = True) -> Job:
        """The job of a global identification of the reservoir, with other settings if given.

        An accepted set of a requested search (``asked``) is used at once. Otherwise, while the
        running set is good, the next window must confirm it.
        """
        now, kept = self._now, self.points.kept
        now.accepted_since_global = now.unexplained_windows = 0
        now.global_patience += max(now.global_patience // 2, 1)
        now.searched_points = len(kept)
        newest_ns = kept[-1].stamp_ns if kept else 0
        return Job(
            self.parameters,
            self._settings,
            number=now.windows,
            windows=self.points.windows,
            evolution=evolution or self._settings.evolution,
            stamp_ns=max(newest_ns, self.parameters.stamp_ns),
            recent=len(self.points.recent(newest_ns)),
            asked=asked,
        )

    def complete(self, job: Job, outcome: Outcome) -> Report | None:
        """Judge the outcome of a job, and use its set if it is accepted.

        Returns None for a change check without an early fit.
        """
        report = outcome.report or blank_report(job)
        fluid, paused = FluidTemperature(), False
        if job.raw is not None:
            paused = not job.raw.start_ns <= self._seen_ns <= job.raw.end_ns
            self._seen_ns = job.raw.end_ns
        if job.raw is None:
            judgement = self._judge_search(job, outcome)
        elif job.raw.look:
            early = self._judge_look(job, outcome, paused=paused)
            if early is None:
                return None
            judgement = early
        else:
            self._now.windows += 1
            judgement = self._judge_with_rival(job, outcome)
            scale, self._now.scales = widened(
                report.scale, self._now.scales, job.raw.start_ns, job.raw.end_ns
            )
            report = replace(report, scale=scale)
            if outcome.fit is not None and judgement.verdict.confirms:
                fluid = self._fluid_temperature(job.raw.temperature, outcome.fit, scale)
        verdict, evidence = judgement.verdict, outcome.evidence
        return replace(
            report,
            verdict=verdict,
            reason=judgement.sentence,
            set_id=self.parameters.set_id,
            # The windows of a search are old, so a fit to them does not confirm the set for new
            # samples.
            confirms=verdict.accepted if job.raw is None else verdict.confirms,
            nrmse_before=evidence.nrmse_before if evidence else math.nan,
            nrmse_after=evidence.nrmse_after if evidence else math.nan,
            global_due=job.raw is not None and self._global_is_due(),
            fluid=fluid,
        )

    def _judge_with_rival(self, job: Job, outcome: Outcome) -> Judgement:
        """Judge a window. A rival that predicts the window better replaces the running set."""
        rival, running = job.rival, self.parameters
        if rival is None:
            return self._judge(job, outcome)
        if outcome.rival_wins:
            self.parameters = rival
            self._forget_scales()
        self._rival = None
        judgement = self._judge(job, outcome)
        if outcome.rival_wins is None or judgement.verdict in _SENSOR_VERDICTS:
            self.parameters, self._rival = running, rival
        elif outcome.rival_wins and judgement.verdict is Verdict.NO_BETTER:
            return Judgement(Verdict.ACCEPTED, f"this window confirms {rival.set_id}")
        return judgement

    def _judge(self, job: Job, outcome: Outcome) -> Judgement:
        """Judge a window, and update the running set and the records."""
        now, found, parts = self._now, outcome.found, outcome.parts
        fit, evidence, force = outcome.fit, outcome.evidence, outcome.force
        self._unexplained = False
        if found is None or fit is None or evidence is None or force is None:
            return outcome.refusal or fault_of_data("the window could not be fitted")
        if parts is not None and not parts.explained:
            # The residual of the whole window contains the error of the law, so the residual of its
            # parts is compared with the baseline.
            self._unexplained = self._gatekeeper.is_usual(parts.rmse, parts.nrmse)
        judgement = self._gatekeeper.judge(
            evidence,
            force,
            holds=not now.other_damper and holds_at(self.parameters, fit.operating_point),
            same_motion=now.motion.windows_before(outcome.motion) >= _KNOWN_AFTER,
            one_point=parts is None,
            objection=partial(implausible, found),
        )
        if self._unexplained and judgement.verdict is Verdict.DISTURBED:
            # The law causes the error, not the samples, so a good running set is confirmed.
            good = evidence.nrmse_before <= GOOD_NRMSE
            judgement = Judgement(
                Verdict.NO_BETTER if good else Verdict.POOR_FIT,
                "the force depends on the current in a way that the running set does not describe: "
                "the window is used in the next global identification",
                usual=False,
            )
        if judgement.teaches:
            # Every good window updates the records; only accepted ones change the running set.
            now.state = outcome.state
            now.watch = now.watch or outcome.watch
            now.motion = now.motion.followed_by(outcome.motion)
            if parts is None or parts.explained:
                # A fit with a wrong dependence on the current is not a suitable baseline.
                now.points = self.points.with_baseline(fit)
        if judgement.verdict.accepted:
            now.watch = outcome.watch
            now.other_damper = False
            now.accepted += 1
            self.parameters = found
        if judgement.verdict is Verdict.UNCONFIRMED:
            self._rival = found
        if judgement.verdict is Verdict.BEYOND_LIMITS:
            self._unexplained = False
        now.unexplained_windows += self._unexplained
        if judgement.teaches or self._unexplained:
            now.accepted_since_global += judgement.teaches
            for kept in outcome.kept:
                now.points = self.points.with_window(kept, job.samples.end_ns)
        return judgement

    def _fluid_temperature(
        self, celsius: float, fit: WindowFit, scale: ForceScale
    ) -> FluidTemperature:
        """Learn from a measured temperature; without a measurement, estimate the temperature."""
        if math.isnan(celsius):
            found = temperature_map(self.points.at(fit.operating_point))
            return FluidTemperature() if found is None else found.temperature(scale)
        self._now.points = with_temperature(self.points, fit.operating_point, celsius, scale)
        return FluidTemperature()

    def _judge_look(self, job: Job, outcome: Outcome, *, paused: bool) -> Judgement | None:
        """Judge a change check; None unless an early fit is accepted.

        ``paused`` says that it shares no samples with the window before.
        """
        now, raw = self._now, job.samples
        now.watch = outcome.watch or now.watch
        found, fit, evidence = outcome.found, outcome.fit, outcome.evidence
        if found is None or fit is None or evidence is None:
            return None
        if not self._gatekeeper.may_be_early(evidence) or implausible(found):
            return None
        now.windows += 1
        self.parameters = found
        self._gatekeeper.follow_change(evidence)
        now.state = outcome.state
        # The residual of an inexact law oscillates, so the change detection stops until the next
        # window.
        now.watch = None
        if not paused:
            # The temperature does not change so fast; the temperature map has become wrong.
            now.points = self.points.without_temperatures()
        now.changed_ns = raw.end_ns - round((fit.sample_count - 1) * raw.period * NANOSECONDS)
        return Judgement(
            Verdict.ACCEPTED_EARLY,
            f"the force changed by {evidence.force_change:+.0%} at "
            f"t = {now.changed_ns / NANOSECONDS:.2f} s: fitted early",
        )

    def _judge_search(self, job: Job, outcome: Outcome) -> Judgement:
        """Judge a search; its set is used at once, or once the next window confirms it."""
        found, evidence = outcome.found, outcome.evidence
        judgement = outcome.refusal or fault_of_data("the windows could not be fitted")
        if found is not None and evidence is not None:
            judgement = self._gatekeeper.judge_global(
                evidence, partial(implausible, found), tentative=not job.asked
            )
        # If the law cannot follow the current, the searches become rarer.
        self._now.unexplained_patience *= 2
        if judgement.verdict is Verdict.UNCONFIRMED:
            self._now.unexplained_patience, self._rival = _KNOWN_AFTER, found
        elif judgement.verdict.accepted and found is not None:
            self._now.unexplained_patience, self._rival = _KNOWN_AFTER, None
            self.parameters = found
            self._forget_scales()
        return judgement

    def _global_is_due(self) -> bool:
        now, period, points = self._now, self._settings.global_period, len(self.points.kept)
        if period == 0:
            return False
        has_grown = points >= _POINT_GROWTH * now.searched_points
        waited = now.unexplained_windows >= now.unexplained_patience
        if self._unexplained and points > 1 and (has_grown or waited):
            return True
        common = self._model.places(self._model.common_names)
        known = bool(self.parameters.observable[common].any())
        if common.size and has_grown and (not known or 0 < now.searched_points < now.accepted):
            # Window fits do not determine a lag, a stiffness or an offset; a global identification
            # of one operating point does. That point may be a poor one, so searches at the next
            # points may correct the result.
            return now.accepted_since_global > 0 and now.accepted <= period
        return now.accepted_since_global >= min(period, now.global_patience) and points > 1
