"""Performance of each controller in a quarter car on roads, over a bump, and as the damper heats.

The controllers receive the true motion of body and wheel. The inverse of the known set computes the
current of the damper from the measurements of a rig.

While the damper heats, the desired force is that of a viscous damper. Skyhook would not show the
benefit of a better set: on a rough road, its force is attainable for a sixth of the time, in
periods shorter than the lag of the coil. Even with the true set, the error exceeds half of that
force.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np

from mr_damper_ros.control import semi_active
from mr_damper_ros.control.force_controller import ForceControlSettings
from mr_damper_ros.control.linear_plant import Bump, IsoRoad, QuarterCar
from mr_damper_ros.emulation import emulator
from mr_damper_ros.emulation.commanded_rig import Choice, ForceChoice, commanded
from mr_damper_ros.emulation.emulator import (
    HIGHEST_CURRENT,
    EmulatedDamper,
    PlantRig,
    RigSettings,
    SupplySetpoint,
    ThermalModel,
    invented_damper,
)
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.report.document import GREY, Chapter, Picture, Table, chart, legend_above
from mr_damper_ros.rig.sources.emulated_source import suspension_state_of
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.engine import Engine
from studies.drawing import bars, chapter, draw_rows, line, name_rows
from studies.program import Campaign
from studies.recordings import rms

CAR = QuarterCar()
STATIC_LOAD = (CAR.body + CAR.wheel) * 9.80665
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

CONTROLLERS: dict[str, semi_active.Controller] = {
    "skyhook": semi_active.skyhook(2500.0),
    "groundhook": semi_active.groundhook(2500.0),
    "hybrid": semi_active.hybrid(3500.0, 0.6),
    "ADD": semi_active.acceleration_driven(SOFT, HARD),
    "SH-ADD": semi_active.mixed_skyhook_add(SOFT, HARD, 12.0),
    "clipped-optimal": semi_active.linear_feedback(
        semi_active.optimal_gain(CAR, semi_active.Weights())
    ),
}
"""Controllers, each with the same settings on all roads; none was tuned to a road."""

STRATEGIES = (OFF, ON, *CONTROLLERS)

_CONSTANTS = {f"{current:g} A": current for current in (0.1, 0.2, 0.3, 0.4, 0.6)}
"""Constant currents [A], which represent passive dampers of different hardness."""

_HELD = {OFF: 0.0, ON: HIGHEST_CURRENT, **_CONSTANTS}

LAG = 0.01
"""Time constant [s] of the coil in drives with coil lag."""

_ROAD = "C"
"""The road of the figures."""

_MOST_SHOWN = 200.0
"""Bars by road, in percent of passive-off."""

Drives = Mapping[tuple[str, str, float], Any]
"""Results of :func:`drive` by controller, road and time constant of the coil [s]."""


@cache
def _surroundings(road: str) -> emulator.Surroundings:
    return BUMP if road == BUMP_ROAD else IsoRoad(road, SPEEDS[road], 1)


def car_rig(
    road: str,
    supply: SupplySetpoint,
    coil_time_constant: float,
    thermal: ThermalModel | None = None,
) -> PlantRig:
    """The car with the invented damper."""
    return PlantRig(
        EmulatedDamper(invented_damper(coil_time_constant), emulator.HOT_FORCE, built_in=True),
        CAR.plant,
        _surroundings(road),
        supply,
        settings=RigSettings(displacement_noise=1e-6),
        thermal=thermal,
        coil_time_constant=coil_time_constant,
        substeps=2,
    )


def force_choice(
    rig: PlantRig,
    known: ParameterSet,
    controller: semi_active.Controller,
    engine: Engine | None = None,
) -> ForceChoice:
    """The nodes `suspension` and `controller` in one object, with an engine that identifies."""
    settings = ForceControlSettings(highest_current=HIGHEST_CURRENT)
    return ForceChoice(settings, known, lambda _: controller(suspension_state_of(rig)), engine)


def drive(strategy: str, road: str, lag: float, duration: float) -> dict[str, Any]:
    """Task: drive with a coil of this time constant [s], evaluated after the first seconds.

    ``comfort`` is the RMS acceleration of the body [m/s²], ``holding`` the RMS deviation of the
    tyre load from the static load, relative to it [1], and ``travel`` the RMS suspension stroke
    [m]. ``power`` [W] is the power that the damper dissipates, and ``coil`` the mean square of its
    current [A²]. ``met`` is the fraction of blocks with an attainable desired force. ``highest``
    and ``furthest`` are the peaks of the body and of the suspension. ``series`` are samples (4, n)
    5 ms apart: time [s], acceleration, load, current.
    """
    held = _HELD.get(strategy, 0.0)
    supply = SupplySetpoint(held)
    rig = car_rig(road, supply, lag)
    choose: Choice = lambda _: held  # noqa: E731
    if strategy in CONTROLLERS:
        choose = force_choice(rig, invented_damper(lag), CONTROLLERS[strategy])
    rows, met = [], []
    for block in commanded(rig, supply, choose, BLOCK, duration):
        motion = block.motion
        power = motion.force * motion.velocity
        load = CAR.tyre * motion.states[:, 2]
        rows.append([motion.rates[:, 1], load, motion.states[:, 0], power, motion.coil])
        if isinstance(choose, ForceChoice) and choose.last is not None:
            met.append(choose.last.attainable and not choose.last.doubt)
    every = np.concatenate(rows, axis=1)
    time = rig.settings.period * np.arange(1, every.shape[1] + 1)
    acceleration, load, travel, power, coil = every[:, round(SETTLED * rig.settings.sample_rate) :]
    return {
        "comfort": rms(acceleration),
        "holding": rms(load) / STATIC_LOAD,
        "travel": rms(travel - travel.mean()),
        "power": float(np.mean(power)),
        "coil": float(np.mean(coil**2)),
        "met": float(np.mean(met)) if met else None,
        "highest": float(np.max(np.abs(acceleration))),
        "furthest": float(np.max(np.abs(travel))),
        "series": np.stack([time, every[0], every[1], every[4]])[:, ::BLOCK],
    }


def roads_part(campaign: Campaign) -> Iterator[Chapter]:
    """All drives, and the chapters on them."""
    duration = 4.0 if campaign.quick else 12.0
    keys = [(strategy, road, LAG) for road in (*SPEEDS, BUMP_ROAD) for strategy in STRATEGIES]
    keys += [(strategy, road, 0.0) for road in ("A", "C", "E") for strategy in CONTROLLERS]
    keys += [(name, _ROAD, 0.0) for name in _HELD]
    drives = campaign.each("drives", drive, keys, duration=duration)
    best = {road: _best_on(drives, road) for road in SPEEDS}
    name = best[_ROAD]
    here, off, on = (drives[each, _ROAD, LAG] for each in (name, OFF, ON))
    against_passive = {
        f"car_{quantity}_over_{passive.replace('-', '_')}": max(
            drives[best[road], road, LAG][quantity] / drives[passive, road, LAG][quantity]
            for road in SPEEDS
        )
        for quantity in ("comfort", "holding")
        for passive in (OFF, ON)
    }
    told = (
        f"on road C, {name} is best in comfort and holding together: {here['comfort']:.2f} m/s² "
        f"and {here['holding']:.0%} of the tyre load, against {off['comfort']:.2f} m/s² and "
        f"{off['holding']:.0%} for passive-off, {on['comfort']:.2f} m/s² and {on['holding']:.0%} "
        "for passive-on."
    )
    campaign.figures["roads"] = {"best": best, "worst": against_passive}
    yield _damper_chapter()
    yield _roads_chapter(drives, duration, told)
    yield _bump_chapter(drives, name)
    yield _lag_chapter(drives)


def _best_on(drives: Drives, road: str) -> str:
    """The controller with the smallest sum of comfort and holding, each relative to passive-off."""
    off = drives[OFF, road, LAG]

    def cost(strategy: str) -> float:
        found = drives[strategy, road, LAG]
        return float(sum(found[each] / off[each] for each in ("comfort", "holding")))

    return min(CONTROLLERS, key=cost)


def _damper_chapter() -> Chapter:
    picture, axes = chart(
        "damper",
        "Force of the damper in a sine of 20 mm and 2 Hz, at five currents.",
        (1, 2, 6.6, 2.6),
    )
    known = invented_damper(0.0)
    time = np.linspace(0.0, 2.0, 2000, endpoint=False)
    amplitude, rate = 0.02, 2.0 * np.pi * 2.0
    u, v = amplitude * np.sin(rate * time), amplitude * rate * np.cos(rate * time)
    motion = Motion(u, v, -(rate**2) * u, np.full(time.size, amplitude * rate), sine=None)
    late = slice(1000, None)
    for place, current in enumerate((0.0, 0.2, 0.4, 0.8, HIGHEST_CURRENT)):
        force = 1e-3 * known.law.force(known.values, motion, np.full(time.size, current), 1e-3)
        axes[0, 0].plot(v[late], force[late], label=f"{current:g} A", **line(place))
        axes[0, 1].plot(1e3 * u[late], force[late], **line(place))
    axes[0, 0].set(xlabel="velocity (m/s)", ylabel="force (kN)")
    axes[0, 1].set(xlabel="displacement (mm)")
    legend_above(axes[0, 0], 5)
    return chapter(
        "damper",
        "The damper and the car",
        "an invented damper with known parameters, in a quarter car.",
        "The damper is invented, so that its parameters are known exactly, and as large as the "
        "damper of the thesis. It obeys the extended sigmoid law with a compliance, a gas spring "
        f"and a coil, for 0 to {HIGHEST_CURRENT:g} A. At 71 °C it has 74 % of its force, like the "
        "damper of the thesis. Its force is computed at 2 kHz and measured at 1 kHz with 5.53 N of "
        "noise; the current is commanded every 5 ms.",
        f"The car has a body of {CAR.body:.0f} kg and a wheel of {CAR.wheel:.0f} kg, a spring of "
        f"{1e-3 * CAR.spring:.0f} kN/m and a tyre of {1e-3 * CAR.tyre:.0f} kN/m (Savaresi et al., "
        "Semi-Active Suspension Control Design for Vehicles, 2010). Tyre and spring are linear: "
        "the wheel does not leave the road, and the suspension has no end stops. The controllers "
        "receive the true motion of body and wheel; the study contains no sensors of the car.",
        picture,
    )


def _roads_chapter(drives: Drives, duration: float, told: str) -> Chapter:
    rows = []
    for road in SPEEDS:
        off = drives[OFF, road, LAG]
        for strategy in STRATEGIES:
            found = drives[strategy, road, LAG]
            rows.append(
                (
                    *(road, strategy, found["comfort"]),
                    _percent(found["comfort"], off["comfort"]),
                    100.0 * found["holding"],
                    _percent(found["holding"], off["holding"]),
                    *(1e3 * found["travel"], found["power"], found["coil"]),
                    None if found["met"] is None else f"{100.0 * found['met']:.0f}",
                )
            )
    speeds = ", ".join(f"{road} {speed:.0f} m/s" for road, speed in SPEEDS.items())
    return chapter(
        "roads",
        "Roads A to E",
        told,
        "Each road is a sum of sines of random phases with the density of its class, the same for "
        f"every controller; {speeds}. After {SETTLED:.0f} s, in which the estimate of the motion "
        f"settles, {duration - SETTLED:.0f} s are evaluated. Every controller has one setting for "
        "all roads; none was tuned to a road.",
        _trade_off(drives),
        _by_road(drives),
        _spectra(drives),
        Table(
            "roads",
            f"Results with a coil lag of {1e3 * LAG:.0f} ms. Comfort: RMS acceleration of the "
            "body. Holding: RMS deviation of the tyre load from the static load, relative to it. "
            "Travel: RMS suspension stroke. Power: mean power dissipated by the damper. Coil: mean "
            "square of its current. Met: fraction of the time in which the desired force was "
            "attainable. Changes are relative to passive-off on the same road.",
            "road | controller | comfort (m/s²) | change (%) | holding (%) | change (%) | "
            "travel (mm) | power (W) | coil (A²) | met (%)",
            rows,
        ),
    )


def _bump_chapter(drives: Drives, best: str) -> Chapter:
    """Peaks and time histories over the bump; ``best`` is the best controller on the road."""
    over = {strategy: drives[strategy, BUMP_ROAD, LAG] for strategy in STRATEGIES}
    rows = [
        (
            strategy,
            found["highest"],
            1e-3 * float(np.max(np.abs(found["series"][2]))),
            1e3 * found["furthest"],
            found["comfort"],
        )
        for strategy, found in over.items()
    ]
    picture, axes = chart(
        "bump", f"Over the bump, coil lag {1e3 * LAG:.0f} ms.", (3, 1, 6.6, 4.6), sharex=True
    )
    for place, strategy in enumerate(_shown(drives)):
        time, acceleration, load, current = over[strategy]["series"]
        chosen = (time > BUMP.start - 0.1) & (time < BUMP.start + 2.4)
        shown = np.stack([acceleration, 1e-3 * load, current])[:, chosen]
        draw_rows(axes, time[chosen] - BUMP.start, shown, strategy, **line(place))
    name_rows(
        *(axes, "acceleration (m/s²)", "tyre load (kN)", "current (A)"),
        time="time since the bump (s)",
    )
    legend_above(axes[0, 0], 4)
    return chapter(
        "bump",
        "A bump",
        f"over the bump, the acceleration of the body is {over[best]['comfort']:.2f} m/s² (RMS; "
        f"peak {over[best]['highest']:.1f}) with {best}, and {over[OFF]['comfort']:.2f} m/s² (peak "
        f"{over[OFF]['highest']:.1f}) with passive-off.",
        f"The bump is a cosine of {1e3 * BUMP.height:.0f} mm by {BUMP.length:g} m, passed at "
        f"{BUMP.speed:g} m/s on a road of class A, {BUMP.start:g} s after the start. A controller "
        "commands the safe current, 0 A, until the motion is known; peaks are evaluated from "
        f"{SETTLED:g} s on.",
        picture,
        Table(
            "bump",
            "Peaks of the acceleration of the body, of the deviation of the tyre load from the "
            "static load, and of the suspension stroke; RMS acceleration of the body.",
            "controller | peak (m/s²) | load (kN) | travel (mm) | RMS (m/s²)",
            rows,
        ),
    )


def _lag_chapter(drives: Drives) -> Chapter:
    rows = []
    for strategy in CONTROLLERS:
        for road in ("A", "C", "E"):
            quick, late = (drives[strategy, road, lag] for lag in (0.0, LAG))
            cells: list[Any] = [strategy, road]
            for name, factor in (("comfort", 1.0), ("holding", 100.0)):
                cells += [factor * quick[name], factor * late[name]]
                cells.append(_percent(late[name], quick[name]))
            rows.append(cells)
    worst = max(
        drives[each, _ROAD, LAG]["comfort"] / drives[each, _ROAD, 0.0]["comfort"]
        for each in CONTROLLERS
    )
    return chapter(
        "lag",
        "With and without lag of the coil",
        f"a coil lag of 10 ms increases the acceleration of the body by at most {worst - 1.0:.0%} "
        "on road C.",
        f"The coil current follows the supply current with a first-order lag of {1e3 * LAG:.0f} "
        "ms. The controller knows this lag and compensates for it within the limits of the supply.",
        Table(
            "lag",
            f"Results without and with a coil lag of {1e3 * LAG:.0f} ms.",
            "controller | road | comfort, none (m/s²) | 10 ms | change (%) | holding, none (%) | "
            "10 ms | change (%)",
            rows,
        ),
    )


def _percent(value: float, reference: float) -> str:
    return f"{100.0 * (value / reference - 1.0):+.1f}".replace("-", "−")


def _trade_off(drives: Drives) -> Picture:
    picture, axes = chart(
        "trade_off",
        f"Comfort against road holding on road {_ROAD}; lower left is better. Line: constant "
        f"currents from 0 to {HIGHEST_CURRENT:g} A. Filled: coil without lag; open: coil lag "
        f"{1e3 * LAG:.0f} ms.",
        (1, 1, 4.8, 3.6),
    )
    axis = axes[0, 0]

    def place_of(name: str, lag: float) -> tuple[float, float]:
        found = drives[name, _ROAD, lag]
        return found["comfort"], 100.0 * found["holding"]

    places = np.array([place_of(name, 0.0) for name in (OFF, *_CONSTANTS, ON)])
    axis.plot(*places.T, color=GREY, marker=".", label="constant currents")
    for number, strategy in enumerate(CONTROLLERS):
        style = {**line(number, marked=True), "linestyle": "", "markersize": 5}
        axis.plot(*place_of(strategy, 0.0), label=strategy, **style)
        axis.plot(*place_of(strategy, LAG), markerfacecolor="white", **style)
    for name, place, side, by in (
        (OFF, places[0], "left", (6, -2)),
        (ON, places[-1], "right", (-6, -3)),
    ):
        axis.annotate(name, place, xytext=by, textcoords="offset points", ha=side, fontsize=7.5)
    axis.set(xlabel="RMS acceleration of the body (m/s²)", ylabel="RMS load of the tyre (%)")
    axis.legend(fontsize=7)
    return picture


def _by_road(drives: Drives) -> Picture:
    picture, axes = chart(
        "by_road",
        "Comfort, road holding and travel of the suspension on the five roads, relative to "
        f"passive-off; coil lag {1e3 * LAG:.0f} ms. Bars are cut at {_MOST_SHOWN:.0f} %; the table "
        "has all values.",
        (3, 1, 6.6, 5.2),
        sharex=True,
    )
    for axis, (name, label) in zip(
        axes[:, 0],
        (("comfort", "acceleration (%)"), ("holding", "tyre load (%)"), ("travel", "travel (%)")),
        strict=True,
    ):
        off = {road: drives[OFF, road, LAG][name] for road in SPEEDS}
        series = {
            strategy: [100.0 * drives[strategy, road, LAG][name] / off[road] for road in SPEEDS]
            for strategy in STRATEGIES[1:]
        }
        bars(axis, series)
        axis.axhline(100.0, color=GREY, linewidth=0.8)
        axis.set(ylabel=label, ylim=(0.0, _MOST_SHOWN))
    axes[-1, 0].set_xticks(range(len(SPEEDS)), [f"road {road}" for road in SPEEDS])
    legend_above(axes[0, 0], 4)
    return picture


def _spectra(drives: Drives) -> Picture:
    from scipy.signal import welch

    picture, axes = chart(
        "spectra",
        f"Spectral density of the body's acceleration on road {_ROAD}; coil lag {1e3 * LAG:.0f} ms "
        "(Welch's method, segments of 4 s).",
        (1, 1, 5.6, 3.0),
    )
    for place, strategy in enumerate(_shown(drives)):
        time, acceleration, _, _ = drives[strategy, _ROAD, LAG]["series"]
        rate = 1.0 / (time[1] - time[0])
        late = acceleration[time > SETTLED]
        frequency, density = welch(late, rate, nperseg=min(round(4.0 * rate), late.size))
        chosen = (frequency >= 0.4) & (frequency <= 30.0)
        axes[0, 0].loglog(frequency[chosen], density[chosen], label=strategy, **line(place))
    axes[0, 0].set(xlabel="frequency (Hz)", ylabel="density ((m/s²)²/Hz)")
    axes[0, 0].legend()
    return picture


def _shown(drives: Drives) -> list[str]:
    return list(dict.fromkeys((OFF, ON, "skyhook", _best_on(drives, _ROAD))))


# -- while the damper heats ------------------------------------------------------------------------

_THERMAL = ThermalModel(heat_capacity=215.0)
"""Half of the usual heat capacity, which permits a short drive."""

_DAMPING = 2500.0
"""Damping [N s/m] of the desired viscous damper, whose force always resists the motion."""

_STRETCH = 5.0
"""Time [s] covered by each value of the series."""

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
    engine = Engine(start=known) if learns else None
    choose = force_choice(rig, known, semi_active.passive(_DAMPING), engine)
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
    found = campaign.each("heated drives", drive_heated, _NAMES, duration=duration)
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
        Table(
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
