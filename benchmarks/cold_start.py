"""Real records, met by an identifier that knows nothing of the damper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.figure import Figure
from mr_damper_ros.api.replay import replay
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.engine import EngineSettings
from studies import earthquake, recordings

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
    said = replay(
        record,
        settings=EngineSettings().for_law(model),
        block_size=max(round(_BLOCK / record.period), 1),
    )
    force, valid = said.predicted, said.valid
    ends = [
        round((report.stamp_ns - record.start_ns) / NANOSECONDS / record.period) + 1
        for report in said.reports
        if report.verdict not in (Verdict.FAULT_OF_DATA, Verdict.ACCEPTED_EARLY)
        and report.window_start_ns < report.stamp_ns
    ]
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
