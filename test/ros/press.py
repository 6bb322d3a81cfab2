"""A test machine simulated by the test: it publishes the samples of a recording."""

import math
from typing import Any

from builtin_interfaces.msg import Time
from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from rcl_interfaces.srv import ListParameters
from rclpy.duration import Duration
from std_msgs.msg import Header
from support import Listener

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import current_message, samples_message
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.recording import Recording

BLOCK = 100

_NAMELESS = "_NODE_NAME_UNKNOWN_"
"""Name that rmw gives to a node whose name has not been discovered yet."""


class Press:
    """Publishes for ``listeners`` nodes, which must have subscribed before it starts.

    It waits until each of them answers, because messages for a node that does not spin yet wait
    in one queue per topic, and a test should not depend on which queue is read first.
    """

    def __init__(self, listener: Listener, listeners: int = 1) -> None:
        self.samples = listener.node.create_publisher(MtsSamples, "mts/samples", quality.stream())
        self.current = listener.node.create_publisher(
            SupplyCurrent, "supply/current", quality.stream()
        )
        for publisher in (self.samples, self.current):
            listener.until(
                lambda publisher=publisher: publisher.get_subscription_count() >= listeners,
                f"{listeners} subscribers of {publisher.topic}",
            )
        listener.until(lambda: self._subscribers(listener), "the names of the subscribers")
        for node in self._subscribers(listener):
            listener.call(ListParameters, f"{node}/list_parameters")

    def _subscribers(self, listener: Listener) -> list[str]:
        """Full names of the nodes that subscribe to the samples; empty until all are known."""
        found = listener.node.get_subscriptions_info_by_topic(self.samples.topic_name)
        if any(info.node_name == _NAMELESS for info in found):
            return []
        return [f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in found]

    def run(self, recording: Recording, *, with_current: bool = True) -> list[MtsSamples]:
        """Publish a recording as fast as possible; returns the blocks sent.

        The current goes first: two topics have no common order, and a test should not depend on it.
        """
        blocks = range(0, recording.sample_count, BLOCK)
        if with_current:
            for index in (*blocks, recording.sample_count - 1):
                self.send_current(recording.stamp_ns(index), float(recording.current[index]))
            assert self.current.wait_for_all_acked(Duration(seconds=30))
        sent = [block_message(recording, first) for first in blocks]
        for message in sent:
            self.samples.publish(message)
        return sent

    def send_current(self, stamp_ns: int, current: float) -> None:
        self.current.publish(current_message(stamp_ns, current, "damper"))


def block_message(recording: Recording, first: int, **changes: Any) -> MtsSamples:
    """The block from sample ``first``, with fields of the message changed."""
    part = slice(first, first + BLOCK)
    block = SampleBlock(
        start_ns=recording.stamp_ns(first),
        sequence=first,
        period=recording.period,
        displacement=recording.displacement[part],
        force=recording.force[part],
    )
    message = samples_message(block, "damper")
    for name, value in changes.items():
        setattr(message, name, value)
    return message


BAD_BLOCKS = {
    "not finite": {"force": [math.nan] * BLOCK},
    "the displacement of sample 0": {"displacement": [math.inf] * BLOCK},
    "must be positive": {"period": -1e-3},
    "holds no samples": {"displacement": [], "force": []},
    "the last time that a stamp can hold": {
        "header": Header(stamp=Time(sec=2**31 - 1, nanosec=999_999_999))
    },
    "but 3 forces": {"force": [1.0, 2.0, 3.0]},
}
"""Invalid blocks: the message for each, and its changed fields."""
