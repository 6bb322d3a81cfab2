"""Performance of each controller in a quarter car on roads and over a bump.

The controllers receive the true motion of body and wheel. The inverse of the known set computes the
current of the damper from the measurements of a rig.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from mr_damper_ros.control.force_controller import ForceController, ForceControlSettings
from mr_damper_ros.control.linear_plant import Bump, IsoRoad, QuarterCar
from mr_damper_ros.control.semi_active import (
    Controller,
    Weights,
    acceleration_driven,
    groundhook,
    hybrid,
    linear_feedback,
    mixed_skyhook_add,
    optimal_gain,
    skyhook,
)
from mr_damper_ros.emulation.commanded_rig import Choice, ForceChoice, commanded
from mr_damper_ros.emulation.emulator import (
    EmulatedDamper,
    RigSettings,
    SupplySetpoint,
    ThermalModel,
)
from mr_damper_ros.emulation.plant_rig import (
    HIGHEST_CURRENT,
    HOT_FORCE,
    PlantRig,
    Surroundings,
    invented_damper,
)
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.rig.sources.emulated_source import moment_of
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import RigBlock
from mr_damper_ros.tracking.engine import Engine
from studies.recordings import rms

CAR = QuarterCar()
GRAVITY = 9.80665
STATIC_LOAD = (CAR.body + CAR.wheel) * GRAVITY
"""Static load of the tyre [N]."""

SPEEDS = {"A": 30.0, "B": 25.0, "C": 20.0, "D": 15.0, "E": 10.0}
"""Speed [m/s] on a road of each class; it is lower on worse roads."""

BUMP = Bump(height=0.06, length=3.0, speed=8.0, start=3.0, road=IsoRoad("A", 8.0, seed=1))
"""The bump follows a stretch of good road, so that the controller knows the motion by then."""
BUMP_ROAD = "bump"

BLOCK = 5
SETTLED = 2.0
"""Time [s] after the start from which results are evaluated."""

OFF, ON = "passive-off", "passive-on"

SOFT, HARD = 700.0, 4000.0
"""Dampings [N s/m] between which ADD and SH-ADD switch."""

CONTROLLERS: dict[str, Controller] = {
    "skyhook": skyhook(2500.0),
    "groundhook": groundhook(2500.0),
    "hybrid": hybrid(3500.0, 0.6),
    "ADD": acceleration_driven(SOFT, HARD),
    "SH-ADD": mixed_skyhook_add(SOFT, HARD, 12.0),
    "clipped-optimal": linear_feedback(optimal_gain(CAR, Weights())),
}
"""Controllers, each with the same settings on all roads; none was tuned to a road."""

STRATEGIES = (OFF, ON, *CONTROLLERS)

CONSTANTS = {f"{current:g} A": current for current in (0.1, 0.2, 0.3, 0.4, 0.6)}
"""Constant currents [A], which represent passive dampers of different hardness."""

_HELD = {OFF: 0.0, ON: HIGHEST_CURRENT, **CONSTANTS}

ROADS = (*SPEEDS, BUMP_ROAD)

LAG = 0.01
"""Time constant [s] of the coil in drives with coil lag."""


@dataclass(frozen=True)
class Drive:
    """A controller on a road, with the time constant of the coil [s].

    Raises ValueError for a drive that is too short to be evaluated.
    """

    strategy: str
    road: str
    coil_time_constant: float
    duration: float = 12.0
    seed: int = 1

    def __post_init__(self) -> None:
        if not self.duration > SETTLED:
            raise ValueError(
                f"the drive is {self.duration:g} s long: it must be longer than the {SETTLED:g} s "
                "after which it counts"
            )


@dataclass(frozen=True)
class DriveResult:
    """RMS values and peaks of a drive.

    ``comfort`` is the acceleration of the body [m/s²], ``holding`` the deviation of the tyre load
    from the static load, relative to it [1], and ``travel`` the suspension stroke [m]. ``power``
    [W] is the power that the damper dissipates, and ``coil`` the mean square of its current [A²].
    ``met`` is the fraction of blocks with an attainable desired force, and ``doubted`` that of
    blocks without control. ``highest`` and ``furthest`` are the peaks of the body and of the
    suspension. ``series`` are samples (4, n) 5 ms apart: time [s], acceleration, load, current.
    """

    comfort: float
    holding: float
    travel: float
    power: float
    coil: float
    met: float
    doubted: float
    highest: float
    furthest: float
    series: Array = field(repr=False)


@cache
def _surroundings(road: str, seed: int) -> Surroundings:
    return BUMP if road == BUMP_ROAD else IsoRoad(road, SPEEDS[road], seed)


def car_rig(
    surroundings: Surroundings,
    supply: SupplySetpoint,
    coil_time_constant: float,
    thermal: ThermalModel | None = None,
) -> PlantRig:
    """The car with the invented damper."""
    return PlantRig(
        EmulatedDamper(invented_damper(coil_time_constant), HOT_FORCE, built_in=True),
        CAR.plant,
        surroundings,
        supply.schedule,
        settings=RigSettings(displacement_noise=1e-6),
        thermal=thermal,
        coil_time_constant=coil_time_constant,
        substeps=2,
    )


def force_choice(
    rig: PlantRig, known: ParameterSet, controller: Controller, engine: Engine | None = None
) -> ForceChoice:
    """The nodes `suspension` and `controller` in one object, with an engine that identifies."""
    settings = ForceControlSettings(highest_current=HIGHEST_CURRENT)
    choice = ForceChoice(ForceController(settings), lambda _: controller(moment_of(rig)), engine)
    choice.controller.predictor.set_parameters(known)
    return choice


def constant(current: float) -> Choice:
    """A constant current [A]."""
    return lambda _: current


def drive(task: Drive) -> DriveResult:
    """Run the drive and evaluate it after the first seconds."""
    held = _HELD.get(task.strategy, 0.0)
    supply = SupplySetpoint(held)
    rig = car_rig(_surroundings(task.road, task.seed), supply, task.coil_time_constant)
    choose: Callable[[RigBlock], float]
    if task.strategy in CONTROLLERS:
        known = invented_damper(task.coil_time_constant)
        choose = force_choice(rig, known, CONTROLLERS[task.strategy])
    else:
        choose = constant(held)
    rows, met, doubted, count = [], 0, 0, 0
    for block in commanded(rig, supply, choose, BLOCK, task.duration):
        motion = block.motion
        rows.append(
            np.stack(
                [
                    motion.rates[:, 1],
                    CAR.tyre * motion.states[:, 2],
                    motion.states[:, 0],
                    motion.force * motion.velocity,
                    motion.coil,
                ]
            )
        )
        if isinstance(choose, ForceChoice) and choose.last is not None:
            count += 1
            met += choose.last.attainable and not choose.last.doubt
            doubted += bool(choose.last.doubt)
    every = np.concatenate(rows, axis=1)
    late = every[:, round(SETTLED * rig.settings.sample_rate) :]
    acceleration, load, travel, power, coil = late
    time = rig.settings.period * np.arange(1, every.shape[1] + 1)
    return DriveResult(
        comfort=rms(acceleration),
        holding=rms(load) / STATIC_LOAD,
        travel=rms(travel - travel.mean()),
        power=float(np.mean(power)),
        coil=float(np.mean(coil**2)),
        met=met / count if count else np.nan,
        doubted=doubted / count if count else 0.0,
        highest=float(np.max(np.abs(acceleration))),
        furthest=float(np.max(np.abs(travel))),
        series=np.stack([time, every[0], every[1], every[4]])[:, ::BLOCK],
    )
