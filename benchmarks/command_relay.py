"""The least that a node can do for a command: one for every block, of no current.

The scale for the controller's latency: the same messages with the same quality of service, on
rclpy's default executor.
"""

from __future__ import annotations

from mr_damper_msgs.msg import CurrentCommand, MtsSamples
from rclpy.node import Node

from benchmarks.relay import QUALITY, SAMPLES_TOPIC, relay_until_signal

COMMAND_TOPIC = "relay/current_command"


class CommandRelay(Node):
    """Publishes a command with each block's header."""

    def __init__(self) -> None:
        super().__init__("command_relay")
        self._command = self.create_publisher(CurrentCommand, COMMAND_TOPIC, QUALITY)
        self.create_subscription(MtsSamples, SAMPLES_TOPIC, self._take, QUALITY)

    def _take(self, message: MtsSamples) -> None:
        self._command.publish(CurrentCommand(header=message.header, current=0.0))


if __name__ == "__main__":
    relay_until_signal(CommandRelay)
