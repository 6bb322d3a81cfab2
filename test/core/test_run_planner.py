"""Choice of the next run: errors of the force, plans within limits, signals, whole campaigns."""

import json
import math
from dataclasses import replace
from pathlib import Path

import known
import numpy as np
import pytest
from campaign_of_three import perform

import mr_damper_ros as mr
from mr_damper_ros.campaign.course import ForceCampaign, run_campaign
from mr_damper_ros.campaign.folder import CampaignStep
from mr_damper_ros.estimation.experiment_design import (
    Cycles,
    ForceGoal,
    MachineLimits,
    PlannedRun,
    PlanState,
    RunPlanner,
    first_run,
    information_of,
    model_error,
)
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tools import plan

GOAL = ForceGoal(0.06, (0.02, 0.2), (0.0, 1.5), speeds=3, currents=4)
LIMITS = MachineLimits(0.01, 0.2, 5000.0, 1.5, 2.0, sample_rate=500.0)

CLAIMS = (1.0 / 3.0, 3.0)
"""Allowed ratio of the stated to the true error of one damper; both are largest values."""

LAW = known.SIGMOID
EVERY = np.ones(len(LAW.parameters), dtype=bool)


class Machine:
    """Makes runs with independent noise, and records the requests."""

    def __init__(self) -> None:
        self.runs: list[PlannedRun] = []
        self.recordings: list[Recording] = []

    def __call__(self, run: PlannedRun) -> Recording:
        self.runs.append(run)
        self.recordings.append(perform(run, len(self.runs)))
        return self.recordings[-1]


@pytest.fixture(scope="module")
def machine() -> Machine:
    return Machine()


@pytest.fixture(scope="module")
def campaign(machine: Machine) -> ForceCampaign:
    return run_campaign(GOAL, LIMITS, machine)


def test_a_campaign_reaches_its_goal_and_claims_what_is_true(campaign: ForceCampaign) -> None:
    now = campaign.steps[-1].plan.now
    assert now.bound > now.worst
    sure = (
        f"{now.worst:.2%} at worst with 50 % confidence, and {now.bound:.2%} with 95 % confidence"
    )
    assert sure in campaign.reason
    assert campaign.reached
    assert campaign.reason.startswith("the goal is met: ")
    assert now.worst <= GOAL.error
    assert len(campaign.steps) <= 6
    cycles = Cycles(LAW, GOAL.cycles())
    truth = cycles.force(known.PLAUSIBLE)
    missed = np.abs(cycles.force(campaign.parameter_set.values) - truth)
    true = float(np.max(missed.max(axis=1) / np.abs(truth).max(axis=1)))
    assert CLAIMS[0] < now.worst / true < CLAIMS[1]
    assert now.worst < 0.1 * campaign.steps[0].plan.now.worst


def test_a_campaign_can_be_ended() -> None:
    heard: list[CampaignStep] = []

    def stop(step: CampaignStep) -> bool:
        heard.append(step)
        return False

    ended = run_campaign(GOAL, LIMITS, Machine(), report=stop)
    assert len(heard) == len(ended.steps) == 1
    assert not ended.reached


def test_a_run_that_makes_no_sense_is_made_once_more() -> None:
    asked: list[PlannedRun] = []

    def dead(run: PlannedRun) -> Recording:
        asked.append(run)
        return replace(perform(run), force=np.zeros(round(run.duration * 500.0)))

    with pytest.raises(ValueError, match="the force does not change"):
        run_campaign(GOAL, LIMITS, dead)
    assert len(asked) == 2
    assert asked[0] == asked[1]


RUNS = (
    PlannedRun(0.01, 0.6, (0.0, 1.0), 4.0),
    PlannedRun(0.01, 3.0, (0.5,), 4.0),
    PlannedRun(0.005, 3.0, (0.2, 0.6, 1.5), 4.0),
)


@pytest.fixture(scope="module")
def planner() -> RunPlanner:
    return RunPlanner(LAW, GOAL, LIMITS)


def windows(*runs: PlannedRun) -> list[Window]:
    return [window for run in runs for window in run.windows(perform(run))]


MISFIT = 0.05


def with_third_harmonic(window: Window, part: float) -> Window:
    """The window with a third harmonic added: a fraction of the largest force that no set fits."""
    largest = np.max(np.abs(LAW.window_force(window, known.PLAUSIBLE)))
    third = np.sin(3.0 * np.arctan2(window.motion.displacement, window.motion.velocity / 10.0))
    return replace(window, force=window.force + part * largest * third)


def test_noise_alone_is_no_model_error() -> None:
    first = first_run(GOAL, LIMITS)
    errors = [model_error(LAW, window, known.PLAUSIBLE) for window in windows(first)]
    assert errors == [0.0] * len(first.currents)


def test_the_error_of_the_force_includes_what_the_law_does_not_follow(planner: RunPlanner) -> None:
    wrong = [with_third_harmonic(window, MISFIT) for window in windows(RUNS[1])]
    there = replace(GOAL, peak_velocity=(0.19, 0.19), current=(0.5, 0.5))
    now = RunPlanner(LAW, there, LIMITS).errors(wrong, known.PLAUSIBLE)
    assert now.model_error == pytest.approx(MISFIT, rel=0.1)
    assert now.worst >= now.model_error
    assert "is model error" in now.sentence
    # It grows with the distance, here to 0.02 m/s and 1.5 A.
    assert planner.errors(wrong, known.PLAUSIBLE).model_error > 3.0 * now.model_error


