"""All conditions: both published sets, our own identification of the run, and their loops.

Thesis tables 17-40, figures 60-90.
"""

from __future__ import annotations

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
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.report import document
from mr_damper_ros.report.document import DASHES, INK, Block, Picture, Table, Text, panels
from mr_damper_ros.signals.arrays import Array
from studies.drawing import heads, name_axes
from studies.program import Campaign
from studies.thesis.errata import METHOD_TITLES, disagreement, find_errata
from studies.thesis.runs import coefficients, loop, title, window

COEFFICIENT_UNITS = {
    "f_t": "N",
    "alpha": "s/m",
    "k_c": "s/m",
    "k_e": "s/m",
    "v_h": "mm/s",
    "v_d": "mm/s",
    "f_d": "N",
}
_SCALES = np.array([1e3 if unit == "mm/s" else 1.0 for unit in COEFFICIENT_UNITS.values()])

_AGREEING = 0.02
"""Largest relative norm of the difference between two loops that agree."""

FIGURES = {0.0: "60–67", 0.5: "68–75", 1.0: "76–83", 1.5: "84–90"}
"""Figures of the thesis by current [A] (table 12)."""


def identify(name: str, seed: int) -> dict[str, Any]:
    """Task: seven coefficients of one run by Nelder-Mead, and the error of every set on it."""
    w = window(name, seed)
    condition = find(name)
    fit = fit_window(MODELS["sigmoid"], w, LITERATURE)
    own = loop(fit.parameters, condition).force

    published = {}
    for method in PUBLISHED_METHODS:
        values = parameters(condition, method)
        theirs = loop(values, condition).force
        published[method] = {
            "maximum": float(theirs.max()),
            "minimum": float(theirs.min()),
            "difference": float(np.linalg.norm(own - theirs) / np.linalg.norm(theirs)),
        }
    return {
        "coefficients": fit.coefficients.tolist(),
        "errors": np.sqrt(np.diag(fit.coefficient_covariance)).tolist(),
        "parameters": fit.parameters.tolist(),
        "rmse": fit.rmse,
        "nrmse": fit.nrmse,
        "evaluations": fit.evaluations,
        "maximum": float(own.max()),
        "minimum": float(own.min()),
        "peak_velocity": fit.operating_point[0],
        "published": published,
    }


def identified(campaign: Campaign) -> dict[str, Any]:
    """Result of :func:`identify` by condition."""
    names = [condition.name for condition in CONDITIONS]
    tasks = [{"name": name, "seed": campaign.seed} for name in names]
    return dict(zip(names, campaign.each_kept("conditions", identify, tasks), strict=True))


def compute(campaign: Campaign) -> dict[str, Any]:
    """Data of the section."""
    found = find_errata()
    return {
        "runs": identified(campaign),
        "errata": {f"{c.name} {m}": reasons for (c, m), reasons in found.items()},
    }


def headline(data: dict[str, Any]) -> str:
    """The result in a sentence."""
    sound = [
        run["published"][PUBLISHED_METHODS[0]]["difference"]
        for name, run in data["runs"].items()
        if not _mark(data, name, PUBLISHED_METHODS[0])
    ]
    return (
        f"in {len(sound)} sound conditions our loop is within {100 * max(sound):.2f} % of the "
        "published Nelder–Mead loop."
    )


def show(data: dict[str, Any]) -> list[Block]:
    """Text, tables and figures of the section."""
    blocks: list[Block] = [
        Text(
            "For each run, Nelder–Mead identifies seven operating-point coefficients, starting "
            "from the literature set. The loops are compared with those of both published sets. A "
            "run is synthesised from the Nelder–Mead set, so our loop must agree with its loop to "
            "within the noise; the difference from the DE loop shows how far the published sets "
            "differ. * marks a row in error (see the section on errata)."
        ),
        _overview(data),
        _coefficients(data),
        _published(data),
        Text(
            "The figures show the loops of all conditions, current by current: Nelder–Mead set "
            "(black), DE set (dashed) and our set (light dots on top). Rows in error are not "
            "drawn. The small step of the force in the middle of the stroke belongs to the law: "
            "there the acceleration changes its sign, and the loop changes its branch."
        ),
    ]
    for current in sorted({condition.current for condition in CONDITIONS}):
        blocks += [_loops(data, current, against) for against in ("velocity", "displacement")]
    return blocks


def _mark(data: dict[str, Any], name: str, method: str) -> str:
    return " *" if f"{name} {method}" in data["errata"] else ""


def _overview(data: dict[str, Any]) -> Table:
    rows = []
    for name, run in data["runs"].items():
        nelder, evolved = (run["published"][method] for method in PUBLISHED_METHODS)
        marks = [_mark(data, name, method) for method in PUBLISHED_METHODS]
        rows.append(
            (
                title(name) + marks[0],
                *(each[end] for end in ("maximum", "minimum") for each in (run, nelder)),
                100.0 * nelder["difference"],
                f"{100.0 * evolved['difference']:.2f}{marks[1]}",
                *(run["rmse"], 100.0 * run["nrmse"]),
            )
        )
    return Table(
        "conditions",
        "Peak forces of our identified loops and of the Nelder–Mead sets of the thesis, and the "
        "difference between our loop and both published loops.",
        heads(
            "Condition | Max ours [N] | Max thesis [N] | Min ours [N] | Min thesis [N] | "
            "Difference NM [%] | Difference DE [%] | RMSE [N] | NRMSE [%]"
        ),
        rows,
    )


