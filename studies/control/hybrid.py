"""An emulated hybrid simulation with a simulated building and a damper in a test machine.

At every step, the simulation sends the position of the first floor to the machine. The machine
moves the damper, and the measured force acts on the simulated building. The lag of the machine adds
energy to the building. The command therefore passes through the inverse of a model of the machine,
as in the benchmark. The authors' compensator adapts; this one is fixed and has an error of a tenth.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from mr_damper_ros.control.linear_plant import DamperMotion, LinearPlant, MovingPlant
from mr_damper_ros.emulation.emulator import EmulatedDamper
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import PeakVelocity
from mr_damper_ros.report.document import DASHES, GREY, Chapter, Table, chart, legend_above
from mr_damper_ros.signals.arrays import Array
from studies.control.buildings import BUILDINGS, DAMPERS, SCALE, el_centro, recorded_damper
from studies.drawing import chapter, draw_rows, line, name_rows
from studies.program import Campaign

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


REFERENCE, LATE, COMPENSATED = "reference", "machine, uncompensated", "machine, compensated"
"""The damper in the building, or moved by the machine, without and with the compensator."""


def hybrid(name: str, duration: float) -> dict[str, Array]:
    """Task: run the simulation, passive-on in building I; it ends early if it becomes unstable.

    Returns time [s], motion of the first ``floor``, of the ``damper`` and of the ``roof`` [m], and
    ``force`` of all dampers [N], each (n,).
    """
    plant = MovingPlant(BUILDINGS["I"].plant, STEP)
    ground = el_centro().scaled(SCALE)
    machine, damper = _late_machine(), EmulatedDamper(recorded_damper(0.0), built_in=True)
    peak, smooth = PeakVelocity(STEP), 0.0
    share = -math.expm1(-STEP / _ACCELERATION_MEMORY)
    time = STEP * np.arange(round(duration / STEP), dtype=np.float64)
    coil = np.ones(1)
    rows = []
    for shaken in ground.at(time).tolist():
        floor = plant.damper
        moved = floor
        if name != REFERENCE:
            machine.step(0.0, _compensated(floor) if name == COMPENSATED else floor.displacement)
            moved = machine.damper
        smooth += share * (moved.acceleration - smooth)
        place, velocity, acceleration = np.array([[moved.displacement], [moved.velocity], [smooth]])
        speed = peak.follow(velocity, acceleration)
        motion = Motion(place, velocity, acceleration, speed, sine=None)
        force = DAMPERS * float(damper.force(motion, coil, 28.0, STEP)[0])
        rows.append((floor.displacement, moved.displacement, force, float(plant.state[2])))
        if abs(floor.displacement) > 1.0:
            break
        plant.step(force, shaken)
    named = zip(("floor", "damper", "force", "roof"), np.array(rows).T, strict=True)
    return {"time": time[: len(rows)], **dict(named)}


def _late_machine() -> MovingPlant:
    """A test machine whose input is the commanded position."""
    rate, across, along = 2.0 * math.pi * BANDWIDTH, np.array([1.0, 0.0]), np.array([0.0, 1.0])
    dynamics = np.array([[0.0, 1.0], [-(rate**2), -2.0 * DAMPING * rate]])
    return MovingPlant(LinearPlant(dynamics, 0.0 * along, rate**2 * along, across, along), STEP)


def _compensated(wanted: DamperMotion) -> float:
    """Command [m] with which the modelled machine would follow the motion."""
    modelled = 2.0 * math.pi * BANDWIDTH * (1.0 + MODEL_ERROR)
    ahead = 2.0 * DAMPING / modelled * wanted.velocity + wanted.acceleration / modelled**2
    return wanted.displacement + ahead


def missed(values: Array, reference: Array) -> float:
    """RMS of the difference over that of the reference; a missing end counts as an error."""
    whole = np.zeros(reference.size)
    whole[: values.size] = values[: reference.size]
    return float(np.sqrt(np.mean((whole - reference) ** 2) / np.mean(reference**2)))


def hybrid_part(campaign: Campaign) -> Iterator[Chapter]:
    """Results with a lagging machine, with and without compensation of the command."""
    names = (REFERENCE, LATE, COMPENSATED)
    duration = 6.0 if campaign.quick else 12.0
    found = campaign.each("hybrid simulations", hybrid, names, duration=duration)
    picture, axes = chart("hybrid", "Roof and force of the dampers.", (2, 1, 6.6, 3.8), sharex=True)
    for place, (name, result) in enumerate(found.items()):
        chosen = (result["time"] > 1.0) & (result["time"] < 6.0)
        rows = (1e3 * result["roof"][chosen], 1e-3 * result["force"][chosen])
        style = line(place - 1) if place else {"color": GREY}
        style["linestyle"] = DASHES[place]
        draw_rows(axes, result["time"][chosen], rows, name, **style)
    name_rows(axes, "roof (mm)", "force (kN)")
    legend_above(axes[0, 0], 3)
    reference = found[REFERENCE]
    off = {
        name: [
            missed(found[name]["damper"], reference["floor"]),
            missed(found[name]["force"], reference["force"]),
            missed(found[name]["damper"], found[name]["floor"]),
            missed(found[name]["roof"], reference["roof"]),
        ]
        for name in names[1:]
    }
    late, ahead = off[LATE][-1], off[COMPENSATED][-1]
    yield chapter(
        "hybrid",
        "A hybrid simulation, emulated",
        f"with the damper in a lagging machine, the error of the roof is {late:.0%}; with a "
        f"compensated command, it is {ahead:.0%}.",
        "As in a real-time hybrid simulation, the building is simulated and a machine moves the "
        f"damper; here machine and damper are emulated. A step is 1/{1.0 / STEP:.0f} s, as in the "
        "benchmark. The measured force is held for a step, for which the building is solved "
        f"exactly. The machine follows its command as a second-order system of {BANDWIDTH:.0f} Hz "
        f"with a damping ratio of {DAMPING:g}, which lags by {1e3 * DELAY:.1f} ms. The compensated "
        f"command is x + 2ζ/ω v + a/ω² of the simulated floor, with an ω that is {MODEL_ERROR:.0%} "
        f"too high. The case is building I in El Centro at {SCALE:.0%} with passive-on; in the "
        "reference, the damper is in the building.",
        picture,
        Table(
            "hybrid",
            "RMS difference in percent of the RMS: motion of the damper and force, relative to the "
            "reference (J1 and J2 of the benchmark); motion of the damper, relative to the floor "
            "that it should follow (J3); motion of the roof, relative to the reference.",
            "| motion | force | following | roof",
            [(name, *(100.0 * each for each in errors)) for name, errors in off.items()],
        ),
    )
    campaign.figures["hybrid"] = {"late": late, "compensated": ahead}
