"""A damper that is met for the first time, and then at another current."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.other_dampers import DAMPERS
from benchmarks.stream_trial import StreamTrial, TrialSettings
from mr_damper_ros.emulation.emulator import CurrentSchedule
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.tracking.tracker import TrackerSettings

STEP = 5.0
"""Seconds at the first current; after three some windows have been fitted."""


@pytest.mark.parametrize("model", ["sigmoid", "sigmoid_lag"])
def test_the_next_current_is_given_no_force_beyond_what_a_damper_can(model: str) -> None:
    tracker = TrackerSettings(method="least_squares", model=model)
    trial = StreamTrial(
        DAMPERS["viscous_tanh"],
        SineMotion(0.005, 1.0),
        CurrentSchedule([0.0, STEP], [0.2, 1.2]),
        settings=TrialSettings(block_size=50, tracker=tracker),
    )
    result = trial.run(STEP + 2.0)
    known = result.time > 3.0
    # Times the largest force of the whole run: what no other current can be taken to give.
    assert np.nanmax(np.abs(result.predicted[known])) < 2.0 * np.abs(result.true).max()
