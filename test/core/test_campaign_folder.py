"""A campaign on disk: by hand, with one program call per step, and its report."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from campaign_of_three import GOAL, LIMITS, RUNS, TASK, perform, plan_quickly, played

import mr_damper_ros as mr
from mr_damper_ros.campaign import course as campaign_course
from mr_damper_ros.campaign.course import fault_of_run
from mr_damper_ros.campaign.folder import claim_folder, read_campaign_runs, read_steps, read_task
from mr_damper_ros.campaign.report import write_campaign_report
from mr_damper_ros.campaign.runs import RunNotFoundError, cut_run
from mr_damper_ros.estimation.experiment_design import ForceGoal, MachineLimits, PlannedRun
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tools import plan


class KilledError(BaseException):
    """Simulates the death of the process."""


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    return plan_quickly(monkeypatch)


def state(folder: Path) -> dict[str, int]:
    """Modification time of each finished file."""
    return {
        str(path.relative_to(folder)): path.stat().st_mtime_ns
        for kind in ("runs/run_*/*", "steps/*.json")
        for path in folder.glob(kind)
    }


def test_a_campaign_is_kept_as_bags_and_steps(quick: list[int], tmp_path: Path) -> None:
    found = mr.run_campaign(GOAL, LIMITS, perform, folder=tmp_path)
    assert found.reached
    assert read_task(tmp_path) == TASK
    kept = read_campaign_runs(tmp_path)
    assert [run for run, _ in kept] == RUNS
    for run, recording in kept:
        np.testing.assert_array_equal(recording.force, perform(run).force)
        np.testing.assert_array_equal(recording.current, perform(run).current)
        assert run.sentence in recording.details["provenance"]
    steps = read_steps(tmp_path)
    assert [step.run for step in steps] == RUNS
    for step, made in zip(steps, found.steps, strict=True):
        np.testing.assert_array_equal(step.plan.now.errors, made.plan.now.errors)
        assert step.plan.now.worst == made.plan.now.worst
        assert (step.plan.state, step.plan.run) == (made.plan.state, made.plan.run)
    assert ParameterSet.load(tmp_path / "set.yaml").set_id == "quick"


@pytest.mark.parametrize("moment", range(6))
def test_killed_at_any_moment_it_goes_on_where_it_was(
    quick: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: int
) -> None:
    """Three of the six moments are during a run; three are after one, before its step is stored."""
    made: list[PlannedRun] = []
    passed = 0

    def die() -> None:
        nonlocal passed
        passed += 1
        if passed == moment + 1:
            raise KilledError

    def mortal(run: PlannedRun) -> Recording:
        die()
        made.append(run)
        return perform(run)

    keep = campaign_course.keep_step

    def keep_step(*arguments: object) -> None:
        die()
        keep(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(campaign_course, "keep_step", keep_step)
    with pytest.raises(KilledError):
        mr.run_campaign(GOAL, LIMITS, mortal, folder=tmp_path)
    before = state(tmp_path)
    found = mr.run_campaign(GOAL, LIMITS, mortal, folder=tmp_path)
    assert found.reached
    assert made == RUNS, "a run that was kept is not made again"
    after = state(tmp_path)
    assert {name: after.get(name) for name in before} == before


@pytest.mark.parametrize(
    ("goal", "limits", "part"),
    [
        (replace(GOAL, error=0.01), LIMITS, "another goal"),
        (GOAL, replace(LIMITS, force=100.0), "another limits"),
    ],
)
def test_another_campaign_is_refused(
    quick: list[int], tmp_path: Path, goal: ForceGoal, limits: MachineLimits, part: str
) -> None:
    claim_folder(tmp_path, TASK).release()
    with pytest.raises(ValueError, match=part):
        mr.run_campaign(goal, limits, perform, folder=tmp_path)


def test_what_is_no_recording_of_the_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="perform returned a NoneType"):
        mr.run_campaign(GOAL, LIMITS, lambda run: None, folder=tmp_path)


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    first = claim_folder(tmp_path, TASK)
    try:
        with pytest.raises(ValueError, match="in use by another program"):
            claim_folder(tmp_path, TASK)
    finally:
        first.release()


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"current": np.zeros(1000)}, "is the supply on"),
        ({"displacement": 2.0 * perform(RUNS[0]).displacement}, "does the machine follow"),
    ],
)
def test_a_run_that_is_not_the_one_wanted_is_refused(
    change: dict[str, np.ndarray], part: str
) -> None:
    assert part in fault_of_run(RUNS[0], replace(perform(RUNS[0]), **change))  # type: ignore[arg-type]


def test_a_run_that_is_too_short_is_refused() -> None:
    short = perform(replace(RUNS[1], duration=1.0))
    assert "lasts 1 s instead of 2 s" in fault_of_run(RUNS[1], short)


def test_a_damaged_step_is_named(quick: list[int], tmp_path: Path) -> None:
    mr.run_campaign(GOAL, LIMITS, perform, folder=tmp_path)
    step = tmp_path / "steps" / "step_002.json"
    other_goal = step.read_text().replace('"errors": [', '"errors": [0.1, ')
    for text, reason in (("{", "Expecting"), (other_goal, "its errors belong to another goal")):
        step.write_text(text)
        with pytest.raises(ValueError, match=rf"step_002\.json is damaged: remove it.*{reason}"):
            mr.run_campaign(GOAL, LIMITS, perform, folder=tmp_path)


# -- a campaign by hand, with one program call per step, and its report ----------------------------

BAG = Path(__file__).parents[2] / "bags" / "5.0mm_1Hz_1.5A"
ASKED = [
    *("--velocity", "0.02", "0.2", "--current", "0", "1.5", "--error", "0.06"),
    *("--amplitude", "0.01", "--force", "5000", "--duration", "2", "--rate", "500"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished campaign."""
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
    assert plan.main(["--keep", *(str(word) for word in arguments)]) == code
    return capsys.readouterr().out


def test_by_hand_call_by_call(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan_quickly(monkeypatch, ForceGoal(0.06, (0.02, 0.2), (0.0, 1.5)))
    reported: list[tuple[Path, str]] = []
    monkeypatch.setattr(plan, "write_campaign_report", lambda *given: reported.append(given))
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
    assert plan.main(["--keep", str(tmp_path / "new")]) == 2
    assert "a new campaign needs --velocity, --current" in capsys.readouterr().err
