"""Measured and predicted force of the same samples as named numbers, for people and their tools."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from mr_damper_msgs.msg import DamperSignals
from rclpy.node import Node
from std_msgs.msg import Header

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import set_stamp
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.tracking.prediction import Prediction

SIGNALS_TOPIC = "damper/signals"


class SignalMirror:
    """Publishes some samples of each block with what was predicted for them, where anybody listens.

    ``rate``: at most so many a second of data; 0 for none. ``current_at`` gives the current [A] at
    a stamp [ns].
    """

    def __init__(
        self, node: Node, rate: float, frame_id: str, current_at: Callable[[int], float]
    ) -> None:
        self._interval_ns = round(NANOSECONDS / rate) if rate else 0
        self._current_at = current_at
        self._due_ns: int | None = None
        self._message = DamperSignals(header=Header(frame_id=frame_id))
        self._publisher = quality.publisher(node, DamperSignals, SIGNALS_TOPIC)

    def restart(self) -> None:
        """Take note that the stamps may have fallen back."""
        self._due_ns = None

    def publish(self, prediction: Prediction, block: SampleBlock) -> None:
        """Publish the samples of a block that are due; only its new ones have a prediction."""
        if self._interval_ns == 0 or not quality.heard(self._publisher):
            return
        message = self._message
        displacement, measured = map(prediction.at_its_samples, (block.displacement, block.force))
        for k, stamp_ns in self._due(prediction):
            set_stamp(message.header.stamp, stamp_ns)
            predicted = float(prediction.force[k])
            message.displacement = float(displacement[k])
            message.velocity = float(prediction.velocity[k])
            message.current = self._current_at(stamp_ns)
            message.measured_force = float(measured[k])
            message.predicted_force = predicted
            message.force_error = predicted - message.measured_force
            message.valid = not prediction.doubts[k]
            self._publisher.publish(message)

    def _due(self, prediction: Prediction) -> Iterator[tuple[int, int]]:
        """Indices and stamps of the samples to publish, as far apart as the rate says."""
        period_ns = prediction.period * NANOSECONDS
        begin = prediction.start_ns
        if self._due_ns is None:
            self._due_ns = begin
        # Half a sample: of stamps that are rounded none comes a whole sample late.
        k = max(math.ceil((self._due_ns - begin) / period_ns - 0.5), 0)
        while k < prediction.force.size:
            stamp_ns = begin + round(k * period_ns)
            yield k, stamp_ns
            late = stamp_ns - self._due_ns > self._interval_ns
            self._due_ns = (stamp_ns if late else self._due_ns) + self._interval_ns
            k = max(math.ceil((self._due_ns - begin) / period_ns - 0.5), k + 1)
