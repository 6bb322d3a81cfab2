"""The buildings of the benchmark in earthquakes: what each controller makes of them.

As the benchmark's authors have it, the dampers lie between ground and first floor, four of them
side by side, and an estimator reads the absolute accelerations of the floors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from mr_damper_ros.control.fallback import FallbackSettings
from mr_damper_ros.control.force_controller import ForceController, ForceControlSettings
from mr_damper_ros.control.linear_quadratic import StateEstimator, regulator_gain
from mr_damper_ros.control.shear_building import BUILDINGS, STOREYS, ShearBuilding
from mr_damper_ros.emulation.commanded_rig import Choice, ForceChoice, commanded
from mr_damper_ros.emulation.emulator import RigSettings, SupplyKnob
from mr_damper_ros.emulation.plant_rig import BuiltInDamper, PlantRig
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.rig_block import RigBlock
from mr_damper_ros.study.ground_motion import (
    NEAR_FAULT,
    REHEARSAL,
    SUBDUCTION,
    GroundMotion,
    el_centro,
)
from mr_damper_ros.study.recorded_damper import recorded_damper
from mr_damper_ros.tracking.predictor import PredictorSettings

DAMPERS = 4
"""Side by side: the authors' model multiplies the force of the damper by four."""

SCALE = 0.5
"""Of the full ground motion: what the authors simulate."""

HIGHEST_CURRENT = 1.0
"""[A] of passive-on and of every controller: the highest of the recordings."""

UNCONTROLLED = "uncontrolled"
OFF, ON = "passive-off", "passive-on"
BANG_BANG = "clipped-optimal, bang-bang"
INVERSE = "clipped-optimal, inverse"
WEIGHTED = "weighted inverse"
STRATEGIES = (OFF, ON, BANG_BANG, INVERSE, WEIGHTED)

EARTHQUAKES: dict[str, Callable[[], GroundMotion]] = {
    "El Centro 1940": el_centro,
    "near fault (invented)": NEAR_FAULT.motion,
    "subduction (invented)": SUBDUCTION.motion,
    "rehearsal (invented)": REHEARSAL.motion,
}
JUDGED = tuple(EARTHQUAKES)[:3]
"""The last one is what weights are tried on."""

_AUTHORS_WEIGHT, _AUTHORS_EFFORT = 1e13, 1.0
"""Of the roof's displacement and of the force."""

_DISTURBANCE, _NOISE = 0.1, 5e-4
"""Of the authors' Kalman filter."""

_BLOCK = 5
_DEADBAND = 60.0
"""[N] of a damper: the current stays for less."""

REVERSAL = 0.05
"""A current that goes back by less [A] has not turned."""


@dataclass(frozen=True)
class OutputWeights:
    """Weights of the squares of roof displacement, roof acceleration and force."""

    displacement: float
    acceleration: float
    force: float


CHOSEN = OutputWeights(displacement=1e13, acceleration=1e5, force=0.01)
"""Of :data:`WEIGHTED`: the best of five tried on the rehearsal in building I."""


@dataclass(frozen=True)
class BuildingRun:
    """A controller in a building and an earthquake, with coils that lag by so many seconds.

    No more than the ``longest`` seconds of the earthquake are simulated.
    """

    strategy: str
    building: str
    earthquake: str
    coil_time_constant: float
    weights: OutputWeights = CHOSEN
    longest: float = math.inf


@dataclass(frozen=True)
class BuildingResult:
    """RMS and peak of the roof's displacement [m] and absolute acceleration [m/s²].

    ``reversals`` are those of the commanded current a second, ``force`` [N] the RMS of all dampers.
    ``series`` (4, n), 10 ms apart: time [s], displacement, acceleration, current of the coil.
    """

    displacement: float
    acceleration: float
    farthest: float
    highest: float
    reversals: float
    force: float
    doubted: float
    series: Array = field(repr=False)


