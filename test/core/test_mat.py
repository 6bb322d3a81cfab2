"""MAT files are read in a process of their own, which may crash or hang."""

from __future__ import annotations

import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pool_tasks
import pytest
from scipy.io import savemat

from mr_damper_ros.io import mat

MATRIX = np.arange(12.0).reshape(4, 3)
UNREADABLE = "is not a MAT file that can be read: save it again, or export it as CSV"


def written(path: Path, content: dict[str, object]) -> Path:
    savemat(path, content)
    return path


def malformed(path: Path) -> Path:
    """A file that SciPy 1.11 to 1.17 crash on: the type of its text is 144; there are 18."""
    stored = BytesIO()
    savemat(stored, {"data": MATRIX, "name": "x"})
    content = bytearray(stored.getvalue())
    assert content[-8:] == b"\x10\0\x01\0x\0\0\0"
    content[-8] = 144
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.int16, np.uint8])
def test_matrices_come_as_they_were_saved(tmp_path: Path, kind: type) -> None:
    stored = {"a": MATRIX.astype(kind), "row": MATRIX[:1].astype(kind)}
    read = mat.read_matrices(written(tmp_path / "run.mat", stored))
    assert list(read) == ["a", "row"]
    for name, array in read.items():
        assert array.dtype == kind
        np.testing.assert_array_equal(array, stored[name])


def test_what_is_no_real_matrix_of_numbers_is_left_out(tmp_path: Path) -> None:
    others = {"text": "x", "cells": np.array([1, "a"], dtype=object), "complex": 1j * MATRIX}
    path = written(tmp_path / "run.mat", {**others, "cube": np.ones((2, 2, 2))})
    assert mat.read_matrices(path) == {}


def test_a_file_that_crashes_the_reader_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(mat.MatError) as caught:
        mat.read_matrices(malformed(tmp_path / "run.mat"))
    assert str(caught.value) == UNREADABLE


def test_a_reader_that_is_killed_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mat, "serve", pool_tasks.crash)
    with pytest.raises(mat.MatError) as caught:
        mat.read_matrices(written(tmp_path / "run.mat", {"data": MATRIX}))
    assert str(caught.value) == UNREADABLE


def test_reading_is_cut_after_a_time_that_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Loading SciPy alone takes longer.
    monkeypatch.setattr(mat, "TIME_LIMIT", 0.001)
    with pytest.raises(mat.MatError, match=r"could not be read within 0\.001 s"):
        mat.read_matrices(written(tmp_path / "run.mat", {"data": MATRIX}))


def test_nothing_beside_the_file_is_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scipy.py").write_text("raise SystemExit(1)", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    read = mat.read_matrices(written(tmp_path / "run.mat", {"data": MATRIX}))
    np.testing.assert_array_equal(read["data"], MATRIX)


def test_a_file_that_unpacks_to_more_than_the_limit_is_refused(tmp_path: Path) -> None:
    # Two hundred megabytes of zeros in two hundred kilobytes.
    path = tmp_path / "run.mat"
    savemat(path, {"data": np.zeros((6_000_000, 4))}, do_compression=True)
    assert path.stat().st_size < 1_000_000
    with pytest.raises(mat.MatError, match="needs more than 100 MB to be read"):
        mat.read_matrices(path, maximum_samples=1000)


def test_the_limit_is_raised_with_the_samples_that_are_allowed(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    savemat(path, {"data": np.zeros((6_000_000, 4))}, do_compression=True)
    assert mat.read_matrices(path, maximum_samples=6_000_000)["data"].shape == (6_000_000, 4)
