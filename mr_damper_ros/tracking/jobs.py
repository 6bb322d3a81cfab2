"""Jobs for the worker: a window to fit, a look at the newest samples, or a search over windows.

One :class:`Job` goes there and one :class:`Outcome` comes back; :func:`run` is the work. What is
decided on the outcome is the tracker's (:mod:`tracker`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from mr_damper_ros.estimation.covariance import NoiseModel
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit, error_of_set, identify_global
from mr_damper_ros.estimation.global_search import adapted
from mr_damper_ros.estimation.window_fit import WindowFit, WindowPrior, fit_window
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import LONGEST_SETTLING, Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.misfit import WindowProblem
from mr_damper_ros.models.parameter_set import EARLY_SOURCE, ParameterSet
from mr_damper_ros.processes.worker import Control
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import (
    CHUNKS,
    Evidence,
    Judgement,
    Lead,
    evidence_of,
    failed,
    fault_of_data,
    held_back_samples,
    rival_wins,
    too_little_motion,
)
from mr_damper_ros.tracking.cusum import ChangeWatch, change_point, fit_scale
from mr_damper_ros.tracking.force_scale import (
    ForceScale,
    baseline_at,
    force_scale,
    with_strength,
)
from mr_damper_ros.tracking.operating_point import Kept, nearest_same, thinned_to_keep
from mr_damper_ros.tracking.recursive_tracker import METHOD, FilterState, RecursiveFilter
from mr_damper_ros.tracking.running_set import WindowSummary, candidate
from mr_damper_ros.tracking.screening import (
    Screening,
    fault_at_rest,
    fault_of_rest,
    fault_of_samples,
    fault_of_sign,
    lack_of_cycle,
    lack_of_motion,
)
from mr_damper_ros.tracking.window_assembler import RawWindow

_NEARER = 0.5
"""A start that leaves less than this part of what the running set leaves is nearer."""

_ASTRAY = 2.0
"""A filter is wrong where held-back samples differ by more than so many times their noise."""

_MOST_INTERVALS = 6
"""A range of currents that is passed through is cut into at most so many parts."""

_FEWEST_SAMPLES = 64
_LEAST_SPEED = 0.2
"""A part of fewer samples, or in which the speed (RMS) is below this part of that of the window, is
no operating point."""

_MOST_SAMPLES = 250
"""So many samples of a part tell what its own fit leaves."""

_AS_WELL = 1.25
_BESIDES = 0.01
"""The law explains the parts where it leaves no more than so many times what their own fits do, or
no more besides than this part of the force."""


class Kind(Enum):
    """What a job is."""

    WINDOW = "fit"
    LOOK = "look"
    SEARCH = "search"


@dataclass(frozen=True)
class FitOptions:
    """How a window is fitted; see the options of the same names."""

    method: str = "nelder_mead"
    robust: bool = False
    tracker: str = "window"
    drift_rate: float = 1e-3
    smallest_change: float = 0.02
    screening: Screening = field(default_factory=Screening)


@dataclass(frozen=True, eq=False)
class Job:
    """The ``running`` set, and what is to be done from it.

    A window, or a look, has its ``raw`` samples. Its ``windows`` are those at the operating points
    of the last seconds before it; ``baselines`` are those of the force scale; ``state`` is where
    the filter stood and ``watch`` that of the detector of changes, if they run; samples stamped
    before ``changed_ns`` are of the damper before its last sudden change.

    A search has its settings (``evolution``); its ``windows`` are those of the reservoir, of which
    the last ``recent`` are at the operating points of late, up to ``stamp_ns``; it is ``asked`` for
    by somebody, or fell due.

    ``rival``: a set that waits for this window to tell whether it predicts better.
    """

    running: ParameterSet
    options: FitOptions = field(default_factory=FitOptions)
    raw: RawWindow | None = None
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
    def kind(self) -> Kind:
        """What is to be done."""
        if self.raw is None:
            return Kind.SEARCH
        return Kind.LOOK if self.raw.look else Kind.WINDOW

    @property
    def samples(self) -> RawWindow:
        """Those of a window or a look."""
        assert self.raw is not None
        return self.raw

    @property
    def model(self) -> Model:
        """The force law."""
        return self.running.law

    @property
    def start(self) -> Array:
        """The parameters (p,) of the running set."""
        return self.running.values

    @property
    def known(self) -> bool:
        """Whether the running set was identified, and so is one of this very damper."""
        return bool(self.running.observable.any())

    @property
    def fresh(self) -> int:
        """Samples of a window that the running set was not fitted to."""
        raw = self.samples
        fresh = round((raw.end_ns - self.running.stamp_ns) / (raw.period * NANOSECONDS))
        # Of a later set, where time was set back, no sample is known to be in common.
        return fresh if fresh >= 0 else raw.force.size


@dataclass(frozen=True)
class PartsByCurrent:
    """What the fits of the parts of a window of about one current leave, and what the law adds.

    ``rmse`` [N], ``nrmse``; ``explained``: whether the law leaves hardly more of all of them
    together.
    """

    rmse: float
    nrmse: float
    explained: bool


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a job found; ``refusal`` says why nothing was fitted, None where something was.

    No sample comes back that the tracker has. ``kept`` is the window as the reservoir keeps it,
    thinned, or its parts, if the current changes; nothing of a look: finding the motion of a window
    takes longer than sending what is kept of it. ``parts`` is what they say of the dependence on
    the current; None where it is constant. A search brings ``found``. ``rival_wins``: whether the
    rival of the job predicts the window as well, and all here is judged against it; None without
    one. ``duration`` [s] is what the work took.
    """

    refusal: Judgement | None = None
    fit: WindowFit | None = None
    found: GlobalFit | None = None
    evidence: Evidence | None = None
    summary: WindowSummary | None = None
    kept: tuple[Kept, ...] = ()
    parts: PartsByCurrent | None = None
    state: FilterState | None = None
    watch: ChangeWatch | None = None
    scale: ForceScale = field(default_factory=ForceScale)
    rival_wins: bool | None = None
    duration: float = math.nan


