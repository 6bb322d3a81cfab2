"""How the force depends on current, frequency, displacement and temperature.

Thesis 4.1-4.5, figures 29-36, tables 8 and 9.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from mr_damper_ros.models.published import THESIS_28_CELSIUS as COLD
from mr_damper_ros.models.published import THESIS_71_CELSIUS as WARM
from mr_damper_ros.models.published import Condition, find, parameters
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.report.document import Chapter, Picture
from mr_damper_ros.signals.arrays import Array
from studies.drawing import chart, line, table
from studies.program import Campaign, Part
from studies.thesis import facts
from studies.thesis.compared import Compared, comparison
from studies.thesis.conditions import identified
from studies.thesis.errata import sound_conditions
from studies.thesis.runs import ACROSS, draw_loop, loop

FREQUENCY_SERIES = tuple(find(f"5.0mm_{f}Hz_0.5A") for f in (1, 3, 5))
STROKE_SERIES = tuple(find(f"{a:.1f}mm_1Hz_0.5A") for a in (2.5, 5.0, 7.5))
CURRENT_SERIES = tuple(find(f"5.0mm_1Hz_{i:.1f}A") for i in (0.0, 0.5, 1.5))
"""Without 1.0 A, because the tables of 5.0 mm repeat those of 0 A there."""

HEATED = CURRENT_SERIES[-1]
"""Condition of the sets of tables 8 and 9."""


def peaks(values: Array) -> tuple[float, float]:
    """Largest and smallest force [N] of a set (16,) in the condition of tables 8 and 9."""
    force = loop(values, HEATED, points=2000).force
    return float(force.max()), float(force.min())


def dependency_part(campaign: Campaign) -> Part:
    """The chapter on the four dependencies."""
    runs = identified(campaign)

    def half_span(condition: Condition) -> float:
        return 0.5 * float(runs[condition.name]["maximum"] - runs[condition.name]["minimum"])

    def slope(series: Iterable[Condition], steps: list[float]) -> float:
        speeds = [runs[condition.name]["peak_velocity"] for condition in series]
        return float(np.polyfit(steps, speeds, 1)[0])

    def asymmetry(condition: Condition) -> float:
        run = runs[condition.name]
        return 100.0 * float(1.0 - abs(run["maximum"]) / abs(run["minimum"]))

    groups: dict[str, tuple[list[float], list[float]]] = {}
    for condition in sound_conditions():
        key = f"{1e3 * condition.amplitude:.1f} mm, {condition.frequency:g} Hz"
        currents, spans = groups.setdefault(key, ([], []))
        currents.append(condition.current)
        spans.append(half_span(condition))
    by_frequency = [half_span(condition) for condition in FREQUENCY_SERIES]
    spread = 100.0 * float(np.ptp(by_frequency) / np.mean(by_frequency))
    rise, stroke = slope(FREQUENCY_SERIES, [1.0, 3.0, 5.0]), slope(STROKE_SERIES, [1.0, 2.0, 3.0])
    ratio = half_span(STROKE_SERIES[2]) / half_span(STROKE_SERIES[1])
    stated = facts.VELOCITY_PER_STROKE, facts.VELOCITY_PER_HERTZ
    where = "4.3, Fig. 33"
    below = "extension peak below compression peak (5 mm, 1 Hz,"
    values: list[Compared] = [
        (
            *("peak velocity per 2.5 mm of amplitude (1 Hz, 0.5 A)", "m/s"),
            *(stroke, stated[0], "4.4, Fig. 35"),
        ),
        ("peak velocity per 1 Hz (5 mm, 0.5 A)", "m/s", rise, stated[1], f"{where}; erratum"),
        ("peak velocity per 2 Hz, the step of the tests", "m/s", 2.0 * rise, stated[1], where),
        (
            *("change of half the force span over 1–5 Hz (5 mm, 0.5 A)", "%"),
            *(spread, "minimal", "4.3, Fig. 32; erratum"),
        ),
        (f"{below} 0.0 A)", "%", asymmetry(CURRENT_SERIES[0]), "asymmetric", "4.1, Fig. 29"),
        *(
            (
                *(f"{below} {condition.current:.1f} A)", "%", asymmetry(condition)),
                *(f"< {100.0 * facts.ASYMMETRY_LIMIT:.0f}", "4.1, Fig. 30"),
            )
            for condition in CURRENT_SERIES[1:]
        ),
        ("half the force span, 7.5 over 5.0 mm (1 Hz, 0.5 A)", "1", ratio, "< 1", "4.4, Fig. 34"),
    ]
    cold, warm, same = peaks(COLD), peaks(WARM), peaks(parameters(HEATED))
    at_cold, at_warm, at_same = (max(map(abs, each)) for each in (cold, warm, same))
    drop = 100.0 * (1.0 - at_warm / at_cold)
    loss = 100.0 * (1.0 - facts.PEAK_WARM / facts.PEAK_COLD)
    there = "peak force of the same condition in table 37"
    heat: list[Compared] = [
        ("peak force at 28 °C", "N", at_cold, facts.PEAK_COLD, "4.5, Fig. 36"),
        ("peak force at 71 °C", "N", at_warm, facts.PEAK_WARM, "4.5, Fig. 36"),
        ("loss of peak force", "%", drop, loss, "4.5"),
        ("opposite peak at 28 °C", "N", cold[1], None, ""),
        ("opposite peak at 71 °C", "N", warm[1], None, ""),
        (there, "N", at_same, facts.PEAK_COLD, "Tables 37, 38"),
    ]
    sets = {"28 °C": COLD, "71 °C": WARM, "difference": WARM - COLD}
    sets["stated, without sign"] = facts.HEATED
    chapter = Chapter(
        "dependency",
        "Dependency on current, frequency, displacement and temperature",
        f"the peak force falls by {drop:.1f} % from 28 to 71 °C (thesis 26 %), the velocity rises "
        f"by {stroke:.4f} m/s per 2.5 mm (thesis 0.015 m/s).",
        [
            "The forces are those of the loops identified from the re-synthesised runs. The thesis "
            "states few numbers here; the tables compare them with ours. The figures show trends.",
            _loops(
                "current_dependency",
                "Current dependency, 5 mm, 1 Hz (thesis Fig. 29–31). Published sets.",
                [(f"{each.current:.1f} A", each, parameters(each)) for each in CURRENT_SERIES],
            ),
            table(
                "current_slopes",
                "Half the force span over current: least-squares slope, and slopes between "
                "neighbouring currents. The last slope shows the saturation.",
                "Amplitude, frequency | Slope [N/A] | Steps [N/A]",
                [
                    (
                        *(key, float(np.polyfit(currents, spans, 1)[0])),
                        ", ".join(f"{step:.0f}" for step in np.diff(spans) / np.diff(currents)),
                    )
                    for key, (currents, spans) in groups.items()
                ],
            ),
            _span_figure(groups),
            _loops(
                "frequency_dependency",
                "Frequency dependency, 5 mm, 0.5 A (thesis Fig. 32, 33). Published sets.",
                [(f"{each.frequency:g} Hz", each, parameters(each)) for each in FREQUENCY_SERIES],
            ),
            _loops(
                "stroke_dependency",
                "Displacement dependency, 1 Hz, 0.5 A (thesis Fig. 34, 35). Published sets.",
                [
                    (f"{1e3 * each.amplitude:.1f} mm", each, parameters(each))
                    for each in STROKE_SERIES
                ],
            ),
            comparison("dependency", "Stated dependencies.", values),
            comparison("temperature", "Force of the sets of tables 8 and 9.", heat),
            table(
                "temperature_parameters",
                "Tables 8 and 9, and their difference. The signs of a0, a1, a2, I0, I1, k0 and k5 "
                "differ: the two sets belong to different local minima, so their differences "
                "contain no information about temperature.",
                f"Temperature | {' | '.join(PARAMETER_NAMES)}",
                [
                    (name, *(f"{value:.2f}".replace("-", "−") for value in each))
                    for name, each in sets.items()
                ],
            ),
            _loops(
                "temperature",
                "Loops of the sets of tables 8 and 9: 5 mm, 1 Hz, 1.5 A (thesis Fig. 36).",
                [("28 °C", HEATED, COLD), ("71 °C", HEATED, WARM)],
            ),
        ],
    )
    return Part([chapter])


def _loops(name: str, caption: str, curves: list[tuple[str, Condition, Array]]) -> Picture:
    picture, axes = chart(name, caption, (1, 2, 6.6, 2.8))
    for a, against in zip(axes[0], ("displacement", "velocity"), strict=True):
        for number, (label, condition, values) in enumerate(curves):
            draw_loop(a, values, condition, against, label=label, **line(number))
        a.set(xlabel=ACROSS[against], ylabel="Force [N]")
    axes[0, 1].legend(loc="upper left")
    return picture


def _span_figure(groups: dict[str, Any]) -> Picture:
    picture, axes = chart(
        "force_over_current",
        "Half the force span over the current, identified from the re-synthesised runs. 5.0 mm, "
        "1.0 A is missing, because its tables are copies of those of 0 A.",
        (1, 3, 6.8, 2.5),
        *("Current [A]", "Half the force span [N]"),
        sharey=True,
    )
    for a, amplitude in zip(axes[0], ("2.5 mm", "5.0 mm", "7.5 mm"), strict=True):
        keys = [key for key in groups if key.startswith(amplitude)]
        for number, key in enumerate(keys):
            a.plot(*groups[key], label=key.split(", ")[1], **line(number, marked=True))
        a.set(title=amplitude, ylim=(0, None))
    axes[0, 0].legend(loc="upper left")
    return picture
