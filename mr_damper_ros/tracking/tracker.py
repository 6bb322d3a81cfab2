"""The tracker: the running set and its memory, which each job turns into those of the next one.

A :class:`Job` for the worker is a window fit, a change check of the newest samples, or a global
search. :func:`run` computes, judges the result, and returns an :class:`Outcome`: the memory after
the job, a report, and the new set if one is taken into use. Nothing else changes the memory, so the
same windows always give the same sets.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from mr_damper_ros.data_check.samples import Samples, check_window
from mr_damper_ros.estimation.covariance import ENOUGH_TO_COMPARE, SAME_MOTION
from mr_damper_ros.estimation.current_lag import CurrentLag, with_lag
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.estimation.observability import operating_points_within, varied_parameters
from mr_damper_ros.estimation.window_fit import (
    WINDOW_METHODS,
    WindowFit,
    fit_of,
    fit_window,
)
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.domain import Domain, Origin
from mr_damper_ros.models.misfit import WindowProblem
from mr_damper_ros.models.parameter_set import (
    DEFAULT_MODEL,
    ParameterSet,
    check_set,
    start_set,
)
from mr_damper_ros.models.plausibility import implausible
from mr_damper_ros.models.quantities import GOOD_NRMSE, NOTICED, SAME_CURRENT
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.worker import Control
from mr_damper_ros.settings.option_table import CheckedSettings, group, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import (
    CHUNKS,
    LARGE_SHAPE_CHANGE,
    AcceptanceSettings,
    Evidence,
    Experience,
    Gatekeeper,
    Judgement,
    Verdict,
    evidence_of,
    evidence_of_search,
    judge_parts,
    lead_of,
    rival_wins,
    validation_mask,
)
from mr_damper_ros.tracking.cusum import ChangeWatch, change_point
from mr_damper_ros.tracking.force_scale import (
    FluidTemperature,
    WindowScale,
    force_scale,
    measured_scale,
    temperature_map,
    widened,
    with_temperature,
)
from mr_damper_ros.tracking.force_step import Compared, ForceStep, find_step, is_back
from mr_damper_ros.tracking.operating_point import (
    SAME_SPEED,
    KnownForce,
    KnownPoints,
    nearest_comparable,
    nearest_same,
    parts_by_current,
    thinned_to_keep,
)
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.screening import (
    Screening,
    TooLittleMotionError,
    check_motion,
    lack_of_motion,
    screened,
)
from mr_damper_ros.tracking.window_assembler import RawWindow

OF_THE_SET = "auto"
"""Option value: use the law of the initial set."""

_POINT_GROWTH = 1.5
"""A global identification is due early if the number of operating points has grown by this factor.
"""

_SENSOR_VERDICTS = (Verdict.FAULT_OF_DATA, Verdict.DISTURBED, Verdict.BEYOND_LIMITS)
"""Verdicts that a sensor fault may cause. A window with such a verdict does not select a set."""


EARLY_METHOD = "force_scale"
"""Method of an early fit, which scales only the gain parameters after a sudden change of force."""


@dataclass(frozen=True)
class SteadyMotion:
    """The sine of the newest good windows, and the number of such windows in a row.

    ``amplitude`` is in m, ``frequency`` in Hz and ``current`` in A.
    """

    windows: int = 0
    amplitude: float = math.nan
    frequency: float = math.nan
    current: float = math.nan

    @classmethod
    def of(cls, window: Window) -> SteadyMotion:
        """The motion of one window; NaN if it is not a sine at one current."""
        current = window.current
        constant = float(np.ptp(current)) <= 2.0 * SAME_CURRENT
        middle = 0.5 * float(current.min() + current.max()) if constant else math.nan
        return cls(1, window.motion.amplitude, window.motion.frequency, middle)

    def windows_before(self, motion: SteadyMotion) -> int:
        """Number of good windows in a row with this motion; 0 if it is not a sine."""
        # A sensor with a delay may also attenuate the motion; the loop keeps its shape.
        points = ((each.amplitude * each.frequency, each.current) for each in (self, motion))
        before, now = points
        same = math.isclose(motion.frequency, self.frequency, rel_tol=SAME_MOTION)
        same = same and nearest_comparable([before], now) is not None
        return self.windows if same else 0


@dataclass(eq=False)
class TrackerMemory(Experience):
    """State of a tracker without its settings and its running set. Jobs change copies of it.

    - ``windows``: number of windows judged so far, which numbers the sets;
    - ``accepted``: number of windows accepted since the start or reset;
    - ``accepted_since_global``: number of windows since the last global identification that gave an
      accepted set or confirmed the running set;
    - ``watch``: state of the change detection;
    - ``changed_ns``: stamp of the start of the last sudden change;
    - ``searched_points``: number of operating points in the last global identification;
    - ``scales``: force scales in motions other than a sine;
    - ``global_patience``: number of good windows until the next search;
    - ``other_damper``: whether the running set may describe another damper;
    - ``motion``: motion of the newest good windows;
    - ``unexplained_windows``: number of windows since the last search that the law's dependence on
      the current did not explain;
    - ``unexplained_patience``: number of such windows until the next search;
    - ``rival``: a set that the next window must confirm;
    - ``seen_ns``: stamp of the last sample of the newest window or change check;
    - ``step``: a step of the load cell that has neither gone again nor been acknowledged;
    - ``current_lag``: lag of the force behind the supply current.
    """

    windows: int = 0
    accepted: int = 0
    accepted_since_global: int = 0
    watch: ChangeWatch | None = None
    changed_ns: int = 0
    searched_points: int = 0
    scales: tuple[WindowScale, ...] = ()
    global_patience: int = 1
    other_damper: bool = False
    motion: SteadyMotion = field(default_factory=SteadyMotion)
    unexplained_windows: int = 0
    unexplained_patience: int = ENOUGH_TO_COMPARE
    rival: ParameterSet | None = None
    seen_ns: int = 0
    step: ForceStep | None = None
    current_lag: CurrentLag = field(default_factory=CurrentLag)

    def forget_changes(self) -> None:
        """Discard the state of the change detection, which belongs to another set."""
        self.watch = None
        self.changed_ns = 0


@dataclass(frozen=True)
class TrackerSettings(CheckedSettings):
    """Settings of the identification of windows; raises ValueError for values out of range."""

    smallest_change: float = option(
        0.02,
        "Relative change of the force that triggers an early fit (see looks). If the force is "
        "hardly larger than its noise, a false alarm occurs every few hours; otherwise false "
        "alarms practically never occur.",
        within=(0.001, 1.0),
    )
    method: str = option(
        "nelder_mead",
        "Fit of a window: nelder_mead (simplex search, as in the thesis, refined by least "
        "squares) or least_squares (Levenberg-Marquardt only: the same minimum, about five "
        "times faster).",
        choices=WINDOW_METHODS,
    )
    screening: Screening = group(Screening)
    acceptance: AcceptanceSettings = group(AcceptanceSettings)
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
        "windows at two operating points, or one window of varying peak velocity while the "
        "dependence on the peak velocity is unknown. It runs sooner if the dependence on current "
        "does not fit, and with model sigmoid_lag after the first accepted window, because window "
        "fits do not determine the lag.",
        within=(0, 1_000_000),
    )
    evolution: EvolutionSettings = group(EvolutionSettings)

    @property
    def law(self) -> str:
        """Name of the force law if there are no initial parameters."""
        return DEFAULT_MODEL if self.model == OF_THE_SET else self.model


@dataclass(frozen=True, eq=False)
class Job:
    """A task for the worker, starting from the ``running`` set and the ``memory``.

    A window fit and a change check have ``raw`` samples. Without them the job is a search, with the
    settings ``evolution``; ``asked`` is True for a requested search and False for a periodic one.
    """

    running: ParameterSet
    settings: TrackerSettings
    memory: TrackerMemory
    raw: RawWindow | None = None
    evolution: EvolutionSettings | None = None
    asked: bool = True

    @property
    def samples(self) -> RawWindow:
        """The raw samples of a window fit or a change check."""
        assert self.raw is not None
        return self.raw

    @property
    def fresh(self) -> int:
        """Number of samples of the window that the running set was not fitted to."""
        raw = self.samples
        fresh = round((raw.end_ns - self.running.stamp_ns) / (raw.period * NANOSECONDS))
        # A set stamped after the window (the clock was set back) shares no samples with it.
        return fresh if fresh >= 0 else raw.force.size

    @property
    def current_lag(self) -> float:
        """Lag [s] of the current in the samples: a law with a coil contains that of the coil."""
        lag = self.memory.current_lag.significant
        return min(lag, 0.0) if self.running.law.has_coil else lag

    @property
    def elsewhere(self) -> tuple[Window, ...]:
        """The newest windows at the recent operating points, which alone come with the job."""
        return self.memory.points.windows


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a job: its ``report``, and the ``memory`` after it, without the older windows.

    The report is None for a change check without an early fit. ``parameters`` is the set in use
    from now on, None if the running set stays; ``found`` is the new set, whether in use or not.
    ``message`` says how a search ended. ``duration`` [s] is the duration of the job.
    """

    memory: TrackerMemory
    report: Report | None = None
    parameters: ParameterSet | None = None
    found: ParameterSet | None = None
    message: str = ""
    duration: float = math.nan


