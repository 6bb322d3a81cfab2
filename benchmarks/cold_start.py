"""Real records, met by an identifier that knows nothing of the damper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.figure import Figure
from mr_damper_ros.models.initial_set import start_set
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.study import earthquake, recordings
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.predictor import ForcePredictor, PredictorSettings
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.window_assembler import WindowAssembler, WindowSettings

LAWS = ("sigmoid", "sigmoid_lag")

GOOD = 0.75
"""Fit, 1 - NRMSE, of the predicted force in the two seconds after a set."""

_MOVING = 1e-4
_BEFORE, _AFTER = 1.0, 9.0
"""Seconds of a record before the motion [m] begins, and after."""

_BLOCK = 0.02
_NEXT = 2.0


def records(utfsm: Path) -> list[Recording]:
    """The begin of the three earthquakes, their smoothing undone."""
    return [begin_of(record) for record in earthquake.unsmoothed_records(utfsm)]


def begin_of(record: Recording) -> Recording:
    """The first seconds of its motion."""
    moves = np.abs(record.displacement - record.displacement[0]) > _MOVING
    begin = max(int(np.argmax(moves)) - round(_BEFORE / record.period), 0)
    part = slice(begin, begin + round((_BEFORE + _AFTER) / record.period))
    return replace(
        record,
        displacement=record.displacement[part],
        force=record.force[part],
        current=record.current[part],
    )


def windows_until_good(record: Recording, model: str) -> tuple[float, float]:
    """Windows in motion until the fit is good, infinite if never; the largest valid force.

    The latter over the largest that was measured in the record.
    """
    predictor, start = ForcePredictor(PredictorSettings()), start_set(model)
    predictor.set_parameters(start)
    tracker = WindowTracker(TrackerSettings(model=model), start)
    given = WindowSettings()
    assembler = WindowAssembler(given.window, given.hop, given.looks)
    force = np.empty(record.force.size)
    valid = np.empty(record.force.size, dtype=bool)
    ends: list[int] = []
    size = max(round(_BLOCK / record.period), 1)
    for first in range(0, force.size, size):
        part = slice(first, min(first + size, force.size))
        stamp = record.start_ns + round(first * record.period * 1e9)
        block = SampleBlock(
            stamp, first, record.period, record.displacement[part], record.force[part]
        )
        current = float(record.current[first])
        predictor.add_current(stamp, current)
        prediction = predictor.predict(block)
        force[part], valid[part] = prediction.force, prediction.valid_samples
        ready = assembler.add_current(stamp, current) + assembler.add_block(block)
        for raw in [*ready, *assembler.add_current(block.end_ns, current)]:
            report = tracker.follow(raw)
            if report is not None and report.verdict is not Verdict.FAULT_OF_DATA:
                ends += [] if raw.look else [part.stop]
                if report.global_due:
                    tracker.identify()
        if tracker.parameters is not predictor.parameters:
            predictor.set_parameters(tracker.parameters)
    largest = np.abs(force[valid]).max(initial=0.0) / np.abs(record.force).max()
    following = round(_NEXT / record.period)
    for count, end in enumerate(ends, start=1):
        after = slice(end, end + following)
        if after.stop > force.size:
            break
        error = force[after] - record.force[after]
        if 1.0 - float(np.sqrt(np.mean(error**2)) / np.std(record.force[after])) >= GOOD:
            return float(count), float(largest)
    return float("inf"), float(largest)


def figures() -> list[Figure]:
    """``cold_start_windows`` and ``cold_start_largest_force``."""
    place = recordings.folder()
    note = recordings.NONE if place is None else ""
    found = None
    if place is not None:
        found = [windows_until_good(r, law) for law in LAWS for r in records(place)]
    return [
        Figure(
            "cold_start_windows",
            None if found is None else [count for count, _ in found],
            "Windows in motion, from a cold start on, until the predicted force fits the next two "
            "seconds to 75 %: earthquakes at 0.2, 0.6 and 1.0 A, smoothing undone, with sixteen "
            "parameters, then with the extended law.",
            (0.0, 4.0),
            note,
        ),
        Figure(
            "cold_start_largest_force",
            None if found is None else [size for _, size in found],
            "Largest force called valid there, over the largest measured.",
            None,
            note,
        ),
    ]
