"""Jobs for the worker: a window fit, a change check of the newest samples, or a global search.

The worker receives a :class:`Job`, executes it by :func:`run`, and returns an :class:`Outcome`. The
tracker decides on the outcome (:mod:`tracker`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mr_damper_ros.estimation.covariance import NoiseModel
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import error_of_set, identify_global
from mr_damper_ros.estimation.window_fit import (
    WINDOW_METHODS,
    WindowFit,
    WindowPrior,
    fit_window,
)
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import LONGEST_SETTLING, Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import WindowProblem
from mr_damper_ros.models.parameter_set import EARLY_SOURCE, ParameterSet
from mr_damper_ros.processes.worker import Control
from mr_damper_ros.settings.option_table import CheckedSettings, group, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import (
    CHUNKS,
    AcceptanceSettings,
    Evidence,
    Judgement,
    Lead,
    Verdict,
    evidence_of,
    fault_of_data,
    rival_wins,
    validation_mask,
)
from mr_damper_ros.tracking.cusum import ChangeWatch, change_point, fit_scale
from mr_damper_ros.tracking.force_scale import force_scale, with_gain
from mr_damper_ros.tracking.operating_point import (
    MOST_SAMPLES,
    Kept,
    KnownForce,
    nearest_same,
    thinned_to_keep,
)
from mr_damper_ros.tracking.recursive_tracker import METHOD, FilterState, RecursiveFilter
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.running_set import (
    SteadyMotion,
    candidate,
    known_force,
    new_set,
)
from mr_damper_ros.tracking.screening import (
    Screening,
    fault_at_rest,
    fault_of_rest,
    fault_of_samples,
    fault_of_sign,
    lack_of_cycle,
    lack_of_motion,
)
from mr_damper_ros.tracking.window_assembler import ENOUGH_POINTS, RawWindow

_DIVERGED = 2.0
"""The filter has diverged if the RMSE of the validation samples exceeds this multiple of the noise
that the filter expects."""

_MOST_INTERVALS = 6
"""Largest number of intervals into which a continuous range of currents is divided."""

_LEAST_SPEED = 0.2
"""A part of a window counts as an operating point if it has ``ENOUGH_POINTS`` samples and an RMS
speed of at least this fraction of the window's RMS speed."""

_EXPLAINED_RATIO = 1.25
_EXPLAINED_PART = 0.01
"""One set explains the parts if its error is at most ``_EXPLAINED_RATIO`` times the error of
separate fits, or if the additional error is at most ``_EXPLAINED_PART`` of the force."""


@dataclass(frozen=True, eq=False)
class Job:
    """A task for the worker, starting from the ``running`` set.

    A window fit and a change check have ``raw`` samples; their ``windows`` are the newest ones at
    the recent operating points, and ``baselines`` the baselines of the force scale. ``state`` is
    the state of the recursive filter, ``watch`` the state of the change detection (None: off).
    Samples stamped before ``changed_ns`` precede the last sudden change of the damper.

    A search has the settings ``evolution``. Its ``windows`` are all windows in the reservoir, up to
    ``stamp_ns``; the last ``recent`` of them are at the recent operating points. ``asked`` is True
    for a requested search and False for a periodic one.

    ``rival`` is a set that the window must confirm. ``number`` is part of a new set's name.
    """

    running: ParameterSet
    options: FitOptions
    raw: RawWindow | None = None
    number: int = 0
    rival: ParameterSet | None = None
    windows: tuple[Window, ...] = ()
    baselines: tuple[WindowFit, ...] = ()
    state: FilterState | None = None
    watch: ChangeWatch | None = None
    changed_ns: int = 0
    evolution: EvolutionSettings | None = None
    stamp_ns: int = 0
    recent: int = 1
    asked: bool = True

    @property
    def samples(self) -> RawWindow:
        """The raw samples of a window fit or a change check."""
        assert self.raw is not None
        return self.raw

    @property
    def known(self) -> bool:
        """Whether the running set was identified on this damper."""
        return bool(self.running.observable.any())

    @property
    def fresh(self) -> int:
        """Number of samples of the window that the running set was not fitted to."""
        raw = self.samples
        fresh = round((raw.end_ns - self.running.stamp_ns) / (raw.period * NANOSECONDS))
        # A set stamped after the window (the clock was set back) shares no samples with it.
        return fresh if fresh >= 0 else raw.force.size


