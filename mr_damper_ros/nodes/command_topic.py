"""A topic of commands, of which each holds for a while: how they are taken in, and judged."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from typing import Any, ClassVar

from rclpy.node import Node

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import ERROR, WARN, Finding
from mr_damper_ros.nodes.messages import to_nanoseconds
from mr_damper_ros.rig.commander import Commander
from mr_damper_ros.signals.blocks import NANOSECONDS

_DEPTH = 10
"""Commands that may wait: only the newest matters."""


class CommandTopic(ABC):
    """Hands the commands of a topic to a commander, and says how they come."""

    kind: ClassVar[type]
    topic: ClassVar[str]
    what: ClassVar[str]
    """What is commanded, such as "the current"."""

    def __init__(self, node: Node, commander: Commander) -> None:
        self._node = node
        self._counted = commander
        self._refusal = ""
        self._told = 0
        self._subscription = node.create_subscription(
            self.kind,
            self.topic,
            self._take,
            quality.stream(_DEPTH),
            qos_overriding_options=quality.overridable(),
        )

    def close(self) -> None:
        """Hear no more commands."""
        self._node.destroy_subscription(self._subscription)

    @abstractmethod
    def _obey(self, message: Any, stamp_ns: int, age: float, now: float) -> str:
        """Hand on a command decided ``age`` [s] ago; returns why not, empty if it holds."""

    @abstractmethod
    def _state(self, now: float) -> Finding:
        """What the commander makes of the commands now."""

    def _take(self, message: Any) -> None:
        stamp_ns = to_nanoseconds(message.header.stamp)
        age = (self._node.get_clock().now().nanoseconds - stamp_ns) / NANOSECONDS
        refusal = self._obey(message, stamp_ns, age, time.monotonic())
        if refusal:
            self._refusal = refusal
            self._node.get_logger().warning(
                f"a command on {self.topic} is refused: {refusal}", throttle_duration_sec=10.0
            )

    def finding(self) -> Finding:
        """What is commanded, and all that is wrong with the commands."""
        state = self._state(time.monotonic())
        refused, self._told = self._counted.refused - self._told, self._counted.refused
        values = {"refused": self._counted.refused, **state.values}
        wrong = []
        publishers = self._node.get_publishers_info_by_topic(
            self._node.resolve_topic_name(self.topic)
        )
        if len(publishers) > 1:
            names = " and ".join(
                sorted(f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in publishers)
            )
            wrong.append(f"{self.what} is commanded by {names}: end all but one")
        if refused:
            wrong.append(f"{refused} commands were refused since the last report: {self._refusal}")
        if wrong:
            return Finding(ERROR if len(publishers) > 1 else WARN, "; ".join(wrong), values)
        return Finding(state.level, state.message, values)
