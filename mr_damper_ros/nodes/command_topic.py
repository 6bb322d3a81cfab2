"""Command topics for current and motion; each command is checked and holds for a limited time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from mr_damper_msgs.msg import CurrentCommand, ExcitationCommand
from rclpy.node import Node
from std_msgs.msg import Header

from mr_damper_ros.data_check.stream_watch import listed
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import ERROR, OK, WARN, Finding
from mr_damper_ros.nodes.messages import to_nanoseconds
from mr_damper_ros.rig.commander import Commander, named
from mr_damper_ros.signals.blocks import NANOSECONDS

COMMAND_TOPIC = "supply/current_command"
DEMAND_TOPIC = "damper/desired_force"
EXCITATION_TOPIC = "rig/excitation_command"

COMMAND_DEPTH = 1
"""Queue length of command topics: only the newest command matters, and commands are repeated."""

_KINDS = (MotionKind.SINE, MotionKind.SWEEP, MotionKind.RANDOM)
"""Kinds of motion in the order of the constants in ExcitationCommand.msg."""


_OF_A_MOTION = ("amplitude", "frequency", "highest_frequency", "period", "seed")
"""Names of the fields that the command and the motion share."""


def command_message(
    header: Header, motion: PeriodicMotion | None, commander: str = ""
) -> ExcitationCommand:
    """The command for a motion; None commands rest."""
    message = ExcitationCommand(header=header, commander=commander)
    if motion is not None:
        message.motion = _KINDS.index(motion.kind)
        for name in _OF_A_MOTION:
            setattr(message, name, getattr(motion, name))
    return message


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


_MOST_NAMES = 8
"""Names of commanders that are kept between two reports."""

_REPORT_PERIOD = 0.5
"""Shortest time [s] for which refusals and stamps are reported together."""

_FEWEST_AGES, _MOST_AGES = 5, 1000
"""Number of commands between two reports whose stamps are compared with the clock."""

_REFUSAL_PERIOD = 10.0
"""Time [s] between two log entries about the same refused commander."""

_COMMANDED: dict[str, tuple[type, str, Callable[[Any], Any]]] = {
    "current": (CurrentCommand, COMMAND_TOPIC, lambda message: message.current),
    "motion": (ExcitationCommand, EXCITATION_TOPIC, motion_of),
}
"""Message type and topic of the commands of each quantity, and what a message commands."""


class CommandTopic:
    """Passes the commands of the quantity ``what`` to a commander, and reports on them.

    ``accepted`` is called after each accepted command, ``refused`` at the first refusal and when
    another commander is refused.
    """

    def __init__(
        self,
        node: Node,
        what: str,
        commander: Commander[Any],
        accepted: Callable[[], None] = lambda: None,
        refused: Callable[[], None] = lambda: None,
    ) -> None:
        self._node, self._what = node, what
        self._commander, self._accepted, self._refused = commander, accepted, refused
        self._refusal = ""
        self._reported = 0
        self._reported_at = -math.inf
        self._logged: dict[str, float] = {}
        self._heard: set[str] = set()
        self._ages: list[float] = []
        kind, self._topic, self._target = _COMMANDED[what]
        self._subscription = quality.subscription(
            node, kind, self._topic, self._take, quality.stream(COMMAND_DEPTH)
        )

    def close(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    def _take(self, message: Any) -> None:
        stamp_ns = to_nanoseconds(message.header.stamp)
        age = (self._node.get_clock().now().nanoseconds - stamp_ns) / NANOSECONDS
        if len(self._heard) < _MOST_NAMES:
            self._heard.add(message.commander)
        if len(self._ages) < _MOST_AGES:
            self._ages.append(age)
        try:
            target = self._target(message)
        except ValueError as error:
            refusal = self._commander.refuse(str(error))
        else:
            refusal = self._commander.command(
                target, stamp_ns, age, time.monotonic(), message.commander
            )
        if not refusal:
            self._accepted()
            return
        self._refusal = refusal
        now = time.monotonic()
        recent = {name: at for name, at in self._logged.items() if now - at < _REFUSAL_PERIOD}
        self._logged = recent
        if message.commander in recent or len(recent) >= _MOST_NAMES:
            return
        recent[message.commander] = now
        self._node.get_logger().warning(f"a command on {self._topic} is rejected: {refusal}")
        self._refused()

    def finding(self) -> Finding:
        """The present command, and all faults of the commands."""
        now = time.monotonic()
        sentence, commanded, timed_out = self._commander.state(now)
        refused = self._commander.refused
        new, heard, ages = refused - self._reported, self._heard, self._ages
        if now - self._reported_at > _REPORT_PERIOD:  # a report between two others ends no period
            self._reported, self._reported_at = refused, now
            self._heard, self._ages = set(), []
        values = {"refused": refused, **commanded}
        if self._commander.is_held(now):
            values["commander"] = named(self._commander.holder)
        publishers = quality.publishing_nodes(self._node, self._topic)
        wrong = []
        # Commanders can be told apart by their names only.
        mixed = len(publishers) > 1 and (
            "" in heard or (len(heard) == 1 and len(set(publishers)) < len(publishers))
        )
        if mixed:
            wrong.append(
                f"the {self._what} is commanded by {listed(publishers)}: stop all but one, "
                "or give each of them a name of its own in the field commander"
            )
        if new:
            wrong.append(f"{new} commands were rejected since the last report: {self._refusal}")
        elif (
            len(ages) >= _FEWEST_AGES
            and min(ages) > self._commander.tolerance
            and not self._node.get_clock().ros_time_is_active  # it may run faster than real time
        ):
            wrong.append(
                f"the commands are stamped {min(ages):.2g} s behind this node's clock, so they end "
                "early: the clocks differ: synchronise both computers"
            )
        if wrong:
            return Finding(ERROR if mixed else WARN, "; ".join(wrong), values)
        return Finding(WARN if timed_out else OK, sentence, values)
