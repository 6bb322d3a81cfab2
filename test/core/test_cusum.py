"""A sudden change of the force is detected at once, with few false alarms."""

import dataclasses
import math
from typing import Any

import known
import numpy as np
import pytest

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.cusum import SLACK, ChangeWatch
from mr_damper_ros.tracking.force_scale import measured_scale
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.tracker import EARLY_METHOD, WindowTracker

POINT = (0.03, 1.0)

SCALE_ERROR = 0.01
"""Relative: a tenth of the detected change."""


def noise(seed: int, count: int, deviation: float = 1.0) -> Array:
    return np.random.default_rng(seed).normal(0.0, deviation, count)


# -- the statistic ---------------------------------------------------------------------------


def blocks_to_alarm(seed: int, threshold: float, most: int) -> int:
    """Blocks until a false alarm on white noise of the size of the force."""
    watch = ChangeWatch(
        noise=1.0,
        block_norm=1.0,
        smallest_change=1e-6,
        operating_point=POINT,
        block=1,
        threshold=threshold,
    )
    predicted = np.ones(1)
    for number, value in enumerate(noise(seed, most), start=1):
        watch = watch.follow(predicted, predicted + value)
        if watch.samples_since_change:
            return number
    return most


def average_run_length(threshold: float) -> float:
    """Mean number of blocks between two false alarms of both sums, in white noise.

    Siegmund's approximation ("Sequential Analysis", 1985); 1.166 corrects the threshold for the
    overshoot over it.
    """
    reach = 2.0 * SLACK * (threshold + 1.166)
    return (math.exp(reach) - reach - 1.0) / (2.0 * SLACK**2) / 2.0


def test_false_alarms_are_as_rare_as_stated() -> None:
    threshold = 3.0
    found = np.mean([blocks_to_alarm(seed, threshold, 5000) for seed in range(150)])
    # Relative: the mean of 150 run lengths is accurate to 8 %.
    assert found == pytest.approx(average_run_length(threshold), rel=0.1)


def test_the_swing_of_a_law_that_is_not_exact_is_no_change() -> None:
    # 15 % of the force in its third harmonic: far above the noise and equal in every cycle.
    phase = np.arange(2000) * 2.0 * math.pi / 1000.0
    predicted = 100.0 * np.tanh(3.0 * np.sin(phase))
    swing = 15.0 * np.sin(3.0 * phase)
    # The residual of a fit is orthogonal to the force.
    swing -= (predicted @ swing) / (predicted @ predicted) * predicted
    measured = predicted + swing + noise(0, 2000)
    watch = ChangeWatch.after_fit(predicted, measured, POINT, 0.02)
    for seed in range(20):
        watch = watch.follow(predicted, measured + noise(1 + seed, 2000))
    assert not watch.samples_since_change
    assert watch.follow(predicted, 0.7 * measured).samples_since_change


def test_without_force_there_is_nothing_to_compare() -> None:
    watch = ChangeWatch.after_fit(np.zeros(100), noise(0, 100), POINT, 0.02)
    assert not watch.follow(np.zeros(100), noise(1, 100)).samples_since_change
    assert math.isnan(measured_scale(np.zeros(5), np.ones(5)).value)


# -- early fits ------------------------------------------------------------------------------

STEP, TRANSITION = 4.3, 0.01
"""Time of the step [s], in the middle of a hop, and its duration [s]: a factor that arrives within
one sample is one of the load cell."""


def stream(
    factor: float = 0.9, *, spoil: object = None, **run: object
) -> tuple[WindowTracker, list[Report]]:
    """A tracker after ten seconds in which the force changes, and its reports."""
    settings: dict[str, object] = {"samples": 10_000, **run}
    whole = known.run(**settings)  # type: ignore[arg-type]
    time = np.arange(10_000) * whole.period
    share = np.clip((time - STEP) / TRANSITION, 0.0, 1.0)
    force = whole.force + share * (factor - 1.0) * whole.clean
    if callable(spoil):
        force = spoil(time, force)
    tracked = known.tracker()
    return tracked, known.followed(tracked, whole.displacement, force, 1.0)


def early(reports: list[Report]) -> list[Report]:
    return [report for report in reports if report.method == EARLY_METHOD]


def seconds(report: Report) -> float:
    return (report.stamp_ns - known.T0) * 1e-9


@pytest.mark.parametrize("factor", [0.7, 0.9, 1.15])
def test_a_step_is_fitted_before_the_hop_is_over(factor: float) -> None:
    reports = stream(factor)[1]
    (report,) = early(reports)
    assert STEP < seconds(report) < 5.0
    assert report.accepted
    assert report.set_id.startswith("early-")
    assert f"the force changed by {factor - 1.0:+.0%} at t = " in report.reason
    assert report.reason.endswith("fitted early")
    told = float(report.reason.split("t = ")[1].split()[0]) - known.T0 * 1e-9
    # Seconds, for a damper that moves at 1 Hz.
    assert told == pytest.approx(STEP, abs=0.02)
    assert report.scale.value == pytest.approx(factor, rel=SCALE_ERROR)
    assert np.isnan(report.coefficient_errors).all()


def test_after_a_step_no_window_mixes_before_and_after() -> None:
    tracked, reports = stream(0.9)
    after = reports[reports.index(early(reports)[0]) :]
    scales = [report.scale.value for report in after if report.confirms]
    assert len(scales) >= 2
    np.testing.assert_allclose(scales, 0.9, rtol=SCALE_ERROR)
    assert any("before the change" in report.reason for report in after)
    found = tracked.parameters.values[0]
    np.testing.assert_allclose(found, 0.9 * known.PLAUSIBLE[0], rtol=SCALE_ERROR)


FAULTS = (
    lambda time, force: np.where(abs(time - 5.4) < 0.2, force + noise(7, time.size, 300.0), force),
    lambda time, force: np.where(time > 5.2, np.clip(force, -500.0, 500.0), force),
    lambda time, force: np.where(time > 5.2, 0.0, force),
)


@pytest.mark.parametrize(
    "of_stream",
    [
        *({"current": current} for current in (0.0, 1.0)),
        *({"spoil": spoil} for spoil in FAULTS),
    ],
)
def test_a_steady_damper_or_a_fault_of_the_sensor_is_not_fitted_early(of_stream: Any) -> None:
    assert early(stream(1.0, **of_stream)[1]) == []


def test_a_force_that_clips_within_the_window_is_not_fitted_early() -> None:
    time = 1e-3 * np.arange(9000)
    moved = 5e-3 * (np.sin(2.0 * np.pi * time) + 0.5 * np.sin(4.6 * np.pi * time))
    force = ParameterSet(known.PLAUSIBLE).force(time, moved, 1.0) + noise(0, time.size, 5.5)
    force[6200:] = force[6200:].clip(-800.0, 800.0)
    assert early(known.followed(known.tracker(), moved, force, 1.0)) == []


def test_when_time_is_set_back_the_past_change_is_forgotten() -> None:
    tracked, _ = stream(0.9)
    past = dataclasses.replace(known.raw_window(known.run()), start_ns=known.T0 - 10**13)
    report = tracked.follow(past)
    assert "before the change" not in report.reason
