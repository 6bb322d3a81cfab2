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
    channels = {
        name: getattr(recording, name)[part] for name in ("displacement", "force", "current")
    }
    return replace(recording, temperature=None, **channels)


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def folder() -> Path | None:
    """Folder ``utfsm`` of the recordings, or None if it does not exist."""
    place = os.environ.get("MR_DAMPER_DATA", "")
    path = Path(place) / "utfsm"
    return path if place and path.is_dir() else None


def processed_records(utfsm: Path) -> list[Recording]:
    """The sinusoid records in ``processed``, whole, ramps included.

    The file name contains amplitude, frequency and current. Raises ValueError for other names.
    """
    return [processed(path)[1] for path in sorted((utfsm / "processed").glob("*.txt"))]


def processed_motions(utfsm: Path) -> dict[str, list[Window]]:
    """The same as windows, by amplitude and frequency."""
    motions: dict[str, list[Window]] = {}
    for path in sorted((utfsm / "processed").glob("*.txt")):
        motion, record = processed(path)
        motions.setdefault(motion, []).append(window_of(record))
    return motions


def processed_windows(utfsm: Path) -> list[Window]:
    """All processed sinusoid records."""
    return [window for windows in processed_motions(utfsm).values() for window in windows]


def processed(path: Path) -> tuple[str, Recording]:
    """Amplitude and frequency of a sinusoid record, as in its name, and the record."""
    told = _NAME.match(path.stem)
    if told is None:
        raise ValueError(f"{path.name}: the name does not end with a current, such as 0x25A")
    return told[1], read_record(path, _COLUMNS, current=float(told[2].replace("x", ".")))
