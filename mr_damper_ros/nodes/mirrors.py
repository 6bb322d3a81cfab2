"""Copies of samples and forces, subsampled or joined, as messages for standard tools."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator

import numpy as np
from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from mr_damper_msgs.msg import DamperSignals, MtsSamples, PredictedForce
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import header, set_stamp, to_field
from mr_damper_ros.rig.blocks import Decimator
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock, SampleBlock
from mr_damper_ros.tracking.predictor import Prediction

SIGNALS_TOPIC = "damper/signals"


class SignalMirror:
    """Publishes measured and predicted force of the same samples, if there are subscribers.

    ``rate`` is the largest number of samples per second of data; with 0 nothing is published.
    ``current_at`` returns the current [A] at a stamp [ns].
    """

    def __init__(
        self, node: Node, rate: float, frame_id: str, current_at: Callable[[int], float]
    ) -> None:
        self._decimator = Decimator(rate)
        self._current_at = current_at
        self._message = DamperSignals(header=Header(frame_id=frame_id))
        self._publisher = quality.publisher(node, DamperSignals, SIGNALS_TOPIC)

    def publish(self, prediction: Prediction, block: SampleBlock) -> None:
        """Publish the samples of a block that are due; only samples with a prediction are used."""
        if not quality.has_subscribers(self._publisher):
            return
        message = self._message
        displacement, measured = map(prediction.at_its_samples, (block.displacement, block.force))
        for k, stamp_ns in self._decimator.due(
            prediction.start_ns, prediction.period, prediction.force.size
        ):
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


JOINED_SAMPLES_TOPIC, JOINED_FORCES_TOPIC = "damper/joined_samples", "damper/joined_forces"

_JOINED = 0.1
"""Duration [s] of a joined block."""


class JoinedMirror:
    """Publishes all samples and their predicted force in larger blocks, if there are subscribers.

    The cost of a message hardly depends on its number of samples. Every 0.1 s of data gives two
    messages with the same sequence number and stamp.
    """

    def __init__(self, node: Node, frame_id: str) -> None:
        self._frame_id = frame_id
        self._samples = quality.publisher(node, MtsSamples, JOINED_SAMPLES_TOPIC)
        self._forces = quality.publisher(node, PredictedForce, JOINED_FORCES_TOPIC)
        self._first: Prediction | None = None
        self._parts: list[tuple[np.ndarray, ...]] = []

    def publish(self, prediction: Prediction, block: SampleBlock) -> None:
        """Add a block; publish when the joined block is complete, or before a numbering gap."""
        if not quality.has_subscribers(self._samples):
            self._first, self._parts = None, []
            return
        count = sum(part[0].size for part in self._parts)
        if self._first is not None and prediction.sequence != self._first.sequence + count:
            self._send(self._first)
            count = 0
        self._first = self._first or prediction
        displacement, force = map(prediction.at_its_samples, (block.displacement, block.force))
        self._parts.append((displacement, force, prediction.force, prediction.doubts))
        if (count + prediction.force.size) * prediction.period >= _JOINED:
            self._send(self._first)

    def _send(self, first: Prediction) -> None:
        joined = map(np.concatenate, zip(*self._parts, strict=True))
        displacement, measured, predicted, doubts = joined
        self._first, self._parts = None, []
        stamped = header(first.start_ns, self._frame_id)
        self._samples.publish(
            MtsSamples(
                header=stamped,
                seq=first.sequence,
                period=first.period,
                displacement=to_field(displacement),
                force=to_field(measured),
            )
        )
        self._forces.publish(
            PredictedForce(
                header=stamped,
                seq=first.sequence,
                period=first.period,
                force=to_field(predicted),
                sample_doubts=array("B", doubts.astype(np.uint8).tobytes()),
            )
        )


class WrenchMirror:
    """Publishes the last force of valid blocks as a wrench, at most ``rate`` per second of data."""

    def __init__(self, node: Node, rate: float, frame_id: str) -> None:
        self._decimator = Decimator(rate)
        self._frame_id = frame_id
        self._publisher = quality.publisher(node, WrenchStamped, "damper/predicted_wrench")

    def publish(self, prediction: Prediction) -> None:
        """Publish the last sample of a block, if it is due and there are subscribers."""
        if not quality.has_subscribers(self._publisher):
            return
        period = prediction.period
        last_ns = prediction.start_ns + round((prediction.force.size - 1) * period * NANOSECONDS)
        for _, stamp_ns in self._decimator.due(last_ns, period, 1):
            wrench = Wrench(force=Vector3(x=float(prediction.force[-1])))
            stamped = header(stamp_ns, self._frame_id)
            self._publisher.publish(WrenchStamped(header=stamped, wrench=wrench))


class JointMirror:
    """Converts samples to joint states, at most ``rate`` per second of data.

    The velocity is the mean since the previous message.
    """

    def __init__(self, rate: float, joint: str) -> None:
        self._decimator = Decimator(rate)
        self._joint = joint
        self._last: tuple[int, float] | None = None

    def messages(self, block: RigBlock, *, subscribed: bool) -> Iterator[JointState]:
        """Yield the messages of a block; none without subscribers (``subscribed`` is false)."""
        for k, stamp_ns in self._decimator.due(block.start_ns, block.period, block.sample_count):
            position = float(block.displacement[k])
            if subscribed and self._last is not None and stamp_ns > self._last[0]:
                elapsed = (stamp_ns - self._last[0]) / NANOSECONDS
                yield JointState(
                    header=header(stamp_ns, self._joint),
                    name=[self._joint],
                    position=[position],
                    velocity=[(position - self._last[1]) / elapsed],
                    effort=[float(block.force[k])],
                )
            self._last = (stamp_ns, position)
