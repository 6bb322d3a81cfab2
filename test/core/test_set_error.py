"""The error of a set is that of its predictions: peak velocity held, all samples together."""

from __future__ import annotations

import known
import numpy as np
import pytest
from known import SIGMOID

from mr_damper_ros.estimation.global_fit import error_of_set
from mr_damper_ros.models.parameter_set import ParameterSet


def test_the_peak_velocity_is_held_within_the_range_of_the_set() -> None:
    run = known.run(seed=None)
    narrow = ParameterSet(known.PLAUSIBLE, peak_velocity_range=(0.0, 0.5 * run.top_speed))
    held = run.window.held_within(0.0, 0.5 * run.top_speed)
    predicted = SIGMOID.window_force(held, known.PLAUSIBLE)
    error = error_of_set(narrow, [run.window])
    assert error.rmse == pytest.approx(known.rms(predicted - run.force), rel=1e-9)
    assert error.rmse > 0.01 * np.std(run.force)
