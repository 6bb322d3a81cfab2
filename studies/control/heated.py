"""Control of a damper that heats during a drive, with the initial set and with the newest set.

The desired force is that of a viscous damper. Skyhook would not show the benefit of a better set:
on a rough road, its force is attainable for a sixth of the time, in periods shorter than the lag of
the coil. Even with the true set, the error exceeds half of that force.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mr_damper_ros.control.semi_active import passive
from mr_damper_ros.emulation.commanded_rig import commanded
from mr_damper_ros.emulation.emulator import SupplySetpoint, ThermalModel
from mr_damper_ros.emulation.plant_rig import invented_damper
from mr_damper_ros.report.document import Chapter, legend_above
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from studies.control.car import BLOCK, CAR, LAG, STATIC_LOAD, car_rig, force_choice
from studies.drawing import chapter, chart, draw_rows, line, name_rows, table
from studies.program import Campaign

_THERMAL = ThermalModel(capacity=215.0)
"""Half of the usual heat capacity, which permits a short drive."""

_DAMPING = 2500.0
"""Damping [N s/m] of the desired viscous damper, whose force always resists the motion."""

_STRETCH = 5.0
"""Time [s] covered by each value of the series."""

_ROAD = "C"

_NAMES = {False: "set of 28 °C", True: "identified on line"}

_BEGINNING = (5.0, 20.0)
"""Reference period [s] for the end: the motion is known and the damper is still cool."""

_END = 15.0


def drive_heated(learns: bool, duration: float) -> dict[str, Any]:
    """Task: drive until the damper is hot; with ``learns`` it is identified meanwhile.

    Returns the number of accepted sets and ``series`` (7, n) of consecutive periods: end of the
    period [s], temperature [°C], acceleration of the body [m/s²], load of the tyre [1], and, for
    the time in which the desired force was attainable, the RMSE of the force [N], the RMS of the
    desired force [N], and the fraction of it that was achieved (1 for all).
    """
    supply = SupplySetpoint()
    rig = car_rig(_ROAD, supply, LAG, _THERMAL)
    known = invented_damper(LAG)
    engine = Engine(EngineSettings().for_law(known.model), known) if learns else None
    choose = force_choice(rig, known, passive(_DAMPING), engine)
    per_stretch = round(_STRETCH / rig.settings.period / BLOCK)
    rows, stretches, before = [], [], None
    for block in commanded(rig, supply, choose, BLOCK, duration):
        motion = block.motion
        # The command after the previous block has produced the force of this one.
        wanted = np.nan
        if before is not None and before.attainable and not before.doubt:
            wanted = before.wanted
        rows.append(
            (
                float(block.measured.temperature[-1]),
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
    celsius, missed, desired, met, comfort, load = np.array(stretches).T
    time = _STRETCH * np.arange(1, celsius.size + 1)
    roots = (np.sqrt(comfort), np.sqrt(load) / STATIC_LOAD, np.sqrt(missed), np.sqrt(desired))
    accepted = sum(report.accepted for report in choose.reports)
    return {"series": np.stack([time, celsius, *roots, met / desired]), "accepted": accepted}


def _ends(series: Array) -> tuple[list[float], list[float]]:
    """Error of the force over the desired force, and its achieved fraction, first and last."""
    time, *_, missed, wanted, share = series
    errors, shares = [], []
    for begin, end in (_BEGINNING, (time[-1] - _END, time[-1])):
        chosen = (time > begin) & (time <= end)
        power = wanted[chosen] ** 2
        errors.append(float(np.sqrt(np.mean(missed[chosen] ** 2) / np.mean(power))))
        shares.append(float(np.average(share[chosen], weights=power)))
    return errors, shares


def heated_part(campaign: Campaign) -> Iterator[Chapter]:
    """Loss with an old set."""
    duration = 40.0 if campaign.quick else 90.0
    tasks = [{"learns": learns, "duration": duration} for learns in _NAMES]
    found = dict(zip(_NAMES, campaign.each("heated drives", drive_heated, tasks), strict=True))
    picture, axes = chart(
        "heated",
        "Temperature, and error and achieved fraction of the force while the desired force was "
        f"attainable, each over {_STRETCH:g} s.",
        (3, 1, 6.6, 4.8),
        sharex=True,
    )
    rows, growth = [], {}
    for learns, name in _NAMES.items():
        time, celsius, comfort, holding, missed, wanted, share = found[learns]["series"]
        draw_rows(
            axes, time, (celsius, 100.0 * missed / wanted, 100.0 * share), name, **line(int(learns))
        )
        errors, shares = _ends(found[learns]["series"])
        growth[learns] = errors[1] / errors[0]
        moving = time > _BEGINNING[0]
        rows.append(
            (
                *(name, float(celsius[-1]), 100.0 * errors[0], 100.0 * errors[1], growth[learns]),
                *(100.0 * shares[0], 100.0 * shares[1], float(comfort[moving].mean())),
                *(100.0 * float(holding[moving].mean()), found[learns]["accepted"]),
            )
        )
    name_rows(axes, "temperature (°C)", "force error (%)", "force achieved (%)")
    axes[1, 0].set(ylim=(0.0, None))
    legend_above(axes[0, 0], 2)
    yield chapter(
        "heated",
        "While the damper heats from 28 °C",
        f"with the set of 28 °C, the force error at the end is {growth[False]:.2f} times the error "
        f"at the beginning; with the set identified on line, {growth[True]:.2f} times.",
        f"The car drives on road {_ROAD} with a coil lag of 10 ms. The desired force is that of a "
        f"viscous damper of {_DAMPING:.0f} N s/m. The dissipated power heats the damper, which "
        "loses 26 % of its force up to 71 °C and none above. The identifier tracks it by windows "
        "of the measured motion, force and current, and the controller uses each accepted set. "
        "Most of the error is caused by the lag of the coil, not by the set.",
        picture,
        table(
            "heated",
            "Results for the time in which the desired force was attainable: first, from "
            f"{_BEGINNING[0]:g} to {_BEGINNING[1]:g} s, and last, in the last {_END:g} s. Error: "
            "RMSE over the RMS of the desired force. Achieved: least-squares fraction of the "
            "desired force that the damper exerted.",
            "set | hottest (°C) | error, first (%) | error, last (%) | last/first | achieved, "
            "first (%) | achieved, last (%) | comfort (m/s²) | holding (%) | accepted sets",
            rows,
        ),
    )
    campaign.figures["heated"] = {"fixed": growth[False], "identified": growth[True]}
