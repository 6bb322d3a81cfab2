"""The programs identify and validate, as their users meet them."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import known
import numpy as np
import pytest

from mr_damper_ros.estimation.differential_evolution import GlobalProgress
from mr_damper_ros.io.bag_reader import read_bag
from mr_damper_ros.io.bag_writer import write_bag
from mr_damper_ros.kinematics.motion import window_motion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import CONDITIONS, LITERATURE, is_clean
from mr_damper_ros.models.sigmoid.following import without_extension
from mr_damper_ros.tools import identify, validate
from mr_damper_ros.tools.console import ProgressLine
from studies.thesis.published_runs import synthesise

BAGS = Path(__file__).parents[2] / "bags"
ONE_RUN = BAGS / "5.0mm_1Hz_1.5A"


def identified(tmp_path: Path, *arguments: str | Path) -> dict[str, Any]:
    path = tmp_path / "result.json"
    assert identify.main([*map(str, arguments), "--json", str(path)]) == 0
    document: dict[str, Any] = json.loads(path.read_text())
    return document


@pytest.mark.parametrize("method", ["nelder_mead", "least_squares", "global"])
def test_a_run_is_identified_down_to_its_noise(tmp_path: Path, method: str) -> None:
    condition = next(c for c in CONDITIONS if is_clean(c) and c.current == 1.5)
    recording = synthesise(condition)
    bag = tmp_path / "bag"
    write_bag(bag, recording)
    document = identified(tmp_path, bag, "--method", method)
    # Residual over the noise in the bag: the asked figure.
    assert document["metrics"]["rmse"] <= 1.01 * 5.53


def test_validate_gives_the_errors_that_identify_gave(tmp_path: Path) -> None:
    output, report = tmp_path / "set.yaml", tmp_path / "validation.json"
    document = identified(tmp_path, ONE_RUN, "--method", "least_squares", "--output", str(output))
    assert validate.main([str(output), str(ONE_RUN), "--json", str(report)]) == 0
    validation = json.loads(report.read_text())
    assert list(validation) == ["bags", "remarks"]
    assert validation["bags"][0]["metrics"] == pytest.approx(document["bags"][0]["metrics"])


def test_validate_does_not_extrapolate_the_law(tmp_path: Path) -> None:
    # The bag's peak velocity, 31 mm/s, lies below what the set was identified at.
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
        ({"displacement": 0.0 * RUN.displacement}, "move the damper"),
        ({"force": -RUN.force}, "reverse the sign"),
        ({"force": 0.0 * RUN.force}, "is the load cell connected"),
        ({"current": 1e3 * RUN.current}, "is it in milliamperes"),
    ],
    ids=["millimetres", "no motion", "wrong sign", "no force", "milliamperes"],
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
    start.write_text(ParameterSet(without_extension(LITERATURE), model="sigmoid_lag").to_yaml())
    assert identify.main([str(ONE_RUN), "--start", str(start)]) != 0
    assert "give a set of model 'sigmoid'" in capsys.readouterr().err


def test_an_interrupted_search_returns_the_best_so_far(tmp_path: Path) -> None:
    """Ctrl-C once the search has begun, from outside: the result is written and says so."""
    result = tmp_path / "result.json"
    program = (
        "import sys, os, signal\n"
        "from mr_damper_ros.tools import console, identify\n"
        "shown = console.ProgressLine.__call__\n"
        "def interrupted(self, told):\n"
        "    if told.generation > 0:\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "    return shown(self, told)\n"
        "console.ProgressLine.__call__ = interrupted\n"
        "sys.exit(identify.main(sys.argv[1:]))\n"
    )
    bags = [str(BAGS / name) for name in ("5.0mm_1Hz_0.5A", "7.5mm_1Hz_1.0A", "5.0mm_1Hz_1.5A")]
    ended = subprocess.run(
        [sys.executable, "-c", program, *bags, "--json", str(result)],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert "stopped" in json.loads(result.read_text())["message"]


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
    """What the line shows of each progress, a second after the one before."""
    clock = iter(float(second) for second in range(len(told)))
    # Its own alone: others read the clock meanwhile.
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
