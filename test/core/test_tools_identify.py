"""The programs identify and validate, from the user's side."""

import dataclasses
import json
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import known
import numpy as np
import pytest
from fresh_python import said

from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.estimation.differential_evolution import GlobalProgress
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.kinematics.motion import window_motion
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.models.published import CONDITIONS
from mr_damper_ros.tools import identify, validate
from mr_damper_ros.tools.console import ProgressLine
from studies.thesis.facts import is_clean
from studies.thesis.runs import synthesise

BAGS = Path(__file__).parents[2] / "bags"
ONE_RUN = BAGS / "5.0mm_1Hz_1.5A"


def identified(tmp_path: Path, *arguments: str | Path) -> dict[str, Any]:
    path = tmp_path / "result.json"
    assert identify.main([*map(str, arguments), "--json", str(path)]) == 0
    return json.loads(path.read_text())


@pytest.mark.parametrize("method", ["nelder_mead", "least_squares", "global"])
def test_a_run_is_identified_down_to_its_noise(tmp_path: Path, method: str) -> None:
    condition = next(c for c in CONDITIONS if is_clean(c) and c.current == 1.5)
    recording = synthesise(condition)
    bag = tmp_path / "bag"
    write_bag(bag, recording)
    document = identified(tmp_path, bag, "--method", method)
    # Residual relative to the noise in the bag.
    assert document["metrics"]["rmse"] <= 1.01 * 5.53


def test_validate_does_not_extrapolate_the_law(tmp_path: Path) -> None:
    # The peak velocity of the bag, 31 mm/s, is below the identified range.
    file, report = tmp_path / "set.yaml", tmp_path / "validation.json"
    found = ParameterSet(known.PLAUSIBLE, peak_velocity_range=(0.05, 0.2))
    file.write_text(found.to_yaml())
    assert validate.main([str(file), str(ONE_RUN), "--json", str(report)]) == 0
    (entry,) = json.loads(report.read_text())["bags"]
    motion = window_motion(RUN.displacement, RUN.period)
    lowest = dataclasses.replace(motion, peak_velocity=np.full(RUN.force.size, 0.05))
    force = found.law.force(found.values, lowest, RUN.current, RUN.period)
    assert entry["metrics"]["rmse"] == pytest.approx(known.rms(force - RUN.force))


def spoilt(tmp_path: Path, **changes: Any) -> Path:
    bag = tmp_path / "spoilt"
    write_bag(bag, dataclasses.replace(read_bag(ONE_RUN)[0], **changes))
    return bag


