"""A campaign on an emulated machine, timed by the stamps of the samples only."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.campaign import course as campaign_course
from mr_damper_ros.campaign.conductor import CampaignConductor, CampaignStage, ConductSettings
from mr_damper_ros.campaign.course import CampaignCourse, CampaignOutcome
from mr_damper_ros.campaign.folder import CampaignTask, read_campaign_runs
from mr_damper_ros.campaign.runs import REST, MachineCommand
from mr_damper_ros.emulation.emulator import (
    CurrentSchedule,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.emulation.motions import CommandedMotion, SineMotion
from mr_damper_ros.estimation.experiment_design import (
    ForceGoal,
    MachineLimits,
    Plan,
    PlannedRun,
    PlanState,
    PointErrors,
)
from mr_damper_ros.kinematics.periodic_motion import MotionKind, RepeatedMatch
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.processes.worker import InlineWorker

RATE, BLOCK = 500.0, 10
GOAL = ForceGoal(0.06, (0.05, 0.2), (0.0, 1.5), speeds=3, currents=4)
LIMITS = MachineLimits(0.01, 0.2, 5000.0, 1.5, 1.2, sample_rate=RATE)
TASK = CampaignTask(GOAL, LIMITS, "sigmoid")
RUNS = [PlannedRun(0.01, 2.0, (0.3, 1.2), 1.2), PlannedRun(0.005, 3.0, (0.75,), 1.2)]

BROAD = [
    RUNS[0],
    PlannedRun(0.005, 1.5, (0.3, 1.2), 1.2, MotionKind.SWEEP, 3.5),
    PlannedRun(0.005, 0.9, (0.75,), 1.2, MotionKind.RANDOM, 6.0, 2),
]


class Inline(InlineWorker):
    """A worker that runs each task at once; ``fail`` makes it fail, and no report is written."""

    def __init__(self) -> None:
        super().__init__(lambda _: 0.0)
        self.fail = ""
        self.done: list[str] = []

    def submit(self, function: Callable[..., Any], *arguments: Any, **limits: float) -> int:
        self.done.append(function.__name__)
        if self.done[-1] == "write_campaign_report" or (self.fail and self.done[-1] == "find_step"):
            function = self._ended
        return super().submit(function, *arguments, **limits)

    def _ended(self, *_: object) -> None:
        if self.fail:
            raise ValueError(self.fail)


class EmulatedMachine:
    """An emulated rig that obeys a conductor and checks every sample."""

    def __init__(self, conductor: CampaignConductor, obeys: bool = True) -> None:
        self.conductor = conductor
        self.obeys = obeys
        self.commands: list[MachineCommand | None] = []
        self.seen = np.empty((3, 0))
        self.time = 0.0
        self.lost = 0
        self._motion = CommandedMotion(SineMotion(1e-9, 1.0), 0.0)
        self._times, self._currents = [0.0], [0.0]
        self._rig = EmulatedRig(
            EmulatedDamper(known.PLAUSIBLE),
            self._motion,
            CurrentSchedule(self._times, self._currents),
            settings=RigSettings(sample_rate=RATE, force_noise=5.0),
        )
        self._rig.live = True

    def set(self, command: MachineCommand) -> None:
        self._motion.command(command.motion, self.time)
        if command.current != self._currents[-1]:
            self._times.append(self.time)
            self._currents.append(command.current)

    def block(self) -> None:
        """One block of samples that follows the previous commands."""
        command = self.conductor.command
        self.commands.append(command)
        if self.obeys and command is not None:
            self.set(command)
        made = self._rig.next_block(BLOCK)
        self.time += BLOCK / RATE
        self.seen = np.concatenate(
            [self.seen, np.stack([made.displacement, made.force, made.current])], axis=1
        )
        if self.lost:
            self.lost -= 1
            return
        self.conductor.add_current(made.start_ns, float(made.current[0]))
        self.conductor.add_block(made.samples)

    def until(self, condition: Callable[[], Any], longest: float = 60.0) -> Any:
        """Run until a condition holds, for at most ``longest`` [s] of simulated time."""
        end = self.time + longest
        while not (found := condition()):
            assert self.time < end, f"in vain waited {longest:g} s: {self.conductor.status()}"
            self.block()
        return found


@pytest.fixture
def planned(monkeypatch: pytest.MonkeyPatch) -> list[PlannedRun]:
    """The planned runs, independent of the results; tests may change them."""
    runs = list(RUNS)

    def plan(_: object, windows: list[object], *__: object) -> tuple[ParameterSet, Plan]:
        made = count[0] = count[0] + 1
        now = PointErrors(GOAL.points, np.full(len(GOAL.points), 0.1), 0.2 / made)
        if made >= len(runs):
            found = Plan(PlanState.MET, now, reason="the goal is met")
        else:
            found = Plan(PlanState.RUN, now, runs[made], 0.1, 1)
        return ParameterSet(known.PLAUSIBLE), found

    count = [0]
    monkeypatch.setattr(campaign_course, "planned", plan)
    monkeypatch.setattr(campaign_course, "planner_of", lambda _: object())
    monkeypatch.setattr(campaign_course, "first_run", lambda *_: runs[0])
    return runs


def begun(
    folder: Path, settings: ConductSettings | None = None, task: CampaignTask = TASK
) -> tuple[CampaignConductor, Inline]:
    worker = Inline()
    conductor = CampaignConductor(worker, settings or ConductSettings())
    conductor.begin(CampaignCourse(task, folder=folder))
    return conductor, worker


def ended(machine: EmulatedMachine) -> CampaignCourse:
    return machine.until(machine.conductor.poll)


def test_a_campaign_is_made_on_a_machine(planned: list[PlannedRun], tmp_path: Path) -> None:
    conductor, worker = begun(tmp_path)
    machine = EmulatedMachine(conductor)
    end = ended(machine)
    assert end.outcome is CampaignOutcome.MET
    assert [run for run, _ in read_campaign_runs(tmp_path)] == RUNS
    assert worker.done == ["judge_run", "find_step"] * 2 + ["write_campaign_report"]
    assert conductor.command is None
    stored = [notice[:5] for notice in conductor.take_notices() if "is stored" in notice]
    assert stored == ["run 1", "run 2"]


def test_swept_and_random_runs_are_made_on_a_machine(
    planned: list[PlannedRun], tmp_path: Path
) -> None:
    planned[:] = BROAD
    conductor, _ = begun(tmp_path)
    machine = EmulatedMachine(conductor)
    assert ended(machine).outcome is CampaignOutcome.MET
    made = read_campaign_runs(tmp_path)
    assert [run for run, _ in made] == BROAD
    for run, recording in made[1:]:
        match = RepeatedMatch(run.motion, recording.period)
        assert match.left_of(recording.displacement) < 0.01
    velocity = np.diff(machine.seen[0]) * RATE
    assert np.abs(machine.seen[0]).max() <= LIMITS.amplitude
    assert np.abs(velocity).max() <= LIMITS.peak_velocity


def test_the_temperature_is_kept_with_the_runs(planned: list[PlannedRun], tmp_path: Path) -> None:
    conductor, _ = begun(tmp_path)
    conductor.add_temperature(0, 31.5)
    conductor.add_temperature(1, 9.9e37)  # a thermometer without its sensor
    ended(EmulatedMachine(conductor))
    kept = [recording.temperature for _, recording in read_campaign_runs(tmp_path)]
    assert kept
    assert [set() if each is None else set(each) for each in kept] == len(kept) * [{31.5}]


@st.composite
def runs_within(draw: st.DrawFn) -> list[PlannedRun]:
    """Runs within the limits, as a planner may choose them."""
    found = []
    for _ in range(draw(st.integers(1, 2))):
        amplitude = draw(st.floats(2e-3, LIMITS.amplitude))
        fastest = min(LIMITS.peak_velocity / (2.0 * math.pi * amplitude), 8.0)
        currents = draw(st.lists(st.floats(0.0, LIMITS.current), min_size=1, max_size=2))
        frequency = draw(st.floats(len(currents) / LIMITS.duration + 0.2, max(fastest, 2.0)))
        frequency = min(frequency, LIMITS.peak_velocity / (2.0 * math.pi * amplitude))
        found.append(PlannedRun(amplitude, frequency, tuple(currents), LIMITS.duration))
    return found


@known.fixed(8)
@given(runs=runs_within(), disturbed=st.lists(st.integers(0, 300), max_size=4))
def test_no_sample_leaves_the_limits(
    tmp_path_factory: pytest.TempPathFactory, runs: list[PlannedRun], disturbed: list[int]
) -> None:
    """For any plan, with pauses, resumptions and losses at any time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(campaign_course, "planner_of", lambda _: object())
        patch.setattr(campaign_course, "first_run", lambda *_: runs[0])
        now = PointErrors(GOAL.points, np.full(len(GOAL.points), 0.1), 0.1)
        steps = [Plan(PlanState.RUN, now, run, 0.1, 1) for run in runs[1:]]
        steps.append(Plan(PlanState.MET, now, reason="the goal is met"))
        patch.setattr(
            campaign_course, "planned", lambda *_: (ParameterSet(known.PLAUSIBLE), steps.pop(0))
        )
        conductor, _ = begun(tmp_path_factory.mktemp("campaign"))
        machine = EmulatedMachine(conductor)
        for count in range(400):
            if conductor.poll() is not None:
                break
            if count in disturbed:
                machine.lost = 2
                conductor.pause()
            if count - 20 in disturbed:
                conductor.resume()
            machine.block()
    displacement, force, current = machine.seen
    velocity = np.gradient(displacement, 1.0 / RATE)
    assert np.abs(displacement).max() <= LIMITS.amplitude * (1.0 + 1e-9)
    # A difference over two samples never exceeds the largest velocity between them.
    assert np.abs(velocity[1:-1]).max() <= LIMITS.peak_velocity * (1.0 + 1e-9)
    assert np.abs(force).max() <= LIMITS.force
    assert 0.0 <= current.min() <= current.max() <= LIMITS.current


