"""A look: whether the newest samples still fit the running set, and an early fit where not."""

from __future__ import annotations

import numpy as np

from mr_damper_ros.estimation.covariance import NoiseModel
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import EARLY_SOURCE
from mr_damper_ros.tracking.acceptance import Evidence
from mr_damper_ros.tracking.cusum import change_point, fit_scale
from mr_damper_ros.tracking.force_scale import Baselines, force_scale, with_strength
from mr_damper_ros.tracking.held_back import Lead, held_back_samples
from mr_damper_ros.tracking.reservoir import nearest_same
from mr_damper_ros.tracking.tasks import FitResult, FitTask, WindowSummary
from mr_damper_ros.tracking.unscented_filter import FilterState

_FEWEST_EARLY = 40
"""An early fit needs as many samples: so that each held-back chunk has one."""


def run_look(task: FitTask, window: Window) -> FitResult:
    """See whether the newest samples fit the running set; if not, fit the force scale to them."""
    raw, watch = task.window, task.watch
    if watch is None:
        return FitResult()
    newest = slice(window.sample_count - raw.look, None)
    here = window.part(newest).operating_point
    if nearest_same([watch.operating_point], here) is None:
        return FitResult(watch=watch.quiet())
    # The strength of the running set is judged by its own force.
    held = task.running.held(window)
    predicted = task.model.window_force(held, task.start)
    watch = watch.follow(predicted[newest], window.force[newest])
    count = min(watch.samples_since_change, window.sample_count)
    if not watch.changed or count < _FEWEST_EARLY:
        return FitResult(watch=watch)
    since = slice(window.sample_count - count, None)
    count -= change_point(predicted[since], window.force[since], _FEWEST_EARLY)
    since = slice(window.sample_count - count, None)
    changed, predicted = held.part(since), predicted[since]
    lasting = task.model.lasting_force(changed, task.start)
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
    evidence = Evidence(before / spread, after / spread, after, trained - 1.0, lead)
    found = fit_scale(own, measured)
    if not found.factor > 0.0 or np.ptp(changed.force) == 0.0:
        return FitResult(watch=watch)  # a sensor has failed, no damper does that
    fit = with_strength(task.model, changed, task.start, found, EARLY_SOURCE)
    state = task.state
    if state is not None:
        strength = task.model.window_problem(changed, task.start).strength
        factors = np.where(strength, found.factor, 1.0)
        state = FilterState(
            state.scales * factors,
            state.covariance * np.outer(factors, factors) + fit.covariance,
            raw.end_ns,
            here,
        )
    scale = force_scale(task.model, changed, fit, Baselines(task.baselines))
    return FitResult(
        fit=fit,
        evidence=evidence,
        summary=WindowSummary.of(changed),
        state=state,
        watch=watch,
        scale=scale,
    )
