"""Accuracy of the laws on the recordings: one set for all, motions left out, earthquakes."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.api.details import parameter_estimates
from mr_damper_ros.api.replay import replay
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.io.records import read_runs
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.files import json_ready
from mr_damper_ros.report import document
from mr_damper_ros.signals.arrays import Array
from studies import recordings
from studies.drawing import chapter, draw_rows, line, name_rows
from studies.program import Campaign

_RAW_COLUMNS = "time:0.005*s,-,force:980.665*N,displacement:10*mm"
_RAW_CURRENTS = (0.0, 0.25, 0.5, 0.75, 1.0)
_BLOCK = 10


def judge_records(law: str, left_out: str | None, utfsm: Path, every: int) -> dict[str, Any]:
    """Task: identify the law, and predict records as the model node does.

    If a motion is left out, its records are evaluated, and the peak velocity is held within the
    range of the others. Otherwise all records and the raw records of the logger are evaluated.
    ``every`` is the stride over the currents of a motion. Returns the ``set``, the ``nrmse`` [1] of
    the evaluated and of the ``raw`` records, by name, and the ``seconds`` of the identification.
    """
    motions = {
        motion: windows[::every] for motion, windows in recordings.processed_motions(utfsm).items()
    }
    began = time.process_time()
    windows = [w for motion, each in motions.items() if motion != left_out for w in each]
    start = MODELS[law].initial_values()[0]
    found = identify_global(MODELS[law], windows, start, EvolutionSettings()).parameter_set
    seconds = time.process_time() - began
    judged = motions if left_out is None else {left_out: motions[left_out]}
    nrmse = {}
    for motion, windows in judged.items():
        for window in windows:
            error = recordings.rms(_left(found, window)) / float(np.std(window.force))
            nrmse[f"{motion}, {window.current[0]:g} A"] = error
    raw = {} if left_out is not None else _raw_errors(found, utfsm)
    return {"set": found, "nrmse": nrmse, "raw": raw, "seconds": seconds}


def _left(found: ParameterSet, window: Window) -> Array:
    """Force error [N] of a set at the settled samples of a window."""
    return np.asarray((found.window_force(window) - window.force)[found.settled(window)])


def _raw_errors(found: ParameterSet, utfsm: Path) -> dict[str, float]:
    """NRMSE of the raw logger records without means, because their force offset is unknown."""
    errors = {}
    for path in sorted((utfsm / "raw").glob("*.txt")):
        for run in read_runs(path, _RAW_COLUMNS, currents=_RAW_CURRENTS):
            window = recordings.window_of(run)
            name = f"{path.stem.removeprefix('ME')}, {run.current[0]:g} A"
            errors[name] = float(np.std(_left(found, window)) / np.std(window.force))
    return errors


def judge_earthquake(
    known: ParameterSet, current: float, follows: bool, utfsm: Path, longest: float
) -> dict[str, Any]:
    """Task: undo the smoothing of a record, and predict at most ``longest`` [s] block by block.

    ``follows`` says whether the identifier runs. Returns the ``fit`` [%] and ``series`` (3, n):
    time [s], measured and predicted force [N] of some samples.
    """
    record = recordings.unsmoothed_earthquakes(utfsm)[recordings.EARTHQUAKE_CURRENTS.index(current)]
    if longest < record.duration:
        record = recordings.cut(record, slice(0, round(longest / record.period)))
    # Blocks of 20 and of 10, the default, give the same fit to 0.01 %.
    force = replay(record, known, identify=follows, block_size=20).predicted
    passed = record.period * np.arange(force.size)
    # Every fifth sample is enough for the figure.
    series = np.stack([passed, record.force, force])[:, ::5]
    return {"fit": recordings.fit_percent(record, force), "series": series}


def microseconds_per_sample(found: ParameterSet, window: Window) -> float:
    """Processor time [µs] of the force of a sample, streaming in blocks of ten."""
    parts = [slice(k, k + _BLOCK) for k in range(0, window.sample_count, _BLOCK)]
    blocks = [(window.motion.part(part), window.current[part]) for part in parts]
    times = []
    for _ in range(3):
        state = None
        began = time.process_time()
        for motion, current in blocks:
            _, state = found.law.follow(found.values, motion, current, window.period, state)
        times.append(time.process_time() - began)
    return 1e6 * min(times) / window.sample_count


QUICK_LAWS = ("hyperbolic_tangent", "sigmoid", "sigmoid_lag", "series_springs")
QUICK_ONLINE = ("sigmoid",)
"""Laws of the short variant, and those with the identifier running."""

_QUICK_EVERY, _QUICK_CURRENTS, _QUICK_LONGEST = 4, (0.6,), 20.0
"""Its stride over the currents of a motion, and its earthquakes: currents [A], duration [s]."""

_SHOWN = (10.0, 14.0)
"""Time range [s] of an earthquake that is drawn."""

Laws = Mapping[str, Any]
"""Results of :func:`judge_records` for each law, with ``left_out``: NRMSE [1] by record; and
``static`` and ``online``: results of :func:`judge_earthquake` without and with the identifier."""


def recordings_part(campaign: Campaign) -> Iterator[document.Chapter]:
    """All laws on all recordings, and the chapters on them."""
    utfsm, quick = recordings.folder(), campaign.quick
    if utfsm is None:
        return
    laws, online = (QUICK_LAWS, QUICK_ONLINE) if quick else (tuple(MODELS), tuple(MODELS))
    currents = _QUICK_CURRENTS if quick else recordings.EARTHQUAKE_CURRENTS
    motions = [None, *recordings.processed_motions(utfsm)]
    every = _QUICK_EVERY if quick else 1
    keys = [(law, left_out) for law in laws for left_out in motions]
    judged = campaign.each("sinusoid records", judge_records, keys, utfsm=utfsm, every=every)
    found: dict[str, Any] = {}
    for law in laws:
        others = [judged[law, left_out]["nrmse"] for left_out in motions[1:]]
        left_out = {name: error for each in others for name, error in each.items()}
        found[law] = {**judged[law, None], "left_out": left_out, "static": [], "online": []}
    trials = [
        (found[law]["set"], current, follows)
        for follows, chosen in ((False, laws), (True, online))
        for law in chosen
        for current in currents
    ]
    common = {"utfsm": utfsm, "longest": _QUICK_LONGEST if quick else math.inf}
    shaken = campaign.each("earthquakes", judge_earthquake, trials, **common)
    for (known, _, follows), result in shaken.items():
        found[known.model]["online" if follows else "static"].append(result)
    window = next(iter(recordings.processed_motions(utfsm).values()))[0]
    for result in found.values():
        result["microseconds"] = microseconds_per_sample(result["set"], window)
    campaign.figures["recordings"] = _figures(found, currents)
    yield from (_sinusoids(found), _earthquakes(found, currents), _parameters(found))


def _fits(results: Sequence[Mapping[str, Any]], currents: Sequence[float]) -> list[float | None]:
    """Fit [%] of each earthquake; None if it was not computed."""
    return [result["fit"] for result in results] or [None] * len(currents)


def _sinusoids(found: Laws) -> document.Chapter:
    rows: list[Sequence[document.Cell]] = []
    for law, result in found.items():
        errors, others = (list(result[kind].values()) for kind in ("nrmse", "left_out"))
        rows.append(
            (
                *(law, len(MODELS[law].parameters)),
                *(100.0 * float(of(errors)) for of in (np.median, np.max)),
                *(100.0 * float(of(others)) for of in (np.median, np.mean)),
                *(100.0 * _median(result["raw"]), result["seconds"], result["microseconds"]),
            )
        )
    names = list(next(iter(found.values()))["nrmse"])
    (best, alone), (safest, unseen) = (
        min(((law, _median(result[kind])) for law, result in found.items()), key=itemgetter(1))
        for kind in ("nrmse", "left_out")
    )
    return chapter(
        "sinusoids",
        "Sinusoid records",
        f"the median NRMSE of one set is {alone:.1%} ({best}), and {unseen:.1%} for motions left "
        f"out of the fit ({safest}).",
        "Recordings of an MR damper in a test machine, UTFSM, Chile, 2022 "
        "(github.com/DanielMaurelE/vRTHS_AMBC_MRdamper, MIT licence, © 2022 mequiroz). There are "
        f"{len(names)} records at constant currents, with ramps. For each law, one set is "
        "identified from all records. In addition, each motion (an amplitude and frequency, at all "
        "its currents) is left out of an identification and then predicted, with the peak velocity "
        "held within the range of the others. The authors smoothed the processed records by a "
        "moving average over a tenth of a cycle. The raw records of the logger exist for two "
        "motions; their mean is subtracted, because the zero of their force is unknown.",
        document.Table(
            "sinusoids",
            "NRMSE (RMSE over the standard deviation of the force) in percent: median and largest "
            "for one set, median and mean for the motions left out, median for the raw records. "
            "Identification: processor time for one set. Streaming: processor time per sample in "
            "blocks of ten. Both hold for the computer that made the report.",
            "law | parameters | one set | largest | left out | left out, mean | raw | "
            "identification (s) | streaming (µs)",
            rows,
        ),
        _errors(found, names),
    )


def _errors(found: Laws, names: Sequence[str]) -> document.Picture:
    picture, axes = document.chart(
        "sinusoids", "Error of every record, by law.", (2, 1, 6.8, 5.2), sharex=True
    )
    motions, _, currents = zip(*(name.rpartition(",") for name in names), strict=True)
    places = np.arange(len(names))
    kinds = (("nrmse", "one set for all"), ("left_out", "its motion left out"))
    for axis, (kind, title) in zip(axes[:, 0], kinds, strict=True):
        for number, (law, result) in enumerate(found.items()):
            values = [100.0 * result[kind].get(name, math.nan) for name in names]
            style = {"color": document.INK[number], "marker": document.MARKS[number]}
            axis.plot(places, values, linestyle="none", label=law, **style)
        axis.set(ylabel=f"NRMSE (%), {title}", yscale="log")
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:g}")
        for place in places[1:]:
            if motions[place] != motions[place - 1]:
                axis.axvline(place - 0.5, color=document.GREY, linewidth=0.6)
    axes[1, 0].set_xticks(places, [current.removesuffix(" A").strip() for current in currents])
    told = ", ".join(map(_motion, dict.fromkeys(motions)))
    axes[1, 0].set_xlabel("current (A), motion by motion: " + told)
    document.legend_above(axes[0, 0], 4)
    return picture


def _earthquakes(found: Laws, currents: Sequence[float]) -> document.Chapter:
    means = {law: _mean_fit(result["static"]) for law, result in found.items()}
    steadiest = max(means, key=means.__getitem__)
    rows: list[Sequence[document.Cell]] = [
        (law, *_fits(result["static"], currents), means[law], *_fits(result["online"], currents))
        for law, result in found.items()
    ]
    middle = len(currents) // 2
    best = max(found, key=lambda law: found[law]["static"][middle]["fit"])
    picture, axes = document.chart(
        "earthquakes",
        f"Measured and predicted force at {currents[middle]:g} A ({best}), and the residual.",
        (2, 1, 6.8, 4.2),
        sharex=True,
    )
    for place, (kind, name) in enumerate(
        (("static", "sinusoid set"), ("online", "identifier running"))
    ):
        for result in found[best][kind][middle : middle + 1]:
            series = result["series"]
            chosen = (series[0] >= _SHOWN[0]) & (series[0] < _SHOWN[1])
            passed, measured, predicted = series[:, chosen]
            if not place:
                grey = {"color": document.GREY, "linewidth": 2.0}
                axes[0, 0].plot(passed, measured, label="measured", **grey)
            draw_rows(axes, passed, (predicted, predicted - measured), name, **line(place))
    name_rows(axes, "force (N)", "residual (N)")
    document.legend_above(axes[0, 0], 3)
    static, online = (
        " | ".join(f"{kind}, {current:g} A" for current in currents)
        for kind in ("static", "on-line")
    )
    return chapter(
        "earthquakes",
        "Earthquake records",
        f"the set of the sinusoids alone has a mean fit of {means[steadiest]:.1f} % to the "
        f"earthquakes ({steadiest}).",
        "The records contain one earthquake motion at each current. As delivered, displacement and "
        "force are averages over 0.3 s, for which no nonlinear law holds; the averages were undone "
        "exactly. The force of every block of 20 samples is predicted before it is used: with the "
        "set of the sinusoid records alone (static), or with the identifier running at the "
        "defaults of the nodes, starting from this set (on-line). The first five seconds of motion "
        "are not evaluated.",
        document.Table(
            "earthquakes",
            "Fit (1 − NRMSE) in percent. –: not computed.",
            f"law | {static} | mean | {online}",
            rows,
        ),
        picture,
    )


def _mean_fit(results: Sequence[Mapping[str, Any]]) -> float:
    return float(np.mean([result["fit"] for result in results]))


def _parameters(found: Laws) -> document.Chapter:
    blocks: list[document.Block] = [
        "The sets were identified from the sinusoid records. The standard errors include the "
        "discrepancy, the model error that other motions reveal. –: the data do not determine the "
        "parameter, which keeps its start value. The records do not determine the lag of the coil, "
        "because each has a constant current."
    ]
    for law, result in found.items():
        rows = [
            (
                name,
                document.with_error(entry.value, entry.standard_error)
                if entry.observable and 0.0 < entry.standard_error < math.inf
                else None,
                entry.unit,
                f"{entry.value:.6g}",
            )
            for name, entry in parameter_estimates(result["set"]).items()
        ]
        columns = "parameter | value ± standard error | unit | in the set"
        blocks.append(
            document.Table(f"parameters_{law}", f"{MODELS[law].title} ({law}).", columns, rows)
        )
    told = "the parameters of each law, with their standard errors."
    return document.Chapter("parameters", "Parameters", told, blocks)


_TOLD = ("value", "standard_error", "discrepancy", "unit", "observable")
"""What the JSON file tells of a parameter."""


def _figures(found: Laws, currents: Sequence[float]) -> dict[str, object]:
    """The figures of the recordings for the JSON file, law by law; NRMSE [1], fits [%]."""
    return {
        law: {
            "one_set_nrmse": result["nrmse"],
            "one_set_median": _median(result["nrmse"]),
            "left_out_nrmse": result["left_out"],
            "left_out_median": _median(result["left_out"]),
            "raw_nrmse": result["raw"],
            "earthquake_currents": currents,
            "earthquake_static_fit": _fits(result["static"], currents),
            "earthquake_online_fit": _fits(result["online"], currents),
            "identification_s": result["seconds"],
            "us_per_sample": result["microseconds"],
            "parameters": {
                name: {key: json_ready(getattr(entry, key)) for key in _TOLD}
                for name, entry in parameter_estimates(result["set"]).items()
            },
        }
        for law, result in found.items()
    }


def _motion(name: str) -> str:
    """``25mm0x1Hz`` as ``25 mm 0.1 Hz``."""
    return name.replace("x", ".").replace("mm", " mm ").replace("Hz", " Hz")


def _median(errors: Mapping[str, float]) -> float:
    return float(np.median(list(errors.values()))) if errors else math.nan
