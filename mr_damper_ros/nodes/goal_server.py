"""An action server whose goals take long: each waits for its result without the executor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from mr_damper_ros.nodes import quality


class GoalServer:
    """Serves an action of a node.

    ``begin`` is given a goal that is accepted; ``refusal`` says why a request cannot be one now,
    empty where it can; ``cancel`` is told of a goal that its client wants no longer; ``succeeded``
    judges a result.

    A goal is "accepted" until :meth:`finish` and "executing" only while its result is handed over:
    a coroutine that waits would be resumed by the executor again and again, which takes two thirds
    of a core.
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
        succeeded: Callable[[Any], bool],
    ) -> None:
        self._logger = node.get_logger()
        self._refusal = refusal
        self._cancelled = cancel
        self._succeeded = succeeded
        self._results: dict[bytes, Any] = {}
        self._server = ActionServer(
            node,
            kind,
            name,
            self._hand_over,
            handle_accepted_callback=begin,
            goal_callback=self._judge,
            cancel_callback=self._cancel,
            goal_service_qos_profile=quality.bursts(),
            result_service_qos_profile=quality.bursts(),
            cancel_service_qos_profile=quality.bursts(),
        )

    def finish(self, goal: ServerGoalHandle, result: Any) -> None:
        """Give whoever sent the goal its result."""
        self._results[bytes(goal.goal_id.uuid)] = result
        goal.execute()

    def _judge(self, request: Any) -> GoalResponse:
        refusal = self._refusal(request)
        if not refusal:
            return GoalResponse.ACCEPT
        self._logger.warning(f"a goal is refused: {refusal}", throttle_duration_sec=1.0)
        return GoalResponse.REJECT

    def _hand_over(self, goal: ServerGoalHandle) -> Any:
        """End a goal, called by the action server once its result is there."""
        result = self._results.pop(bytes(goal.goal_id.uuid))
        if goal.is_cancel_requested:
            goal.canceled()
        elif self._succeeded(result):
            goal.succeed()
        else:
            goal.abort()
        return result

    def _cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        self._cancelled(goal)
        return CancelResponse.ACCEPT
