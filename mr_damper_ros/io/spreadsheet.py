"""Columns from a sheet of a spreadsheet, read with openpyxl in a process of its own."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import sys
from collections.abc import Iterable
from datetime import date, time, timedelta
from pathlib import Path

from mr_damper_ros.io.columns import Columns
from mr_damper_ros.io.confined_reading import limit_memory, limit_time, memory_for, run_confined
from mr_damper_ros.io.raw_table import RawTable, RecordError, too_long
from mr_damper_ros.io.text_table import TextFile

TIME_LIMIT = 300.0
"""Seconds that reading may take: a full sheet has a million rows."""

_SEPARATOR = "\t"

_HEAD_ROWS = 1000
"""Rows that may stand before the first sample, and be empty."""

_NO_LIBRARY, _DAMAGED, _TOO_LARGE, _CHOOSE = 4, 5, 6, 7
"""Exit codes of the child."""


def read_spreadsheet(
    path: Path, columns: Columns, variable: str | None, maximum_samples: int
) -> RawTable:
    """Read columns of one sheet, ``variable`` where there are several. Raises RecordError.

    Cells hold numbers or text; a formula is read as the value that was saved with it.
    """
    memory, rows = memory_for(maximum_samples), maximum_samples + _HEAD_ROWS
    code, stream = run_confined(
        serve, path, str(TIME_LIMIT), str(memory), variable or "", str(rows)
    )
    if code == _CHOOSE:
        asked = f"no sheet '{variable}'" if variable else "several sheets"
        listed = ", ".join(json.load(stream))
        raise RecordError(f"{path.name} has {asked}: choose one as the variable, of {listed}")
    if code == _TOO_LARGE:
        raise too_long(path.name, maximum_samples)
    if code != 0:
        raise RecordError(f"{path.name} {_reason(code)}")
    # The text stays there as long as rows may be named.
    text = TextFile(Path(f"/proc/self/fd/{stream.fileno()}"), path.name, "utf-8", _SEPARATOR)
    table = text.table(columns, maximum_samples)
    return RawTable(table.values, lambda row: "" if stream.closed else table.place(row))


def _reason(code: int) -> str:
    if code == _NO_LIBRARY:
        return (
            "is a spreadsheet, which needs openpyxl: install it (pip install openpyxl==3.1.5, or "
            "python3-openpyxl of Ubuntu), or save the sheet as CSV"
        )
    if code == -signal.SIGALRM:
        return f"could not be read within {TIME_LIMIT:g} s: save the sheet as CSV"
    return "is not a spreadsheet that can be read: save it again, or save the sheet as CSV"


def serve(time_limit: str, memory_limit: str, sheet: str, most_rows: str, result: str) -> None:
    """Be the child: the sheet on standard input becomes lines of text, its rows."""
    limit_time(float(time_limit))
    try:
        from openpyxl import load_workbook
    except ImportError:
        raise SystemExit(_NO_LIBRARY) from None
    try:
        limit_memory(int(memory_limit))
        book = load_workbook(sys.stdin.buffer, read_only=True, data_only=True)
        sheets = {page.title: page for page in book.worksheets}
        chosen = sheet or (next(iter(sheets)) if len(sheets) == 1 else "")
        with open(int(result), "w", encoding="utf-8", newline="") as stream:
            if chosen not in sheets:
                json.dump(list(sheets), stream)
                stream.flush()
                os._exit(_CHOOSE)
            for number, row in enumerate(sheets[chosen].iter_rows(values_only=True)):
                if number == int(most_rows):
                    os._exit(_TOO_LARGE)
                stream.write(_line(row))
    except (MemoryError, OSError):
        raise SystemExit(_TOO_LARGE) from None
    except Exception:
        # Damaged bytes surface in the library as exceptions of many kinds.
        raise SystemExit(_DAMAGED) from None


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
