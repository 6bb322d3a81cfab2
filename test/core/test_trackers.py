"""A tracker is one class: it is asked, and what it makes of a window is what counts."""

from __future__ import annotations

import known
import pytest

from mr_damper_ros.estimation.window_fit import WindowFit, fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.tracking.held_back import evidence_of, held_back_samples
from mr_damper_ros.tracking.scale_tracker import Followed, ScaleTracker
from mr_damper_ros.tracking.tasks import FitTask
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.trackers import TRACKERS
from mr_damper_ros.tracking.unscented_filter import FilterState, state_of

SAMPLES = 1000
SCALE = 1e-3
"""Relative: the noise moves the scale of a window by 1e-4."""

KEPT = 0.5
"""Part of the old scales that the smoothing tracker keeps."""


class SmoothingTracker(ScaleTracker):
    """A tracker such as a user adds: the mean of the last scales and those of the window."""

    name = "smoothing"
    remembers = True

    def objection(self, model: Model) -> str:
        return ""

    def follow(self, task: FitTask, window: Window) -> Followed | None:
        if task.state is None:
            return None
        fit = fit_window(task.model, window, task.start, method="least_squares")
        problem = task.model.window_problem(window, task.start)
        scales = KEPT * task.state.scales + (1.0 - KEPT) * fit.scales
        held_back = held_back_samples(window.sample_count)
        after = problem.parameters(scales)
        evidence = evidence_of(task, held_back, window, after)
        state = FilterState(scales, fit.covariance, task.window.end_ns, fit.operating_point)
        return Followed(fit, evidence, state)

    def begin(self, fit: WindowFit, stamp_ns: int) -> FilterState | None:
        return state_of(fit, stamp_ns)


def test_a_tracker_of_a_users_own_follows_the_damper(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TRACKERS, SmoothingTracker.name, SmoothingTracker())
    settings = TrackerSettings(model="sigmoid", method="least_squares", global_period=0)
    object.__setattr__(settings, "tracker", SmoothingTracker.name)  # chosen from the registry
    tracked = WindowTracker(settings, ParameterSet(known.PLAUSIBLE))
    strengths = (1.0, 0.98, 0.98)
    for number, strength in enumerate(strengths):
        weaker = known.PLAUSIBLE.copy()
        weaker[known.index("f0")] *= strength
        tracked.follow(
            known.raw_window(known.run(weaker, samples=SAMPLES, seed=number), number=number)
        )
    state = tracked.memory.state
    assert state is not None
    # Half way to 0.98, then half of the rest.
    assert state.scales[0] == pytest.approx(0.985 * known.PLAUSIBLE[0], rel=SCALE)


@pytest.mark.parametrize("model", MODELS)
def test_every_tracker_says_whether_it_follows_a_model(model: str) -> None:
    for tracker in TRACKERS.values():
        objection = tracker.objection(MODELS[model])
        assert not objection or f"model '{model}'" in objection
