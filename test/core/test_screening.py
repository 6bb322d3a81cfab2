"""Unusable windows are named before they are fitted."""

import known
import numpy as np
import pytest

from mr_damper_ros.kinematics.motion import DataError
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.screening import (
    Screening,
    TooLittleMotionError,
    check_samples,
    fault_of_samples,
    fault_of_sign,
    lack_of_motion,
)

Samples = dict[str, Array]


def samples() -> Samples:
    run = known.run(current=1.0, samples=1000)
    return {
        "displacement": run.displacement.copy(),
        "force": run.force.copy(),
        "current": np.full(1000, 1.0),
    }


def fault(data: Samples, **limits: float) -> str:
    given = Screening(**limits)
    return fault_of_samples(**data, limits=given) or lack_of_motion(data["displacement"], given)


def test_a_good_window_has_no_fault() -> None:
    assert fault(samples()) == ""


BAD: dict[str, tuple[dict[str, object], str]] = {
    "millimetres": ({"displacement": lambda x: 1e3 * x}, "is it in millimetres"),
    "force in a wrong unit": ({"force": lambda x: 1e5 * x}, "the unit of the force"),
    "milliamperes": ({"current": lambda x: 1e3 * x}, "is it in milliamperes"),
    "no motion": ({"displacement": lambda x: 0.0 * x + 0.01}, "move the damper"),
    "hardly any motion": (
        {"displacement": lambda x: 0.05 * x},
        "0.25 mm is below the minimum of 0.5 mm",
    ),
    "no force": ({"force": lambda x: 0.0 * x}, "is the load cell connected"),
    "clipped above": ({"force": lambda x: np.minimum(x, 0.8 * x.max())}, "the force is clipped"),
    "clipped below": ({"force": lambda x: np.maximum(x, 0.8 * x.min())}, "the force is clipped"),
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


@pytest.mark.parametrize("step", [1.0, 3.0, 5.0])
def test_a_quantised_force_is_not_taken_for_clipped(step: float) -> None:
    # 16 bits over a load cell of 100 kN are 3 N.
    data = samples()
    data["force"] = np.round(data["force"] / step) * step
    assert fault(data) == ""


@pytest.mark.parametrize("dwell", [0.05, 0.1, 0.2])
def test_a_crank_that_rests_at_dead_centre_is_not_taken_for_clipped(dwell: float) -> None:
    # It slows down, stops completely, and starts slowly.
    t = np.arange(2000) * 1e-3
    cycle = np.clip((t % 0.5) / 0.5 / (1.0 - dwell), 0.0, 1.0)
    data = {
        "displacement": 5e-3 * np.cos(2.0 * np.pi * cycle),
        "force": known.run(current=1.0, samples=2000).force,
        "current": np.full(2000, 1.0),
    }
    assert fault(data) == ""
    clipped = np.minimum(data["displacement"], 4.8e-3)
    assert "the displacement is clipped" in fault({**data, "displacement": clipped})


@pytest.mark.parametrize(
    ("moving", "size", "known", "error"),
    [
        (0.0, 1.0, 1.0, DataError),
        (0.0, 0.05, 1.0, TooLittleMotionError),  # hum of the load cell
        (0.0, 1.0, np.nan, TooLittleMotionError),
        (0.05, 1.0, 1.0, TooLittleMotionError),
    ],
)
def test_a_displacement_that_rests_while_the_force_goes_through_a_cycle_is_at_fault(
    moving: float, size: float, known: float, error: type[Exception]
) -> None:
    data, noise = samples(), np.random.default_rng(0).normal(0.0, 1e-6, 1000)
    displacement, force = moving * data["displacement"] + noise, size * data["force"]
    largest = known * float(np.abs(data["force"]).max())
    with pytest.raises(error):
        check_samples(displacement, force, data["current"], Screening(), largest)


@pytest.mark.parametrize("offset", [0.0, 10_000.0])
def test_a_reversed_sign_is_found_whatever_the_zero_of_the_load_cell(offset: float) -> None:
    run = known.run(current=1.0, samples=1000)
    assert fault_of_sign(run.velocity, offset + run.force) == ""
    assert "reverse the sign" in fault_of_sign(run.velocity, offset - run.force)
