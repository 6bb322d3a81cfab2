"""The two input streams of identifier and model: samples of the test machine and supply current."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from mr_damper_ros.data_check import findings
from mr_damper_ros.data_check.findings import Kind
from mr_damper_ros.data_check.stream_watch import StreamWatch, several_publishers
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import WARN, Finding, finding_of
from mr_damper_ros.nodes.messages import sample_block, to_nanoseconds
from mr_damper_ros.nodes.rclpy_internals import waiting_messages
from mr_damper_ros.signals.blocks import SILENCE, BlockError, CurrentError, SampleBlock, joined
from mr_damper_ros.signals.uniform_grid import UniformGrid

SAMPLES_TOPIC = "mts/samples"
CURRENT_TOPIC = "supply/current"

_SAMPLES, _CURRENT = "samples", "current"
"""Channels of the watch."""

T = TypeVar("T")


class MessageError(ValueError):
    """A message cannot be used; the message of the error is a sentence with the reason."""


class Stream(Generic[T]):
    """A subscription that counts its samples and its rejected messages.

    ``read`` converts a message, or rejects it by a BlockError, CurrentError or MessageError;
    ``use`` receives what it returns. ``advice`` is added to the finding if nothing publishes the
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
        self._heard = self._since
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
        """Whether no message has arrived recently."""
        return time.monotonic() - self._heard >= SILENCE

    def take_rate(self) -> float:
        """Samples per second since the last call."""
        now = time.monotonic()
        rate = self._count / max(now - self._since, 1e-9)
        self._count, self._since = 0, now
        return rate

    def take_finding(self) -> findings.Finding | None:
        """What is wrong with the stream since the last call."""
        rejected, self._rejected_since = self._rejected_since, 0
        if rejected:
            reason = self._rejection
            return Kind.UNUSABLE.found(count=rejected, topic=self.topic, reason=reason)
        return self.absence()

    def absence(self) -> findings.Finding | None:
        """Why nothing has arrived recently; None if something has."""
        if not self.silent:
            return None
        if self._node.count_publishers(self.topic) == 0:
            return Kind.NO_PUBLISHER.found(topic=self.topic, advice=self._advice)
        # A reliable subscription receives nothing from publishers that are all best effort.
        profile = self.subscription.qos_profile  # with the overrides by the user
        if profile.reliability == ReliabilityPolicy.RELIABLE and all(
            publisher.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
            for publisher in self._node.get_publishers_info_by_topic(self.topic)
        ):
            return Kind.BEST_EFFORT.found(topic=self.topic)
        return Kind.STOPPED.found(topic=self.topic)


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
        # Both have their own clocks, and all samples are used: only what arrives is judged.
        watch = self._watch = StreamWatch(
            {_SAMPLES: SAMPLES_TOPIC, _CURRENT: CURRENT_TOPIC}, own_clocks=True
        )

        def read_current(message: SupplyCurrent) -> float:
            stamp_ns = to_nanoseconds(message.header.stamp)
            on_current(stamp_ns, message.current)
            self._value = message.current
            watch.arrive(_CURRENT, time.monotonic(), stamp_ns, message.current)
            return self._value

        def use_block(block: SampleBlock) -> None:
            on_block(block)
            now = time.monotonic()
            watch.arrive(_SAMPLES, now, block.start_ns, float(block.force[0]))
            watch.leave(now, block.period, block.displacement, block.force)

        self.samples = Stream(node, MtsSamples, SAMPLES_TOPIC, sample_block, use_block, profile())
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

    def stream_findings(self) -> list[findings.Finding]:
        """What the watch finds in both streams now."""
        return self._watch.findings(time.monotonic())

    def _first(self, *, of_current: bool) -> findings.Finding | None:
        found = (
            each for each in self.stream_findings() if (each.channel == _CURRENT) is of_current
        )
        return next(found, None)

    def samples_finding(self, sequence: UniformGrid) -> Finding:
        """The rate and faults of the samples; ``sequence``: the grid that counts interruptions."""
        rate, found = self.samples.take_rate(), self.samples.take_finding()
        found = found or self._first(of_current=False)
        before, self._interruptions = self._interruptions, sequence.interruptions
        interruptions = self._interruptions - before
        values = {
            "samples/s": f"{rate:.1f}",
            "lost": sequence.lost_samples,
            "bridged": sequence.bridged_samples,
            "repeated": sequence.repeated_samples,
            "interruptions": sequence.interruptions,
            "rejected messages": self.samples.rejected,
        }
        if not found and interruptions > 1:
            publishers = quality.publishing_nodes(self._node, SAMPLES_TOPIC)
            if len(publishers) > 1:
                found = several_publishers(SAMPLES_TOPIC, publishers)
        if not found and interruptions:
            sentence = sequence.last_interruption
            if interruptions > 1:
                sentence += f" ({interruptions} interruptions of the stream since the last report)"
            return Finding(WARN, sentence, values)
        return finding_of(found, f"{rate:.0f} samples/s{_pace(rate, sequence)}", values)

    def current_finding(self) -> Finding:
        """The value and faults of the supply current."""
        rate, found = self._current.take_rate(), self._current.take_finding()
        # With a cause in the network, the watch sees only its effect.
        if found is None or found.kind is Kind.STOPPED:
            found = self._first(of_current=True) or found
        values = {
            "current [A]": self._value,
            "values/s": f"{rate:.1f}",
            "rejected messages": self._current.rejected,
        }
        return finding_of(found, f"{self._value:.3f} A", values)


def _pace(rate: float, sequence: UniformGrid) -> str:
    """A remark if the sample rate does not match the sample period, or an empty string."""
    pace = rate * sequence.last.period if sequence.last else 0.0
    # In a second, the rate is uncertain by up to a block of 0.1 s.
    if abs(pace - 1.0) <= 0.2 or rate == 0.0:
        return ""
    return f", {pace:.2g} times the rate of their period: is this a replay at another rate?"
