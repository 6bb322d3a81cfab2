"""The topic that commands a current, for the supply node and for a bridge that has a supply."""

from __future__ import annotations

import time
from collections.abc import Callable

from mr_damper_msgs.msg import CurrentCommand
from rclpy.node import Node

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import ERROR, OK, WARN, Finding
from mr_damper_ros.nodes.messages import to_nanoseconds
from mr_damper_ros.rig.supplies.current_commander import CurrentCommander, Origin
from mr_damper_ros.signals.blocks import NANOSECONDS

COMMAND_TOPIC = "supply/current_command"

_DEPTH = 10
"""Commands that may wait: only the newest matters."""


class CurrentCommands:
    """Hands the commands of the topic to a commander, and says how they come.

    ``heard`` is called after each that holds.
    """

    def __init__(
        self, node: Node, commander: CurrentCommander, heard: Callable[[], None] = lambda: None
    ) -> None:
        self._node = node
        self._commander = commander
        self._heard = heard
        self._refusal = ""
        self._refused = 0
        self._subscription = node.create_subscription(
            CurrentCommand,
            COMMAND_TOPIC,
            self._take,
            quality.stream(_DEPTH),
            qos_overriding_options=quality.overridable(),
        )

    def close(self) -> None:
        """Hear no more commands."""
        self._node.destroy_subscription(self._subscription)

    def _take(self, message: CurrentCommand) -> None:
        stamp_ns = to_nanoseconds(message.header.stamp)
        age = (self._node.get_clock().now().nanoseconds - stamp_ns) / NANOSECONDS
        refusal = self._commander.command(message.current, stamp_ns, age, time.monotonic())
        if refusal:
            self._refusal = refusal
            self._node.get_logger().warning(
                f"a command on {COMMAND_TOPIC} is refused: {refusal}", throttle_duration_sec=10.0
            )
        else:
            self._heard()

    def finding(self) -> Finding:
        """Where the current comes from, and what is wrong with the commands."""
        commander = self._commander
        origin = commander.origin(time.monotonic())
        values = {"origin": origin.name, "refused": commander.refused, "cut": commander.cut}
        refused, self._refused = commander.refused - self._refused, commander.refused
        if refused:
            return Finding(
                WARN,
                f"{refused} commands were refused since the last report: {self._refusal}",
                values,
            )
        publishers = self._node.get_publishers_info_by_topic(
            self._node.resolve_topic_name(COMMAND_TOPIC)
        )
        if len(publishers) > 1:
            names = " and ".join(
                sorted(f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in publishers)
            )
            return Finding(ERROR, f"the current is commanded by {names}: end all but one", values)
        level = WARN if origin is Origin.TIMED_OUT else OK
        return Finding(level, f"the current is {origin.value}", values)
