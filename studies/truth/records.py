"""Accuracy of the laws on the recordings: one set for all, motions left out, earthquakes."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mr_damper_ros.api.findings import parameter_estimates
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.io.records import read_runs
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.files import json_ready
from mr_damper_ros.report.document import (
    GREY,
    INK,
    MARKS,
    Cell,
    Chapter,
    Picture,
    Table,
    Text,
    legend_above,
    panels,
    with_error,
)
from mr_damper_ros.signals.arrays import Array
from studies import earthquake, recordings
from studies.drawing import line

_RAW_COLUMNS = "time:0.005*s,-,force:980.665*N,displacement:10*mm"
_RAW_CURRENTS = (0.0, 0.25, 0.5, 0.75, 1.0)
_BLOCK = 10
_SHOWN_EVERY = 5
"""Stride of the samples of an earthquake that are kept for drawing."""


@dataclass(frozen=True)
class RecordTrial:
    """A law on the sinusoid records; ``left_out`` names a motion excluded from the identification.

    ``every`` is the stride over the currents of a motion, which shortens the task.
    """

    utfsm: Path
    law: str
    left_out: str | None = None
    every: int = 1


@dataclass(frozen=True, eq=False)
class RecordResult:
    """The set; NRMSE [1] of the evaluated and of the raw records, by name; and the duration [s]."""

    parameter_set: ParameterSet
    nrmse: Mapping[str, float]
    raw: Mapping[str, float]
    seconds: float


@dataclass(frozen=True)
class EarthquakeTrial:
    """An earthquake record at a current and a law, with or without the identifier.

    ``longest`` [s] cuts the record short.
    """

    utfsm: Path
    parameter_set: ParameterSet
    current: float
    follows: bool
    longest: float


@dataclass(frozen=True, eq=False)
class EarthquakeResult:
    """Fit [%]; time [s], measured and predicted force [N] of some samples, shape (n,) each."""

    fit: float
    time: Array
    measured: Array
    predicted: Array


def judge_records(task: RecordTrial) -> RecordResult:
    """Identify the law, and predict the evaluated records as the model node does.

    If a motion is left out, its records are evaluated, and the peak velocity is held within the
    range of the others. Otherwise all records and the raw records of the logger are evaluated.
    """
    motions = {
        motion: windows[:: task.every]
        for motion, windows in recordings.processed_motions(task.utfsm).items()
    }
    began = time.process_time()
    found = set_without(motions, task.law, task.left_out)
    seconds = time.process_time() - began
    judged = motions if task.left_out is None else {task.left_out: motions[task.left_out]}
    nrmse = {
        f"{motion}, {window.current[0]:g} A": error_of(found, window)
        for motion, windows in judged.items()
        for window in windows
    }
    raw = {} if task.left_out is not None else _raw_errors(found, task.utfsm)
    return RecordResult(found, nrmse, raw, seconds)


def set_without(
    motions: Mapping[str, Sequence[Window]], law: str, left_out: str | None
) -> ParameterSet:
    """One set of a law for the windows of all motions except the one left out."""
    model = MODELS[law]
    windows = [w for motion, each in motions.items() if motion != left_out for w in each]
    start = model.initial_values()[0]
    return identify_global(model, windows, start, EvolutionSettings()).parameter_set


def error_of(found: ParameterSet, window: Window) -> float:
    """RMSE/std [1] of the force of a set, the peak velocity held within the set's range."""
    held = window.held_within(*found.peak_velocity_range)
    residual = found.law.window_force(held, found.values) - window.force
    return float(np.sqrt(np.mean(residual**2)) / np.std(window.force))


def _raw_errors(found: ParameterSet, utfsm: Path) -> dict[str, float]:
    """NRMSE of the raw logger records without means, because their force offset is unknown."""
    errors = {}
    for path in sorted((utfsm / "raw").glob("*.txt")):
        for run in read_runs(path, _RAW_COLUMNS, currents=_RAW_CURRENTS):
            window = recordings.window_of(run)
            held = window.held_within(*found.peak_velocity_range)
            residual = found.law.window_force(held, found.values) - window.force
            name = f"{path.stem.removeprefix('ME')}, {run.current[0]:g} A"
            errors[name] = float(np.std(residual) / np.std(window.force))
    return errors


