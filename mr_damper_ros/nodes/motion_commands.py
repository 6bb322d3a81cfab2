"""The topic that commands the motion, for a bridge whose machine moves as it is told."""

from __future__ import annotations

import time

from mr_damper_msgs.msg import ExcitationCommand
from rclpy.node import Node
from std_msgs.msg import Header

from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import OK, WARN, Finding
from mr_damper_ros.nodes.messages import to_nanoseconds
from mr_damper_ros.rig.motion_commander import MotionCommander
from mr_damper_ros.signals.blocks import NANOSECONDS

EXCITATION_TOPIC = "rig/excitation_command"

_KINDS = (MotionKind.SINE, MotionKind.SWEEP, MotionKind.RANDOM)
"""In the order of their numbers in ExcitationCommand.msg."""

_DEPTH = 10
"""Commands that may wait: only the newest matters."""


class MotionCommands:
    """Hands the commands of the topic to the commander of a machine, and says how they come."""

    def __init__(self, node: Node, commander: MotionCommander) -> None:
        self._node = node
        self._commander = commander
        self._refusal = ""
        self._told = 0
        self._subscription = node.create_subscription(
            ExcitationCommand,
            EXCITATION_TOPIC,
            self._take,
            quality.stream(_DEPTH),
            qos_overriding_options=quality.overridable(),
        )

    def close(self) -> None:
        """Hear no more commands."""
        self._node.destroy_subscription(self._subscription)

    def _take(self, message: ExcitationCommand) -> None:
        stamp_ns = to_nanoseconds(message.header.stamp)
        age = (self._node.get_clock().now().nanoseconds - stamp_ns) / NANOSECONDS
        try:
            motion = motion_of(message)
        except ValueError as error:
            refusal = self._commander.refuse(str(error))
        else:
            refusal = self._commander.command(motion, stamp_ns, age, time.monotonic())
        if refusal:
            self._refusal = refusal
            self._node.get_logger().warning(
                f"a command on {EXCITATION_TOPIC} is refused: {refusal}",
                throttle_duration_sec=10.0,
            )

    def finding(self) -> Finding:
        """How the machine moves, and what is wrong with the commands."""
        commander = self._commander
        refused, self._told = commander.refused - self._told, commander.refused
        values = {"refused": commander.refused}
        if refused:
            return Finding(
                WARN,
                f"{refused} commands were refused since the last report: {self._refusal}",
                values,
            )
        if not commander.commanded:
            return Finding(OK, "the machine moves by itself until a command comes", values)
        motion = commander.wanted(time.monotonic())
        if motion is None:
            return Finding(OK, "the machine rests", values)
        return Finding(OK, f"{motion.sentence} commanded", values)


def command_message(header: Header, motion: PeriodicMotion | None) -> ExcitationCommand:
    """The command of a motion, None for rest."""
    if motion is None:
        return ExcitationCommand(header=header)
    return ExcitationCommand(
        header=header,
        amplitude=motion.amplitude,
        frequency=motion.frequency,
        motion=_KINDS.index(motion.kind),
        highest_frequency=motion.highest_frequency,
        period=motion.period,
        seed=motion.seed,
    )


def motion_of(message: ExcitationCommand) -> PeriodicMotion | None:
    """The motion of a command, None for rest. Raises ValueError where it makes no sense."""
    if message.amplitude == 0.0:
        return None
    if message.motion >= len(_KINDS):
        raise ValueError(f"the motion {message.motion} is unknown")
    kind = _KINDS[message.motion]
    if kind is MotionKind.SINE:
        return PeriodicMotion(kind, message.amplitude, message.frequency)
    return PeriodicMotion(
        kind,
        message.amplitude,
        message.frequency,
        message.highest_frequency,
        message.period,
        message.seed,
    )
