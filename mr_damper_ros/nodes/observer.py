"""Listeners to running nodes, for tools, figures and tests; deadlines take the place of sleeps."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from mr_damper_msgs.msg import (
    CurrentCommand,
    DamperParameters,
    FitReport,
    MtsSamples,
    PredictedForce,
    SupplyCurrent,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from mr_damper_ros.data_check.streams import ReceivedBlock, RigRecord
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.command_topic import COMMAND_TOPIC
from mr_damper_ros.nodes.inputs import CURRENT_TOPIC, SAMPLES_TOPIC
from mr_damper_ros.nodes.messages import from_field, to_nanoseconds
from mr_damper_ros.nodes.quality import STREAM_DEPTH
from mr_damper_ros.processes.programs import PATIENCE, RosDomain
from mr_damper_ros.rig.sources.daq_source import SATURATED


class Observer(AbstractContextManager):
    """A node in a separate rclpy context, which stores messages or passes them to a callback.

    Without a ``domain`` it joins the domain of this process.
    """

    def __init__(
        self, name: str = "observer", domain: RosDomain | None = None, namespace: str = ""
    ) -> None:
        quality.use_profile()
        self._context = rclpy.Context()
        with domain.entered() if domain else nullcontext():
            self._context.init()
            self.node = rclpy.create_node(name, namespace=namespace, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def listen(
        self,
        message_type: type,
        topic: str,
        quality: QoSProfile | int = STREAM_DEPTH,
        take: Callable[[Any], None] | None = None,
        *,
        raw: bool = False,
    ) -> list[Any]:
        """Subscribe: each message goes to ``take``, or into the returned list."""
        received: list[Any] = []
        self.node.create_subscription(
            message_type, topic, take or received.append, quality, raw=raw
        )
        return received

    def spin_once(self, timeout: float = 0.1) -> None:
        """Process the next message, if one arrives within ``timeout`` [s]."""
        self._executor.spin_once(timeout_sec=timeout)

    def spin_for(self, duration: float) -> None:
        """Process messages for ``duration`` seconds; Ctrl-C ends it soon also without messages."""
        end = time.monotonic() + duration
        while (left := end - time.monotonic()) > 0.0:
            self.spin_once(min(left, 0.1))

    def until(
        self, condition: Callable[[], Any], what: str, patience: float = PATIENCE, tick: float = 0.1
    ) -> None:
        """Spin until the condition holds; raises TimeoutError after ``patience`` [s]."""
        deadline = time.monotonic() + patience
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{what} did not occur within {patience:g} s")
            self.spin_once(tick)

    def wait_for_publishers(self, topic: str, count: int = 1) -> None:
        """Wait for ``count`` publishers of a topic; after that, their nodes are ready."""
        self.until(
            lambda: self.node.count_publishers(topic) >= count, f"{count} publishers of {topic}"
        )

    def wait_for_subscribers(self, topic: str, count: int = 1) -> None:
        """Wait for ``count`` subscribers of a topic; after that, their nodes are ready."""
        self.until(
            lambda: self.node.count_subscribers(topic) >= count, f"{count} subscribers of {topic}"
        )


def listen_to_identification(
    observer: Observer, take_report: Callable[[Any], None]
) -> tuple[list[Any], list[Any], list[Any]]:
    """Listen to identifier and model; returns the samples, forces and sets as they arrive."""
    observer.listen(FitReport, "damper/fit_report", take=take_report)
    return (
        observer.listen(MtsSamples, "mts/samples"),
        observer.listen(PredictedForce, "damper/predicted_force"),
        observer.listen(DamperParameters, "damper/parameters", quality.latched()),
    )


def record_rig(node: Node, record: RigRecord) -> None:
    """Subscribe a node to the topics of a rig, and store their messages while the node spins."""
    namespace = node.get_namespace().strip("/")
    prefix = f"{namespace}/" if namespace else ""

    def take_samples(message: MtsSamples) -> None:
        displacement, force = from_field(message.displacement), from_field(message.force)
        if not 0 < displacement.size == force.size or not message.period > 0.0:
            record.unusable += 1
            return
        stamp_ns, arrival_ns = to_nanoseconds(message.header.stamp), time.monotonic_ns()
        sequence, period = int(message.seq), float(message.period)
        record.blocks.append(
            ReceivedBlock(stamp_ns, sequence, period, displacement, force, arrival_ns)
        )

    def take_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(prefix) and status.name.endswith(": source"):
                for item in status.values:
                    channel, _, what = item.key.partition(" ")
                    if what == SATURATED and item.value.isdigit():
                        first, _ = record.saturated.get(channel, (int(item.value), 0))
                        record.saturated[channel] = (first, int(item.value))

    def keep_in(currents: list[tuple[int, float]]) -> Callable[[Any], None]:
        return lambda message: currents.append(
            (to_nanoseconds(message.header.stamp), message.current)
        )

    for kind, topic, take in (
        (MtsSamples, SAMPLES_TOPIC, take_samples),
        (SupplyCurrent, CURRENT_TOPIC, keep_in(record.measured)),
        (CurrentCommand, COMMAND_TOPIC, keep_in(record.commanded)),
        (DiagnosticArray, "/diagnostics", take_diagnostics),
    ):
        node.create_subscription(kind, topic, take, quality.lossless())
