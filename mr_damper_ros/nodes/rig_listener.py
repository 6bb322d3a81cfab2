"""Listens to the signals of a rig, whatever they hold, for whoever judges them."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray
from mr_damper_msgs.msg import CurrentCommand, MtsSamples, SupplyCurrent
from rclpy.node import Node

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.current_commands import COMMAND_TOPIC
from mr_damper_ros.nodes.inputs import CURRENT_TOPIC, SAMPLES_TOPIC
from mr_damper_ros.nodes.messages import from_field, to_nanoseconds
from mr_damper_ros.rig.sources.daq_source import SATURATED
from mr_damper_ros.rig_check.record import HeardBlock, RigRecord


def record_rig(node: Node, record: RigRecord) -> None:
    """Put all that comes from now on into a record, while the node is spun."""
    namespace = node.get_namespace().strip("/")
    prefix = f"{namespace}/" if namespace else ""

    def take_samples(message: MtsSamples) -> None:
        displacement, force = from_field(message.displacement), from_field(message.force)
        if not 0 < displacement.size == force.size or not message.period > 0.0:
            record.unusable += 1
            return
        record.blocks.append(
            HeardBlock(
                to_nanoseconds(message.header.stamp),
                int(message.seq),
                float(message.period),
                displacement,
                force,
                time.monotonic_ns(),
            )
        )

    def take_current(message: SupplyCurrent) -> None:
        record.measured.append((to_nanoseconds(message.header.stamp), message.current))

    def take_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(prefix) and status.name.endswith(": source"):
                for item in status.values:
                    channel, _, what = item.key.partition(" ")
                    if what == SATURATED and item.value.isdigit():
                        first, _ = record.saturated.get(channel, (int(item.value), 0))
                        record.saturated[channel] = (first, int(item.value))

    def take_command(message: CurrentCommand) -> None:
        record.commanded.append((to_nanoseconds(message.header.stamp), message.current))

    for kind, topic, take in (
        (MtsSamples, SAMPLES_TOPIC, take_samples),
        (SupplyCurrent, CURRENT_TOPIC, take_current),
        (CurrentCommand, COMMAND_TOPIC, take_command),
        (DiagnosticArray, "/diagnostics", take_diagnostics),
    ):
        node.create_subscription(kind, topic, take, quality.lossless())
