"""Sends recorded or made-up data at their pace, or as fast as every subscriber can take them.

At a pace, messages go out when their time has come on the steady clock. The due times are counted
from one anchor, so that nothing drifts. Being late by up to a quarter of a second is made good by
sending what is due at once; what is more (the process was stopped, the machine slept) is left
out, and the stream goes on later instead of in a burst.

As fast as possible, a sender must not overrun its subscribers. The only word that DDS gives back
is the acknowledgement, and it means "arrived in the subscriber's queue", not "taken from it".
A subscriber that keeps *all* messages (:func:`mr_damper_ros.nodes.quality.lossless`) stops
acknowledging once its queue is full. So the sender waits for acknowledgement each time its own
queue is full, and is then held up by the slowest such subscriber; of a subscriber that keeps only
the *last* messages it cannot know how far it is, and that one may lose some: play to it at a rate.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher

from mr_damper_ros.nodes import quality

_FORGIVEN_NS = 250_000_000
"""Lateness that is made good; see above."""

_QUEUE = 100
"""Messages between two waits. It is the depth of the publisher too: with a full queue the
middleware asks for acknowledgements at once, otherwise only every three seconds."""

_PATIENCE = 30.0
"""Seconds to wait for a subscriber that acknowledges nothing before going on without it. DDS
itself takes 20 s to find out that a process was killed."""

_SETTLE = 0.3
"""Seconds for which the subscribers must have been the same, so that all their topics are there."""

_POLL = 0.05


class PacedSender:
    """Publishes on these topics in a thread of its own, so that the node goes on answering.

    ``rate`` is the speed relative to the data's time; 0: as fast as subscribers acknowledge.
    Topics of ``latched`` keep their last message. ``state`` and ``failure`` say in words what it
    does, and what went wrong.
    """

    def __init__(
        self,
        node: Node,
        rate: float,
        topics: Mapping[str, type],
        *,
        latched: Collection[str] = (),
        paused: bool = False,
    ) -> None:
        self._node = node
        self._rate = rate
        self.paused = paused
        """Whether the sending is held up."""
        self.stopped = False
        """Whether the sending is to end."""
        self.left_out_ns = 0
        """Of the data's time, since the start: so much later it is now than its stamps say."""
        self.state = self.failure = ""
        self._steps = 0
        self._anchor: tuple[int, int] | None = None
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self.publishers: dict[str, Publisher] = {}
        self._unacknowledged: dict[str, int] = {}
        for topic, kind in topics.items():
            profile = quality.latched() if topic in latched else quality.stream()
            if rate == 0.0 and topic not in latched:
                profile = quality.stream(_QUEUE)
                self._unacknowledged[topic] = 0
            self.publishers[topic] = quality.publisher(node, kind, topic, profile)

    # --- the thread -----------------------------------------------------------------------------

    def start(self, send: Callable[[], None], nodes: int, timeout: float) -> None:
        """Call ``send`` once so many nodes subscribe, or a ``timeout`` [s] is over."""
        self.stopped, self._steps, self._anchor, self.left_out_ns = False, 0, None, 0
        self.failure = ""
        self._thread = threading.Thread(
            target=self._run, args=(send, nodes, timeout), name="sending", daemon=True
        )
        self._thread.start()

    @property
    def active(self) -> bool:
        """Whether it was started, and has not been stopped since."""
        return self._thread is not None

    @property
    def finished(self) -> bool:
        """Whether there is nothing more to send."""
        return self._thread is None or not self._thread.is_alive()

    def stop(self) -> None:
        """End the sending and wait until it has ended."""
        with self._changed:
            self.stopped = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def close(self) -> None:
        """Withdraw the topics."""
        for publisher in self.publishers.values():
            self._node.destroy_publisher(publisher)

    def _run(self, send: Callable[[], None], nodes: int, timeout: float) -> None:
        self.state = "waits for subscribers"
        try:
            if nodes:
                self._wait_for_subscribers(nodes, timeout)
            send()
        except Exception as error:  # a thread that dies must not die unheard
            self.failure = f"sending failed: {error}"
            self._node.get_logger().error(self.failure)

    # --- pace -----------------------------------------------------------------------------------

    def wait_until(self, data_ns: int, *, is_step: bool = True) -> bool:
        """Wait for the data's time; returns False where the sending is to end.

        While paused, one step lets everything pass up to the first that ``is_step``.
        """
        with self._changed:
            while not self.stopped:
                if self.paused:
                    self._anchor = None
                    if self._steps > 0:
                        self._steps -= int(is_step)
                        return True
                    self._changed.wait()
                    continue
                if self._rate == 0.0:
                    return True
                now = time.monotonic_ns()
                if self._anchor is None:
                    self._anchor = (now, data_ns)
                start, origin = self._anchor
                early = start + int((data_ns - origin) / self._rate) - now
                if early <= 0:
                    if -early > _FORGIVEN_NS:
                        self._anchor = (now, data_ns)
                        self.left_out_ns += int(-early * self._rate)
                    return True
                self._changed.wait(early * 1e-9)
            return False

    def begin(self, data_ns: int | None) -> None:
        """Let the data's time be this now; None: the one that is waited for next."""
        with self._changed:
            self._anchor = None if data_ns is None else (time.monotonic_ns(), data_ns)

    def pause(self, *, paused: bool = True) -> None:
        """Hold up the sending, or let it go on."""
        with self._changed:
            self.paused = paused
            self._steps = 0
            self._changed.notify_all()

    def step(self) -> None:
        """Let one message pass while paused."""
        with self._changed:
            self._steps += 1
            self._changed.notify_all()

    # --- subscribers ----------------------------------------------------------------------------

    def publish(self, topic: str, message: object) -> None:
        """Publish a message, or the bytes of one."""
        self.publishers[topic].publish(message)
        if topic in self._unacknowledged:
            self._unacknowledged[topic] += 1
            if self._unacknowledged[topic] >= _QUEUE:
                self._wait_for_acknowledgement(topic)

    def wait_for_acknowledgements(self) -> None:
        """Wait until every subscriber has all messages, or the sending is to end."""
        for topic in self.publishers:
            self._wait_for_acknowledgement(topic)

    def _wait_for_acknowledgement(self, topic: str) -> None:
        if topic in self._unacknowledged:
            self._unacknowledged[topic] = 0
        publisher = self.publishers[topic]
        give_up = time.monotonic() + _PATIENCE
        while not self.stopped:
            if publisher.wait_for_all_acked(Duration(seconds=_POLL)):
                return
            if time.monotonic() > give_up:
                self._node.get_logger().warning(
                    f"a subscriber of {publisher.topic_name} has not acknowledged anything for "
                    f"{_PATIENCE:g} s: going on without it"
                )
                return

    def _wait_for_subscribers(self, nodes: int, timeout: float) -> None:
        publishers = self.publishers.values()
        seen: object = None
        since = time.monotonic()
        give_up = since + timeout
        while not self.stopped and time.monotonic() < give_up:
            present = [
                {(info.node_namespace, info.node_name, bytes(info.endpoint_gid)) for info in found}
                for found in (
                    self._node.get_subscriptions_info_by_topic(each.topic_name)
                    for each in publishers
                )
            ]
            if present != seen:
                seen, since = present, time.monotonic()
            names = {place[:2] for subscribers in present for place in subscribers}
            connected = all(
                publisher.get_subscription_count() >= len(subscribers)
                for publisher, subscribers in zip(publishers, present, strict=True)
            )
            if len(names) >= nodes and connected and time.monotonic() - since >= _SETTLE:
                return
            time.sleep(_POLL)
        if not self.stopped:
            self._node.get_logger().warning(
                f"fewer than {nodes} nodes subscribed within {timeout:g} s: continuing without "
                "the others"
            )
