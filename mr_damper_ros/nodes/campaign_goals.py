"""The action of the campaign node: goals come in, and each ends with a result."""

from __future__ import annotations

from collections.abc import Callable

from mr_damper_msgs.action import RunCampaign
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from mr_damper_ros.campaign.conductor import CampaignStatus
from mr_damper_ros.nodes.goal_server import GoalServer


class CampaignGoals:
    """Serves ``~/run_campaign``, one goal at a time.

    ``begin`` starts the campaign of a goal and returns why not, empty where it has begun; ``stop``
    is called where the goal is cancelled. ``refusal`` says why a goal cannot be meant, ``busy``
    whether there is a campaign already.
    """

    def __init__(
        self,
        node: Node,
        begin: Callable[[RunCampaign.Goal], str],
        refusal: Callable[[RunCampaign.Goal], str],
        busy: Callable[[], bool],
        stop: Callable[[], None],
    ) -> None:
        self._begin_campaign = begin
        self._cannot_be_meant = refusal
        self._busy = busy
        self._stop = stop
        self._logger = node.get_logger()
        self._goal: ServerGoalHandle | None = None
        self._server = GoalServer(
            node,
            RunCampaign,
            "~/run_campaign",
            begin=self._begin,
            refusal=self._refusal,
            cancel=self._cancel,
            succeeded=lambda result: result.outcome == RunCampaign.Result.MET,
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
            self._server.finish(goal, result)

    def _refusal(self, request: RunCampaign.Goal) -> str:
        if self._busy():
            return "a campaign is under way; stop it first, or wait for its end"
        return self._cannot_be_meant(request)

    def _begin(self, goal: ServerGoalHandle) -> None:
        why_not = self._begin_campaign(goal.request)
        if not why_not:
            self._goal = goal
            return
        self._logger.error(f"the campaign cannot begin: {why_not}")
        self._server.finish(
            goal,
            RunCampaign.Result(
                outcome=RunCampaign.Result.FAILED, message=why_not, worst_error=float("nan")
            ),
        )

    def _cancel(self, goal: ServerGoalHandle) -> None:
        if goal == self._goal:
            self._stop()
