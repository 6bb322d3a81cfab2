"""How far the predicted force jumps between two samples, on real records, against the measured."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.figure import Figure
from mr_damper_ros.io.records import read_runs
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from studies import earthquake, recordings

LAWS = ("sigmoid", "sigmoid_lag")

_RAW_COLUMNS = "-,time:datetime,force:980.665*N,displacement:10*mm"
_RAW_CURRENTS = (0.0, 0.25, 0.5, 0.75, 1.0)

_SETTLED = 1.0
"""Seconds of a record that do not count: the observer and the centre settle."""


def raw_records(utfsm: Path) -> list[Recording]:
    """The runs in the logger's own files, as they came."""
    paths = sorted((utfsm / "raw").glob("ME*.txt"))
    return [run for path in paths for run in read_runs(path, _RAW_COLUMNS, currents=_RAW_CURRENTS)]


def largest_step(force: Array, period: float) -> float:
    """Largest change [N] of a force (n,) between two samples, NaN left out."""
    steps = np.abs(np.diff(force[round(_SETTLED / period) :]))
    return float(np.nanmax(steps))


def jump(record: Recording, parameters: ParameterSet) -> float:
    """Largest step of the predicted force over that of the measured one."""
    predicted = earthquake.predicted(record, parameters, identify=False)
    return largest_step(predicted, record.period) / largest_step(record.force, record.period)


def _worst(records: Iterable[Recording], parameters: ParameterSet) -> tuple[float, str]:
    return max((jump(record, parameters), record.name) for record in records)


def figures(laws: Sequence[str] = LAWS) -> list[Figure]:
    """``reversal_jump`` and that of smoothed records."""
    place = recordings.folder()
    note = recordings.NONE if place is None else ""
    rough: list[tuple[float, str]] = []
    smoothed: list[tuple[float, str]] = []
    if place is not None:
        for law in laws:
            known = earthquake.sinusoid_set(place, law)
            rough += [
                _worst(r, known) for r in (raw_records(place), earthquake.unsmoothed_records(place))
            ]
            smoothed.append(_worst(recordings.processed_records(place), known))
    names = ", ".join(laws)
    return [
        Figure(
            "reversal_jump",
            [value for value, _ in rough] or None,
            "Largest step of the predicted force between two samples over that of the measured "
            f"one, with the set of the sinusoid records; the worst of the logger's own records, "
            f"then of the earthquakes with their smoothing undone: {names}.",
            (0.0, 1.5),
            note or "; ".join(name for _, name in rough),
        ),
        Figure(
            "reversal_jump_smoothed",
            [value for value, _ in smoothed] or None,
            "The same of the sinusoid records as delivered, whose makers averaged the force over a "
            "tenth of a cycle.",
            None,
            note or "; ".join(name for _, name in smoothed),
        ),
    ]
