"""The runs of a record, cut at pauses, rests, and changes of current or cycle."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from mr_damper_ros.io.columns import MAXIMUM_SAMPLES, RecordError, parse_columns
from mr_damper_ros.io.records import GAP, SampledRecord, check_current, integrated, read_samples
from mr_damper_ros.kinematics.window import turning_points
from mr_damper_ros.models.quantities import SAME_CURRENT
from mr_damper_ros.signals.arrays import NOISE_SPAN, Array, white_noise
from mr_damper_ros.signals.recording import Recording

_BLOCK = 0.1
"""Length of a block [s]. Rests are detected block by block, and a run keeps one block of a rest."""

_REST = 1.0
"""Shortest duration of a rest [s]."""

_REST_OF_STROKE = 0.3
"""Shortest duration of a rest relative to a stroke, because a slow reversal resembles a rest."""

_STILL = 0.002
"""Largest change of the displacement at rest, relative to its span, unless the noise is larger."""

_SMALLEST_RUN = 0.02
"""Smallest span of a run, relative to the largest span in the file."""

_REVERSAL = 0.1
"""Smallest return of the motion at a reversal, relative to the span."""

_PHASE_CHANGE = 0.2
"""Largest change of the logarithm of height, duration or force within a phase."""

_REFERENCE_STROKES = 4
"""Number of previous strokes whose median is the reference for a change."""

_STROKES = 6
"""Smallest number of strokes of a phase."""

_STEADY = 0.7
"""If the phases cover less than this fraction of a motion, the whole motion is one run."""


def read_runs(
    path: str | Path,
    columns: str,
    *,
    currents: float | Sequence[float | None] | None = None,
    period: float | None = None,
    variable: str | None = None,
    maximum_samples: int = MAXIMUM_SAMPLES,
) -> list[Recording]:
    """Read a file with several successive runs into one recording per run.

    A run ends where the time jumps or restarts (the logger has paused), where the rod rests for at
    least one second, where a measured current changes, and where a steady cycle changes its
    amplitude, frequency or force.
    ``currents`` [A] has one value per run, or is one number for all runs, if no column holds the
    current; None omits a run. The other parameters are as in :func:`read_record`.

    Raises the exceptions of :func:`read_record`. For a wrong number of currents, the message lists
    the runs.
    """
    return RunsOfFile(path, columns, period, variable, maximum_samples).recordings(currents)


class RunsOfFile:
    """The runs of a file, before their currents are known.

    ``summaries``: a description of each run; ``asks``: whether currents are needed. Raises the
    exceptions of :func:`read_runs`.
    """

    def __init__(
        self,
        path: str | Path,
        columns: str,
        period: float | None = None,
        variable: str | None = None,
        maximum_samples: int = MAXIMUM_SAMPLES,
    ) -> None:
        self._wanted = wanted = parse_columns(columns)
        self._record = read_samples(path, wanted, period, variable, maximum_samples)
        self._rows = _runs(self._record)
        self._name = Path(path).name
        self.asks = "current" not in wanted.quantities
        self.summaries = [_summary(self._record, rows) for rows in self._rows]
        if not self._rows:
            raise RecordError(f"{self._name} contains no run, because the displacement is constant")

    def recordings(self, currents: float | Iterable[float | None] | None) -> list[Recording]:
        """A recording of each run with a current, or of all runs if a column holds the current."""
        count = len(self._rows)
        if currents is not None:
            currents = list(currents) if isinstance(currents, Iterable) else [currents] * count
            if not self.asks:
                raise RecordError("the current is given twice: by a column and for each run")
        if self.asks and len(currents or ()) != count:
            listed = "; ".join(f"{k}: {text}" for k, text in enumerate(self.summaries, start=1))
            raise RecordError(
                f"{self._name} holds {count} runs, but {len(currents or ())} currents "
                f"are given: give one [A] for each run (currents, --currents), or None (-) to omit "
                f"the run ({listed})"
            )
        recordings = []
        for number, rows in enumerate(self._rows, start=1):
            current = None if currents is None else currents[number - 1]
            if self.asks and current is None:
                continue
            check_current(self._wanted, current)
            run = self._record.part(rows)
            recordings.append(run.recording(current, f"{Path(self._name).stem}_{number}"))
        return recordings


def _runs(record: SampledRecord) -> list[slice]:
    """Rows of each run of a record, in order; parts without motion are not runs."""
    steps, usual = np.diff(record.time), _usual_step(record.time)
    jumps = np.flatnonzero((steps <= 0.0) | (steps > GAP * usual)) + 1
    length = max(round(_BLOCK / usual), 1)
    motions = [
        motion
        for stretch in _between(jumps.tolist(), slice(0, record.time.size))
        for level in _levels(record, stretch, length)
        for motion in _motions(record, level, length)
    ]
    spans = [float(np.ptp(_position(record, motion))) for motion in motions]
    return [
        phase
        for motion, span in zip(motions, spans, strict=True)
        if span > _SMALLEST_RUN * max(spans)
        for phase in _phases(record, motion)
    ]


def _summary(record: SampledRecord, rows: slice) -> str:
    """Description of a run: its duration, its start in the file, and its loop without spikes."""
    low, high = np.percentile(record.values["force"][rows], (0.5, 99.5))
    position = _position(record, rows)
    turns = _turns(position)
    period = _usual_step(record.time)
    strokes = (turns[-1] - turns[0]) * period / (len(turns) - 1) if len(turns) > 1 else np.inf
    return (
        f"{position.size * period:.3g} s from {record.place(rows.start)}, "
        f"{500.0 * float(np.ptp(position)):.3g} mm, {0.5 / strokes:.2g} Hz, "
        f"±{0.5 * float(high - low):.3g} N"
    )


def _usual_step(time: Array) -> float:
    steps = np.diff(time)
    return float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 1.0


def _position(record: SampledRecord, rows: slice) -> Array:
    """Displacement [m] of some rows; without displacement, the integral of the velocity."""
    if "displacement" in record.values:
        return record.values["displacement"][rows]
    return integrated(record.values["velocity"][rows], _usual_step(record.time))


def _between(cuts: list[int], rows: slice) -> Iterator[slice]:
    for first, last in pairwise([rows.start, *cuts, rows.stop]):
        if last - first > 1:
            yield slice(first, last)


def _levels(record: SampledRecord, rows: slice, length: int) -> Iterator[slice]:
    """Rows at one current; without a measured current, all rows."""
    current = record.values.get("current")
    cuts: list[int] = []
    if current is not None:
        level = float(np.median(current[rows][:length]))
        for first in range(rows.start, rows.stop, length):
            block = float(np.median(current[first : min(first + length, rows.stop)]))
            if abs(block - level) > SAME_CURRENT:
                cuts.append(first)
                level = block
    yield from _between(cuts, rows)


def _motions(record: SampledRecord, rows: slice, length: int) -> Iterator[slice]:
    """Rows between rests of the rod."""
    position = _position(record, rows)
    count = position.size // length
    window = round(_REST / _BLOCK)
    span = float(np.ptp(position))
    if count < window or span == 0.0:
        if span > 0.0:
            yield rows
        return
    blocks = position[: count * length].reshape(count, length)
    still = max(_STILL * span, NOISE_SPAN * white_noise(position))
    views = np.lib.stride_tricks.sliding_window_view(blocks, window, axis=0)
    spans = views.max(axis=(1, 2)) - views.min(axis=(1, 2))
    resting = np.convolve(spans < still, np.ones(window)) > 0.0
    strokes = max(len(_turns(position)) - 1, 1)
    least = _REST_OF_STROKE * (count - np.count_nonzero(resting)) / strokes
    rests = np.ma.clump_masked(np.ma.array(resting, mask=resting))  # type: ignore[no-untyped-call]
    for rest in rests:
        if rest.stop - rest.start < least:
            resting[rest] = False
    moves = np.ma.clump_unmasked(np.ma.array(resting, mask=resting))  # type: ignore[no-untyped-call]
    for moved in moves:
        start = rows.start + max(moved.start - 1, 0) * length
        stop = rows.stop if moved.stop == count else rows.start + (moved.stop + 1) * length
        yield slice(start, min(stop, rows.stop))


def _turns(position: Array) -> list[int]:
    """Indices of the reversals of the motion."""
    return turning_points(position.tolist(), _REVERSAL * float(np.ptp(position)))[1:-1].tolist()


def _phases(record: SampledRecord, rows: slice) -> list[slice]:
    """The phases of steady cycles in a motion, or the whole motion if there are none."""
    position, force = _position(record, rows), record.values["force"][rows]
    strokes = list(pairwise(_turns(position)))
    heights = np.array(
        [(abs(position[j] - position[i]), j - i, np.ptp(force[i:j])) for i, j in strokes]
    )
    if len(strokes) < 2 * _STROKES or np.any(heights <= 0.0):
        return [rows]
    features = np.log(heights)
    phases, first = [], 0
    for k in range(1, len(strokes) + 1):
        before = np.median(features[max(first, k - _REFERENCE_STROKES) : k], axis=0)
        if k == len(strokes) or np.max(np.abs(features[k] - before)) > _PHASE_CHANGE:
            if k - first >= _STROKES:
                phases.append(slice(rows.start + strokes[first][0], rows.start + strokes[k - 1][1]))
            first = k
    covered = sum(phase.stop - phase.start for phase in phases)
    if len(phases) < 2 or covered < _STEADY * position.size:
        return [rows]
    return phases
