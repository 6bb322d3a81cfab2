"""Recordings: invalid ones are rejected with one sentence; recordings by damper."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mr_damper_ros.io.recording_list import ListError, RecordFormat, find_recordings, read_list
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


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"displacement": 5.0 * np.sin(60.0 * TIME)}, "is it in millimetres?"),
        ({"displacement": np.full(100, 0.02)}, "did not move"),
        ({"displacement": 0.2 * np.sin(600.0 * TIME)}, "is the unit of the time right?"),
        ({"period": 1.0}, "is the unit of the time right?"),
        ({"period": 1e-7}, "is the unit of the time right?"),
        ({"force": 1e7 * np.cos(60.0 * TIME)}, "is the unit of the force"),
        ({"force": np.full(100, 3.0)}, "is this the right column?"),
        ({"current": np.full(100, 500.0)}, "is it in milliamperes?"),
        ({"temperature": np.full(100, 301.0)}, "is it in kelvin?"),
    ],
)
def test_wrong_units_are_named(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(RecordingError, match=r".") as error:
        recording(**changes).check_plausible()
    assert sentence in str(error.value)


def test_a_damper_in_its_units_is_plausible() -> None:
    recording(temperature=np.full(100, 28.0)).check_plausible()


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


# -- recordings in a folder, and the damper of each ------------------------------------------------


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


@pytest.fixture
def lot(tmp_path: Path) -> Path:
    """Two dampers with one folder each, bags as folders and files, and other files."""
    root = tmp_path / "lot"
    touch(
        root / "D1" / "slow" / "metadata.yaml",
        root / "D1" / "slow" / "data.mcap",
        root / "D1" / "D1_fast.mcap",
        root / "D2" / "D2_0.5A.mcap",
        root / "D2" / "D2_1.0A.csv",
        root / "notes.txt",
    )
    return root


def names(*sources: Path | str, **options: object) -> dict[str, list[str]]:
    found, _ = find_recordings(sources, **options)  # type: ignore[arg-type]
    groups: dict[str, list[str]] = {}
    for recording in found:
        groups.setdefault(recording.damper, []).append(recording.path.name)
    return groups


def test_recordings_are_found_and_named_as_asked(lot: Path) -> None:
    assert names(lot) == {"D1": ["D1_fast.mcap", "slow"], "D2": ["D2_0.5A.mcap"]}
    assert names(lot / "D2", with_records=True) == {"D2": ["D2_0.5A.mcap", "D2_1.0A.csv"]}
    assert names(str(lot / "*" / "*.mcap")) == {"D1": ["D1_fast.mcap"], "D2": ["D2_0.5A.mcap"]}
    assert names(lot, pattern=r"D(\d)/") == {"1": ["D1_fast.mcap", "slow"], "2": ["D2_0.5A.mcap"]}
    pattern = r"(?P<damper>D\d)_(?P<current>[\d.]+)A"
    found, left_out = find_recordings([lot], pattern=pattern, with_records=True)
    assert {r.path.name: r.current for r in found} == {"D2_0.5A.mcap": 0.5, "D2_1.0A.csv": 1.0}
    assert {entry.path.name for entry in left_out} == {"D1_fast.mcap", "slow", "notes.txt"}
    assert names(lot, lot / "D2") == names(lot)


@pytest.mark.parametrize(
    ("source", "options", "sentence"),
    [
        ("nowhere", {}, "there is no "),
        ("lot/*/none*", {}, "there is no recording in"),
        ("lot/notes.txt", {}, "there is no recording in"),
        ("lot", {"pattern": "(D"}, "is not a regular expression"),
        ("lot", {"pattern": "D."}, "has no group"),
    ],
)
def test_what_finds_nothing_is_refused_in_a_sentence(
    lot: Path, source: str, options: dict[str, str], sentence: str
) -> None:
    with pytest.raises(ListError, match=sentence.replace("(", r"\(")):
        find_recordings([lot.parent / source], **options)  # type: ignore[arg-type]


def test_a_list_names_paths_dampers_and_currents(tmp_path: Path) -> None:
    file = tmp_path / "runs.csv"
    file.write_text(
        "damper,path,current\nA,one.csv,0.5\nB,two,\nA,sub/three.csv,1\nA,four,much\n,five,1\n"
    )
    found, left_out = read_list(file)
    assert [entry.path.name for entry in left_out] == ["four", "five"]
    assert [(r.damper, r.path, r.current) for r in found] == [
        ("A", tmp_path / "one.csv", 0.5),
        ("B", tmp_path / "two", None),
        ("A", tmp_path / "sub" / "three.csv", 1.0),
    ]


@pytest.mark.parametrize(
    "text",
    ["", "path\n1\n", "damper\nA\n", "\x00", "path,damper\n", "path,damper\n1,A\nx/../1,B\n"],
)
def test_a_file_that_is_no_list_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "runs.csv"
    file.write_text(text)
    with pytest.raises(ListError):
        read_list(file)


@pytest.mark.parametrize(("listed", "current"), [(None, 0.5), (1.0, 1.0)])
def test_the_current_of_a_list_overrides_that_of_the_format(
    tmp_path: Path, listed: float | None, current: float
) -> None:
    file = tmp_path / "run.csv"
    np.savetxt(file, np.column_stack((np.sin(20.0 * TIME), np.cos(20.0 * TIME))), delimiter=",")
    read = RecordFormat("displacement:mm,force:N", current=0.5, period=1e-3).read(file, listed)
    assert set(read.current) == {current}
