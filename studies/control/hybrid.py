"""A hybrid simulation, all of it emulated: the building is reckoned, the damper is in a machine.

Every step the reckoned building tells the machine where the first floor is, the machine moves the
damper, and the force that is measured there moves the building. The machine is late, which feeds
the building with energy; the command therefore runs ahead by the inverse of a model of the machine,
as the authors of the benchmark have it (theirs adapts; this one is fixed, and wrong by a tenth).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.control.linear_plant import DamperMotion, MovingPlant
from mr_damper_ros.emulation.plant_rig import BuiltInDamper
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
"""Seconds of an integration step, as the authors have it; the building is solved exactly for a
force that holds for a step."""

BANDWIDTH, DAMPING = 30.0, 0.9
"""The machine: a second order of this frequency [Hz] and damping ratio; it is 9.5 ms late."""

MODEL_ERROR = 0.1
"""The compensator takes the machine for so much quicker than it is."""

DELAY = 2.0 * DAMPING / (2.0 * math.pi * BANDWIDTH)
"""Seconds by which a slow motion is late."""

_ACCELERATION_MEMORY = 0.008


@dataclass(frozen=True)
class HybridRun:
    """``machine``: it moves the damper; else that is in the building: the reference."""

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
    """Run it; it ends early where it becomes unstable."""
    plant = MovingPlant(BUILDINGS[task.building].plant, STEP)
    ground = el_centro().scaled(SCALE)
    machine, damper = _LateMachine(), BuiltInDamper(recorded_damper(0.0))
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
        force = DAMPERS * damper.force(motion, coil, 28.0, STEP)
        rows.append((floor.displacement, moved.displacement, force, float(plant.state[2])))
        if abs(floor.displacement) > 1.0:
            break
        plant.step(force, shaken[place])
    every = np.array(rows).T
    return HybridResult(STEP * np.arange(every.shape[1], dtype=np.float64), *every)


class _LateMachine:
    """A test machine that follows a command late."""

    def __init__(self) -> None:
        from scipy.linalg import expm  # here: see mr_damper_ros.entry_points

        self._rate = 2.0 * math.pi * BANDWIDTH
        whole = np.zeros((3, 3))
        whole[0, 1] = 1.0
        whole[1] = (-(self._rate**2), -2.0 * DAMPING * self._rate, self._rate**2)
        self._step = expm(STEP * whole)[:2]
        self._state = np.zeros(2)

    def follow(self, wanted: DamperMotion, *, compensated: bool) -> DamperMotion:
        """How it moves a step later."""
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
    """RMS of the difference over the RMS of the reference; what is missing at the end counts."""
    whole = np.zeros(reference.size)
    whole[: values.size] = values[: reference.size]
    return float(np.sqrt(np.mean((whole - reference) ** 2) / np.mean(reference**2)))


REFERENCE = HybridRun(machine=False)
LATE = HybridRun(machine=True)
COMPENSATED = HybridRun(machine=True, compensated=True)
_NAMES = {REFERENCE: "reference", LATE: "machine, as it is", COMPENSATED: "machine, compensated"}

TASKS = tuple(_NAMES)


def hybrid_chapter(found: Mapping[HybridRun, HybridResult]) -> Chapter:
    """With a machine that is late, and with a command that runs ahead."""
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
