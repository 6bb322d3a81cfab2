"""Mirrors for people and standard tools: some of the samples and forces, as other messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from mr_damper_msgs.msg import DamperSignals
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import header, set_stamp
from mr_damper_ros.rig.blocks import Decimator
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock, SampleBlock
from mr_damper_ros.tracking.predictor import Prediction

SIGNALS_TOPIC = "damper/signals"


class SignalMirror:
    """Measured and predicted force of the same samples as named numbers, where anybody listens.

    ``rate``: at most so many a second of data; 0 for none. ``current_at`` gives the current [A] at
    a stamp [ns].
    """

    def __init__(
        self, node: Node, rate: float, frame_id: str, current_at: Callable[[int], float]
    ) -> None:
        self._decimator = Decimator(rate)
        self._current_at = current_at
        self._message = DamperSignals(header=Header(frame_id=frame_id))
        self._publisher = quality.publisher(node, DamperSignals, SIGNALS_TOPIC)

    def publish(self, prediction: Prediction, block: SampleBlock) -> None:
        """Publish the samples of a block that are due; only its new ones have a prediction."""
        if not quality.heard(self._publisher):
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


class WrenchMirror:
    """The last sample of valid blocks as wrenches, at most ``rate`` a second of data."""

    def __init__(self, node: Node, rate: float, frame_id: str) -> None:
        self._decimator = Decimator(rate)
        self._frame_id = frame_id
        self._publisher = quality.publisher(node, WrenchStamped, "damper/predicted_wrench")

    def publish(self, prediction: Prediction) -> None:
        """Publish the last sample of a block, where one is due and heard."""
        if not quality.heard(self._publisher):
            return
        period = prediction.period
        last_ns = prediction.start_ns + round((prediction.force.size - 1) * period * NANOSECONDS)
        for _, stamp_ns in self._decimator.due(last_ns, period, 1):
            wrench = Wrench(force=Vector3(x=float(prediction.force[-1])))
            stamped = header(stamp_ns, self._frame_id)
            self._publisher.publish(WrenchStamped(header=stamped, wrench=wrench))


class JointMirror:
    """Samples as joint states, at most ``rate`` a second of data.

    The velocity is the mean since the message before.
    """

    def __init__(self, rate: float, joint: str) -> None:
        self._decimator = Decimator(rate)
        self._joint = joint
        self._last: tuple[int, float] | None = None

    def messages(self, block: RigBlock, *, heard: bool) -> Iterator[JointState]:
        """Those of a block, none where nobody hears them."""
        for k, stamp_ns in self._decimator.due(block.start_ns, block.period, block.sample_count):
            position = float(block.displacement[k])
            if heard and self._last is not None and stamp_ns > self._last[0]:
                elapsed = (stamp_ns - self._last[0]) / NANOSECONDS
                yield JointState(
                    header=header(stamp_ns, self._joint),
                    name=[self._joint],
                    position=[position],
                    velocity=[(position - self._last[1]) / elapsed],
                    effort=[float(block.force[k])],
                )
            self._last = (stamp_ns, position)
