"""Plants that contain a damper, their excitation, and suspension controllers."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mr_damper_ros.control.linear_plant import Bump, IsoRoad, MovingPlant, QuarterCar
from mr_damper_ros.control.semi_active import (
    Controller,
    SuspensionSettings,
    Weights,
    acceleration_driven,
    controller_of,
    hybrid,
    linear_feedback,
    mixed_skyhook_add,
    optimal_gain,
    passive,
    skyhook,
)
from mr_damper_ros.emulation.commanded_rig import commanded
from mr_damper_ros.emulation.emulator import (
    HOT_FORCE,
    EmulatedDamper,
    PlantRig,
    RigSettings,
    SupplySetpoint,
    invented_damper,
)
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import SuspensionState

CAR = QuarterCar()


def car_rig(current: float | SupplySetpoint = 0.3, **options: object) -> PlantRig:
    settings = {"settings": RigSettings(seed=5), **options}
    return PlantRig(
        EmulatedDamper(invented_damper(0.0), HOT_FORCE, built_in=True),
        CAR.plant,
        IsoRoad("C", 20.0, seed=2),
        current,
        **settings,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("sizes", [(50,), (1, 7, 13)])
def test_a_plant_moves_the_same_whatever_the_blocks(sizes: tuple[int, ...]) -> None:
    whole = car_rig().next_block(420)
    rig, parts = car_rig(), []
    while sum(part.sample_count for part in parts) < 420:
        size = sizes[len(parts) % len(sizes)]
        parts.append(rig.next_block(min(size, 420 - sum(p.sample_count for p in parts))))
    for name in ("displacement", "force", "current", "temperature"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name))


def test_a_choice_takes_effect_with_the_next_block() -> None:
    supply = SupplySetpoint(0.2)
    assert {supply: supply.constant(0.2)}[supply].currents == (0.2,)
    rig = car_rig(supply)
    currents = [
        block.measured.current
        for block in commanded(rig, supply, lambda measured: 1e-3 * measured.sequence, 10, 0.04)
    ]
    assert [float(current[0]) for current in currents] == pytest.approx([0.2, 0.0, 0.01, 0.02])
    assert all(np.ptp(current) == 0.0 for current in currents)


@pytest.mark.parametrize(
    "name", ["passive", "skyhook", "groundhook", "hybrid", "add", "sh_add", "optimal"]
)
def test_every_controller_has_a_name(name: str) -> None:
    force = controller_of(SuspensionSettings(controller=name))(
        SuspensionState(0.3, -0.2, 1.0, 0.01, 0.001)
    )
    assert math.isfinite(force)


def stiff_floor(now: SuspensionState) -> float:
    """A user's own controller."""
    return 1000.0 * now.stroke


def test_a_controller_of_ones_own_is_one_function() -> None:
    mine = controller_of(SuspensionSettings(function=f"{__name__}:stiff_floor"))
    assert mine(SuspensionState(0.0, 0.0, stroke=0.2)) == pytest.approx(200.0)


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ("nowhere_at_all:f", "PYTHONPATH"),
        ("math:no_such", "math has no no_such"),
        ("math", "module:function"),
        ("math:pi", "not a function"),
    ],
)
def test_a_function_that_is_not_there_is_named(place: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        controller_of(SuspensionSettings(function=place))


# -- suspension controllers and the car model ------------------------------------------------------

PERIOD = 1e-3
SOFT, HARD = 300.0, 3900.0
"""Damping [N s/m] range of an ideal semi-active damper."""


def driven(controller: Controller, road: Array) -> tuple[float, float]:
    """RMS of body acceleration [m/s²] and tyre load [N] with an ideal damper."""
    car = MovingPlant(CAR.plant, PERIOD)
    force, body, tyre = 0.0, [], []
    for velocity in road.tolist():
        before = car.state
        state = car.step(force, velocity)
        body.append((state[1] - before[1]) / PERIOD)
        tyre.append(CAR.tyre * state[2])
        extension = state[1] - state[3]
        low, high = sorted((SOFT * extension, HARD * extension))
        now = SuspensionState(state[1], state[3], body[-1], state[0], state[2])
        force = min(max(controller(now), low), high)
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

    def rates(_: float, x: Array) -> Array:
        return CAR.plant.dynamics @ x + 120.0 * CAR.plant.by_force + 0.1 * CAR.plant.by_input

    run = solve_ivp(rates, (0.0, 0.2), np.zeros(4), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(car.rates, rates(0.2, state), atol=1e-9)
    # Relative, for a solver with a tolerance of 1e-9.
    np.testing.assert_allclose(state, run.y[:, -1], rtol=1e-6)


def test_a_road_of_no_class_is_refused() -> None:
    with pytest.raises(ValueError, match="the classes are A, B"):
        IsoRoad("F", 20.0)


def test_a_bump_may_be_on_a_road() -> None:
    time, road = np.arange(500) * PERIOD, IsoRoad("A", 5.0, seed=1)
    even, rough = (Bump(0.05, 1.0, 5.0, road=under).at(time) for under in (None, road))
    np.testing.assert_array_equal(rough, even + road.at(time))
    later = Bump(0.05, 1.0, 5.0, start=100 * PERIOD).at(time)
    np.testing.assert_allclose(later[100:], even[:-100], atol=1e-9)