# A search also tries parameters whose force overflows, and rejects them.
@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def run(job: Job, control: Control | None = None) -> Outcome:
    """Run a job; faults of the data and failures become the verdict of its report.

    ``control`` can end the job early, with the best result so far.
    """
    began = time.perf_counter()
    try:
        if (raw := job.raw) is None:
            outcome = _search(job, control)
        else:
            window = _screened(job)
            if not raw.look:
                lag = job.memory.current_lag.after(window)
                job = replace(job, memory=replace(job.memory, current_lag=lag))
            window, known = with_lag(window, job.current_lag)
            job = replace(job, raw=raw.part(known))
            predicted = job.running.window_force(window)
            if (stepped := _step_of_load_cell(job, window, predicted)) is not None:
                outcome = stepped
            elif raw.look:
                outcome = _check_change(job, window, predicted)
            else:
                outcome = _fit(job, window, control.should_stop if control else None)
    except DataError as error:
        outcome = refused(job, Judgement(Verdict.FAULT_OF_DATA, str(error)))
    except TooLittleMotionError as error:
        outcome = refused(job, Judgement(Verdict.TOO_LITTLE_MOTION, str(error)))
    except (ValueError, ArithmeticError) as error:
        sentence = f"the identification failed ({type(error).__name__}: {error}): the running set"
        outcome = refused(job, Judgement(Verdict.FAILED, f"{sentence} stays"))
    if job.raw is None:
        # The windows of a search need not be sent back.
        outcome.memory.points = outcome.memory.points.with_recent_windows(-math.inf)
    return replace(outcome, duration=time.perf_counter() - began)


