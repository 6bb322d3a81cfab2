"""Node that identifies the damper during operation, by window fits and global identifications."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from mr_damper_msgs.action import IdentifyGlobal
from mr_damper_msgs.msg import DamperParameters, FitReport
from mr_damper_msgs.srv import LoadParameters, SaveParameters
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from mr_damper_ros.models import MODELS, machine_code
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet, start_set
from mr_damper_ros.models.plausibility import check_plausible
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Diagnostics, Finding
from mr_damper_ros.nodes.goal_server import GoalServer
from mr_damper_ros.nodes.inputs import CURRENT_TOPIC, SAMPLES_TOPIC, Inputs
from mr_damper_ros.nodes.messages import (
    fluid_temperature_message,
    numbers_message,
    parameters_message,
    report_message,
)
from mr_damper_ros.nodes.node_parameters import NodeParameters
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.processes.worker import Worker, WorkerPool
from mr_damper_ros.settings.option_table import ParameterTable, group, option
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.signals.uniform_grid import GridSettings
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.identifier import (
    Identifier,
    PipelineSettings,
    Publication,
    Search,
    SearchEnded,
    SearchProgress,
)
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError, read_parameter_file
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.tracker_state import TrackerState
from mr_damper_ros.tracking.window_assembler import WindowAssembler, WindowSettings


@dataclass(frozen=True)
class IdentifierParameters(ParameterTable):
    """Parameters of the identifier node.

    Samples and supply current are collected into windows. The node fits the windows in the order of
    the data, each starting from the set in use. The fitted set replaces the set in use if it
    predicts validation samples of the window better. Periodically, all parameters of the law are
    identified at once, from windows at different operating points (peak velocity, current). Only
    the stamps of the data matter, so a bag gives the same sets at any replay rate.
    """

    windows: WindowSettings = group(WindowSettings, flat=True)
    grid: GridSettings = group(GridSettings, flat=True)
    tracking: TrackerSettings = group(TrackerSettings, flat=True)
    work: PipelineSettings = group(PipelineSettings, flat=True)
    initial_parameters: str = option(
        "literature",
        "Parameter file (YAML) to start from, for example from `identify` or from the service "
        "~/save_parameters; or literature, the start of the searches in the thesis (laws other "
        "than the sigmoid then start from the first window). The service ~/reset returns to this "
        "set. Its ranges are kept until samples contradict them: a window at one current rescales "
        "the set, but does not narrow its range to that current.",
    )
    state_dir: str = option(
        "",
        'Folder for parameter sets; "": none. It holds the state under the name of the node '
        "(the set in use, baselines, reservoir, residual baseline), which is loaded at the "
        "next start, and the sets of the services ~/save_parameters and ~/load_parameters, "
        "which take plain names, not paths. A file that is damaged, of another law, of another "
        "version of the format or not plausible for a damper is never used: it is renamed and "
        "reported in the diagnostics until the service ~/acknowledge is called. Only one node "
        "at a time may use a folder and node name.",
    )
    frame_id: str = option("damper", "Frame of the published messages, x along the damper's rod.")


_POLL_PERIOD = 0.02
"""Time [s] between two polls of the worker.

