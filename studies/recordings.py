"""Real recordings, if the environment variable MR_DAMPER_DATA gives their folder."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from mr_damper_ros.io.records import read_record
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording

NONE = "MR_DAMPER_DATA is not set to a folder that holds utfsm."
_COLUMNS = "time:s,displacement:mm,velocity:mm/s,force:N"
_NAME = re.compile(r"(.+Hz)(\d+(?:x\d+)?)A$")


def window_of(recording: Recording) -> Window:
    """A whole recording as one window."""
    return Window.from_samples(
        recording.displacement, recording.force, recording.current, recording.period
    )


def cut(recording: Recording, part: slice) -> Recording:
    """A part of a recording, without its temperature."""
    return replace(recording.part(part), start_ns=recording.start_ns, temperature=None)


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def folder() -> Path | None:
    """Folder ``utfsm`` of the recordings, or None if it does not exist."""
    place = os.environ.get("MR_DAMPER_DATA", "")
    path = Path(place) / "utfsm"
    return path if place and path.is_dir() else None


def processed_motions(utfsm: Path) -> dict[str, list[Window]]:
    """The sinusoid records in ``processed``, whole, ramps included, by amplitude and frequency.

    The file name contains amplitude, frequency and current. Raises ValueError for other names.
    """
    motions: dict[str, list[Window]] = {}
    for path in sorted((utfsm / "processed").glob("*.txt")):
        motion, record = processed(path)
        motions.setdefault(motion, []).append(window_of(record))
    return motions


def processed(path: Path) -> tuple[str, Recording]:
    """Amplitude and frequency of a sinusoid record, as in its name, and the record."""
    told = _NAME.match(path.stem)
    if told is None:
        raise ValueError(f"{path.name}: the name does not end with a current, such as 0x25A")
    return told[1], read_record(path, _COLUMNS, current=float(told[2].replace("x", ".")))


# -- earthquakes -----------------------------------------------------------------------------------

EARTHQUAKE_CURRENTS = (0.2, 0.6, 1.0)
"""Currents [A] of the force columns in earthquake.mat."""

_PERIOD = 1e-3
_SMOOTHED = 300
"""Length of the moving average that the authors of the records applied [samples]."""

_MOVING = 1e-4
"""Distance from the initial position [m] at which the motion has begun."""

_LEFT_OUT = 5.0
"""Time [s] of motion that is not evaluated."""


def unsmoothed_earthquakes(utfsm: Path) -> list[Recording]:
    """The three records with the moving average of their authors undone."""
    return [
        read_record(
            utfsm / "earthquake.mat",
            ",".join(["displacement:mm", *["-"] * number, "force:N", "..."]),
            current=current,
            period=_PERIOD,
            moving_average=_SMOOTHED,
        )
        for number, current in enumerate(EARTHQUAKE_CURRENTS)
    ]


def fit_percent(record: Recording, force: Array) -> float:
    """1 - NRMSE [%] after the first 5 s of motion."""
    moved = np.abs(record.displacement - record.displacement[0]) > _MOVING
    counted = slice(int(np.argmax(moved)) + round(_LEFT_OUT / record.period), None)
    measured = record.force[counted]
    error = force[counted] - measured
    return 100.0 * (1.0 - float(np.sqrt(np.mean(error**2)) / np.std(measured)))