def _coefficients(data: dict[str, Any]) -> Table:
    rows: list[tuple[str, ...]] = []
    for condition in CONDITIONS:
        if _mark(data, condition.name, PUBLISHED_METHODS[0]):
            continue
        run = data["runs"][condition.name]
        ours, errors = (_SCALES * np.array(run[key]) for key in ("coefficients", "errors"))
        rows.append((title(condition.name), "ours", *map(document.with_error, ours, errors)))
        for method in PUBLISHED_METHODS:
            theirs = _SCALES * published_coefficients(condition, method)
            mark = _mark(data, condition.name, method)
            label = METHOD_TITLES[method] + mark
            rows.append((title(condition.name), label, *map(document.to_error, theirs, errors)))
    heads = (f"{name} [{unit}]" for name, unit in COEFFICIENT_UNITS.items())
    return Table(
        "coefficients",
        "The seven coefficients that one run determines, with standard errors, in every sound "
        "condition, and the coefficients of both published sets (to the same digits). "
        + _agreement(data),
        ("Condition", "Set", *heads),
        rows,
    )


def _agreement(data: dict[str, Any]) -> str:
    """Agreement, in words, of the coefficients of published sets whose loops agree."""
    f_t, f_d = (list(COEFFICIENT_UNITS).index(name) for name in ("f_t", "f_d"))
    apart: dict[str, tuple[Array, Array]] = {}
    for condition in CONDITIONS:
        if any(_mark(data, condition.name, method) for method in PUBLISHED_METHODS):
            continue
        if disagreement(condition) < _AGREEING:
            one, two = (published_coefficients(condition, method) for method in PUBLISHED_METHODS)
            apart[condition.name] = one, two
    worst = max(apart, key=lambda name: _change(*apart[name], f_d))
    one, two = apart[worst]
    return (
        f"Where the loops of both published sets agree to {100 * _AGREEING:.0f} % "
        f"({len(apart)} conditions), f_t agrees to "
        f"{100 * max(_change(*pair, f_t) for pair in apart.values()):.0f} %. The smaller "
        "coefficients may differ, because they compensate for each other, as at "
        f"{title(worst)}, where f_d is {one[f_d]:.1f} and {two[f_d]:.1f} N."
    )


def _change(one: Array, two: Array, place: int) -> float:
    return abs(float(two[place] / one[place]) - 1.0)


def published_coefficients(condition: Condition, method: str) -> Array:
    """Seven coefficients (7,) of a published set in its condition."""
    top_speed = 2.0 * np.pi * condition.frequency * condition.amplitude
    return coefficients(parameters(condition, method), top_speed, condition.current)


def _published(data: dict[str, Any]) -> Table:
    rows = [
        (
            title(condition.name),
            METHOD_TITLES[method] + _mark(data, condition.name, method),
            *(f"{x:.8g}" for x in parameters(condition, method)),
        )
        for condition in CONDITIONS
        for method in PUBLISHED_METHODS
    ]
    return Table(
        "published_parameters",
        "The published sets (tables 17–40), in the units of the thesis. The loops of both methods "
        "agree but their parameters differ: a single run does not determine sixteen parameters.",
        ("Condition", "Method", *PARAMETER_NAMES),
        rows,
    )


_STYLES = {
    METHOD_TITLES["nelder_mead"]: (DASHES[0], INK[0], 1.8),
    METHOD_TITLES["differential_evolution"]: (DASHES[1], INK[1], 1.2),
    "ours": (DASHES[2], "0.75", None),
}


def _loops(data: dict[str, Any], current: float, against: str) -> Picture:
    figure, axes = panels(3, 3, 6.8, 6.0, sharey=True)
    scale, label = (1.0, "Velocity [m/s]") if against == "velocity" else (1e3, "Displacement [mm]")
    amplitudes = sorted({c.amplitude for c in CONDITIONS})
    frequencies = sorted({c.frequency for c in CONDITIONS})
    found = {(c.amplitude, c.frequency): c for c in CONDITIONS if c.current == current}
    for a, key in zip(axes.ravel(), product(amplitudes, frequencies), strict=True):
        a.set_title(f"{1e3 * key[0]:.1f} mm, {key[1]:g} Hz")
        condition = found.get(key)
        if condition is None or _mark(data, condition.name, PUBLISHED_METHODS[0]):
            words = "not tested" if condition is None else "in error"
            a.text(0.5, 0.5, words, transform=a.transAxes, ha="center", color="0.4")
            a.set_xticks([])
            a.spines["bottom"].set_visible(False)
            continue
        sets = {
            METHOD_TITLES[method]: parameters(condition, method)
            for method in PUBLISHED_METHODS
            if not _mark(data, condition.name, method)
        }
        sets["ours"] = np.array(data["runs"][condition.name]["parameters"])
        for name, values in sets.items():
            turn, (dashes, colour, width) = loop(values, condition), _STYLES[name]
            style = {"ls": dashes, "color": colour, "lw": width, "label": name}
            a.plot(scale * getattr(turn, against), turn.force, **style)
        a.locator_params(axis="x", nbins=5)
    name_axes(axes, label, "Force [N]")
    document.legend_above(figure, axes[0, 0], 3)
    return Picture(
        f"loops_{against}_{current:.1f}A",
        f"Force over {against} at {current:.1f} A (thesis Fig. {FIGURES[current]}).",
        figure,
    )
