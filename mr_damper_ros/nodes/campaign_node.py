"""Node that characterises a damper by runs of a test machine, which it chooses and commands."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from mr_damper_msgs.action import RunCampaign
from mr_damper_msgs.msg import CurrentCommand, ExcitationCommand
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from mr_damper_ros.campaign.conductor import CampaignConductor, ConductSettings
from mr_damper_ros.campaign.course import CampaignCourse, CampaignOutcome
from mr_damper_ros.campaign.folder import CampaignTask
from mr_damper_ros.campaign.goal_options import GoalOptions, MachineOptions
from mr_damper_ros.campaign.runs import REST, MachineCommand
from mr_damper_ros.estimation.experiment_design import first_run
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.command_topic import (
    COMMAND_DEPTH,
    COMMAND_TOPIC,
    EXCITATION_TOPIC,
    command_message,
)
from mr_damper_ros.nodes.diagnostics import ERROR, OK, WARN, Diagnostics, Finding, steady_timer
from mr_damper_ros.nodes.goal_server import GoalServer
from mr_damper_ros.nodes.inputs import Inputs
from mr_damper_ros.nodes.messages import header, parameters_message, to_nanoseconds
from mr_damper_ros.nodes.node_parameters import NodeParameters
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.processes.files import reason_of
from mr_damper_ros.processes.worker import Worker, WorkerPool
from mr_damper_ros.settings.option_table import ParameterTable, group, option
from mr_damper_ros.signals.blocks import SampleBlock


@dataclass(frozen=True)
class CampaignParameters(ParameterTable):
    """Parameters of the campaign node.

    A goal of the action ~/run_campaign begins or continues a campaign. The node commands the
    machine (rig/excitation_command) and the supply (supply/current_command), and waits until both
    follow the commands. It stores the samples of the run as a bag, identifies from all runs and
    chooses the next run, until the force is known to the desired accuracy. ~/pause stops the
    machine, ~/resume continues the campaign, ~/stop ends it. If the node is killed, the same goal
    later continues with the stored runs.
    """

    folder: str = option(
        "",
        "Folder of the campaign: runs as bags, the result after each run, the last set "
        "(set.yaml) and the report (campaign.html). An unfinished campaign with the same goal "
        'continues. "": no goal is accepted.',
    )
    autostart: bool = option(
        False,
        "Whether to start or continue the campaign of the configured goal at once, without a goal "
        "of the action. The machine then moves when the node starts.",
    )
    model: str = option(DEFAULT_MODEL, "Force law that is identified.", choices=tuple(MODELS))
    most_runs: int = option(20, "Maximum number of runs of a campaign.", within=(1, 999))
    conduct: ConductSettings = group(ConductSettings, flat=True)
    goal: GoalOptions = group(GoalOptions)
    machine: MachineOptions = group(MachineOptions)
    samples_timeout: float = option(
        1.0,
        "Time [s] without samples, on the clock of this computer, after which the machine is "
        "stopped; the run is repeated when samples return.",
        within=(0.05, 60.0),
    )
    frame_id: str = option("damper", "Frame of the commands.")

    def objection(self) -> str:
        """Return the reason if goal, limits or automatic start are invalid; empty if valid."""
        try:
            self.goal.goal()
            self.machine.limits(manual=self.conduct.manual)
        except ValueError as error:
            return str(error)
        if self.autostart and not self.folder:
            return "autostart needs a folder: set the parameter folder"
        return ""


_POLL_PERIOD = 0.05
"""Time [s] between two polls of the worker, and between two commands. A machine that receives no
command for half a second stops."""


class CampaignNode(Node):
    """Passes incoming data to the conductor, and the conductor's commands to the machine."""

    def __init__(self, worker: Worker) -> None:
        super().__init__("campaign")
        self._options = NodeParameters(self, CampaignParameters).values
        self._conductor = conductor = CampaignConductor(worker, self._options.conduct)
        self._last_block = -math.inf
        self._polls = 0
        self._moving: MachineCommand | None = None
        self._last = ""
        self._failed = False
        self._motion_publisher = quality.publisher(
            self, ExcitationCommand, EXCITATION_TOPIC, quality.stream(COMMAND_DEPTH)
        )
        self._current_publisher = quality.publisher(
            self, CurrentCommand, COMMAND_TOPIC, quality.stream(COMMAND_DEPTH)
        )
        quality.subscription(
            self,
            Temperature,
            "temperature",
            lambda message: self._conductor.add_temperature(
                to_nanoseconds(message.header.stamp), message.temperature
            ),
        )
        self._inputs = Inputs(self, quality.stream, self._take_block, self._conductor.add_current)
        self._goal: ServerGoalHandle | None = None
        self._goals = GoalServer(
            self,
            RunCampaign,
            "~/run_campaign",
            begin=self._begin_goal,
            refusal=self._refusal,
            cancel=lambda goal: conductor.stop() if goal == self._goal else None,
        )
        for name, act, said in (
            ("pause", conductor.pause, "paused: the machine rests until ~/resume is called"),
            ("resume", conductor.resume, "the campaign continues"),
            ("stop", conductor.stop, "the campaign has ended; the same goal continues it"),
        ):
            self.create_service(Trigger, f"~/{name}", partial(self._steer, act, said))
        self._diagnostics = Diagnostics(
            self,
            {
                "input": lambda: self._inputs.samples_finding(conductor.sequence),
                "current": self._inputs.current_finding,
                "campaign": self._finding,
            },
            self._inputs.stream_findings,
        )
        if self._options.autostart:
            self._begin(self._options.goal)
        else:
            self.get_logger().info(
                f"waiting for a goal on {self.get_fully_qualified_name()}/run_campaign"
            )
        steady_timer(self, _POLL_PERIOD, self._poll)

    def destroy_node(self) -> None:
        """Stop the machine; completed runs are on disk."""
        if self.context.ok() and self._moving is not None:
            self._publish(REST)
        super().destroy_node()

    # --- goals ----------------------------------------------------------------------------------

    def _refusal(self, request: RunCampaign.Goal) -> str:
        """Return the reason to reject a goal, or an empty string if it is accepted."""
        options = self._options
        if self._conductor.running:
            return "a campaign is running; stop it first, or wait for its end"
        try:
            limits = options.machine.limits(manual=options.conduct.manual)
            first_run(self._wanted(request).goal(), limits)
        except ValueError as error:
            return str(error)
        return ""

    def _wanted(self, request: RunCampaign.Goal) -> GoalOptions:
        given = {"error": request.error} if request.error != 0.0 else {}
        for name in ("peak_velocity", "current"):
            ends = {end: getattr(request, end) for end in (f"lowest_{name}", f"highest_{name}")}
            given |= ends if any(ends.values()) else {}
        return replace(self._options.goal, **given)

    def _begin_goal(self, goal: ServerGoalHandle) -> None:
        try:
            self._begin(self._wanted(goal.request))
        except (ValueError, OSError) as error:
            reason = reason_of(error)
            self.get_logger().error(f"the campaign cannot begin: {reason}")
            failed = RunCampaign.Result.FAILED
            result = RunCampaign.Result(outcome=failed, message=reason, worst_error=math.nan)
            self._goals.finish(goal, result, succeeded=False)
        else:
            self._goal = goal

    def _begin(self, wanted: GoalOptions) -> None:
        """Begin or continue a campaign; raises ValueError or OSError if that is not possible."""
        options = self._options
        if not options.folder:
            raise ValueError("there is no folder to store the runs: set the parameter folder")
        limits = options.machine.limits(manual=options.conduct.manual)
        task = CampaignTask(wanted.goal(), limits, options.model)
        folder = Path(options.folder).expanduser().absolute()
        course = CampaignCourse(task, folder=folder, most_runs=options.most_runs)
        self._last, self._failed = "", False
        self._conductor.begin(course)

    def _steer(self, act: Callable[[], None], said: str, _: Any, response: Any) -> Any:
        response.success = self._conductor.running
        response.message = said if response.success else "there is no campaign"
        if response.success:
            act()
            self._command()
        return response

    # --- samples and commands -------------------------------------------------------------------

    def _take_block(self, block: SampleBlock) -> None:
        self._last_block = time.monotonic()
        before = self._conductor.command
        self._conductor.add_block(block)
        if self._conductor.command != before:
            self._command()

    def _command(self) -> None:
        command = self._conductor.command
        if command is not None:
            self._publish(command)
        elif self._moving is not None:
            self._publish(REST)
        self._moving = command

    def _publish(self, command: MachineCommand) -> None:
        stamp = header(self.get_clock().now().nanoseconds, self._options.frame_id)
        name = self.get_fully_qualified_name()
        self._motion_publisher.publish(command_message(stamp, command.motion, name))
        self._current_publisher.publish(
            CurrentCommand(header=stamp, current=command.current, commander=name)
        )

    def _poll(self) -> None:
        if time.monotonic() - self._last_block > self._options.samples_timeout:
            self._conductor.lose_contact()
        self._command()
        end = self._conductor.poll()
        for notice in self._conductor.take_notices():
            self.get_logger().info(notice)
        if end is not None:
            self._end(end)
        self._polls += 1
        status = self._conductor.status()
        if status is None or self._polls % 10:  # feedback twice a second
            return
        if self._goal is not None:
            self._goal.publish_feedback(
                RunCampaign.Feedback(
                    stage=int(status.stage),
                    run=status.run,
                    sentence=status.sentence or status.state,
                    worst_error=status.worst_error,
                    runs_left=-1 if status.runs_left is None else status.runs_left,
                )
            )
        if self._options.conduct.manual and status.sentence and status.sentence != self._last:
            # For the operator of a manual press, once.
            self._last = status.sentence
            self.get_logger().info(f"set run {status.run}: {status.sentence}")

    def _end(self, end: CampaignCourse) -> None:
        assert end.outcome is not None
        self._last, self._failed = end.reason, end.outcome is CampaignOutcome.FAILED
        log = self.get_logger().error if self._failed else self.get_logger().info
        log(f"the campaign has ended after {len(end.steps)} runs: {end.reason}")
        if self._goal is None:
            return
        goal, self._goal = self._goal, None
        result = RunCampaign.Result(
            outcome=int(end.outcome),
            message=end.reason,
            runs=len(end.steps),
            folder=self._options.folder,
            worst_error=end.steps[-1].plan.now.worst if end.steps else math.nan,
        )
        if end.steps:
            found, node = end.steps[-1].parameter_set, self.get_fully_qualified_name()
            result.parameters = parameters_message(found, self._options.frame_id, node)
        self._goals.finish(goal, result, succeeded=end.outcome is CampaignOutcome.MET)

    # --- state ----------------------------------------------------------------------------------

    def _finding(self) -> Finding:
        status = self._conductor.status()
        if status is None:
            said = f"the last campaign: {self._last}" if self._last else "waiting for a goal"
            return Finding(ERROR if self._failed else OK, said)
        figures = {
            "stage": status.stage.name,
            "run": status.run,
            "worst error": f"{status.worst_error:.4g}",
            "runs left": "unknown" if status.runs_left is None else status.runs_left,
        }
        sentences = filter(None, (status.sentence, status.state))
        level = WARN if self._inputs.samples.silent else OK
        return Finding(level, f"run {status.run}: {'; '.join(sentences)}", figures)


def main() -> int:
    """Run the node and its worker; returns the exit code."""
    with closing(WorkerPool("scipy.optimize mr_damper_ros.campaign.course")) as workers:
        return run(partial(CampaignNode, Worker(workers)), CampaignParameters)
