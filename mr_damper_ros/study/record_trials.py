"""What the laws make of the recordings: one set for all, motions left out, earthquakes."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.io.records import read_runs
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.study import earthquake, recordings

_RAW_COLUMNS = "time:0.005*s,-,force:980.665*N,displacement:10*mm"
_RAW_CURRENTS = (0.0, 0.25, 0.5, 0.75, 1.0)
_BLOCK = 10
_SHOWN_EVERY = 5
"""Every so many samples of an earthquake are kept to be drawn."""


@dataclass(frozen=True)
class RecordTrial:
    """A law on the sinusoid records; ``left_out`` names a motion that the set has not seen.

    ``every`` takes each so many of a motion's currents, to be quick.
    """

    utfsm: Path
    law: str
    left_out: str | None = None
    every: int = 1


@dataclass(frozen=True, eq=False)
class RecordResult:
    """The set; NRMSE [1] of the records judged, by name, and of raw ones; seconds it took."""

    parameter_set: ParameterSet
    nrmse: Mapping[str, float]
    raw: Mapping[str, float]
    seconds: float


@dataclass(frozen=True)
class EarthquakeTrial:
    """An earthquake record at a current, by a law's set, with the identifier running or not.

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
    """Identify the law, and predict what it was judged by as the model node does.

    With a motion left out these are its records: the peak velocity is then held in the range of
    the others. Else they are all records, and the raw ones of the logger besides.
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
    """One set of a law for the windows of all motions but the one left out."""
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
    """NRMSE of the logger's own records, whose force has no zero: the means are taken off."""
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
        record = replace(
            record,
            displacement=record.displacement[part],
            force=record.force[part],
            current=record.current[part],
        )
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
