"""The least that a node can do with a block: publish its force again as a predicted force.

The scale for the model node's latency: the same messages with the same quality of service, on
rclpy's default executor.
"""

from __future__ import annotations

from collections.abc import Callable

import rclpy
from mr_damper_msgs.msg import MtsSamples, PredictedForce
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

SAMPLES_TOPIC = "relay/samples"
FORCE_TOPIC = "relay/force"
PARAMETER_SET = "relay"
QUALITY = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, depth=1000)


class Relay(Node):
    """Publishes each block's force as it came."""

    def __init__(self) -> None:
        super().__init__("relay")
        self._force = self.create_publisher(PredictedForce, FORCE_TOPIC, QUALITY)
        self.create_subscription(MtsSamples, SAMPLES_TOPIC, self._take, QUALITY)

    def _take(self, message: MtsSamples) -> None:
        self._force.publish(
            PredictedForce(
                header=message.header,
                seq=message.seq,
                period=message.period,
                force=message.force,
                parameter_set=PARAMETER_SET,
                sample_doubts=bytes(len(message.force)),
                valid=True,
            )
        )


def relay_until_signal(made: Callable[[], Node]) -> None:
    """Run such a node until a signal comes."""
    rclpy.init()
    node = made()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    relay_until_signal(Relay)