def refused(job: Job, judgement: Judgement) -> Outcome:
    """The outcome of a job that gave no set."""
    memory = _begun(job)
    if job.raw is None:
        memory.unexplained_patience *= 2
        return Outcome(memory, _report(job, job.running, judgement))
    if judgement.verdict is Verdict.FAILED:
        # What the job started from may be the cause, and would make every later window fail.
        memory.forget_changes()
        memory.rival = None
    if job.raw.look:
        return Outcome(memory)
    due = _search_is_due(job, job.running, memory, unexplained=False)
    return Outcome(memory, _report(job, job.running, judgement, global_due=due))


def _begun(job: Job) -> TrackerMemory:
    """A copy of the memory that has seen the samples of the job."""
    memory = replace(job.memory)
    if job.raw is not None:
        memory.windows += not job.raw.look
        memory.seen_ns = job.raw.end_ns
        if job.raw.end_ns < memory.changed_ns:
            memory.changed_ns = 0  # the clock was set back
    return memory


def _report(
    job: Job,
    used: ParameterSet,
    judgement: Judgement,
    evidence: Evidence | None = None,
    window: Window | None = None,
    fit: WindowFit | None = None,
    **figures: Any,
) -> Report:
    """The report on a job after which the set ``used`` is in use, with the fit of its window."""
    raw, model, verdict = job.raw, job.running.law, judgement.verdict
    if raw is None:
        points = job.memory.points
        stamp_ns = max(points.newest_ns, job.running.stamp_ns)
        # Linear laws are solved by least squares; the others need a search.
        searched = model.searched_laws(frozenset(model.parameter_names)) > 0
        figures |= {
            "window_start_ns": stamp_ns,
            "stamp_ns": stamp_ns,
            "sample_count": sum(window.sample_count for window in points.windows),
            "method": "differential_evolution" if searched else "least_squares",
        }
    else:
        unknown = np.full(len(model.coefficient_names), math.nan)
        figures = {
            "window_start_ns": raw.start_ns,
            "stamp_ns": raw.end_ns,
            "sample_count": raw.force.size,
            "method": job.settings.method,
            "current": float(np.mean(raw.current)),
            "temperature": raw.temperature,
            "coefficient_names": model.coefficient_names,
            "coefficients": unknown,
            "coefficient_errors": unknown,
            "coefficient_discrepancies": unknown,
        } | figures
    if evidence is not None:
        figures |= {"nrmse_before": evidence.nrmse_before, "nrmse_after": evidence.nrmse_after}
    if window is not None and fit is not None:
        figures |= {
            "method": fit.method,
            "evaluations": fit.evaluations,
            "peak_velocity": fit.operating_point[0],
            "amplitude": window.motion.amplitude,
            "frequency": window.motion.frequency,
            "coefficients": fit.coefficients,
        }
    return Report(
        verdict=verdict,
        current_lag=job.current_lag,
        current_lag_error=job.memory.current_lag.estimate[1],
        reason=judgement.sentence,
        set_id=used.set_id,
        # The windows of a search are old, so a fit to them does not confirm the set for new
        # samples.
        confirms=verdict.accepted if raw is None else verdict.confirms,
        **figures,
    )


