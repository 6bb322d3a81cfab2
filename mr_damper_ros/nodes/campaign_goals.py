"""The action of the campaign node: goals come in, and each ends with a result."""

from __future__ import annotations

from collections.abc import Callable

from mr_damper_msgs.action import RunCampaign
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from mr_damper_ros.interface.campaign_conductor import CampaignStatus
from mr_damper_ros.nodes import quality


class CampaignGoals:
    """Serves ``~/run_campaign``, one goal at a time.

    ``begin`` starts the campaign of a goal and returns why not, empty where it has begun; ``stop``
    is called where the goal is cancelled. ``busy`` tells that there is a campaign already.

    A goal is "accepted" until its campaign has ended and "executing" only while its result is
    handed over: a coroutine that waits would be resumed by the executor again and again.
    """

    def __init__(
        self,
        node: Node,
        begin: Callable[[RunCampaign.Goal], str],
        busy: Callable[[], bool],
        stop: Callable[[], None],
    ) -> None:
        self._begin_campaign = begin
        self._busy = busy
        self._stop = stop
        self._logger = node.get_logger()
        self._goal: ServerGoalHandle | None = None
        self._results: dict[bytes, RunCampaign.Result] = {}
        self._server = ActionServer(
            node,
            RunCampaign,
            "~/run_campaign",
            self._hand_over,
            handle_accepted_callback=self._begin,
            goal_callback=self._judge,
            cancel_callback=self._cancel,
            goal_service_qos_profile=quality.bursts(),
            result_service_qos_profile=quality.bursts(),
            cancel_service_qos_profile=quality.bursts(),
        )

    def tell(self, status: CampaignStatus) -> None:
        """Tell whoever asked for the campaign how it stands."""
        if self._goal is not None:
            left = status.runs_left
            self._goal.publish_feedback(
                RunCampaign.Feedback(
                    stage=int(status.stage),
                    run=status.run,
                    sentence=status.sentence or status.state,
                    worst_error=status.worst_error,
                    runs_left=-1 if left is None else left,
                )
            )

    def end(self, result: RunCampaign.Result) -> None:
        """Give whoever asked for the campaign its result."""
        if self._goal is not None:
            goal, self._goal = self._goal, None
            self._finish(goal, result)

    def _judge(self, _: RunCampaign.Goal) -> GoalResponse:
        if not self._busy():
            return GoalResponse.ACCEPT
        self._logger.warning(
            "a goal is refused: a campaign is under way; stop it first, or wait for its end",
            throttle_duration_sec=1.0,
        )
        return GoalResponse.REJECT

    def _begin(self, goal: ServerGoalHandle) -> None:
        why_not = self._begin_campaign(goal.request)
        if not why_not:
            self._goal = goal
            return
        self._logger.error(f"the campaign cannot begin: {why_not}")
        self._finish(
            goal,
            RunCampaign.Result(
                outcome=RunCampaign.Result.FAILED, message=why_not, worst_error=float("nan")
            ),
        )

    def _finish(self, goal: ServerGoalHandle, result: RunCampaign.Result) -> None:
        self._results[bytes(goal.goal_id.uuid)] = result
        goal.execute()

    def _hand_over(self, goal: ServerGoalHandle) -> RunCampaign.Result:
        """End a goal, called by the action server once its result is there."""
        result = self._results.pop(bytes(goal.goal_id.uuid))
        if goal.is_cancel_requested:
            goal.canceled()
        elif result.outcome == RunCampaign.Result.MET:
            goal.succeed()
        else:
            goal.abort()
        return result

    def _cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        if goal == self._goal:
            self._stop()
        return CancelResponse.ACCEPT
