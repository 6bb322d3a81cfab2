"""The work of a window's task: screened, fitted or filtered, and judged by what was held back."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mr_damper_ros.estimation.adaptation import adapted
from mr_damper_ros.estimation.window_fit import WindowFit, WindowPrior, fit_window
from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import (
    Evidence,
    failed,
    fault_of_data,
    too_little_motion,
)
from mr_damper_ros.tracking.current_parts import judge_parts, parts_by_current
from mr_damper_ros.tracking.cusum import ChangeWatch
from mr_damper_ros.tracking.force_scale import Baselines, force_scale
from mr_damper_ros.tracking.held_back import evidence_of, held_back_samples, seen_samples
from mr_damper_ros.tracking.look_task import run_look
from mr_damper_ros.tracking.reservoir import thinned_to_keep
from mr_damper_ros.tracking.running_set import candidate
from mr_damper_ros.tracking.screening import (
    fault_at_rest,
    fault_of_rest,
    fault_of_samples,
    fault_of_sign,
    lack_of_cycle,
    lack_of_motion,
)
from mr_damper_ros.tracking.tasks import FitResult, FitTask, WindowSummary
from mr_damper_ros.tracking.trackers import TRACKERS
from mr_damper_ros.tracking.unscented_filter import FilterState

_NEARER = 0.5
"""A start that leaves less than this part of what the running set leaves is nearer."""


def run_fit(task: FitTask, should_stop: Callable[[], bool] | None = None) -> FitResult:
    """Fit the window of a task; a fault of the data, or a failure, comes back as a sentence.

    Of a look only the watch comes back as long as nothing has changed.
    """
    raw, settings = task.window, task.settings
    fault = fault_of_samples(raw.displacement, raw.force, raw.current, settings.screening)
    if fault:
        return FitResult(fault_of_data(fault))
    lack = lack_of_motion(raw.displacement, settings.screening)
    if lack:
        fault = fault_at_rest(raw.displacement, raw.force, task.running.largest_force)
        return FitResult(fault_of_data(fault) if fault else too_little_motion(lack))
    try:
        window = Window.from_samples(
            raw.displacement, raw.force, raw.current, raw.period, raw.peak_velocity
        )
        fault = fault_of_rest(window.motion.velocity, window.force)
        if fault:
            return FitResult(fault_of_data(fault))
        lack = lack_of_cycle(raw.displacement, window.motion.velocity)
        if lack:
            return FitResult(too_little_motion(lack))
        fault = fault_of_sign(window.motion.velocity, window.force)
        if fault:
            return FitResult(fault_of_data(fault))
        if raw.force_after is not None:
            window = window.measured_after(raw.force_after)
        if raw.look:
            return run_look(task, window)
        before_change = math.ceil((task.changed_ns - raw.start_ns) / (raw.period * NANOSECONDS))
        if before_change > 0.5 * window.sample_count:
            return FitResult(
                too_little_motion("most of the window lies before the change of the force")
            )
        window = window.part(slice(max(before_change, 0), None))
        tracker = TRACKERS[settings.tracker]
        followed = tracker.follow(task, window)
        if followed is not None:
            return _fitted(task, window, followed.fit, followed.evidence, followed.state)
        held_back = held_back_samples(window.sample_count, seen_samples(task, window))
        model, start = task.model, _start_of(task, window)
        _, fastest = task.running.peak_velocity_range
        prior = WindowPrior(start, fastest) if task.known else None
        trained = fit_window(
            model,
            window.part(~held_back),
            start,
            method=settings.method,
            robust=settings.robust,
            prior=prior,
            should_stop=should_stop,
        )
        evidence = evidence_of(task, held_back, window, trained.parameters)
        # What is published uses every sample; the held-back part only judged whether to.
        final = fit_window(
            model,
            window,
            trained.parameters,
            method="least_squares",
            robust=settings.robust,
            prior=prior,
        )
    except DataError as error:
        return FitResult(fault_of_data(str(error)))
    except (ValueError, ArithmeticError) as error:
        return FitResult(failed(error))
    final = replace(
        final,
        method=settings.method,
        evaluations=trained.evaluations + final.evaluations,
        success=trained.success,
        message=trained.message,
    )
    return _fitted(task, window, final, evidence, tracker.begin(final, raw.end_ns))


def _start_of(task: FitTask, window: Window) -> Array:
    """The running set (p,), or that first found at the window's operating point where it is nearer.

    From far away a search may end in another minimum. Only the force of the latter counts: what has
    been learnt since of other operating points stays.
    """
    baseline = Baselines(task.baselines).get(window.operating_point)
    if baseline is None:
        return task.start
    model = task.model
    linear = frozenset(model.free_in_one_run)
    first = adapted(model, [window], baseline.parameters, task.start, linear)
    left, left_by_first = (
        float(np.sum((model.window_force(window, each) - window.force) ** 2))
        for each in (task.start, first)
    )
    return first if left_by_first < _NEARER**2 * left else task.start


def _fitted(
    task: FitTask, window: Window, fit: WindowFit, evidence: Evidence, state: FilterState | None
) -> FitResult:
    """The result of a fit: with its force scale, and a watch for changes from its window on."""
    found = candidate(task.running, fit.parameters, window)
    settled = task.model.settled(window, fit.parameters)
    watch = ChangeWatch.after_fit(
        found.force(window)[settled],
        window.force[settled],
        fit.operating_point,
        task.settings.smallest_change,
    )
    scale = force_scale(task.model, window, fit, Baselines(task.baselines))
    parts = parts_by_current(task.model, window, task.settings.screening.current_tolerance)
    divided = bool(parts) and parts[0] is not window
    return FitResult(
        fit=fit,
        evidence=evidence,
        summary=WindowSummary.of(window),
        kept=tuple(
            thinned_to_keep(part, with_past=task.model.needs_past(part), parts=len(parts))
            for part in parts
        ),
        parts=judge_parts(window, parts, found) if divided else None,
        state=state,
        watch=watch,
        scale=scale,
    )
