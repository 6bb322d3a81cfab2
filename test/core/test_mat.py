"""MAT files are read in a process of their own, which may crash or hang."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pool_tasks
import pytest
from scipy.io import savemat

from mr_damper_ros.io import binary_tables
from mr_damper_ros.io.columns import MAXIMUM_SAMPLES, RecordError, parse_columns
from mr_damper_ros.signals.arrays import Array

MATRIX = np.arange(12.0).reshape(4, 3)
UNREADABLE = "run.mat is not a MAT file that can be read: save it again, or export it as CSV"

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
