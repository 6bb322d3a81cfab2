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
from mr_damper_ros.models.sigmoid.law import COEFFICIENT_NAMES, PARAMETER_NAMES
from mr_damper_ros.report.document import (
    DASHES,
    INK,
    Block,
    Chapter,
    Picture,
    Table,
    legend_above,
    to_error,
    with_error,
)
from mr_damper_ros.signals.arrays import Array
from studies.drawing import chart, table
from studies.program import Campaign, Part
from studies.thesis.errata import METHOD_TITLES, disagreement, find_errata
from studies.thesis.runs import ACROSS, coefficients, draw_loop, loop, title, top_speed, window

_UNITS = ("N", "s/m", "s/m", "s/m", "mm/s", "mm/s", "N")
COEFFICIENT_UNITS = dict(zip(COEFFICIENT_NAMES, _UNITS, strict=True))
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
    tasks = [{"name": name, "seed": campaign.seed} for name in names]
    return dict(zip(names, campaign.each("conditions", identify, tasks), strict=True))


def _mark(condition: Condition, method: str) -> str:
    return " *" if (condition, method) in find_errata() else ""


def conditions_part(campaign: Campaign) -> Part:
    """The chapter on all conditions."""
    runs = identified(campaign)
    sound = [condition for condition in CONDITIONS if not _mark(condition, _SIMPLEX)]
    worst = max(runs[each.name]["published"][_SIMPLEX]["difference"] for each in sound)
    blocks: list[Block] = [
        "For each run, Nelder–Mead identifies seven operating-point coefficients, starting from "
        "the literature set. The loops are compared with those of both published sets. A run is "
        "synthesised from the Nelder–Mead set, so our loop must agree with its loop to within the "
        "noise; the difference from the DE loop shows how far the published sets differ. * marks a "
        "row in error (see the section on errata).",
        _overview(runs),
        _coefficients(runs, sound),
        table(
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
        blocks += [_loops(runs, current, against) for against in ACROSS]
    told = (
        f"in {len(sound)} sound conditions our loop is within {100 * worst:.2f} % of the published "
        "Nelder–Mead loop."
    )
    return Part([Chapter("conditions", "All conditions", told, blocks)])


def _overview(runs: Runs) -> Table:
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
    return table(
        "conditions",
        "Peak forces of our identified loops and of the Nelder–Mead sets of the thesis, and the "
        "difference between our loop and both published loops.",
        "Condition | Max ours [N] | Max thesis [N] | Min ours [N] | Min thesis [N] | "
        "Difference NM [%] | Difference DE [%] | RMSE [N] | NRMSE [%]",
        rows,
    )


def _coefficients(runs: Runs, sound: list[Condition]) -> Table:
    rows: list[tuple[str, ...]] = []
    for condition in sound:
        run, name = runs[condition.name], title(condition.name)
        ours, errors = (_SCALES * run[key] for key in ("coefficients", "errors"))
        rows.append((name, "ours", *map(with_error, ours, errors)))
        for method in PUBLISHED_METHODS:
            theirs = _SCALES * published_coefficients(condition, method)
            label = METHOD_TITLES[method] + _mark(condition, method)
            rows.append((name, label, *map(to_error, theirs, errors)))
    heads = (f"{name} [{unit}]" for name, unit in COEFFICIENT_UNITS.items())
    return table(
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
        f"Where the loops of both published sets agree to {100 * _AGREEING:.0f} % "
        f"({len(apart)} conditions), f_t agrees to "
        f"{100 * max(change[f_t] for change in changes.values()):.0f} %. The smaller coefficients "
        "may differ, because they compensate for each other, as at "
        f"{title(worst)}, where f_d is {one[f_d]:.1f} and {two[f_d]:.1f} N."
    )


def published_coefficients(condition: Condition, method: str) -> Array:
    """Seven coefficients (7,) of a published set in its condition."""
    values = parameters(condition, method)
    return coefficients(values, top_speed(condition), condition.current)


_STYLES = {
    METHOD_TITLES["nelder_mead"]: {"ls": DASHES[0], "color": INK[0], "lw": 1.8},
    METHOD_TITLES["differential_evolution"]: {"ls": DASHES[1], "color": INK[1], "lw": 1.2},
    "ours": {"ls": DASHES[2], "color": "0.75"},
}


def _loops(runs: Runs, current: float, against: str) -> Picture:
    picture, axes = chart(
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
    legend_above(axes[0, 0], 3)
    return picture
