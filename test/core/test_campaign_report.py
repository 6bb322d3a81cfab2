"""A campaign by hand, program call by program call, and its report."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from campaign_of_three import GOAL, LIMITS, RUNS, perform, plan_quickly, played

import mr_damper_ros as mr
from mr_damper_ros.campaign.folder import read_campaign_runs
from mr_damper_ros.campaign.report import write_campaign_report
from mr_damper_ros.campaign.runs import RunNotFoundError, cut_run
from mr_damper_ros.estimation.planned_run import ForceGoal, PlannedRun
from mr_damper_ros.tools import plan_run

BAG = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"
ASKED = [
    *("--velocity", "0.02", "0.2", "--current", "0", "1.5", "--error", "0.06"),
    *("--amplitude", "0.01", "--force", "5000", "--duration", "2", "--rate", "500"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign that is over."""
    place = tmp_path_factory.mktemp("campaign")
    with pytest.MonkeyPatch.context() as patch:
        plan_quickly(patch)
        mr.run_campaign(GOAL, LIMITS, perform, folder=place)
    return place


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return write_campaign_report(folder).read_text(encoding="utf-8")


def test_the_report_has_its_chapters_goal_runs_and_outcome(page: str) -> None:
    assert re.findall(r'<section id="(\w+)">', page) == [
        *("plan", "error", "map", "loops", "set", "unknown")
    ]
    assert page.count("data:image/svg+xml") == 3
    assert "an error of 6.00% of the force at the worst point" in page
    assert "3 runs, 6 s of steady motion; the goal is met" in page


def test_a_folder_without_a_campaign_has_no_report(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no campaign"):
        write_campaign_report(tmp_path)


def told(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 0) -> str:
    assert plan_run.main(["--keep", *(str(word) for word in arguments)]) == code
    return capsys.readouterr().out


def test_by_hand_call_by_call(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan_quickly(monkeypatch, ForceGoal(0.06, (0.02, 0.2), (0.0, 1.5)))
    reported: list[tuple[Path, str]] = []
    monkeypatch.setattr(plan_run, "write_campaign_report", lambda *given: reported.append(given))
    folder, bags = tmp_path / "campaign", tmp_path / "bags"
    said = told(capsys, folder, *ASKED)
    assert f"run 1: {RUNS[0].sentence}" in said
    assert (folder / "signals" / "run_001.csv").read_text().startswith("time:s,displacement:m")
    for number, run in enumerate(RUNS, start=1):
        start_ns = number * 1_000_000_000_000
        mr.write_bag(bags / f"bag_{number}", replace(played(run), start_ns=start_ns))
        said = told(capsys, folder, bags)
        assert len(read_campaign_runs(folder)) == number, said
        if number < len(RUNS):
            assert f"run {number + 1}: {RUNS[number].sentence}" in said
    assert "the goal is met" in said
    assert reported[-1] == (folder, "the goal is met")


def test_a_bag_of_another_run_is_told_and_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan_quickly(monkeypatch)
    mr.write_bag(tmp_path / "bag", played(RUNS[2]))
    said = told(capsys, tmp_path / "campaign", tmp_path / "bag", *ASKED)
    assert "run 1 is rejected" in said
    assert f"run 1: {RUNS[0].sentence}" in said


def test_the_amplitude_of_another_motion_is_told_right() -> None:
    wanted = PlannedRun(0.01, 0.31, (0.0,), 4.0)
    with pytest.raises(
        RunNotFoundError, match=r"its amplitude is 5 mm, its duration 7 s, and its current 1\.5 A"
    ):
        cut_run(wanted, mr.read_bag(BAG)[0])


def test_a_new_campaign_needs_a_goal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert plan_run.main(["--keep", str(tmp_path / "new")]) == 2
    assert "a new campaign needs --velocity, --current" in capsys.readouterr().err
