"""The stream of the bridge: blocks of a source become messages on topics, each at its time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from rclpy.node import Node
from sensor_msgs.msg import JointState, Temperature

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import (
    SUSPENSION_TOPIC,
    current_message,
    header,
    samples_message,
    suspension_message,
)
from mr_damper_ros.nodes.pacing import Outlet, Pacer, wait_for_subscribers
from mr_damper_ros.rig.blocks import Meter, Reading
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock

_TOPICS = {
    "mts/samples": MtsSamples,
    "supply/current": SupplyCurrent,
    "temperature": Temperature,
    "joint_states": JointState,
    SUSPENSION_TOPIC: JointState,
}

_CURRENT_STEP = 0.005
"""Change [A] of the current that is published at once; smaller ones wait for the next reading."""

_TEMPERATURE_PERIOD = 1.0


@dataclass(frozen=True)
class SubscriberWait:
    """Number of ``nodes`` that must have subscribed first, and how long they are waited for [s]."""

    nodes: int
    timeout: float


class BridgeStream:
    """The topics of the bridge, from its configuration to its clean-up.

    ``current_rate`` and ``mirror_rate`` are messages per second [Hz] of the data's time; without a
    mirror rate there are no joint states, and no motion of a suspension that is not there.
    """

    def __init__(
        self,
        node: Node,
        pacer: Pacer,
        *,
        frame_id: str,
        current_rate: float,
        mirror_rate: float,
        unpaced: bool,
        suspended: bool,
    ) -> None:
        self._node = node
        self._pacer = pacer
        self._frame_id = frame_id
        self._current_period = 1.0 / current_rate
        self._mirror_rate = mirror_rate
        self.sent = 0
        self.state = ""
        self._outlets = {
            topic: Outlet(node, kind, topic, pacer, unpaced=unpaced)
            for topic, kind in _TOPICS.items()
            if (topic != "joint_states" or mirror_rate > 0.0)
            and (topic != SUSPENSION_TOPIC or suspended)
        }

    def close(self) -> None:
        """Withdraw the topics."""
        for outlet in self._outlets.values():
            self._node.destroy_publisher(outlet.publisher)

    def send(self, blocks: Iterator[RigBlock], wait: SubscriberWait, *, live: bool = False) -> None:
        """Publish all blocks, each when its last sample is due, or until the pacer is stopped.

        Those of a ``live`` source go out as they come, with their stamps. Others are stamped anew:
        the first sample is taken when all is ready to send it, and where sending was held up for
        longer than can be made good, the stamps pause, too.
        """
        self.sent = 0
        self._wait_for(wait)
        self.state = "streams"
        supply = Meter(self._current_period, step=_CURRENT_STEP)
        thermometer = Meter(_TEMPERATURE_PERIOD)
        mirror = _Mirror(self._mirror_rate, self._frame_id) if self._mirror_rate else None
        block = None
        for block in self._as_they_come(blocks) if live else self._paced(blocks):
            # What belongs to the samples goes first, so that it is known when they arrive.
            for reading in supply.read(block, block.current, block.supply_ahead_ns):
                self._publish_current(reading)
            for reading in thermometer.read(block, block.temperature):
                self._outlets["temperature"].publish(
                    Temperature(
                        header=header(reading.stamp_ns, self._frame_id), temperature=reading.value
                    )
                )
            if block.suspension is not None:
                # A force is wanted by the time the controller of the damper has the samples.
                stamp = header(_last_stamp(block), self._frame_id)
                self._outlets[SUSPENSION_TOPIC].publish(suspension_message(block.suspension, stamp))
            self._outlets["mts/samples"].publish(samples_message(block, self._frame_id))
            if mirror is not None:
                outlet = self._outlets["joint_states"]
                for message in mirror.messages(block, heard=quality.heard(outlet.publisher)):
                    outlet.publish(message)
            self.sent += block.sample_count
        if self._pacer.stopped:
            return
        if block is not None and not math.isnan(block.current[-1]):
            # The current is now known up to the last sample.
            self._publish_current(Reading(_last_stamp(block), float(block.current[-1])))
        for outlet in self._outlets.values():
            outlet.wait_for_acknowledgement()
        self.state = "the recording is at its end: nothing more comes"
        self._node.get_logger().info(f"end of the recording: {self.sent} samples were sent")

    def _as_they_come(self, blocks: Iterator[RigBlock]) -> Iterator[RigBlock]:
        for block in blocks:
            if self._pacer.stopped:
                return
            if block.sample_count:
                yield block

    def _paced(self, blocks: Iterator[RigBlock]) -> Iterator[RigBlock]:
        later_ns: int | None = None
        for made in blocks:
            if later_ns is None and made.sample_count > 0:
                # Its first sample is taken now, and it goes out with its last.
                first_ns = made.due_ns - (made.stamp_ns(made.sample_count - 1) - made.start_ns)
                later_ns = self._node.get_clock().now().nanoseconds - first_ns
                self._pacer.begin(first_ns)
            if self._pacer.stopped or not self._pacer.wait_until(made.due_ns):
                return
            if made.sample_count and later_ns is not None:
                yield replace(made, start_ns=made.start_ns + later_ns + self._pacer.left_out_ns)

    def _wait_for(self, wait: SubscriberWait) -> None:
        self.state = "waits for subscribers"
        publishers = [outlet.publisher for outlet in self._outlets.values()]
        if wait.nodes > 0 and not wait_for_subscribers(
            self._node, publishers, wait.nodes, wait.timeout, self._pacer
        ):
            self._node.get_logger().warning(
                f"fewer than {wait.nodes} nodes subscribed within {wait.timeout:g} s: streaming to "
                "those that are there"
            )

    def _publish_current(self, reading: Reading) -> None:
        self._outlets["supply/current"].publish(
            current_message(reading.stamp_ns, reading.value, self._frame_id)
        )


class _Mirror:
    """The samples as joint states, thinned out; velocity is the mean since the one before."""

    def __init__(self, rate: float, joint: str) -> None:
        self._rate = rate
        self._joint = joint
        self._last: tuple[int, float] | None = None

    def messages(self, block: RigBlock, *, heard: bool) -> Iterator[JointState]:
        """Those of a block, none where nobody hears them."""
        every = max(round(1.0 / (self._rate * block.period)), 1)
        for index in range(-block.sequence % every, block.force.size, every):
            stamp_ns = block.stamp_ns(index)
            position = float(block.displacement[index])
            if heard and self._last is not None:
                elapsed = (stamp_ns - self._last[0]) / NANOSECONDS
                yield JointState(
                    header=header(stamp_ns, self._joint),
                    name=[self._joint],
                    position=[position],
                    velocity=[(position - self._last[1]) / elapsed],
                    effort=[float(block.force[index])],
                )
            self._last = (stamp_ns, position)


def _last_stamp(block: RigBlock) -> int:
    return block.stamp_ns(block.sample_count - 1)
