"""Columns from MAT, TDMS, MF4 and XLSX files.

A malformed file can crash the reading process (segmentation fault), block it for ever, or exhaust
the memory when it is unpacked. A child process with limited time and memory therefore reads the
file and returns arrays or text.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import logging
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
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
    """Columns of numbers by name, such as a matrix of a MAT file or a group of channels.

    ``label`` describes the group in a message. A group without columns is only described. The
    columns may have ``periods``, the sample periods [s] that the file states, and ``starts``, the
    stamps [ns] of their first samples. ``clock`` is the name of the column with the times of the
    others. ``note`` says what the group lacks.
    """

    name: str
    label: str
    columns: dict[str, Array]
    periods: dict[str, float] = field(default_factory=dict)
    starts: dict[str, int] = field(default_factory=dict)
    clock: str = ""
    note: str = ""


@dataclass(frozen=True)
class Format:
    """A file format and its reader.

    ``what`` is the name of the format; ``module`` is the module that reads it; ``library`` says how
    to install the module; ``time_limit`` [s] limits the reading. ``read`` runs in the child process
    and receives the open file, the name of the variable, and the largest number of samples. It
    returns groups of columns, or lines of text. ``words`` are the words for a group, for several
    groups and for a column. ``join`` may select columns by name beyond one group.
    """

    what: str
    module: str
    library: str
    time_limit: float
    read: Callable[[BinaryIO, str | None, int], list[Group] | str]
    words: tuple[str, str, str] = ("sheet", "sheets", "column")
    join: Callable[[str, list[Group], list[str]], Group | None] | None = None


def read_binary_table(
    path: Path, columns: Columns, variable: str | None, maximum_samples: int
) -> RawTable:
    """Read columns of one group, which ``variable`` selects if several have these columns.

    In a MAT file each column may instead name a variable. The sample period is taken from the file,
    if it states one, and channels that start at different times are aligned. Raises RecordError.
    """
    form = FORMATS[path.suffix.lower()]
    if form.read is _variables and any(column.holds_dates for column in columns.wanted):
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
    rows, period, notes = _aligned(path.name, kind, group, list(found.values()))
    lengths = {name: rows[name].size for name in found.values()}
    if len(set(lengths.values())) > 1:
        sizes = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise RecordError(
            f"the chosen {kind}s of {path.name} differ in length: {sizes}; "
            f"choose {kind}s of one sample rate"
        )
    if max(lengths.values()) > maximum_samples:
        raise too_long(path.name, maximum_samples)
    return RawTable(
        {quantity: rows[name] for quantity, name in found.items()},
        lambda row: f"row {row + 1}",
        period,
        notes,
    )


def text_of_sheet(path: Path, variable: str | None, maximum_samples: int) -> TextFile:
    """The text of a sheet; raises RecordError, also for other formats, with their contents."""
    form = FORMATS[path.suffix.lower()]
    content = _confined(form, path, maximum_samples, variable)
    if isinstance(content, str):
        return TextFile(lambda: io.StringIO(content), path.name, _SEPARATOR)
    raise RecordError(
        f"{path.name} is {form.what} and holds {_listed(form, content)}: describe its "
        "columns (--columns) and name the bag (--output)"
    )


_SAME_END = 0.5
"""Largest difference of two ends, in sample periods, of channels with the same period."""

_SAME_START = 0.01
"""Largest difference of two starts, in sample periods, that is neglected."""


def _aligned(
    file: str, kind: str, group: Group, names: list[str]
) -> tuple[dict[str, Array], float | None, tuple[str, ...]]:
    """The columns from their last common start on, their period [s], and what was changed.

    The period is None if the file does not state it. Columns whose starts differ by a fraction of a
    period are interpolated. Raises RecordError if the periods differ.
    """
    rows = {name: group.columns[name] for name in names}
    notes = (group.note,) if group.note else ()
    stated = {n: group.periods[n] for n in names if group.periods.get(n, 0.0) > 0.0}
    period = next(iter(stated.values())) if len(stated) == len(names) else None
    longest = max(values.size for values in rows.values())
    # Rounded to few digits, periods of one clock differ.
    if stated and (max(stated.values()) / min(stated.values()) - 1.0) * longest > _SAME_END:
        listed = ", ".join(f"{name} {each:.6g} s" for name, each in stated.items())
        raise RecordError(
            f"the chosen {kind}s of {file} have different sample periods: {listed}; choose {kind}s "
            "of one sample rate"
        )
    starts = {name: group.starts[name] for name in names if name in group.starts}
    if len(starts) < 2 or not stated:
        return rows, period, notes
    step_ns = 1e9 * next(iter(stated.values()))
    latest = max(starts.values())
    delays = {name: (latest - start) / step_ns for name, start in starts.items()}
    if max(delays.values()) <= _SAME_START:
        return rows, period, notes
    if len(starts) < len(names):
        missing = ", ".join(name for name in names if name not in starts)
        raise RecordError(
            f"the chosen {kind}s of {file} start at different times, and the start of {missing} is "
            f"unknown: omit {missing}, or choose {kind}s that start together"
        )
    for name, delay in delays.items():
        whole = round(delay)
        part = delay - whole
        values = rows[name][whole:]
        if abs(part) > _SAME_START:
            first = np.arange(len(rows[name]), dtype=float)
            places = first[first + delay <= len(first) - 1] + delay
            values = np.interp(places, first, np.asarray(rows[name], dtype=float))
        rows[name] = values
    size = min(values.size for values in rows.values())
    if size < 2:
        raise RecordError(
            f"the chosen {kind}s of {file} have no time in common: choose {kind}s of one recording"
        )
    later = ", ".join(
        f"{name} {(start - min(starts.values())) * 1e-9:.6g} s"
        for name, start in starts.items()
        if start > min(starts.values())
    )
    said = f"{kind}s start later than others ({later}): only the time that all have was read"
    rows = {name: values[:size] for name, values in rows.items()}
    return rows, period, (*notes, said)


_MOST_NAMED = 20
"""Largest number of parts of a file that a message lists."""


def _listed(form: Format, groups: list[Group]) -> str:
    labels = [group.label for group in groups if group.label]
    more = f" and {len(labels) - _MOST_NAMED} more" if len(labels) > _MOST_NAMED else ""
    return (", ".join(labels[:_MOST_NAMED]) or f"no {form.words[0]} of numbers") + more


def _group(
    name: str, form: Format, groups: list[Group], columns: Columns, variable: str | None
) -> tuple[Group, str]:
    """The group with the selected columns, and a list of the contents of the file or the group."""
    listed = _listed(form, groups)
    groups = [group for group in groups if group.columns]
    least = max(column.position for column in columns.wanted) + 1
    headers = [column.header for column in columns.wanted if column.header]
    if variable is not None:
        fitting = [group for group in groups if group.name == variable]
        if not fitting:
            raise RecordError(f"{name} has no {form.words[0]} '{variable}': it holds {listed}")
        if form.read is _variables and not {*headers} <= set(fitting[0].columns):
            raise RecordError(
                "the columns already name variables of the MAT file: omit the option variable"
            )
    elif headers and form.join and (joined := form.join(name, groups, headers)) is not None:
        return joined, listed
    elif len(groups) == 1 and len(groups[0].columns) > 1:
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


def _named_variables(file: str, groups: list[Group], headers: list[str]) -> Group | None:
    """The variables of a MAT file; None if structures have fields with these names instead."""
    vectors = {g.name: next(iter(g.columns.values())) for g in groups if len(g.columns) == 1}
    fields = any({*headers} <= set(group.columns) for group in groups)
    return None if fields and not {*headers} <= set(vectors) else Group("", "", vectors)


def _same_times(file: str, groups: list[Group], headers: list[str]) -> Group | None:
    """Channels of several groups as one; None if one group has all, or a channel is missing.

    Raises RecordError if the groups have different times, or several groups have a channel.
    """
    if any({*headers} <= set(group.columns) for group in groups):
        return None
    holders: dict[str, Group] = {}
    for header in headers:
        having = [group for group in groups if header in group.columns]
        if any(header != group.clock for group in having) and len(having) > 1:
            names = ", ".join(group.name for group in having)
            raise RecordError(
                f"{file} has the channel '{header}' in several groups ({names}), and none has all "
                "chosen channels: rename it, or export one group"
            )
        if not having:
            return None
        holders[header] = having[0]
    first, *others = {id(group): group for group in holders.values()}.values()
    for other in others:
        if not np.array_equal(first.columns[first.clock], other.columns[other.clock]):
            raise RecordError(
                f"the groups {first.name} and {other.name} of {file} are sampled at different "
                "times: choose channels of one group, or resample the file to one rate"
            )
    columns = {header: group.columns[header] for header, group in holders.items()}
    return Group(first.name, first.label, columns, dict.fromkeys(columns, _period_of(first)))


def _period_of(group: Group) -> float:
    return group.periods.get(group.clock, math.nan)


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
        # What the libraries say is not meant for the user.
        logging.disable()
        warnings.simplefilter("ignore")
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


def _variables(file: BinaryIO, variable: str | None, most_samples: int) -> list[Group]:
    """The real numeric matrices and structures, and a description of everything else."""
    from scipy.io import loadmat  # imported late: see entry_points

    groups: list[Group] = []
    for name, value in loadmat(file).items():
        if not name.startswith("__"):
            groups += _parts(name, value)
    return groups


def _parts(name: str, value: Any) -> Iterator[Group]:
    """The groups in a variable of a MAT file; the parts of a structure have no labels."""
    from scipy.io.matlab import MatlabFunction, MatlabOpaque

    if isinstance(value, MatlabOpaque):
        names = (value[0][each] for each in ("s0", "s2"))
        name, kind = (each.decode() if isinstance(each, bytes) else str(each) for each in names)
        remedy = "save its fields as variables"
        yield Group(name, f"{name} (a MATLAB object of class {kind}: {remedy})", {})
    elif isinstance(value, MatlabFunction) or not isinstance(value, np.ndarray):
        yield Group(name, f"{name} (a {type(value).__name__})", {})
    elif value.dtype.names:
        for place, element in enumerate(value.flat, start=1):
            yield from _structure(name if value.size == 1 else f"{name}({place})", element)
    elif value.dtype.kind == "O":
        yield Group(name, f"{name} (a cell array)", {})
        for place, element in enumerate(value.flat, start=1):
            yield from (replace(g, label="") for g in _parts(f"{name}{{{place}}}", element))
    elif value.ndim == 2 and value.dtype.kind in "fiu":
        # The samples may be rows or columns.
        rows = value if value.shape[0] < value.shape[1] else value.T
        columns = {f"{place}": row for place, row in enumerate(rows, start=1)}
        yield Group(name, f"{name} ({value.shape[0]} x {value.shape[1]})", columns)
    else:
        kind = {"U": "a text", "c": "complex numbers"}.get(value.dtype.kind, "an array")
        yield Group(name, f"{name} ({kind})", {})


def _structure(name: str, element: Any) -> Iterator[Group]:
    """A structure with its vectors as columns, and its parts as variables of their own."""
    parts = {field: list(_parts(field, element[field])) for field in element.dtype.names}
    vectors = _signals(element) if {"time", "signals"} <= set(parts) else {}
    is_output = bool(vectors)
    described = [each.label for inner in parts.values() for each in inner if each.label]
    for each in (group for inner in parts.values() for group in inner):
        # Only a matrix has numbered columns.
        if [*each.columns] == ["1"] and each.columns["1"].size > 1 and not is_output:
            vectors[each.name] = each.columns["1"]
    listed = ", ".join(vectors if is_output else described[:_MOST_NAMED])
    yield Group(name, f"{name} (a structure of {listed or 'nothing'})", vectors)
    for inner in parts.values():
        for each in inner:
            if each.columns and (len(each.columns) == 1 or not is_output):
                yield Group(f"{name}.{each.name}", "", each.columns)


def _signals(element: Any) -> dict[str, Array]:
    """The columns of an output of Simulink (structure with time); empty for other structures.

    A signal has the name of its label, or ``signals(k)``.
    """
    time, signals = element["time"], element["signals"]
    if not (signals.dtype.names and "values" in signals.dtype.names and time.dtype.kind in "fiu"):
        return {}
    columns = {"time": time.ravel()} if time.size else {}
    for place, signal in enumerate(signals.flat, start=1):
        values = signal["values"]
        if values.ndim != 2 or values.dtype.kind not in "fiu":
            continue
        rows = values.T if len(values) == time.size or not time.size else values
        label = signal["label"] if "label" in signals.dtype.names else np.empty(0)
        name = str(label.item()).strip() if label.dtype.kind == "U" and label.size == 1 else ""
        name = name if name and name not in columns else f"signals({place})"
        for number, row in enumerate(rows, start=1):
            columns[name if len(rows) == 1 else f"{name}({number})"] = row
    return columns


def _channels(file: BinaryIO, variable: str | None, most_samples: int) -> list[Group]:
    """All channels with numbers or times, by group."""
    from nptdms import TdmsFile

    with TdmsFile.open(file) as tdms:
        cut = tdms.file_status.incomplete_final_segment
        groups = []
        for each in tdms.groups():
            channels = [c for c in each.channels() if c.dtype.kind in "fiuM" and len(c) > 0]
            if any(len(channel) > most_samples for channel in channels):
                raise MemoryError
            columns = {channel.name: _floats(channel[:]) for channel in channels}
            periods, note = {}, ""
            starts: dict[str, int] = {}
            offsets: dict[str, int] = {}
            for channel in channels:
                given = channel.properties
                periods[channel.name] = float(given.get("wf_increment", math.nan))
                offset = round(1e9 * float(given.get("wf_start_offset", 0.0)))
                # A start that is not set is missing, or the origin of LabVIEW in 1904.
                origin = np.datetime64(given.get("wf_start_time") or 0, "ns").astype(np.int64)
                offsets[channel.name] = offset
                if origin > 0:
                    starts[channel.name] = int(origin) + offset
            sizes = {values.size for values in columns.values()}
            if cut and channels:
                # The channels of an interrupted segment may differ in length.
                columns = {name: values[: min(sizes)] for name, values in columns.items()}
                note = (
                    "the file was not closed, so that its last samples may be missing; "
                    f"{min(sizes)} samples were read"
                )
            if channels:
                begins = starts or offsets
                groups.append(Group(each.name, each.name, columns, periods, begins, note=note))
        return groups


def _measurements(file: BinaryIO, variable: str | None, most_samples: int) -> list[Group]:
    """All channels with numbers, by group; the times of a group are its column ``time``."""
    from asammdf import MDF

    with MDF(file.name) as measured:
        groups: list[Group] = []
        for number, each in enumerate(measured.groups):
            if each.channel_group.cycles_nr > most_samples:
                raise MemoryError
            master = measured.masters_db.get(number)
            columns: dict[str, Array] = {}
            if master is not None and each.channel_group.cycles_nr:
                columns["time"] = np.asarray(measured.get_master(number), dtype=np.float64)
            for place, channel in enumerate(each.channels):
                if place == master:
                    continue
                signal = measured.get(group=number, index=place, ignore_invalidation_bits=True)
                values = np.asarray(signal.samples)
                if values.ndim != 1 or values.dtype.kind not in "fiu" or not values.size:
                    continue
                values = values.astype(np.float64)
                if signal.invalidation_bits is not None:
                    values[np.asarray(signal.invalidation_bits, dtype=bool)] = math.nan
                columns[channel.name] = values
            name = each.channel_group.acq_name or f"group {number + 1}"
            if name in (group.name for group in groups):
                name = f"{name} ({number + 1})"
            periods = dict.fromkeys(columns, _uniform_period(columns.get("time")))
            label = f"{name} ({', '.join(columns)})"
            if len(columns) > 1 or (columns and master is None):
                clock = "time" if "time" in columns else ""
                groups.append(Group(name, label, columns, periods, clock=clock))
        return groups


def _uniform_period(time: Array | None) -> float:
    """Sample period [s] of uniform times; NaN for others."""
    if time is None or time.size < 2:
        return math.nan
    period = float(time[-1] - time[0]) / (time.size - 1)
    uniform = time[0] + period * np.arange(time.size)
    return period if float(np.max(np.abs(time - uniform))) <= _SAME_START * period else math.nan


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
    # Some programs state a wrong dimension, beyond which the library would not read.
    sheets[chosen].reset_dimensions()
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
        _variables,
        ("variable", "matrices", "column"),
        _named_variables,
    ),
    ".mf4": Format(
        "an MF4 file",
        "asammdf",
        "asammdf: install it (pip install asammdf==8.8.28)",
        120.0,
        _measurements,
        ("group", "groups of channels", "channel"),
        _same_times,
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
