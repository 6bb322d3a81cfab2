"""The course of a campaign: the next run of a test machine from the recordings so far."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache
from pathlib import Path

import numpy as np

from mr_damper_ros.api.measured_runs import RunSource, all_windows, measured_run, measured_runs
from mr_damper_ros.campaign.folder import (
    CampaignStep,
    CampaignTask,
    MadeRun,
    claim_folder,
    keep_run,
    keep_step,
    read_campaign_runs,
    read_steps,
)
from mr_damper_ros.campaign.runs import DriveSettings
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.experiment_design import (
    ForceGoal,
    MachineLimits,
    Plan,
    PlannedRun,
    PlanState,
    RunPlanner,
    first_run,
)
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.kinematics.periodic_motion import MotionKind, RepeatedMatch
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterSet, known_model
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.worker import Control
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import Recording


@one_thread()
def advise_run(runs: Iterable[RunSource], task: CampaignTask) -> Plan:
    """Accuracy of the force from the runs so far, and the next run.

    Raises ValueError if a run cannot be used.
    """
    return planned(planner_of(task), all_windows(measured_runs(runs)))[1]


def planned(
    planner: RunPlanner, windows: list[Window], before: Array | None = None
) -> tuple[ParameterSet, Plan]:
    """Maximum-a-posteriori set of the windows, from the start ``before`` (p,), and the plan."""
    start = planner.model.initial_values()[0] if before is None else before
    fit = identify_global(planner.model, windows, start, EvolutionSettings(), known=before)
    found = fit.parameter_set
    found = replace(found, values=planner.most_probable(windows, found.values))
    return found, planner.next(windows, found.values, found.observable)


_TRIES = 2
"""Number of attempts per run."""


class CampaignOutcome(IntEnum):
    """Outcome of a campaign; the numbers are constants of RunCampaign.action."""

    MET = 0
    OUT_OF_REACH = 1
    ENDED = 2
    FAILED = 3


@lru_cache(maxsize=1)
@one_thread()
def planner_of(task: CampaignTask) -> RunPlanner:
    """The planner of the runs of a campaign."""
    return RunPlanner(known_model(task.model), task.goal, task.limits)


def judge_run(
    folder: Path | None, number: int, made: MadeRun, control: Control | None = None
) -> str:
    """Reason to reject a run, or empty; with a folder, the run is always stored.

    This function can run in a worker, like :func:`find_step`. Raises OSError.
    """
    refusal = fault_of_run(*made)
    if folder is not None:
        keep_run(folder, number, *made, refusal)
    return refusal


@one_thread()
def find_step(
    task: CampaignTask,
    runs: Sequence[MadeRun],
    before: Array | None,
    control: Control | None = None,
) -> CampaignStep:
    """Identify from all runs and plan the next; ``before`` (p,): the set without the last run."""
    windows = [window for run, recording in runs for window in run.windows(recording)]
    found, plan = planned(planner_of(task), windows, before)
    return CampaignStep(runs[-1][0], found, plan)


class CampaignCourse:
    """A campaign from its start, or continued from ``folder``, which it locks until it is closed.

    ``next_run`` is the run to make now. It is None if ``work`` must be done first, or if the
    campaign has ended; ``outcome`` (None before) and ``reason`` then say why. At most ``most_runs``
    are made.

    Raises ValueError if the machine cannot make the first run, and as :func:`claim_folder`, also if
    the folder is damaged.
    """

    def __init__(
        self, task: CampaignTask, *, folder: Path | None = None, most_runs: int = 20
    ) -> None:
        self.task = task
        self.runs: list[MadeRun] = []
        self.steps: list[CampaignStep] = []
        self.refusals = 0
        self.outcome: CampaignOutcome | None = None
        self.reason = ""
        self.folder = folder
        self._most_runs = most_runs
        self._first = first_run(task.goal, task.limits)
        if folder is not None:
            self._lock = claim_folder(folder, task)
            try:
                self.runs = read_campaign_runs(folder)
                self.steps = read_steps(folder)[: len(self.runs)]
            except BaseException:
                self.close()
                raise
            self._end_if_finished()

    def close(self) -> None:
        """Release the folder for other programs."""
        if self.folder is not None:
            self._lock.release()

    @property
    def number(self) -> int:
        """Number of the present or last run, from 1."""
        return len(self.runs) + (self.next_run is not None)

    @property
    def next_run(self) -> PlannedRun | None:
        """The run to make now."""
        if self.outcome is not None or len(self.steps) < len(self.runs):
            return None
        return self.steps[-1].plan.run if self.steps else self._first

    @property
    def work(self) -> tuple[CampaignTask, Sequence[MadeRun], Array | None] | None:
        """Arguments of :func:`find_step` before the next run."""
        if self.outcome is not None or len(self.steps) == len(self.runs):
            return None
        before = self.steps[-1].parameter_set.values if self.steps else None
        return self.task, self.runs[: len(self.steps) + 1], before

    def add_recording(self, recording: Recording, made: PlannedRun | None = None) -> str:
        """Add a recording of the next run; returns the reason to reject it, or empty.

        ``made``: the run that was made, if it differs from ``next_run``. A run that is rejected
        twice ends the campaign; the stored runs remain. Raises OSError.
        """
        run = made or self.next_run
        assert run is not None, "there is no run to make now"
        refusal = judge_run(self.folder, len(self.runs) + 1, (run, recording))
        self.add_run((run, recording), refusal)
        return refusal

    def add_run(self, made: MadeRun, refusal: str) -> None:
        """Add a judged run, with the reason to reject it, or empty."""
        if not refusal:
            self.refusals = 0
            self.runs.append(made)
            return
        self.refusals += 1
        if self.refusals >= _TRIES:
            reason = f"run {self.number} was rejected {_TRIES} times: {refusal}"
            self.end(reason, CampaignOutcome.FAILED)

    def add_step(self, step: CampaignStep) -> None:
        """Add the result of the work. Raises OSError."""
        if self.folder is not None:
            keep_step(self.folder, len(self.steps) + 1, step)
        self.steps.append(step)
        self._end_if_finished()

    def _end_if_finished(self) -> None:
        if self.outcome is not None or not self.steps or len(self.steps) < len(self.runs):
            return
        plan = self.steps[-1].plan
        if plan.state is not PlanState.RUN:
            self.end(plan.reason, CampaignOutcome[plan.state.name])
        elif len(self.steps) >= self._most_runs:
            made = f"{self._most_runs} runs were made, the largest number allowed"
            self.end(f"{made}; {plan.reason}" if plan.reason else made)

    def end(self, reason: str, outcome: CampaignOutcome = CampaignOutcome.ENDED) -> None:
        """End the campaign, by default on request."""
        self.outcome, self.reason = outcome, reason


def fault_of_run(run: PlannedRun, recording: Recording) -> str:
    """Reason why a recording does not match this run, or empty.

    Tolerances: 30 % of the amplitude; 50 % RMS of a motion other than a sine; 5 % of the median
    current of a segment, and at least the ``current_tolerance`` of :class:`DriveSettings`.
    """
    try:
        measured_run(recording)
    except ValueError as error:
        return str(error)
    needed = round(run.duration / recording.period)
    if recording.sample_count < needed:
        return f"the recording lasts {recording.duration:.3g} s instead of {run.duration:.3g} s"
    parts = run.parts(recording.period)
    # A part of a motion other than a sine may begin at any phase.
    for part in parts if run.kind is MotionKind.SINE else [slice(needed)]:
        amplitude = 0.5 * float(np.ptp(recording.displacement[part]))
        if abs(amplitude - run.span) > 0.3 * run.span:
            return (
                f"the amplitude is {1e3 * amplitude:.3g} mm instead of {1e3 * run.span:.3g} mm: "
                "does the machine follow the command?"
            )
    if run.kind is not MotionKind.SINE:
        left = RepeatedMatch(run.motion, recording.period).left_of(recording.displacement[:needed])
        if left > 0.5:
            return (
                f"the motion deviates by {left:.0%} from {run.kind.description} as planned: can "
                "the machine make it?"
            )
    for place, (current, part) in enumerate(zip(run.currents, parts, strict=True)):
        measured = float(np.median(recording.current[part]))
        if abs(measured - current) > max(DriveSettings.current_tolerance, 0.05 * current):
            return (
                f"the current is {measured:.3g} A instead of {current:.3g} A in part {place + 1} "
                "of the run: is the supply on?"
            )
    return ""


Perform = Callable[[PlannedRun], Recording]
"""Makes a run on a machine; the recording begins in steady motion, at the first current."""


@dataclass(frozen=True, eq=False)
class ForceCampaign:
    """Result of :func:`run_campaign`: its steps and the reason of its end.

    ``reached``: whether the goal is met.
    """

    steps: tuple[CampaignStep, ...]
    reached: bool
    reason: str

    @property
    def parameter_set(self) -> ParameterSet:
        """The set of the last step."""
        return self.steps[-1].parameter_set


def run_campaign(
    goal: ForceGoal,
    limits: MachineLimits,
    perform: Perform,
    *,
    model: str = DEFAULT_MODEL,
    most_runs: int = 20,
    report: Callable[[CampaignStep], bool] | None = None,
    folder: str | os.PathLike[str] | None = None,
) -> ForceCampaign:
    """Plan, make and identify runs until the goal is met or cannot be met.

    ``perform`` makes a run. ``report`` is called after each step and ends the campaign by returning
    False. An unusable run is repeated once. With a ``folder``, every run is stored as a bag with
    its result; a repeated call with the same goal continues the campaign. Raises ValueError if a
    repeated run is still unusable, the goal is invalid, the machine cannot make the first run, or
    the folder holds another campaign.
    """
    task = CampaignTask(goal, limits, model)
    path = None if folder is None else Path(folder)
    course = CampaignCourse(task, folder=path, most_runs=most_runs)
    with closing(course):
        while course.outcome is None:
            if course.work is not None:
                course.add_step(find_step(*course.work))
                if report is not None and not report(course.steps[-1]):
                    course.end("it was ended")
            elif course.next_run is not None:
                made = perform(course.next_run)
                if not isinstance(made, Recording):
                    raise ValueError(f"perform returned a {type(made).__name__}, not a recording")
                course.add_recording(made)
    if course.outcome is CampaignOutcome.FAILED:
        raise ValueError(course.reason)
    return ForceCampaign(tuple(course.steps), course.outcome is CampaignOutcome.MET, course.reason)
