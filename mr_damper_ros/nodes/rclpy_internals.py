"""All access to private parts of rclpy, so that another version can break only this module."""

from __future__ import annotations

import time
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.subscription import Subscription

from mr_damper_ros.nodes.quality import STREAM_DEPTH

RCLError = rclpy_implementation.RCLError
"""The exceptions of the middleware."""


def given_parameters(node: Node) -> dict[str, Any]:
    """Values of parameters from the command line and from files, declared or not, by name."""
    return {name: parameter.value for name, parameter in node._parameter_overrides.items()}


class NodeClock:
    """The time of a node: simulated time, or a clock that is never set after the start."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._ahead_ns = time.time_ns() - time.monotonic_ns()

    @property
    def is_simulated(self) -> bool:
        """Whether the node's time comes from the clock topic."""
        return bool(self._node._time_source.ros_time_is_active)

    def now_ns(self) -> int:
        """The present time [ns]."""
        if self.is_simulated:
            return int(self._node.get_clock().now().nanoseconds)
        return time.monotonic_ns() + self._ahead_ns


def now_ns(node: Node) -> int:
    """Time [ns] by the node's clock.

    Without simulated time it is the system time, which rclpy takes ten times as long to give.
    """
    if node._time_source.ros_time_is_active:
        return int(node.get_clock().now().nanoseconds)
    return time.time_ns()


def waiting_messages(subscription: Subscription) -> list[Any]:
    """Take the waiting messages of a subscription, at most as many as a stream's queue holds.

    The executor tolerates that it then finds an empty queue.
    """
    messages: list[Any] = []
    with subscription.handle:
        while len(messages) < STREAM_DEPTH:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                break
            messages.append(taken[0])
    return messages


def refuse_wrong_transitions(node: LifecycleNode) -> None:
    """Make a managed node reject the transitions that its state does not allow.

    By default rclpy raises an exception in the executor, which ends the node. Such requests are
    normal: a manager may deactivate a node that has just lost its device and is already inactive.
    """
    service = node._service_change_state
    change = service.callback

    def change_if_allowed(
        request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        try:
            return change(request, response)
        except RCLError:
            state = node._state_machine.current_state[1]
            asked = request.transition.label or f"number {request.transition.id}"
            node.get_logger().warning(f"transition {asked} is not possible in the state {state}")
            response.success = False
            return response

    service.callback = change_if_allowed
