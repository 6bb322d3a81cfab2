"""Columns from the channels of a TDMS file, read with npTDMS in a process of its own."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np

from mr_damper_ros.io.columns import Columns
from mr_damper_ros.io.confined_reading import limit_memory, limit_time, memory_for, run_confined
from mr_damper_ros.io.raw_table import RawTable, RecordError, too_long
from mr_damper_ros.signals.arrays import Array

TIME_LIMIT = 60.0
"""Seconds that reading may take."""

_NO_LIBRARY, _DAMAGED, _TOO_LARGE = 4, 5, 6
"""Exit codes of the child."""


def read_tdms(path: Path, columns: Columns, variable: str | None, maximum_samples: int) -> RawTable:
    """Read the channels of a group, ``variable`` where there are several. Raises RecordError.

    They are columns in the order of the file; a header is the name of a channel. The time between
    samples is that of the waveform where the file has it.
    """
    memory = memory_for(maximum_samples)
    code, stream = run_confined(serve, path, str(TIME_LIMIT), str(memory), str(maximum_samples))
    with stream:
        if code == _TOO_LARGE:
            raise too_long(path.name, maximum_samples)
        if code != 0:
            raise RecordError(f"{path.name} {_reason(code)}")
        names = np.load(stream, allow_pickle=False).tolist()
        periods = np.load(stream, allow_pickle=False).tolist()
        groups: dict[str, dict[str, tuple[Array, float]]] = {}
        for (group, channel), period in zip(names, periods, strict=True):
            groups.setdefault(group, {})[channel] = np.load(stream, allow_pickle=False), period
    return _table(path.name, _group(path.name, groups, variable), columns)


def _group(name: str, groups: dict[str, Any], variable: str | None) -> Any:
    if variable is None and len(groups) == 1:
        return next(iter(groups.values()))
    if variable not in groups:
        asked = f"no group '{variable}'" if variable else f"{len(groups)} groups of numbers"
        raise RecordError(
            f"{name} has {asked}: choose one as the variable, of {', '.join(groups) or 'none'}"
        )
    return groups[variable]


def _table(name: str, channels: dict[str, tuple[Array, float]], columns: Columns) -> RawTable:
    listed = ", ".join(channels)
    in_order = list(channels.values())
    fault = columns.fault_of_width(name, len(channels))
    if fault:
        raise RecordError(f"{fault} (its channels: {listed})")
    chosen = {}
    for column in columns.wanted:
        if column.header and column.header in channels:
            chosen[column.quantity] = channels[column.header]
        elif not column.header and column.position < len(in_order):
            chosen[column.quantity] = in_order[column.position]
        else:
            wanted = f"'{column.header}'" if column.header else f"{column.position + 1}"
            raise RecordError(f"{name} has no channel {wanted}: it holds {listed}")
    lengths = {values.size for values, _ in chosen.values()}
    if len(lengths) > 1:
        raise RecordError(
            f"the channels of {name} that are wanted differ in length: choose channels of one rate"
        )
    periods = {period for _, period in chosen.values() if np.isfinite(period) and period > 0.0}
    return RawTable(
        {quantity: values for quantity, (values, _) in chosen.items()},
        lambda row: f"sample {row + 1}",
        periods.pop() if len(periods) == 1 else None,
    )


def _reason(code: int) -> str:
    if code == _NO_LIBRARY:
        return (
            "is a TDMS file, which needs npTDMS: install it (pip install npTDMS==1.13.0), or "
            "export the file as CSV"
        )
    if code == -signal.SIGALRM:
        return f"could not be read within {TIME_LIMIT:g} s: save a part of it, or export it as CSV"
    return "is not a TDMS file that can be read: save it again, or export it as CSV"


def serve(time_limit: str, memory_limit: str, most_samples: str, result: str) -> None:
    """Be the child: the channels of numbers or times on standard input become arrays."""
    limit_time(float(time_limit))
    try:
        from nptdms import TdmsFile
    except ImportError:
        raise SystemExit(_NO_LIBRARY) from None
    try:
        limit_memory(int(memory_limit))
        with TdmsFile.open(sys.stdin.buffer) as file, open(int(result), "wb") as stream:
            channels = [
                channel
                for group in file.groups()
                for channel in group.channels()
                if channel.dtype.kind in "fiuM" and len(channel) > 0
            ]
            if any(len(channel) > int(most_samples) for channel in channels):
                raise SystemExit(_TOO_LARGE)
            names = [(channel.group_name, channel.name) for channel in channels]
            periods = [float(c.properties.get("wf_increment", np.nan)) for c in channels]
            np.save(stream, np.array(names, dtype=np.str_).reshape(-1, 2), allow_pickle=False)
            np.save(stream, np.array(periods, dtype=np.float64), allow_pickle=False)
            for channel in channels:
                np.save(stream, _numbers(channel[:]), allow_pickle=False)
    except (MemoryError, OSError):
        raise SystemExit(_TOO_LARGE) from None
    except Exception:
        # Damaged bytes surface in the library as exceptions of many kinds.
        raise SystemExit(_DAMAGED) from None


def _numbers(values: Any) -> Array:
    """Values as numbers; times as seconds since 1970."""
    if values.dtype.kind == "M":
        return np.asarray(values.astype("datetime64[ns]").astype(np.int64) * 1e-9)
    return np.asarray(values, dtype=np.float64)