def run(job: Job, control: Control | None = None) -> Outcome:
    """Do a job; a fault of the data, or a failure, comes back as a refusal.

    ``control`` can end it early, with the best so far.
    """
    began = time.perf_counter()
    try:
        outcome = _search(job, control) if job.raw is None else _fit(job, control)
    except DataError as error:
        outcome = Outcome(fault_of_data(str(error)))
    except (ValueError, ArithmeticError) as error:
        outcome = Outcome(failed(error))
    return replace(outcome, duration=time.perf_counter() - began)


def _fit(job: Job, control: Control | None) -> Outcome:
    """Screen a window; then fit it, filter it, or look at its newest samples."""
    raw, limits = job.samples, job.options.screening
    fault = fault_of_samples(raw.displacement, raw.force, raw.current, limits)
    if fault:
        return Outcome(fault_of_data(fault))
    lack = lack_of_motion(raw.displacement, limits)
    if lack:
        fault = fault_at_rest(raw.displacement, raw.force, job.running.largest_force)
        return Outcome(fault_of_data(fault) if fault else too_little_motion(lack))
    window = Window.from_samples(
        raw.displacement, raw.force, raw.current, raw.period, raw.peak_velocity
    )
    velocity, force = window.motion.velocity, window.force
    fault, lack = fault_of_rest(velocity, force), lack_of_cycle(raw.displacement, velocity)
    fault = fault or ("" if lack else fault_of_sign(velocity, force))
    if fault or lack:
        return Outcome(fault_of_data(fault) if fault else too_little_motion(lack))
    if raw.force_after is not None:
        window = window.measured_after(raw.force_after)
    if job.kind is Kind.LOOK:
        return _look(job, window)
    before_change = math.ceil((job.changed_ns - raw.start_ns) / (raw.period * NANOSECONDS))
    if before_change > 0.5 * window.sample_count:
        return Outcome(too_little_motion("most of the window lies before the change of the force"))
    window = window.part(slice(max(before_change, 0), None))
    rival, taken = job.rival, None
    if rival is not None:
        taken = rival_wins(rival, job.running, window, fresh=job.fresh, elsewhere=job.windows)
        if taken:
            # The filter and the detector of changes follow the other set.
            job = replace(job, running=rival, state=None, watch=None)
    follow = TRACKERS[job.options.tracker]
    outcome = follow(job, window) if follow else None
    outcome = outcome or _fitted(job, window, control.should_stop if control else None)
    return replace(outcome, rival_wins=taken)


def _followed(job: Job, window: Window) -> Outcome | None:
    """The recursive filter after the samples of a window that it has not seen yet.

    None after a jump in time or to another operating point, and where the filter has gone astray,
    as it may where it knew too little: a fit must come first.
    """
    raw, options, state = job.samples, job.options, job.state
    if state is None or not state.stamp_ns < raw.end_ns:
        return None
    if nearest_same([state.operating_point], window.operating_point) is None:
        return None
    unseen = round((raw.end_ns - state.stamp_ns) / (raw.period * NANOSECONDS))
    new = window.part(slice(max(window.sample_count - unseen, 0), None))
    problem = WindowProblem(job.model, new, job.start)
    follower = RecursiveFilter(
        state, problem, raw.end_ns, drift_rate=options.drift_rate, robust=options.robust
    )
    held_back = held_back_samples(new.sample_count, job.fresh)
    follower.take_in(~held_back)
    evidence = _evidence(job, new, follower.as_fit(problem).parameters, held_back)
    if evidence.rmse_after > _ASTRAY * follower.noise_level:
        return None
    follower.take_in(held_back)
    fit = follower.as_fit(WindowProblem(job.model, window, job.start))
    return _outcome(job, window, fit, evidence, follower.state)


