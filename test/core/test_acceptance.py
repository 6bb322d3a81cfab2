"""Bad windows are refused with a reason, and good ones are not."""

from __future__ import annotations

import math

import known
import numpy as np
import pytest

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.acceptance import AcceptanceSettings, Evidence, Gatekeeper
from mr_damper_ros.tracking.screening import Screening, fault_of_samples

SPREAD = 500.0
"""Standard deviation of the force [N] that the evidence below is about."""


def evidence(before: float, after: float, change: float = 0.0) -> Evidence:
    """RMSE [N] of the running and of the new set on held-back samples."""
    return Evidence(before / SPREAD, after / SPREAD, after, change)


def experienced(residual: float = 5.0, **settings: float) -> Gatekeeper:
    """A gatekeeper that has accepted five usual windows."""
    gatekeeper = Gatekeeper(AcceptanceSettings(**settings))
    for _ in range(5):
        assert gatekeeper.judge(evidence(2.0 * residual, residual)) == ""
    return gatekeeper


# -- gatekeeper ------------------------------------------------------------------------------


def test_a_better_set_is_accepted() -> None:
    assert Gatekeeper(AcceptanceSettings()).judge(evidence(20.0, 5.0)) == ""


def test_a_set_that_is_no_better_is_refused() -> None:
    reason = Gatekeeper(AcceptanceSettings()).judge(evidence(5.0, 5.0))
    assert "running set predicts the held-back samples as well" in reason


def test_a_fit_that_explains_too_little_is_refused() -> None:
    gatekeeper = Gatekeeper(AcceptanceSettings(maximum_nrmse=0.3))
    reason = gatekeeper.judge(evidence(500.0, 0.31 * SPREAD))
    assert "31%" in reason
    assert "maximum_nrmse (30%)" in reason


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_fit_without_a_finite_error_is_refused(value: float) -> None:
    reason = Gatekeeper(AcceptanceSettings()).judge(Evidence(1.0, value, value, 0.0))
    assert "no finite error" in reason


def test_a_set_is_accepted_where_the_running_one_has_no_finite_error() -> None:
    assert Gatekeeper(AcceptanceSettings()).judge(Evidence(math.inf, 0.01, 5.0, 0.1)) == ""


def test_a_residual_far_above_the_usual_one_is_refused() -> None:
    reason = experienced(5.0).judge(evidence(100.0, 20.0))
    assert "4.0 times the usual one" in reason


def test_a_residual_that_grows_with_the_force_is_not_a_disturbance() -> None:
    # Four times the newtons, but the same share of a force four times as large.
    large = Evidence(0.05, 5.0 / SPREAD, 20.0, 0.0)
    assert experienced(5.0).judge(large) == ""


def test_a_sensor_that_stays_noisy_is_believed_in_the_end() -> None:
    gatekeeper = experienced(5.0)
    verdicts = [gatekeeper.judge(evidence(100.0, 20.0)) for _ in range(6)]
    assert [bool(v) for v in verdicts] == [True, True, True, True, False, False]


def test_single_disturbances_never_add_up() -> None:
    gatekeeper = experienced(5.0)
    for _ in range(10):
        assert gatekeeper.judge(evidence(100.0, 20.0)) != ""
        assert gatekeeper.judge(evidence(10.0, 5.0)) == ""


def test_a_refused_window_does_not_change_what_is_usual() -> None:
    gatekeeper = experienced(5.0)
    for _ in range(3):
        gatekeeper.judge(evidence(100.0, 20.0))
    assert "4.0 times" in gatekeeper.judge(evidence(100.0, 20.0))


def test_a_large_step_waits_for_the_next_window() -> None:
    gatekeeper = experienced()
    first = gatekeeper.judge(evidence(400.0, 5.0, change=-0.7))
    assert "changed by -70% at once: waiting for the next window" in first
    assert gatekeeper.judge(evidence(400.0, 5.0, change=-0.7)) == ""


def test_a_second_window_that_says_otherwise_does_not_confirm() -> None:
    gatekeeper = experienced()
    gatekeeper.judge(evidence(400.0, 5.0, change=-0.7))
    assert "at once" in gatekeeper.judge(evidence(400.0, 5.0, change=0.9))


def test_a_good_window_in_between_takes_the_confirmation_back() -> None:
    gatekeeper = experienced()
    gatekeeper.judge(evidence(400.0, 5.0, change=-0.7))
    assert gatekeeper.judge(evidence(10.0, 5.0)) == ""
    assert "at once" in gatekeeper.judge(evidence(400.0, 5.0, change=-0.7))


@pytest.mark.parametrize("between", [evidence(5.0, 5.0), evidence(100.0, 50.0)], ids=str)
def test_a_refused_window_in_between_takes_the_confirmation_back(between: Evidence) -> None:
    gatekeeper = experienced()
    gatekeeper.judge(evidence(400.0, 5.0, change=-0.7))
    assert gatekeeper.judge(between) != ""
    assert "at once" in gatekeeper.judge(evidence(400.0, 5.0, change=-0.7))


