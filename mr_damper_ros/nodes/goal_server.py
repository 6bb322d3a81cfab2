"""Action server for long goals, which wait for their results without using the executor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from mr_damper_ros.nodes import quality


class GoalServer:
    """Serves an action of a node.

    ``begin`` receives each accepted goal. ``refusal`` returns the reason to reject a request now,
    or an empty string. ``cancel`` receives a goal that its client cancels.

    A goal stays "accepted" until :meth:`finish`, and is "executing" only while its result is
    delivered. If it waited in a coroutine, the executor would resume the coroutine again and again,
    which takes two thirds of a core.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        name: str,
        *,
        begin: Callable[[ServerGoalHandle], None],
        refusal: Callable[[Any], str],
        cancel: Callable[[ServerGoalHandle], None],
    ) -> None:
        self._results: dict[bytes, tuple[Any, bool]] = {}

        def judge(request: Any) -> GoalResponse:
            reason = refusal(request)
            if reason:
                node.get_logger().warning(
                    f"a goal is rejected: {reason}", throttle_duration_sec=1.0
                )
            return GoalResponse.REJECT if reason else GoalResponse.ACCEPT

        def accept_cancel(goal: ServerGoalHandle) -> CancelResponse:
            cancel(goal)
            return CancelResponse.ACCEPT

        self._server = ActionServer(
            node,
            kind,
            name,
            self._hand_over,
            handle_accepted_callback=begin,
            goal_callback=judge,
            cancel_callback=accept_cancel,
            goal_service_qos_profile=quality.lossless(),
            result_service_qos_profile=quality.lossless(),
            cancel_service_qos_profile=quality.lossless(),
        )

    def finish(self, goal: ServerGoalHandle, result: Any, *, succeeded: bool) -> None:
        """Deliver the result of a goal to its client, as a success or not."""
        self._results[bytes(goal.goal_id.uuid)] = result, succeeded
        goal.execute()

    def _hand_over(self, goal: ServerGoalHandle) -> Any:
        """End a goal; the action server calls this once the result is available."""
        result, succeeded = self._results.pop(bytes(goal.goal_id.uuid))
        if goal.is_cancel_requested:
            goal.canceled()
        elif succeeded:
            goal.succeed()
        else:
            goal.abort()
        return result