def simulate(task: BuildingRun) -> BuildingResult:
    """Shake the building."""
    building, ground = BUILDINGS[task.building], _ground(task.earthquake)
    start = HIGHEST_CURRENT if task.strategy == ON else 0.0
    knob = SupplyKnob(start)
    rig = PlantRig(
        BuiltInDamper(recorded_damper(task.coil_time_constant)),
        building.plant,
        ground,
        knob.schedule,
        settings=RigSettings(displacement_noise=1e-6),
        coil_time_constant=task.coil_time_constant,
        dampers=0 if task.strategy == UNCONTROLLED else DAMPERS,
    )
    choose, block = _choice(task, rig, building)
    rows, doubted, blocks = [], 0, 0
    commands = []
    duration = min(ground.duration, task.longest)
    for done in commanded(rig, knob, choose, block, duration):
        motion = done.motion
        total = (0 if task.strategy == UNCONTROLLED else DAMPERS) * motion.force
        roof = _absolute(building, motion.states, total)[:, -1]
        rows.append(np.stack([motion.states[:, STOREYS - 1], roof, total, motion.coil]))
        commands.append(done.current)
        blocks += 1
        if isinstance(choose, ForceChoice) and choose.last is not None:
            doubted += bool(choose.last.doubt)
    every = np.concatenate(rows, axis=1)
    displacement, acceleration, force, _ = every
    time = rig.settings.period * np.arange(1, every.shape[1] + 1)
    return BuildingResult(
        displacement=_rms(displacement),
        acceleration=_rms(acceleration),
        farthest=float(np.max(np.abs(displacement))),
        highest=float(np.max(np.abs(acceleration))),
        reversals=reversals(np.array(commands)) / duration,
        force=_rms(force),
        doubted=doubted / blocks,
        series=np.stack([time, displacement, acceleration, every[3]])[:, ::10],
    )


def reversals(current: Array, least: float = REVERSAL) -> int:
    """How often a current (n,) [A] turns, where it goes back by more than ``least``."""
    turns, sense = 0, 0
    low = high = float(current[0])
    for value in current.tolist():
        low, high = min(low, value), max(high, value)
        if sense >= 0 and value < high - least:
            turns, sense, low = turns + (sense > 0), -1, value
            high = value
        elif sense <= 0 and value > low + least:
            turns, sense, high = turns + (sense < 0), 1, value
            low = value
    return turns


@cache
def _ground(name: str) -> GroundMotion:
    return EARTHQUAKES[name]().scaled(SCALE)


def _absolute(building: ShearBuilding, states: Array, force: Array) -> Array:
    """Absolute accelerations (n, floors) [m/s²]: what accelerometers read."""
    return states @ building.dynamics[STOREYS:].T + np.outer(force, building.by_force[STOREYS:])


def _choice(task: BuildingRun, rig: PlantRig, building: ShearBuilding) -> tuple[Choice, int]:
    """How the current is chosen, and after how many samples."""
    if task.strategy in (UNCONTROLLED, OFF):
        return lambda _: 0.0, _BLOCK
    if task.strategy == ON:
        return lambda _: HIGHEST_CURRENT, _BLOCK
    weights = (
        task.weights
        if task.strategy == WEIGHTED
        else OutputWeights(_AUTHORS_WEIGHT, 0.0, _AUTHORS_EFFORT)
    )
    observed = _Observed(rig, building, weights)
    if task.strategy == BANG_BANG:

        def switch(measured: RigBlock) -> float:
            wanted = observed(measured)
            force = DAMPERS * float(measured.force[-1])
            return HIGHEST_CURRENT if (wanted - force) * force > 0.0 else 0.0

        return switch, 1
    settings = ForceControlSettings(
        highest_current=HIGHEST_CURRENT,
        # Stiff where the motion is not known, as passive-on is.
        fallback=FallbackSettings(safe_current=HIGHEST_CURRENT),
        force_deadband=_DEADBAND,
        # The emulated damper is the set itself, at any speed.
        predictor=PredictorSettings(velocity_margin=100.0),
    )
    controller = ForceController(settings)
    controller.set_parameters(recorded_damper(task.coil_time_constant))
    return ForceChoice(controller, lambda measured: observed(measured) / DAMPERS), _BLOCK


class _Observed:
    """The wanted force [N] of all dampers, from accelerations and measured force."""

    def __init__(self, rig: PlantRig, building: ShearBuilding, weights: OutputWeights) -> None:
        plant = building.plant
        outputs, direct = building.dynamics[STOREYS:], building.by_force[STOREYS:]
        roof = np.eye(2 * STOREYS)[STOREYS - 1]
        self._gain = regulator_gain(
            plant,
            np.stack([roof, outputs[-1]]),
            np.array([0.0, direct[-1]]),
            np.array([weights.displacement, weights.acceleration]),
            weights.force,
        )
        self._estimator = StateEstimator(
            plant,
            outputs,
            direct,
            disturbance=_DISTURBANCE,
            noise=_NOISE,
            period=rig.settings.period,
        )
        self._rig, self._building = rig, building

    def __call__(self, measured: RigBlock) -> float:
        """The wanted force [N] after a block."""
        assert self._rig.motion is not None
        motion = self._rig.motion
        read = _absolute(self._building, motion.states, DAMPERS * motion.force)
        for force, outputs in zip(measured.force.tolist(), read, strict=True):
            states = self._estimator.follow(DAMPERS * force, outputs)
        return -float(self._gain @ states)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
