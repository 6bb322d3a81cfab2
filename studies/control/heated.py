"""Control of a damper that heats during a drive, with the initial set and with the newest set.

The desired force is that of a viscous damper. Skyhook would not show the benefit of a better set:
on a rough road, its force is attainable for a sixth of the time, in periods shorter than the lag of
the coil. Even with the true set, the error exceeds half of that force.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mr_damper_ros.control.linear_plant import IsoRoad
from mr_damper_ros.control.semi_active import passive
from mr_damper_ros.emulation.commanded_rig import commanded
from mr_damper_ros.emulation.emulator import SupplySetpoint, ThermalModel
from mr_damper_ros.emulation.plant_rig import invented_damper
from mr_damper_ros.report.document import (
    Chapter,
    Picture,
    Table,
    Text,
    legend_above,
    panels,
)
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from studies.control.car_drives import (
    BLOCK,
    CAR,
    SPEEDS,
    STATIC_LOAD,
    car_rig,
    force_choice,
)
from studies.drawing import heads, line

THERMAL = ThermalModel(capacity=215.0)
"""Half of the usual heat capacity, which permits a short drive."""

DAMPING = 2500.0
"""Damping [N s/m] of the desired viscous damper, whose force always resists the motion."""

STRETCH = 5.0
"""Time [s] covered by each value of the series."""


@dataclass(frozen=True)
class HeatedDrive:
    """A drive; with ``learns`` the damper is identified, otherwise the set of 28 °C is kept.

    Raises ValueError for a drive that is shorter than one value of its series.
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
    """Values (n,) of consecutive periods of a drive.

    They are the end of the period [s], the temperature [°C], the acceleration of the body [m/s²]
    and the load of the tyre [1]. For the time in which the desired force was attainable, they are
    also the RMSE of the force [N], the RMS of the desired force [N], and the fraction of it that
    was achieved (1 for all). ``accepted`` is the number of accepted sets.
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
        """Error of the force between two times [s], relative to the desired force."""
        chosen = (self.time > begin) & (self.time <= end)
        missed, wanted = self.missed[chosen], self.wanted[chosen]
        return float(np.sqrt(np.mean(missed**2) / np.mean(wanted**2)))

    def share_between(self, begin: float, end: float) -> float:
        """Achieved fraction of the desired force between two times [s]."""
        chosen = (self.time > begin) & (self.time <= end)
        return float(np.average(self.share[chosen], weights=self.wanted[chosen] ** 2))


def drive_heated(task: HeatedDrive) -> HeatedResult:
    """Run the drive until the damper is hot."""
    supply = SupplySetpoint()
    road = IsoRoad(task.road, SPEEDS[task.road], task.seed)
    rig = car_rig(road, supply, task.coil_time_constant, THERMAL)
    known = invented_damper(task.coil_time_constant)
    engine = Engine(EngineSettings().for_law(known.model), known) if task.learns else None
    choose = force_choice(rig, known, passive(DAMPING), engine)
    per_stretch = round(STRETCH / rig.settings.period / BLOCK)
    rows, stretches, before = [], [], None
    for block in commanded(rig, supply, choose, BLOCK, task.duration):
        motion, measured = block.motion, block.measured
        # The command after the previous block has produced the force of this one.
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
        accepted=sum(report.accepted for report in choose.reports),
    )


FIXED, NEWEST = "set of 28 °C", "identified on line"
_NAMES = {False: FIXED, True: NEWEST}

_BEGINNING = (5.0, 20.0)
"""Reference period [s] for the end: the motion is known and the damper is still cool."""

_END = 15.0


def heated_chapter(found: Mapping[bool, HeatedResult], task: HeatedDrive) -> Chapter:
    """Loss with an old set; the keys of ``found`` say whether the damper is identified."""
    figure, axes = panels(3, 1, 6.6, 4.8, sharex=True)
    for place, learns in enumerate((False, True)):
        result, style = found[learns], line(place)
        axes[0, 0].plot(result.time, result.celsius, label=_NAMES[learns], **style)
        axes[1, 0].plot(result.time, 100.0 * result.missed / result.wanted, **style)
        axes[2, 0].plot(result.time, 100.0 * result.share, **style)
    axes[0, 0].set(ylabel="temperature (°C)")
    axes[1, 0].set(ylabel="force missed (%)", ylim=(0.0, None))
    axes[2, 0].set(ylabel="force that came (%)", xlabel="time (s)")
    legend_above(figure, axes[0, 0], 2)
    rows = [
        (
            _NAMES[learns],
            float(result.celsius[-1]),
            100.0 * result.nrmse(*_BEGINNING),
            100.0 * result.nrmse(result.time[-1] - _END, result.time[-1]),
            growth(result),
            100.0 * result.share_between(*_BEGINNING),
            100.0 * result.share_between(result.time[-1] - _END, result.time[-1]),
            float(result.comfort[result.time > 5.0].mean()),
            100.0 * float(result.holding[result.time > 5.0].mean()),
            result.accepted,
        )
        for learns, result in found.items()
    ]
    return Chapter(
        "heated",
        "While the damper heats from 28 °C",
        [
            Text(
                f"Road {task.road}, a coil that lags by 10 ms. The damper is to act like a viscous "
                f"one of {DAMPING:.0f} N s/m. It takes what it damps as heat and loses 26 % of its "
                "force on the way to 71 °C, above which it stays as it is. The identifier follows "
                "it by windows of the measured motion, force and current, and the controller takes "
                "each set that is accepted. Most of the miss is not the set's: the wheel moves on "
                "while the coil follows."
            ),
            Picture(
                "heated",
                "Temperature; where the wanted force could be had, by how much it was missed, "
                f"and how much of it came; each over {STRETCH:g} s.",
                figure,
            ),
            Table(
                "heated",
                "Where the wanted force could be had, in "
                f"{_BEGINNING[0]:g} to {_BEGINNING[1]:g} s and in the last {_END:g} s. Missed: "
                "RMSE over the RMS of the wanted force. Came: the part of the wanted force that "
                "the damper gave, by least squares.",
                heads(
                    "set | hottest (°C) | missed, first (%) | missed, last (%) | last/first | "
                    "came, first (%) | came, last (%) | comfort (m/s²) | holding (%) | sets taken"
                ),
                rows,
            ),
        ],
    )


def growth(result: HeatedResult) -> float:
    """Error of the force at the end over that at the beginning."""
    end = float(result.time[-1])
    return result.nrmse(end - _END, end) / result.nrmse(*_BEGINNING)
