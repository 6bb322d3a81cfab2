"""A damper that heats while it is driven: with the set of the start, and with the newest one.

It is to act like a viscous damper. Skyhook would not show what a set is worth: on a rough road its
force can be had for a sixth of the time, in pieces shorter than the coil's lag, and is missed by
more than half of it with the true set too.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mr_damper_ros.control.quarter_car import IsoRoad
from mr_damper_ros.control.semi_active import passive
from mr_damper_ros.emulation.commanded_rig import commanded
from mr_damper_ros.emulation.emulator import SupplyKnob, ThermalModel
from mr_damper_ros.emulation.plant_rig import invented_damper
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.rig_block import RigBlock
from mr_damper_ros.study.car_drives import (
    BLOCK,
    CAR,
    SPEEDS,
    STATIC_LOAD,
    car_rig,
    force_choice,
)
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.window_assembler import WindowAssembler, WindowSettings

THERMAL = ThermalModel(capacity=215.0)
"""Half of the usual heat capacity, so that the drive may be short."""

DAMPING = 2500.0
"""[N s/m] of the viscous damper that is wanted: a force that always resists the motion."""

STRETCH = 5.0
"""Seconds that a value of the series is of."""


@dataclass(frozen=True)
class HeatedDrive:
    """``learns``: the damper is identified meanwhile; else the set of 28 °C is kept.

    Raises ValueError for a drive that is shorter than a value of its series.
    """

    learns: bool
    road: str = "C"
    coil_time_constant: float = 0.01
    duration: float = 90.0
    seed: int = 1

    def __post_init__(self) -> None:
        if self.duration < STRETCH:
            raise ValueError(
                f"the drive is {self.duration:g} s long: at least {STRETCH:g} s are needed"
            )


@dataclass(frozen=True)
class HeatedResult:
    """Values of every few seconds of a drive, (n,).

    End of the stretch [s], temperature [°C]; where the wanted force could be had, RMSE [N] of the
    force, RMS of the wanted one, and how much of it came: 1 for all; acceleration of the body
    [m/s²], load of the tyre [1]. ``accepted`` is how many sets were taken.
    """

    time: Array = field(repr=False)
    celsius: Array = field(repr=False)
    missed: Array = field(repr=False)
    wanted: Array = field(repr=False)
    share: Array = field(repr=False)
    comfort: Array = field(repr=False)
    holding: Array = field(repr=False)
    accepted: int

    def nrmse(self, begin: float, end: float) -> float:
        """Miss of the wanted force between two times [s], as a part of it."""
        chosen = (self.time > begin) & (self.time <= end)
        missed, wanted = self.missed[chosen], self.wanted[chosen]
        return float(np.sqrt(np.mean(missed**2) / np.mean(wanted**2)))

    def share_between(self, begin: float, end: float) -> float:
        """How much of the wanted force came between two times [s]."""
        chosen = (self.time > begin) & (self.time <= end)
        return float(np.average(self.share[chosen], weights=self.wanted[chosen] ** 2))


class _Learner:
    """Identifies the damper from what is measured, as the identifier does."""

    def __init__(self, known: float) -> None:
        start = invented_damper(known)
        windows = WindowSettings()
        self._assembler = WindowAssembler(
            windows.window, windows.hop, windows.looks, windows.longest_window
        )
        self.tracker = WindowTracker(TrackerSettings(model=start.model), start)
        self.accepted = 0

    def hear(self, measured: RigBlock) -> bool:
        """Whether a block has brought a new set."""
        ready = self._assembler.add_current(measured.start_ns, float(measured.current[0]))
        ready += self._assembler.add_block(
            SampleBlock(
                measured.start_ns,
                measured.sequence,
                measured.period,
                measured.displacement,
                measured.force,
            )
        )
        before = self.accepted
        for window in ready:
            try:
                report = self.tracker.follow(window)
            except np.linalg.LinAlgError:
                # In the identifier a fit that fails in its worker leaves the set as it is, too.
                continue
            self.accepted += report is not None and report.accepted
        return self.accepted > before


def drive_heated(task: HeatedDrive) -> HeatedResult:
    """Drive until the damper is hot."""
    knob = SupplyKnob()
    road = IsoRoad(task.road, SPEEDS[task.road], task.seed)
    rig = car_rig(road, knob, task.coil_time_constant, THERMAL)
    choose = force_choice(rig, invented_damper(task.coil_time_constant), passive(DAMPING))
    learner = _Learner(task.coil_time_constant) if task.learns else None
    per_stretch = round(STRETCH / rig.settings.period / BLOCK)
    rows, stretches, before = [], [], None
    for block in commanded(rig, knob, choose, BLOCK, task.duration):
        motion, measured = block.motion, block.measured
        if learner is not None and learner.hear(measured):
            choose.controller.set_parameters(learner.tracker.parameters)
        # What was commanded after the block before has made the force of this one.
        wanted = np.nan
        if before is not None and before.attainable and not before.doubt:
            wanted = before.wanted
        rows.append(
            (
                float(measured.temperature[-1]),
                float(np.mean((motion.force - wanted) ** 2)),
                wanted**2,
                wanted * float(np.mean(motion.force)),
                float(np.mean(motion.rates[:, 1] ** 2)),
                float(np.mean((CAR.tyre * motion.states[:, 2]) ** 2)),
            )
        )
        before = choose.last
        if len(rows) == per_stretch:
            every = np.array(rows)
            stretches.append((every[-1, 0], *np.nanmean(every[:, 1:], axis=0)))
            rows = []
    celsius, missed, wanted, met, comfort, load = np.array(stretches).T
    return HeatedResult(
        time=STRETCH * np.arange(1, celsius.size + 1),
        celsius=celsius,
        missed=np.sqrt(missed),
        wanted=np.sqrt(wanted),
        share=met / wanted,
        comfort=np.sqrt(comfort),
        holding=np.sqrt(load) / STATIC_LOAD,
        accepted=learner.accepted if learner else 0,
    )