RUN = read_bag(ONE_RUN)[0]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"displacement": 1e3 * RUN.displacement}, "is it in millimetres"),
        ({"force": -RUN.force}, "reverse the sign"),
    ],
    ids=["millimetres", "wrong sign"],
)
def test_a_bag_that_makes_no_sense_is_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, Any], sentence: str
) -> None:
    assert identify.main([str(spoilt(tmp_path, **changes))]) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert len(said.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere"], "nowhere"),
        ([str(ONE_RUN), "--generations", "0"], "generations must be from 1"),
        ([str(ONE_RUN), "--start", "nowhere.yaml"], "nowhere.yaml"),
        ([str(ONE_RUN), "--seed", "-1"], "seed"),
        ([str(ONE_RUN), "--profile", "b9"], "there is no parameter 'b9' to profile"),
        ([str(ONE_RUN), "--starts", "0"], "starts is 0: give a whole number of at least 1"),
        ([str(ONE_RUN), "--workers", "0"], "workers is 0: give a whole number of at least 1"),
        (["nowhere", "--top-velocity", "-1"], "-1.0: it must be positive"),
        (["nowhere", "--top-current", "nan"], "largest current is nan"),
    ],
)
def test_a_wrong_argument_is_one_sentence(
    capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert identify.main(arguments) == 2
    assert sentence in capsys.readouterr().err


def test_the_extended_law_is_identified_where_it_is_asked_for(tmp_path: Path) -> None:
    output = tmp_path / "set.yaml"
    document = identified(tmp_path, ONE_RUN, "--model", "sigmoid_lag", "--output", output)
    assert document["model"] == "sigmoid_lag"
    assert document["observable"]["stiffness"]
    found = ParameterSet.from_yaml(output.read_text())
    assert found.as_dict() == document["parameters"]
    assert validate.main([str(output), str(ONE_RUN)]) == 0
    again = identified(tmp_path, ONE_RUN, "--model", "sigmoid_lag", "--start", output)
    assert again["metrics"]["rmse"] == pytest.approx(document["metrics"]["rmse"], rel=1e-3)


def test_a_start_with_a_lag_is_refused_for_the_law_without_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    start = tmp_path / "start.yaml"
    start.write_text(start_set("sigmoid_lag").to_yaml())
    assert identify.main([str(ONE_RUN), "--start", str(start)]) != 0
    assert "give a set of model 'sigmoid'" in capsys.readouterr().err


def test_what_would_be_refused_is_taken_with_a_warning_where_that_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = spoilt(tmp_path, displacement=np.minimum(RUN.displacement, 4.5e-3))
    assert identify.main([str(bag)]) == 2
    assert "--accept-doubtful" in capsys.readouterr().err
    assert identify.main([str(bag), "--accept-doubtful"]) == 0
    assert "WARNING: " in capsys.readouterr().out
    dead = tmp_path / "dead"
    write_bag(dead, dataclasses.replace(RUN, force=0.0 * RUN.force))
    assert identify.main([str(dead), "--accept-doubtful"]) == 2


def test_a_second_interrupt_ends_at_once() -> None:
    def raised_twice() -> None:
        with ProgressLine() as line:
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGINT)
                line(GlobalProgress("laws", 1, 2, 0.5, 1.0))

    with pytest.raises(KeyboardInterrupt):
        raised_twice()


PROGRESS = GlobalProgress("laws", 3, 9, 0.5, 10.0)


def shown_progress(monkeypatch: pytest.MonkeyPatch, *told: GlobalProgress) -> list[str]:
    """Text of the progress line for each progress, at intervals of one second."""
    clock = iter(float(second) for second in range(len(told)))
    # Only for this module: others read the clock in the meantime.
    stand_in = SimpleNamespace(monotonic=lambda: next(clock))
    monkeypatch.setattr("mr_damper_ros.tools.console.time", stand_in)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    written: list[str] = []
    monkeypatch.setattr("sys.stderr.write", written.append, raising=False)
    line = ProgressLine()
    assert all(line(progress) for progress in told)
    return written


def test_the_time_left_never_counts_up(monkeypatch: pytest.MonkeyPatch) -> None:
    estimates = (10.0, 12.0, 5.0, 300.0)
    shown = shown_progress(
        monkeypatch, *(dataclasses.replace(PROGRESS, time_left=left) for left in estimates)
    )
    ends = [text.partition("0.70711, ")[2].removesuffix("\033[K") for text in shown]
    assert ends == ["at most 10 s left", "at most 9 s left", "at most 5 s left"] + [
        "longer than expected"
    ]


# -- further results ------------------------------------------------------------------------------


QUICK = ("--generations", "20")

PROGRAM = (
    "import sys\n"
    "from mr_damper_ros.tools import identify\n"
    "if __name__ == '__main__':\n"
    "    sys.exit(identify.main(sys.argv[1:]))\n"
)
"""Runs in a separate process, in which BLAS has one thread from the start."""

STOPPING = PROGRAM.replace(
    "if __name__",
    "import os, signal\n"
    "from mr_damper_ros.tools.console import ProgressLine\n"
    "shown = ProgressLine.__call__\n"
    "def interrupted(self, progress):\n"
    "    if progress.generation > 0:\n"
    "        os.kill(os.getpid(), signal.SIGINT)\n"
    "    return shown(self, progress)\n"
    "ProgressLine.__call__ = interrupted\n"
    "if __name__",
).replace("sys.exit(identify.main(sys.argv[1:]))", "assert identify.main(sys.argv[1:]) in (0, 3)")
"""As PROGRAM, but Ctrl-C is sent at the first progress; the set may be poor."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Short runs of one damper at four currents, which determine ten parameters."""
    folder, paths = tmp_path_factory.mktemp("runs"), []
    for seed, current in enumerate((0.0, 0.5, 1.0, 1.5)):
        rig = EmulatedRig(
            EmulatedDamper(known.PLAUSIBLE),
            SineMotion(5e-3, 2.0),
            current,
            settings=RigSettings(sample_rate=500.0, seed=seed),
        )
        paths.append(folder / f"{current} A")
        write_bag(paths[-1], rig.record(1.0))
    return paths


