"""Columns from MAT, TDMS and XLSX files, which a library reads in a process of its own.

A malformed file can end the process that reads it (a segmentation fault), keep it for ever, or
unpack a few bytes to more than the memory. So a child process reads, with limited time and memory,
and hands over arrays without objects, or text.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import date, time, timedelta
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mr_damper_ros.io.columns import Columns, RawTable, RecordError, too_long
from mr_damper_ros.io.text_table import TextFile
from mr_damper_ros.processes import child_process
from mr_damper_ros.signals.arrays import Array

_BYTES_PER_SAMPLE = 100
"""Memory [B] that may be used: four columns of eight bytes, compressed, unpacked and turned."""

_LEAST_MEMORY = 100_000_000
"""Bytes that any file may use."""

_HEAD_ROWS = 1000
"""Rows of a sheet that may stand before the first sample, and be empty."""

_SEPARATOR = "\t"
"""Between the cells of a sheet that has become text."""

_VERSION_73, _NO_LIBRARY, _DAMAGED, _TOO_LARGE, _CHOOSE = 3, 4, 5, 6, 7
"""Exit codes of the child."""


@dataclass(frozen=True)
class Format:
    """What a file is, what reads it and where that is to be had, in words, and how.

    ``time_limit`` [s] bounds the reading. ``convert`` runs in the child, which has loaded the
    ``module``: it reads standard input and writes to the file descriptor, at most so many samples
    of the variable of this name.
    """

    what: str
    module: str
    library: str
    time_limit: float
    convert: Callable[[int, str, int], None]


def read_mat(path: Path, columns: Columns, variable: str | None, maximum_samples: int) -> RawTable:
    """Read columns of one matrix, ``variable`` where there are several, or a variable for each.

    Raises RecordError.
    """
    if any(column.holds_dates for column in columns.wanted):
        raise RecordError("a MAT file holds numbers: give the unit of its time, such as time:s")
    with _confined("mat", path, maximum_samples) as stream:
        names = np.load(stream, allow_pickle=False).tolist()
        variables = {name: np.load(stream, allow_pickle=False) for name in names}
    shapes = [f"{name} ({v.shape[0]} x {v.shape[1]})" for name, v in variables.items()]
    listed = ", ".join(shapes) or "no matrix of numbers"
    if columns.by_header:
        if variable is not None:
            raise RecordError(
                "the columns name variables of the MAT file themselves: choose no variable"
            )
        vectors = {name: v.ravel() for name, v in variables.items() if min(v.shape) == 1}
        chosen = _chosen(path.name, "variable", vectors, columns, listed)
    else:
        # Samples may run down or across.
        upright = {n: v.T if v.shape[0] < v.shape[1] else v for n, v in variables.items()}
        needed = 1 + max(column.position for column in columns.wanted)
        fitting = [n for n, v in upright.items() if v.shape[1] >= needed and v.shape[0] > 1]
        if variable is None and len(fitting) != 1:
            raise RecordError(
                f"{path.name} holds {len(fitting)} matrices with {needed} columns or more: "
                f"choose one as the variable; it holds {listed}"
            )
        variable = variable or fitting[0]
        if variable not in upright:
            raise RecordError(f"{path.name} has no variable '{variable}': it holds {listed}")
        matrix = upright[variable]
        fault = columns.fault_of_width(path.name, matrix.shape[1])
        if fault:
            raise RecordError(fault)
        names = [f"{place}" for place in range(1, matrix.shape[1] + 1)]
        vectors = dict(zip(names, matrix.T, strict=True))
        chosen = _chosen(f"'{variable}' in {path.name}", "column", vectors, columns, listed)
    table = RawTable(chosen, lambda row: f"row {row + 1}")
    if table.row_count > maximum_samples:
        raise too_long(path.name, maximum_samples)
    return table


def read_tdms(path: Path, columns: Columns, variable: str | None, maximum_samples: int) -> RawTable:
    """Read the channels of a group, ``variable`` where there are several. Raises RecordError.

    They are columns in the order of the file; a header is the name of a channel. The time between
    samples is that of the waveform where the file has it.
    """
    groups: dict[str, dict[str, Array]] = {}
    periods: dict[tuple[str, str], float] = {}
    with _confined("tdms", path, maximum_samples) as stream:
        names = np.load(stream, allow_pickle=False).tolist()
        waveform = np.load(stream, allow_pickle=False).tolist()
        for (group, channel), period in zip(names, waveform, strict=True):
            groups.setdefault(group, {})[channel] = np.load(stream, allow_pickle=False)
            periods[group, channel] = period
    if variable is None and len(groups) == 1:
        variable = next(iter(groups))
    if variable not in groups:
        asked = f"no group '{variable}'" if variable else f"{len(groups)} groups of numbers"
        raise RecordError(
            f"{path.name} has {asked}: choose one as the variable, of {', '.join(groups) or 'none'}"
        )
    channels = groups[variable]
    listed = ", ".join(channels)
    fault = columns.fault_of_width(path.name, len(channels))
    if fault:
        raise RecordError(f"{fault} (its channels: {listed})")
    chosen = _chosen(path.name, "channel", channels, columns, listed)
    told = {
        periods[variable, name]
        for name, values in channels.items()
        if any(values is one for one in chosen.values()) and periods[variable, name] > 0.0
    }
    period = told.pop() if len(told) == 1 else np.inf
    return RawTable(
        chosen, lambda row: f"sample {row + 1}", period if np.isfinite(period) else None
    )


def read_spreadsheet(
    path: Path, columns: Columns, variable: str | None, maximum_samples: int
) -> RawTable:
    """Read columns of one sheet, ``variable`` where there are several. Raises RecordError.

    Cells hold numbers or text; a formula is read as the value that was saved with it.
    """
    stream = _confined("spreadsheet", path, maximum_samples, variable or "")
    # The text stays there as long as rows may be named.
    text = TextFile(Path(f"/proc/self/fd/{stream.fileno()}"), path.name, "utf-8", _SEPARATOR)
    table = text.table(columns, maximum_samples)
    return RawTable(table.values, lambda row: "" if stream.closed else table.place(row))


def _chosen(
    name: str, kind: str, vectors: Mapping[str, Array], columns: Columns, listed: str
) -> dict[str, Array]:
    """By quantity, the vectors that the columns name, or want by their place."""
    names = list(vectors)
    found: dict[str, str] = {}
    for column in columns.wanted:
        there = column.position < len(names)
        wanted = column.header or (names[column.position] if there else f"{column.position + 1}")
        if wanted not in vectors:
            raise RecordError(f"{name} has no {kind} '{wanted}': it holds {listed}")
        found[column.quantity] = wanted
    lengths = {wanted: vectors[wanted].size for wanted in found.values()}
    if len(set(lengths.values())) > 1:
        sizes = ", ".join(f"{wanted} has {length}" for wanted, length in lengths.items())
        raise RecordError(
            f"the {kind}s of {name} that are wanted differ in length: {sizes}; choose those of "
            "one rate"
        )
    return {quantity: vectors[wanted] for quantity, wanted in found.items()}


def _confined(kind: str, path: Path, maximum_samples: int, variable: str = "") -> BinaryIO:
    """What the child makes of a file. Raises RecordError, and OSError where there is none."""
    form = FORMATS[kind]
    memory = max(_BYTES_PER_SAMPLE * maximum_samples, _LEAST_MEMORY)
    limits = (str(form.time_limit), str(memory), str(maximum_samples))
    result = os.memfd_create("result")
    stream = open(result, "w+b")  # noqa: SIM115 (handed over)
    with path.open("rb") as file:
        code = subprocess.run(
            child_process.command(serve, kind, *limits, variable, str(result)),
            stdin=file,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=[result],
            start_new_session=True,
            check=False,
        ).returncode
    stream.seek(0)
    if code == 0:
        return stream
    with stream:
        if code == _TOO_LARGE:
            raise too_long(path.name, maximum_samples)
        if code == _NO_LIBRARY:
            why = f"is {form.what}, which needs {form.library}, or export the file as CSV"
        elif code == _VERSION_73:
            why = "is a MAT file of version 7.3: save it in MATLAB with save(..., '-v7') first"
        elif code == _CHOOSE:
            asked = f"no sheet '{variable}'" if variable else "several sheets"
            why = f"has {asked}: choose one as the variable, of {', '.join(json.load(stream))}"
        elif code == -signal.SIGALRM:
            why = (
                f"could not be read within {form.time_limit:g} s: save a part of it, or export it "
                "as CSV"
            )
        else:
            why = f"is not {form.what} that can be read: save it again, or export it as CSV"
    raise RecordError(f"{path.name} {why}")


def serve(
    kind: str, time_limit: str, memory_limit: str, most_samples: str, variable: str, result: str
) -> None:
    """Be the child, for at most so many seconds and bytes more than a fresh process has."""
    # Also while it is in a call into C.
    signal.setitimer(signal.ITIMER_REAL, float(time_limit))
    form = FORMATS[kind]
    try:
        import_module(form.module)
    except ImportError:
        raise SystemExit(_NO_LIBRARY) from None
    try:
        _limit_memory(int(memory_limit))
        form.convert(int(result), variable, int(most_samples))
    except MemoryError:
        raise SystemExit(_TOO_LARGE) from None
    except NotImplementedError:
        raise SystemExit(_VERSION_73) from None
    except Exception as error:
        # Damaged bytes surface in the libraries as exceptions of many kinds.
        too_large = isinstance(error, OSError) and error.errno in (errno.EFBIG, errno.ENOMEM)
        raise SystemExit(_TOO_LARGE if too_large else _DAMAGED) from None


def _limit_memory(size: int) -> None:
    """Let this process take and write so many bytes more than now. Elsewhere than on Linux: not."""
    if sys.platform != "linux":
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[5])  # data and stack
    used = pages * os.sysconf("SC_PAGE_SIZE")
    for kind, limit in ((resource.RLIMIT_DATA, used + size), (resource.RLIMIT_FSIZE, size)):
        with contextlib.suppress(ValueError):  # a lower limit is set already
            resource.setrlimit(kind, (limit, limit))


def _convert_mat(result: int, variable: str, most_samples: int) -> None:
    """The real matrices of numbers: their names, then each."""
    from scipy.io import loadmat  # here: see mr_damper_ros.entry_points

    matrices = {
        name: value
        for name, value in loadmat(sys.stdin.buffer).items()
        if isinstance(value, np.ndarray) and value.ndim == 2 and value.dtype.kind in "fiu"
    }
    _save(result, np.array(list(matrices), dtype=np.str_), *matrices.values())


def _convert_tdms(result: int, variable: str, most_samples: int) -> None:
    """The channels of numbers or times: group and name of each, their periods [s], then each."""
    from nptdms import TdmsFile

    with TdmsFile.open(sys.stdin.buffer) as file:
        channels = [
            channel
            for group in file.groups()
            for channel in group.channels()
            if channel.dtype.kind in "fiuM" and len(channel) > 0
        ]
        if any(len(channel) > most_samples for channel in channels):
            raise SystemExit(_TOO_LARGE)
        names = [(channel.group_name, channel.name) for channel in channels]
        periods = [float(c.properties.get("wf_increment", np.nan)) for c in channels]
        _save(
            result,
            np.array(names, dtype=np.str_).reshape(-1, 2),
            np.array(periods, dtype=np.float64),
            *(_numbers(channel[:]) for channel in channels),
        )


def _save(result: int, *arrays: np.ndarray) -> None:
    with open(result, "wb") as stream:
        for values in arrays:
            np.save(stream, values, allow_pickle=False)


def _numbers(values: Any) -> Array:
    """Values as numbers; times as seconds since 1970."""
    if values.dtype.kind == "M":
        return np.asarray(values.astype("datetime64[ns]").astype(np.int64) * 1e-9)
    return np.asarray(values, dtype=np.float64)


def _convert_spreadsheet(result: int, variable: str, most_samples: int) -> None:
    """The rows of a sheet, as lines of text."""
    from openpyxl import load_workbook

    book = load_workbook(sys.stdin.buffer, read_only=True, data_only=True)
    sheets = {page.title: page for page in book.worksheets}
    chosen = variable or (next(iter(sheets)) if len(sheets) == 1 else "")
    with open(result, "w", encoding="utf-8", newline="") as stream:
        if chosen not in sheets:
            json.dump(list(sheets), stream)
            stream.flush()
            os._exit(_CHOOSE)
        for number, row in enumerate(sheets[chosen].iter_rows(values_only=True)):
            if number == most_samples + _HEAD_ROWS:
                os._exit(_TOO_LARGE)
            stream.write(_line(row))


def _line(row: Iterable[object]) -> str:
    line = io.StringIO()
    cells = [_text(cell) for cell in row]
    csv.writer(line, delimiter=_SEPARATOR, lineterminator="\n").writerow(cells)
    return line.getvalue() if any(cells) else "\n"


def _text(cell: object) -> str:
    if cell is None:
        return ""
    if isinstance(cell, (date, time)):
        return cell.isoformat()
    if isinstance(cell, timedelta):
        return repr(cell.total_seconds())
    return " ".join(str(cell).split())


FORMATS = {
    "mat": Format("a MAT file", "scipy.io", "SciPy: install it", 60.0, _convert_mat),
    "tdms": Format(
        "a TDMS file",
        "nptdms",
        "npTDMS: install it (pip install npTDMS==1.13.0)",
        60.0,
        _convert_tdms,
    ),
    "spreadsheet": Format(
        "a spreadsheet",
        "openpyxl",
        "openpyxl: install it (pip install openpyxl==3.1.5, or python3-openpyxl of Ubuntu)",
        300.0,  # a full sheet has a million rows
        _convert_spreadsheet,
    ),
}
