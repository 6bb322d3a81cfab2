"""The reviewed models identified from the same records and compared (thesis 2.5, table 2)."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.report.document import GREY, INK, MARKS, Block, Picture, Table, Text, panels
from studies import recordings
from studies.drawing import heads, name_axes
from studies.program import Campaign
from studies.recordings import processed, window_of
from studies.thesis import facts
from studies.thesis.errata import sound_conditions
from studies.thesis.runs import title, window

SAMPLES = 500
"""Approximate number of evenly spaced fitted samples; the error is that of the whole record."""

_CYCLES = 2.0
_SHOWN = "5.0mm_1Hz_0.5A"
_QUICK = ("7.5mm_3Hz_0.0A", "5.0mm_1Hz_0.5A", "2.5mm_3Hz_1.5A")


def _judged(part: Window, whole: Window) -> dict[str, Any]:
    """Every model fitted to a part of a record, and its error on the whole record.

    Times are processor times [s].
    """
    spread = float(np.std(whole.force))
    results = {}
    for name, model in MODELS.items():
        began = time.process_time()
        fit = fit_window(model, part, model.initial_values()[0], method="least_squares")
        fitted = time.process_time()
        model.force(fit.parameters, whole.motion, whole.current, whole.period)
        predicted = time.process_time()
        residual = model.window_force(whole, fit.parameters) - whole.force
        results[name] = {
            "parameters": fit.parameters.tolist(),
            "nrmse": float(np.sqrt(np.mean(residual**2)) / spread),
            "evaluations": fit.evaluations,
            "seconds": fitted - began,
            "seconds_per_sample": (predicted - fitted) / whole.sample_count,
        }
    return results


def resynthesised(name: str, noise_seed: int) -> dict[str, Any]:
    """Task: all models on a re-synthesised run; two cycles are fitted."""
    whole = window(name, noise_seed)
    sine = whole.motion.sine
    frequency = 1.0 if sine is None else sine.frequency
    last = round(_CYCLES / frequency / whole.period)
    results = _judged(whole.part(slice(0, last)).thinned(SAMPLES), whole)
    # One cycle, settled, to be drawn.
    cycle = whole.part(slice(last, last + round(1.0 / frequency / whole.period)))
    shown = None
    if name == _SHOWN:
        shown = {
            "velocity": cycle.motion.velocity[::4].tolist(),
            "force": cycle.force[::4].tolist(),
            "models": {
                key: model.window_force(cycle, np.array(results[key]["parameters"]))[::4].tolist()
                for key, model in MODELS.items()
            },
        }
    return {"models": results, "shown": shown}


def recorded(path: str) -> dict[str, Any]:
    """Task: all models on a real record."""
    whole = window_of(processed(Path(path))[1])
    return {"models": _judged(whole.thinned(SAMPLES), whole)}


def records(campaign: Campaign) -> list[Path]:
    """Files of the real records; none where no recordings are given."""
    utfsm = recordings.folder()
    paths = [] if utfsm is None else sorted((utfsm / "processed").glob("*.txt"))
    return paths[::7] if campaign.quick else paths


def compute(campaign: Campaign) -> dict[str, Any]:
    """Data of the section."""
    names = [condition.name for condition in sound_conditions()]
    if campaign.quick:
        names = [name for name in names if name in _QUICK]
    tasks = [{"name": name, "noise_seed": campaign.seed} for name in names]
    runs = dict(zip(names, campaign.each_kept("models", resynthesised, tasks), strict=True))
    data: dict[str, Any] = {"runs": runs, "records": None}
    paths = records(campaign)
    if paths:
        tasks = [{"path": str(path)} for path in paths]
        results = campaign.each_kept("models_recorded", recorded, tasks)
        data["records"] = dict(zip([path.stem for path in paths], results, strict=True))
    return data


def headline(data: dict[str, Any]) -> str:
    """The result in a sentence."""
    group = data["records"] or data["runs"]
    kind = "real" if data["records"] else "re-synthesised"
    errors = {
        model.title: float(np.median([100.0 * e["models"][name]["nrmse"] for e in group.values()]))
        for name, model in MODELS.items()
    }
    best, worst = min(errors, key=lambda t: errors[t]), max(errors, key=lambda t: errors[t])
    return (
        f"on {len(group)} {kind} records the {best} model is best (median NRMSE "
        f"{errors[best]:.1f} %), {worst} worst ({errors[worst]:.1f} %)."
    )


def show(data: dict[str, Any]) -> list[Block]:
    """Text, tables and figures of the section."""
    runs, records = data["runs"], data["records"]

    def nrmse(group: dict[str, Any], name: str) -> list[float]:
        return [100.0 * entry["models"][name]["nrmse"] for entry in group.values()]

    rows: list[tuple[str | float | None, ...]] = []
    for name, model in MODELS.items():
        ours = [run["models"][name] for run in runs.values()]
        seconds, evaluations, per_sample = (
            float(np.median([fit[key] for fit in ours]))
            for key in ("seconds", "evaluations", "seconds_per_sample")
        )
        rows.append(
            (
                *(model.title, len(model.free_indices)),
                *(float(of(nrmse(runs, name))) for of in (np.median, np.max)),
                None if records is None else float(np.median(nrmse(records, name))),
                *(facts.MODEL_ERRORS.get(name), 1e3 * seconds, evaluations, 1e6 * per_sample),
            )
        )
    note = (
        "The real recordings (utfsm: another damper, of an unstated type, in an MTS press) are "
        "missing, because the variable MR_DAMPER_DATA is not set."
        if records is None
        else f"Real recordings: {len(records)} records of utfsm, another damper of an unstated "
        "type in an MTS press, ramps included; MIT licence, © 2022 mequiroz."
    )
    blocks: list[Block] = [
        Text(
            "Every model is fitted to each record separately, by bounded least squares on about "
            f"{SAMPLES} samples, from starts derived from the record; the error is that of the "
            "whole record. The re-synthesised runs were made with the sigmoid law, so it must be "
            "best there; only real recordings show which model describes a damper. " + note
        ),
        Table(
            "models",
            "Comparison of the models. NRMSE: RMSE over the standard deviation of the force. Table "
            "2 of the thesis quotes estimation errors of Yaakub et al. (2020). Neither source "
            "states their measure, so only their order can be compared. Times are processor times "
            "on the computer that made this report.",
            heads(
                f"Model | Free parameters | NRMSE, {len(runs)} runs, median [%] | Largest [%] | "
                "NRMSE, real, median [%] | Table 2 | Time per identification [ms] | Evaluations | "
                "Time per sample [µs]"
            ),
            rows,
        ),
        _errors_figure(data),
    ]
    if runs.get(_SHOWN, {}).get("shown"):
        blocks.append(_loops_figure(runs[_SHOWN]["shown"]))
    blocks.append(_parameters(data))
    blocks.append(
        Table(
            "model_sources",
            "Sources.",
            ("Model", "Parameters and units", "Source"),
            [
                (
                    model.title,
                    ", ".join(f"{p.name} [{p.unit}]" for p in model.parameters),
                    model.source,
                )
                for model in MODELS.values()
            ],
        )
    )
    return blocks


def _parameters(data: dict[str, Any]) -> Table:
    run = data["runs"][_SHOWN]
    rows = []
    for name, model in MODELS.items():
        values = run["models"][name]["parameters"]
        free = [model.parameter_names[k] for k in model.free_indices]
        text = ", ".join(
            f"{p.name} = {value:.4g} {p.unit if p.unit != '1' else ''}".strip()
            for p, value in zip(model.parameters, values, strict=True)
            if p.name in free
        )
        rows.append((model.title, text.replace("-", "−")))
    return Table(
        "model_parameters",
        f"Identified parameters of {title(_SHOWN)}.",
        ("Model", "Parameters"),
        rows,
    )


def _errors_figure(data: dict[str, Any]) -> Picture:
    records = data["records"]
    groups = [("re-synthesised runs", data["runs"])]
    if records is not None:
        groups.append(("real recordings (utfsm)", records))
    figure, axes = panels(1, len(groups), 3.8 + 3.2 * (len(groups) - 1), 2.8, sharey=True)
    titles = [model.title for model in MODELS.values()][::-1]
    for a, (label, group) in zip(axes[0], groups, strict=True):
        for place, name in enumerate(list(MODELS)[::-1]):
            errors = [100.0 * entry["models"][name]["nrmse"] for entry in group.values()]
            a.plot(errors, [place] * len(errors), "|", color=GREY, ms=8, mew=1.0)
            a.plot(np.median(errors), place, MARKS[3], color=INK[1], ms=4.5)
        a.set_xscale("log")
        a.set(title=label, xlabel="NRMSE [%]")
        a.set_yticks(range(len(titles)), titles)
        low, high = a.get_xlim()
        kept = [t for t in (0.5, 1, 2, 5, 10, 20, 50, 100) if low <= t <= high]
        a.set_xticks(kept, [f"{t:g}" for t in kept])
        a.minorticks_off()
    return Picture(
        "models",
        "Error of every model on every record (ticks) and its median (diamonds).",
        figure,
    )


def _loops_figure(shown: dict[str, Any]) -> Picture:
    figure, axes = panels(2, 4, 7.2, 3.9, sharex=True, sharey=True)
    v = np.array(shown["velocity"])
    for a, (name, force) in zip(axes.ravel(), shown["models"].items(), strict=False):
        a.plot(v, shown["force"], ".", ms=2, color=GREY)
        a.plot([*v, v[0]], [*force, force[0]], color=INK[0])
        a.set_title(MODELS[name].title, fontsize=7.5)
    name_axes(axes, "Velocity [m/s]", "Force [N]")
    return Picture(
        "model_loops",
        f"Loops of the models (lines) on {title(_SHOWN)}, re-synthesised (dots).",
        figure,
    )
