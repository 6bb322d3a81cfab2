"""Prediction of earthquake records, block by block in data time, with the core of the nodes."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from mr_damper_ros.api.replay import replay
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.io.records import read_record
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from studies import recordings

CURRENTS = (0.2, 0.6, 1.0)
"""Currents [A] of the force columns in earthquake.mat."""

_PERIOD = 1e-3
_SMOOTHED = 300
"""Length of the moving average that the authors of the records applied [samples]."""

_BLOCK = 20
_MOVING = 1e-4
"""Distance from the initial position [m] at which the motion has begun."""

_LEFT_OUT = 5.0
"""Time [s] of motion that is not evaluated."""


def records(utfsm: Path, moving_average: int | None = None) -> list[Recording]:
    """The three records as delivered, or with a moving average of a given length undone."""
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
    """The three records with the moving average of their authors undone."""
    return records(utfsm, _SMOOTHED)


@cache
def sinusoid_set(utfsm: Path, model: str) -> ParameterSet:
    """The set of ``model`` for all processed sinusoid records."""
    windows = recordings.processed_windows(utfsm)
    start = start_set(model).values
    return identify_global(MODELS[model], windows, start, EvolutionSettings()).parameter_set


def predicted(record: Recording, start: ParameterSet, *, identify: bool) -> Array:
    """Force [N] predicted block by block, with or without the identifier; shape (n,)."""
    return replay(record, start, identify=identify, block_size=_BLOCK).predicted


def fit_percent(record: Recording, force: Array) -> float:
    """1 - NRMSE [%] after the first 5 s of motion."""
    moved = np.abs(record.displacement - record.displacement[0]) > _MOVING
    counted = slice(int(np.argmax(moved)) + round(_LEFT_OUT / record.period), None)
    measured = record.force[counted]
    error = force[counted] - measured
    return 100.0 * (1.0 - float(np.sqrt(np.mean(error**2)) / np.std(measured)))
