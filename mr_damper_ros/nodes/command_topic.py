"""Command topics for current and motion; each command is checked and holds for a limited time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from mr_damper_msgs.msg import CurrentCommand, ExcitationCommand
from rclpy.node import Node
from std_msgs.msg import Header

from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import ERROR, OK, WARN, Finding
from mr_damper_ros.nodes.messages import to_nanoseconds
from mr_damper_ros.rig.commander import Commander
from mr_damper_ros.signals.blocks import NANOSECONDS

COMMAND_TOPIC = "supply/current_command"
DEMAND_TOPIC = "damper/desired_force"
EXCITATION_TOPIC = "rig/excitation_command"

_KINDS = (MotionKind.SINE, MotionKind.SWEEP, MotionKind.RANDOM)
"""Kinds of motion in the order of the constants in ExcitationCommand.msg."""


_OF_A_MOTION = ("amplitude", "frequency", "highest_frequency", "period", "seed")
"""Names of the fields that the command and the motion share."""


def command_message(header: Header, motion: PeriodicMotion | None) -> ExcitationCommand:
    """The command for a motion; None commands rest."""
    if motion is None:
        return ExcitationCommand(header=header)
    values = {name: getattr(motion, name) for name in _OF_A_MOTION}
    return ExcitationCommand(header=header, motion=_KINDS.index(motion.kind), **values)


def motion_of(message: ExcitationCommand) -> PeriodicMotion | None:
    """The motion in a command, None for rest. Raises ValueError if the command is invalid."""
    if message.amplitude == 0.0:
        return None
    if message.motion >= len(_KINDS):
        raise ValueError(f"the motion {message.motion} is unknown")
    kind = _KINDS[message.motion]
    # The other fields have no meaning for a sine.
    names = _OF_A_MOTION[:2] if kind is MotionKind.SINE else _OF_A_MOTION
    return PeriodicMotion(kind, **{name: getattr(message, name) for name in names})


_COMMANDED: dict[str, tuple[type, str, Callable[[Any], Any]]] = {
    "current": (CurrentCommand, COMMAND_TOPIC, lambda message: message.current),
    "motion": (ExcitationCommand, EXCITATION_TOPIC, motion_of),
}
"""Message type and topic of the commands of each quantity, and what a message commands."""


class CommandTopic:
    """Passes the commands of the quantity ``what`` to a commander, and reports on them.

    ``accepted`` is called after each accepted command.
    """

    def __init__(
        self,
        node: Node,
        what: str,
        commander: Commander[Any],
        accepted: Callable[[], None] = lambda: None,
    ) -> None:
        self._node, self._what = node, what
        self._commander, self._accepted = commander, accepted
        self._refusal = ""
        self._reported = 0
        kind, self._topic, self._target = _COMMANDED[what]
        self._subscription = quality.subscription(
            node, kind, self._topic, self._take, quality.newest()
        )

    def close(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    def _take(self, message: Any) -> None:
        stamp_ns = to_nanoseconds(message.header.stamp)
        age = (self._node.get_clock().now().nanoseconds - stamp_ns) / NANOSECONDS
        try:
            target = self._target(message)
        except ValueError as error:
            refusal = self._commander.refuse(str(error))
        else:
            refusal = self._commander.command(target, stamp_ns, age, time.monotonic())
        if not refusal:
            self._accepted()
            return
        self._refusal = refusal
        self._node.get_logger().warning(
            f"a command on {self._topic} is rejected: {refusal}", throttle_duration_sec=10.0
        )

    def finding(self) -> Finding:
        """The present command, and all faults of the commands."""
        sentence, commanded, timed_out = self._commander.state(time.monotonic())
        refused = self._commander.refused
        new, self._reported = refused - self._reported, refused
        values = {"refused": refused, **commanded}
        wrong = []
        publishers = quality.publishing_nodes(self._node, self._topic)
        if len(publishers) > 1:
            names = quality.listed(publishers)
            wrong.append(f"the {self._what} is commanded by {names}: stop all but one")
        if new:
            wrong.append(f"{new} commands were rejected since the last report: {self._refusal}")
        if wrong:
            return Finding(ERROR if len(publishers) > 1 else WARN, "; ".join(wrong), values)
        return Finding(WARN if timed_out else OK, sentence, values)
