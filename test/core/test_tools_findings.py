"""What identify tells besides the set: what is open, what to run, profiles, searches, resuming."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import known
import pytest

from mr_damper_ros.emulation.emulator import (
    ConstantDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.tools import identify

BAGS = Path(__file__).parents[2] / "bags"
ONE_RUN = BAGS / "5.0mm_1Hz_1.5A"
QUICK = ("--generations", "20")

PROGRAM = (
    "import sys\n"
    "from mr_damper_ros.tools import identify\n"
    "if __name__ == '__main__':\n"
    "    sys.exit(identify.main(sys.argv[1:]))\n"
)
"""A process of its own: BLAS has one thread there from the start."""

STOPPING = PROGRAM.replace(
    "if __name__",
    "from mr_damper_ros.tools.console import ProgressLine\n"
    "ProgressLine.__call__ = lambda self, progress: False\n"
    "if __name__",
)
"""The same, stopped as soon as it tells of its progress."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Short runs of one damper at four currents, which determine ten parameters."""
    folder, paths = tmp_path_factory.mktemp("runs"), []
    for seed, current in enumerate((0.0, 0.5, 1.0, 1.5)):
        rig = EmulatedRig(
            ConstantDamper(known.PLAUSIBLE),
            SineMotion(5e-3, 2.0),
            current,
            settings=RigSettings(sample_rate=500.0, seed=seed),
        )
        paths.append(folder / f"{current} A")
        write_bag(paths[-1], rig.record(1.0))
    return paths


def identified(tmp_path: Path, *arguments: str | Path) -> dict[str, Any]:
    path = tmp_path / "result.json"
    assert identify.main([*map(str, arguments), "--json", str(path)]) == 0
    document: dict[str, Any] = json.loads(path.read_text())
    return document


def in_a_process(tmp_path: Path, program: str, *arguments: str | Path) -> dict[str, Any]:
    path = tmp_path / "result.json"
    ended = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments), "--json", str(path)],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    document: dict[str, Any] = json.loads(path.read_text())
    return document


# -- what is open --------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--profile", "b9"], "there is no parameter 'b9' to profile"),
        (["--starts", "0"], "starts is 0: at least 1 is needed"),
        (["--workers", "0"], "workers is 0: at least 1 is needed"),
        (["--top-velocity", "-1"], "largest peak velocity is -1.0: it must be positive"),
        (["--top-current", "nan"], "largest current is nan"),
    ],
    ids=str,
)
def test_a_wrong_option_is_one_sentence(
    capsys: pytest.CaptureFixture[str], arguments: list[str], sentence: str
) -> None:
    assert identify.main([str(ONE_RUN), *arguments]) == 2
    assert sentence in capsys.readouterr().err


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


def test_the_searches_and_their_spread_are_told(
    tmp_path: Path, runs: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    document = identified(tmp_path, *runs, *QUICK, "--starts", "2")
    said = capsys.readouterr().out
    assert [search["seed"] for search in document["searches"]] == [0, 1]
    best = min(document["searches"], key=lambda search: search["cost"])
    assert document["parameters"] == best["parameters"]
    assert set(document["spread"]) == set(document["parameters"])
    assert "2 searches left " in said


def test_a_stopped_search_is_resumed_from_its_file(tmp_path: Path, runs: list[Path]) -> None:
    record = tmp_path / "record.json"
    arguments = (*runs, *QUICK, "--resume", record)
    stopped = in_a_process(tmp_path, STOPPING, *arguments)
    resumed = in_a_process(tmp_path, PROGRAM, *arguments)
    again = in_a_process(tmp_path, STOPPING, *arguments)
    assert "stopped" in stopped["message"]
    assert resumed["message"] == "converged"
    assert resumed["searches"][0]["cost"] <= stopped["searches"][0]["cost"]
    # What is finished is not searched again, so there is nothing to stop.
    assert again["parameters"] == resumed["parameters"]
    assert [path.name for path in tmp_path.iterdir() if "record" in path.name] == ["record.json"]


@pytest.mark.parametrize("text", ["", "no JSON", "{}", '{"version": 1, "search": "x"}'])
def test_a_file_that_is_no_record_is_refused_and_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    record = tmp_path / "record.json"
    record.write_text(text)
    assert identify.main([str(ONE_RUN), "--resume", str(record)]) == 2
    assert f"cannot resume from {record}" in capsys.readouterr().err
    assert record.read_text() == text


# -- temperature ---------------------------------------------------------------------------------
