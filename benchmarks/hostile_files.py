"""Hostile record files, bags and parameter files."""

from __future__ import annotations

import random
import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from benchmarks.hostile_input import NUMBERS, PERIOD, T0, motion
from mr_damper_ros.io.bag_files import BagError
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.io.columns import ColumnError, RecordError
from mr_damper_ros.io.records import read_record
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.signals.recording import Recording, RecordingError

_COLUMNS = (
    *("time:s,displacement:mm,force:N,current:A", "time:s,displacement:mm,force:kN,-"),
    *("displacement,force", "", "a:b:c", "time:s,time:s,force:N", ",,,", "force:N*1e400", "\0:s"),
    "time:s," + "-," * 500 + "force:N",
)

YAML = b"""model: bingham
id: a
nrmse: 0.1
current_range: [0, 1.5]
parameters:
  f_y: {value: 1.0, standard_error: 0.1}
  c0: 2e3
  f0: 0
"""


def _table() -> np.ndarray:
    time_ = np.arange(30) * PERIOD
    return np.column_stack((time_, 1e3 * motion(time_)[0], 1e4 * time_, np.ones(30)))


def record_text() -> bytes:
    """A sound text record."""
    rows = "\n".join(",".join(f"{value:.6g}" for value in row) for row in _table())
    return f"t,u,F,i\n{rows}\n".encode()


def record_mat() -> bytes:
    """A sound MAT file."""
    stored = BytesIO()
    savemat(stored, {"data": _table(), "name": "x"})
    return stored.getvalue()


def record_bag(folder: Path) -> bytes:
    """A sound bag, without the checksums that would tell of every change."""
    time_ = np.arange(200) * PERIOD
    u = motion(time_)[0]
    write_bag(folder / "good", Recording("good", T0, PERIOD, u, 1e4 * u, np.ones(200)))
    whole = bytearray(next((folder / "good").glob("*.mcap")).read_bytes())
    for place in checksum_places(whole):
        whole[place : place + 4] = bytes(4)
    return bytes(whole)


def checksum_places(whole: bytes | bytearray) -> list[int]:
    """Where an MCAP file has the checksums of its chunks, its data section and its summary."""
    places, position = [], 8
    while position < len(whole) - 8:
        operation, length = struct.unpack_from("<BQ", whole, position)
        offset = {0x06: 24, 0x0F: 0, 0x02: 16}.get(operation)
        if offset is not None:
            places.append(position + 9 + offset)
        position += 9 + length
    return places


def try_record(chance: random.Random, path: Path, data: bytes) -> str:
    """Read spoilt bytes as a record; what is wrong with what came out, or nothing."""
    path.write_bytes(data)
    columns = _COLUMNS[0] if chance.random() < 0.7 else chance.choice(_COLUMNS)
    options: dict[str, Any] = {}
    if chance.random() < 0.2:
        options = {"current": chance.choice(NUMBERS), "period": chance.choice(NUMBERS)}
    try:
        recording = read_record(path, columns, **options)
        recording.check_plausible()
    except (RecordError, ColumnError, RecordingError, OSError):
        return ""
    return _fault_of(recording)


def try_bag(path: Path, data: bytes) -> str:
    """Read spoilt bytes as a bag; what is wrong with what came out, or nothing."""
    path.write_bytes(data)
    try:
        recordings = read_bag(path)
        for recording in recordings:
            recording.check_plausible()
    except (BagError, RecordingError, OSError):
        return ""
    return next(filter(None, map(_fault_of, recordings)), "")


def _fault_of(recording: Recording) -> str:
    for values in (recording.displacement, recording.force, recording.current):
        if values.shape != (recording.sample_count,) or not np.isfinite(values).all():
            return "a recording with values that are not finite, or missing"
    return "" if recording.period > 0.0 else "a recording without a period"


def try_yaml(data: bytes) -> str:
    """Read spoilt bytes as a parameter file; what is wrong with what came out, or nothing."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return ""
    try:
        parameters = ParameterSet.from_yaml(text)
    except ParameterError:
        return ""
    return "" if np.isfinite(parameters.values).all() else "a parameter that is not finite"
