"""Recordings: invalid ones are rejected with one sentence; bags in folders."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mr_damper_ros.io.bag_list import BagListError, find_bags
from mr_damper_ros.signals.recording import NotFiniteError, Recording, RecordingError

TIME = np.arange(100) * 1e-3


def recording(**changes: Any) -> Recording:
    fields: dict[str, Any] = {
        "name": "run",
        "start_ns": 1_700_000_000_000_000_000,
        "period": 1e-3,
        "displacement": 0.005 * np.sin(60.0 * TIME),
        "force": 1000.0 * np.cos(60.0 * TIME),
        "current": np.full(100, 0.5),
    }
    return Recording(**{**fields, **changes})


def changed(values: np.ndarray, index: int, value: float) -> np.ndarray:
    values = values.copy()
    values[index] = value
    return values


@pytest.mark.parametrize("quantity", ["displacement", "force", "current", "temperature"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 9.91e37])
def test_the_door_refuses_what_is_not_finite(quantity: str, value: float) -> None:
    with pytest.raises(NotFiniteError) as error:
        recording(**{quantity: changed(TIME, 42, value)})
    assert (error.value.quantity, error.value.sample) == (quantity, 42)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"period": 0.0}, "the sample period of 'run' is 0.0 s: it must be positive"),
        ({"period": 1e-200}, "it must be positive, 1e-9 to 1e9"),
        ({"period": np.nan}, "it must be positive"),
        ({"period": [1e-3, 1e-3]}, "it must be positive"),
        ({"displacement": np.empty(0)}, "holds no samples"),
        ({"displacement": np.zeros((100, 2))}, "shape"),
        ({"force": np.zeros(99)}, "'run' holds 100 displacements but 99 values of force"),
        ({"temperature": np.zeros(3)}, "3 values of temperature"),
        ({"force": changed(TIME, 7, np.nan)}, "the force of sample 7 of 'run' is nan"),
        ({"force": np.ma.masked_equal(np.arange(100), 7)}, "the force of sample 7 of 'run' is nan"),
        ({"current": changed(TIME, 99, np.inf)}, "the current of sample 99 of 'run' is inf"),
    ],
)
def test_what_is_no_recording_is_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(RecordingError) as error:
        recording(**changes)
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


def test_a_recording_cannot_be_changed_afterwards() -> None:
    displacement = 0.005 * np.sin(60.0 * TIME)
    made = recording(displacement=displacement)
    displacement[:] = 0.0
    assert np.ptp(made.displacement) > 0.0
    with pytest.raises(ValueError, match="read-only"):
        made.force[0] = 0.0


def test_stamps_follow_the_period_to_the_nanosecond() -> None:
    made = recording(period=np.array([[1.0 / 3.0]]), start_ns=17)  # a number of a MAT file
    assert made.stamp_ns(3) == 17 + 1_000_000_000
    assert made.stamp_ns(1) == 17 + 333_333_333
    assert made.duration == pytest.approx(100.0 / 3.0)


# -- bags in a folder ------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Bags as folders and files in two folders, and other files."""
    paths = ("D1/slow/metadata.yaml", "D1/slow/data.mcap", "D1/fast.mcap", "D2/a.mcap", "D2/b.csv")
    for path in (tmp_path / "all" / each for each in (*paths, "notes.txt")):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return tmp_path / "all"


def test_bags_are_found_in_folders_and_patterns(folder: Path) -> None:
    every = [folder / "D1" / "fast.mcap", folder / "D1" / "slow", folder / "D2" / "a.mcap"]
    assert sorted(find_bags([folder])) == every
    assert find_bags([str(folder / "*" / "*.mcap")]) == [every[0], every[2]]
    assert sorted(find_bags([folder, folder / "D2"])) == every


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ("nowhere", "there is no "),
        ("all/*/none*", "there is no bag in"),
        ("all/notes.txt", "there is no bag in"),
    ],
)
def test_what_finds_no_bag_is_refused_in_a_sentence(
    folder: Path, source: str, sentence: str
) -> None:
    with pytest.raises(BagListError, match=sentence):
        find_bags([folder.parent / source])