def test_a_step_below_the_limit_is_taken_at_once() -> None:
    assert experienced(step_limit=0.2).judge(evidence(60.0, 5.0, change=-0.1)) == ""


def test_the_first_window_may_change_the_force_by_any_amount() -> None:
    assert Gatekeeper(AcceptanceSettings()).judge(evidence(400.0, 5.0, change=20.0)) == ""


def test_a_force_without_noise_is_no_disturbance_after_another() -> None:
    # What remains of an emulated force without noise is rounding, 1e-12 N or 1e-9 N.
    gatekeeper = experienced(1e-12)
    assert gatekeeper.judge(evidence(20.0, 1e-9)) == ""


# -- screening -------------------------------------------------------------------------------

Samples = dict[str, Array]


def samples() -> Samples:
    run = known.run(current=1.0, samples=1000)
    return {
        "displacement": run.displacement.copy(),
        "force": run.force.copy(),
        "current": np.full(1000, 1.0),
    }


def fault(data: Samples, **limits: float) -> str:
    return fault_of_samples(**data, limits=Screening(**limits))


def test_a_good_window_has_no_fault() -> None:
    assert fault(samples()) == ""


@pytest.mark.parametrize("name", ["displacement", "force", "current"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_named(name: str, value: float) -> None:
    data = samples()
    data[name][17] = value
    assert f"the {name} holds NaN or infinite values" in fault(data)


BAD: dict[str, tuple[dict[str, object], str]] = {
    "millimetres": ({"displacement": lambda x: 1e3 * x}, "is it in millimetres"),
    "force in a wrong unit": ({"force": lambda x: 1e5 * x}, "check its unit"),
    "milliamperes": ({"current": lambda x: 1e3 * x}, "is it in milliamperes"),
    "no motion": ({"displacement": lambda x: 0.0 * x + 0.01}, "move the damper"),
    "hardly any motion": ({"displacement": lambda x: 0.05 * x}, "0.25 mm is below 0.5 mm"),
    "no force": ({"force": lambda x: 0.0 * x}, "is the load cell connected"),
    "current step": (
        {"current": lambda x: np.where(np.arange(x.size) < 500, x, 1.5)},
        "the current changes by 0.5 A within the window",
    ),
    "clipped above": (
        {"force": lambda x: np.minimum(x, 0.8 * x.max())},
        "the force is clipped",
    ),
    "clipped below": (
        {"force": lambda x: np.maximum(x, 0.8 * x.min())},
        "the force is clipped",
    ),
    "clipped displacement": (
        {"displacement": lambda x: np.minimum(x, 0.9 * x.max())},
        "the displacement is clipped",
    ),
}


@pytest.mark.parametrize(("changes", "sentence"), BAD.values(), ids=BAD.keys())
def test_a_fault_is_named(changes: dict[str, object], sentence: str) -> None:
    data = samples()
    for name, change in changes.items():
        data[name] = change(data[name])  # type: ignore[operator]
    assert sentence in fault(data)


def test_the_limits_can_be_moved() -> None:
    data = samples()
    data["displacement"] *= 0.05
    assert fault(data, minimum_amplitude=0.1e-3) == ""
    data = samples()
    data["current"][500:] = 1.5
    assert fault(data, current_tolerance=0.6) == ""


def test_a_clipped_force_is_seen_at_a_low_rate_too() -> None:
    run = known.run(current=1.0, frequency=3.0, period=5e-3, samples=400)
    clipped = np.clip(run.force, -0.8 * run.force.max(), 0.8 * run.force.max())
    reason = fault_of_samples(run.displacement, clipped, np.full(400, 1.0), Screening())
    assert "clipped" in reason


@pytest.mark.parametrize("step", [1.0, 3.0, 5.0])
def test_a_quantised_force_is_not_taken_for_clipped(step: float) -> None:
    # 16 bits over a load cell of 100 kN are 3 N.
    data = samples()
    data["force"] = np.round(data["force"] / step) * step
    assert fault(data) == ""


def test_a_machine_that_dwells_at_its_ends_is_not_taken_for_clipped() -> None:
    # A trapezoidal motion is driven that way: the command, not the sensor, stands still.
    t = np.arange(1000) * 1e-3
    swing = np.clip(2.0 * np.sin(2.0 * np.pi * 2.0 * t), -1.0, 1.0)
    noise = np.random.default_rng(0).normal(0.0, 1e-6, 1000)
    data = samples()
    data["displacement"] = 5e-3 * swing + noise
    assert fault(data) == ""


def test_the_residual_factor_is_used() -> None:
    assert experienced(5.0, residual_factor=5.0).judge(evidence(100.0, 20.0)) == ""
