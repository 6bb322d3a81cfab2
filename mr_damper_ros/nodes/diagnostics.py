"""The state of a node in words, published on /diagnostics once a second."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR
STALE = DiagnosticStatus.STALE


@dataclass(frozen=True)
class Finding:
    """The state of one concern: its ``level``, a sentence, and values by name."""

    level: bytes
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


def steady_timer(node: Node, period: float, callback: Callable[[], None]) -> None:
    """Call a function every ``period`` [s] by the steady clock, whatever the clock of the node."""
    node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


class Diagnostics:
    """Publishes the findings of all ``concerns`` (one function per name) every second.

    With ``use_sim_time`` the node's clock may stop, and then the diagnostics are needed most.
    """

    def __init__(self, node: Node, concerns: Mapping[str, Callable[[], Finding]]) -> None:
        self._node = node
        self._concerns = dict(concerns)
        self.publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        steady_timer(node, 1.0, self.publish)

    def publish(self) -> None:
        """Publish the present findings."""
        name = self._node.get_fully_qualified_name().lstrip("/")
        array = DiagnosticArray()
        array.header.stamp = self._node.get_clock().now().to_msg()
        for concern, find in self._concerns.items():
            finding = find()
            array.status.append(
                DiagnosticStatus(
                    level=finding.level,
                    name=f"{name}: {concern}",
                    message=finding.message,
                    hardware_id=name,
                    values=[
                        KeyValue(key=key, value=str(value)) for key, value in finding.values.items()
                    ],
                )
            )
        self.publisher.publish(array)