TRACKERS: dict[str, Callable[[Job, Window], Outcome | None] | None] = {
    "window": None,
    METHOD: _followed,
    "unscented": _followed,
}
"""How the damper is followed from window to window, by name: what goes on from the state of a job,
or asks for a fit (None); without it every window is fitted. A new tracker is one line here."""


def _fitted(job: Job, window: Window, should_stop: Callable[[], bool] | None) -> Outcome:
    """Fit a window, once to what is not held back and once to all of it."""
    model, options = job.model, job.options
    held_back = held_back_samples(window.sample_count, job.fresh)
    start = _start_of(job, window)
    _, fastest = job.running.peak_velocity_range
    prior = WindowPrior(start, fastest) if job.known else None
    trained = fit_window(
        model,
        window.part(~held_back),
        start,
        method=options.method,
        robust=options.robust,
        prior=prior,
        should_stop=should_stop,
    )
    evidence = _evidence(job, window, trained.parameters, held_back)
    # What is published uses every sample; the held-back part only judged whether to.
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


def _evidence(job: Job, window: Window, values: Array, held_back: np.ndarray) -> Evidence:
    found = candidate(job.running, values, window)
    return evidence_of(
        job.running, found, window, held_back, fresh=job.fresh, elsewhere=job.windows
    )


def _start_of(job: Job, window: Window) -> Array:
    """The running set (p,), or that first found at the window's operating point where it is nearer.

    From far away a search may end in another minimum. Only the force of the latter counts: what has
    been learnt since of other operating points stays.
    """
    baseline = baseline_at(job.baselines, window.operating_point)
    if baseline is None:
        return job.start
    model = job.model
    linear = frozenset(model.free_in_one_run)
    first = adapted(model, [window], baseline.parameters, job.start, linear)
    left, left_by_first = (
        float(np.sum((model.window_force(window, each) - window.force) ** 2))
        for each in (job.start, first)
    )
    return first if left_by_first < _NEARER**2 * left else job.start


def _outcome(
    job: Job, window: Window, fit: WindowFit, evidence: Evidence, state: FilterState | None
) -> Outcome:
    """The outcome of a fit: with its force scale, and a watch for changes from its window on."""
    model, options = job.model, job.options
    found = candidate(job.running, fit.parameters, window)
    settled = model.settled(window, fit.parameters)
    watch = ChangeWatch.after_fit(
        found.window_force(window)[settled],
        window.force[settled],
        fit.operating_point,
        options.smallest_change,
    )
    parts = parts_by_current(model, window, options.screening.current_tolerance)
    divided = bool(parts) and parts[0] is not window
    return Outcome(
        fit=fit,
        evidence=evidence,
        summary=WindowSummary.of(window),
        kept=tuple(
            thinned_to_keep(part, with_past=model.needs_past(part), parts=len(parts))
            for part in parts
        ),
        parts=judge_parts(window, parts, found) if divided else None,
        state=state,
        watch=watch,
        scale=force_scale(model, window, fit, job.baselines),
    )


# -- a window of changing current ------------------------------------------------------------


