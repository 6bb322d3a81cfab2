"""The action by which a user asks for a global identification."""

from __future__ import annotations

import dataclasses
import math

from mr_damper_msgs.action import IdentifyGlobal
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.nodes.goal_server import GoalServer
from mr_damper_ros.nodes.results import parameters_message
from mr_damper_ros.tracking.identifier import Identifier, Search, SearchEnded, SearchProgress

_REFUSED = "global-refused"
"""Id of a set that was found but is not in use."""

_MOST_GOALS = 20
"""Goals that may wait; a search takes up to minutes, so nobody waits for more of them."""


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

    def tell(self, event: SearchProgress) -> None:
        """Tell whoever asked for a search how far it is."""
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

    def end(self, event: SearchEnded) -> None:
        """Give whoever asked for a search its result."""
        if event.search in self._goals:
            self._server.finish(self._goals.pop(event.search), self._result(event))

    def _refusal(self, _: IdentifyGlobal.Goal) -> str:
        if len(self._goals) < _MOST_GOALS:
            return ""
        return f"{_MOST_GOALS} wait already; cancel some, or send it later"

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
                message="cancelled, or overtaken by a reset or another set", nrmse=math.nan
            )
        fit, report = event.outcome.found, event.report
        if fit is None:
            return IdentifyGlobal.Result(message=report.reason, nrmse=math.nan)
        message = fit.message
        if not report.accepted:
            message += f"; not in use: {report.reason}"
        found = dataclasses.replace(
            fit.parameter_set,
            set_id=report.set_id if report.accepted else _REFUSED,
            stamp_ns=report.stamp_ns,
        )
        return IdentifyGlobal.Result(
            accepted=report.accepted,
            success=True,
            message=message,
            parameters=parameters_message(found, self._frame_id, self._node),
            nrmse=report.nrmse_after,
            evaluations=fit.evaluations,
        )
