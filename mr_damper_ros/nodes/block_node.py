"""Base class of model and controller, which answer each block at once with the newest set."""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Generic, TypeVar

import numpy as np
from mr_damper_msgs.msg import DamperParameters, FitReport
from rclpy.node import Node

from mr_damper_ros.data_check.stream_watch import listed
from mr_damper_ros.models.parameter_set import ParameterError
from mr_damper_ros.models.plausibility import check_plausible
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Diagnostics, Finding
from mr_damper_ros.nodes.inputs import Inputs
from mr_damper_ros.nodes.messages import (
    PARAMETERS_TOPIC,
    REPORT_TOPIC,
    SHOWN,
    parameter_set,
    report_of,
)
from mr_damper_ros.nodes.node_parameters import NodeParameters
from mr_damper_ros.nodes.rclpy_internals import NodeClock
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.tracking.predictor import ForcePredictor
from mr_damper_ros.tracking.state_directory import StateError, read_parameter_file


@dataclass(frozen=True)
class SetOptions(ParameterTable):
    """Options that choose the parameter set of a node and judge its force."""

    parameter_file: str = option(
        "",
        'Parameter file (YAML) to use; "": none. A set from an identifier replaces the file once '
        "the set covers all currents of the file, or once the force of the file is wrong; the "
        "start set of an identifier never replaces it. Give the identifier the same file as "
        "initial_parameters. With a file no identifier is needed.",
    )
    error_memory: float = option(
        10.0,
        "Averaging time [s] of the error of the force in the diagnostics; the model judges the "
        "error once half of this time has passed with valid force.",
        within=(0.1, 3600.0),
    )


Options = TypeVar("Options", bound=SetOptions)
Answer = TypeVar("Answer")