@dataclass(frozen=True)
class PartsByCurrent:
    """Errors of separate fits to the parts of a window, each at about one current.

    ``rmse`` [N] and ``nrmse`` are the errors over all parts. ``explained`` says whether one set for
    all parts fits almost as well.
    """

    rmse: float
    nrmse: float
    explained: bool


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a job; ``refusal`` says why nothing was fitted, None after a fit.

    ``report`` holds the figures of the job; the tracker adds the verdict. ``found`` is the new set.
    ``fit``, ``force`` and ``motion`` belong to a window: its fit, the size of its force, and its
    motion. ``kept`` is the window thinned for the reservoir, or its parts if the current changes;
    empty for a change check. The worker returns it because sending the motion takes less time than
    computing it again. ``parts`` holds the errors of separate fits to these parts; None if the
    current is constant. ``rival_wins`` says whether the rival of the job predicts the window
    better, None without a rival; if it does, the evidence compares the new set with the rival.
    ``message`` says how a search ended. ``duration`` [s] is the duration of the job.
    """

    refusal: Judgement | None = None
    report: Report | None = None
    found: ParameterSet | None = None
    evidence: Evidence | None = None
    fit: WindowFit | None = None
    force: KnownForce | None = None
    motion: SteadyMotion = field(default_factory=SteadyMotion)
    kept: tuple[Kept, ...] = ()
    parts: PartsByCurrent | None = None
    state: FilterState | None = None
    watch: ChangeWatch | None = None
    rival_wins: bool | None = None
    message: str = ""
    duration: float = math.nan


def blank_report(job: Job) -> Report:
    """The report on a job without a result."""
    raw, model = job.raw, job.running.law
    if raw is None:
        # Linear laws are solved by least squares; the others need a search.
        searched = model.searched_laws(frozenset(model.parameter_names)) > 0
        return Report(
            window_start_ns=job.stamp_ns,
            stamp_ns=job.stamp_ns,
            set_id=job.running.set_id,
            sample_count=sum(window.sample_count for window in job.windows),
            method="differential_evolution" if searched else "least_squares",
        )
    unknown = np.full(len(model.coefficient_names), math.nan)
    return Report(
        window_start_ns=raw.start_ns,
        stamp_ns=raw.end_ns,
        set_id=job.running.set_id,
        sample_count=raw.force.size,
        method=job.options.method,
        current=float(np.mean(raw.current)),
        temperature=raw.temperature,
        coefficient_names=model.coefficient_names,
        coefficients=unknown,
        coefficient_errors=unknown,
        coefficient_discrepancies=unknown,
    )


def _report(job: Job, window: Window, fit: WindowFit) -> Report:
    """The figures of a fitted window."""
    report = replace(
        blank_report(job),
        method=fit.method,
        evaluations=fit.evaluations,
        scale=force_scale(job.running.law, window, fit, job.baselines),
        peak_velocity=fit.operating_point[0],
        amplitude=window.motion.amplitude,
        frequency=window.motion.frequency,
        coefficients=fit.coefficients,
    )
    if job.samples.look:  # a single factor does not determine the errors of the coefficients
        return report
    report = replace(report, coefficient_errors=_errors(fit.coefficient_covariance))
    if fit.coefficient_discrepancy is None:
        return report
    return replace(report, coefficient_discrepancies=_errors(fit.coefficient_discrepancy))


def _errors(covariance: Array) -> Array:
    # Rounding may make a variance near zero slightly negative.
    return np.sqrt(np.maximum(np.diag(covariance), 0.0))


# A search also tries parameters whose force overflows, and rejects them.
@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def run(job: Job, control: Control | None = None) -> Outcome:
    """Run a job; faults of the data and failures are returned as a refusal.

    ``control`` can end the job early, with the best result so far.
    """
    began = time.perf_counter()
    try:
        outcome = _search(job, control) if job.raw is None else _fit(job, control)
    except DataError as error:
        outcome = Outcome(fault_of_data(str(error)))
    except (ValueError, ArithmeticError) as error:
        sentence = f"the identification failed ({type(error).__name__}: {error}): the running set"
        outcome = Outcome(Judgement(Verdict.FAILED, f"{sentence} stays"))
    return replace(outcome, duration=time.perf_counter() - began)


def _too_little_motion(sentence: str) -> Judgement:
    return Judgement(Verdict.TOO_LITTLE_MOTION, sentence)


def _fit(job: Job, control: Control | None) -> Outcome:
    """Screen a window; then fit it, run the filter over it, or check it for a change."""
    raw, limits = job.samples, job.options.screening
    fault = fault_of_samples(raw.displacement, raw.force, raw.current, limits)
    if fault:
        return Outcome(fault_of_data(fault))
    lack = lack_of_motion(raw.displacement, limits)
    if lack:
        fault = fault_at_rest(raw.displacement, raw.force, job.running.largest_force)
        return Outcome(fault_of_data(fault) if fault else _too_little_motion(lack))
    window = Window.from_samples(
        raw.displacement, raw.force, raw.current, raw.period, raw.peak_velocity
    )
    velocity, force = window.motion.velocity, window.force
    fault, lack = fault_of_rest(velocity, force), lack_of_cycle(raw.displacement, velocity)
    fault = fault or ("" if lack else fault_of_sign(velocity, force))
    if fault or lack:
        return Outcome(fault_of_data(fault) if fault else _too_little_motion(lack))
    if raw.force_after is not None:
        window = window.measured_after(raw.force_after)
    if raw.look:
        return _look(job, window)
    before_change = math.ceil((job.changed_ns - raw.start_ns) / (raw.period * NANOSECONDS))
    if before_change > 0.5 * window.sample_count:
        return Outcome(_too_little_motion("most of the window lies before the change of the force"))
    window = window.part(slice(max(before_change, 0), None))
    rival, taken = job.rival, None
    if rival is not None:
        taken = rival_wins(
            rival,
            job.running,
            window,
            fresh=job.fresh,
            maximum_nrmse=job.options.acceptance.maximum_nrmse,
            elsewhere=job.windows,
        )
        if taken:
            # The states of the filter and of the change detection belong to the replaced set.
            job = replace(job, running=rival, state=None, watch=None)
    follow = TRACKERS[job.options.tracker]
    outcome = follow(job, window) if follow else None
    outcome = outcome or _fitted(job, window, control.should_stop if control else None)
    return replace(outcome, rival_wins=taken)


def _followed(job: Job, window: Window) -> Outcome | None:
    """Run the recursive filter over the samples of a window that it has not used yet.

    Returns None after a jump in time or to another operating point, and if the filter has diverged,
    for example from a poorly determined state. A window fit then restarts the filter.
    """
    raw, options, state = job.samples, job.options, job.state
    if state is None or not state.stamp_ns < raw.end_ns:
        return None
    if nearest_same([state.operating_point], window.operating_point) is None:
        return None
    unseen = round((raw.end_ns - state.stamp_ns) / (raw.period * NANOSECONDS))
    new = window.part(slice(max(window.sample_count - unseen, 0), None))
    problem = WindowProblem(job.running.law, new, job.running.values)
    follower = RecursiveFilter(
        state, problem, raw.end_ns, drift_rate=options.drift_rate, robust=options.robust
    )
    validation = validation_mask(new.sample_count, job.fresh)
    follower.take_in(~validation)
    evidence = _evidence(job, new, follower.as_fit(problem).parameters, validation)
    if evidence.rmse_after > _DIVERGED * follower.noise_level:
        return None
    follower.take_in(validation)
    fit = follower.as_fit(WindowProblem(job.running.law, window, job.running.values))
    return _outcome(job, window, fit, evidence, follower.state)


TRACKERS: dict[str, Callable[[Job, Window], Outcome | None] | None] = {
    "window": None,
    METHOD: _followed,
    "unscented": _followed,
}
"""Tracking methods by name. The function of a method continues from the state of a job and returns
its outcome, or None to request a window fit. If the entry is None, every window is fitted."""


@dataclass(frozen=True)
class FitOptions(CheckedSettings):
    """How a window is fitted."""

    smallest_change: float = option(
        0.02,
        "Relative change of the force that triggers an early fit (see looks). If the force is "
        "hardly larger than its noise, a false alarm occurs every few hours; otherwise false "
        "alarms practically never occur.",
        within=(0.001, 1.0),
    )
    tracker: str = option(
        "window",
        "Tracking method: window (each window is fitted on its own) or recursive (an extended "
        "Kalman filter, which uses every sample once and starts from the fit of a window; its "
        "earlier name unscented is still accepted).",
        choices=tuple(TRACKERS),
    )
    drift_rate: float = option(
        1e-3,
        "For tracker recursive: expected random walk of the force [1/sqrt(s)], relative to "
        "the force. A larger value tracks faster and averages less.",
        within=(1e-9, 1.0),
    )
    method: str = option(
        "nelder_mead",
        "Fit of a window: nelder_mead (simplex search, as in the thesis, refined by least "
        "squares) or least_squares (Levenberg-Marquardt only: the same minimum, about five "
        "times faster).",
        choices=WINDOW_METHODS,
    )
    robust: bool = option(
        False,
        "Whether the influence of force outliers is bounded (Huber's weights). It costs some "
        "milliseconds per window and has no noticeable effect without outliers.",
    )
    screening: Screening = group(Screening)
    acceptance: AcceptanceSettings = group(AcceptanceSettings)


def _fitted(job: Job, window: Window, should_stop: Callable[[], bool] | None) -> Outcome:
    """Fit a window, first without its validation samples and then to all samples."""
    model, options = job.running.law, job.options
    validation = validation_mask(window.sample_count, job.fresh)
    start = job.running.values
    _, fastest = job.running.peak_velocity_range
    prior = WindowPrior(start, fastest) if job.known else None
    trained = fit_window(
        model,
        window.part(~validation),
        start,
        method=options.method,
        robust=options.robust,
        prior=prior,
        should_stop=should_stop,
    )
    evidence = _evidence(job, window, trained.parameters, validation)
    # The published set uses all samples; the validation samples only serve the acceptance test.
    final = fit_window(
        model,
        window,
        trained.parameters,
        method="least_squares",
        robust=options.robust,
        prior=prior,
    )
    final = replace(
        final,
        method=options.method,
        evaluations=trained.evaluations + final.evaluations,
        success=trained.success,
        message=trained.message,
    )
    remembers = TRACKERS[options.tracker] is not None
    state = FilterState.of(final, job.samples.end_ns) if remembers else None
    return _outcome(job, window, final, evidence, state)


def _evidence(job: Job, window: Window, values: Array, validation: np.ndarray) -> Evidence:
    found = candidate(job.running, values, window)
    return evidence_of(
        job.running, found, window, validation, fresh=job.fresh, elsewhere=job.windows
    )


def _outcome(
    job: Job, window: Window, fit: WindowFit, evidence: Evidence, state: FilterState | None
) -> Outcome:
    """The outcome of a fit, with a change detection for later samples."""
    model, options, running = job.running.law, job.options, job.running
    judged = candidate(running, fit.parameters, window)
    settled = model.settled(window, fit.parameters)
    watch = ChangeWatch.after_fit(
        judged.window_force(window)[settled],
        window.force[settled],
        fit.operating_point,
        options.smallest_change,
    )
    parts = parts_by_current(model, window, options.screening.current_tolerance)
    divided = bool(parts) and parts[0] is not window
    stamp_ns, name = job.samples.end_ns, f"window-{job.number}"
    return Outcome(
        report=_report(job, window, fit),
        found=new_set(running, fit, evidence, window, set_id=name, stamp_ns=stamp_ns),
        evidence=evidence,
        fit=fit,
        force=known_force(fit, window),
        motion=SteadyMotion.of(window),
        kept=tuple(
            thinned_to_keep(part, with_past=model.needs_past(part), parts=len(parts))
            for part in parts
        ),
        parts=judge_parts(window, parts, judged) if divided else None,
        state=state,
        watch=watch,
    )


# -- a window of changing current ------------------------------------------------------------


def parts_by_current(model: Model, window: Window, tolerance: float) -> list[Window]:
    """Parts of a window within which the current is about constant.

    If the current is constant, the window itself is the only part. Levels of the current more than
    ``tolerance`` [A] apart become separate parts; a continuous range is divided into equal
    intervals. Each part is an operating point, whose fit does not depend on the law's dependence on
    the current. Samples at the start of the window at which the force of the ``model`` depends on
    the unknown past do not count towards the smallest size of a part.
    """
    if float(np.ptp(window.current)) <= tolerance:
        return [window]
    lead_in = round(LONGEST_SETTLING * window.sample_count) if model.needs_past(window) else 0
    edges = _edges(window.current, tolerance)
    place = np.searchsorted(edges, window.current, side="right")
    speed = window.motion.velocity
    least = _LEAST_SPEED * float(np.sqrt(np.mean(speed**2)))
    parts = []
    for number in range(edges.size + 1):
        chosen = place == number
        if np.count_nonzero(chosen[lead_in:]) < ENOUGH_POINTS:
            continue
        moving = float(np.sqrt(np.mean(speed[chosen] ** 2))) >= least
        if moving and np.ptp(window.force[chosen]) > 0.0:
            parts.append(window.part(chosen))
    return parts


def _edges(current: Array, tolerance: float) -> Array:
    """Currents [A] between the parts, in ascending order."""
    levels = np.unique(current)
    widest = max(float(np.ptp(levels)) / _MOST_INTERVALS, tolerance)
    gaps = np.flatnonzero(np.diff(levels) > tolerance)
    edges = (0.5 * (levels[gaps] + levels[gaps + 1])).tolist()
    for stretch in np.split(levels, gaps + 1):
        count = math.ceil(float(np.ptp(stretch)) / widest)
        edges += np.linspace(stretch[0], stretch[-1], count + 1)[1:-1].tolist()
    return np.sort(edges)


def judge_parts(window: Window, parts: Sequence[Window], found: ParameterSet) -> PartsByCurrent:
    """Compare the error of one set for all parts of a window with the error of separate fits."""
    few = [found.held(part.thinned(MOST_SAMPLES // 2)) for part in parts]
    own = [fit_window(found.law, part, found.values, method="least_squares") for part in few]
    alone = _pooled([fit.rmse for fit in own], parts)
    together = _pooled([error_of_set(found, [part]).rmse for part in few], parts)
    spread = float(np.std(window.force))
    explained = together <= max(
        _EXPLAINED_RATIO * alone, math.hypot(alone, _EXPLAINED_PART * spread)
    )
    return PartsByCurrent(alone, alone / spread, explained)


def _pooled(errors: Sequence[float], parts: Sequence[Window]) -> float:
    """RMSE [N] over all parts, from the RMSE of each part."""
    counts = [part.sample_count for part in parts]
    return math.sqrt(float(np.average(np.square(errors), weights=counts)))


# -- a change check --------------------------------------------------------------------------


def _look(job: Job, window: Window) -> Outcome:
    """Check whether the newest samples fit the running set; otherwise fit the force scale.

    Without a change the outcome contains only the state of the change detection.
    """
    raw, watch, model = job.samples, job.watch, job.running.law
    if watch is None:
        return Outcome()
    newest = slice(window.sample_count - raw.look, None)
    here = window.part(newest).operating_point
    if nearest_same([watch.operating_point], here) is None:
        return Outcome(watch=watch.quiet())
    # The peak velocity is limited to the range of the running set, as in a prediction.
    held = job.running.held(window)
    predicted = model.window_force(held, job.running.values)
    watch = watch.follow(predicted[newest], window.force[newest])
    count = min(watch.samples_since_change, window.sample_count)
    if not watch.changed or count < CHUNKS:
        return Outcome(watch=watch)
    since = slice(window.sample_count - count, None)
    count -= change_point(predicted[since], window.force[since], CHUNKS)
    since = slice(window.sample_count - count, None)
    changed, predicted = held.part(since), predicted[since]
    lasting = model.lasting_force(changed, job.running.values)
    own, measured = predicted - lasting, changed.force - lasting
    validation = validation_mask(count)
    trained = fit_scale(own[~validation], measured[~validation]).factor
    spread = float(np.std(window.force))
    before, after = (
        float(np.sqrt(np.mean((factor * own - measured)[validation] ** 2)))
        for factor in (1.0, trained)
    )
    # The lead accounts for the autocorrelation of the model error, which in so few samples
    # resembles a change.
    noise = NoiseModel.of(trained * own - measured)
    lead = Lead.together([Lead.of(own, trained * own, measured, validation, noise)])
    scale = fit_scale(own, measured)
    if not scale.factor > 0.0 or np.ptp(changed.force) == 0.0:
        return Outcome(watch=watch)  # only a failed sensor gives such a force
    fit = with_gain(model, changed, job.running.values, scale, EARLY_SOURCE)
    state = job.state
    if state is not None:
        strength = WindowProblem(model, changed, job.running.values).strength
        factors = np.where(strength, scale.factor, 1.0)
        covariance = state.covariance * np.outer(factors, factors) + fit.covariance
        state = FilterState(state.scales * factors, covariance, raw.end_ns, here)
    evidence = Evidence(before / spread, after / spread, after, trained - 1.0, lead)
    found = new_set(
        job.running, fit, evidence, changed, set_id=f"early-{job.number}", stamp_ns=raw.end_ns
    )
    return Outcome(
        report=_report(job, changed, fit),
        found=found,
        evidence=evidence,
        fit=fit,
        state=state,
        watch=watch,
    )


# -- a search --------------------------------------------------------------------------------


def _search(job: Job, control: Control | None) -> Outcome:
    """Identify globally; a quarter of each window's samples is validation data."""
    start = job.running
    validation = [validation_mask(window.sample_count) for window in job.windows]
    pairs = list(zip(job.windows, validation, strict=True))
    fit = identify_global(
        start.law,
        [window.part(~judges) for window, judges in pairs],
        start.values,
        job.evolution or EvolutionSettings(),
        control.report if control else None,
    )
    found = replace(fit.parameter_set, set_id=f"global-{job.number}", stamp_ns=job.stamp_ns)
    report = replace(blank_report(job), evaluations=fit.evaluations)
    # A window of very few samples has no validation samples.
    judged = [window.part(judges) for window, judges in pairs if judges.any()]
    before, after = (error_of_set(each, judged).nrmse for each in (start, found))
    last = judged[-max(job.recent, 1) :]
    recent = error_of_set(start, last).nrmse, error_of_set(found, last).nrmse
    lead, leads = math.inf, []
    for window, judges in pairs:
        old, new = start.window_force(window), found.window_force(window)
        if not np.isfinite(old).all():
            break
        noise = NoiseModel.of(new - window.force)
        leads.append(Lead.of(old, new, window.force, judges, noise))
    else:
        lead = Lead.together(leads)
    newest = error_of_set(start, judged[-1:]).nrmse
    evidence = Evidence(before, after, lead=lead, recent=recent, newest=newest)
    return Outcome(report=report, found=found, evidence=evidence, message=fit.message)