def judge_earthquake(task: EarthquakeTrial) -> EarthquakeResult:
    """Predict the record block by block, its smoothing undone."""
    place = earthquake.CURRENTS.index(task.current)
    record = earthquake.unsmoothed_records(task.utfsm)[place]
    if task.longest < record.force.size * record.period:
        part = slice(0, round(task.longest / record.period))
        record = recordings.cut(record, part)
    force = earthquake.predicted(record, task.parameter_set, identify=task.follows)
    shown = slice(None, None, _SHOWN_EVERY)
    return EarthquakeResult(
        earthquake.fit_percent(record, force),
        np.asarray(record.period * np.arange(force.size), dtype=float)[shown],
        record.force[shown],
        force[shown],
    )


def microseconds_per_sample(found: ParameterSet, window: Window) -> float:
    """Processor time [µs] of the force of a sample, streaming in blocks of ten."""
    parts = [slice(k, k + _BLOCK) for k in range(0, window.sample_count, _BLOCK)]
    blocks = [(window.motion.part(part), window.current[part]) for part in parts]
    times = []
    for _ in range(3):
        stream = found.law.stream(window.period)
        began = time.process_time()
        for motion, current in blocks:
            stream.follow(found.values, motion, current)
        times.append(time.process_time() - began)
    return 1e6 * min(times) / window.sample_count


_SOURCE = (
    "Recordings of an MR damper in a test machine, UTFSM, Chile, 2022 "
    "(github.com/DanielMaurelE/vRTHS_AMBC_MRdamper, MIT licence, © 2022 mequiroz)."
)
_SHOWN = (10.0, 14.0)
"""Time range [s] of an earthquake that is drawn."""


@dataclass(frozen=True)
class Recorded:
    """Results by law; earthquakes by law, current [A] and whether the identifier ran."""

    one_set: Mapping[str, RecordResult]
    left_out: Mapping[str, Mapping[str, float]]
    earthquakes: Mapping[tuple[str, float, bool], EarthquakeResult]
    microseconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def currents(self) -> list[float]:
        """Currents [A] of the earthquakes."""
        return sorted({current for _, current, _ in self.earthquakes})

    def fits(self, law: str, follows: bool) -> list[float | None]:
        """Fit [%] of each earthquake; None if it was not computed."""
        found = (self.earthquakes.get((law, current, follows)) for current in self.currents)
        return [None if result is None else result.fit for result in found]

    def static_mean(self, law: str) -> float:
        """Mean fit [%] of the earthquakes with the sinusoid set alone; NaN if one is missing."""
        fits = [math.nan if fit is None else fit for fit in self.fits(law, follows=False)]
        return float(np.mean(fits)) if fits else math.nan


def headlines(found: Recorded) -> list[str]:
    """Summary sentences of the chapters."""
    alone = {law: _median(result.nrmse) for law, result in found.one_set.items()}
    unseen = {law: _median(errors) for law, errors in found.left_out.items()}
    shaken = {law: found.static_mean(law) for law in found.one_set}
    best, safest, steadiest = (
        min(alone, key=lambda law: alone[law]),
        min(unseen, key=lambda law: unseen[law]),
        max(shaken, key=lambda law: shaken[law]),
    )
    return [
        f"one set leaves {alone[best]:.1%} of the force ({best}, median over the records), and "
        f"{unseen[safest]:.1%} of motions that it has not seen ({safest}).",
        f"the set of the sinusoids alone fits the earthquakes to {shaken[steadiest]:.1f} % in the "
        f"mean ({steadiest}).",
        "those of each law, with their errors.",
    ]