def _search_is_due(
    job: Job, used: ParameterSet, memory: TrackerMemory, *, unexplained: bool
) -> bool:
    """Whether a periodic search is due; ``unexplained`` is as in :func:`_fit`."""
    period, points, law = job.settings.global_period, len(memory.points.kept), used.law
    if period == 0:
        return False
    has_grown = points >= _POINT_GROWTH * memory.searched_points
    waited = memory.unexplained_windows >= memory.unexplained_patience
    if unexplained and points > 1 and (has_grown or waited):
        return True
    common = law.places(law.common_names)
    known = bool(used.observable[common].any())
    if common.size and has_grown and (not known or 0 < memory.searched_points < memory.accepted):
        # Window fits do not determine a lag, a stiffness or an offset; a global identification of
        # one operating point does. That point may be a poor one, so searches at the next points may
        # correct the result.
        return memory.accepted_since_global > 0 and memory.accepted <= period
    if memory.accepted_since_global < min(period, memory.global_patience):
        return False
    return points > 1 or any(_shows_more(used, each) for each in memory.points.windows)


def _shows_more(used: ParameterSet, window: Window) -> bool:
    """Whether one window of varying peak velocity shows a dependence on it that is unknown."""
    law = used.law
    if law.knows_speeds(used.observable):
        return False
    varied = varied_parameters(law, *operating_points_within([window]))
    return law.knows_speeds(law.marked(varied))


# -- a window --------------------------------------------------------------------------------


def _screened(job: Job) -> Window:
    """The window of a job; raises DataError or TooLittleMotionError if it cannot be fitted."""
    raw = job.samples
    given = Samples(raw.displacement, raw.force, raw.current, raw.period)
    used = screened(given, job.settings.screening, job.running.largest_force)
    samples = used.displacement, used.force, used.current
    window = Window.from_samples(*samples, raw.period, raw.peak_velocity)
    check_motion(used.displacement, window.motion.velocity, window.force)
    return window if raw.force_after is None else window.measured_after(raw.force_after)


def _fit(job: Job, window: Window, should_stop: Callable[[], bool] | None) -> Outcome:
    """Fit a window and judge the result.

    Every good window updates the memory; only accepted ones change the running set. A window is
    unexplained if separate sets for its currents fit it as usual, but one set does not.
    """
    raw, memory, options = job.samples, _begun(job), job.settings
    before, rival, wins = job.running, job.memory.rival, False
    model, running = before.law, before
    before_change = math.ceil((memory.changed_ns - raw.start_ns) / (raw.period * NANOSECONDS))
    if before_change > 0.5 * window.sample_count:
        raise TooLittleMotionError("most of the window lies before the change of the force")
    window = window.part(slice(max(before_change, 0), None))
    if rival is not None:
        maximum = options.acceptance.maximum_nrmse
        wins = rival_wins(
            rival, running, window, fresh=job.fresh, maximum_nrmse=maximum, elsewhere=job.elsewhere
        )
        memory.rival = None
        if wins:
            running = rival
            memory.forget_changes()
            job = replace(job, running=rival)
    fit, evidence = _fitted(job, window, should_stop)
    names = {"set_id": f"window-{memory.windows}", "stamp_ns": raw.end_ns}
    found = _new_set(running, fit, evidence, window, **names)
    judged = _candidate(running, fit)
    settled = judged.settled(window)
    watch = ChangeWatch.after_fit(
        judged.window_force(window)[settled],
        window.force[settled],
        fit.operating_point,
        options.smallest_change,
    )
    motion, baselines = SteadyMotion.of(window), memory.points.baselines
    windows_before = memory.motion.windows_before(motion)
    divided = parts_by_current(model, window, options.screening.current_tolerance)
    one_point, explained, unexplained = not divided or divided[0] is window, True, False
    gatekeeper = Gatekeeper(options.acceptance, memory)
    if not one_point:
        rmse, explained = judge_parts(window, divided, judged)
        # The residual of the whole window contains the error of the law, so the residual of its
        # parts is compared with the baseline.
        nrmse = rmse / float(np.std(window.force))
        unexplained = not explained and gatekeeper.is_usual(rmse, nrmse)
    speed, current = fit.operating_point
    holds = running.observable.any() and not memory.other_damper
    # The residual of the fit is not a part of the force.
    size = float(np.std(window.force)) * math.sqrt(max(1.0 - fit.nrmse**2, 0.0))
    judgement = gatekeeper.judge(
        evidence,
        KnownForce(speed, current, size, window.largest_force),
        holds=bool(holds and all(_holds(running, Domain((speed, speed), (current, current))))),
        same_motion=windows_before >= ENOUGH_TO_COMPARE,
        one_point=one_point,
        objection=partial(implausible, found),
    )
    if unexplained and judgement.verdict is Verdict.DISTURBED:
        # The law causes the error, not the samples, so a good running set is confirmed.
        good = evidence.nrmse_before <= GOOD_NRMSE
        judgement = Judgement(
            Verdict.NO_BETTER if good else Verdict.POOR_FIT,
            "the force depends on the current in a way that the running set does not describe: "
            "the window is used in the next global identification",
            usual=False,
        )
    confirmed = wins and judgement.verdict is Verdict.NO_BETTER
    if confirmed:
        sentence = f"this window confirms {running.set_id}"
        judgement = replace(judgement, verdict=Verdict.ACCEPTED, sentence=sentence)
    verdict, teaches = judgement.verdict, judgement.teaches
    unexplained = unexplained and verdict is not Verdict.BEYOND_LIMITS
    if teaches:
        memory.watch = memory.watch or watch
        memory.motion = replace(motion, windows=windows_before + 1)
        memory.accepted_since_global += 1
        if explained:
            # A fit with a wrong dependence on the current is not a suitable baseline.
            memory.points = memory.points.with_baseline(fit)
    memory.unexplained_windows += unexplained
    if teaches or unexplained:
        for part in divided:
            past = model.needs_past(part)
            kept = thinned_to_keep(part, with_past=past, parts=len(divided))
            memory.points = memory.points.with_window(kept, part.operating_point, raw.end_ns)
    used = running
    if verdict.accepted:
        memory.watch = watch
        memory.other_damper = False
        memory.accepted += 1
        used = running if confirmed else found
    elif verdict is Verdict.UNCONFIRMED:
        memory.rival = found
    if rival is not None and verdict in _SENSOR_VERDICTS:
        used, memory.rival = before, rival
    scale, memory.scales = widened(
        force_scale(model, window, fit, baselines), memory.scales, raw.start_ns, raw.end_ns
    )
    fluid = FluidTemperature()
    if judgement.verdict.confirms and not math.isnan(raw.temperature):
        memory.points = with_temperature(memory.points, fit.operating_point, raw.temperature, scale)
    elif judgement.verdict.confirms:
        # Without a measurement, the temperature is estimated from the force.
        mapped = temperature_map(memory.points.at(fit.operating_point))
        fluid = mapped.temperature(scale) if mapped else fluid
    unknown = np.full((fit.coefficients.size,) * 2, math.nan)
    covariances = fit.coefficient_covariance, fit.coefficient_discrepancy
    # Rounding may make a variance near zero slightly negative.
    errors = [
        np.sqrt(np.maximum(np.diag(unknown if each is None else each), 0.0)) for each in covariances
    ]
    report = _report(
        job,
        used,
        judgement,
        evidence,
        window,
        fit,
        scale=scale,
        coefficient_errors=errors[0],
        coefficient_discrepancies=errors[1],
        global_due=_search_is_due(job, used, memory, unexplained=unexplained),
        fluid=fluid,
    )
    return Outcome(memory, report, None if used is before else used, found)


