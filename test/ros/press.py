"""A test machine played by the test itself: it publishes the samples of a recording."""

from __future__ import annotations

import math
from typing import Any

from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from support import Listener

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import current_message, samples_message
from mr_damper_ros.rig.recording import Recording
from mr_damper_ros.streaming.blocks import SampleBlock

BLOCK = 100


class Press:
    """Publishes for ``listeners`` nodes, which must have subscribed before it starts."""

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

    def run(self, recording: Recording, *, with_current: bool = True) -> list[MtsSamples]:
        """Publish a recording as fast as possible; returns the blocks sent."""
        sent = []
        for first in range(0, recording.sample_count, BLOCK):
            message = block_message(recording, first)
            if with_current:
                self.send_current(recording.stamp_ns(first), float(recording.current[first]))
            self.samples.publish(message)
            sent.append(message)
        if with_current:
            last = recording.sample_count - 1
            self.send_current(recording.stamp_ns(last), float(recording.current[last]))
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
    "but 3 forces": {"force": [1.0, 2.0, 3.0]},
}
"""Blocks that cannot be used: what is said about them, and what is wrong with them."""