def sinusoid_chapter(found: Recorded) -> Chapter:
    """Results of every law on the sinusoid records."""
    rows: list[Sequence[Cell]] = []
    for law, result in found.one_set.items():
        errors, unseen = list(result.nrmse.values()), list(found.left_out[law].values())
        rows.append(
            (
                law,
                len(MODELS[law].parameters),
                *(100.0 * float(of(errors)) for of in (np.median, np.max)),
                *(100.0 * float(of(unseen)) for of in (np.median, np.mean)),
                100.0 * _median(result.raw),
                result.seconds,
                found.microseconds.get(law),
            )
        )
    motions = list(dict.fromkeys(name.rpartition(",")[0] for name in _records(found)))
    figure, axes = panels(2, 1, 6.8, 5.2, sharex=True)
    places = np.arange(len(_records(found)))
    for row, (title, errors_of) in enumerate(
        (
            ("one set for all", {law: result.nrmse for law, result in found.one_set.items()}),
            ("its motion left out", found.left_out),
        )
    ):
        for number, (law, errors_by_name) in enumerate(errors_of.items()):
            values = [100.0 * errors_by_name.get(name, math.nan) for name in _records(found)]
            axes[row, 0].plot(
                places,
                values,
                color=INK[number % len(INK)],
                marker=MARKS[number % len(MARKS)],
                linestyle="none",
                label=law,
            )
        axes[row, 0].set(ylabel=f"NRMSE (%), {title}", yscale="log")
        axes[row, 0].yaxis.set_major_formatter("{x:g}")
        axes[row, 0].yaxis.set_minor_formatter("{x:g}")
    currents = [name.rpartition(",")[2].removesuffix(" A").strip() for name in _records(found)]
    axes[1, 0].set_xticks(places, currents)
    axes[1, 0].set_xlabel("current (A), motion by motion: " + ", ".join(map(_motion, motions)))
    for edge in np.flatnonzero(np.diff([motions.index(_of(n)) for n in _records(found)])):
        for row in (0, 1):
            axes[row, 0].axvline(edge + 0.5, color=GREY, linewidth=0.6)
    legend_above(figure, axes[0, 0], 4)
    return Chapter(
        "sinusoids",
        "Sinusoid records",
        [
            Text(
                f"{_SOURCE} {len(places)} records at constant currents, ramps included. Each law "
                "is identified with one set for all of them, and again without one motion (an "
                "amplitude and frequency, at all its currents), which it then predicts, the peak "
                "velocity held in the range of the others. The processed records are moving "
                "averages over a tenth of a cycle, made so by their makers; the raw ones are the "
                "logger's own, of two of the motions, whose force has no zero: its mean is taken "
                "off."
            ),
            Table(
                "sinusoids",
                "NRMSE is RMSE over the standard deviation of the force, in percent: median and "
                "largest of one set, median and mean of the motions left out, median of the raw "
                "records. Identification: processor time of one set. Streaming: processor time "
                "of a sample in blocks of ten. Both are those of the machine that made the report.",
                (
                    *("law", "parameters", "one set", "largest", "left out", "left out, mean"),
                    *("raw", "identified in (s)", "streaming (µs)"),
                ),
                rows,
            ),
            Picture("sinusoids", "Error of every record, by law.", figure),
        ],
    )