def _fitted(
    job: Job, window: Window, should_stop: Callable[[], bool] | None
) -> tuple[WindowFit, Evidence]:
    """Fit a window, first without its validation samples and then to all samples."""
    running, options = job.running, job.settings
    validation = validation_mask(window.sample_count, job.fresh)
    # Only a set that was identified on this damper is evidence.
    prior = running if running.observable.any() else None
    fitted = partial(fit_window, running.law, prior=prior)
    searched = partial(fitted, method=options.method, should_stop=should_stop)
    training, trials = window.part(~validation), []
    for held in _held_ranges(running, window):
        trial = searched(training, running.values, held=held)
        trials.append((trial, _evidence(job, window, trial, validation)))
    trained, evidence = min(trials, key=lambda each: np.nan_to_num(each[1].rmse_after, nan=np.inf))
    # The published set uses all samples; the validation samples only serve the acceptance test.
    final = fitted(window, trained.parameters, method="least_squares", held=trained.held)
    final = replace(
        final,
        method=options.method,
        evaluations=sum(trial.evaluations for trial, _ in trials) + final.evaluations,
        success=trained.success,
        message=trained.message,
    )
    return final, evidence


def _evidence(job: Job, window: Window, fit: WindowFit, validation: np.ndarray) -> Evidence:
    found = _candidate(job.running, fit)
    return evidence_of(
        job.running, found, window, validation, fresh=job.fresh, elsewhere=job.elsewhere
    )


# -- a step of the load cell -----------------------------------------------------------------


