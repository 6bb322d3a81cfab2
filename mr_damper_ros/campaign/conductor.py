"""Conducts a campaign on a machine: samples in, commands out, identification in a worker.

It uses neither ROS nor any clock except the stamps of the samples. Every result is written to disk
before the next step, so that the program may end at any time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from mr_damper_ros.campaign.course import CampaignCourse, CampaignOutcome, find_step, judge_run
from mr_damper_ros.campaign.folder import MadeRun
from mr_damper_ros.campaign.report import write_campaign_report
from mr_damper_ros.campaign.runs import REST, DriveSettings, MachineCommand, RunDriver
from mr_damper_ros.estimation.experiment_design import PlanState
from mr_damper_ros.processes.files import reason_of
from mr_damper_ros.processes.worker import Done, Failed, Outcome, TaskRunner
from mr_damper_ros.settings.option_table import CheckedSettings, group, option
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.signals.recording import TEMPERATURES
from mr_damper_ros.signals.uniform_grid import GridSettings, UniformGrid


class CampaignStage(IntEnum):
    """The present stage; the numbers are constants of RunCampaign.action."""

    WAITING = 0
    SETTLING = 1
    RECORDING = 2
    IDENTIFYING = 3
    PAUSED = 4


@dataclass(frozen=True)
class ConductSettings(CheckedSettings):
    """Options of conducting a campaign."""

    manual: bool = option(
        False,
        "Whether an operator sets the press and the supply. The node then commands nothing: log, "
        "diagnostics and action feedback say what to set, and recording starts once the "
        "samples agree. The current is constant within a run.",
    )
    rest_time: float = option(
        0.0,
        "Rest [s] in which the damper cools before each run; no law models a drifting force.",
        within=(0.0, 86400.0),
    )
    drive: DriveSettings = group(DriveSettings, flat=True)
    grid: GridSettings = group(GridSettings, flat=True)


@dataclass(frozen=True)
class CampaignStatus:
    """State of a campaign, as in the feedback of RunCampaign.action.

    ``state`` says in words what the campaign is waiting for. ``runs_left`` is None if unknown.
    """

    stage: CampaignStage
    run: int
    sentence: str
    state: str
    worst_error: float
    runs_left: int | None


class CampaignConductor:
    """Conducts one campaign at a time on one machine."""

    def __init__(self, worker: TaskRunner, settings: ConductSettings) -> None:
        self._worker = worker
        self._settings = settings
        self._course: CampaignCourse | None = None
        self._driver: RunDriver | None = None
        self._made: MadeRun | None = None
        self._celsius: tuple[int, float] | None = None
        self._paused = self._reporting = False
        self._rested_ns: int | None = None
        self._newest_ns = 0
        self._notices: list[str] = []
        self.sequence = UniformGrid(settings.grid)
        """Continuity of the samples."""

    @property
    def running(self) -> bool:
        """Whether a campaign is running."""
        return self._course is not None

    def begin(self, course: CampaignCourse) -> None:
        """Start this campaign, which must have a folder; no other may be running."""
        assert self._course is None
        self._course = course
        self._paused = self._reporting = False
        self._driver, self._rested_ns, self._made = None, None, None
        if course.runs:
            self._notices.append(f"continuing after run {len(course.runs)}, which is stored")

    def pause(self) -> None:
        """Stop the machine; an interrupted run is repeated later."""
        self._paused, self._driver = True, None

    def resume(self) -> None:
        """Continue after a pause."""
        self._paused = False

    def stop(self) -> None:
        """End the campaign; it continues if the same goal is sent again."""
        if self._course is not None and self._course.outcome is None:
            self._driver = None
            self._course.end("it was stopped")
            if self._worker.busy:
                self._worker.cancel()

    def lose_contact(self) -> None:
        """Note that samples have stopped; the present run is repeated when they return."""
        self._driver = None

    # --- inputs ---------------------------------------------------------------------------------

    def add_current(self, stamp_ns: int, current: float) -> None:
        """Add a measured current [A]; raises CurrentError if it is invalid."""
        if self._driver is not None:
            self._driver.current.add(stamp_ns, current)

    def add_temperature(self, stamp_ns: int, celsius: float) -> None:
        """Add a temperature [°C]; that of a disconnected thermometer is implausible and ignored."""
        if TEMPERATURES[0] <= celsius <= TEMPERATURES[1]:
            self._celsius = (stamp_ns, celsius)
            if self._driver is not None:
                self._driver.celsius.add(stamp_ns, celsius)

    def add_block(self, block: SampleBlock) -> None:
        """Add samples."""
        for placed in self.sequence.follow(block):
            self._newest_ns = placed.block.end_ns
            self._driver = driver = self._driver or self._new_driver()
            if driver is None or self._course is None:
                continue
            driver.add_block(placed)
            if driver.over:
                self._driver, self._rested_ns = None, None
            if driver.recording is not None:
                # The worker writes the bag, so that commands do not wait for the disk.
                self._made = driver.run, driver.recording
            elif driver.fault:
                fault = f"run {self._course.number} could not be made: {driver.fault}"
                self._course.end(fault, CampaignOutcome.FAILED)

    def _new_driver(self) -> RunDriver | None:
        course, settings = self._course, self._settings
        if course is None or self._paused or self._made is not None or course.next_run is None:
            return None
        if self._rested_ns is None:
            self._rested_ns = self._newest_ns + round(settings.rest_time * NANOSECONDS)
        if self._newest_ns < self._rested_ns:
            return None
        limits = course.task.limits
        driver = RunDriver(course.next_run, limits, settings.drive, by_hand=settings.manual)
        if self._celsius is not None:
            driver.celsius.add(*self._celsius)
        return driver

    # --- outputs --------------------------------------------------------------------------------

    @property
    def command(self) -> MachineCommand | None:
        """The command for the machine; None without a campaign, or if an operator sets it."""
        if self._course is None or self._settings.manual:
            return None
        return REST if self._driver is None else self._driver.command

    def status(self) -> CampaignStatus | None:
        """The state; None without a campaign."""
        course = self._course
        if course is None:
            return None
        plan = course.steps[-1].plan if course.steps else None
        stage, state = self._stage(course)
        return CampaignStatus(
            stage,
            course.number,
            course.next_run.sentence if course.next_run else "",
            state,
            plan.now.worst if plan else math.nan,
            plan.runs_left if plan else None,
        )

    def _stage(self, course: CampaignCourse) -> tuple[CampaignStage, str]:
        if self._made is not None:
            return CampaignStage.IDENTIFYING, "the run is checked and stored"
        if self._worker.busy or course.work is not None or course.outcome is not None:
            return CampaignStage.IDENTIFYING, "the set is identified from all runs"
        if self._paused:
            return CampaignStage.PAUSED, "paused: the machine rests until it is resumed"
        if self._driver is None:
            if self._rested_ns is not None and self._newest_ns < self._rested_ns:
                return CampaignStage.WAITING, "the damper rests"
            return CampaignStage.WAITING, "waiting for samples"
        if self._driver.recording_begun:
            return CampaignStage.RECORDING, self._driver.state
        wanted = f"set {self._driver.run.sentence}; " if self._settings.manual else ""
        return CampaignStage.SETTLING, wanted + self._driver.state

    def take_notices(self) -> list[str]:
        """Messages since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def poll(self) -> CampaignCourse | None:
        """Collect results of the worker and give it new work; returns the course at its end."""
        outcomes = self._worker.poll()
        course = self._course
        if course is None:
            return None
        assert course.folder is not None
        for outcome in outcomes:
            self._take_outcome(course, outcome)
        if self._worker.busy:
            return None
        if self._made is not None:
            self._worker.submit(judge_run, course.folder, len(course.runs) + 1, self._made)
        elif course.outcome is None:
            if course.work is not None:
                self._worker.submit(find_step, *course.work)
        elif course.steps and not self._reporting:
            self._reporting = True
            self._worker.submit(write_campaign_report, course.folder, course.reason)
        else:
            course.close()
            self._course = None
            return course
        return None

    def _take_outcome(self, course: CampaignCourse, outcome: Outcome) -> None:
        made, self._made = self._made, None
        result = outcome.result if isinstance(outcome, Done) else None
        failed = outcome.reason if isinstance(outcome, Failed) else ""
        if made is not None:
            # A campaign that was stopped meanwhile also stores the run.
            number = len(course.runs) + 1
            if failed:
                course.end(f"run {number} could not be stored: {failed}", CampaignOutcome.FAILED)
            elif result is not None:
                said = f"is rejected: {result}" if result else f"is stored: {made[0].sentence}"
                self._notices.append(f"run {number} {said}")
                course.add_run(made, result)
        elif self._reporting:
            if failed:
                self._notices.append(f"the report could not be written: {failed}")
        elif course.outcome is None and failed:
            reason = f"run {course.number} could not be identified: {failed}"
            course.end(reason, CampaignOutcome.FAILED)
        elif course.outcome is None and result is not None:
            plan = result.plan
            try:
                course.add_step(result)
            except OSError as error:
                reason = f"the result could not be stored: {reason_of(error)}"
                course.end(reason, CampaignOutcome.FAILED)
                return
            self._notices.append(f"the force is known to {plan.now.sentence}")
            if plan.state is PlanState.RUN and plan.reason:
                self._notices.append(plan.reason)
