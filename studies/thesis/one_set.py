"""One parameter set for all currents, amplitudes and frequencies, by the package's global method.

The section covers the sigmoid law and the extended law (lag, stiffness, offset), on re-synthesised
runs and on real recordings.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.sigmoid.following import EXTENDED_MODEL, EXTENDED_NAMES
from mr_damper_ros.report import document
from mr_damper_ros.report.document import GREY, Block, Picture, Table, Text, panels
from studies.drawing import bars, heads, line
from studies.program import Campaign
from studies.recordings import processed, window_of
from studies.thesis import model_table
from studies.thesis.errata import sound_conditions
from studies.thesis.runs import title, window

LAWS = ("sigmoid", EXTENDED_MODEL)
GENERATIONS = 500
_KEPT, _QUICK_KEPT = 4, 16
"""Stride of the samples used from a re-synthesised run."""

_OPEN = 100.0
"""Standard error, relative to the value, above which a parameter counts as unknown."""


def resynthesised(
    names: list[str], noise_seed: int, keep: int, law: str, generations: int
) -> dict[str, Any]:
    """Task: one set of a law for all re-synthesised runs."""
    windows = [window(name, noise_seed).part(slice(None, None, keep)) for name in names]
    return _identify(windows, law, generations)


def recorded(paths: list[str], law: str, generations: int) -> dict[str, Any]:
    """Task: one set of a law for all real records."""
    return _identify([window_of(processed(Path(path))[1]) for path in paths], law, generations)


def _identify(windows: list[Window], law: str, generations: int) -> dict[str, Any]:
    start = MODELS[law].initial_values()[0]
    began = time.process_time()
    fit = identify_global(MODELS[law], windows, start, EvolutionSettings(generations=generations))
    spread = np.array([float(np.std(w.force)) for w in windows])
    return {
        "parameters": fit.parameter_set.values.tolist(),
        "errors": [None if np.isnan(x) else float(x) for x in fit.parameter_set.standard_errors],
        "nrmse": fit.nrmse.tolist(),
        "rmse": (fit.nrmse * spread).tolist(),
        "evaluations": fit.evaluations,
        "seconds": time.process_time() - began,
    }


def identified(campaign: Campaign) -> dict[str, Any]:
    """Result of :func:`resynthesised` by law, and the names of the runs."""
    names = [condition.name for condition in sound_conditions()]
    keep = _QUICK_KEPT if campaign.quick else _KEPT
    common = {"names": names, "noise_seed": campaign.seed, "keep": keep, "generations": GENERATIONS}
    fits = campaign.each_kept("one_set", resynthesised, [{**common, "law": law} for law in LAWS])
    return {"names": names, "kept": keep, "laws": dict(zip(LAWS, fits, strict=True))}


def compute(campaign: Campaign) -> dict[str, Any]:
    """Data of the section."""
    data: dict[str, Any] = {"runs": identified(campaign), "records": None}
    paths = model_table.records(campaign)
    if paths:
        given = [str(path) for path in paths]
        tasks = [{"paths": given, "law": law, "generations": GENERATIONS} for law in LAWS]
        fits = campaign.each_kept("one_set_recorded", recorded, tasks)
        data["records"] = {
            "names": [path.stem for path in paths],
            "laws": dict(zip(LAWS, fits, strict=True)),
        }
    data["seed"] = campaign.seed
    data["each"] = _each(campaign)
    return data


def _each(campaign: Campaign) -> dict[str, dict[str, float]]:
    """Median NRMSE of a set for each run or record, by kind and law."""
    own = model_table.compute(campaign)
    return {
        kind: {
            law: float(np.median([entry["models"][law]["nrmse"] for entry in own[kind].values()]))
            for law in LAWS
        }
        for kind in ("runs", "records")
        if own[kind] is not None
    }


def headline(data: dict[str, Any]) -> str:
    """The result in a sentence."""

    def medians(part: dict[str, Any]) -> str:
        plain, extended = (100.0 * float(np.median(part["laws"][law]["nrmse"])) for law in LAWS)
        return f"{plain:.1f} % ({extended:.1f} % with lag, stiffness and offset)"

    real = data["records"]
    return (
        "one set of sixteen parameters for all conditions has a median NRMSE of "
        f"{medians(data['runs'])} on the re-synthesised runs, whose noise is below 1 %"
        + (
            "."
            if real is None
            else f", and of {medians(real)} on {len(real['names'])} real records."
        )
    )


def show(data: dict[str, Any]) -> list[Block]:
    """Text, tables and figures of the section."""
    runs, real = data["runs"], data["records"]
    rows = []
    for kind, label in (("runs", "re-synthesised"), ("records", "real (utfsm)")):
        if data[kind] is None:
            continue
        for law in LAWS:
            fit = data[kind]["laws"][law]
            percent = 100.0 * np.array(fit["nrmse"])
            rows.append(
                (
                    *(MODELS[law].title, label, len(fit["parameters"]), len(percent)),
                    *(float(np.median(percent)), float(np.max(percent))),
                    *(100.0 * data["each"][kind][law], fit["evaluations"], fit["seconds"]),
                )
            )
    blocks: list[Block] = [
        Text(
            f"One set for all {len(runs['names'])} sound conditions was identified by the global "
            "method of this package (differential evolution for the laws of the coefficients, then "
            f"least squares on every {runs['kept']}th sample). The thesis has one set per "
            "condition and says that each condition needs its own parameters. The fit is poor "
            "without current: the law couples the offset of the force to the yield force, but from "
            "0 to 1.5 A (5 mm, 1 Hz) the yield force grows by a factor of seventeen and the offset "
            "by almost two. A separate offset improves this, but no set of either law fits all "
            "conditions to the noise. A part of the error is caused by the data: the runs are made "
            "from sets that were identified separately, and the thesis does not state the "
            f"temperature of the damper. The median error is {_ratio(data, 'runs'):.0f} times the "
            "median error of separate sets"
            + (
                ". The real recordings are missing, because the variable MR_DAMPER_DATA is not set."
                if real is None
                else f"; on the real records, {_ratio(data, 'records'):.1f} times."
            )
        ),
        Table(
            "one_set",
            "One set for all, and the median for separate sets of each run or record (section on "
            "models). Time: processor time on the computer that made this report.",
            heads(
                "Law | Data | Parameters | Conditions | NRMSE, median [%] | Largest [%] | "
                "Separate sets, median [%] | Evaluations | Time [s]"
            ),
            rows,
        ),
        _errors_figure(runs, "one_set", "sound condition, re-synthesised"),
        _loops_figure(data),
        _parameters(data),
        _errors(runs, "one_set_errors", "condition"),
    ]
    if real is not None:
        blocks += [
            _errors_figure(real, "one_set_recorded", "real record (utfsm)"),
            _errors(real, "one_set_errors_recorded", "real record (utfsm)"),
        ]
    return blocks


def _ratio(data: dict[str, Any], kind: str) -> float:
    one = float(np.median(data[kind]["laws"]["sigmoid"]["nrmse"]))
    return one / float(data["each"][kind]["sigmoid"])


def _parameters(data: dict[str, Any]) -> Table:
    columns = [
        (f"{label}, {kind}", data[group]["laws"][law])
        for group, kind in (("runs", "re-synthesised"), ("records", "real"))
        if data[group] is not None
        for law, label in zip(LAWS, ("Sigmoid", "Extended"), strict=True)
    ]
    units = MODELS[EXTENDED_MODEL].units
    rows = []
    for place, name in enumerate(EXTENDED_NAMES):
        cells = [
            _with_error(fit["parameters"][place], fit["errors"][place])
            if place < len(fit["parameters"])
            else ""
            for _, fit in columns
        ]
        rows.append((name, units[name], *cells))
    return Table(
        "one_set_parameters",
        "The sets with their standard errors, which follow from the misfit. “Open”: the data do "
        "not determine the parameter.",
        ("Parameter", "Unit", *(head for head, _ in columns)),
        rows,
    )


def _with_error(value: float, error: float | None) -> str:
    if not error or error > _OPEN * abs(value):
        return f"{document.shown(value)}, open"
    return document.with_error(value, error)


def _errors(part: dict[str, Any], name: str, kind: str) -> Table:
    columns = [
        factor * np.array(part["laws"][law][key])
        for law in LAWS
        for key, factor in (("rmse", 1.0), ("nrmse", 100.0))
    ]
    names = heads(
        "Sigmoid, RMSE [N] | Sigmoid, NRMSE [%] | Extended, RMSE [N] | Extended, NRMSE [%]"
    )
    return Table(
        name,
        f"Error of the one set, by {kind}.",
        (kind.capitalize(), *names),
        [
            (_label(key), *map(float, row))
            for key, row in zip(part["names"], np.stack(columns).T, strict=True)
        ],
    )


def _label(name: str) -> str:
    return title(name) if "_" in name else name.replace("x", ".")


def _errors_figure(part: dict[str, Any], name: str, kind: str) -> Picture:
    figure, axes = panels(1, 1, 7.0, 3.0)
    a, x = axes[0, 0], np.arange(len(part["names"]))
    errors = {
        MODELS[law].title: (100.0 * np.array(part["laws"][law]["nrmse"])).tolist() for law in LAWS
    }
    bars(a, errors, ("0.75", "0.25"))
    a.set_xticks(x, [_label(entry) for entry in part["names"]], rotation=90, fontsize=6.5)
    a.set(ylabel="NRMSE [%]", xlim=(-0.8, x.size - 0.2))
    document.legend_above(figure, a, 2)
    return Picture(name, f"Error of one set in every {kind}.", figure)


def _loops_figure(data: dict[str, Any]) -> Picture:
    runs = data["runs"]
    # The best, the median and the worst condition of the sigmoid law.
    order = np.argsort(runs["laws"]["sigmoid"]["nrmse"])
    chosen = [runs["names"][order[place]] for place in (0, len(order) // 2, -1)]
    figure, axes = panels(1, 3, 7.0, 2.7)
    for a, name in zip(axes[0], chosen, strict=True):
        whole = window(name, data["seed"])
        sine = whole.motion.sine
        cycle = slice(
            0, whole.sample_count if sine is None else round(1.0 / sine.frequency / whole.period)
        )
        turn = whole.part(cycle)
        v = turn.motion.velocity
        a.plot(v, turn.force, ".", ms=2, color=GREY, label="run")
        for number, law in enumerate(LAWS):
            values = np.array(runs["laws"][law]["parameters"])
            force = MODELS[law].window_force(whole, values)[cycle]
            a.plot(v, force, label=MODELS[law].title, **line(number))
        a.set(title=title(name), xlabel="Velocity [m/s]")
        a.locator_params(axis="x", nbins=5)
    axes[0, 0].set_ylabel("Force [N]")
    document.legend_above(figure, axes[0, 0], 3)
    return Picture(
        "one_set_loops",
        "One set for all conditions, in the conditions in which the sigmoid law has the smallest, "
        "the median and the largest error.",
        figure,
    )
