"""Command topics for current and motion; each command is checked and holds for a limited time."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

from mr_damper_msgs.msg import CurrentCommand, ExcitationCommand
from rclpy.node import Node
from std_msgs.msg import Header

from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import ERROR, OK, WARN, Finding
from mr_damper_ros.nodes.messages import to_nanoseconds
from mr_damper_ros.rig.commander import Commander, CurrentCommander, MotionCommander, Origin
from mr_damper_ros.signals.blocks import NANOSECONDS


class CommandTopic(ABC):
    """Passes the commands of a topic to a commander, and reports on them."""

    kind: ClassVar[type]
    topic: ClassVar[str]
    what: ClassVar[str]
    """The commanded quantity in messages, such as "the current"."""

    def __init__(self, node: Node, commander: Commander) -> None:
        self._node = node
        self._counted = commander
        self._refusal = ""
        self._reported = 0
        self._subscription = quality.subscription(
            node, self.kind, self.topic, self._take, quality.newest()
        )

    def close(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    @abstractmethod
    def _command(self, message: Any, stamp_ns: int, age: float, now: float) -> str:
        """Pass on a command issued ``age`` [s] ago; returns why it is rejected, or ""."""

    @abstractmethod
    def _state(self, now: float) -> Finding:
        """The state of the commander."""

    def _take(self, message: Any) -> None:
        stamp_ns = to_nanoseconds(message.header.stamp)
        age = (self._node.get_clock().now().nanoseconds - stamp_ns) / NANOSECONDS
        refusal = self._command(message, stamp_ns, age, time.monotonic())
        if refusal:
            self._refusal = refusal
            self._node.get_logger().warning(
                f"a command on {self.topic} is rejected: {refusal}", throttle_duration_sec=10.0
            )

    def finding(self) -> Finding:
        """The present command, and all faults of the commands."""
        state = self._state(time.monotonic())
        refused, self._reported = self._counted.refused - self._reported, self._counted.refused
        values = {"refused": self._counted.refused, **state.values}
        wrong = []
        publishers = quality.publishing_nodes(self._node, self.topic)
        if len(publishers) > 1:
            names = " and ".join(publishers)
            wrong.append(f"{self.what} is commanded by {names}: stop all but one")
        if refused:
            wrong.append(f"{refused} commands were rejected since the last report: {self._refusal}")
        if wrong:
            return Finding(ERROR if len(publishers) > 1 else WARN, "; ".join(wrong), values)
        return Finding(state.level, state.message, values)


COMMAND_TOPIC = "supply/current_command"
DEMAND_TOPIC = "damper/desired_force"


class CurrentCommands(CommandTopic):
    """Passes on commands of the current; ``accepted`` is called after each accepted command."""

    kind, topic, what = CurrentCommand, COMMAND_TOPIC, "the current"

    def __init__(
        self, node: Node, commander: CurrentCommander, accepted: Callable[[], None] = lambda: None
    ) -> None:
        self._commander = commander
        self._accepted = accepted
        super().__init__(node, commander)

    def _command(self, message: CurrentCommand, stamp_ns: int, age: float, now: float) -> str:
        refusal = self._commander.command(message.current, stamp_ns, age, now)
        if not refusal:
            self._accepted()
        return refusal

    def _state(self, now: float) -> Finding:
        origin = self._commander.origin(now)
        level = WARN if origin is Origin.TIMED_OUT else OK
        values = {"origin": origin.name, "cut": self._commander.cut}
        return Finding(level, f"the current is {origin.value}", values)


EXCITATION_TOPIC = "rig/excitation_command"

_KINDS = (MotionKind.SINE, MotionKind.SWEEP, MotionKind.RANDOM)
"""Kinds of motion in the order of the constants in ExcitationCommand.msg."""


class MotionCommands(CommandTopic):
    """Passes commands of the motion to the commander of a machine."""

    kind, topic, what = ExcitationCommand, EXCITATION_TOPIC, "the motion"

    def __init__(self, node: Node, commander: MotionCommander) -> None:
        self._commander = commander
        super().__init__(node, commander)

    def _command(self, message: ExcitationCommand, stamp_ns: int, age: float, now: float) -> str:
        try:
            motion = motion_of(message)
        except ValueError as error:
            return self._commander.refuse(str(error))
        return self._commander.command(motion, stamp_ns, age, now)

    def _state(self, now: float) -> Finding:
        if not self._commander.commanded:
            sentence = "the machine makes its own motion until a command arrives"
            return Finding(OK, sentence, {"excitation": "its own"})
        motion = self._commander.motion(now)
        if motion is None:
            return Finding(OK, "the machine rests", {"excitation": "at rest"})
        return Finding(OK, f"{motion.sentence} commanded", {"excitation": motion.sentence})


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