def test_the_model_error_is_relative_to_the_measured_force() -> None:
    (window,) = windows(RUNS[1])
    half = replace(window, force=0.5 * window.force)
    assert model_error(LAW, half, known.PLAUSIBLE) == pytest.approx(1.0, rel=0.1)


def test_a_law_that_does_not_fit_is_named_as_the_reason() -> None:
    goal = replace(GOAL, error=0.02)
    wrong = [with_third_harmonic(window, MISFIT) for window in windows(*RUNS)]
    plan = RunPlanner(LAW, goal, LIMITS).next(wrong, known.PLAUSIBLE, EVERY)
    assert plan.state is PlanState.OUT_OF_REACH
    assert plan.reason.startswith("the model error of the law sigmoid is ")
    assert "choose another model (choose_law" in plan.reason


@pytest.mark.parametrize(
    ("limits", "sentence"),
    [
        (replace(LIMITS, peak_velocity=0.1), "the machine reaches only 0.1 m/s"),
        (replace(LIMITS, current=1.0), "the supply reaches only 1 A"),
        (replace(LIMITS, force=100.0), "may leave the limits of force or heat"),
        (replace(LIMITS, heat=1e-3), "may leave the limits of force or heat"),
    ],
)
def test_a_goal_beyond_the_machine_is_out_of_reach(limits: MachineLimits, sentence: str) -> None:
    plan = RunPlanner(LAW, GOAL, limits).next(windows(RUNS[0]), known.PLAUSIBLE, EVERY)
    assert plan.state is PlanState.OUT_OF_REACH
    assert sentence in plan.reason


def test_a_goal_beyond_the_noise_is_out_of_reach_and_says_what_is_left() -> None:
    goal = replace(GOAL, error=1e-5)
    plan = RunPlanner(LAW, goal, LIMITS).next(windows(*RUNS), known.PLAUSIBLE, EVERY)
    assert plan.state is PlanState.OUT_OF_REACH
    assert plan.run is not None
    assert "more runs would leave an error of" in plan.reason


def test_the_prior_of_every_law_leaves_every_parameter_a_range() -> None:
    for name, law in MODELS.items():
        values = known.controllable(name).values
        assert np.all(RunPlanner(law, GOAL, LIMITS).prior(values).width > 0.0), name


def test_the_information_is_positive_even_if_rounding_makes_the_covariance_indefinite() -> None:
    assert np.all(np.linalg.eigvalsh(information_of(np.diag([1.0, -1e-14]))) > 0.0)
    assert information_of(np.diag([4.0, 1.0])) == pytest.approx(np.diag([0.25, 1.0]))


def test_the_next_run_helps_within_the_limits(planner: RunPlanner) -> None:
    plan = planner.next(windows(RUNS[0]), known.PLAUSIBLE, EVERY)
    assert plan.state is PlanState.RUN
    assert plan.expected < plan.now.worst
    assert planner.candidates
    assert all(run.stretch * run.frequency >= 1.0 for run in planner.candidates)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"error": 0.0}, "fraction of the force"),
        ({"peak_velocity": (0.2, 0.1)}, "the lower one first"),
        ({"current": (-1.0, 1.0)}, "none below 0"),
    ],
)
def test_a_goal_that_cannot_be_meant_is_refused(change: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        replace(GOAL, **change)  # type: ignore[arg-type]


def test_a_machine_too_slow_for_a_cycle_is_refused() -> None:
    with pytest.raises(ValueError, match="allow longer runs"):
        first_run(GOAL, replace(LIMITS, duration=0.1))


PROGRAM = [
    *("--velocity", "0.02", "0.2", "--current", "0", "1.5"),
    *("--amplitude", "0.01", "--force", "5000"),
]


def test_the_program_names_the_first_run_and_writes_its_signal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert plan.main([*PROGRAM, "--signal", str(tmp_path / "run.csv")]) == 0
    assert "mm at" in capsys.readouterr().out
    assert (tmp_path / "run.csv").read_text().startswith("time:s,displacement:m,current:A\n")


def test_the_program_goes_on_from_bags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for place, run in enumerate(RUNS[:2]):
        mr.write_bag(tmp_path / f"run{place}", perform(replace(run, currents=run.currents[:1])))
    bags = [str(path) for path in sorted(tmp_path.iterdir())]
    output = tmp_path / "plan.json"
    assert plan.main([*bags, *PROGRAM, "--json", str(output)]) == 0
    assert "the force is known to" in capsys.readouterr().out
    document = json.loads(output.read_text())
    assert document["state"] == "run"
    assert math.isfinite(document["worst_error"])
    assert document["run"]["amplitude"] <= 0.01


def test_the_program_says_when_a_goal_is_out_of_reach(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mr.write_bag(tmp_path / "run", perform(RUNS[0]))
    code = plan.main([str(tmp_path / "run"), *PROGRAM, "--top-current", "1"])
    assert code == plan.OUT_OF_REACH
    assert "the supply reaches only 1 A" in capsys.readouterr().out
