"""The force laws compared: a set for each record, and one set for all conditions.

The first chapter identifies the reviewed models from each re-synthesised run and, where they are
given, from each real record (thesis 2.5, table 2). The second identifies one set of the sigmoid
law, and of the extended law (lag, stiffness, offset), from all runs.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.sigmoid.following import EXTENDED_MODEL, EXTENDED_NAMES
from mr_damper_ros.report import document
from studies import recordings
from studies.drawing import bars, chapter, line
from studies.program import Campaign
from studies.recordings import processed, window_of
from studies.thesis import facts
from studies.thesis.errata import sound_conditions
from studies.thesis.runs import ACROSS, title, window

Results = dict[str, Any]
"""Results by name of the run or record."""


def _samples(whole: Window, cycles: float) -> int:
    """Number of samples in some cycles of a sine."""
    assert whole.motion.sine is not None
    return round(cycles / whole.motion.sine.frequency / whole.period)


# -- a set for each record -------------------------------------------------------------------------

SAMPLES = 500
"""Approximate number of evenly spaced fitted samples, which limits the time; the error is that of
the whole record."""

_SHOWN = "5.0mm_1Hz_0.5A"
_QUICK = ("7.5mm_3Hz_0.0A", _SHOWN, "2.5mm_3Hz_1.5A")


def judge_run(name: str, noise_seed: int) -> dict[str, Any]:
    """Task: all models on a re-synthesised run; two cycles are fitted."""
    whole = window(name, noise_seed)
    return _judged(whole.part(slice(0, _samples(whole, 2.0))), whole)


def judge_record(path: Path) -> dict[str, Any]:
    """Task: all models on a real record."""
    whole = window_of(processed(path)[1])
    return _judged(whole, whole)


def _judged(part: Window, whole: Window) -> dict[str, Any]:
    """Every model fitted to a part of a record, and its error on the whole record.

    Times are processor times [s].
    """
    fitted, results = part.thinned(SAMPLES), {}
    for name, model in MODELS.items():
        times = [time.process_time()]
        fit = fit_window(model, fitted, model.initial_values()[0], method="least_squares")
        times.append(time.process_time())
        model.force(fit.parameters, whole.motion, whole.current, whole.period)
        times.append(time.process_time())
        residual = model.window_force(whole, fit.parameters) - whole.force
        results[name] = {
            "parameters": fit.parameters,
            "nrmse": float(np.sqrt(np.mean(residual**2)) / np.std(whole.force)),
            "evaluations": fit.evaluations,
            "seconds": times[1] - times[0],
            "seconds_per_sample": (times[2] - times[1]) / whole.sample_count,
        }
    return results


def judged(campaign: Campaign) -> tuple[Results, Results]:
    """Results of all models for the re-synthesised runs and for the real records."""
    names = [condition.name for condition in sound_conditions()]
    if campaign.quick:
        names = [name for name in names if name in _QUICK]
    runs = campaign.each("models", judge_run, names, noise_seed=campaign.seed)
    utfsm = recordings.folder()
    paths = [] if utfsm is None else sorted((utfsm / "processed").glob("*.txt"))
    paths = paths[::7] if campaign.quick else paths
    records = campaign.each("models_recorded", judge_record, paths)
    return runs, {path.stem: result for path, result in records.items()}


def _of(group: Results, law: str, key: str = "nrmse") -> list[float]:
    return [entry[law][key] for entry in group.values()]


def models_part(campaign: Campaign) -> Iterator[document.Chapter]:
    """The chapter on the reviewed models."""
    runs, records = judged(campaign)
    group, kind = (records, "real") if records else (runs, "re-synthesised")
    errors = {model.title: 100.0 * np.median(_of(group, law)) for law, model in MODELS.items()}
    best, worst = (of(errors, key=errors.__getitem__) for of in (min, max))
    rows = []
    for law, model in MODELS.items():
        seconds, evaluations, per_sample = (
            float(np.median(_of(runs, law, key)))
            for key in ("seconds", "evaluations", "seconds_per_sample")
        )
        rows.append(
            (
                *(model.title, len(model.free_in_one_run)),
                *(100.0 * float(of(_of(runs, law))) for of in (np.median, np.max)),
                100.0 * float(np.median(_of(records, law))) if records else None,
                *(facts.MODEL_ERRORS.get(law), 1e3 * seconds, evaluations, 1e6 * per_sample),
            )
        )
    note = (
        f"Real recordings: {len(records)} records of utfsm, another damper of an unstated type in "
        "an MTS press, ramps included; MIT licence, © 2022 mequiroz."
        if records
        else "The real recordings (utfsm: another damper, of an unstated type, in an MTS press) "
        "are missing, because the variable MR_DAMPER_DATA is not set."
    )
    yield chapter(
        "models",
        "Comparison of the reviewed models",
        f"on {len(group)} {kind} records the {best} model is best (median NRMSE {errors[best]:.1f} "
        f"%), {worst} worst ({errors[worst]:.1f} %).",
        "Every model is fitted to each record separately, by bounded least squares on about "
        f"{SAMPLES} samples, from starts derived from the record; the error is that of the whole "
        "record. The re-synthesised runs were made with the sigmoid law, so it must be "
        "best there; only real recordings show which model describes a damper. " + note,
        document.Table(
            "models",
            "Comparison of the models. NRMSE: RMSE over the standard deviation of the force. Table "
            "2 of the thesis quotes estimation errors of Yaakub et al. (2020). Neither source "
            "states their measure, so only their order can be compared. Times are processor times "
            "on the computer that made this report.",
            f"Model | Free parameters | NRMSE, {len(runs)} runs, median [%] | Largest [%] | "
            "NRMSE, real, median [%] | Table 2 | Time per identification [ms] | Evaluations | "
            "Time per sample [µs]",
            rows,
        ),
        _models_figure(runs, records),
        _model_loops(runs[_SHOWN], campaign.seed),
        document.Table(
            "model_parameters",
            f"Identified parameters of {title(_SHOWN)}.",
            "Model | Parameters",
            [
                (model.title, _values(law, runs[_SHOWN][law]["parameters"]))
                for law, model in MODELS.items()
            ],
        ),
        document.Table(
            "model_sources",
            "Sources.",
            "Model | Parameters and units | Source",
            [
                (
                    model.title,
                    ", ".join(f"{p.name} [{p.unit}]" for p in model.parameters),
                    model.source,
                )
                for model in MODELS.values()
            ],
        ),
    )


def _values(law: str, values: np.ndarray) -> str:
    """Values and units of the free parameters of a law."""
    told = (
        f"{p.name} = {values[k]:.4g} {p.unit if p.unit != '1' else ''}".strip()
        for k, p in enumerate(MODELS[law].parameters)
        if p.name in MODELS[law].free_in_one_run
    )
    return ", ".join(told).replace("-", "−")


def _models_figure(runs: Results, records: Results) -> document.Picture:
    groups = {"re-synthesised runs": runs}
    if records:
        groups["real recordings (utfsm)"] = records
    picture, axes = document.chart(
        "models",
        "Error of every model on every record (ticks) and its median (diamonds).",
        (1, len(groups), 3.8 + 3.2 * (len(groups) - 1), 2.8),
        "NRMSE [%]",
        sharey=True,
    )
    laws = list(MODELS)[::-1]
    for a, (label, group) in zip(axes[0], groups.items(), strict=True):
        for place, law in enumerate(laws):
            errors = 100.0 * np.array(_of(group, law))
            a.plot(errors, [place] * errors.size, "|", color=document.GREY, ms=8, mew=1.0)
            a.plot(np.median(errors), place, document.MARKS[3], color=document.INK[1], ms=4.5)
        a.set_xscale("log")
        a.set_title(label)
        a.set_yticks(range(len(laws)), [MODELS[law].title for law in laws])
        low, high = a.get_xlim()
        kept = [t for t in (0.5, 1, 2, 5, 10, 20, 50, 100) if low <= t <= high]
        a.set_xticks(kept, [f"{t:g}" for t in kept])
        a.minorticks_off()
    return picture


def _model_loops(found: dict[str, Any], noise_seed: int) -> document.Picture:
    picture, axes = document.chart(
        "model_loops",
        f"Loops of the models (lines) on {title(_SHOWN)}, re-synthesised (dots).",
        (2, 4, 7.2, 3.9),
        *(ACROSS["velocity"], "Force [N]"),
        sharex=True,
        sharey=True,
    )
    whole = window(_SHOWN, noise_seed)
    # The third cycle, settled.
    turn = whole.part(slice(_samples(whole, 2.0), _samples(whole, 3.0)))
    v = turn.motion.velocity[::4]
    for a, (law, model) in zip(axes.ravel(), MODELS.items(), strict=False):
        force = model.window_force(turn, found[law]["parameters"])[::4]
        a.plot(v, turn.force[::4], ".", ms=2, color=document.GREY)
        a.plot([*v, v[0]], [*force, force[0]], color=document.INK[0])
        a.set_title(model.title, fontsize=7.5)
    return picture


# -- one set for all conditions --------------------------------------------------------------------

LAWS = ("sigmoid", EXTENDED_MODEL)

_OPEN = 100.0
"""Standard error, relative to the value, above which a parameter counts as unknown."""


def fit_runs(law: str, names: list[str], noise_seed: int, keep: int) -> dict[str, Any]:
    """Task: one set of a law for all re-synthesised runs, from every ``keep``-th sample."""
    windows = [window(name, noise_seed).part(slice(None, None, keep)) for name in names]
    start = MODELS[law].initial_values()[0]
    began = time.process_time()
    fit = identify_global(MODELS[law], windows, start, EvolutionSettings())
    return {
        "parameters": fit.parameter_set.values,
        "errors": fit.parameter_set.standard_errors,
        "nrmse": fit.nrmse,
        "rmse": fit.nrmse * np.array([np.std(w.force) for w in windows]),
        "evaluations": fit.evaluations,
        "seconds": time.process_time() - began,
    }


def identified(campaign: Campaign) -> tuple[list[str], dict[str, Any], int]:
    """Names of the runs, one set for all of them by law, and the stride of the samples used.

    Neighbouring samples of a run at 1 kHz add little to a fit of all runs.
    """
    names, keep = [condition.name for condition in sound_conditions()], 16 if campaign.quick else 4
    common = {"names": names, "noise_seed": campaign.seed, "keep": keep}
    return names, campaign.each("one_set", fit_runs, LAWS, **common), keep


def one_set_part(campaign: Campaign) -> Iterator[document.Chapter]:
    """The chapter on one set for all conditions."""
    names, fits, keep = identified(campaign)
    own, _ = judged(campaign)
    one, each = (
        {law: 100.0 * float(np.median(errors)) for law, errors in zip(LAWS, every, strict=True)}
        for every in ((fit["nrmse"] for fit in fits.values()), (_of(own, law) for law in LAWS))
    )
    plain, extended = one.values()
    errors = np.array([e for fit in fits.values() for e in (fit["rmse"], 100.0 * fit["nrmse"])])
    yield chapter(
        "one-set",
        "Beyond the thesis: one set for all conditions",
        f"one set of sixteen parameters for all conditions has a median NRMSE of {plain:.1f} % "
        f"({extended:.1f} % with lag, stiffness and offset) on the re-synthesised runs, whose "
        "noise is below 1 %.",
        f"One set for all {len(names)} sound conditions was identified by the global method of "
        "this package (differential evolution for the laws of the coefficients, then least squares "
        f"on every {keep}th sample). The thesis has one set per condition and says that each "
        "condition needs its own parameters. The fit is poor without current: the law couples the "
        "offset of the force to the yield force, but from 0 to 1.5 A (5 mm, 1 Hz) the yield force "
        "grows by a factor of seventeen and the offset by almost two. A separate offset improves "
        "this, but no set of either law fits all conditions to the noise. A part of the error is "
        "caused by the data: the runs are made from sets that were identified separately, and the "
        "thesis does not state the temperature of the damper. The median error is "
        f"{plain / each['sigmoid']:.0f} times the median error of separate sets. One set of every "
        "law for the real recordings is in the report of `make truth`.",
        document.Table(
            "one_set",
            "One set for all, and the median for separate sets of each run (section on models). "
            "Time: processor time on the computer that made this report.",
            "Law | Parameters | Conditions | NRMSE, median [%] | Largest [%] | "
            "Separate sets, median [%] | Evaluations | Time [s]",
            [
                (
                    *(MODELS[law].title, len(fit["parameters"]), len(names), one[law]),
                    *(100.0 * float(fit["nrmse"].max()), each[law]),
                    *(fit["evaluations"], fit["seconds"]),
                )
                for law, fit in fits.items()
            ],
        ),
        _errors_figure(names, fits),
        _loops_figure(names, fits, campaign.seed),
        _parameters(fits),
        document.Table(
            "one_set_errors",
            "Error of the one set, by condition.",
            "Condition | Sigmoid, RMSE [N] | Sigmoid, NRMSE [%] | Extended, RMSE [N] | "
            "Extended, NRMSE [%]",
            [
                (title(name), *(float(x) for x in row))
                for name, row in zip(names, errors.T, strict=True)
            ],
        ),
    )


def _parameters(fits: dict[str, Any]) -> document.Table:
    units = MODELS[EXTENDED_MODEL].units
    rows = []
    for place, name in enumerate(EXTENDED_NAMES):
        cells = []
        for fit in fits.values():
            cell = ""
            if place < len(fit["parameters"]):
                value, error = (float(fit[key][place]) for key in ("parameters", "errors"))
                cell = f"{document.shown(value)}, open"
                if 0.0 < error <= _OPEN * abs(value):
                    cell = document.with_error(value, error)
            cells.append(cell)
        rows.append((name, units[name], *cells))
    return document.Table(
        "one_set_parameters",
        "The sets with their standard errors, which follow from the misfit. “Open”: the data do "
        "not determine the parameter.",
        "Parameter | Unit | Sigmoid | Extended",
        rows,
    )


def _errors_figure(names: list[str], fits: dict[str, Any]) -> document.Picture:
    picture, ((a,),) = document.chart(
        "one_set",
        "Error of one set in every sound condition, re-synthesised.",
        (1, 1, 7.0, 3.0),
        up="NRMSE [%]",
    )
    errors = {MODELS[law].title: 100.0 * fit["nrmse"] for law, fit in fits.items()}
    bars(a, errors, ("0.75", "0.25"))
    a.set_xticks(range(len(names)), list(map(title, names)), rotation=90, fontsize=6.5)
    a.set_xlim(-0.8, len(names) - 0.2)
    document.legend_above(a, 2)
    return picture


def _loops_figure(names: list[str], fits: dict[str, Any], noise_seed: int) -> document.Picture:
    picture, axes = document.chart(
        "one_set_loops",
        "One set for all conditions, in the conditions in which the sigmoid law has the smallest, "
        "the median and the largest error.",
        (1, 3, 7.0, 2.7),
        *(ACROSS["velocity"], "Force [N]"),
    )
    order = np.argsort(fits["sigmoid"]["nrmse"])
    for a, place in zip(axes[0], order[[0, order.size // 2, -1]], strict=True):
        whole = window(names[place], noise_seed)
        cycle = slice(0, _samples(whole, 1.0))
        v = whole.motion.velocity[cycle]
        a.plot(v, whole.force[cycle], ".", ms=2, color=document.GREY, label="run")
        for number, law in enumerate(LAWS):
            force = MODELS[law].window_force(whole, fits[law]["parameters"])[cycle]
            a.plot(v, force, label=MODELS[law].title, **line(number))
        a.set_title(title(names[place]))
        a.locator_params(axis="x", nbins=5)
    document.legend_above(axes[0, 0], 3)
    return picture