def _step_of_load_cell(job: Job, window: Window, predicted: Array) -> Outcome | None:
    """The outcome of a window that shows a step of the load cell; None for a window of the damper.

    ``predicted`` (n,) [N] is the force of the running set in the window. While the step lasts,
    nothing is learnt.
    """
    raw, running, memory = job.samples, job.running, _begun(job)
    if job.settings.acceptance.accept_force_steps or not running.observable.any():
        return None
    period_ns = raw.period * NANOSECONDS
    begin = max(math.ceil((memory.changed_ns - raw.start_ns) / period_ns), 0)
    begin += int(np.argmax(running.settled(window)[begin:])) if begin < predicted.size else 0
    if memory.step is not None:
        begin = max(begin, window.sample_count - max(raw.look, window.sample_count // 4))
    given = Compared(predicted[begin:], window.force[begin:], window.current[begin:], window.period)
    if memory.step is None:
        if (found := find_step(given)) is None:
            return None
        if found.factor is None or found.offset is None:
            sentence = (
                "the measured force jumped within one sample: waiting for more samples to tell a "
                "change of the load cell"
            )
            judgement = Judgement(Verdict.UNCONFIRMED, sentence)
            return Outcome(memory, None if raw.look else _report(job, running, judgement))
        stamp_ns = raw.start_ns + round((begin + found.place) * period_ns)
        memory.step, memory.rival = ForceStep(stamp_ns, found.factor, found.offset), None
    elif is_back(memory.step, given):
        memory.step, memory.changed_ns = None, raw.start_ns + round(begin * period_ns)
        judgement = Judgement(
            Verdict.NO_BETTER, "the load cell shows the force of the running set again"
        )
        return Outcome(memory, _report(job, running, judgement))
    elif raw.look:
        return Outcome(memory)
    judgement = Judgement(Verdict.INSTRUMENT, memory.step.sentence)
    return Outcome(memory, _report(job, running, judgement))


# -- a change check --------------------------------------------------------------------------


def _check_change(job: Job, window: Window, predicted: Array) -> Outcome:
    """Check whether the newest samples fit the running set; otherwise fit the force scale.

    ``predicted`` (n,) [N] is the force of the running set in the window. Without a change, only the
    state of the change detection changes.
    """
    raw, memory, model, running = job.samples, _begun(job), job.running.law, job.running
    watch, unchanged = memory.watch, Outcome(memory)
    if watch is None:
        return unchanged
    newest = slice(window.sample_count - raw.look, None)
    here = window.part(newest).operating_point
    if nearest_same([watch.operating_point], here) is None:
        # Both sums start again.
        memory.watch = replace(watch, rising=0.0, falling=0.0, rising_samples=0, falling_samples=0)
        return unchanged
    memory.watch = watch = watch.follow(predicted[newest], window.force[newest])
    count = min(watch.samples_since_change, window.sample_count)
    if count < CHUNKS:
        return unchanged
    since = slice(window.sample_count - count, None)
    count -= change_point(predicted[since], window.force[since], CHUNKS)
    since = slice(window.sample_count - count, None)
    changed, predicted = window.part(since), predicted[since]
    lasting = model.lasting_force(running.held(changed), running.values)
    own, measured = predicted - lasting, changed.force - lasting
    validation = validation_mask(count)
    trained = measured_scale(own[~validation], measured[~validation]).value
    scale = measured_scale(own, measured)
    newest_samples = Samples(
        changed.motion.displacement, changed.force, changed.current, changed.period
    )
    moves = not lack_of_motion(newest_samples.displacement, job.settings.screening)
    fault = check_window(newest_samples, moves=moves).refused
    if not (trained > 0.0 and scale.value > 0.0) or fault or np.ptp(changed.force) == 0.0:
        return unchanged  # only a failed sensor gives such a force
    spread = float(np.std(window.force))
    before, after = (
        float(np.sqrt(np.mean((each * own - measured)[validation] ** 2))) for each in (1.0, trained)
    )
    # The lead accounts for the autocorrelation of the model error, which in so few samples
    # resembles a change.
    lead = lead_of([(own, trained * own, measured, validation)])
    evidence = Evidence(before / spread, after / spread, after, trained - 1.0, lead)
    found = running.times_force(
        scale.value,
        scale.standard_error,
        set_id=f"early-{memory.windows + 1}",
        source=EARLY_METHOD,
        origin=Origin.EARLY,
        nrmse=evidence.nrmse_after,
        stamp_ns=raw.end_ns,
        largest_force=float(np.fmax(changed.largest_force, running.largest_force)),
    )
    gatekeeper = Gatekeeper(job.settings.acceptance, memory)
    if not gatekeeper.may_be_early(evidence) or implausible(found):
        return unchanged
    problem = WindowProblem(model, changed, found.values, held=found.held_range)
    gains = np.where(problem.strength, problem.start, 0.0) * (scale.standard_error / scale.value)
    fit = fit_of(problem, problem.start, np.outer(gains, gains), method=EARLY_METHOD, evaluations=2)
    of_window = force_scale(model, changed, fit, memory.points.baselines)
    memory.level *= 1.0 + evidence.force_change
    memory.windows += 1
    # The residual of an inexact law oscillates, so the change detection stops until the next
    # window.
    memory.watch = None
    if raw.start_ns <= job.memory.seen_ns <= raw.end_ns:
        # The samples continue those before, and the temperature does not change so fast: the
        # temperature map has become wrong.
        memory.points = memory.points.without_temperatures()
    memory.changed_ns = raw.end_ns - round((count - 1) * raw.period * NANOSECONDS)
    judgement = Judgement(
        Verdict.ACCEPTED_EARLY,
        f"the force changed by {evidence.force_change:+.0%} at "
        f"t = {memory.changed_ns / NANOSECONDS:.2f} s: fitted early",
    )
    report = _report(job, found, judgement, evidence, changed, fit, scale=of_window)
    return Outcome(memory, report, found, found)


# -- a search --------------------------------------------------------------------------------


def _search(job: Job, control: Control | None) -> Outcome:
    """Identify globally; a quarter of each window's samples is validation data."""
    start, memory, points = job.running, _begun(job), job.memory.points
    pairs = [(window, validation_mask(window.sample_count)) for window in points.windows]
    fit = identify_global(
        start.law,
        [window.part(~judges) for window, judges in pairs],
        start.values,
        job.evolution or job.settings.evolution,
        control.report if control else None,
    )
    stamp_ns = max(points.newest_ns, start.stamp_ns)
    found = replace(fit.parameter_set, set_id=f"global-{memory.windows}", stamp_ns=stamp_ns)
    recent = points.with_recent_windows(points.newest_ns).windows
    evidence = evidence_of_search(start, found, pairs, len(recent))
    judgement = Gatekeeper(job.settings.acceptance, memory).judge_global(
        evidence, partial(implausible, found), tentative=not job.asked
    )
    used = start
    if judgement.verdict is Verdict.UNCONFIRMED:
        memory.unexplained_patience, memory.rival = ENOUGH_TO_COMPARE, found
    elif judgement.verdict.accepted:
        memory.unexplained_patience, memory.rival, used = ENOUGH_TO_COMPARE, None, found
        memory.forget_changes()
    else:
        # If the law cannot follow the current, the searches become rarer.
        memory.unexplained_patience *= 2
    report = _report(job, used, judgement, evidence, evaluations=fit.evaluations)
    return Outcome(memory, report, None if used is start else used, found, fit.message)


# -- the set of a window ---------------------------------------------------------------------


def _holds(running: ParameterSet, found: Domain) -> tuple[bool, bool]:
    """Whether the speeds, and the currents, of a domain lie within those of the running set."""
    known = running.domain
    return known.covers_speeds(found, SAME_SPEED), known.covers(found)


def _held_ranges(running: ParameterSet, window: Window) -> list[tuple[float, float]]:
    """Ranges [m/s] to which the set of a window may limit the peak velocity, the usual one first.

    Beyond the range in which it is known, the dependence on the peak velocity may be right or have
    a pole, so a window beyond it is fitted both ways.
    """
    if not running.law.knows_speeds(running.observable):
        return [window.dependence_range]
    known = running.held_range
    wider = _wider_speeds(known, window.dependence_range, window.motion.frequency)
    return list(dict.fromkeys([known, wider]))


def _candidate(running: ParameterSet, fit: WindowFit) -> ParameterSet:
    """The set of the fit of a window."""
    return replace(running, values=fit.parameters, dependence_range=fit.held)


def _wider_speeds(
    known: tuple[float, float], found: tuple[float, float], frequency: float
) -> tuple[float, float]:
    """The ``known`` range of the peak velocity [m/s], extended by the range ``found`` of a window.

    If ``frequency`` is NaN, the motion is not a sine, and the lower end stays.
    """
    slowest = known[0]
    if math.isnan(frequency):
        # In a motion other than a sine, low values contain no information on the law at low speed.
        found = max(found[0], slowest), max(found[1], slowest)
    return min(found[0], known[0]), max(found[1], known[1])


def _new_set(
    running: ParameterSet, fit: WindowFit, evidence: Evidence, window: Window, **names: Any
) -> ParameterSet:
    """The set of a window fit; ``names`` are its name and the stamp of the last sample.

    Parameters that were not fitted keep their values and errors. The set holds in the range of the
    window, and in that of the running set if its dependence on the peak velocity, or on the
    current, is known and agrees with the window. A window that is not a sine does not change the
    lower end of a known range.
    """
    model = running.law
    errors, discrepancies = running.standard_errors.copy(), running.discrepancies.copy()
    places = model.unknown_indices
    errors[places] = found = np.sqrt(np.diag(fit.whole_covariance))
    observable = running.observable.copy()
    observable[places] = np.isfinite(found)
    discrepancies[places] = math.nan
    if fit.discrepancy is not None:
        discrepancies[places] = np.sqrt(np.diag(fit.discrepancy))
    # The running set predicted the force here, or its shape, so its range stays valid.
    similar = evidence.shape_change <= LARGE_SHAPE_CHANGE
    agrees = abs(evidence.force_change) <= NOTICED
    velocity_range, largest_force = window.peak_velocity_range, window.largest_force
    current_range = float(window.current.min()), float(window.current.max())
    knows = model.knows_speeds(running.observable), model.knows_currents(running.observable)
    of_window = Domain(velocity_range, current_range)
    within = _holds(running, of_window)
    known = [similar and one and (agrees or two) for one, two in zip(knows, within, strict=True)]
    if known[0]:
        speeds = running.peak_velocity_range
        velocity_range = _wider_speeds(speeds, velocity_range, window.motion.frequency)
    if known[1]:
        current_range = of_window.joined(running.domain).currents
    if any(known):
        # If the largest force is unknown for the running set, it is also unknown for the new set.
        largest_force = float(np.maximum(largest_force, running.largest_force))
    return replace(
        running,
        values=fit.parameters,
        source=fit.method,
        origin=Origin.WINDOW,
        nrmse=evidence.nrmse_after,
        standard_errors=errors,
        discrepancies=discrepancies,
        observable=observable,
        peak_velocity_range=velocity_range,
        current_range=current_range,
        dependence_range=fit.held,
        largest_force=largest_force,
        **names,
    )


# -- the tracker -----------------------------------------------------------------------------


class WindowTracker:
    """The running set ``parameters``, and the ``memory`` that the jobs need.

    Jobs are created one after another, each from the state after the previous one.
    """

    def __init__(
        self, settings: TrackerSettings | None = None, initial: ParameterSet | None = None
    ) -> None:
        """Start with the set ``initial``; None takes the start set of the law in the settings.

        Raises ParameterError if the settings name another law than the set.
        """
        settings = settings or TrackerSettings()
        initial = start_set(settings.law) if initial is None else initial
        check_set(initial)
        if settings.model != OF_THE_SET:
            initial.of_model(settings.model)
        self._settings = replace(settings, model=initial.model)
        self.parameters = self._initial = initial.as_given()
        self.memory = TrackerMemory()

    def resume(self, parameters: ParameterSet, memory: TrackerMemory) -> None:
        """Continue from the state of a tracker, which may have had other settings.

        Raises ParameterError if the set belongs to another law.
        """
        self.parameters = parameters.of_model(self._settings.model)
        self.memory = memory = replace(memory)
        if memory.watch and memory.watch.smallest_change != self._settings.smallest_change:
            memory.watch = None

    @property
    def accepted_windows(self) -> int:
        """Windows accepted since the start or the last reset."""
        return self.memory.accepted

    @property
    def points(self) -> KnownPoints:
        """The records of the operating points, with the windows for the global identification."""
        return self.memory.points

    def reset(self) -> None:
        """Return to the initial set; baselines and reservoir are discarded."""
        # The names of sets contain the number of windows, so the count continues. The damper may
        # have been replaced.
        self.parameters = self._initial
        self.memory = TrackerMemory(windows=self.memory.windows, other_damper=True)

    def acknowledge(self) -> str:
        """Accept a step of the load cell, and learn from the samples after it.

        Returns what was accepted; empty if there was no step.
        """
        step = self.memory.step
        if step is None:
            return ""
        self.memory = replace(self.memory, step=None, changed_ns=self.memory.seen_ns)
        return f"accepted, and learning from now on: {step.sentence}"

    def replace(self, parameters: ParameterSet) -> None:
        """Use this set, loaded by the user, from now on; records and baselines are deleted.

        Raises ParameterError if the set belongs to another law.
        """
        self.parameters = parameters.of_model(self._settings.model).as_given()
        self.memory = TrackerMemory(windows=self.memory.windows)

    @one_thread()
    def follow(self, window: RawWindow) -> Report | None:
        """Fit a window, or run a change check, in this process.

        Returns None for a change check without an early fit.
        """
        return self.complete(run(self.job_of(window)))

    @one_thread()
    def identify(self, evolution: EvolutionSettings | None = None) -> Report:
        """Run a global identification of the reservoir in this process; see :meth:`search`."""
        report = self.complete(run(self.search(evolution)))
        assert report is not None
        return report

    def job_of(self, window: RawWindow) -> Job:
        """The job of a window fit or a change check, starting from the running set."""
        # Only the windows that the job compares with need to be sent. A change check needs none.
        points = self.points.with_recent_windows(-math.inf if window.look else window.start_ns)
        return Job(self.parameters, self._settings, replace(self.memory, points=points), window)

    def search(self, evolution: EvolutionSettings | None = None, *, asked: bool = True) -> Job:
        """The job of a global identification of the reservoir, with other settings if given.

        An accepted set of a requested search (``asked``) is used at once. Otherwise, while the
        running set is good, the next window must confirm it.
        """
        self.memory = memory = replace(self.memory)
        memory.accepted_since_global = memory.unexplained_windows = 0
        memory.global_patience += max(memory.global_patience // 2, 1)
        memory.searched_points = len(self.points.kept)
        return Job(self.parameters, self._settings, memory, evolution=evolution, asked=asked)

    def complete(self, outcome: Outcome) -> Report | None:
        """Take over the outcome of the newest job; returns its report."""
        points = self.points.updated(outcome.memory.points)
        self.memory = replace(outcome.memory, points=points)
        self.parameters = outcome.parameters or self.parameters
        return outcome.report
