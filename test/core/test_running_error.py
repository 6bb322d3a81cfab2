"""The running error is the NRMSE of the last seconds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mr_damper_ros.tracking.running_error import RunningError

ROUNDING = 1e-9
"""Relative: sums over blocks for sums over all samples."""


def test_it_is_the_nrmse_of_what_lies_within_the_memory() -> None:
    rng = np.random.default_rng(1)
    measured = 300.0 + rng.normal(0.0, 100.0, 1000)
    predicted = measured + rng.normal(3.0, 10.0, 1000)
    running = RunningError(memory=0.5)
    for block in np.split(np.arange(1000), 100):
        running.add(predicted[block], measured[block], 1e-3)
    recent = slice(500, None)
    error = predicted[recent] - measured[recent]
    expected = math.sqrt(np.mean(error**2)) / np.std(measured[recent])
    assert running.nrmse == pytest.approx(expected, rel=ROUNDING)
    running.reset()
    assert math.isnan(running.nrmse)


def test_without_variation_there_is_no_figure() -> None:
    running = RunningError(memory=1.0)
    assert math.isnan(running.nrmse)
    running.add(np.ones(10), np.full(10, 300.1), 1e-3)
    assert math.isnan(running.nrmse)
