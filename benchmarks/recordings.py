"""Real recordings, where the environment variable MR_DAMPER_DATA says that there are any."""

from __future__ import annotations

import os
import re
from pathlib import Path

from benchmarks.dampers import window_of
from mr_damper_ros.identification.window import Window
from mr_damper_ros.rig.readers import read_record

NONE = "MR_DAMPER_DATA is not set to a folder that holds utfsm."
_COLUMNS = "time:s,displacement:mm,velocity:mm/s,force:N"
_CURRENT = re.compile(r"Hz(\d+(?:x\d+)?)A$")


def folder() -> Path | None:
    """Folder ``utfsm`` of the recordings, or None."""
    place = os.environ.get("MR_DAMPER_DATA", "")
    path = Path(place) / "utfsm"
    return path if place and path.is_dir() else None


def processed_windows(utfsm: Path) -> list[Window]:
    """The sinusoid records in ``processed``, whole, ramps included; the name tells the current."""
    windows = []
    for path in sorted((utfsm / "processed").glob("*.txt")):
        current = _CURRENT.search(path.stem)
        if current is None:
            raise ValueError(f"{path.name}: the name does not end with a current, such as 0x25A")
        value = float(current[1].replace("x", "."))
        windows.append(window_of(read_record(path, _COLUMNS, current=value)))
    return windows
