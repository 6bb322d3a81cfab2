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
from collections.abc import Callable, Iterable

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


class Pacer:
    """Holds up a sending thread until the data's time has come; other threads steer it.

    ``rate`` is the speed relative to the data's time; 0 means not to wait at all.
    """

    def __init__(self, rate: float, *, paused: bool = False) -> None:
        self._rate = rate
        self.paused = paused
        """Whether the sending is held up."""
        self.stopped = False
        """Whether the sending is to end."""
        self._steps = 0
        self._anchor: tuple[int, int] | None = None
        self._changed = threading.Condition()
        self.left_out_ns = 0
        """Of the data's time, since the start: so much later it is now than its stamps say."""

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

    def restart(self) -> None:
        """Count the due times anew from the next message: its time is not that of the last one."""
        with self._changed:
            self._anchor = None

    def begin(self, data_ns: int) -> None:
        """Let the data's time be this now."""
        with self._changed:
            self._anchor = (time.monotonic_ns(), data_ns)

    def pause(self) -> None:
        """Hold up the sending."""
        self._steer(paused=True)

    def resume(self) -> None:
        """Let the sending go on."""
        self._steer(paused=False)

    def step(self) -> None:
        """Let one message pass while paused."""
        with self._changed:
            self._steps += 1
            self._changed.notify_all()

    def start(self) -> None:
        """Begin a new sending."""
        with self._changed:
            self.stopped = False
            self._steps = 0
            self._anchor = None
            self.left_out_ns = 0

    def stop(self) -> None:
        """End the sending."""
        with self._changed:
            self.stopped = True
            self._changed.notify_all()

    def _steer(self, *, paused: bool) -> None:
        with self._changed:
            self.paused = paused
            self._steps = 0
            self._changed.notify_all()


class Outlet:
    """A publisher that, as fast as possible, goes no faster than its subscribers acknowledge."""

    def __init__(
        self,
        node: Node,
        message_type: type,
        topic: str,
        pacer: Pacer,
        *,
        unpaced: bool,
        latched: bool = False,
    ) -> None:
        self._pacer = pacer
        self._logger = node.get_logger()
        self._waits = unpaced and not latched
        self._unacknowledged = 0
        profile = quality.stream(_QUEUE) if self._waits else quality.stream()
        self.publisher: Publisher = quality.publisher(
            node, message_type, topic, quality.latched() if latched else profile
        )

    def publish(self, message: object) -> None:
        """Publish a message, or the bytes of one."""
        self.publisher.publish(message)
        if self._waits:
            self._unacknowledged += 1
            if self._unacknowledged >= _QUEUE:
                self.wait_for_acknowledgement()

    def wait_for_acknowledgement(self) -> None:
        """Wait until every subscriber has all messages, or the sending is to end."""
        self._unacknowledged = 0
        give_up = time.monotonic() + _PATIENCE
        while not self._pacer.stopped:
            if self.publisher.wait_for_all_acked(Duration(seconds=_POLL)):
                return
            if time.monotonic() > give_up:
                self._logger.warning(
                    f"a subscriber of {self.publisher.topic_name} has not acknowledged anything "
                    f"for {_PATIENCE:g} s: going on without it"
                )
                return


def wait_for_subscribers(
    node: Node, outlets: Iterable[Outlet], nodes: int, timeout: float, pacer: Pacer
) -> None:
    """Wait until that many nodes subscribe and are connected, or the sending is to end.

    Where they do not come within the ``timeout`` [s], a warning says so.
    """
    if nodes == 0:
        return
    publishers = [outlet.publisher for outlet in outlets]
    give_up = time.monotonic() + timeout
    seen: object = None
    since = time.monotonic()
    while not pacer.stopped and time.monotonic() < give_up:
        present = [_subscribers(node, publisher) for publisher in publishers]
        if present != seen:
            seen, since = present, time.monotonic()
        names = {name for subscribers in present for name in subscribers}
        connected = all(
            publisher.get_subscription_count() >= len(subscribers)
            for publisher, subscribers in zip(publishers, present, strict=True)
        )
        if len(names) >= nodes and connected and time.monotonic() - since >= _SETTLE:
            return
        time.sleep(_POLL)
    if not pacer.stopped:
        node.get_logger().warning(
            f"fewer than {nodes} nodes subscribed within {timeout:g} s: going on with those that "
            "are there"
        )


def _subscribers(node: Node, publisher: Publisher) -> list[str]:
    return sorted(
        f"{info.node_namespace}/{info.node_name}"
        for info in node.get_subscriptions_info_by_topic(publisher.topic_name)
    )


class SendingThread:
    """Runs a sending function in a thread of its own, so that the node goes on answering.

    What goes wrong in it is kept in ``failure``, in words, and logged.
    """

    def __init__(self, node: Node, pacer: Pacer, send: Callable[[], None]) -> None:
        self._logger = node.get_logger()
        self._pacer = pacer
        self._send = send
        self.failure = ""
        self._thread = threading.Thread(target=self._run, name="sending", daemon=True)
        self._thread.start()

    @property
    def finished(self) -> bool:
        """Whether there is nothing more to send."""
        return not self._thread.is_alive()

    def stop(self) -> None:
        """End the sending and wait until it has ended."""
        self._pacer.stop()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._send()
        except Exception as error:  # a thread that dies must not die unheard
            self.failure = f"sending failed: {error}"
            self._logger.error(self.failure)