The events executor does not support guard conditions, which would make polling unnecessary. In an
overloaded node, a timer would wait until all queued samples were processed, and no window would be
fitted meanwhile.
"""


_MOST_GOALS = 20
"""Largest number of waiting goals; a search may take minutes, so a longer queue is useless."""


class IdentifierNode(Node):
    """Passes incoming data to the identification, and publishes its results."""

    def __init__(self, worker: Worker) -> None:
        super().__init__("identifier")
        options = NodeParameters(self, IdentifierParameters).values
        self._frame_id = options.frame_id
        # Two dampers in two namespaces may share a folder.
        own_name = self.get_fully_qualified_name().strip("/").replace("/", ".")
        self._identifier = identifier = _identifier(options, own_name, worker)
        self._resume()
        self._sets = self.create_publisher(DamperParameters, "damper/parameters", quality.latched())
        self._reports = quality.publisher(self, FitReport, "damper/fit_report")
        self._temperatures = quality.publisher(self, Temperature, "damper/fluid_temperature")
        self._numbers = quality.publisher(self, DiagnosticArray, "damper/identified")
        self._publish_parameters(identifier.tracker.parameters)
        self._next_poll = 0.0
        self._inputs = Inputs(self, quality.lossless, self._take_block, identifier.add_current)
        quality.subscription(
            self,
            Temperature,
            "temperature",
            lambda message: identifier.add_temperature(message.temperature),
        )
        for kind, name, act in (
            (SaveParameters, "save_parameters", self._save),
            (LoadParameters, "load_parameters", self._load),
            (Trigger, "reset", lambda _: self._switch(identifier.reset)),
            (Trigger, "acknowledge", self._acknowledge),
        ):
            self.create_service(kind, f"~/{name}", partial(_answer, act))
        self._evolution = options.tracking.evolution
        self._goals: dict[Search, ServerGoalHandle] = {}
        self._server = GoalServer(
            self,
            IdentifyGlobal,
            "~/identify_global",
            begin=self._begin_goal,
            refusal=self._refusal,
            cancel=self._cancel_goal,
        )
        self._worker = worker
        # A rejected fit causes a warning only if the NRMSE of the set in use exceeds this limit.
        self._maximum_nrmse = options.tracking.acceptance.maximum_nrmse
        self._diagnostics = Diagnostics(
            self,
            {
                "input": lambda: self._inputs.samples_finding(identifier.assembler.sequence),
                "current": self._inputs.current_finding,
                "window": self._find_window,
                "fit": self._find_fit,
                "worker": self._find_worker,
                "parameters": self._find_parameters,
                "state": self._find_state,
            },
            self._inputs.stream_findings,
        )
        kept = options.state_dir
        self.get_logger().info(
            f"waiting for {self.resolve_topic_name(SAMPLES_TOPIC)} and "
            f"{self.resolve_topic_name(CURRENT_TOPIC)}; "
            + (f"state is stored in {kept}" if kept else "no state is stored: state_dir is not set")
        )
        law = identifier.tracker.parameters.model
        if MODELS[law].remembers and not machine_code.is_available():
            self.get_logger().info(
                f"Numba is not installed; with it, the law '{law}' is identified several times as "
                "fast (pip install numba==0.68.1)"
            )

    def destroy_node(self) -> None:
        """Store and publish pending results, then end."""
        self._identifier.close()
        self._publish(self._identifier.flush())
        super().destroy_node()

    def _resume(self) -> None:
        state = self._identifier.state
        try:
            known = state.resume(self._identifier.tracker)
        except StateError as error:
            raise ValueError(f"state_dir: {error}") from error
        if known:
            self.get_logger().info(f"continuing with {known}")
        if state.set_aside:
            self.get_logger().error(state.set_aside)

    def _take_block(self, block: SampleBlock) -> None:
        for event in self._identifier.add_block(block):
            self.get_logger().warning(event, throttle_duration_sec=1.0)

    def poll_in_time(self) -> float:
        """Poll the worker if it is due; returns the seconds until the next poll."""
        left = self._next_poll - time.monotonic()
        if left > 0.0:
            return left
        for event in self._identifier.poll():
            if isinstance(event, Publication):
                self._publish([event])
            elif event.search not in self._goals:
                continue
            elif isinstance(event, SearchProgress):
                feedback = IdentifyGlobal.Feedback(**vars(event.progress))
                self._goals[event.search].publish_feedback(feedback)
            else:
                result = self._goal_result(event)
                goal = self._goals.pop(event.search)
                self._server.finish(goal, result, succeeded=result.success)
        for notice in self._identifier.take_notices():
            self.get_logger().warning(notice)
        self._next_poll = time.monotonic() + _POLL_PERIOD
        return _POLL_PERIOD

    def _publish(self, publications: Iterable[Publication]) -> None:
        for publication in publications:
            report = publication.report
            if report.verdict is Verdict.ACCEPTED_EARLY:
                self.get_logger().warning(report.reason)
            frame, node = self._frame_id, self.get_fully_qualified_name()
            if not math.isnan(report.fluid.celsius):
                self._temperatures.publish(fluid_temperature_message(report, frame))
            self._reports.publish(report_message(report, publication.duration, frame, node))
            if np.isfinite(report.coefficients).any():
                self._numbers.publish(numbers_message(report, frame))
            if report.verdict is Verdict.ACCEPTED:
                self.get_logger().info(report.line)
            if publication.parameters is not None:
                self._publish_parameters(publication.parameters)

    def _publish_parameters(self, parameters: ParameterSet) -> None:
        self._sets.publish(self._set_message(parameters))
        self._numbers.publish(numbers_message(parameters, self._frame_id))

    def _set_message(self, parameters: ParameterSet) -> DamperParameters:
        return parameters_message(parameters, self._frame_id, self.get_fully_qualified_name())

    def _save(self, request: Any) -> str:
        tracker = self._identifier.tracker
        path = self._identifier.state.save(request.name, tracker)
        return f"saved {tracker.parameters.set_id} as {path}"

    def _load(self, request: Any) -> str:
        parameters = self._identifier.state.load(request.name)
        return self._switch(lambda: self._identifier.replace(parameters))

    def _acknowledge(self, _: Any) -> str:
        taken = self._identifier.state.acknowledge(), self._identifier.acknowledge()
        return "; ".join(filter(None, taken)) or "there was nothing to acknowledge"

    def _switch(self, to_another_set: Callable[[], str]) -> str:
        """Publish pending results of the set in use, then put the other set in use."""
        self._publish(self._identifier.flush())
        fault = to_another_set()
        parameters = self._identifier.tracker.parameters
        self._publish_parameters(parameters)
        return f"running with {parameters.set_id}" + (f"; {fault}" if fault else "")

    # --- goals: each is a search of the identification -------------------------------------------

    def _refusal(self, _: IdentifyGlobal.Goal) -> str:
        if len(self._goals) < _MOST_GOALS:
            return ""
        return f"{_MOST_GOALS} goals are waiting; cancel some, or try again later"

    def _begin_goal(self, goal: ServerGoalHandle) -> None:
        try:
            settings = replace(
                self._evolution,
                generations=goal.request.generations or self._evolution.generations,
                seed=goal.request.seed,
                strategy=goal.request.strategy or self._evolution.strategy,
            )
        except ValueError as error:
            result = IdentifyGlobal.Result(message=str(error), nrmse=math.nan)
            self._server.finish(goal, result, succeeded=False)
            return
        search = Search(settings)
        self._goals[search] = goal
        self._identifier.add_search(search)

    def _cancel_goal(self, goal: ServerGoalHandle) -> None:
        for search, known in self._goals.items():
            if known == goal:
                self._identifier.cancel_search(search)

    def _goal_result(self, event: SearchEnded) -> IdentifyGlobal.Result:
        outcome = event.outcome
        if outcome is None or outcome.report is None:
            return IdentifyGlobal.Result(
                message="cancelled, or superseded by a reset or another set", nrmse=math.nan
            )
        report = outcome.report
        if outcome.found is None:
            return IdentifyGlobal.Result(message=report.reason, nrmse=math.nan)
        message = outcome.message
        if not report.accepted:
            message += f"; not in use: {report.reason}"
        found = replace(
            outcome.found,
            set_id=report.set_id if report.accepted else "global-refused",
            stamp_ns=report.stamp_ns,
        )
        return IdentifyGlobal.Result(
            accepted=report.accepted,
            success=True,
            message=message,
            parameters=self._set_message(found),
            nrmse=report.nrmse_after,
            evaluations=report.evaluations,
        )

    # --- state ----------------------------------------------------------------------------------

    def _find_window(self) -> Finding:
        assembler = self._identifier.assembler
        if assembler.waits_for_current:
            return Finding(
                WARN,
                "a window is full but waits for a supply current stamped at or after its end: is "
                "the current published, with stamps on the clock of the samples?",
            )
        return Finding(OK, f"window {assembler.fill:.0%} full")

    def _find_fit(self) -> Finding:
        report, tracker = self._identifier.last_report, self._identifier.tracker
        if report is None:
            return Finding(STALE, "no window has been fitted yet")
        values = {
            "NRMSE before": f"{report.nrmse_before:.4f}",
            "NRMSE after": f"{report.nrmse_after:.4f}",
            "force scale": f"{report.scale.value:.4f} ± {report.scale.standard_error:.2g}",
            "temperature from the force [°C]": (
                f"{report.fluid.celsius:.1f} ± {report.fluid.standard_error:.1f}"
            ),
            "lag of the force behind the current [s]": (
                f"{report.current_lag:.3f} ± {report.current_lag_error:.2g}"
            ),
            "accepted windows": tracker.accepted_windows,
            "operating points": len(tracker.points.windows),
        }
        if report.verdict is Verdict.ACCEPTED_EARLY:
            return Finding(WARN, f"{report.reason} as {report.set_id}", values)
        if report.late_current:
            return Finding(WARN, report.late_current, values)
        if report.accepted:
            return Finding(OK, f"accepted as {report.set_id}", values)
        waits = report.verdict is Verdict.TOO_LITTLE_MOTION and tracker.accepted_windows > 0
        good = waits or report.nrmse_before <= self._maximum_nrmse
        return Finding(OK if good else WARN, f"not accepted: {report.reason}", values)

    def _find_worker(self) -> Finding:
        """The activity of the worker, and whether it keeps up with the data."""
        worker, identifier = self._worker, self._identifier
        dropped = identifier.dropped_windows
        values = {
            "waiting windows": identifier.waiting_windows,
            "dropped windows": dropped,
            "replaced": worker.pool.replaced,
            "process": worker.pid,
        }
        if dropped:
            return Finding(
                WARN,
                f"{dropped} windows were dropped: they arrive faster than they are fitted; "
                "increase hop or waiting_windows",
                values,
            )
        if not worker.pool.ready:
            return Finding(OK, "the process is starting", values)
        return Finding(OK, identifier.running or "idle", values)

    def _find_parameters(self) -> Finding:
        tracker = self._identifier.tracker
        parameters = tracker.parameters
        age = (self.get_clock().now().nanoseconds - parameters.stamp_ns) / NANOSECONDS
        names = parameters.law.parameter_names
        hidden = [n for n, seen in zip(names, parameters.observable, strict=True) if not seen]
        values = {
            "id": parameters.set_id,
            "model": parameters.model,
            "source": parameters.source,
            "age [s]": f"{age:.1f}" if parameters.stamp_ns else "unknown",
            "NRMSE": f"{parameters.nrmse:.4f}",
            "not observable": ", ".join(hidden) or "none",
        }
        if tracker.accepted_windows == 0:
            return Finding(
                WARN, f"no window accepted yet: running with {parameters.set_id}", values
            )
        return Finding(OK, f"running with {parameters.set_id}", values)

    def _find_state(self) -> Finding:
        state = self._identifier.state
        if state.writer.fault:
            return Finding(ERROR, state.writer.fault)
        if state.set_aside:
            return Finding(ERROR, f"{state.set_aside} (call ~/acknowledge once you have read this)")
        if state.path is None:
            return Finding(OK, "nothing is stored on disk: state_dir is not set")
        return Finding(OK, f"stored in {state.path}")


def _answer(act: Callable[[Any], str], request: Any, response: Any) -> Any:
    """The answer of a service: the action taken, or the reason for its failure."""
    try:
        response.message = act(request)
        response.success = True
    except (StateError, ParameterError) as error:
        response.message = str(error)
    return response


def _identifier(options: IdentifierParameters, own_name: str, worker: Worker) -> Identifier:
    tracking = options.tracking
    initial = options.initial_parameters
    try:
        tracker = WindowTracker(
            tracking,
            start_set(tracking.law)
            if initial == "literature"
            else check_plausible(read_parameter_file(initial)),
        )
    except ValueError as error:
        raise ValueError(f"initial_parameters: {error}") from error
    return Identifier(
        WindowAssembler(options.windows, options.grid),
        tracker,
        worker,
        options.work,
        TrackerState(StateDirectory(options.state_dir), own_name),
    )


def main() -> int:
    """Run the node and its worker; returns the exit code."""
    with closing(WorkerPool("scipy.optimize mr_damper_ros.tracking.tracker")) as workers:
        node, poll = partial(IdentifierNode, Worker(workers)), IdentifierNode.poll_in_time
        return run(node, IdentifierParameters, between=poll)