def parts_by_current(model: Model, window: Window, tolerance: float) -> list[Window]:
    """Parts of a window within which the current changes little; the window, if it does so itself.

    Each is an operating point of its own, whatever the law says of the dependence on the current.
    Levels of the current more than ``tolerance`` [A] apart are parts of their own. Where it passes
    through all values between, its range is cut into equal intervals. What lies only in the begin
    of the window is no part, if the force of the ``model`` there depends on the unknown past.
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
        if np.count_nonzero(chosen[lead_in:]) < _FEWEST_SAMPLES:
            continue
        moving = float(np.sqrt(np.mean(speed[chosen] ** 2))) >= least
        if moving and np.ptp(window.force[chosen]) > 0.0:
            parts.append(window.part(chosen))
    return parts


def _edges(current: Array, tolerance: float) -> Array:
    """Currents [A] at which one part ends and the next begins, rising."""
    levels = np.unique(current)
    widest = max(float(np.ptp(levels)) / _MOST_INTERVALS, tolerance)
    gaps = np.flatnonzero(np.diff(levels) > tolerance)
    edges = (0.5 * (levels[gaps] + levels[gaps + 1])).tolist()
    for stretch in np.split(levels, gaps + 1):
        count = math.ceil(float(np.ptp(stretch)) / widest)
        edges += np.linspace(stretch[0], stretch[-1], count + 1)[1:-1].tolist()
    return np.sort(edges)


def judge_parts(window: Window, parts: Sequence[Window], found: ParameterSet) -> PartsByCurrent:
    """How a set explains the parts of a window, against what their own fits leave."""
    few = [found.held(part.thinned(_MOST_SAMPLES)) for part in parts]
    own = [fit_window(found.law, part, found.values, method="least_squares") for part in few]
    alone = _pooled([fit.rmse for fit in own], parts)
    together = _pooled([error_of_set(found, [part]).rmse for part in few], parts)
    spread = float(np.std(window.force))
    explained = together <= max(_AS_WELL * alone, math.hypot(alone, _BESIDES * spread))
    return PartsByCurrent(alone, alone / spread, explained)


def _pooled(errors: Sequence[float], parts: Sequence[Window]) -> float:
    """RMSE [N] over all parts from that of each."""
    counts = [part.sample_count for part in parts]
    return math.sqrt(float(np.average(np.square(errors), weights=counts)))


# -- a look ----------------------------------------------------------------------------------


def _look(job: Job, window: Window) -> Outcome:
    """See whether the newest samples fit the running set; if not, fit the force scale to them.

    Of a look only the watch comes back as long as nothing has changed.
    """
    raw, watch, model = job.samples, job.watch, job.model
    if watch is None:
        return Outcome()
    newest = slice(window.sample_count - raw.look, None)
    here = window.part(newest).operating_point
    if nearest_same([watch.operating_point], here) is None:
        return Outcome(watch=watch.quiet())
    # The strength of the running set is judged by its own force.
    held = job.running.held(window)
    predicted = model.window_force(held, job.start)
    watch = watch.follow(predicted[newest], window.force[newest])
    count = min(watch.samples_since_change, window.sample_count)
    if not watch.changed or count < CHUNKS:
        return Outcome(watch=watch)
    since = slice(window.sample_count - count, None)
    count -= change_point(predicted[since], window.force[since], CHUNKS)
    since = slice(window.sample_count - count, None)
    changed, predicted = held.part(since), predicted[since]
    lasting = model.lasting_force(changed, job.start)
    own, measured = predicted - lasting, changed.force - lasting
    held_back = held_back_samples(count)
    trained = fit_scale(own[~held_back], measured[~held_back]).factor
    spread = float(np.std(window.force))
    before, after = (
        float(np.sqrt(np.mean((factor * own - measured)[held_back] ** 2)))
        for factor in (1.0, trained)
    )
    # What the law cannot follow lasts for much of so few samples, and looks like a change.
    noise = NoiseModel.of(trained * own - measured)
    lead = Lead.together([Lead.of(own, trained * own, measured, held_back, noise)])
    found = fit_scale(own, measured)
    if not found.factor > 0.0 or np.ptp(changed.force) == 0.0:
        return Outcome(watch=watch)  # a sensor has failed, no damper does that
    fit = with_strength(model, changed, job.start, found, EARLY_SOURCE)
    state = job.state
    if state is not None:
        strength = WindowProblem(model, changed, job.start).strength
        factors = np.where(strength, found.factor, 1.0)
        covariance = state.covariance * np.outer(factors, factors) + fit.covariance
        state = FilterState(state.scales * factors, covariance, raw.end_ns, here)
    return Outcome(
        fit=fit,
        evidence=Evidence(before / spread, after / spread, after, trained - 1.0, lead),
        summary=WindowSummary.of(changed),
        state=state,
        watch=watch,
        scale=force_scale(model, changed, fit, job.baselines),
    )


# -- a search --------------------------------------------------------------------------------


def _search(job: Job, control: Control | None) -> Outcome:
    """Identify globally; a quarter of the samples, all over every window, judges the set."""
    start = job.running
    held_back = [held_back_samples(window.sample_count) for window in job.windows]
    pairs = list(zip(job.windows, held_back, strict=True))
    fit = identify_global(
        start.law,
        [window.part(~judges) for window, judges in pairs],
        start.values,
        job.evolution or EvolutionSettings(),
        control.report if control else None,
    )
    found = fit.parameter_set
    # Of a few samples none is held back.
    judged = [window.part(judges) for window, judges in pairs if judges.any()]
    before, after = (error_of_set(each, judged).nrmse for each in (start, found))
    last = judged[-max(job.recent, 1) :]
    recent = error_of_set(start, last).nrmse, error_of_set(found, last).nrmse
    leads: list[Lead] = []
    for window, judges in pairs:
        old, new = start.window_force(window), found.window_force(window)
        if not np.isfinite(old).all():
            return Outcome(found=fit, evidence=Evidence(before, after, recent=recent))
        noise = NoiseModel.of(new - window.force)
        leads.append(Lead.of(old, new, window.force, judges, noise))
    lead = Lead.together(leads)
    return Outcome(found=fit, evidence=Evidence(before, after, lead=lead, recent=recent))
