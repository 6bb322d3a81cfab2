"""An emulated damper in a plant; the force of the damper and the motion of the plant interact.

Like :class:`mr_damper_ros.emulation.emulator.EmulatedRig`, the rig uses no wall clock, and its
samples do not depend on the block size.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from mr_damper_ros.control.linear_plant import LinearPlant, MovingPlant
from mr_damper_ros.emulation import emulator
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import PeakVelocity
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import RigBlock

_ACCELERATION_MEMORY = 0.008
"""Time constant [s] of the low-pass filter of the acceleration for the peak velocity.

The force depends on the peak velocity, and the acceleration depends on the force. The filter breaks
    this algebraic loop. Observers of recorded motion also smooth the acceleration.
"""


class Surroundings(Protocol):
    """The external input of a plant as a function of time, such as a road or the ground."""

    def at(self, time: Array) -> Array:
        """The input (n,) at the times (n,) [s]; for a road, its vertical velocity [m/s]."""


class PlantRig(emulator.MeasuredRig):
    """A damper in a plant.

    Each sample period has ``substeps`` steps. The force of the damper is computed at every step and
    held during it; for this held force, the solution of the plant is exact. ``dampers`` equal
    dampers act in parallel, and one of them is measured. The current in the coil follows the supply
    with a lag of ``coil_time_constant`` [s].
    """

    def __init__(
        self,
        damper: emulator.Damper,
        plant: LinearPlant,
        surroundings: Surroundings,
        current: emulator.CurrentSchedule | float,
        *,
        settings: emulator.RigSettings | None = None,
        thermal: emulator.ThermalModel | None = None,
        coil_time_constant: float = 0.0,
        dampers: int = 1,
        substeps: int = 4,
    ) -> None:
        super().__init__(damper, current, settings, thermal)
        self._surroundings = surroundings
        self._dampers, self._substeps = dampers, substeps
        self._step = self.settings.period / substeps
        self.plant = MovingPlant(plant, self._step)
        """The plant in its present state."""
        self._peak = PeakVelocity(self._step)
        decay = math.exp(-self._step / coil_time_constant) if coil_time_constant > 0.0 else 0.0
        self._coil_decay, self._coil = decay, float(self._current.at(np.zeros(1))[0])
        self._force = self._acceleration = 0.0
        self._share = -math.expm1(-self._step / _ACCELERATION_MEMORY)
        self._inputs: list[list[float]] = []
        self._moved: list[tuple[Array, Array, float, float, float]] = []

    def next_block(self, count: int) -> RigBlock:
        """The next ``count`` samples."""
        self._moved = []
        block = super().next_block(count)
        self.motion = emulator.PlantMotion(*map(np.array, zip(*self._moved, strict=True)))
        return block

    def _true(self, time: Array, current: Array) -> tuple[Array, Array, Array]:
        begin = self._made % emulator.CHUNK
        if begin == 0:
            steps = np.arange(emulator.CHUNK * self._substeps, dtype=np.float64)
            inputs = self._surroundings.at((steps + self._made * self._substeps) * self._step)
            self._inputs = inputs.reshape(emulator.CHUNK, self._substeps).tolist()
        rows = np.empty((3, time.size))
        for place, supplied in enumerate(current.tolist()):
            heat = sum([self._step_on(supplied, moved) for moved in self._inputs[begin + place]])
            now = self.plant.damper
            rows[:, place] = now.displacement, self._force, heat / self.settings.period
            self._moved.append(
                (self.plant.state, self.plant.rates, self._force, now.velocity, self._coil)
            )
        displacement, force, power = rows
        return displacement, force, power

    def _step_on(self, supplied: float, moved: float) -> float:
        """Advance by one step with a supply current [A] and an input; returns the heat [J]."""
        now = self.plant.damper
        self._coil = supplied + (self._coil - supplied) * self._coil_decay
        self._acceleration += self._share * (now.acceleration - self._acceleration)
        velocity, acceleration = np.array([now.velocity]), np.array([self._acceleration])
        peak = self._peak.follow(velocity, acceleration)
        motion = Motion(np.array([now.displacement]), velocity, acceleration, peak, sine=None)
        coil = np.array([self._coil])
        self._force = float(self._damper.force(motion, coil, self._celsius, self._step)[0])
        self.plant.step(self._dampers * self._force, moved)
        return self._force * now.velocity * self._step


HOT_FORCE = 989.0 / 1332.0
"""Force of the damper in the thesis at 71 °C, relative to its force at 28 °C.

Tables 8 and 9, at 5 mm, 1 Hz and 1.5 A.
"""

HIGHEST_CURRENT = 1.6

_VALUES = (
    *(40.0, -0.35, -0.25, 900.0, 2.5, 4.0, 3.0, 2.0),
    *(9.0, 4.0, 6.0, 18.0, -0.45, -0.11, 0.06, 0.012),
    *(3e-08, 2000.0, -40.0),
)
"""Values of the law ``sigmoid_lag``, without the time constant of the coil."""


def invented_damper(coil_time_constant: float) -> ParameterSet:
    """Parameter set of an invented damper at 28 °C, with the given coil time constant [s]."""
    return ParameterSet(
        np.array([*_VALUES, coil_time_constant]),
        set_id="invented",
        peak_velocity_range=(0.0, 2.0),
        current_range=(0.0, HIGHEST_CURRENT),
        model="sigmoid_lag",
    )
