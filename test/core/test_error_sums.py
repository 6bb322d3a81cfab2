"""RMSE, NRMSE and R² of records, alone and taken together."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.signals.error_sums import ErrorSums, RunningError, pooled

ROUNDING = 1e-9
"""Relative: sums for means and standard deviations of the samples."""

RNG = np.random.default_rng(7)
MEASURED = 300.0 + RNG.normal(0.0, 100.0, 1000)
PREDICTED = MEASURED + RNG.normal(3.0, 10.0, 1000)


@given(cuts=st.lists(st.integers(0, 1000), max_size=5))
def test_records_taken_together_are_one_record(cuts: list[int]) -> None:
    parts = np.split(np.arange(1000), sorted(cuts))
    together = pooled(ErrorSums.of(PREDICTED[part], MEASURED[part]) for part in parts)
    whole = ErrorSums.of(PREDICTED, MEASURED)
    assert together.count == whole.count
    assert together.nrmse == pytest.approx(whole.nrmse, rel=ROUNDING)


def test_the_running_error_is_the_nrmse_of_what_lies_within_the_memory() -> None:
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