def earthquake_chapter(found: Recorded) -> Chapter:
    """Results of every law on the earthquakes."""
    currents = found.currents
    rows: list[Sequence[Cell]] = [
        (
            law,
            *found.fits(law, follows=False),
            json_ready(found.static_mean(law)),
            *found.fits(law, follows=True),
        )
        for law in found.one_set
    ]
    middle = currents[len(currents) // 2]
    best = max(found.one_set, key=lambda law: found.earthquakes[law, middle, False].fit)
    static = found.earthquakes[best, middle, False]
    online = found.earthquakes.get((best, middle, True))
    figure, axes = panels(2, 1, 6.8, 4.2, sharex=True)
    chosen = (static.time >= _SHOWN[0]) & (static.time < _SHOWN[1])
    time = static.time[chosen]
    axes[0, 0].plot(time, static.measured[chosen], color=GREY, linewidth=2.0, label="measured")
    for place, (result, name) in enumerate(
        ((static, "sinusoid set"), (online, "identifier running"))
    ):
        if result is not None:
            style = line(place)
            axes[0, 0].plot(time, result.predicted[chosen], label=name, **style)
            left = result.predicted - result.measured
            axes[1, 0].plot(time, left[chosen], **style)
    axes[0, 0].set(ylabel="force (N)")
    axes[1, 0].set(ylabel="left (N)", xlabel="time (s)")
    legend_above(figure, axes[0, 0], 3)
    heads = [f"{current:g} A" for current in currents]
    return Chapter(
        "earthquakes",
        "Earthquake records",
        [
            Text(
                "One earthquake motion at each of the currents. As delivered, displacement and "
                "force are averages over 0.3 s, between which no nonlinear law can hold; the "
                "average is exactly reversible and was undone. The force of every block of 20 "
                "samples is predicted before it is used, by the set of the sinusoid records alone "
                "(static), or with the identifier running from that set on at the nodes' defaults "
                "(on-line). The first five seconds of motion do not count."
            ),
            Table(
                "earthquakes",
                "Fit 1 − NRMSE in percent. –: not tried.",
                (
                    "law",
                    *(f"static, {head}" for head in heads),
                    "mean",
                    *(f"on-line, {head}" for head in heads),
                ),
                rows,
            ),
            Picture(
                "earthquakes",
                f"Force at {middle:g} A, {best}: measured, predicted, and what is left.",
                figure,
            ),
        ],
    )


def parameter_chapter(found: Recorded) -> Chapter:
    """The set of every law."""
    blocks: list[Text | Table] = [
        Text(
            "The sets that were identified from the sinusoid records. The standard errors contain "
            "what another motion would say, since no law follows the damper exactly (the "
            "discrepancy); –: what these data do not determine, which kept the value of its start. "
            "The records tell nothing of the coil's lag, since each is of one current."
        )
    ]
    for law, result in found.one_set.items():
        rows = [
            (
                name,
                with_error(entry.value, entry.standard_error)
                if _known(entry.observable, entry.standard_error)
                else None,
                entry.unit,
                f"{entry.value:.6g}",
            )
            for name, entry in parameter_estimates(result.parameter_set).items()
        ]
        blocks.append(
            Table(
                f"parameters_{law}",
                f"{MODELS[law].title} ({law}).",
                ("parameter", "value ± standard error", "unit", "in the set"),
                rows,
            )
        )
    return Chapter("parameters", "Parameters", blocks)


def record_document(found: Recorded) -> dict[str, object]:
    """The figures of the recordings for the JSON file, law by law; NRMSE [1], fits [%]."""
    return {
        law: {
            "one_set_nrmse": dict(result.nrmse),
            "one_set_median": _median(result.nrmse),
            "left_out_nrmse": dict(found.left_out[law]),
            "left_out_median": _median(found.left_out[law]),
            "raw_nrmse": dict(result.raw),
            "earthquake_currents": found.currents,
            "earthquake_static_fit": found.fits(law, follows=False),
            "earthquake_online_fit": found.fits(law, follows=True),
            "identification_s": result.seconds,
            "us_per_sample": found.microseconds.get(law),
            "parameters": {
                name: {
                    "value": entry.value,
                    "standard_error": json_ready(entry.standard_error),
                    "discrepancy": json_ready(entry.discrepancy),
                    "unit": entry.unit,
                    "observable": entry.observable,
                }
                for name, entry in parameter_estimates(result.parameter_set).items()
            },
        }
        for law, result in found.one_set.items()
    }


def _known(observable: bool, error: float) -> bool:
    return observable and math.isfinite(error) and error > 0.0


def _records(found: Recorded) -> list[str]:
    return list(next(iter(found.one_set.values())).nrmse)


def _of(name: str) -> str:
    return name.rpartition(",")[0]


def _motion(name: str) -> str:
    """``25mm0x1Hz`` as ``25 mm 0.1 Hz``."""
    return name.replace("x", ".").replace("mm", " mm ").replace("Hz", " Hz")


def _median(errors: Mapping[str, float]) -> float:
    return float(np.median(list(errors.values()))) if errors else math.nan
