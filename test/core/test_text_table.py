"""Text records of any size, and MAT files in a separate process, which may crash or hang."""

import os
import socket
import tracemalloc
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pool_tasks
import pytest
from scipy.io import savemat

from mr_damper_ros.io import binary_tables
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.io.columns import MAXIMUM_SAMPLES, RecordError, parse_columns
from mr_damper_ros.io.records import read_record
from mr_damper_ros.io.text_tables import read_text_table
from mr_damper_ros.signals.arrays import Array

TEXT_COLUMNS = "time:s,displacement:mm,force:N"


def text_file(path: Path, rows: int) -> Path:
    numbers = np.arange(rows)
    table = np.column_stack((1e-3 * numbers, 5.0 * np.sin(0.01 * numbers), 1e3 * np.cos(numbers)))
    np.savetxt(path, table, fmt="%.6f", delimiter=",")
    return path


def test_memory_is_that_of_the_numbers(tmp_path: Path) -> None:
    rows = 150_000
    path = text_file(tmp_path / "run.csv", rows)
    tracemalloc.start()
    table = read_text_table(path, parse_columns(TEXT_COLUMNS), None, rows)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert table.values["force"].size == rows
    # Three numbers of eight bytes, twice, because the parts are joined at the end; and 12 MB to
    # parse fifty thousand lines at a time.
    assert peak < 60 * rows + 12_000_000


def test_the_progress_is_that_of_the_file(tmp_path: Path) -> None:
    path = text_file(tmp_path / "run.csv", 50_000)
    seen: list[float] = []
    run = read_record(path, TEXT_COLUMNS, current=0.5, progress=seen.append)
    assert seen == sorted(seen)
    assert len(seen) > 2
    assert seen[-1] == 1.0
    seen.clear()
    write_bag(tmp_path / "bag", run, progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


def test_a_file_with_more_samples_than_allowed_is_refused(tmp_path: Path) -> None:
    path = text_file(tmp_path / "run.csv", 100)
    assert read_record(path, TEXT_COLUMNS, current=0.5, maximum_samples=100).sample_count == 100
    with pytest.raises(RecordError, match=r"run.csv holds more than 99 samples: split it"):
        read_record(path, TEXT_COLUMNS, current=0.5, maximum_samples=99)


@pytest.mark.parametrize("length", [100_001, 1_000_000])
def test_a_line_without_end_is_refused(tmp_path: Path, length: int) -> None:
    path = tmp_path / "run.csv"
    path.write_text("0,1,2\n" + "7" * length + ",1,2\n", encoding="utf-8")
    with pytest.raises(RecordError, match=r"line 2 of run.csv has more than 100000 characters"):
        read_record(path, TEXT_COLUMNS, current=0.5)


def test_an_interrupt_within_a_date_ends_the_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dates = count()

    def date(text: str) -> float:
        if next(dates) == 1:  # NumPy reads all dates but the first
            raise KeyboardInterrupt
        return 1.0

    monkeypatch.setattr("mr_damper_ros.io.text_tables.seconds_since_1970", date)
    columns = parse_columns("time:datetime,displacement:mm,force:N")
    with pytest.raises(KeyboardInterrupt):
        read_text_table(text_file(tmp_path / "run.csv", 10), columns, None, 10)


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
        read_record(path, TEXT_COLUMNS, current=0.5)


# -- MAT files are read in a separate process, which may crash or hang -----------------------------

MATRIX = np.arange(12.0).reshape(4, 3)
UNREADABLE = "run.mat cannot be read as a MAT file: save it again, or export it as CSV"

COLUMNS = parse_columns("time:s,displacement:m,force:N")


def matrix(path: Path, maximum_samples: int = MAXIMUM_SAMPLES) -> Array:
    values = binary_tables.read_binary_table(path, COLUMNS, None, maximum_samples).values
    return np.column_stack([values[name] for name in ("time", "displacement", "force")])


def written(path: Path, content: dict[str, object]) -> Path:
    savemat(path, content)
    return path


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int16, np.uint8])
def test_a_matrix_comes_as_it_was_saved(tmp_path: Path, kind: type) -> None:
    read = matrix(written(tmp_path / "run.mat", {"a": MATRIX.astype(kind), "row": MATRIX[:1]}))
    assert read.dtype == kind
    np.testing.assert_array_equal(read, MATRIX)


def test_a_reader_that_is_killed_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(binary_tables, "_read", pool_tasks.crash)
    with pytest.raises(RecordError) as caught:
        matrix(written(tmp_path / "run.mat", {"data": MATRIX}))
    assert str(caught.value) == UNREADABLE


def test_reading_is_cut_after_a_time_that_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Loading SciPy alone takes longer.
    hasty = replace(binary_tables.FORMATS[".mat"], time_limit=0.001)
    monkeypatch.setitem(binary_tables.FORMATS, ".mat", hasty)
    with pytest.raises(RecordError, match=r"could not be read within 0\.001 s"):
        matrix(written(tmp_path / "run.mat", {"data": MATRIX}))


def test_a_file_that_unpacks_to_more_than_the_limit_is_refused(tmp_path: Path) -> None:
    # Fifty megabytes of zeros in fifty kilobytes.
    path = tmp_path / "run.mat"
    savemat(path, {"data": np.zeros((1_500_000, 4))}, do_compression=True)
    assert path.stat().st_size < 1_000_000
    with pytest.raises(RecordError, match="holds more than 1000 samples"):
        matrix(path, maximum_samples=1000)
