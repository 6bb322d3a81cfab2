"""The unscented Kalman filter as a tracker: every sample is used once, a fit begins it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.held_back import evidence_of, held_back_samples, seen_samples
from mr_damper_ros.tracking.reservoir import nearest_same
from mr_damper_ros.tracking.scale_tracker import Followed, ScaleTracker
from mr_damper_ros.tracking.unscented_filter import (
    METHOD,
    FilterState,
    UnscentedFilter,
    state_of,
)

if TYPE_CHECKING:
    from mr_damper_ros.tracking.tasks import FitTask

_ASTRAY = 2.0
"""A filter is wrong where held-back samples differ by more than so many times their noise."""


class UnscentedTracker(ScaleTracker):
    """Goes on from the last window, where the operating point is still the same."""

    name = METHOD
    remembers = True

    def objection(self, model: Model) -> str:
        """The sigma points are evaluated at once, which not every model can."""
        if model.many_at_once:
            return ""
        return (
            f"tracker '{self.name}' does not follow model '{model.name}': choose tracker 'window'"
        )

    def follow(self, task: FitTask, window: Window) -> Followed | None:
        """The filter's state after the samples of a window that it has not seen yet.

        None after a jump in time or to another operating point, and where the filter has gone
        astray, as it may where it knew too little of the scales.
        """
        raw, settings, state = task.window, task.settings, task.state
        if state is None or not state.stamp_ns < raw.end_ns:
            return None
        if nearest_same([state.operating_point], window.operating_point) is None:
            return None
        unseen = round((raw.end_ns - state.stamp_ns) / (raw.period * NANOSECONDS))
        new = window.part(slice(max(window.sample_count - unseen, 0), None))
        held_back = held_back_samples(new.sample_count, seen_samples(task, new))
        follower = UnscentedFilter(
            state,
            task.model,
            new,
            task.start,
            raw.end_ns,
            drift_rate=settings.drift_rate,
            robust=settings.robust,
        )
        follower.take_in(~held_back)
        trained = follower.as_fit(new).parameters
        evidence = evidence_of(task, held_back, new, trained)
        if evidence.rmse_after > _ASTRAY * follower.noise_level:
            return None
        follower.take_in(held_back)
        return Followed(follower.as_fit(window), evidence, follower.state)

    def begin(self, fit: WindowFit, stamp_ns: int) -> FilterState | None:
        """Begin from a fit that determines all scales."""
        return state_of(fit, stamp_ns)
