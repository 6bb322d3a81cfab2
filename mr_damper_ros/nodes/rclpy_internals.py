"""All that touches private parts of rclpy: here it may break with another version of it."""

from __future__ import annotations

from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.subscription import Subscription

from mr_damper_ros.nodes.quality import STREAM_DEPTH

RCLError = rclpy_implementation.RCLError
"""What the middleware raises."""


def given_parameters(node: Node) -> dict[str, Any]:
    """Values of parameters from the command line and from files, declared or not, by name."""
    return {name: parameter.value for name, parameter in node._parameter_overrides.items()}


def waiting_messages(subscription: Subscription) -> list[Any]:
    """The messages that wait in a subscription's queue, not more than it can hold.

    The executor finds nothing later on, which is usual for it.
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
    """Have a managed node refuse the transitions that its state does not allow.

    rclpy raises out of the executor there, and the node would be gone: a manager may well ask a
    node to deactivate that has just lost its device and is inactive.
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
            node.get_logger().warning(f"no transition {asked} from the state {state}: it stays so")
            response.success = False
            return response

    service.callback = change_if_allowed
