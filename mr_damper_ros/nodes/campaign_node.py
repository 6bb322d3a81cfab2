"""Node that makes a damper known: it chooses the runs of a test machine and has them made."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from mr_damper_msgs.action import RunCampaign
from mr_damper_msgs.msg import CurrentCommand, DamperParameters, ExcitationCommand
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from mr_damper_ros.campaign.conductor import (
    CampaignConductor,
    CampaignEnd,
    CampaignStatus,
)
from mr_damper_ros.campaign.course import CampaignCourse, CampaignOutcome
from mr_damper_ros.campaign.folder import CampaignFolder, CampaignTask
from mr_damper_ros.campaign.runs import REST, MachineCommand
from mr_damper_ros.estimation.planned_run import first_run
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.campaign_goals import CampaignGoals
from mr_damper_ros.nodes.campaign_parameters import CampaignParameters, GoalOptions
from mr_damper_ros.nodes.current_commands import COMMAND_TOPIC
from mr_damper_ros.nodes.diagnostics import ERROR, OK, WARN, Diagnostics, Finding
from mr_damper_ros.nodes.inputs import Inputs
from mr_damper_ros.nodes.messages import header, to_nanoseconds
from mr_damper_ros.nodes.motion_commands import EXCITATION_TOPIC, command_message
from mr_damper_ros.nodes.node_parameters import ConfigurationError, NodeParameters
from mr_damper_ros.nodes.results import parameters_message
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.processes.worker import Worker
from mr_damper_ros.signals.blocks import SampleBlock

_ATTENTION_PERIOD = 0.05
"""Seconds between two looks at the worker, and two commands: a machine that hears none for half a
second comes to rest."""

_FEEDBACK = 10
"""Looks between two feedbacks."""


class CampaignNode(Node):
    """Hands what arrives to the conductor, and its commands to the machine."""

    def __init__(self, worker: Worker) -> None:
        super().__init__("campaign")
        self._options = NodeParameters(self, CampaignParameters).values
        self._conductor = CampaignConductor(worker, self._options.conduct)
        self._heard = -math.inf
        self._looks = 0
        self._moving: MachineCommand | None = None
        self._last = ""
        self._failed = False
        self._motion_publisher, self._current_publisher = (
            self.create_publisher(
                kind, topic, quality.stream(), qos_overriding_options=quality.overridable()
            )
            for kind, topic in (
                (ExcitationCommand, EXCITATION_TOPIC),
                (CurrentCommand, COMMAND_TOPIC),
            )
        )
        self.create_subscription(
            Temperature,
            "temperature",
            lambda message: self._conductor.add_temperature(
                to_nanoseconds(message.header.stamp), message.temperature
            ),
            quality.stream(),
            qos_overriding_options=quality.overridable(),
        )
        self._inputs = Inputs(self, quality.stream, self._take_block, self._conductor.add_current)
        self._goals = CampaignGoals(
            self,
            lambda request: self._begin(self._wanted(request)),
            self._objection,
            lambda: self._conductor.running,
            self._conductor.stop,
        )
        conductor = self._conductor
        for name, act, said in (
            ("pause", conductor.pause, "paused: the machine rests until ~/resume is called"),
            ("resume", conductor.resume, "the campaign goes on"),
            ("stop", conductor.stop, "the campaign is ended; the same goal goes on with it"),
        ):
            self.create_service(Trigger, f"~/{name}", partial(self._steer, act, said))
        self._diagnostics = Diagnostics(
            self,
            {
                "input": lambda: self._inputs.samples_finding(conductor.sequence),
                "current": self._inputs.current_finding,
                "campaign": self._finding,
            },
        )
        if self._options.autostart:
            why_not = self._begin(self._options.goal)
            if why_not:
                raise ConfigurationError(why_not)
        else:
            self.get_logger().info(
                f"waiting for a goal on {self.get_fully_qualified_name()}/run_campaign"
            )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_ATTENTION_PERIOD, self._attend, clock=steady)

    def destroy_node(self) -> None:
        """Let the machine rest; what is finished is on disk."""
        if self.context.ok() and self._moving is not None:
            self._publish(REST)
        super().destroy_node()

    # --- goals ----------------------------------------------------------------------------------

    def _objection(self, request: RunCampaign.Goal) -> str:
        """Why a goal cannot be meant, or is beyond the machine, in words; empty where it can."""
        options = self._options
        try:
            limits = options.machine.limits(manual=options.conduct.manual)
            first_run(self._wanted(request).goal(), limits)
        except ValueError as error:
            return str(error)
        return ""

    def _wanted(self, request: RunCampaign.Goal) -> GoalOptions:
        wanted = self._options.goal
        if request.error != 0.0:
            wanted = replace(wanted, error=request.error)
        for name in ("peak_velocity", "current"):
            low, high = (f"lowest_{name}", f"highest_{name}")
            if getattr(request, low) != 0.0 or getattr(request, high) != 0.0:
                wanted = replace(
                    wanted, **{low: getattr(request, low), high: getattr(request, high)}
                )
        return wanted

    def _begin(self, wanted: GoalOptions) -> str:
        """Begin a campaign, or go on with it; why not, in words, empty where it has begun."""
        options = self._options
        if not options.folder:
            return "there is no folder to keep the runs in: set the parameter folder"
        try:
            limits = options.machine.limits(manual=options.conduct.manual)
            task = CampaignTask(wanted.goal(), limits, options.model)
            folder = CampaignFolder(Path(options.folder).expanduser().absolute(), task)
        except (ValueError, OSError) as error:
            return str(error)
        try:
            course = CampaignCourse(task, folder=folder, most_runs=options.most_runs)
        except (ValueError, OSError) as error:
            folder.close()
            return str(error)
        self._last, self._failed = "", False
        self._conductor.begin(course, folder)
        return ""

    def _steer(self, act: Callable[[], None], said: str, _: Any, response: Any) -> Any:
        response.success = self._conductor.running
        response.message = said if response.success else "there is no campaign"
        if response.success:
            act()
            self._command()
        return response

    # --- samples and commands -------------------------------------------------------------------

    def _take_block(self, block: SampleBlock) -> None:
        self._heard = time.monotonic()
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
        self._motion_publisher.publish(command_message(stamp, command.motion))
        self._current_publisher.publish(CurrentCommand(header=stamp, current=command.current))

    def _attend(self) -> None:
        if time.monotonic() - self._heard > self._options.samples_timeout:
            self._conductor.lose_contact()
        self._command()
        end = self._conductor.poll()
        for notice in self._conductor.take_notices():
            self.get_logger().info(notice)
        if end is not None:
            self._end(end)
        self._looks += 1
        status = self._conductor.status()
        if status is not None and self._looks % _FEEDBACK == 0:
            self._goals.tell(status)
            self._say(status)

    def _say(self, status: CampaignStatus) -> None:
        """Tell whoever sets the press what to set, once."""
        if self._options.conduct.manual and status.sentence and status.sentence != self._last:
            self._last = status.sentence
            self.get_logger().info(f"set run {status.run}: {status.sentence}")

    def _end(self, end: CampaignEnd) -> None:
        self._last, self._failed = end.reason, end.outcome is CampaignOutcome.FAILED
        log = self.get_logger().error if self._failed else self.get_logger().info
        log(f"the campaign has ended after {len(end.steps)} runs: {end.reason}")
        found = DamperParameters()
        worst = math.nan
        if end.steps:
            step = end.steps[-1]
            worst = step.plan.now.worst
            found = parameters_message(
                step.parameter_set, self._options.frame_id, self.get_fully_qualified_name()
            )
        self._goals.end(
            RunCampaign.Result(
                outcome=int(end.outcome),
                message=end.reason,
                runs=len(end.steps),
                folder=self._options.folder,
                parameters=found,
                worst_error=worst,
            )
        )

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
        waits = self._inputs.silent
        said = f"run {status.run}: {status.sentence or status.state}"
        if status.sentence:
            said += f"; {status.state}"
        return Finding(WARN if waits else OK, said, figures)


def main(worker: Worker) -> int:
    """Run the node, with a worker that the caller closes."""
    return run(partial(CampaignNode, worker), CampaignParameters)
