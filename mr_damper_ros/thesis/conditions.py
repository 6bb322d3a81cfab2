"""All conditions: both published sets, our own identification of the run, and their loops.

Thesis tables 15-40, figures 55, 57, 60-90.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mr_damper_ros.damper.published import LITERATURE
from mr_damper_ros.damper.sigmoid import (
    COEFFICIENT_NAMES,
    PARAMETER_NAMES,
)
from mr_damper_ros.identification.fit import fit_window
from mr_damper_ros.rig.thesis import CONDITIONS, METHODS, find, parameters
from mr_damper_ros.thesis.campaign import Campaign
from mr_damper_ros.thesis.errata import METHOD_TITLES, find_errata
from mr_damper_ros.thesis.report import Block, Picture, Table, Text
from mr_damper_ros.thesis.runs import loop, window
from mr_damper_ros.thesis.style import DASHES, INK, legend_above, panels

COEFFICIENT_UNITS = ("N", "s/m", "s/m", "s/m", "m/s", "m/s", "N")


def identify(name: str, seed: int) -> dict[str, Any]:
    """Task: seven coefficients of one run by Nelder-Mead, and the error of every set on it."""
    w = window(name, seed)
    condition = find(name)
    fit = fit_window(w, LITERATURE)
    own = loop(fit.parameters, condition).force

    published = {}
    for method in METHODS:
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
    tasks = [{"name": name, "seed": campaign.settings.seed} for name in names]
    return dict(zip(names, campaign.each("conditions", identify, tasks), strict=True))


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
        run["published"][METHODS[0]]["difference"]
        for name, run in data["runs"].items()
        if not _mark(data, name, METHODS[0])
    ]
    return (
        f"in {len(sound)} sound conditions our loop is within {100 * max(sound):.2f} % of the "
        "published Nelder–Mead loop."
    )


def show(data: dict[str, Any]) -> list[Block]:
    """Text, tables and figures of the section."""
    blocks: list[Block] = [
        Text(
            "One set of seven operating-point coefficients per run, found by Nelder–Mead from the "
            "literature set, beside the loops of both published sets. A run is made from the "
            "Nelder–Mead set, so ours must agree with that one to within the noise; the difference "
            "to the DE loop shows how far the two published sets are apart. * marks a row in error "
            "(see the section on errata)."
        ),
        _overview(data),
        _coefficients(data),
        _published(data),
        Text(
            "Loops of all conditions, current by current (thesis figures 57 and 60–90). Lines: "
            "Nelder–Mead set (black), DE set (dashed), ours (dotted). Rows in error are not drawn."
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
        nelder, evolved = (run["published"][method] for method in METHODS)
        rows.append(
            (
                name.replace("_", " ") + _mark(data, name, METHODS[0]),
                run["maximum"],
                nelder["maximum"],
                run["minimum"],
                nelder["minimum"],
                100.0 * nelder["difference"],
                f"{100.0 * evolved['difference']:.2f}{_mark(data, name, METHODS[1])}",
                run["rmse"],
                100.0 * run["nrmse"],
            )
        )
    return Table(
        "conditions",
        "Peak forces of our identified loops beside those of the thesis' Nelder–Mead sets, and the "
        "distance of our loop from both published loops.",
        (
            "Condition",
            "Max ours [N]",
            "Max thesis [N]",
            "Min ours [N]",
            "Min thesis [N]",
            "From NM [%]",
            "From DE [%]",
            "RMSE [N]",
            "NRMSE [%]",
        ),
        rows,
    )


def _coefficients(data: dict[str, Any]) -> Table:
    rows = [
        (
            name.replace("_", " ") + _mark(data, name, METHODS[0]),
            *(
                f"{value:.4g} ± {error:.1g}".replace("-", "−")
                for value, error in zip(run["coefficients"], run["errors"], strict=True)
            ),
        )
        for name, run in data["runs"].items()
    ]
    heads = tuple(f"{n} [{u}]" for n, u in zip(COEFFICIENT_NAMES, COEFFICIENT_UNITS, strict=True))
    return Table(
        "coefficients",
        "What one run determines: seven coefficients with standard errors, every condition.",
        ("Condition", *heads),
        rows,
    )


def _published(data: dict[str, Any]) -> Table:
    rows: list[tuple[str | float, ...]] = [
        (
            condition.name.replace("_", " "),
            METHOD_TITLES[method] + _mark(data, condition.name, method),
            *(float(x) for x in parameters(condition, method)),
        )
        for condition in CONDITIONS
        for method in METHODS
    ]
    return Table(
        "published_parameters",
        "The published sets (tables 17–40). Their loops agree, their parameters do not: a single "
        "run does not determine sixteen parameters.",
        ("Condition", "Method", *PARAMETER_NAMES),
        rows,
    )


def _loops(data: dict[str, Any], current: float, against: str) -> Picture:
    conditions = [c for c in CONDITIONS if c.current == current]
    amplitudes = sorted({c.amplitude for c in CONDITIONS})
    frequencies = sorted({c.frequency for c in CONDITIONS})
    figure, axes = panels(3, 3, 6.8, 6.0, sharey=True)
    scale, label = (1.0, "Velocity [m/s]") if against == "velocity" else (1e3, "Displacement [mm]")
    for i, amplitude in enumerate(amplitudes):
        for j, frequency in enumerate(frequencies):
            a = axes[i, j]
            matches = [
                c for c in conditions if (c.amplitude, c.frequency) == (amplitude, frequency)
            ]
            a.set_title(f"{1e3 * amplitude:.1f} mm, {frequency:g} Hz")
            if not matches or f"{matches[0].name} {METHODS[0]}" in data["errata"]:
                a.text(
                    0.5,
                    0.5,
                    "in error" if matches else "not tested",
                    transform=a.transAxes,
                    ha="center",
                    color="0.4",
                )
                a.set_xticks([])
                a.spines["bottom"].set_visible(False)
                continue
            condition = matches[0]
            for number, method in enumerate(METHODS):
                if f"{condition.name} {method}" in data["errata"]:
                    continue
                turn = loop(parameters(condition, method), condition)
                x = scale * getattr(turn, against)
                a.plot(
                    x,
                    turn.force,
                    ls=DASHES[number],
                    color=(INK[0], INK[1])[number],
                    lw=(1.8, 1.2)[number],
                    label=METHOD_TITLES[method],
                )
            own = loop(np.array(data["runs"][condition.name]["parameters"]), condition)
            a.plot(
                scale * getattr(own, against), own.force, ls=DASHES[2], color="0.75", label="ours"
            )
            a.locator_params(axis="x", nbins=5)
    for a in axes[-1]:
        a.set_xlabel(label)
    for a in axes[:, 0]:
        a.set_ylabel("Force [N]")
    legend_above(figure, axes[0, 0], 3)
    return Picture(
        f"loops_{against}_{current:.1f}A",
        f"Force over {against} at {current:.1f} A.",
        figure,
    )
