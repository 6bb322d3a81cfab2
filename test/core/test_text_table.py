"""Text records of any size: read line by line, refused where they are none or too long."""

from __future__ import annotations

import os
import socket
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from mr_damper_ros.io.columns import RecordError, parse_columns
from mr_damper_ros.io.records import read_record
from mr_damper_ros.io.text_table import read_text_table

COLUMNS = "time:s,displacement:mm,force:N"


def written(path: Path, rows: int) -> Path:
    numbers = np.arange(rows)
    table = np.column_stack((1e-3 * numbers, 5.0 * np.sin(0.01 * numbers), 1e3 * np.cos(numbers)))
    np.savetxt(path, table, fmt="%.6f", delimiter=",")
    return path


def test_memory_is_that_of_the_numbers(tmp_path: Path) -> None:
    rows = 150_000
    path = written(tmp_path / "run.csv", rows)
    tracemalloc.start()
    table = read_text_table(path, parse_columns(COLUMNS), None, rows)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert table.row_count == rows
    # Of three numbers of eight bytes, twice: what has been read is joined at the end.
    # Bytes: fifty thousand lines are parsed at a time.
    assert peak < 60 * rows + 12_000_000


def test_a_file_with_more_samples_than_allowed_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "run.csv", 100)
    assert read_record(path, COLUMNS, current=0.5, maximum_samples=100).sample_count == 100
    with pytest.raises(RecordError, match=r"run.csv holds more than 99 samples: split it"):
        read_record(path, COLUMNS, current=0.5, maximum_samples=99)


@pytest.mark.parametrize("length", [100_001, 1_000_000])
def test_a_line_without_end_is_refused(tmp_path: Path, length: int) -> None:
    path = tmp_path / "run.csv"
    path.write_text("0,1,2\n" + "7" * length + ",1,2\n", encoding="utf-8")
    with pytest.raises(RecordError, match=r"line 2 of run.csv has more than 100000 characters"):
        read_record(path, COLUMNS, current=0.5)


@pytest.mark.parametrize("place", range(5))
def test_no_column_lets_in_what_is_not_finite(tmp_path: Path, place: int) -> None:
    quantities = ("time:s", "displacement:mm", "force:N", "current:A", "temperature:degC")
    rows = np.column_stack((1e-3 * np.arange(50), *np.random.default_rng(0).random((4, 50))))
    rows[20, place] = np.inf
    path = tmp_path / "run.csv"
    np.savetxt(path, rows, delimiter=",")
    quantity = quantities[place].partition(":")[0]
    with pytest.raises(RecordError, match=f"the {quantity} in line 21 of run.csv is inf"):
        read_record(path, ",".join(quantities))


@pytest.mark.parametrize("suffix", [".csv", ".mat"])
@pytest.mark.parametrize("kind", ["a named pipe", "a socket", "a device", "a folder"])
def test_what_may_never_end_is_not_read(tmp_path: Path, kind: str, suffix: str) -> None:
    path = tmp_path / f"run{suffix}"
    if kind == "a named pipe":
        os.mkfifo(path)
    elif kind == "a socket":
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(str(path))
    elif kind == "a device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    with pytest.raises(RecordError, match=f"run{suffix} is {kind}: give a text, CSV, MAT"):
        read_record(path, COLUMNS, current=0.5)
