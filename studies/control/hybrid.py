"""An emulated hybrid simulation with a simulated building and a damper in a test machine.

At every step, the simulation sends the position of the first floor to the machine. The machine
moves the damper, and the measured force acts on the simulated building. The lag of the machine adds
energy to the building. The command therefore passes through the inverse of a model of the machine,
as in the benchmark. The authors' compensator adapts; this one is fixed and has an error of a tenth.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.control.linear_plant import DamperMotion, MovingPlant
from mr_damper_ros.emulation.emulator import EmulatedDamper
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import PeakVelocity
from mr_damper_ros.report.document import (
    DASHES,
    GREY,
    INK,
    Chapter,
    Picture,
    Table,
    Text,
    legend_above,
    panels,
)
from mr_damper_ros.signals.arrays import Array
from studies.control.buildings import DAMPERS, SCALE
from studies.control.ground_motion import el_centro
from studies.control.recorded_damper import recorded_damper
from studies.control.shear_building import BUILDINGS

STEP = 1.0 / 4096.0
"""Integration step [s] of the benchmark. The building is solved exactly for a force that is
constant during a step."""

BANDWIDTH, DAMPING = 30.0, 0.9
"""Natural frequency [Hz] and damping ratio of the second-order machine, which lags by 9.5 ms."""

MODEL_ERROR = 0.1
"""Fraction by which the compensator overestimates the speed of the machine."""

DELAY = 2.0 * DAMPING / (2.0 * math.pi * BANDWIDTH)
"""Lag of a slow motion [s]."""

_ACCELERATION_MEMORY = 0.008


@dataclass(frozen=True)
class HybridRun:
    """A run; without ``machine``, the damper is in the building, which is the reference."""

    machine: bool
    compensated: bool = False
    current: float = 1.0
    building: str = "I"
    duration: float = 12.0


@dataclass(frozen=True, eq=False)
class HybridResult:
    """Time [s], first floor and damper [m], force [N] of all dampers, roof [m], each (n,)."""

    time: Array
    floor: Array
    damper: Array
    force: Array
    roof: Array


def hybrid(task: HybridRun) -> HybridResult:
    """Run the simulation; it ends early if it becomes unstable."""
    plant = MovingPlant(BUILDINGS[task.building].plant, STEP)
    ground = el_centro().scaled(SCALE)
    machine, damper = _LateMachine(), EmulatedDamper(recorded_damper(0.0), built_in=True)
    peak, smooth = PeakVelocity(STEP), 0.0
    share = -math.expm1(-STEP / _ACCELERATION_MEMORY)
    count = round(task.duration / STEP)
    shaken = ground.at(STEP * np.arange(count, dtype=np.float64)).tolist()
    coil = np.array([task.current])
    rows = []
    for place in range(count):
        floor = plant.damper
        moved = machine.follow(floor, compensated=task.compensated) if task.machine else floor
        smooth += share * (moved.acceleration - smooth)
        velocity, acceleration = np.array([moved.velocity]), np.array([smooth])
        motion = Motion(
            np.array([moved.displacement]),
            velocity,
            acceleration,
            peak.follow(velocity, acceleration),
            sine=None,
        )
        force = DAMPERS * float(damper.force(motion, coil, 28.0, STEP)[0])
        rows.append((floor.displacement, moved.displacement, force, float(plant.state[2])))
        if abs(floor.displacement) > 1.0:
            break
        plant.step(force, shaken[place])
    every = np.array(rows).T
    return HybridResult(STEP * np.arange(every.shape[1], dtype=np.float64), *every)


class _LateMachine:
    """A test machine that follows its command with a lag."""

    def __init__(self) -> None:
        from scipy.linalg import expm  # here: see mr_damper_ros.entry_points

        self._rate = 2.0 * math.pi * BANDWIDTH
        whole = np.zeros((3, 3))
        whole[0, 1] = 1.0
        whole[1] = (-(self._rate**2), -2.0 * DAMPING * self._rate, self._rate**2)
        self._step = expm(STEP * whole)[:2]
        self._state = np.zeros(2)

    def follow(self, wanted: DamperMotion, *, compensated: bool) -> DamperMotion:
        """Motion of the machine one step later."""
        command = wanted.displacement
        if compensated:
            modelled = self._rate * (1.0 + MODEL_ERROR)
            command += 2.0 * DAMPING / modelled * wanted.velocity
            command += wanted.acceleration / modelled**2
        self._state = self._step @ np.append(self._state, command)
        place, velocity = self._state.tolist()
        pulled = self._rate**2 * (command - place) - 2.0 * DAMPING * self._rate * velocity
        return DamperMotion(place, velocity, pulled)


def missed(values: Array, reference: Array) -> float:
    """RMS of the difference over that of the reference; a missing end counts as an error."""
    whole = np.zeros(reference.size)
    whole[: values.size] = values[: reference.size]
    return float(np.sqrt(np.mean((whole - reference) ** 2) / np.mean(reference**2)))


REFERENCE = HybridRun(machine=False)
LATE = HybridRun(machine=True)
COMPENSATED = HybridRun(machine=True, compensated=True)
_NAMES = {REFERENCE: "reference", LATE: "machine, as it is", COMPENSATED: "machine, compensated"}

TASKS = tuple(_NAMES)


def hybrid_chapter(found: Mapping[HybridRun, HybridResult]) -> Chapter:
    """Results with a lagging machine, with and without compensation of the command."""
    reference = found[REFERENCE]
    figure, axes = panels(2, 1, 6.6, 3.8, sharex=True)
    for place, (task, name) in enumerate(_NAMES.items()):
        result = found[task]
        chosen = (result.time > 1.0) & (result.time < 6.0)
        style = {
            "color": GREY if task == REFERENCE else INK[place - 1],
            "linestyle": "-" if task == REFERENCE else DASHES[place],
        }
        axes[0, 0].plot(result.time[chosen], 1e3 * result.roof[chosen], label=name, **style)
        axes[1, 0].plot(result.time[chosen], 1e-3 * result.force[chosen], **style)
    axes[0, 0].set(ylabel="roof (mm)")
    axes[1, 0].set(ylabel="force (kN)", xlabel="time (s)")
    legend_above(figure, axes[0, 0], 3)
    rows = [
        (
            _NAMES[task],
            100.0 * missed(found[task].damper, reference.floor),
            100.0 * missed(found[task].force, reference.force),
            100.0 * missed(found[task].damper, found[task].floor),
            100.0 * missed(found[task].roof, reference.roof),
        )
        for task in (LATE, COMPENSATED)
    ]
    return Chapter(
        "hybrid",
        "A hybrid simulation, emulated",
        [
            Text(
                "The building is reckoned and the damper is moved by a machine, as in a real-time "
                "hybrid simulation; here the machine and the damper are emulated too. One step "
                f"is 1/{1.0 / STEP:.0f} s, as the authors have it: the building is solved exactly "
                "for the measured force, which holds for a step. The machine follows its command "
                f"like a second order of {BANDWIDTH:.0f} Hz and a damping ratio of {DAMPING:g}, "
                f"{1e3 * DELAY:.1f} ms late. Compensated, the command is x + 2ζ/ω v + a/ω² of the "
                f"reckoned floor, with an ω that is {MODEL_ERROR:.0%} too high. Building I, El "
                f"Centro at {SCALE:.0%}, passive-on; the reference has the damper in the building."
            ),
            Picture("hybrid", "Roof and force of the dampers.", figure),
            Table(
                "hybrid",
                "RMS of the difference in percent of the RMS: motion of the damper and force "
                "against the reference (J1, J2 of the authors measure the same), motion of the "
                "damper against the floor that it should follow (J3), roof against the reference.",
                ("", "motion", "force", "following", "roof"),
                rows,
            ),
        ],
    )
