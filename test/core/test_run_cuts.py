"""A record of several runs is split at their ends: pauses, rests, currents, phases."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import known
import numpy as np
import pytest

from mr_damper_ros.api.measured_runs import findings_on, measured_runs
from mr_damper_ros.data_check.findings import NOTE
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.columns import RecordError
from mr_damper_ros.io.records import RunsOfFile, read_runs
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tools import import_

RATE = 200.0

COLUMNS = "time:s,displacement:m,force:N"

TO_A_BLOCK = 0.25
"""[s]: rests are found with a resolution of 0.1 s, and one block remains at each end."""


def cycles(
    amplitude: float, frequency: float, seconds: float, yield_force: float = 800.0
) -> np.ndarray:
    """Displacement and force, shape (2, n), of a sine from rest to rest."""
    time = np.arange(round(seconds * RATE)) / RATE
    phase = 2.0 * np.pi * frequency * time
    return np.stack([amplitude * np.sin(phase), yield_force * np.tanh(3.0 * np.cos(phase))])


def rest(seconds: float) -> np.ndarray:
    return np.zeros((2, round(seconds * RATE)))


def write(path: Path, parts: Sequence[np.ndarray], *more: np.ndarray, pause: float = 0.0) -> Path:
    """A file of the parts in sequence, with a pause of the logger between them."""
    values = np.concatenate(parts, axis=1)
    # [m] of the displacement.
    values = values + np.random.default_rng(0).normal(0.0, [[2e-6], [2.0]], values.shape)
    pauses = np.repeat(np.arange(len(parts)) * pause, [part.shape[1] for part in parts])
    time = np.arange(values.shape[1]) / RATE + pauses
    np.savetxt(path, np.stack([time, *values, *more], axis=1), fmt="%.9g", delimiter=",")
    return path


def durations(path: Path, columns: str = COLUMNS, **options: Any) -> list[float]:
    runs = RunsOfFile(path, columns)
    given = options or {"currents": 0.5 if runs.asks else None}
    return [run.duration for run in runs.recordings(**given)]


def test_a_pause_of_the_logger_ends_a_run(tmp_path: Path) -> None:
    motion = cycles(5e-3, 1.0, 5.0)
    path = write(tmp_path / "paused.csv", [motion, motion, motion], pause=3.0)
    assert durations(path) == pytest.approx([5.0, 5.0, 5.0])


def test_a_rest_ends_a_run(tmp_path: Path) -> None:
    parts = [rest(3.0), cycles(5e-3, 1.0, 5.0), rest(1.5), cycles(5e-3, 1.0, 8.0), rest(4.0)]
    path = write(tmp_path / "rests.csv", parts)
    assert durations(path) == pytest.approx([5.0, 8.0], abs=TO_A_BLOCK)


@pytest.mark.parametrize("frequency", [0.01, 0.05, 0.25])
def test_a_slow_turn_is_no_rest(tmp_path: Path, frequency: float) -> None:
    path = write(tmp_path / "slow.csv", [cycles(5e-3, frequency, 3.0 / frequency)])
    assert durations(path) == pytest.approx([3.0 / frequency], abs=TO_A_BLOCK)


@pytest.mark.parametrize(
    "other",
    [cycles(2e-3, 1.0, 8.0), cycles(5e-3, 2.0, 8.0), cycles(5e-3, 1.0, 8.0, yield_force=300.0)],
    ids=["amplitude", "frequency", "force"],
)
def test_a_new_phase_begins_a_run(tmp_path: Path, other: np.ndarray) -> None:
    path = write(tmp_path / "phases.csv", [cycles(5e-3, 1.0, 10.0), other])
    assert durations(path) == pytest.approx([10.0, 8.0], abs=1.5)  # whole strokes of 0.5 s each


def test_a_measured_current_that_changes_begins_a_run(tmp_path: Path) -> None:
    motion = cycles(5e-3, 1.0, 12.0)
    current = np.repeat([0.0, 0.5, 1.0], [800, 800, 800])
    path = write(tmp_path / "currents.csv", [motion], current)
    runs = read_runs(path, COLUMNS + ",current:A")
    assert [float(np.median(run.current)) for run in runs] == [0.0, 0.5, 1.0]
    assert [run.duration for run in runs] == pytest.approx([4.0, 4.0, 4.0])


def test_a_velocity_that_is_not_finite_is_named(tmp_path: Path) -> None:
    path = tmp_path / "broken.csv"
    path.write_text("0.1,1\n" * 500 + "nan,1\n", encoding="utf-8")
    with pytest.raises(RecordError, match=r"the velocity in line 501 of broken.csv is nan"):
        RunsOfFile(path, "velocity:m/s,force:N", period=0.01)


# ---- the program ----


@pytest.fixture
def two_runs(tmp_path: Path) -> Path:
    motion = cycles(5e-3, 1.0, 5.0)
    return write(tmp_path / "two.csv", [motion, 1.0 * motion], pause=3.0)


def imported(path: Path, *arguments: str) -> int:
    output = str(path.parent / "bags")
    return import_.main([str(path), "--columns", COLUMNS, "--output", output, *arguments])


def test_each_run_is_asked_for_its_current(two_runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, answers = [], iter(("0.25", "-"))

    def answer(question: str) -> str:
        asked.append(question)
        return next(answers)

    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", answer)
    assert imported(two_runs, "--split") == 0
    assert len(asked) == 2
    (run,) = read_bag(two_runs.parent / "bags" / "two_1")
    assert run.current[0] == 0.25


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--split",), "two.csv holds 2 runs, but 0 currents are given: give one [A] for each run"),
        (("--split", "--currents", "1"), "[A] for each run (currents, --currents), or None (-)"),
        (("--split", "--currents", "1,x"), "the current 'x' is not a number"),
        (("--split", "--currents", "1,1", "--from", "1"), "omit --split"),
        (("--currents", "1,1"), "--currents needs --split"),
        (("--current", "1"), "increases by 3.005 s instead of 0.005 s: choose a part of the"),
    ],
)
def test_what_is_missing_is_one_sentence(
    two_runs: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], sentence: str
) -> None:
    assert imported(two_runs, *arguments) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert len(said.strip().splitlines()) == 1


# -- currents that contradict the heights of the loops are reported, and no others -----------------

SAMPLES = 4000


def recording(name: str, current: float, force: Array | None = None, **options: float) -> Recording:
    run = known.run(current=current, frequency=2.0, samples=SAMPLES, **options)
    force = run.force if force is None else force
    return Recording(name, 0, run.period, run.displacement, force, np.full(SAMPLES, current))


def remarks(*runs: Recording) -> list[str]:
    return [str(each) for each in findings_on(measured_runs(runs)) if each.severity > NOTE]


def test_runs_of_one_damper_at_the_currents_they_were_made_at_are_in_order() -> None:
    assert remarks(*(recording(f"{i} A", i) for i in (0.0, 0.5, 1.0, 1.5))) == []


def test_a_run_that_holds_two_currents_is_said_to() -> None:
    low, high = (known.run(current=i, frequency=2.0, samples=SAMPLES).force for i in (0.0, 1.5))
    force = np.where(np.arange(SAMPLES) < SAMPLES // 2, low, high)
    (remark,) = remarks(recording("both", 1.0, force))
    assert remark.startswith("both: at 1 A and the same speed the force reaches")


@pytest.mark.parametrize(("first", "second"), [(1.5, 0.0), (0.5, 0.5)], ids=["mixed up", "equal"])
def test_two_runs_that_contradict_each_other_are_named(first: float, second: float) -> None:
    weak, strong = (known.run(current=i, frequency=2.0, samples=SAMPLES).force for i in (0.0, 1.5))
    (remark,) = remarks(recording("a", first, weak), recording("b", second, strong))
    assert remark.startswith("a: the force reaches")
    assert "in b, at the same speed" in remark
