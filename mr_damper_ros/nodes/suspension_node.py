"""Node that computes the desired force of a damper in a suspension."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

from mr_damper_msgs.msg import DesiredForce
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from mr_damper_ros.control.semi_active import SuspensionSettings, controller_of
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.command_topic import DEMAND_TOPIC
from mr_damper_ros.nodes.diagnostics import Diagnostics, Finding, finding_of
from mr_damper_ros.nodes.inputs import MessageError, Stream
from mr_damper_ros.nodes.messages import BODY, SUSPENSION_TOPIC, suspension_state, to_nanoseconds
from mr_damper_ros.nodes.node_parameters import NodeParameters
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.processes.files import reason_of
from mr_damper_ros.settings.option_table import ParameterTable, group, option
from mr_damper_ros.signals.blocks import NANOSECONDS


@dataclass(frozen=True)
class SuspensionParameters(ParameterTable):
    """Parameters of the suspension node.

    For every motion on suspension/motion it publishes the desired force of the damper on
    damper/desired_force. The node ``controller`` commands the current for it.
    """

    control: SuspensionSettings = group(SuspensionSettings, flat=True)
    largest_force: float = option(
        10_000.0, "Largest magnitude of the desired force [N].", within=(0.0, 1e9)
    )
    frame_id: str = option("damper", "Frame of the desired forces.")


class SuspensionNode(Node):
    """Publishes a desired force for every motion of the suspension."""

    def __init__(self) -> None:
        super().__init__("suspension")
        self._options = NodeParameters(self, SuspensionParameters).values
        self._controller = controller_of(self._options.control)
        self._last = math.nan
        # Velocity of the body [m/s] and its stamp.
        self._body = math.nan, 0
        self._demand = quality.publisher(self, DesiredForce, DEMAND_TOPIC)
        self._stream = Stream(
            self,
            JointState,
            SUSPENSION_TOPIC,
            self._demand_for,
            self._demand.publish,
            quality.newest(),
            "does the vehicle send its motion?",
        )
        self._diagnostics = Diagnostics(self, {"force": self._finding})
        name = self._options.control.function or self._options.control.controller
        self.get_logger().info(
            f"{name}: waiting for {self.resolve_topic_name(SUSPENSION_TOPIC)}; without it no "
            "desired force is published"
        )

    def _demand_for(self, message: JointState) -> DesiredForce:
        """The desired force at a motion; raises MessageError if there is none."""
        try:
            now = suspension_state(message, self._acceleration(message))
        except ValueError as error:
            raise MessageError(str(error)) from error
        try:
            force = float(self._controller(now))
        except Exception as error:  # a user's function: its errors must not end the node
            raise MessageError(f"the controller failed: {reason_of(error)}") from error
        if not math.isfinite(force):
            raise MessageError(
                f"the controller returned {force} N: does it need a signal that is not measured?"
            )
        limit = self._options.largest_force
        self._last = min(max(force, -limit), limit)
        stamped = Header(stamp=message.header.stamp, frame_id=self._options.frame_id)
        return DesiredForce(header=stamped, force=self._last)

    def _acceleration(self, message: JointState) -> float:
        """Mean acceleration [m/s²] of the body since the last message; 0 after a pause of 0.1 s."""
        velocity = dict(zip(message.name, message.velocity, strict=False)).get(BODY, math.nan)
        stamp_ns = to_nanoseconds(message.header.stamp)
        (before, before_ns), self._body = self._body, (velocity, stamp_ns)
        passed = (stamp_ns - before_ns) / NANOSECONDS
        return (velocity - before) / passed if 0.0 < passed < 0.1 else 0.0

    def _finding(self) -> Finding:
        """The desired force; without it, the damper controller commands its safe current."""
        rate, found = self._stream.take_rate(), self._stream.take_finding()
        values = {"desired force [N]": f"{self._last:.4g}", "forces/s": f"{rate:.1f}"}
        return finding_of(found, f"the desired force is {self._last:.0f} N", values)


main = partial(run, SuspensionNode, SuspensionParameters)
