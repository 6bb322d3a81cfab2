"""Controllers of a suspension, and the car that they are for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mr_damper_ros.control.linear_plant import Bump, IsoRoad, MovingPlant, QuarterCar
from mr_damper_ros.control.semi_active import (
    Controller,
    SuspensionState,
    Weights,
    acceleration_driven,
    hybrid,
    linear_feedback,
    mixed_skyhook_add,
    optimal_gain,
    passive,
    skyhook,
)
from mr_damper_ros.signals.arrays import Array

CAR = QuarterCar()
PERIOD = 1e-3
SOFT, HARD = 300.0, 3900.0
"""Damping [N s/m] that an ideal semi-active damper can have."""


def suspension_state(state: Array, acceleration: float) -> SuspensionState:
    return SuspensionState(state[1], state[3], acceleration, state[0], state[2])


def driven(controller: Controller, road: Array) -> tuple[float, float]:
    """RMS of body acceleration [m/s²] and of the tyre's load [N], with an ideal damper."""
    car = MovingPlant(CAR.plant, PERIOD)
    force, body, tyre = 0.0, [], []
    for velocity in road.tolist():
        before = car.state
        state = car.step(force, velocity)
        body.append((state[1] - before[1]) / PERIOD)
        tyre.append(CAR.tyre * state[2])
        extension = state[1] - state[3]
        low, high = sorted((SOFT * extension, HARD * extension))
        force = min(max(controller(suspension_state(state, body[-1])), low), high)
    return float(np.sqrt(np.mean(np.square(body)))), float(np.sqrt(np.mean(np.square(tyre))))


ROAD = IsoRoad("C", 20.0, seed=3).at(np.arange(8000) * PERIOD)


@pytest.fixture(scope="module")
def soft() -> tuple[float, float]:
    return driven(passive(SOFT), ROAD)


@pytest.mark.parametrize(
    "controller",
    [
        skyhook(HARD),
        hybrid(HARD, 0.7),
        mixed_skyhook_add(SOFT, HARD, 12.0),
        linear_feedback(optimal_gain(CAR, Weights())),
    ],
    ids=["skyhook", "hybrid", "SH-ADD", "optimal"],
)
def test_a_controller_for_comfort_beats_the_soft_and_the_hard_damper(
    controller: Controller, soft: tuple[float, float]
) -> None:
    comfort, _ = driven(controller, ROAD)
    assert comfort < soft[0]
    assert comfort < driven(passive(HARD), ROAD)[0]


def test_add_is_hard_where_that_slows_the_acceleration() -> None:
    controller = acceleration_driven(SOFT, HARD)
    assert controller(SuspensionState(0.2, 0.1, 3.0)) == pytest.approx(0.1 * HARD)
    assert controller(SuspensionState(0.2, 0.1, -3.0)) == pytest.approx(0.1 * SOFT)
    assert driven(controller, ROAD)[0] < driven(passive(HARD), ROAD)[0]


def test_the_car_moves_as_its_equations_say() -> None:
    car = MovingPlant(CAR.plant, PERIOD)
    for _ in range(200):
        state = car.step(120.0, 0.1)
    run = solve_ivp(
        lambda _, x: CAR.plant.dynamics @ x + 120.0 * CAR.plant.by_force + 0.1 * CAR.plant.by_input,
        (0.0, 0.2),
        np.zeros(4),
        rtol=1e-9,
        atol=1e-12,
    )
    # Relative, of a solver with a tolerance of 1e-9.
    np.testing.assert_allclose(state, run.y[:, -1], rtol=1e-6)


def test_a_road_of_no_class_is_refused() -> None:
    with pytest.raises(ValueError, match="the classes are A, B"):
        IsoRoad("F", 20.0)


def test_a_bump_may_be_on_a_road() -> None:
    time, road = np.arange(500) * PERIOD, IsoRoad("A", 5.0, seed=1)
    even, rough = (Bump(0.05, 1.0, 5.0, road=under).at(time) for under in (None, road))
    np.testing.assert_array_equal(rough, even + road.at(time))
