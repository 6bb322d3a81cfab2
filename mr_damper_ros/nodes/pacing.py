"""Sends recorded or generated data at their rate, or as fast as the subscribers can receive.

At a given rate, messages are sent when they are due on the steady clock. All due times are relative
to one start time, so that errors do not accumulate. After a delay of up to a quarter of a second
the sender catches up by sending all overdue messages at once. After a longer delay, for example if
the process was stopped, it shifts the due times instead of sending a burst.

At full speed, a sender must not overrun its subscribers. DDS acknowledges a message when it arrives
in the subscriber's queue, not when it is taken from the queue. A subscriber that keeps *all*
messages (:func:`mr_damper_ros.nodes.quality.lossless`) stops acknowledging once its queue is full.
The sender therefore waits for acknowledgement each time its own queue is full, and sends as fast as
the slowest such subscriber receives. A subscriber that keeps only the *last* messages acknowledges
all of them and may lose some; for such subscribers, send at a given rate.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher

from mr_damper_ros.nodes import quality
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.blocks import NANOSECONDS

_QUEUE = 100
"""Number of messages between two waits for acknowledgement, and depth of the publisher. If the
queue is full, the middleware requests acknowledgements at once, otherwise only every three
seconds."""

_PATIENCE = 30.0
"""Time [s] to wait for a subscriber that does not acknowledge, before continuing without it. DDS
takes 20 s to detect a killed process."""

_POLL = 0.05


@dataclass(frozen=True)
class PacingSettings(CheckedSettings):
    """Speed of a sender, and the subscribers that it waits for."""

    rate: float = option(
        1.0,
        "Speed relative to the time of the data: 2.0 is twice as fast. 0.0: as fast as the "
        "subscribers that keep all messages, such as the identifier, can receive; other "
        "subscribers may lose messages.",
        within=(0.0, 1000.0),
    )
    wait_for_subscribers: int = option(
        0,
        "Number of subscribing nodes to wait for before the first message is sent.",
        within=(0, 1000),
    )
    wait_timeout: float = option(
        10.0,
        "Longest time [s] to wait for the subscribers; then sending starts without them.",
        within=(0.0, 86400.0),
    )


class PacedSender:
    """Publishes on these topics in its own thread, so that the node stays responsive.

    Late subscribers also receive the last message of ``latched`` topics. ``state`` and ``failure``
    describe the activity and the fault in words. If it is ``stopped``, the sending is to end.
    """

    def __init__(
        self,
        node: Node,
        settings: PacingSettings,
        topics: Mapping[str, type],
        *,
        latched: Collection[str] = (),
        paused: bool = False,
    ) -> None:
        self._node = node
        self._settings, self._rate = settings, settings.rate
        self.paused, self.stopped = paused, False
        self.left_out_ns = 0
        """Total shift of the due times since the start, in the time of the data."""
        self.state = self.failure = ""
        self._steps = 0
        self._anchor: tuple[int, int] | None = None
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self.publishers: dict[str, Publisher] = {}
        self._unacknowledged = 0
        for topic, kind in topics.items():
            profile = quality.latched() if topic in latched else quality.stream()
            if self._rate == 0.0 and topic not in latched:
                profile = quality.stream(_QUEUE)
            self.publishers[topic] = quality.publisher(node, kind, topic, profile)

    # --- the thread -----------------------------------------------------------------------------

    def start(self, send: Callable[[], None]) -> None:
        """Call ``send`` once enough nodes subscribe, or after the timeout."""
        self.stopped, self._steps, self._anchor, self.left_out_ns = False, 0, None, 0
        self.failure = ""
        self._thread = threading.Thread(target=self._run, args=(send,), name="sending", daemon=True)
        self._thread.start()

    @property
    def active(self) -> bool:
        """Whether the sender has been started, and not stopped since."""
        return self._thread is not None

    @property
    def finished(self) -> bool:
        """Whether there is nothing more to send."""
        return self._thread is None or not self._thread.is_alive()

    def stop(self) -> None:
        """End the sending and wait for the thread."""
        with self._changed:
            self.stopped = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def close(self) -> None:
        """Destroy the publishers."""
        for publisher in self.publishers.values():
            self._node.destroy_publisher(publisher)

    def _run(self, send: Callable[[], None]) -> None:
        self.state = "waiting for subscribers"
        try:
            if self._settings.wait_for_subscribers:
                self._wait_for_subscribers()
            send()
        except Exception as error:  # report any failure of the thread
            self.failure = f"sending failed: {error}"
            self._node.get_logger().error(self.failure)

    # --- pace -----------------------------------------------------------------------------------

    def wait_until(self, data_ns: int, *, is_step: bool = True) -> bool:
        """Wait until a time of the data is due; returns False if the sending is to end.

        While the sender is paused, :meth:`step` lets all calls pass up to and including the next
        one with ``is_step``.
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
                    if -early > NANOSECONDS // 4:
                        self._anchor = (now, data_ns)
                        self.left_out_ns += int(-early * self._rate)
                    return True
                self._changed.wait(early * 1e-9)
            return False

    def begin(self, data_ns: int | None) -> None:
        """Set the present time of the data; None: the time of the next :meth:`wait_until`."""
        with self._changed:
            self._anchor = None if data_ns is None else (time.monotonic_ns(), data_ns)

    def pause(self, *, paused: bool = True) -> None:
        """Pause or continue the sending."""
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
        """Publish a message, or a serialised message."""
        self.publishers[topic].publish(message)
        self._unacknowledged += 1
        if self._rate == 0.0 and self._unacknowledged >= _QUEUE:
            self.wait_for_acknowledgements()

    def wait_for_acknowledgements(self) -> None:
        """Wait until every subscriber has acknowledged all messages, or the sending is to end."""
        self._unacknowledged = 0
        for publisher in self.publishers.values():
            give_up = time.monotonic() + _PATIENCE
            while not self.stopped and not publisher.wait_for_all_acked(Duration(seconds=_POLL)):
                if time.monotonic() > give_up:
                    self._node.get_logger().warning(
                        f"a subscriber of {publisher.topic_name} has not acknowledged anything for "
                        f"{_PATIENCE:g} s: continuing without it"
                    )
                    break

    def _wait_for_subscribers(self) -> None:
        nodes, timeout = self._settings.wait_for_subscribers, self._settings.wait_timeout
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
            # Discovery is complete once the subscribers have not changed for a while.
            if len(names) >= nodes and connected and time.monotonic() - since >= 0.3:
                return
            time.sleep(_POLL)
        if not self.stopped:
            self._node.get_logger().warning(
                f"fewer than {nodes} nodes subscribed within {timeout:g} s: continuing without "
                "the others"
            )
