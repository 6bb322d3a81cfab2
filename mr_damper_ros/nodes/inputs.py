"""The two input streams of identifier and model: samples of the test machine and supply current."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import OK, WARN, Finding
from mr_damper_ros.nodes.messages import sample_block, to_nanoseconds
from mr_damper_ros.nodes.rclpy_internals import waiting_messages
from mr_damper_ros.signals.blocks import SILENCE, BlockError, CurrentError, SampleBlock, joined
from mr_damper_ros.signals.uniform_grid import UniformGrid

SAMPLES_TOPIC = "mts/samples"
CURRENT_TOPIC = "supply/current"

T = TypeVar("T")


class MessageError(ValueError):
    """A message cannot be used; the message of the error is a sentence with the reason."""


class Stream(Generic[T]):
    """A subscription that counts its samples and its rejected messages.

    ``read`` converts a message, or rejects it by a BlockError, CurrentError or MessageError;
    ``use`` receives what it returns. ``advice`` is added to the fault if nothing publishes the
    topic. ``topic`` is its name in sentences.
    """

    def __init__(
        self,
        node: Node,
        kind: type,
        topic: str,
        read: Callable[[Any], T],
        use: Callable[[T], object],
        profile: QoSProfile,
        advice: str = "is the bridge running in this namespace?",
    ) -> None:
        self._node, self._read, self._use = node, read, use
        self._advice, self.topic = advice, topic
        self._count = self._rejected_since = self.rejected = 0
        self._since = time.monotonic()
        self._heard = -math.inf
        self._rejection = ""
        self.subscription = quality.subscription(node, kind, topic, self.take, profile)

    def take(self, message: Any) -> None:
        """Pass on what a message holds, or count it as rejected."""
        if (found := self.read(message)) is not None:
            self._use(found)

    def read(self, message: Any) -> T | None:
        """Return what a message holds, and count it; None if it is rejected."""
        self._heard = time.monotonic()
        try:
            found = self._read(message)
        except (BlockError, CurrentError, MessageError) as error:
            self.rejected += 1
            self._rejected_since += 1
            self._rejection = str(error)
            self._node.get_logger().warning(
                f"a message on {self.topic} is ignored: {error}", throttle_duration_sec=10.0
            )
            return None
        self._count += found.sample_count if isinstance(found, SampleBlock) else 1
        return found

    @property
    def silent(self) -> bool:
        """Whether no message has arrived recently, or ever."""
        return time.monotonic() - self._heard >= SILENCE

    def take_rate(self) -> float:
        """Samples per second since the last call."""
        now = time.monotonic()
        rate = self._count / max(now - self._since, 1e-9)
        self._count, self._since = 0, now
        return rate

    def take_fault(self) -> str:
        """The fault of the stream since the last call, as a sentence; empty without a fault."""
        rejected, self._rejected_since = self._rejected_since, 0
        if rejected:
            return f"{rejected} messages on {self.topic} could not be used: {self._rejection}"
        if not self.silent:
            return ""
        if self._node.count_publishers(self.topic) == 0:
            return f"nothing publishes {self.topic}: {self._advice}"
        # A reliable subscription receives nothing from publishers that are all best effort.
        profile = self.subscription.qos_profile  # with the overrides by the user
        if profile.reliability == ReliabilityPolicy.RELIABLE and all(
            publisher.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
            for publisher in self._node.get_publishers_info_by_topic(self.topic)
        ):
            return (
                f"{self.topic} is published best effort, which a reliable subscription cannot "
                "receive: set qos_overrides.<topic>.subscription.reliability to best_effort"
            )
        return f"nothing arrives on {self.topic}: has its publisher stopped?"


class Inputs:
    """Subscribes to samples and currents, passes on valid messages, and counts rejected ones."""

    def __init__(
        self,
        node: Node,
        profile: Callable[[], QoSProfile],
        on_block: Callable[[SampleBlock], None],
        on_current: Callable[[int, float], None],
    ) -> None:
        self._node = node
        self._value = math.nan
        self._interruptions = 0

        def read_current(message: SupplyCurrent) -> float:
            on_current(to_nanoseconds(message.header.stamp), message.current)
            self._value = message.current
            return self._value

        self.samples = Stream(node, MtsSamples, SAMPLES_TOPIC, sample_block, on_block, profile())
        self._current = Stream(
            node, SupplyCurrent, CURRENT_TOPIC, read_current, lambda _: None, profile()
        )

    def skip_to_newest(
        self, block: SampleBlock, follow: Callable[[SampleBlock], object]
    ) -> tuple[SampleBlock, int]:
        """Return the newest block in the queue, and the number of blocks skipped for it.

        ``follow`` is called with the skipped samples, joined into as few blocks as possible. Queued
        currents are passed on as usual.
        """
        for message in waiting_messages(self._current.subscription):
            self._current.take(message)
        waiting = map(self.samples.read, waiting_messages(self.samples.subscription))
        *skipped, newest = (block, *(each for each in waiting if each is not None))
        for part in joined(skipped):
            follow(part)
        return newest, len(skipped)

    def samples_finding(self, sequence: UniformGrid) -> Finding:
        """The rate and faults of the samples; ``sequence``: the grid that counts interruptions."""
        rate, fault = self.samples.take_rate(), self.samples.take_fault()
        before, self._interruptions = self._interruptions, sequence.interruptions
        interruptions = self._interruptions - before
        if not fault and interruptions:
            fault = sequence.last_interruption
            if interruptions > 1:
                fault += f" ({interruptions} interruptions of the stream since the last report)"
                publishers = quality.publishing_nodes(self._node, SAMPLES_TOPIC)
                if len(publishers) > 1:
                    names = quality.listed(publishers)
                    fault = f"{SAMPLES_TOPIC} is published by {names}: stop all but one; {fault}"
        return Finding(
            WARN if fault else OK,
            fault or f"{rate:.0f} samples/s{_pace(rate, sequence)}",
            {
                "samples/s": f"{rate:.1f}",
                "lost": sequence.lost_samples,
                "bridged": sequence.bridged_samples,
                "repeated": sequence.repeated_samples,
                "interruptions": sequence.interruptions,
                "rejected messages": self.samples.rejected,
            },
        )

    def current_finding(self) -> Finding:
        """The value and faults of the supply current."""
        rate, fault = self._current.take_rate(), self._current.take_fault()
        return Finding(
            WARN if fault else OK,
            fault or f"{self._value:.3f} A",
            {
                "current [A]": self._value,
                "values/s": f"{rate:.1f}",
                "rejected messages": self._current.rejected,
            },
        )


def _pace(rate: float, sequence: UniformGrid) -> str:
    """A remark if the sample rate does not match the sample period, or an empty string."""
    pace = rate * sequence.last.period if sequence.last else 0.0
    # In a second, the rate is uncertain by up to a block of 0.1 s.
    if abs(pace - 1.0) <= 0.2 or rate == 0.0:
        return ""
    return f", {pace:.2g} times the rate of their period: is this a replay at another rate?"
