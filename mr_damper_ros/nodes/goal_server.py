"""Action servers for long goals, which wait for their results without using the executor.

:class:`SearchGoals` serves requests for a global identification.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

from mr_damper_msgs.action import IdentifyGlobal
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import parameters_message
from mr_damper_ros.tracking.identifier import Identifier, Search, SearchEnded, SearchProgress


class GoalServer:
    """Serves an action of a node.

    ``begin`` receives each accepted goal. ``refusal`` returns the reason to reject a request now,
    or an empty string. ``cancel`` receives a goal that its client cancels. ``succeeded`` says
    whether a result is a success.

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
            goal_service_qos_profile=quality.lossless(),
            result_service_qos_profile=quality.lossless(),
            cancel_service_qos_profile=quality.lossless(),
        )

    def finish(self, goal: ServerGoalHandle, result: Any) -> None:
        """Deliver the result of a goal to its client."""
        self._results[bytes(goal.goal_id.uuid)] = result
        goal.execute()

    def _judge(self, request: Any) -> GoalResponse:
        refusal = self._refusal(request)
        if not refusal:
            return GoalResponse.ACCEPT
        self._logger.warning(f"a goal is rejected: {refusal}", throttle_duration_sec=1.0)
        return GoalResponse.REJECT

    def _hand_over(self, goal: ServerGoalHandle) -> Any:
        """End a goal; the action server calls this once the result is available."""
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


_REFUSED = "global-refused"
"""Id of an identified set that was rejected."""

_MOST_GOALS = 20
"""Largest number of waiting goals; a search may take minutes, so a longer queue is useless."""


class SearchGoals:
    """Serves ``~/identify_global``: each goal is a search of the identification."""

    def __init__(
        self, node: Node, identifier: Identifier, configured: EvolutionSettings, frame_id: str
    ) -> None:
        self._identifier = identifier
        self._configured = configured
        self._frame_id = frame_id
        self._node = node.get_fully_qualified_name()
        self._goals: dict[Search, ServerGoalHandle] = {}
        self._server = GoalServer(
            node,
            IdentifyGlobal,
            "~/identify_global",
            begin=self._begin,
            refusal=self._refusal,
            cancel=self._cancel,
            succeeded=lambda result: bool(result.success),
        )

    def publish_progress(self, event: SearchProgress) -> None:
        """Send the progress of a search to the client of its goal."""
        if event.search in self._goals:
            progress = event.progress
            self._goals[event.search].publish_feedback(
                IdentifyGlobal.Feedback(
                    stage=progress.stage,
                    generation=progress.generation,
                    generations=progress.generations,
                    best_cost=progress.best_cost,
                    time_left=progress.time_left,
                )
            )

    def finish(self, event: SearchEnded) -> None:
        """Deliver the result of a search to the client of its goal."""
        if event.search in self._goals:
            self._server.finish(self._goals.pop(event.search), self._result(event))

    def _refusal(self, _: IdentifyGlobal.Goal) -> str:
        if len(self._goals) < _MOST_GOALS:
            return ""
        return f"{_MOST_GOALS} goals are waiting; cancel some, or try again later"

    def _begin(self, goal: ServerGoalHandle) -> None:
        try:
            settings = dataclasses.replace(
                self._configured,
                generations=goal.request.generations or self._configured.generations,
                seed=goal.request.seed,
                strategy=goal.request.strategy or self._configured.strategy,
            )
        except ValueError as error:
            self._server.finish(goal, IdentifyGlobal.Result(message=str(error), nrmse=math.nan))
            return
        search = Search(settings)
        self._goals[search] = goal
        self._identifier.add_search(search)

    def _cancel(self, goal: ServerGoalHandle) -> None:
        for search, known in self._goals.items():
            if known == goal:
                self._identifier.cancel_search(search)

    def _result(self, event: SearchEnded) -> IdentifyGlobal.Result:
        if event.outcome is None or event.report is None:
            return IdentifyGlobal.Result(
                message="cancelled, or superseded by a reset or another set", nrmse=math.nan
            )
        outcome, report = event.outcome, event.report
        if outcome.found is None:
            return IdentifyGlobal.Result(message=report.reason, nrmse=math.nan)
        message = outcome.message
        if not report.accepted:
            message += f"; not in use: {report.reason}"
        found = dataclasses.replace(
            outcome.found,
            set_id=report.set_id if report.accepted else _REFUSED,
            stamp_ns=report.stamp_ns,
        )
        return IdentifyGlobal.Result(
            accepted=report.accepted,
            success=True,
            message=message,
            parameters=parameters_message(found, self._frame_id, self._node),
            nrmse=report.nrmse_after,
            evaluations=report.evaluations,
        )
