"""Node that commands the supply so that the damper produces a desired force."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass
from functools import partial

import numpy as np
from mr_damper_msgs.msg import CurrentCommand, DesiredForce
from rclpy.duration import Duration
from std_msgs.msg import Header

from mr_damper_ros.control.force_controller import (
    Command,
    ForceController,
    ForceControlSettings,
)
from mr_damper_ros.control.licence import REMEDY
from mr_damper_ros.nodes import quality, rclpy_internals
from mr_damper_ros.nodes.block_node import BlockNode, SetOptions
from mr_damper_ros.nodes.command_topic import COMMAND_DEPTH, COMMAND_TOPIC, DEMAND_TOPIC
from mr_damper_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Finding, steady_timer
from mr_damper_ros.nodes.inputs import CURRENT_TOPIC, SAMPLES_TOPIC
from mr_damper_ros.nodes.messages import set_stamp, to_nanoseconds
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.settings.option_table import group, option
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.error_sums import RunningError
from mr_damper_ros.signals.uniform_grid import GridSettings
from mr_damper_ros.tracking.validity import DoubtKind


@dataclass(frozen=True)
class ControllerParameters(SetOptions):
    """Parameters of the controller node.

    For every block on mts/samples the node computes, with the newest parameters, the current whose
    force is nearest to the desired force (damper/desired_force), and publishes it on
    supply/current_command. If the predicted force is invalid, the node keeps the current for a
    short time (doubt_time), then goes to the safe current. If the desired force is too old, it goes
    to the safe current at once. Without samples it commands the safe current directly. The
    diagnostics give the reason.
    """

    samples_timeout: float = option(
        0.2,
        "Time [s] without samples, on the clock of this computer, after which the safe "
        "current is commanded repeatedly.",
        within=(0.01, 60.0),
    )
    control: ForceControlSettings = group(ForceControlSettings, flat=True)
    grid: GridSettings = group(GridSettings, flat=True)
    frame_id: str = option("damper", "Frame of the commands.")

    def objection(self) -> str:
        """Return the reason if the limits leave no current to command, or an empty string."""
        low, high = self.control.lowest_current, self.control.highest_current
        if not low < high:
            return f"highest_current is {high:g} A: it must be above lowest_current, {low:g} A"
        if not low <= self.control.fallback.safe_current <= high:
            return (
                f"safe_current is {self.control.fallback.safe_current:g} A: it must lie within "
                f"lowest_current and highest_current, {low:g} to {high:g} A"
            )
        if self.control.probe_step > 0.0 and self.control.predictor.maximum_error == 0.0:
            return (
                "probe_step needs the measured force, but maximum_error is 0: set one of the two "
                "to its default"
            )
        return ""


class ControllerNode(BlockNode[ControllerParameters, Command]):
    """Publishes a command for every block of samples, and the safe current if samples stop."""

    answer, doing = "command", "controlling"

    def __init__(self) -> None:
        super().__init__("controller", ControllerParameters)
        options = self._options
        # A command applies to the present. On a computer with a free core, blocks are younger.
        self._late = 0.05
        self._controller = ForceController(options.control, options.grid)
        self._tracking = RunningError(options.error_memory)
        self._last: Command | None = None
        self._counts: Counter[str] = Counter()
        self._last_block = -math.inf
        # One message for all commands: publishing copies it.
        self._message = CurrentCommand(
            header=Header(frame_id=options.frame_id), commander=self.get_fully_qualified_name()
        )
        self._refused_force = self._told = ""
        self._command = quality.publisher(
            self, CurrentCommand, COMMAND_TOPIC, quality.stream(COMMAND_DEPTH)
        )
        quality.subscription(
            self, DesiredForce, DEMAND_TOPIC, self._take_desired_force, quality.newest()
        )
        self._listen(self._controller.predictor)
        steady_timer(self, 0.5 * options.samples_timeout, self._watch)
        self._diagnose({"command": self._command_finding, "tracking": self._tracking_finding})
        self.get_logger().info(
            f"waiting for {self.resolve_topic_name(DEMAND_TOPIC)}, "
            f"{self.resolve_topic_name(SAMPLES_TOPIC)} and "
            f"{self.resolve_topic_name(CURRENT_TOPIC)}; until then the safe current, "
            f"{options.control.fallback.safe_current:g} A, is commanded"
        )

    def _take_desired_force(self, message: DesiredForce) -> None:
        self._refused_force = self._controller.want(
            to_nanoseconds(message.header.stamp), message.force
        )

    def _publish_answer(self, block: SampleBlock, now_ns: int | None) -> Command:
        self._last_block = time.monotonic()
        command = self._controller.command(block, now_ns)
        self._publish(command.current, rclpy_internals.now_ns(self))
        return command

    def _publish(self, current: float, stamp_ns: int) -> None:
        set_stamp(self._message.header.stamp, stamp_ns)
        self._message.current = current
        self._command.publish(self._message)

    def _give_up(self) -> None:
        self._publish(self._controller.give_up(), self.get_clock().now().nanoseconds)

    def _watch(self) -> None:
        """Command the safe current if no samples arrive."""
        if time.monotonic() - self._last_block > self._options.samples_timeout:
            self._give_up()

    def _finish(self, command: Command, block: SampleBlock) -> None:
        continuity = command.prediction.continuity
        if continuity:
            self.get_logger().warning(continuity, throttle_duration_sec=10.0)
        if command.doubt.kind is DoubtKind.OUT_OF_RANGE and command.doubt.sentence != self._told:
            self._told = command.doubt.sentence
            self.get_logger().warning(f"no control: {self._told}")
        # The force of this block follows from the command after the previous block.
        before, self._last = self._last, command
        if before is not None and not before.doubt:
            self._counts.update(commands=1, met=before.attainable, unknown=before.unknown)
            if before.attainable:
                wanted = np.full(block.force.size, before.wanted)
                self._tracking.add(wanted, block.force, block.period)
        self._controller.predictor.catch_up()

    def destroy_node(self) -> None:
        """Command the safe current, and end."""
        if self.context.ok():
            self._give_up()
            # Destroying the publisher drops messages that have not been received.
            self._command.wait_for_all_acked(Duration(seconds=1.0))
        super().destroy_node()

    def _command_finding(self) -> Finding:
        counts, self._counts = self._counts, Counter()
        safe = f"the safe current, {self._options.control.fallback.safe_current:g} A, is commanded"
        if self._last is None or self._inputs.samples.silent:
            return Finding(STALE, f"no samples arrive: {safe}")
        last = self._last
        values: dict[str, object] = {
            "current [A]": f"{last.current:.4f}",
            "desired force [N]": f"{last.wanted:.4g}",
            "expected force [N]": f"{last.expected:.4g}",
            "feedback factor": f"{self._controller.feedback.factor:.4f}",
            "doubt": last.doubt.kind.name,
        }
        if self._refused_force:
            return Finding(WARN, f"{self._refused_force}; the last usable force holds", values)
        if last.doubt:
            level = ERROR if last.doubt.kind.grave else WARN
            doing = safe if last.falls_back else f"the current stays at most {last.current:.3f} A"
            return Finding(level, f"{last.doubt.sentence}: {doing}", values)
        share = counts["met"] / counts["commands"] if counts else math.nan
        values["attainable"] = f"{share:.3f}"
        if counts["unknown"]:
            unknown = counts["unknown"] / counts["commands"]
            return Finding(
                WARN,
                f"{unknown:.0%} of the desired forces of the last second need a higher "
                f"current than was identified ({self._controller.highest_known:.2f} A): identify "
                f"the damper at higher currents, {REMEDY}",
                values,
            )
        return Finding(
            OK,
            f"{last.current:.3f} A for {last.wanted:.0f} N; {share:.0%} of the desired forces of "
            "the last second were attainable, the others are not dissipative or too large",
            values,
        )

    def _tracking_finding(self) -> Finding:
        nrmse = self._tracking.nrmse
        if math.isnan(nrmse):
            given = self._last is not None and not math.isnan(self._last.wanted)
            sentence = "no desired force has been given yet"
            return Finding(OK, "no desired force was attainable yet" if given else sentence)
        return Finding(
            OK,
            f"NRMSE of the attainable forces: {nrmse:.1%} of the measured force",
            {"NRMSE": f"{nrmse:.4f}"},
        )


main = partial(run, ControllerNode, ControllerParameters, between=ControllerNode.finish_in_time)
