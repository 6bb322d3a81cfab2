"""Base class of model and controller, which answer each block at once with the newest set."""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import ClassVar, Generic, TypeVar

import numpy as np
from rclpy.node import Node

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import OK, STALE, WARN, Diagnostics, Finding
from mr_damper_ros.nodes.inputs import Inputs
from mr_damper_ros.nodes.node_parameters import NodeParameters
from mr_damper_ros.nodes.parameter_input import ParameterInput, SetOptions
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.error_sums import RunningError
from mr_damper_ros.tracking.predictor import ForcePredictor

_WORK_DELAY = 1e-3
"""Delay [s] of the remaining work after publishing, so that the subscribers of the answer run first
if they share a core with this process."""

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

    def __init__(self, name: str, table: type[Options], cli_args: list[str] | None = None) -> None:
        super().__init__(name, cli_args=cli_args)
        self._options: Options = NodeParameters(self, table).values
        # The remaining work on the newest block, and when it is due.
        self._work: Callable[[], None] | None = None
        self._due = math.inf
        self._late = math.inf
        self._slowest, self._oldest, self._skipped = 0.0, math.nan, 0

    def _listen(
        self,
        predictor: ForcePredictor,
        max_age: float,
        error: RunningError | None = None,
    ) -> None:
        """Subscribe to samples, currents and sets, and pass them to the predictor.

        The diagnostics warn of samples older than ``max_age`` [s]; 0 allows any age. A new set
        resets the ``error`` of the diagnostics.
        """
        self._predictor = predictor
        self._max_age = max_age
        self._parameter_input = ParameterInput(
            self, predictor.set_parameters, predictor, self._options, error
        )
        self._inputs = Inputs(self, quality.stream, self._take_block, predictor.add_current)

    def _diagnose(self, concerns: dict[str, Callable[[], Finding]]) -> None:
        """Report on these concerns, and on the concerns of all block nodes."""
        self._diagnostics = Diagnostics(
            self,
            {
                "input": lambda: self._inputs.samples_finding(self._predictor.sequence),
                "current": self._inputs.current_finding,
                "parameters": lambda: self._parameter_input.finding(self.doing),
                **concerns,
                "latency": self._latency_finding,
            },
        )

    @abstractmethod
    def _publish_answer(self, block: SampleBlock, now_ns: int) -> Answer:
        """Publish the answer to a block at the node's time [ns], and return it."""

    @abstractmethod
    def _finish(self, answer: Answer, block: SampleBlock) -> None:
        """Complete the remaining work on a block after its answer."""

    def _take_block(self, block: SampleBlock) -> None:
        began = time.perf_counter()
        self._finish_work()
        now_ns = self.get_clock().now().nanoseconds
        freshness = self._predictor.freshness
        if freshness.are_older(block.end_ns, now_ns, self._late):
            block, skipped = self._inputs.skip_to_newest(block, self._predictor.predict)
            self._skipped += skipped
            now_ns = self.get_clock().now().nanoseconds
        answer = self._publish_answer(block, now_ns)
        self._work = partial(self._finish, answer, block)
        self._due = time.perf_counter() + _WORK_DELAY
        self._slowest = max(self._slowest, time.perf_counter() - began)
        self._oldest = float(np.fmax(self._oldest, freshness.age))

    def _finish_work(self) -> None:
        work, self._work = self._work, None
        if work is not None:
            work()

    def finish_in_time(self) -> float:
        """Complete the remaining work if it is due; returns the time [s] until it is."""
        left = math.inf if self._work is None else self._due - time.perf_counter()
        if left > 0.0:
            return left
        self._finish_work()
        return math.inf

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
        late = skipped > 0 or (self._max_age > 0.0 and oldest > self._max_age)
        return Finding(
            WARN if late else OK,
            sentence,
            {
                "slowest [ms]": f"{1e3 * slowest:.3f}",
                "age [ms]": f"{1e3 * oldest:.1f}",
                "skipped blocks": skipped,
            },
        )
