"""The state of a node in words, published on /diagnostics once a second, or at a new finding."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from mr_damper_ros.data_check import findings
from mr_damper_ros.data_check.stream_watch import NewFindings

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


def finding_of(
    found: findings.Finding | None, otherwise: str, values: Mapping[str, object]
) -> Finding:
    """The state that a finding of the check of data describes; ``otherwise`` is the one without."""
    if found is None:
        return Finding(OK, otherwise, values)
    level = STALE if found.severity is findings.NOTE else WARN
    return Finding(level, found.sentence, {**values, "finding": found.name})


def steady_timer(node: Node, period: float, callback: Callable[[], None]) -> None:
    """Call a function every ``period`` [s] by the steady clock, whatever the clock of the node."""
    node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


_TICK, _TICKS = 0.2, 5
"""Time [s] between two looks at the stream, and number of looks in the period of reports."""


class Diagnostics:
    """Publishes the findings of all ``concerns`` (one function per name) every second.

    ``stream`` returns the findings on the node's stream. Each new one is logged once, and published
    at once. With ``use_sim_time`` the node's clock may stop, and then the diagnostics are needed
    most.
    """

    def __init__(
        self,
        node: Node,
        concerns: Mapping[str, Callable[[], Finding]],
        stream: Callable[[], Iterable[findings.Finding]] = tuple,
    ) -> None:
        self._node = node
        self._concerns = dict(concerns)
        self._stream = stream
        self._new = NewFindings()
        self._ticks = 0
        self.publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        steady_timer(node, _TICK, self._look)

    def _look(self) -> None:
        self._ticks += 1
        new = self._new.of(self._stream(), time.monotonic())
        for found in new:
            if found.severity is not findings.NOTE:
                self._node.get_logger().warning(found.sentence)
        if new or self._ticks >= _TICKS:
            self.publish()

    def publish(self) -> None:
        """Publish the present findings."""
        self._ticks = 0
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
