"""Chapters of the report on the quarter car: roads, bump, lag of the coil."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.emulation.plant_rig import HIGHEST_CURRENT, invented_damper
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.report.document import (
    GREY,
    INK,
    MARKS,
    Chapter,
    Picture,
    Table,
    Text,
    legend_above,
    panels,
)
from studies.control.car_drives import (
    BUMP,
    BUMP_ROAD,
    CAR,
    CONSTANTS,
    CONTROLLERS,
    LAG,
    OFF,
    ON,
    ROADS,
    SETTLED,
    SPEEDS,
    STRATEGIES,
    Drive,
    DriveResult,
)
from studies.drawing import heads, line


@dataclass(frozen=True)
class Drives:
    """Results by controller, road and lag of the coil; all drives are equally long [s]."""

    results: Mapping[Drive, DriveResult]
    duration: float

    def of(self, strategy: str, road: str, lag: float) -> DriveResult:
        """The result of a drive."""
        return self.results[Drive(strategy, road, lag, duration=self.duration)]


_TRADE_OFF_ROAD = "C"

_MOST_SHOWN = 200.0
"""Bars by road, in percent of passive-off."""


def best_on(drives: Drives, road: str) -> str:
    """The controller with the smallest sum of comfort and holding, each relative to passive-off."""
    off = drives.of(OFF, road, LAG)

    def cost(strategy: str) -> float:
        found = drives.of(strategy, road, LAG)
        return found.comfort / off.comfort + found.holding / off.holding

    return min(CONTROLLERS, key=cost)


def damper_chapter() -> Chapter:
    """Description of the damper of the car."""
    figure, axes = panels(1, 2, 6.6, 2.6)
    known = invented_damper(0.0)
    time = np.linspace(0.0, 2.0, 2000, endpoint=False)
    for place, current in enumerate((0.0, 0.2, 0.4, 0.8, HIGHEST_CURRENT)):
        amplitude, rate = 0.02, 2.0 * np.pi * 2.0
        motion = Motion(
            displacement=amplitude * np.sin(rate * time),
            velocity=amplitude * rate * np.cos(rate * time),
            acceleration=-amplitude * rate**2 * np.sin(rate * time),
            peak_velocity=np.full(time.size, amplitude * rate),
            sine=None,
        )
        force = known.law.force(known.values, motion, np.full(time.size, current), 1e-3)
        late = slice(1000, None)
        style = line(place)
        axes[0, 0].plot(motion.velocity[late], 1e-3 * force[late], label=f"{current:g} A", **style)
        axes[0, 1].plot(1e3 * motion.displacement[late], 1e-3 * force[late], **style)
    axes[0, 0].set(xlabel="velocity (m/s)", ylabel="force (kN)")
    axes[0, 1].set(xlabel="displacement (mm)")
    legend_above(figure, axes[0, 0], 5)
    return Chapter(
        "damper",
        "The damper and the car",
        [
            Text(
                "The damper is an invented one, in the size of the one of the thesis, so that what "
                "is known of it is the truth: the extended sigmoid law with a compliance, a gas "
                f"spring and a coil, for 0 to {HIGHEST_CURRENT:g} A. It keeps 74 % of its force at "
                "71 °C, as that of the thesis does. Its force is reckoned two thousand times a "
                "second, measured a thousand times a second with 5.53 N of noise, and the current "
                "is commanded every 5 ms."
            ),
            Text(
                f"The car has a body of {CAR.body:.0f} kg and a wheel of {CAR.wheel:.0f} kg, a "
                f"spring of {1e-3 * CAR.spring:.0f} kN/m and a tyre of {1e-3 * CAR.tyre:.0f} kN/m "
                "(Savaresi et al., Semi-Active Suspension Control Design for Vehicles, 2010). Tyre "
                "and spring are linear: the wheel does not leave the road, and nothing ends the "
                "suspension's travel. The controllers are given the true motion of body and wheel; "
                "no sensor of the car is in the study."
            ),
            Picture(
                "damper",
                "Force of the damper in a sine of 20 mm and 2 Hz, at five currents.",
                figure,
            ),
        ],
    )


def roads_chapter(drives: Drives) -> Chapter:
    """Comfort, road holding, travel and energy on roads of ISO 8608."""
    rows = []
    for road in ROADS[:-1]:
        off = drives.of(OFF, road, LAG)
        for strategy in STRATEGIES:
            found = drives.of(strategy, road, LAG)
            rows.append(
                (
                    road,
                    strategy,
                    found.comfort,
                    _percent(found.comfort, off.comfort),
                    100.0 * found.holding,
                    _percent(found.holding, off.holding),
                    1e3 * found.travel,
                    found.power,
                    found.coil,
                    f"{100.0 * found.met:.0f}" if np.isfinite(found.met) else None,
                )
            )
    table = Table(
        "roads",
        f"A coil that lags by {1e3 * LAG:.0f} ms. Comfort: RMS of the body's acceleration. Road "
        "holding: RMS of the tyre's load about the static one, as a part of it. Travel: RMS of the "
        "suspension's. Power: mean that the damper takes. Coil: mean square of its current. Met: "
        "share of the time in which the wanted force could be had. The changes are against "
        "passive-off on the same road.",
        heads(
            "road | controller | comfort (m/s²) | change (%) | holding (%) | change (%) | "
            "travel (mm) | power (W) | coil (A²) | met (%)"
        ),
        rows,
    )
    speeds = ", ".join(f"{road} {speed:.0f} m/s" for road, speed in SPEEDS.items())
    return Chapter(
        "roads",
        "Roads A to E",
        [
            Text(
                "Each road is a sum of sines of random phases with the density of its class, "
                f"the same for every controller; {speeds}. {drives.duration - SETTLED:.0f} s "
                f"count, after {SETTLED:.0f} in which the controller comes to know the motion. "
                "Every controller has one setting for all roads, and none was tuned to a road."
            ),
            Picture(
                "trade_off",
                f"Comfort against road holding on road {_TRADE_OFF_ROAD}; better is below and to "
                "the left. The line is what constant currents give, from "
                f"0 to {HIGHEST_CURRENT:g} A. Filled: coil without lag; open: {1e3 * LAG:.0f} ms.",
                _trade_off(drives),
            ),
            Picture(
                "by_road",
                "Comfort, road holding and travel of the suspension on the five roads, against "
                f"passive-off; coil lag {1e3 * LAG:.0f} ms. Bars that end at {_MOST_SHOWN:.0f} % "
                "go beyond: the table has their numbers.",
                _by_road(drives),
            ),
            Picture(
                "spectra",
                f"Density of the body's acceleration on road {_TRADE_OFF_ROAD}, coil lag "
                f"{1e3 * LAG:.0f} ms (Welch, stretches of 4 s).",
                _spectra(drives),
            ),
            table,
        ],
    )


def bump_chapter(drives: Drives) -> Chapter:
    """Peaks and time histories over the bump."""
    rows = [
        (
            strategy,
            found.highest,
            1e-3 * float(np.max(np.abs(found.series[2]))),
            1e3 * found.furthest,
            found.comfort,
        )
        for strategy in STRATEGIES
        for found in (drives.of(strategy, BUMP_ROAD, LAG),)
    ]
    return Chapter(
        "bump",
        "A bump",
        [
            Text(
                f"A cosine of {1e3 * BUMP.height:.0f} mm by {BUMP.length:g} m at {BUMP.speed:g} "
                f"m/s, on a road of class A, {BUMP.start:g} s after the start. A controller "
                "commands the safe current, 0 A, until the motion is known; the peaks are those "
                f"from {SETTLED:g} s on."
            ),
            Picture(
                "bump",
                f"Over the bump, coil lag {1e3 * LAG:.0f} ms.",
                _bump(drives),
            ),
            Table(
                "bump",
                "Peaks of the body's acceleration, of the tyre's load about the static one and of "
                "the suspension's travel; RMS of the acceleration.",
                ("controller", "peak (m/s²)", "load (kN)", "travel (mm)", "RMS (m/s²)"),
                rows,
            ),
        ],
    )


def lag_chapter(drives: Drives) -> Chapter:
    """Loss of performance caused by the lag of the coil."""
    rows = []
    for strategy in CONTROLLERS:
        for road in ("A", "C", "E"):
            quick, late = (drives.of(strategy, road, lag) for lag in (0.0, LAG))
            rows.append(
                (
                    strategy,
                    road,
                    quick.comfort,
                    late.comfort,
                    _percent(late.comfort, quick.comfort),
                    100.0 * quick.holding,
                    100.0 * late.holding,
                    _percent(late.holding, quick.holding),
                )
            )
    return Chapter(
        "lag",
        "With and without lag of the coil",
        [
            Text(
                "The current of the coil follows that of the supply with a first-order lag of "
                f"{1e3 * LAG:.0f} ms, which the inverse knows and makes up for as far as the "
                "limits of the supply let it."
            ),
            Table(
                "lag",
                "Without lag and with it.",
                heads(
                    "controller | road | comfort, none (m/s²) | 10 ms | change (%) | "
                    "holding, none (%) | 10 ms | change (%)"
                ),
                rows,
            ),
        ],
    )


def _percent(value: float, reference: float) -> str:
    return f"{100.0 * (value / reference - 1.0):+.1f}".replace("-", "−")


def _trade_off(drives: Drives) -> object:
    figure, axes = panels(1, 1, 4.8, 3.6)
    axis, road = axes[0, 0], _TRADE_OFF_ROAD
    line = [drives.of(name, road, 0.0) for name in (OFF, *CONSTANTS, ON)]
    axis.plot(
        [found.comfort for found in line],
        [100.0 * found.holding for found in line],
        color=GREY,
        marker=".",
        label="constant currents",
    )
    for place, strategy in enumerate(CONTROLLERS):
        for lag, filled in ((0.0, INK[place]), (LAG, "white")):
            found = drives.of(strategy, road, lag)
            axis.plot(
                found.comfort,
                100.0 * found.holding,
                linestyle="",
                marker=MARKS[place],
                color=INK[place],
                markerfacecolor=filled,
                label=strategy if lag == 0.0 else None,
                markersize=5,
            )
    for name, found in zip((OFF, ON), (line[0], line[-1]), strict=True):
        axis.annotate(
            name,
            (found.comfort, 100.0 * found.holding),
            xytext=(6, -2) if name == OFF else (-6, -3),
            textcoords="offset points",
            ha="left" if name == OFF else "right",
            fontsize=7.5,
        )
    axis.set(xlabel="RMS acceleration of the body (m/s²)", ylabel="RMS load of the tyre (%)")
    axis.legend(fontsize=7)
    return figure


def _by_road(drives: Drives) -> object:
    figure, axes = panels(3, 1, 6.6, 5.2, sharex=True)
    shown = STRATEGIES[1:]
    width = 0.8 / len(shown)
    quantities = (
        ("comfort", "acceleration (%)"),
        ("holding", "tyre load (%)"),
        ("travel", "travel (%)"),
    )
    for axis, (name, label) in zip(axes[:, 0], quantities, strict=True):
        for place, strategy in enumerate(shown):
            parts = [
                100.0
                * getattr(drives.of(strategy, road, LAG), name)
                / getattr(drives.of(OFF, road, LAG), name)
                for road in ROADS[:-1]
            ]
            offsets = np.arange(len(parts)) + (place - 0.5 * (len(shown) - 1)) * width
            axis.bar(offsets, parts, width, color=INK[place], label=strategy)
        axis.axhline(100.0, color=GREY, linewidth=0.8)
        axis.set(ylabel=label, ylim=(0.0, _MOST_SHOWN))
    axes[-1, 0].set_xticks(range(len(ROADS) - 1), [f"road {road}" for road in ROADS[:-1]])
    legend_above(figure, axes[0, 0], 4)
    return figure


def _spectra(drives: Drives) -> object:
    from scipy.signal import welch

    figure, axes = panels(1, 1, 5.6, 3.0)
    shown = (OFF, ON, "skyhook", best_on(drives, _TRADE_OFF_ROAD))
    for place, strategy in enumerate(dict.fromkeys(shown)):
        time, acceleration, _, _ = drives.of(strategy, _TRADE_OFF_ROAD, LAG).series
        rate = 1.0 / (time[1] - time[0])
        late = acceleration[time > SETTLED]
        frequency, density = welch(late, rate, nperseg=min(round(4.0 * rate), late.size))
        chosen = (frequency >= 0.4) & (frequency <= 30.0)
        axes[0, 0].loglog(frequency[chosen], density[chosen], label=strategy, **line(place))
    axes[0, 0].set(xlabel="frequency (Hz)", ylabel="density ((m/s²)²/Hz)")
    axes[0, 0].legend()
    return figure


def _bump(drives: Drives) -> object:
    figure, axes = panels(3, 1, 6.6, 4.6, sharex=True)
    shown: Sequence[str] = (OFF, ON, "skyhook", best_on(drives, _TRADE_OFF_ROAD))
    for place, strategy in enumerate(dict.fromkeys(shown)):
        time, acceleration, load, current = drives.of(strategy, BUMP_ROAD, LAG).series
        chosen = (time > BUMP.start - 0.1) & (time < BUMP.start + 2.4)
        since = time[chosen] - BUMP.start
        style = line(place)
        axes[0, 0].plot(since, acceleration[chosen], label=strategy, **style)
        axes[1, 0].plot(since, 1e-3 * load[chosen], **style)
        axes[2, 0].plot(since, current[chosen], **style)
    axes[0, 0].set(ylabel="acceleration (m/s²)")
    axes[1, 0].set(ylabel="tyre load (kN)")
    axes[2, 0].set(ylabel="current (A)", xlabel="time since the bump (s)")
    legend_above(figure, axes[0, 0], 4)
    return figure
