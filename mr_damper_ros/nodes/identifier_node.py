"""Node that identifies the damper while it runs: window by window, and as a whole now and then."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import Any

from mr_damper_msgs.action import IdentifyGlobal
from mr_damper_msgs.msg import DamperParameters, FitReport
from mr_damper_msgs.srv import LoadParameters, SaveParameters
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Temperature
from std_srvs.srv import Trigger

from mr_damper_ros.estimation.differential_evolution import STRATEGIES, EvolutionSettings
from mr_damper_ros.estimation.window_fit import WINDOW_METHODS
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.initial_set import start_set
from mr_damper_ros.models.parameter_set import DEFAULT_MODEL, ParameterError, ParameterSet
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Diagnostics, Finding
from mr_damper_ros.nodes.inputs import Inputs
from mr_damper_ros.nodes.node_parameters import ConfigurationError, NodeParameters
from mr_damper_ros.nodes.results import (
    fluid_temperature_message,
    parameters_message,
    report_message,
)
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.processes.background_writer import BackgroundWriter
from mr_damper_ros.processes.worker import Worker
from mr_damper_ros.settings.option_table import ParameterTable, group, option
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.tracking.acceptance import AcceptanceSettings, Verdict
from mr_damper_ros.tracking.pipeline import (
    Budget,
    Pipeline,
    Search,
    SearchEnded,
    SearchProgress,
    WindowEnded,
)
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.screening import Screening
from mr_damper_ros.tracking.state_directory import StateDirectory, StateError, read_parameter_file
from mr_damper_ros.tracking.tracker import WindowTracker
from mr_damper_ros.tracking.tracker_memory import TrackerMemory, from_text, to_text
from mr_damper_ros.tracking.tracker_settings import TRACKERS, TrackerSettings
from mr_damper_ros.tracking.window_assembler import WindowAssembler

_ATTENTION_PERIOD = 0.02
"""Seconds between two looks at the worker; this costs 1 % of a core.

