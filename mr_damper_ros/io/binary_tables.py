"""Columns from MAT, TDMS and XLSX files.

A malformed file can crash the reading process (segmentation fault), block it for ever, or exhaust
the memory when it is unpacked. A child process with limited time and memory therefore reads the
file and returns arrays or text.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import math
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import date, time, timedelta
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mr_damper_ros.io.columns import Columns, RawTable, RecordError, too_long
from mr_damper_ros.io.text_tables import TextFile
from mr_damper_ros.processes.process_pool import run_apart
from mr_damper_ros.signals.arrays import Array

_BYTES_PER_SAMPLE = 150
"""Memory limit per sample [B].

It suffices for four columns of eight bytes each, in compressed, unpacked, transposed and
transferred form.
"""

_LEAST_MEMORY = 100_000_000
"""Smallest memory limit [B]."""

_HEAD_ROWS = 1000
"""Number of rows that a sheet may have in addition to the samples, for headers and empty rows."""

_SEPARATOR = "\t"
"""Separator of cells in the text of a sheet."""


@dataclass(frozen=True)
class Group:
    """Columns of numbers by name: a matrix of a MAT file, or a group of channels of a TDMS file.

    ``label`` describes the group in a message. ``periods`` are the sample periods [s] of columns,
    if the file states them.
    """

    name: str
    label: str
    columns: dict[str, Array]
    periods: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Format:
    """A file format and its reader.

    ``what`` is the name of the format; ``module`` is the module that reads it; ``library`` says how
    to install the module; ``time_limit`` [s] limits the reading. ``read`` runs in the child process
    and receives the open file, the name of the variable, and the largest number of samples. It
    returns groups of columns, or lines of text. ``words`` are the words for a group, for several
    groups and for a column.
    """

    what: str
    module: str
    library: str
    time_limit: float
    read: Callable[[BinaryIO, str | None, int], list[Group] | str]
    words: tuple[str, str, str] = ("sheet", "sheets", "column")


def read_binary_table(
    path: Path, columns: Columns, variable: str | None, maximum_samples: int
) -> RawTable:
    """Read columns of one group, which ``variable`` selects if several have these columns.

    In a MAT file each column may instead name a variable. The sample period is taken from a TDMS
    waveform, if the file states it. Raises RecordError.
    """
    form = FORMATS[path.suffix.lower()]
    if form.read is _matrices and any(column.holds_dates for column in columns.wanted):
        raise RecordError("a MAT file holds no dates: give the unit of its time, such as time:s")
    content = _confined(form, path, maximum_samples, variable)
    if isinstance(content, str):
        lines = TextFile(lambda: io.StringIO(content), path.name, _SEPARATOR)
        return lines.table(columns, maximum_samples)
    group, listed = _group(path.name, form, content, columns, variable)
    kind = form.words[2] if group.name else form.words[0]
    if not columns.by_header:
        columns.check_width(path.name, len(group.columns), f" ({kind}s: {listed})")
    names = list(group.columns)
    found: dict[str, str] = {}
    for column in columns.wanted:
        there = column.position < len(names)
        wanted = column.header or (names[column.position] if there else f"{column.position + 1}")
        if wanted not in group.columns:
            raise RecordError(f"{path.name} has no {kind} '{wanted}': it holds {listed}")
        found[column.quantity] = wanted
    lengths = {name: group.columns[name].size for name in found.values()}
    if len(set(lengths.values())) > 1:
        sizes = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise RecordError(
            f"the chosen {kind}s of {path.name} differ in length: {sizes}; "
            f"choose {kind}s of one sample rate"
        )
    if max(lengths.values()) > maximum_samples:
        raise too_long(path.name, maximum_samples)
    periods = {group.periods.get(name, math.nan) for name in found.values()}
    period = periods.pop() if len(periods) == 1 else math.nan
    return RawTable(
        {quantity: group.columns[name] for quantity, name in found.items()},
        lambda row: f"row {row + 1}",
        period if math.isfinite(period) and period > 0.0 else None,
    )


def text_of_sheet(path: Path, variable: str | None, maximum_samples: int) -> TextFile:
    """The text of a sheet; raises RecordError, also for other formats, with their contents."""
    form = FORMATS[path.suffix.lower()]
    content = _confined(form, path, maximum_samples, variable)
    if isinstance(content, str):
        return TextFile(lambda: io.StringIO(content), path.name, _SEPARATOR)
    listed = ", ".join(group.label for group in content) or f"no {form.words[0]} of numbers"
    raise RecordError(
        f"{path.name} is {form.what} and holds {listed}: describe its columns (--columns) and name "
        "the bag (--output)"
    )


def _group(
    name: str, form: Format, groups: list[Group], columns: Columns, variable: str | None
) -> tuple[Group, str]:
    """The group with the selected columns, and a list of the contents of the file or the group."""
    listed = ", ".join(group.label for group in groups) or f"no {form.words[0]} of numbers"
    if form.read is _matrices and columns.by_header:
        if variable is not None:
            raise RecordError(
                "the columns already name variables of the MAT file: omit the option variable"
            )
        vectors = {g.name: next(iter(g.columns.values())) for g in groups if len(g.columns) == 1}
        return Group("", "", vectors), listed
    least = max(column.position for column in columns.wanted) + 1
    headers = [column.header for column in columns.wanted if column.header]
    if variable is not None:
        fitting = [group for group in groups if group.name == variable]
        if not fitting:
            raise RecordError(f"{name} has no {form.words[0]} '{variable}': it holds {listed}")
    elif len(groups) == 1:
        fitting = groups
    else:
        fitting = [g for g in groups if len(g.columns) >= least and {*headers} <= set(g.columns)]
    if len(fitting) != 1:
        needed = f"the columns {', '.join(headers)}" if headers else f"at least {least} columns"
        choose = ": choose one by the option variable" if fitting else ""
        raise RecordError(
            f"{name} holds {len(fitting)} {form.words[1]} with {needed}{choose}; it holds {listed}"
        )
    return fitting[0], ", ".join(fitting[0].columns)


def _confined(
    form: Format, path: Path, maximum_samples: int, variable: str | None
) -> list[Group] | str:
    """Read a file in a child process. Raises RecordError; OSError if the file does not exist."""
    try:
        content: list[Group] | str = run_apart(
            __name__, _read, path, variable, maximum_samples, budget=form.time_limit
        )
        return content
    except TimeoutError:
        raise RecordError(
            f"{path.name} could not be read within {form.time_limit:g} s: save a part of it, or "
            "export it as CSV"
        ) from None
    except MemoryError:
        raise too_long(path.name, maximum_samples) from None
    except ChildProcessError:
        raise RecordError(_unreadable(form, path)) from None


def _unreadable(form: Format, path: Path) -> str:
    return f"{path.name} cannot be read as {form.what}: save it again, or export it as CSV"


def _read(path: Path, variable: str | None, most_samples: int, _: object) -> list[Group] | str:
    """Read a file; runs in the child process.

    Raises RecordError, and MemoryError if the file needs more memory than ``most_samples`` allows.
    """
    form = FORMATS[path.suffix.lower()]
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
                f"{path.name} is a MAT file of version 7.3: first save it in MATLAB with "
                "save(..., '-v7')"
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
    with contextlib.suppress(ValueError):  # a lower limit is already set
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def _matrices(file: BinaryIO, variable: str | None, most_samples: int) -> list[Group]:
    """The real numeric matrices; their samples may be rows or columns."""
    from scipy.io import loadmat  # imported late: see entry_points

    groups = []
    for name, value in loadmat(file).items():
        if isinstance(value, np.ndarray) and value.ndim == 2 and value.dtype.kind in "fiu":
            rows = value if value.shape[0] < value.shape[1] else value.T
            columns = {f"{place}": row for place, row in enumerate(rows, start=1)}
            label = f"{name} ({value.shape[0]} x {value.shape[1]})"
            groups.append(Group(name, label, columns))
    return groups


def _channels(file: BinaryIO, variable: str | None, most_samples: int) -> list[Group]:
    """All channels with numbers or times, by group."""
    from nptdms import TdmsFile

    with TdmsFile.open(file) as tdms:
        groups = []
        for each in tdms.groups():
            channels = [c for c in each.channels() if c.dtype.kind in "fiuM" and len(c) > 0]
            if any(len(channel) > most_samples for channel in channels):
                raise MemoryError
            periods = {c.name: float(c.properties.get("wf_increment", math.nan)) for c in channels}
            columns = {channel.name: _floats(channel[:]) for channel in channels}
            groups += [Group(each.name, each.name, columns, periods)] if channels else []
        return groups


def _floats(values: Any) -> Array:
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
            f"the file has {asked}: choose one of {', '.join(sheets)} by the option variable"
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


_XLSX = Format(
    "a spreadsheet",
    "openpyxl",
    "openpyxl: install it (pip install openpyxl==3.1.5, or python3-openpyxl of Ubuntu)",
    300.0,  # a full sheet has a million rows
    _sheet,
)

FORMATS = {
    ".mat": Format(
        "a MAT file",
        "scipy.io",
        "SciPy: install it",
        60.0,
        _matrices,
        ("variable", "matrices", "column"),
    ),
    ".tdms": Format(
        "a TDMS file",
        "nptdms",
        "npTDMS: install it (pip install npTDMS==1.13.0)",
        60.0,
        _channels,
        ("group", "groups of numbers", "channel"),
    ),
    ".xlsm": _XLSX,
    ".xlsx": _XLSX,
}
"""The format of files by their ending; all other files are text."""
