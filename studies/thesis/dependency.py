"""How the force depends on current, frequency, displacement and temperature.

Thesis 4.1-4.5, figures 29-36, tables 8 and 9.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mr_damper_ros.models.published import THESIS_28_CELSIUS as COLD
from mr_damper_ros.models.published import THESIS_71_CELSIUS as WARM
from mr_damper_ros.models.published import Condition, find, parameters
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.report.document import Block, Picture, Table, Text, panels
from mr_damper_ros.signals.arrays import Array
from studies.drawing import line
from studies.program import Campaign
from studies.thesis import facts
from studies.thesis.compared import Compared, comparison
from studies.thesis.conditions import identified
from studies.thesis.errata import sound_conditions
from studies.thesis.runs import loop

FREQUENCY_SERIES = tuple(f"5.0mm_{f}Hz_0.5A" for f in (1, 3, 5))
STROKE_SERIES = tuple(f"{a:.1f}mm_1Hz_0.5A" for a in (2.5, 5.0, 7.5))
CURRENT_SERIES = tuple(f"5.0mm_1Hz_{i:.1f}A" for i in (0.0, 0.5, 1.5))
"""Without 1.0 A, because the tables of 5.0 mm repeat those of 0 A there."""


def compute(campaign: Campaign) -> dict[str, Any]:
    """Data of the section."""
    runs = identified(campaign)

    def half_span(name: str) -> float:
        return 0.5 * float(runs[name]["maximum"] - runs[name]["minimum"])

    def asymmetry(name: str) -> float:
        low, high = abs(runs[name]["minimum"]), abs(runs[name]["maximum"])
        return float(1.0 - high / low)

    def series(names: tuple[str, ...], steps: list[float]) -> dict[str, Any]:
        speeds = [runs[name]["peak_velocity"] for name in names]
        slope = float(np.polyfit(steps, speeds, 1)[0])
        return {"half_span": [half_span(name) for name in names], "slope": slope}

    groups: dict[str, dict[str, Any]] = {}
    for condition in sound_conditions():
        key = f"{1e3 * condition.amplitude:.1f} mm, {condition.frequency:g} Hz"
        group = groups.setdefault(key, {"current": [], "half_span": []})
        group["current"].append(condition.current)
        group["half_span"].append(half_span(condition.name))
    for group in groups.values():
        group["slope"] = float(np.polyfit(group["current"], group["half_span"], 1)[0])
        i, f = group["current"], group["half_span"]
        group["pieces"] = [(f[k + 1] - f[k]) / (i[k + 1] - i[k]) for k in range(len(i) - 1)]
    warm, cold = (_peaks(values) for values in (WARM, COLD))
    return {
        "groups": groups,
        "asymmetry": {name: asymmetry(name) for name in ("5.0mm_1Hz_0.0A", *CURRENT_SERIES[1:])},
        "frequency": series(FREQUENCY_SERIES, [1.0, 3.0, 5.0]),
        "stroke": series(STROKE_SERIES, [1.0, 2.0, 3.0]),
        "temperature": {
            "cold": cold,
            "warm": warm,
            "drop": 1.0 - max(map(abs, warm)) / max(map(abs, cold)),
            "condition": _peaks(parameters(find("5.0mm_1Hz_1.5A"))),
        },
    }


def _peaks(values: Array) -> list[float]:
    turn = loop(values, find("5.0mm_1Hz_1.5A"), points=2000)
    return [float(turn.force.max()), float(turn.force.min())]


def headline(data: dict[str, Any]) -> str:
    """The result in a sentence."""
    heat, stroke = data["temperature"], data["stroke"]["slope"]
    return (
        f"the peak force falls by {100 * heat['drop']:.1f} % from 28 to 71 °C (thesis 26 %), the "
        f"velocity rises by {stroke:.4f} m/s per 2.5 mm (thesis 0.015 m/s)."
    )


def show(data: dict[str, Any]) -> list[Block]:
    """Text, tables and figures of the section."""
    frequency, stroke, temperature = data["frequency"], data["stroke"], data["temperature"]
    spread = np.ptp(frequency["half_span"]) / np.mean(frequency["half_span"])
    rise, ratio = frequency["slope"], stroke["half_span"][2] / stroke["half_span"][1]
    stated = facts.VELOCITY_PER_STROKE, facts.VELOCITY_PER_HERTZ
    where = "4.3, Fig. 33"
    values: list[Compared] = [
        (
            *("peak velocity per 2.5 mm of amplitude (1 Hz, 0.5 A)", "m/s"),
            *(stroke["slope"], stated[0], "4.4, Fig. 35"),
        ),
        ("peak velocity per 1 Hz (5 mm, 0.5 A)", "m/s", rise, stated[1], f"{where}; erratum"),
        ("peak velocity per 2 Hz, the step of the tests", "m/s", 2.0 * rise, stated[1], where),
        (
            *("change of half the force span over 1–5 Hz (5 mm, 0.5 A)", "%"),
            *(100.0 * float(spread), "minimal", "4.3, Fig. 32; erratum"),
        ),
        *(
            (
                f"extension peak below compression peak (5 mm, 1 Hz, {find(name).current:.1f} A)",
                *("%", 100.0 * value),
                "asymmetric" if "0.0A" in name else f"< {100.0 * facts.ASYMMETRY_LIMIT:.0f}",
                "4.1, Fig. 29" if "0.0A" in name else "4.1, Fig. 30",
            )
            for name, value in data["asymmetry"].items()
        ),
        ("half the force span, 7.5 over 5.0 mm (1 Hz, 0.5 A)", "1", ratio, "< 1", "4.4, Fig. 34"),
    ]
    slopes = Table(
        "current_slopes",
        "Half the force span over current: least-squares slope, and slopes between neighbouring "
        "currents. The last slope shows the saturation.",
        ("Amplitude, frequency", "Slope [N/A]", "Steps [N/A]"),
        [
            (key, group["slope"], ", ".join(f"{piece:.0f}" for piece in group["pieces"]))
            for key, group in data["groups"].items()
        ],
    )
    cold, warm, same = (temperature[key] for key in ("cold", "warm", "condition"))
    loss = 100.0 * (1.0 - facts.PEAK_WARM / facts.PEAK_COLD)
    there = "peak force of the same condition in table 37"
    heat: list[Compared] = [
        ("peak force at 28 °C", "N", max(map(abs, cold)), facts.PEAK_COLD, "4.5, Fig. 36"),
        ("peak force at 71 °C", "N", max(map(abs, warm)), facts.PEAK_WARM, "4.5, Fig. 36"),
        ("loss of peak force", "%", 100.0 * temperature["drop"], loss, "4.5"),
        ("opposite peak at 28 °C", "N", cold[1], None, ""),
        ("opposite peak at 71 °C", "N", warm[1], None, ""),
        (there, "N", max(map(abs, same)), facts.PEAK_COLD, "Tables 37, 38"),
    ]
    return [
        Text(
            "The forces are those of the loops identified from the re-synthesised runs. The thesis "
            "states few numbers here; the tables compare them with ours. The figures show trends."
        ),
        _series_figure(
            "current", "Current dependency, 5 mm, 1 Hz (thesis Fig. 29–31).", CURRENT_SERIES
        ),
        slopes,
        _span_figure(data),
        _series_figure(
            "frequency", "Frequency dependency, 5 mm, 0.5 A (thesis Fig. 32, 33).", FREQUENCY_SERIES
        ),
        _series_figure(
            "stroke", "Displacement dependency, 1 Hz, 0.5 A (thesis Fig. 34, 35).", STROKE_SERIES
        ),
        comparison("dependency", "Stated dependencies.", values),
        comparison("temperature", "Force of the sets of tables 8 and 9.", heat),
        Table(
            "temperature_parameters",
            "Tables 8 and 9, and their difference. The signs of a0, a1, a2, I0, I1, k0 and k5 "
            "differ: the two sets belong to different local minima, so their differences contain "
            "no information about temperature.",
            ("Temperature", *PARAMETER_NAMES),
            [
                ("28 °C", *map(_two_decimals, COLD)),
                ("71 °C", *map(_two_decimals, WARM)),
                ("difference", *map(_two_decimals, WARM - COLD)),
                ("stated, without sign", *map(_two_decimals, facts.HEATED)),
            ],
        ),
        _temperature_figure(),
    ]


def _two_decimals(value: float) -> str:
    return f"{value:.2f}".replace("-", "−")


def _loop_panels(curves: list[tuple[str, Condition, Array]]) -> Any:
    figure, axes = panels(1, 2, 6.6, 2.8)
    for number, (label, condition, values) in enumerate(curves):
        turn = loop(values, condition)
        style = {**line(number), "label": label}
        axes[0, 0].plot(1e3 * turn.displacement, turn.force, **style)
        axes[0, 1].plot(turn.velocity, turn.force, **style)
    axes[0, 0].set(xlabel="Displacement [mm]", ylabel="Force [N]")
    axes[0, 1].set(xlabel="Velocity [m/s]", ylabel="Force [N]")
    axes[0, 1].legend(loc="upper left")
    return figure


def _series_figure(name: str, caption: str, series: tuple[str, ...]) -> Picture:
    curves = []
    for condition in map(find, series):
        label = {
            "current": f"{condition.current:.1f} A",
            "frequency": f"{condition.frequency:g} Hz",
            "stroke": f"{1e3 * condition.amplitude:.1f} mm",
        }[name]
        curves.append((label, condition, parameters(condition)))
    return Picture(f"{name}_dependency", f"{caption} Published sets.", _loop_panels(curves))


def _span_figure(data: dict[str, Any]) -> Picture:
    figure, axes = panels(1, 3, 6.8, 2.5, sharey=True)
    for a, amplitude in zip(axes[0], ("2.5 mm", "5.0 mm", "7.5 mm"), strict=True):
        groups = [(k, g) for k, g in data["groups"].items() if k.startswith(amplitude)]
        for number, (key, group) in enumerate(groups):
            style = {"label": key.split(", ")[1], **line(number, marked=True)}
            a.plot(group["current"], group["half_span"], **style)
        a.set(title=amplitude, xlabel="Current [A]", ylim=(0, None))
    axes[0, 0].set_ylabel("Half the force span [N]")
    axes[0, 0].legend(loc="upper left")
    return Picture(
        "force_over_current",
        "Half the force span over the current, identified from the re-synthesised runs. 5.0 mm, "
        "1.0 A is missing, because its tables are copies of those of 0 A.",
        figure,
    )


def _temperature_figure() -> Picture:
    condition = find("5.0mm_1Hz_1.5A")
    curves = [("28 °C", condition, COLD), ("71 °C", condition, WARM)]
    return Picture(
        "temperature",
        "Loops of the sets of tables 8 and 9: 5 mm, 1 Hz, 1.5 A (thesis Fig. 36).",
        _loop_panels(curves),
    )
