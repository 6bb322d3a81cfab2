"""Moving averages: detected in a record, reversed, and reported."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mr_damper_ros as mr
from mr_damper_ros.api.measured_runs import findings_on, measured_runs
from mr_damper_ros.data_check.findings import Kind
from mr_damper_ros.io.columns import RecordError
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.moving_average import find_average, undo_average, undo_average_in_motion

WRITTEN = 1e-4
"""[mm], [N]: twelve digits of numbers up to 1e4 are written, and thousands of roundings add up."""

LOST = 0.02
"""Relative: content of a steady motion at the frequencies that the average removes."""

SAMPLES = 6000
COUNT = 50


def averaged(values: Array, count: int) -> Array:
    """Mean (n,) of each sample and its ``count - 1`` predecessors, at rest before the first."""
    sums = np.cumsum(values - values[0])
    before = np.concatenate([np.zeros(count), sums[:-count]])[: sums.size]
    return np.asarray(values[0] + (sums - before) / count)


def motion(seed: int = 0, samples: int = SAMPLES) -> Array:
    """Random motion that begins with a rest of 100 samples."""
    steps = np.random.default_rng(seed).normal(size=samples)
    steps[:100] = 0.0
    return np.asarray(np.convolve(np.cumsum(steps), [0.25, 0.5, 0.25], "same"))


@settings(max_examples=50, deadline=None)
@given(count=st.integers(2, 400), seed=st.integers(0, 1000))
def test_undone_is_what_was_averaged(count: int, seed: int) -> None:
    values = motion(seed, 1000)
    size = np.abs(values).max()
    # Relative: sums over the whole signal.
    assert np.allclose(undo_average(averaged(values, count), count), values, atol=1e-9 * size)


@pytest.mark.parametrize("part", [slice(777, 5777), slice(1500, 5000)])
def test_a_record_cut_out_of_the_middle_comes_back_but_for_what_is_lost(part: slice) -> None:
    displacement = np.sin(np.arange(SAMPLES) * 2.0 * np.pi / 480.0 + 0.4)
    for values in (displacement, np.tanh(5.0 * displacement)):
        found = undo_average_in_motion(averaged(values, COUNT)[part], COUNT)
        assert np.std(found - values[part]) < LOST * np.std(values)
        assert np.mean(found) == pytest.approx(np.mean(values[part]), abs=LOST)


@pytest.mark.parametrize("count", [10, 33, 100])
def test_the_length_of_an_average_is_found(count: int) -> None:
    assert find_average(averaged(motion(), count)) == count


@pytest.mark.parametrize("seed", range(10))
def test_none_is_seen_where_there_is_none(seed: int) -> None:
    assert find_average(motion(seed)) == 1


def written(folder: Path, displacement: Array, force: Array) -> Path:
    path = folder / "run.csv"
    np.savetxt(path, np.column_stack([displacement, force]), delimiter=",", fmt="%.12g")
    return path


def test_a_record_is_imported_as_it_was_before_the_average(tmp_path: Path) -> None:
    displacement, force = motion(3), 100.0 * motion(4)
    path = written(tmp_path, averaged(displacement, COUNT), averaged(force, COUNT))
    found = mr.read_record(
        path, "displacement:mm,force:N", current=1.0, period=1e-3, moving_average=COUNT
    )
    assert found.details["smoothing"] == "a moving average over 50 samples was undone"
    assert np.allclose(1e3 * found.displacement, displacement, atol=WRITTEN)
    assert np.allclose(found.force, force, atol=WRITTEN)


def test_a_record_that_begins_in_motion_is_undone_where_that_is_said(tmp_path: Path) -> None:
    displacement, force = np.sin(np.arange(SAMPLES) * 0.013), np.sin(np.arange(SAMPLES) * 0.013 + 1)
    late = slice(1000, None)
    path = written(tmp_path, averaged(displacement, COUNT)[late], averaged(force, COUNT)[late])
    found = mr.read_record(
        path,
        "displacement:mm,force:N",
        current=1.0,
        period=1e-3,
        moving_average=COUNT,
        begins_in_motion=True,
    )
    assert np.std(found.force - force[late]) < LOST * np.std(force)


@pytest.mark.parametrize(
    ("begin", "count", "reason"),
    [
        (2000, COUNT, "does not rest in the first 50 samples"),
        (0, 1, "cannot be undone in a record of 6000"),
        (0, SAMPLES, "cannot be undone in a record of 6000"),
    ],
)
def test_what_cannot_be_undone_is_refused(
    tmp_path: Path, begin: int, count: int, reason: str
) -> None:
    path = written(tmp_path, motion(3)[begin:], motion(4)[begin:])
    with pytest.raises(RecordError, match=reason):
        mr.read_record(
            path, "displacement:mm,force:N", current=1.0, period=1e-3, moving_average=count
        )


@pytest.mark.parametrize("in_motion", [False, True])
def test_an_average_that_never_was_is_not_undone(in_motion: bool) -> None:
    path = Path(__file__).parents[2] / "doc" / "example.csv"
    columns, more = "time:s,displacement:mm,force:N", {"begins_in_motion": in_motion}
    with pytest.raises(RecordError, match="a pattern of 5 samples makes up"):
        mr.read_record(path, columns, current=0.5, moving_average=5, **more)


@pytest.mark.skipif("MR_DAMPER_DATA" not in os.environ, reason="MR_DAMPER_DATA is not set")
def test_the_average_of_a_real_record_is_found() -> None:
    path = Path(os.environ["MR_DAMPER_DATA"], "utfsm", "earthquake.mat")
    record = mr.read_record(
        path, "displacement:mm,force:N,-,-", current=0.2, period=1e-3, variable="data"
    )
    # According to the manufacturer.
    assert [find_average(record.displacement), find_average(record.force)] == [300, 300]


def test_a_cut_record_too_short_for_its_average_is_refused() -> None:
    with pytest.raises(ValueError, match="1000 are needed"):
        undo_average_in_motion(motion()[:900], COUNT)


def test_what_was_averaged_is_said_of_a_run() -> None:
    moved = 1e-4 * motion(3)
    displacement, force = averaged(moved, COUNT), averaged(5e3 * np.gradient(moved, 1e-3), COUNT)
    runs = measured_runs([], (displacement, force, 1.0, 1e-3), accept_doubtful=True)
    smoothed = [each for each in findings_on(runs) if each.kind is Kind.SMOOTHED]
    assert {each.value for each in smoothed} == {50.0}