def test_a_force_beyond_the_limit_ends_it_at_once(
    planned: list[PlannedRun], tmp_path: Path
) -> None:
    task = replace(TASK, limits=replace(LIMITS, force=200.0))
    conductor, _ = begun(tmp_path, task=task)
    machine = EmulatedMachine(conductor)
    end = ended(machine)
    assert end.outcome is CampaignOutcome.FAILED
    assert "above 200 N" in end.reason
    over = int(np.argmax(np.abs(machine.seen[1]) > 200.0)) // BLOCK
    assert all(command in (REST, None) for command in machine.commands[over + 1 :])


def test_a_refused_run_is_repeated_once_then_reported(
    planned: list[PlannedRun], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(campaign_course, "fault_of_run", lambda *_: "it makes no sense")
    conductor, _ = begun(tmp_path)
    end = ended(EmulatedMachine(conductor))
    assert end.outcome is CampaignOutcome.FAILED
    assert "rejected 2 times: it makes no sense" in end.reason
    assert len(list(tmp_path.glob("runs/refused_001_*"))) == 2


def test_lost_samples_begin_the_run_anew(planned: list[PlannedRun], tmp_path: Path) -> None:
    conductor, _ = begun(tmp_path)
    machine = EmulatedMachine(conductor)
    machine.until(lambda: conductor.status().stage is CampaignStage.RECORDING)  # type: ignore[union-attr]
    machine.block()
    machine.lost = 20
    for _ in range(21):
        machine.block()
    assert conductor.status().stage is CampaignStage.SETTLING  # type: ignore[union-attr]
    assert ended(machine).outcome is CampaignOutcome.MET
    recordings = [recording for _, recording in read_campaign_runs(tmp_path)]
    assert [one.sample_count for one in recordings] == [600, 600]


def test_it_is_stopped_and_goes_on_later(planned: list[PlannedRun], tmp_path: Path) -> None:
    conductor, _ = begun(tmp_path)
    machine = EmulatedMachine(conductor)

    def one_step() -> bool:
        conductor.poll()
        return (tmp_path / "steps" / "step_001.json").exists()

    machine.until(one_step)
    conductor.stop()
    end = ended(machine)
    assert (end.outcome, end.reason, len(end.steps)) == (CampaignOutcome.ENDED, "it was stopped", 1)
    again, worker = begun(tmp_path)
    assert "continuing after run 1" in again.take_notices()[0]
    assert ended(EmulatedMachine(again)).outcome is CampaignOutcome.MET
    assert worker.done == ["judge_run", "find_step", "write_campaign_report"]


def test_an_identification_that_fails_is_told_and_its_run_kept(
    planned: list[PlannedRun], tmp_path: Path
) -> None:
    conductor, worker = begun(tmp_path)
    worker.fail = "the worker process died"
    end = ended(EmulatedMachine(conductor))
    assert end.outcome is CampaignOutcome.FAILED
    assert "run 1 could not be identified: the worker process died" in end.reason
    assert len(read_campaign_runs(tmp_path)) == 1
