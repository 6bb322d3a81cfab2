"""Earthquake records, predicted block by block by what the nodes are made of, in data time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.io.records import read_record
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.initial_set import start_set
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.study import recordings
from mr_damper_ros.tracking.predictor import ForcePredictor, PredictorSettings
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.window_assembler import RawWindow, WindowAssembler

CURRENTS = (0.2, 0.6, 1.0)
"""[A], of the columns of force in earthquake.mat."""

_PERIOD = 1e-3
_SMOOTHED = 300
"""Samples over which the makers of the records averaged them."""

_BLOCK = 20
_MOVING = 1e-4
"""The motion has begun once it has gone so far [m] from where it began."""

_LEFT_OUT = 5.0
"""Seconds of motion that do not count."""


@dataclass(frozen=True)
class Following:
    """Windows of ``window`` [s] every ``hop`` [s], with ``looks`` between two of them."""

    window: float = 2.0
    hop: float = 1.0
    looks: int = 3


def records(utfsm: Path, moving_average: int | None = None) -> list[Recording]:
    """The three records, as delivered, or with a moving average over so many samples undone."""
    return [
        read_record(
            utfsm / "earthquake.mat",
            ",".join(["displacement:mm", *["-"] * number, "force:N", "..."]),
            current=current,
            period=_PERIOD,
            moving_average=moving_average,
        )
        for number, current in enumerate(CURRENTS)
    ]


def unsmoothed_records(utfsm: Path) -> list[Recording]:
    """The three records as they were before their makers averaged them."""
    return records(utfsm, _SMOOTHED)


@cache
def sinusoid_set(utfsm: Path, model: str) -> ParameterSet:
    """The set of ``model`` for all processed sinusoid records."""
    windows = recordings.processed_windows(utfsm)
    start = start_set(model).values
    return identify_global(MODELS[model], windows, start, EvolutionSettings()).parameter_set


def predicted(record: Recording, start: ParameterSet, following: Following | None) -> Array:
    """Force [N] predicted block by block, each before it is used; shape (n,).

    With ``following`` the identifier runs, with the node's other defaults; the predictor gets a
    set, and what is said of it, once the block that completed its window is over.
    """
    predictor = ForcePredictor(PredictorSettings())
    predictor.set_parameters(start)
    force = np.empty(record.force.size)
    tracker = WindowTracker(TrackerSettings(model=start.model), start)
    assembler = None
    if following is not None:
        assembler = WindowAssembler(following.window, following.hop, following.looks)
    for first in range(0, force.size, _BLOCK):
        part = slice(first, min(first + _BLOCK, force.size))
        stamp = record.start_ns + round(first * record.period * 1e9)
        block = SampleBlock(
            stamp, first, record.period, record.displacement[part], record.force[part]
        )
        current = float(record.current[first])
        predictor.add_current(stamp, current)
        force[part] = predictor.predict(block).force
        if assembler is not None:
            assembler.add_current(stamp, current)
            ready = assembler.add_block(block)
            for raw in [*ready, *assembler.add_current(block.end_ns, current)]:
                _learn(tracker, raw, predictor)
    return force


def _learn(tracker: WindowTracker, raw: RawWindow, predictor: ForcePredictor) -> None:
    before = tracker.parameters
    report = tracker.follow(raw)
    if report is None:
        return
    if report.confirms:
        predictor.confirm(report.set_id, report.window_start_ns, report.stamp_ns)
    if report.global_due:
        tracker.identify()
    if tracker.parameters is not before:
        predictor.set_parameters(tracker.parameters, tracker.parameters.stamp_ns)


def fit_percent(record: Recording, force: Array) -> float:
    """1 - NRMSE [%] after the first 5 s of motion."""
    moved = np.abs(record.displacement - record.displacement[0]) > _MOVING
    counted = slice(int(np.argmax(moved)) + round(_LEFT_OUT / record.period), None)
    measured = record.force[counted]
    error = force[counted] - measured
    return 100.0 * (1.0 - float(np.sqrt(np.mean(error**2)) / np.std(measured)))


def fits(utfsm: Path, model: str, following: Following | None) -> list[float]:
    """Fit [%] of each record, its smoothing undone, with the sinusoid set of a model to start from.

    As delivered, displacement and force are averages, between which no law can hold.
    """
    start = sinusoid_set(utfsm, model)
    return [fit_percent(r, predicted(r, start, following)) for r in unsmoothed_records(utfsm)]
