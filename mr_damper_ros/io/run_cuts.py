"""Where the runs lie in a record that holds several: between pauses, rests and changes of phase."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mr_damper_ros.io.sampled_record import GAP, SampledRecord, integrated
from mr_damper_ros.kinematics.window import turning_points
from mr_damper_ros.signals.arrays import NOISE_SPAN, Array, white_noise

_BLOCK = 0.1
"""Seconds of a block; a rest is found to this accuracy, and so much of it is left to a run."""

_REST = 1.0
"""Seconds that a rest takes at least,"""

_REST_OF_STROKE = 0.3
"""and this part of a stroke: a slow motion turns slowly."""

_STILL = 0.002
"""The rod rests where the displacement keeps within this part of its span, or of its noise."""

_CURRENT_STEP = 0.05
"""A change of a measured current [A] that begins another run."""

_JOLT = 0.02
"""What moves less than this part of the largest motion of the file is no run."""

_TURNED = 0.1
"""The motion has turned when it has gone this part of the span back."""

_SAME = 0.2
"""Strokes are of one phase where height, duration and force differ by no more than this,"""

_LATEST = 4
"""from the median of so many before."""

_STROKES = 6
"""Strokes of a phase."""

_STEADY = 0.7
"""Part of a motion that its phases make up; else it is not of that kind, and is left whole."""


@dataclass(frozen=True)
class RunSummary:
    """What a run is recognised by: where it begins in the file, in words, and its loop.

    ``duration`` [s]; ``amplitude`` [m] and ``force`` [N] are half the spans, without the extreme
    hundredth of the force; ``frequency`` [Hz] counts strokes.
    """

    begins: str
    duration: float
    amplitude: float
    frequency: float
    force: float

    def __str__(self) -> str:
        return (
            f"{self.duration:.3g} s from {self.begins}, {1e3 * self.amplitude:.3g} mm, "
            f"{self.frequency:.2g} Hz, ±{self.force:.3g} N"
        )


def find_runs(record: SampledRecord) -> list[slice]:
    """Rows of each run of a record, in order.

    A run ends where the time jumps or begins anew, where a measured current changes, where the rod
    rests for a second or more, and where a steady cycle gives way to another: of another amplitude,
    frequency or force. What does not move is no run.
    """
    motions = [
        motion
        for stretch in _stretches(record)
        for level in _levels(record, stretch)
        for motion in _motions(record, level)
    ]
    spans = [float(np.ptp(_position(record, motion))) for motion in motions]
    return [
        phase
        for motion, span in zip(motions, spans, strict=True)
        if span > _JOLT * max(spans)
        for phase in _phases(record, motion)
    ]


def run_summary(record: SampledRecord, rows: slice) -> RunSummary:
    """What a run is recognised by."""
    low, high = np.percentile(record.values["force"][rows], (0.5, 99.5))
    position = _position(record, rows)
    turns = _turns(position)
    period = _usual_step(record.time)
    strokes = (turns[-1] - turns[0]) * period / (len(turns) - 1) if len(turns) > 1 else np.inf
    return RunSummary(
        begins=record.place(rows.start),
        duration=position.size * period,
        amplitude=0.5 * float(np.ptp(position)),
        frequency=0.5 / strokes,
        force=0.5 * float(high - low),
    )


def _usual_step(time: Array) -> float:
    steps = np.diff(time)
    return float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 1.0


def _position(record: SampledRecord, rows: slice) -> Array:
    """Displacement [m] of some rows; where there is none, the integral of the velocity."""
    if "displacement" in record.values:
        return record.values["displacement"][rows]
    return integrated(record.values["velocity"][rows], _usual_step(record.time))


def _stretches(record: SampledRecord) -> Iterator[slice]:
    """Rows between two jumps of the time."""
    steps = np.diff(record.time)
    jumps = np.flatnonzero((steps <= 0.0) | (steps > GAP * _usual_step(record.time))) + 1
    yield from _between(jumps.tolist(), slice(0, record.time.size))


def _between(cuts: list[int], rows: slice) -> Iterator[slice]:
    for first, last in pairwise([rows.start, *cuts, rows.stop]):
        if last - first > 1:
            yield slice(first, last)


def _levels(record: SampledRecord, rows: slice) -> Iterator[slice]:
    """Rows at one current, where one was measured."""
    current = record.values.get("current")
    if current is None:
        yield rows
        return
    length = _block_length(record)
    cuts, level = [], float(np.median(current[rows][:length]))
    for first in range(rows.start, rows.stop, length):
        block = float(np.median(current[first : min(first + length, rows.stop)]))
        if abs(block - level) > _CURRENT_STEP:
            cuts.append(first)
            level = block
    yield from _between(cuts, rows)


def _block_length(record: SampledRecord) -> int:
    return max(round(_BLOCK / _usual_step(record.time)), 1)


def _motions(record: SampledRecord, rows: slice) -> Iterator[slice]:
    """Rows between two rests of the rod."""
    length = _block_length(record)
    position = _position(record, rows)
    count = position.size // length
    window = round(_REST / _BLOCK)
    span = float(np.ptp(position))
    if count < window or span == 0.0:
        if span > 0.0:
            yield rows
        return
    blocks = position[: count * length].reshape(count, length)
    noise = white_noise(position)
    still = max(_STILL * span, NOISE_SPAN * noise)
    high = np.lib.stride_tricks.sliding_window_view(blocks.max(axis=1), window).max(axis=1)
    low = np.lib.stride_tricks.sliding_window_view(blocks.min(axis=1), window).min(axis=1)
    resting = np.convolve(high - low < still, np.ones(window)) > 0.0
    strokes = max(len(_turns(position)) - 1, 1)
    least = _REST_OF_STROKE * (count - np.count_nonzero(resting)) / strokes
    for first, last, rests in _equal(resting):
        if rests and last - first < least:
            resting[first:last] = False
    for first, last, rests in _equal(resting):
        if not rests:
            start = rows.start + max(first - 1, 0) * length
            stop = rows.stop if last == count else rows.start + (last + 1) * length
            yield slice(start, min(stop, rows.stop))


def _equal(flags: NDArray[np.bool_]) -> list[tuple[int, int, bool]]:
    """First, last + 1 and value of each stretch of equal flags."""
    edges = np.flatnonzero(np.diff(flags)) + 1
    places = [0, *edges.tolist(), flags.size]
    return [(first, last, bool(flags[first])) for first, last in pairwise(places)]


def _turns(position: Array) -> list[int]:
    """Indices of the extremes between which the rod goes some of its way, shape (k,)."""
    return turning_points(position.tolist(), _TURNED * float(np.ptp(position)))[1:-1].tolist()


def _phases(record: SampledRecord, rows: slice) -> list[slice]:
    """The steady cycles that make up a motion, or the motion where it is nothing of the kind."""
    position, force = _position(record, rows), record.values["force"][rows]
    strokes = list(pairwise(_turns(position)))
    heights = np.array(
        [
            (
                abs(float(position[last] - position[first])),
                float(last - first),
                float(np.ptp(force[first:last])),
            )
            for first, last in strokes
        ]
    )
    if len(strokes) < 2 * _STROKES or np.any(heights <= 0.0):
        return [rows]
    features = np.log(heights)
    phases, first = [], 0
    for k in range(1, len(strokes) + 1):
        before = np.median(features[max(first, k - _LATEST) : k], axis=0)
        if k == len(strokes) or np.max(np.abs(features[k] - before)) > _SAME:
            if k - first >= _STROKES:
                phases.append(slice(rows.start + strokes[first][0], rows.start + strokes[k - 1][1]))
            first = k
    covered = sum(phase.stop - phase.start for phase in phases)
    if len(phases) < 2 or covered < _STEADY * position.size:
        return [rows]
    return phases