A guard condition would need no looking, but the events executor supports none.
"""

_DISK_PATIENCE = 1.0
"""Seconds after which what is identified is published even though it is not on disk yet."""


@dataclass(frozen=True)
class EvolutionParameters:
    """Parameters of the differential evolution."""

    strategy: str = option(
        EvolutionSettings.strategy,
        "How differential evolution makes new individuals.",
        choices=STRATEGIES,
        read_only=True,
    )
    mutation: float = option(
        EvolutionSettings.mutation,
        "Differential weight F.",
        minimum=0.01,
        maximum=1.99,
        read_only=True,
    )
    recombination: float = option(
        EvolutionSettings.recombination,
        "Crossover probability CR.",
        minimum=0.0,
        maximum=1.0,
        read_only=True,
    )
    generations: int = option(
        EvolutionSettings.generations,
        "At most so many generations.",
        minimum=1,
        maximum=1_000_000,
        read_only=True,
    )
    population: int = option(
        EvolutionSettings.population,
        "Individuals per unknown.",
        minimum=5,
        maximum=1000,
        read_only=True,
    )
    seed: int = option(
        EvolutionSettings.seed,
        "Seed of the random numbers: the same seed and data give the same result.",
        minimum=0,
        maximum=2**32 - 1,
        read_only=True,
    )


@dataclass(frozen=True)
class ScreeningParameters:
    """Limits that a window must keep to be fitted at all."""

    minimum_amplitude: float = option(
        Screening.minimum_amplitude,
        "Least half span of the displacement [m] in a window.",
        minimum=0.0,
        maximum=1.0,
        read_only=True,
    )
    current_tolerance: float = option(
        Screening.current_tolerance,
        "Largest change of the current [A] within a window.",
        minimum=0.0,
        maximum=100.0,
        read_only=True,
    )


@dataclass(frozen=True)
class AcceptanceParameters:
    """Limits that a fit must keep to be accepted."""

    maximum_nrmse: float = option(
        AcceptanceSettings.maximum_nrmse,
        "Largest RMSE/std of the force on held-back samples.",
        minimum=0.0,
        maximum=10.0,
        read_only=True,
    )
    residual_factor: float = option(
        AcceptanceSettings.residual_factor,
        "A residual so many times the usual one is taken for a disturbance.",
        minimum=1.0,
        maximum=1e6,
        read_only=True,
    )
    step_limit: float = option(
        AcceptanceSettings.step_limit,
        "A relative change of the force beyond this must be confirmed by the next window.",
        minimum=0.0,
        maximum=1e6,
        read_only=True,
    )


@dataclass(frozen=True)
class IdentifierParameters(ParameterTable):
    """Parameters of the identifier node."""

    model: str = option(
        DEFAULT_MODEL,
        "Force law that is identified.",
        choices=tuple(MODELS),
        read_only=True,
    )
    window: float = option(
        2.0,
        "Length of a window [s]; at least one cycle of the motion must fit in.",
        minimum=0.01,
        maximum=3600.0,
        read_only=True,
    )
    hop: float = option(
        1.0,
        "Time [s] from the start of a window to the start of the next, at most the window's "
        "length.",
        minimum=0.001,
        maximum=3600.0,
        read_only=True,
    )
    looks: int = option(
        3,
        "Times within a hop that the newest samples are compared with the set in use; 0: never.",
        minimum=0,
        maximum=1000,
        read_only=True,
    )
    smallest_change: float = option(
        TrackerSettings.smallest_change,
        "Relative change of the force between two windows that is worth an early fit.",
        minimum=0.001,
        maximum=1.0,
        read_only=True,
    )
    tracker: str = option(
        TrackerSettings.tracker,
        "How the damper is followed: by the fit of each window, or by a recursive filter.",
        choices=TRACKERS,
        read_only=True,
    )
    drift_rate: float = option(
        TrackerSettings.drift_rate,
        "Random walk of the force [1/sqrt(s)] that the recursive filter reckons with.",
        minimum=1e-9,
        maximum=1.0,
        read_only=True,
    )
    method: str = option(
        TrackerSettings.method, "How a window is fitted.", choices=WINDOW_METHODS, read_only=True
    )
    robust: bool = option(
        TrackerSettings.robust,
        "Whether the influence of outliers in the force is bounded (Huber).",
        read_only=True,
    )
    fit_time_budget: float = option(
        30.0,
        "Time [s] after which the fit of a window is cut, with the best so far.",
        minimum=0.01,
        maximum=3600.0,
        read_only=True,
    )
    waiting_windows: int = option(
        1000,
        "At most so many windows wait for their fit; then the oldest one makes room. 1: the "
        "newest window replaces the waiting one.",
        minimum=1,
        maximum=1_000_000,
        read_only=True,
    )
    global_period: int = option(
        TrackerSettings.global_period,
        "A global identification follows every so many accepted windows; 0 for never.",
        minimum=0,
        maximum=1_000_000,
        read_only=True,
    )
    search_time_budget: float = option(
        600.0,
        "Time [s] after which a global identification is cut, with the best so far.",
        minimum=0.01,
        maximum=86_400.0,
        read_only=True,
    )
    evolution: EvolutionParameters = group(EvolutionParameters)
    screening: ScreeningParameters = group(ScreeningParameters)
    acceptance: AcceptanceParameters = group(AcceptanceParameters)
    initial_parameters: str = option(
        "literature",
        "Parameter file (YAML) to start from; 'literature' for the published start of the "
        "thesis' searches (for a model other than the sigmoid law: from the first window).",
        read_only=True,
    )
    state_dir: str = option(
        "",
        "Folder in which parameter sets are kept: the running one, read again at the next start, "
        "and those of the services save_parameters and load_parameters. Empty: nothing is kept.",
        read_only=True,
    )
    frame_id: str = option("damper", "Frame of the published messages.", read_only=True)

    def objection(self) -> str:
        """Why these values do not go together."""
        if self.hop > self.window:
            return (
                f"hop ({self.hop:g} s) is longer than window ({self.window:g} s): "
                "samples between two windows would never be used"
            )
        try:
            _ = self.tracker_settings
        except ValueError as error:
            return str(error)
        return ""

    @property
    def tracker_settings(self) -> TrackerSettings:
        """The settings of the identification itself."""
        return TrackerSettings(
            model=self.model,
            tracker=self.tracker,
            method=self.method,
            robust=self.robust,
            drift_rate=self.drift_rate,
            smallest_change=self.smallest_change,
            global_period=self.global_period,
            screening=Screening(**dataclasses.asdict(self.screening)),
            acceptance=AcceptanceSettings(**dataclasses.asdict(self.acceptance)),
            evolution=EvolutionSettings(**dataclasses.asdict(self.evolution)),
        )


@dataclass(frozen=True, eq=False)
class _Outgoing:
    """A report, and the set it brought, that wait until the state of this number is on disk."""

    report: FitReport
    parameters: ParameterSet | None
    state: int
    deadline: float


class IdentifierNode(Node):
    """Feeds what arrives to the identification, and publishes what comes of it."""

    def __init__(self, worker: Worker) -> None:
        super().__init__("identifier")
        self._options = NodeParameters(self, IdentifierParameters).values
        self._state = _state_directory(self._options.state_dir)
        self._set_aside = ""
        self._keeper: BackgroundWriter[tuple[ParameterSet, TrackerMemory]] | None = None
        self._outbox: deque[_Outgoing] = deque()
        # Two dampers in two namespaces may share a folder.
        self._own_name = self.get_fully_qualified_name().strip("/").replace("/", ".")
        self._assembler = WindowAssembler(
            self._options.window, self._options.hop, self._options.looks
        )
        self._tracker = WindowTracker(
            self._options.tracker_settings,
            _initial_set(self._options.initial_parameters, self._options.model),
        )
        self._resume()
        self._goals: dict[Search, ServerGoalHandle] = {}
        self._results: dict[bytes, IdentifyGlobal.Result] = {}
        self._last_report: Report | None = None
        self._parameters_publisher = self.create_publisher(
            DamperParameters, "damper/parameters", quality.latched()
        )
        self._report_publisher = self.create_publisher(
            FitReport,
            "damper/fit_report",
            quality.stream(),
            qos_overriding_options=quality.overridable(),
        )
        self._temperature_publisher = self.create_publisher(
            Temperature,
            "damper/fluid_temperature",
            quality.stream(),
            qos_overriding_options=quality.overridable(),
        )
        self._publish_parameters(self._tracker.parameters)
        self._worker = worker
        self._pipeline = Pipeline(
            self._tracker,
            self._worker,
            waiting_windows=self._options.waiting_windows,
            budget=Budget(self._options.fit_time_budget, self._options.search_time_budget),
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_ATTENTION_PERIOD, self._attend, clock=steady)
        self._inputs = Inputs(self, quality.lossless, self._take_block, self._take_current)
        self.create_subscription(
            Temperature,
            "temperature",
            self._take_temperature,
            quality.stream(),
            qos_overriding_options=quality.overridable(),
        )
        self.create_service(SaveParameters, "~/save_parameters", self._save)
        self.create_service(LoadParameters, "~/load_parameters", self._load)
        self.create_service(Trigger, "~/reset", self._reset)
        self._action = ActionServer(
            self,
            IdentifyGlobal,
            "~/identify_global",
            self._hand_over,
            handle_accepted_callback=self._begin_search,
            cancel_callback=self._cancel,
        )
        self._diagnostics = Diagnostics(
            self,
            {
                "input": lambda: self._inputs.samples_finding(self._assembler.sequence),
                "current": self._inputs.current_finding,
                "window": self._window_finding,
                "fit": self._fit_finding,
                "worker": self._worker_finding,
                "parameters": self._parameters_finding,
                "state": self._state_finding,
            },
        )

    def destroy_node(self) -> None:
        """End what keeps the state too."""
        if self._keeper is not None:
            self._keeper.close(_DISK_PATIENCE)
        self._send(at_once=True)
        super().destroy_node()

    # What arrives

    def _take_block(self, block: SampleBlock) -> None:
        for window in self._assembler.add_block(block):
            self._pipeline.add_window(window)
        for event in self._assembler.take_events():
            self.get_logger().warning(event, throttle_duration_sec=1.0)

    def _take_current(self, stamp_ns: int, current: float) -> None:
        for window in self._assembler.add_current(stamp_ns, current):
            self._pipeline.add_window(window)

    def _take_temperature(self, message: Temperature) -> None:
        self._assembler.add_temperature(message.temperature)

    # What comes of it

    def _attend(self) -> None:
        for event in self._pipeline.poll():
            if isinstance(event, WindowEnded):
                self._publish_report(event.report, event.duration)
            elif isinstance(event, SearchProgress):
                self._publish_progress(event)
            else:
                self._finish_search(event)
        self._send()
        for notice in self._worker.take_notices():
            self.get_logger().warning(notice)

    def _publish_report(self, report: Report, duration: float) -> None:
        self._last_report = report
        if report.verdict is Verdict.ACCEPTED_EARLY:
            self.get_logger().warning(report.reason)
        if not math.isnan(report.fluid.celsius):
            self._temperature_publisher.publish(
                fluid_temperature_message(report, self._options.frame_id)
            )
        parameters = self._tracker.parameters if report.accepted else None
        if report.accepted:
            self._keep()
        self._outbox.append(
            _Outgoing(
                report_message(report, duration, self._options.frame_id),
                parameters,
                self._keeper.given if self._keeper else 0,
                time.monotonic() + _DISK_PATIENCE,
            )
        )
        self._send()

    def _send(self, *, at_once: bool = False) -> None:
        """Publish what is kept by now: what others have heard of survives whatever happens."""
        while self._outbox:
            first = self._outbox[0]
            if self._keeper is not None and self._keeper.done < first.state and not at_once:
                if time.monotonic() < first.deadline:
                    return
                self.get_logger().warning(
                    f"state_dir takes more than {_DISK_PATIENCE:g} s to be written: "
                    "publishing what is not kept yet",
                    throttle_duration_sec=60.0,
                )
            self._outbox.popleft()
            self._report_publisher.publish(first.report)
            if first.parameters is not None:
                self._publish_parameters(first.parameters)

    def _publish_parameters(self, parameters: ParameterSet) -> None:
        self._parameters_publisher.publish(parameters_message(parameters, self._options.frame_id))

    def _publish_progress(self, event: SearchProgress) -> None:
        if event.search in self._goals:
            progress = event.progress
            self._goals[event.search].publish_feedback(
                IdentifyGlobal.Feedback(
                    generation=progress.generation,
                    generations=progress.generations,
                    best_cost=progress.best_cost,
                    time_left=progress.time_left,
                )
            )

    def _finish_search(self, event: SearchEnded) -> None:
        if event.report is not None:
            self._publish_report(event.report, event.duration)
        if event.search in self._goals:
            self._finish(self._goals.pop(event.search), self._search_result(event))

    # Global identification on demand

    def _begin_search(self, goal: ServerGoalHandle) -> None:
        """Start what a goal asks for.

        The goal is "accepted" until the search has ended and "executing" only while its result is
        handed over: a coroutine that waits for the search would be resumed by the executor again
        and again, which takes two thirds of a core.
        """
        configured = self._options.tracker_settings.evolution
        try:
            settings = dataclasses.replace(
                configured,
                generations=goal.request.generations or configured.generations,
                seed=goal.request.seed,
                strategy=goal.request.strategy or configured.strategy,
            )
        except ValueError as error:
            self._finish(goal, IdentifyGlobal.Result(message=str(error), nrmse=math.nan))
            return
        search = Search(settings)
        self._goals[search] = goal
        self._pipeline.add_search(search)

    def _finish(self, goal: ServerGoalHandle, result: IdentifyGlobal.Result) -> None:
        self._results[bytes(goal.goal_id.uuid)] = result
        goal.execute()

    def _hand_over(self, goal: ServerGoalHandle) -> IdentifyGlobal.Result:
        """End a goal, called by the action server once its result is there."""
        result = self._results.pop(bytes(goal.goal_id.uuid))
        if goal.is_cancel_requested:
            goal.canceled()
        elif result.success:
            goal.succeed()
        else:
            goal.abort()
        return result

    def _search_result(self, event: SearchEnded) -> IdentifyGlobal.Result:
        if event.result is None or event.report is None:
            return IdentifyGlobal.Result(
                message="cancelled, or overtaken by a reset or another set", nrmse=math.nan
            )
        fit = event.result.fit
        if fit is None:
            return IdentifyGlobal.Result(message=event.report.reason, nrmse=math.nan)
        message = fit.message
        if event.report.reason:
            message += f"; not in use: {event.report.reason}"
        return IdentifyGlobal.Result(
            accepted=event.report.accepted,
            success=True,
            message=message,
            parameters=parameters_message(fit.parameter_set, self._options.frame_id),
            nrmse=event.report.nrmse_after,
            evaluations=fit.evaluations,
        )

    def _cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        for search, known in self._goals.items():
            if known == goal:
                self._pipeline.cancel_search(search)
        return CancelResponse.ACCEPT

    # State on disk

    def _resume(self) -> None:
        """Go on where the node ended, and keep from now on what it learns."""
        if not self._options.state_dir:
            return
        name = self._own_name
        try:
            is_kept = self._state.file(name).exists()
            if not is_kept:
                self._state.save(name, self._tracker.parameters)
        except StateError as error:
            raise ConfigurationError(f"state_dir: {error}") from error
        self._state.remove_unfinished(name)
        if is_kept:
            self._go_on(name)
        self._keeper = BackgroundWriter(
            lambda item: self._state.save(name, item[0], to_text(item[1]))
        )

    def _go_on(self, name: str) -> None:
        try:
            parameters, memory = self._state.load_with_memory(name)
            parameters.of_model(self._tracker.parameters.model)
        except (StateError, ParameterError) as error:
            self._put_aside(name, str(error))
            return
        try:
            if memory:
                learnt = from_text(memory, parameters.values.size)
                self._tracker.resume(parameters, learnt)
                known = f"{len(learnt.baselines)} baselines, {len(learnt.reservoir)} windows"
            else:
                self._tracker.replace(parameters)
                known = "a new baseline"
        except StateError as error:
            self._tracker.replace(parameters)
            self._put_aside(name, f"{error}; going on with {parameters.set_id} alone")
            with contextlib.suppress(StateError):
                self._state.save(name, parameters)
            return
        self.get_logger().info(f"going on with parameters {parameters.set_id} and {known}")

    def _put_aside(self, name: str, why: str) -> None:
        self._set_aside = why
        with contextlib.suppress(StateError):
            self._set_aside += f"; set aside as {self._state.set_aside(name)}"
        self.get_logger().error(self._set_aside)

    def _keep(self) -> None:
        """Have the running set, and what goes with it, written to disk soon."""
        if self._keeper is not None:
            self._keeper.keep((self._tracker.parameters, self._tracker.memory))
            self._set_aside = ""

    def _keep_now(self) -> str:
        """Keep, and wait for it; returns what is wrong with that, if anything is."""
        self._keep()
        if self._keeper is None:
            return ""
        if not self._keeper.wait(_DISK_PATIENCE):
            return f"state_dir takes more than {_DISK_PATIENCE:g} s to be written"
        return self._keeper.fault

    def _save(self, request: Any, response: Any) -> Any:
        name = request.name or self._own_name
        try:
            path = self._state.file(name)
            if path == self._state.file(self._own_name):
                fault = self._keep_now()
                if fault:
                    raise StateError(fault)
            else:
                self._state.save(name, self._tracker.parameters)
        except StateError as error:
            response.message = str(error)
            return response
        response.success = True
        response.message = f"saved {self._tracker.parameters.set_id} as {path}"
        return response

    def _load(self, request: Any, response: Any) -> Any:
        try:
            parameters = self._state.load(request.name or self._own_name)
            parameters.of_model(self._tracker.parameters.model)
        except (StateError, ParameterError) as error:
            response.message = str(error)
            return response
        self._send(at_once=True)
        self._pipeline.replace(parameters)
        return self._run_with_another(response)

    def _reset(self, request: Any, response: Any) -> Any:
        self._send(at_once=True)
        self._assembler.reset()
        self._pipeline.reset()
        self._last_report = None
        return self._run_with_another(response)

    def _run_with_another(self, response: Any) -> Any:
        """Keep and publish the set that a service has put in use, and answer."""
        fault = self._keep_now()
        parameters = self._tracker.parameters
        self._publish_parameters(parameters)
        response.success = True
        response.message = f"running with {parameters.set_id}" + (f"; {fault}" if fault else "")
        return response

    # Diagnostics

    def _window_finding(self) -> Finding:
        if self._assembler.waits_for_current:
            return Finding(
                WARN,
                "a window is full but waits for a supply current stamped at or after its end: is "
                "one published, with stamps on the clock of the samples?",
            )
        return Finding(OK, f"window {self._assembler.fill:.0%} full")

    def _fit_finding(self) -> Finding:
        report = self._last_report
        if report is None:
            return Finding(STALE, "no window has been fitted yet")
        values = {
            "NRMSE before": f"{report.nrmse_before:.4f}",
            "NRMSE after": f"{report.nrmse_after:.4f}",
            "force scale": f"{report.scale.value:.4f} ± {report.scale.standard_error:.4f}",
            "temperature from the force [°C]": (
                f"{report.fluid.celsius:.1f} ± {report.fluid.standard_error:.1f}"
            ),
            "accepted windows": self._tracker.accepted_windows,
            "operating points": self._tracker.reservoir.operating_points,
        }
        if report.verdict is Verdict.ACCEPTED_EARLY:
            return Finding(WARN, f"{report.reason} as {report.set_id}", values)
        if report.accepted:
            return Finding(OK, f"accepted as {report.set_id}", values)
        limit = self._options.acceptance.maximum_nrmse
        good = report.nrmse_before <= limit
        return Finding(OK if good else WARN, f"not accepted: {report.reason}", values)

    def _worker_finding(self) -> Finding:
        waiting, dropped = self._pipeline.waiting_windows, self._pipeline.dropped_windows
        values = {
            "waiting windows": waiting,
            "dropped windows": dropped,
            "replaced": self._worker.replaced,
            "process": self._worker.pid,
        }
        if dropped:
            return Finding(
                WARN,
                f"{dropped} windows were dropped: they come faster than they are fitted; "
                "raise hop or waiting_windows",
                values,
            )
        if not self._worker.ready:
            return Finding(OK, "the process is starting", values)
        return Finding(OK, self._pipeline.running or "idle", values)

    def _parameters_finding(self) -> Finding:
        parameters = self._tracker.parameters
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
        if self._tracker.accepted_windows == 0:
            return Finding(
                WARN, f"no window accepted yet: running with {parameters.set_id}", values
            )
        return Finding(OK, f"running with {parameters.set_id}", values)

    def _state_finding(self) -> Finding:
        fault = self._keeper.fault if self._keeper else ""
        if fault or self._set_aside:
            return Finding(ERROR, fault or self._set_aside)
        if not self._options.state_dir:
            return Finding(OK, "nothing is kept on disk: state_dir is not set")
        return Finding(OK, f"kept in {self._state.file(self._own_name)}")


def _state_directory(path: str) -> StateDirectory:
    try:
        return StateDirectory(path)
    except StateError as error:
        raise ConfigurationError(str(error)) from error


def _initial_set(source: str, model: str) -> ParameterSet:
    if source == "literature":
        return start_set(model)
    try:
        return read_parameter_file(source).of_model(model)
    except (StateError, ParameterError) as error:
        raise ConfigurationError(f"initial_parameters: {error}") from error


def main(worker: Worker) -> int:
    """Run the node, with a worker that the caller closes."""
    return run(partial(IdentifierNode, worker), IdentifierParameters)
