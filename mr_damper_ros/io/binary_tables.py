"""Columns from MAT, TDMS and XLSX files, which are read in a separate process.

A malformed file can crash the reading process (segmentation fault), block it for ever, or exhaust
the memory when it is unpacked. Therefore a child process with limited time and memory reads the
file and returns arrays or text.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import os
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor
from concurrent.futures import TimeoutError as LateError
from dataclasses import dataclass
from datetime import date, time, timedelta
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mr_damper_ros.io.columns import Columns, RawTable, RecordError, too_long
from mr_damper_ros.io.text_table import TextFile
from mr_damper_ros.processes.process_pool import LocalProcesses
from mr_damper_ros.signals.arrays import Array

_BYTES_PER_SAMPLE = 150
"""Memory limit per sample [B].

It suffices for four columns of eight bytes each, in compressed, unpacked, transposed and
transferred form.
"""

_LEAST_MEMORY = 100_000_000
"""Smallest memory limit [B]."""

_HEAD_ROWS = 1000
"""Number of rows of a sheet, in addition to the samples, for headers and empty rows."""

_SEPARATOR = "\t"
"""Separator of cells in the text of a sheet."""


@dataclass(frozen=True)
class Format:
    """A file format and its reader.

    ``what`` is the name of the format; ``module`` is the module that reads it; ``library`` says how
    to install the module; ``time_limit`` [s] limits the reading. ``read`` runs in the child process
    and receives the open file, the name of the variable, and the largest number of samples.
    """

    what: str
    module: str
    library: str
    time_limit: float
    read: Callable[[BinaryIO, str | None, int], Any]


def read_mat(path: Path, columns: Columns, variable: str | None, maximum_samples: int) -> RawTable:
    """Read columns from one matrix, or from one variable per column.

    ``variable`` selects the matrix if there are several. Raises RecordError.
    """
    if any(column.holds_dates for column in columns.wanted):
        raise RecordError("a MAT file holds numbers: give the unit of its time, such as time:s")
    variables: dict[str, Array] = _confined("mat", path, maximum_samples)
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
        # Samples may be rows or columns of the matrix.
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
    """Read the channels of a group as columns, in the order of the file. Raises RecordError.

    ``variable`` selects the group if there are several. The names of the channels are the headers.
    The sample period is that of the waveform, if the file holds it.
    """
    groups: dict[str, dict[str, Array]] = {}
    periods: dict[tuple[str, str], float] = {}
    for group, channel, period, values in _confined("tdms", path, maximum_samples):
        groups.setdefault(group, {})[channel] = values
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
    """Read columns of one sheet. Raises RecordError.

    ``variable`` selects the sheet if there are several. Cells hold numbers or text; the value of a
    formula is the value stored in the file.
    """
    text = _confined("spreadsheet", path, maximum_samples, variable)
    lines = TextFile(lambda: io.StringIO(text), path.name, _SEPARATOR)
    return lines.table(columns, maximum_samples)


def _chosen(
    name: str, kind: str, vectors: Mapping[str, Array], columns: Columns, listed: str
) -> dict[str, Array]:
    """The vectors by quantity; columns select them by header or by position."""
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


def _confined(kind: str, path: Path, maximum_samples: int, variable: str | None = None) -> Any:
    """Read a file in a child process. Raises RecordError, and OSError if there is no file."""
    form = FORMATS[kind]
    child = LocalProcesses(1)
    try:
        task = child.start().submit(_read, kind, str(path), variable, maximum_samples)
        return task.result(form.time_limit)
    except LateError:
        raise RecordError(
            f"{path.name} could not be read within {form.time_limit:g} s: save a part of it, or "
            "export it as CSV"
        ) from None
    except MemoryError:
        raise too_long(path.name, maximum_samples) from None
    except BrokenExecutor:
        raise RecordError(_unreadable(form, path)) from None
    finally:
        child.end()


def _unreadable(form: Format, path: Path) -> str:
    return f"{path.name} is not {form.what} that can be read: save it again, or export it as CSV"


def _read(kind: str, place: str, variable: str | None, most_samples: int) -> Any:
    """Read a file; runs in the child process.

    Raises RecordError, and MemoryError if the file needs more memory than ``most_samples``.
    """
    form, path = FORMATS[kind], Path(place)
    with path.open("rb") as file:
        try:
            import_module(form.module)
        except ImportError:
            raise RecordError(
                f"{path.name} is {form.what}, which needs {form.library}, or export the file as CSV"
            ) from None
        _limit_memory(max(_BYTES_PER_SAMPLE * most_samples, _LEAST_MEMORY))
        try:
            return form.read(file, variable, most_samples)
        except (RecordError, MemoryError):
            raise
        except NotImplementedError:
            raise RecordError(
                f"{path.name} is a MAT file of version 7.3: save it in MATLAB with "
                "save(..., '-v7') first"
            ) from None
        except Exception as error:
            # For damaged data, the libraries raise exceptions of many kinds.
            if isinstance(error, OSError) and error.errno == errno.ENOMEM:
                raise MemoryError from None
            raise RecordError(_unreadable(form, path)) from None


def _limit_memory(size: int) -> None:
    """Limit the additional memory of this process to ``size`` [B]; has an effect on Linux only."""
    if sys.platform != "linux":
        return
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[5])  # data and stack
    limit = pages * os.sysconf("SC_PAGE_SIZE") + size
    with contextlib.suppress(ValueError):  # a lower limit is set already
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def _matrices(file: BinaryIO, variable: str | None, most_samples: int) -> dict[str, Array]:
    """The real numeric matrices, by name."""
    from scipy.io import loadmat  # here: see mr_damper_ros.entry_points

    return {
        name: value
        for name, value in loadmat(file).items()
        if isinstance(value, np.ndarray) and value.ndim == 2 and value.dtype.kind in "fiu"
    }


def _channels(
    file: BinaryIO, variable: str | None, most_samples: int
) -> list[tuple[str, str, float, Array]]:
    """Group, name, period [s] and values of all channels with numbers or times."""
    from nptdms import TdmsFile

    with TdmsFile.open(file) as tdms:
        channels = [
            channel
            for group in tdms.groups()
            for channel in group.channels()
            if channel.dtype.kind in "fiuM" and len(channel) > 0
        ]
        if any(len(channel) > most_samples for channel in channels):
            raise MemoryError
        return [
            (
                channel.group_name,
                channel.name,
                float(channel.properties.get("wf_increment", np.nan)),
                _numbers(channel[:]),
            )
            for channel in channels
        ]


def _numbers(values: Any) -> Array:
    """Values as floating-point numbers; times in seconds since 1970."""
    if values.dtype.kind == "M":
        return np.asarray(values.astype("datetime64[ns]").astype(np.int64) * 1e-9)
    return np.asarray(values, dtype=np.float64)


def _sheet(file: BinaryIO, variable: str | None, most_samples: int) -> str:
    """The rows of a sheet as lines of text."""
    from openpyxl import load_workbook

    book = load_workbook(file, read_only=True, data_only=True)
    sheets = {page.title: page for page in book.worksheets}
    chosen = variable or (next(iter(sheets)) if len(sheets) == 1 else "")
    if chosen not in sheets:
        asked = f"no sheet '{variable}'" if variable else "several sheets"
        raise RecordError(
            f"the file has {asked}: choose one as the variable, of {', '.join(sheets)}"
        )
    text = io.StringIO()
    writer = csv.writer(text, delimiter=_SEPARATOR, lineterminator="\n")
    for number, row in enumerate(sheets[chosen].iter_rows(values_only=True)):
        if number == most_samples + _HEAD_ROWS:
            raise MemoryError
        cells = [_text(cell) for cell in row]
        writer.writerow(cells if any(cells) else [])
    return text.getvalue()


def _text(cell: object) -> str:
    if cell is None:
        return ""
    if isinstance(cell, (date, time)):
        return cell.isoformat()
    if isinstance(cell, timedelta):
        return repr(cell.total_seconds())
    return " ".join(str(cell).split())


FORMATS = {
    "mat": Format("a MAT file", "scipy.io", "SciPy: install it", 60.0, _matrices),
    "tdms": Format(
        "a TDMS file",
        "nptdms",
        "npTDMS: install it (pip install npTDMS==1.13.0)",
        60.0,
        _channels,
    ),
    "spreadsheet": Format(
        "a spreadsheet",
        "openpyxl",
        "openpyxl: install it (pip install openpyxl==3.1.5, or python3-openpyxl of Ubuntu)",
        300.0,  # a full sheet has a million rows
        _sheet,
    ),
}
