"""Channels of ASAM MF4 files are read by name, each with the times of its group."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mr_damper_ros.io.columns import RecordError
from mr_damper_ros.io.records import read_record

asammdf = pytest.importorskip("asammdf", reason="asammdf is missing: pip install asammdf")

TIME = np.arange(200) * 0.01
DISPLACEMENT = 5.0 * np.sin(20.0 * TIME)
FORCE = 900.0 * np.cos(20.0 * TIME)

COLUMNS = "time=time:s,displacement=Stroke:mm,force=Load:N"


def measured(path: Path, *groups: dict[str, np.ndarray], times: Any = ()) -> Path:
    """A file whose groups have these channels, sampled at ``times`` (TIME if not given)."""
    with asammdf.MDF(version="4.10") as file:
        for number, group in enumerate(groups, start=1):
            time = times[number - 1] if times else TIME
            signals = [asammdf.Signal(v, time, name=n) for n, v in group.items()]
            file.append(signals, acq_name=f"Run {number}")
        file.save(path, overwrite=True)
    return path


def assert_is_the_run(path: Path, columns: str = COLUMNS, **options: Any) -> None:
    read = read_record(path, columns, current=0.5, **options)
    np.testing.assert_allclose(read.displacement, 1e-3 * DISPLACEMENT, rtol=1e-12)
    np.testing.assert_allclose(read.force, FORCE, rtol=1e-12)
    assert read.period == pytest.approx(0.01, rel=1e-9)


def refused(path: Path, columns: str = COLUMNS, **options: Any) -> str:
    with pytest.raises(RecordError) as caught:
        read_record(path, columns, current=0.5, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


BOTH = {"Stroke": DISPLACEMENT, "Load": FORCE}


def test_channels_are_columns(tmp_path: Path) -> None:
    path = measured(tmp_path / "run.mf4", BOTH)
    assert_is_the_run(path)
    assert_is_the_run(path, "displacement=Stroke:mm,force=Load:N")
    assert_is_the_run(path, "time:s,displacement:mm,force:N")


def test_a_group_is_chosen_by_its_name(tmp_path: Path) -> None:
    path = measured(tmp_path / "run.mf4", BOTH, BOTH)
    assert "choose one by the option variable; it holds Run 1 (time, Stroke, Load)" in refused(path)
    assert_is_the_run(path, variable="Run 2")


def test_groups_with_the_same_times_are_joined(tmp_path: Path) -> None:
    path = measured(tmp_path / "run.mf4", {"Stroke": DISPLACEMENT}, {"Load": FORCE})
    assert_is_the_run(path)
    assert_is_the_run(path, "displacement=Stroke:mm,force=Load:N")


@pytest.mark.parametrize("change", ["rate", "start", "length"])
def test_groups_with_different_times_are_refused(tmp_path: Path, change: str) -> None:
    time = {"rate": 2.0 * TIME, "start": TIME + 0.004, "length": TIME[:-1]}[change]
    groups = {"Stroke": DISPLACEMENT}, {"Load": FORCE[: time.size]}
    path = measured(tmp_path / "run.mf4", *groups, times=(TIME, time))
    assert "the groups Run 1 and Run 2 of run.mf4 are sampled at different times" in refused(path)


def test_a_channel_that_is_missing_is_named(tmp_path: Path) -> None:
    path = measured(tmp_path / "run.mf4", BOTH)
    sentence = refused(path, "displacement=Weg:mm,force=Load:N")
    assert "has no channel 'Weg': it holds time, Stroke, Load" in sentence


def test_an_invalid_sample_is_not_read(tmp_path: Path) -> None:
    bits = np.zeros(200, dtype=bool)
    bits[20] = True
    with asammdf.MDF(version="4.10") as file:
        file.append(
            [
                asammdf.Signal(DISPLACEMENT, TIME, name="Stroke"),
                asammdf.Signal(FORCE, TIME, name="Load", invalidation_bits=bits),
            ]
        )
        file.save(tmp_path / "run.mf4", overwrite=True)
    assert "the force in row 21 of run.mf4 is nan" in refused(tmp_path / "run.mf4")


def test_a_damaged_file_is_one_sentence(tmp_path: Path) -> None:
    path = measured(tmp_path / "run.mf4", BOTH)
    path.write_bytes(path.read_bytes()[:900])
    assert "cannot be read as an MF4 file" in refused(path)
    path.write_bytes(b"MDF     " + bytes(1000))
    assert "cannot be read as an MF4 file" in refused(path)
    whole = measured(tmp_path / "whole.mf4", BOTH)
    assert "holds more than 100 samples" in refused(whole, maximum_samples=100)