class BlockNode(Node, Generic[Options, Answer]):
    """Publishes an answer to each block at once, and completes the remaining work afterwards.

    If a block is older than :attr:`_late` [s] and newer blocks wait, the node answers only the
    newest one. The predictor also processes the skipped blocks, but the node does not answer them.
    """

    answer: ClassVar[str]
    """Word for the answer in messages, such as "prediction"."""

    doing: ClassVar[str]
    """Word for the use of the parameter set in messages, such as "predicting"."""

    def __init__(self, name: str, table: type[Options]) -> None:
        super().__init__(name)
        self._options: Options = NodeParameters(self, table).values
        self._age_clock = NodeClock(self)
        # The remaining work on the newest block, and when it is due.
        self._work: Callable[[], None] | None = None
        self._due = math.inf
        self._late = math.inf
        self._slowest, self._oldest, self._skipped = 0.0, math.nan, 0

    def _listen(self, predictor: ForcePredictor) -> None:
        """Subscribe to samples, currents, sets and reports, and pass them to the predictor.

        Raises ValueError if the parameter file is invalid.
        """
        self._predictor = predictor
        self._refused = self._given = ""
        self._from = file = self._options.parameter_file
        if file:
            try:
                given = check_plausible(read_parameter_file(file))
            except (StateError, ParameterError) as problem:
                raise ValueError(f"parameter_file: {problem}") from problem
            self._given = given.set_id
            predictor.set_parameters(given)
        self.create_subscription(
            DamperParameters, PARAMETERS_TOPIC, self._take_set, quality.latched()
        )
        quality.subscription(self, FitReport, REPORT_TOPIC, self._take_report, quality.newest())
        self._inputs = Inputs(self, quality.stream, self._take_block, predictor.add_current)

    def _diagnose(self, concerns: dict[str, Callable[[], Finding]]) -> None:
        """Report on these concerns, and on the concerns of all block nodes."""
        self._diagnostics = Diagnostics(
            self,
            {
                "input": lambda: self._inputs.samples_finding(self._predictor.sequence),
                "current": self._inputs.current_finding,
                "parameters": self._set_finding,
                **concerns,
                "latency": self._latency_finding,
            },
            self._inputs.stream_findings,
        )

    def _take_set(self, message: DamperParameters) -> None:
        self._refused = ""
        try:
            parameters = check_plausible(parameter_set(message))
        except ParameterError as error:
            self._refused = str(error)
            self.get_logger().warning(f"parameters {message.id[:SHOWN]} are not used: {error}")
            return
        self._from = message.node or "a node that does not state its name"
        before = self._predictor.parameters
        self._predictor.follow_set(parameters)
        if self._predictor.parameters is not before:
            self.get_logger().debug(f"using parameters {parameters.set_id}")

    def _take_report(self, message: FitReport) -> None:
        self._predictor.follow_report(report_of(message))

    def _set_finding(self) -> Finding:
        parameters, file = self._predictor.parameters, self._options.parameter_file
        publishers = quality.publishing_nodes(self, PARAMETERS_TOPIC)
        if len(publishers) > 1:
            several = f"{PARAMETERS_TOPIC} is published by {listed(publishers)}"
            return Finding(ERROR, f"{several}: stop all but one")
        if self._refused:
            return Finding(WARN, f"the newest parameters are not used: {self._refused}")
        if parameters is None:
            return Finding(
                WARN,
                "no parameters yet: start the identifier in this namespace, or give parameter_file",
            )
        return Finding(
            OK,
            f"{self.doing} with {parameters.set_id}",
            {
                "id": parameters.set_id,
                "model": parameters.model,
                "source": parameters.source,
                "from": file if parameters.set_id == self._given else self._from,
                "peak velocity [m/s]": "{:.4g} to {:.4g}".format(*parameters.peak_velocity_range),
                "current [A]": "{:.4g} to {:.4g}".format(*parameters.current_range),
            },
        )

    @abstractmethod
    def _publish_answer(self, block: SampleBlock, now_ns: int | None) -> Answer:
        """Publish the answer to a block at a time [ns] as in :meth:`_now_ns`, and return it."""

    @abstractmethod
    def _finish(self, answer: Answer, block: SampleBlock) -> None:
        """Complete the remaining work on a block after its answer."""

    def _now_ns(self) -> int | None:
        """Time [ns] from which the age of samples follows, by a clock that is never set.

        Simulated time gives no age: it runs at the rate of a replay, and its messages have no
        common order with the samples. Every block is then answered.
        """
        return None if self._age_clock.is_simulated else self._age_clock.now_ns()

    def _take_block(self, block: SampleBlock) -> None:
        began = time.perf_counter()
        self._finish_work()
        present_ns = self._now_ns()
        freshness = self._predictor.freshness
        if freshness.are_older(block.end_ns, present_ns, self._late):
            predict = partial(self._predictor.predict, now_ns=present_ns)
            block, skipped = self._inputs.skip_to_newest(block, predict)
            self._skipped += skipped
            present_ns = self._now_ns()
        answer = self._publish_answer(block, present_ns)
        self._work = partial(self._finish, answer, block)
        # The subscribers of the answer run first if they share a core with this process.
        self._due = time.perf_counter() + 1e-3
        self._slowest = max(self._slowest, time.perf_counter() - began)
        self._oldest = float(np.fmax(self._oldest, freshness.age))

    def _finish_work(self) -> None:
        work, self._work, self._due = self._work, None, math.inf
        if work is not None:
            work()

    def finish_in_time(self) -> float:
        """Complete the remaining work if it is due; returns the time [s] until it is."""
        if self._due <= time.perf_counter():
            self._finish_work()
        return max(self._due - time.perf_counter(), 0.0)

    def _latency_finding(self) -> Finding:
        slowest, oldest, skipped = self._slowest, self._oldest, self._skipped
        self._slowest, self._oldest, self._skipped = 0.0, math.nan, 0
        if slowest == 0.0:
            return Finding(STALE, "no block since the last report")
        sentence = f"at most {1e3 * slowest:.2f} ms from a block to its {self.answer}"
        if math.isnan(oldest):
            sentence += "; the stamps are not from a live machine, so the age is unknown"
        else:
            sentence += f"; the samples were up to {1e3 * oldest:.0f} ms old"
        if skipped:
            sentence += f"; {skipped} blocks have no {self.answer}, because newer ones had "
            sentence += "arrived: is the computer overloaded?"
        late = skipped > 0 or oldest > self._predictor.freshness.max_age
        return Finding(
            WARN if late else OK,
            sentence,
            {
                "slowest [ms]": f"{1e3 * slowest:.3f}",
                "age [ms]": f"{1e3 * oldest:.1f}",
                "skipped blocks": skipped,
            },
        )