def in_a_process(tmp_path: Path, program: str, *arguments: str | Path) -> dict[str, Any]:
    path = tmp_path / "result.json"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    said(sys.executable, "-c", program, *arguments, "--json", path, env=environment)
    return json.loads(path.read_text())


# -- undetermined parameters ---------------------------------------------------------------------


def test_one_run_determines_seven_combinations_and_the_rest_is_advised(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = identified(tmp_path, ONE_RUN, "--top-velocity", "0.2")
    said = capsys.readouterr().out
    assert document["determination"]["rank"] == 7
    assert document["determination"]["condition"] is None
    assert len(document["determination"]["open"]) == 9
    promised = {name for run in document["advice"] for name in run["determines"]}
    assert promised == set(known.SHAPE_PARAMETER_NAMES)
    assert "determine 7 of 16 combinations" in said
    for run in document["advice"]:
        assert run["sentence"] in said


def test_a_profile_is_given_on_demand(tmp_path: Path) -> None:
    document = identified(tmp_path, ONE_RUN, "--profile", "k6", "a2")
    profile, error = document["profiles"]["k6"], document["standard_errors"]["k6"]
    low, high = profile["interval"]
    assert (high - low) / (2.0 * 1.96 * error) == pytest.approx(1.0, abs=0.05)
    assert document["profiles"]["a2"]["interval"] == [None, None]


# -- searches ------------------------------------------------------------------------------------


def test_the_number_of_workers_does_not_change_a_digit(tmp_path: Path, runs: list[Path]) -> None:
    results = []
    for workers in ("1", "2"):
        document = in_a_process(
            tmp_path,
            PROGRAM,
            *runs,
            *QUICK,
            *("--starts", "3", "--workers", workers, "--profile", "k5", "k6"),
        )
        del document["duration_s"]
        results.append(document)
    assert results[0] == results[1]


def test_a_stopped_search_is_resumed_from_its_file(tmp_path: Path, runs: list[Path]) -> None:
    record = tmp_path / "record.json"
    arguments = (*runs, *QUICK, "--resume", record)
    stopped = in_a_process(tmp_path, STOPPING, *arguments)
    resumed = in_a_process(tmp_path, PROGRAM, *arguments)
    again = in_a_process(tmp_path, STOPPING, *arguments)
    assert "stopped" in stopped["message"]
    assert resumed["message"] == "converged"
    assert resumed["searches"][0]["cost"] <= stopped["searches"][0]["cost"]
    # A finished search is not repeated, so it cannot be stopped.
    assert again["parameters"] == resumed["parameters"]
    assert [path.name for path in tmp_path.iterdir() if "record" in path.name] == ["record.json"]


# -- temperature ---------------------------------------------------------------------------------


def test_the_searches_and_their_spread_are_told(
    tmp_path: Path, runs: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    document = identified(tmp_path, *runs, *QUICK, "--starts", "2")
    said = capsys.readouterr().out
    assert [search["seed"] for search in document["searches"]] == [0, 1]
    best = min(document["searches"], key=lambda search: search["cost"])
    assert document["parameters"] == best["parameters"]
    assert set(document["spread"]) == set(document["parameters"])
    assert "2 searches, RMS residual " in said


@pytest.mark.parametrize("text", ["", "no JSON", "{}", '{"version": 9, "search": "x"}'])
def test_a_file_that_is_no_record_is_refused_and_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    record = tmp_path / "record.json"
    record.write_text(text)
    assert identify.main([str(ONE_RUN), "--resume", str(record)]) == 2
    assert f"cannot resume from {record}" in capsys.readouterr().err
    assert record.read_text() == text
