"""All conditions, and how the force depends on current, frequency, displacement and temperature.

All conditions (thesis tables 17-40, figures 60-90): both published sets, our own identification of
the run, and their loops. Dependencies: thesis 4.1-4.5, figures 29-36, tables 8 and 9.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import product
from typing import Any

import numpy as np

from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.published import (
    CONDITIONS,
    LITERATURE,
    PUBLISHED_METHODS,
    Condition,
    find,
    parameters,
)
from mr_damper_ros.models.published import THESIS_28_CELSIUS as COLD
from mr_damper_ros.models.published import THESIS_71_CELSIUS as WARM
from mr_damper_ros.models.sigmoid.law import COEFFICIENT_NAMES, PARAMETER_NAMES
from mr_damper_ros.report import document
from mr_damper_ros.signals.arrays import Array
from studies.drawing import chapter, line
from studies.program import Campaign
from studies.thesis import facts
from studies.thesis.errata import METHOD_TITLES, disagreement, find_errata, sound_conditions
from studies.thesis.facts import Compared, comparison
from studies.thesis.runs import ACROSS, coefficients, draw_loop, loop, title, top_speed, window

# -- all conditions --------------------------------------------------------------------------------

_UNITS = ("N", "s/m", "s/m", "s/m", "mm/s", "mm/s", "N")
_SCALES = np.array([1e3 if unit == "mm/s" else 1.0 for unit in _UNITS])

_AGREEING = 0.02
"""Largest relative norm of the difference between two loops that agree."""

FIGURES = {0.0: "60–67", 0.5: "68–75", 1.0: "76–83", 1.5: "84–90"}
"""Figures of the thesis by current [A] (table 12)."""

_SIMPLEX = PUBLISHED_METHODS[0]

Runs = dict[str, dict[str, Any]]
"""Results of :func:`identify` by condition."""


def identify(name: str, seed: int) -> dict[str, Any]:
    """Task: seven coefficients of one run by Nelder-Mead, and the error of every set on it."""
    condition = find(name)
    fit = fit_window(MODELS["sigmoid"], window(name, seed), LITERATURE)
    own = loop(fit.parameters, condition).force

    published = {}
    for method in PUBLISHED_METHODS:
        theirs = loop(parameters(condition, method), condition).force
        published[method] = {
            "maximum": float(theirs.max()),
            "minimum": float(theirs.min()),
            "difference": float(np.linalg.norm(own - theirs) / np.linalg.norm(theirs)),
        }
    return {
        "coefficients": fit.coefficients,
        "errors": np.sqrt(np.diag(fit.coefficient_covariance)),
        "parameters": fit.parameters,
        "rmse": fit.rmse,
        "nrmse": fit.nrmse,
        "maximum": float(own.max()),
        "minimum": float(own.min()),
        "peak_velocity": fit.operating_point[0],
        "published": published,
    }


def identified(campaign: Campaign) -> dict[str, Any]:
    """Result of :func:`identify` by condition."""
    names = [condition.name for condition in CONDITIONS]
    return campaign.each("conditions", identify, names, seed=campaign.seed)


def _mark(condition: Condition, method: str) -> str:
    return " *" if (condition, method) in find_errata() else ""


def conditions_part(campaign: Campaign) -> Iterator[document.Chapter]:
    """The chapter on all conditions."""
    runs = identified(campaign)
    sound = [condition for condition in CONDITIONS if not _mark(condition, _SIMPLEX)]
    worst = max(runs[each.name]["published"][_SIMPLEX]["difference"] for each in sound)
    blocks: list[document.Block] = [
        "For each run, Nelder–Mead identifies seven operating-point coefficients, starting from "
        "the literature set. The loops are compared with those of both published sets. A run is "
        "synthesised from the Nelder–Mead set, so our loop must agree with its loop to within the "
        "noise; the difference from the DE loop shows how far the published sets differ. * marks a "
        "row in error (see the section on errata).",
        _overview(runs),
        _coefficients(runs, sound),
        document.Table(
            "published_parameters",
            "The published sets (tables 17–40), in the units of the thesis. The loops of both "
            "methods agree but their parameters differ: a single run does not determine sixteen "
            "parameters.",
            f"Condition | Method | {' | '.join(PARAMETER_NAMES)}",
            [
                (
                    title(condition.name),
                    METHOD_TITLES[method] + _mark(condition, method),
                    *(f"{x:.8g}" for x in parameters(condition, method)),
                )
                for condition, method in product(CONDITIONS, PUBLISHED_METHODS)
            ],
        ),
        "The figures show the loops of all conditions, current by current: Nelder–Mead set "
        "(black), DE set (dashed) and our set (light dots on top). Rows in error are not drawn. "
        "The small step of the force in the middle of the stroke belongs to the law: there the "
        "acceleration changes its sign, and the loop changes its branch.",
    ]
    for current in sorted({condition.current for condition in CONDITIONS}):
        blocks += [_all_loops(runs, current, against) for against in ACROSS]
    told = (
        f"in {len(sound)} sound conditions our loop is within {100 * worst:.2f} % of the published "
        "Nelder–Mead loop."
    )
    yield chapter("conditions", "All conditions", told, *blocks)


def _overview(runs: Runs) -> document.Table:
    rows = []
    for condition in CONDITIONS:
        run = runs[condition.name]
        nelder, evolved = (run["published"][method] for method in PUBLISHED_METHODS)
        marks = [_mark(condition, method) for method in PUBLISHED_METHODS]
        rows.append(
            (
                title(condition.name) + marks[0],
                *(each[end] for end in ("maximum", "minimum") for each in (run, nelder)),
                100.0 * nelder["difference"],
                f"{100.0 * evolved['difference']:.2f}{marks[1]}",
                *(run["rmse"], 100.0 * run["nrmse"]),
            )
        )
    return document.Table(
        "conditions",
        "Peak forces of our identified loops and of the Nelder–Mead sets of the thesis, and the "
        "difference between our loop and both published loops.",
        "Condition | Max ours [N] | Max thesis [N] | Min ours [N] | Min thesis [N] | "
        "Difference NM [%] | Difference DE [%] | RMSE [N] | NRMSE [%]",
        rows,
    )


def _coefficients(runs: Runs, sound: list[Condition]) -> document.Table:
    rows: list[tuple[str, ...]] = []
    for condition in sound:
        run, name = runs[condition.name], title(condition.name)
        ours, errors = (_SCALES * run[key] for key in ("coefficients", "errors"))
        rows.append((name, "ours", *map(document.with_error, ours, errors)))
        for method in PUBLISHED_METHODS:
            theirs = _SCALES * published_coefficients(condition, method)
            label = METHOD_TITLES[method] + _mark(condition, method)
            rows.append((name, label, *map(document.to_error, theirs, errors)))
    heads = (f"{name} [{unit}]" for name, unit in zip(COEFFICIENT_NAMES, _UNITS, strict=True))
    return document.Table(
        "coefficients",
        "The seven coefficients that one run determines, with standard errors, in every sound "
        "condition, and the coefficients of both published sets (to the same digits). "
        + _agreement(sound),
        f"Condition | Set | {' | '.join(heads)}",
        rows,
    )


def _agreement(sound: list[Condition]) -> str:
    """Agreement, in words, of the coefficients of published sets whose loops agree."""
    apart = {
        condition.name: [published_coefficients(condition, method) for method in PUBLISHED_METHODS]
        for condition in sound
        if not _mark(condition, PUBLISHED_METHODS[1]) and disagreement(condition) < _AGREEING
    }
    changes = {name: np.abs(two / one - 1.0) for name, (one, two) in apart.items()}
    f_t, f_d = (COEFFICIENT_NAMES.index(name) for name in ("f_t", "f_d"))
    worst = max(changes, key=lambda name: changes[name][f_d])
    one, two = apart[worst]
    return (
        f"Where the loops of both published sets agree to {100 * _AGREEING:.0f} % ({len(apart)} "
        f"conditions), f_t agrees to {100 * max(change[f_t] for change in changes.values()):.0f} "
        "%. The smaller coefficients may differ, because they compensate for each other, as at "
        f"{title(worst)}, where f_d is {one[f_d]:.1f} and {two[f_d]:.1f} N."
    )


def published_coefficients(condition: Condition, method: str) -> Array:
    """Seven coefficients (7,) of a published set in its condition."""
    values = parameters(condition, method)
    return coefficients(values, top_speed(condition), condition.current)


_STYLES = {
    METHOD_TITLES["nelder_mead"]: {**line(0), "linewidth": 1.8},
    METHOD_TITLES["differential_evolution"]: {**line(1), "linewidth": 1.2},
    "ours": {**line(2), "color": "0.75"},
}


def _all_loops(runs: Runs, current: float, against: str) -> document.Picture:
    picture, axes = document.chart(
        f"loops_{against}_{current:.1f}A",
        f"Force over {against} at {current:.1f} A (thesis Fig. {FIGURES[current]}).",
        (3, 3, 6.8, 6.0),
        *(ACROSS[against], "Force [N]"),
        sharey=True,
    )
    amplitudes = sorted({c.amplitude for c in CONDITIONS})
    frequencies = sorted({c.frequency for c in CONDITIONS})
    found = {(c.amplitude, c.frequency): c for c in CONDITIONS if c.current == current}
    for a, key in zip(axes.ravel(), product(amplitudes, frequencies), strict=True):
        a.set_title(f"{1e3 * key[0]:.1f} mm, {key[1]:g} Hz")
        condition = found.get(key)
        if condition is None or _mark(condition, _SIMPLEX):
            words = "not tested" if condition is None else "in error"
            a.text(0.5, 0.5, words, transform=a.transAxes, ha="center", color="0.4")
            a.set_xticks([])
            a.spines["bottom"].set_visible(False)
            continue
        sets = {
            METHOD_TITLES[method]: parameters(condition, method)
            for method in PUBLISHED_METHODS
            if not _mark(condition, method)
        }
        sets["ours"] = runs[condition.name]["parameters"]
        for name, values in sets.items():
            draw_loop(a, values, condition, against, label=name, **_STYLES[name])
        a.locator_params(axis="x", nbins=5)
    document.legend_above(axes[0, 0], 3)
    return picture


# -- dependencies ----------------------------------------------------------------------------------

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


def dependency_part(campaign: Campaign) -> Iterator[document.Chapter]:
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
    yield chapter(
        "dependency",
        "Dependency on current, frequency, displacement and temperature",
        f"the peak force falls by {drop:.1f} % from 28 to 71 °C (thesis 26 %), the velocity rises "
        f"by {stroke:.4f} m/s per 2.5 mm (thesis 0.015 m/s).",
        "The forces are those of the loops identified from the re-synthesised runs. The thesis "
        "states few numbers here; the tables compare them with ours. The figures show trends.",
        _loops(
            "current_dependency",
            "Current dependency, 5 mm, 1 Hz (thesis Fig. 29–31). Published sets.",
            [(f"{each.current:.1f} A", each, parameters(each)) for each in CURRENT_SERIES],
        ),
        document.Table(
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
            [(f"{1e3 * each.amplitude:.1f} mm", each, parameters(each)) for each in STROKE_SERIES],
        ),
        comparison("dependency", "Stated dependencies.", values),
        comparison("temperature", "Force of the sets of tables 8 and 9.", heat),
        document.Table(
            "temperature_parameters",
            "Tables 8 and 9, and their difference. The signs of a0, a1, a2, I0, I1, k0 and k5 "
            "differ: the two sets belong to different local minima, so their differences contain "
            "no information about temperature.",
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
    )


def _loops(name: str, caption: str, curves: list[tuple[str, Condition, Array]]) -> document.Picture:
    picture, axes = document.chart(name, caption, (1, 2, 6.6, 2.8))
    for a, against in zip(axes[0], ("displacement", "velocity"), strict=True):
        for number, (label, condition, values) in enumerate(curves):
            draw_loop(a, values, condition, against, label=label, **line(number))
        a.set(xlabel=ACROSS[against], ylabel="Force [N]")
    axes[0, 1].legend(loc="upper left")
    return picture


def _span_figure(groups: dict[str, Any]) -> document.Picture:
    picture, axes = document.chart(
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
