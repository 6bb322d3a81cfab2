"""Node that predicts the damper's force, block by block, for controllers."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import partial

from mr_damper_msgs.msg import PredictedForce
from rclpy.node import Node

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Diagnostics, Finding
from mr_damper_ros.nodes.inputs import CURRENT_TOPIC, SAMPLES_TOPIC, Inputs
from mr_damper_ros.nodes.messages import PredictionMessage
from mr_damper_ros.nodes.mirrors import SignalMirror, WrenchMirror
from mr_damper_ros.nodes.node_parameters import NodeParameters
from mr_damper_ros.nodes.parameter_input import PARAMETERS_TOPIC, ParameterInput, SetOptions
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.processes.deferred import PostponedWork
from mr_damper_ros.processes.programs import HELP
from mr_damper_ros.settings.option_table import group, option
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.error_sums import RunningError
from mr_damper_ros.signals.uniform_grid import GridSettings
from mr_damper_ros.tracking.prediction import Prediction
from mr_damper_ros.tracking.predictor import ForcePredictor, PredictorSettings

_LATE = 0.8
"""Share of ``max_age`` from which on the forces of older samples would soon be invalid."""

_POOR_NRMSE, _BAD_NRMSE = 0.3, 0.6
"""Errors of valid forces over the last seconds that deserve a warning, and an error."""


@dataclass(frozen=True)
class ModelParameters(SetOptions):
    """Parameters of the model node.

    For every block on mts/samples it publishes the predicted force on damper/predicted_force, from
    the displacement, the supply current and the newest parameters. A force that should not be
    relied on is marked ``valid: false``, with the reason in words.
    """

    predictor: PredictorSettings = group(PredictorSettings, flat=True)
    newest_first: bool = option(
        True,
        "If live samples are so late that their forces would soon be outdated (max_age), skip "
        "to the newest: earlier blocks update the motion, their forces are not published, and "
        "the diagnostics count them (`latency`). Every block of a played recording is "
        "predicted.",
    )
    grid: GridSettings = group(GridSettings, flat=True)
    error_memory: float = option(
        10.0,
        "Averaging time [s] of the prediction error in the diagnostics.",
        minimum=0.1,
        maximum=3600.0,
    )
    wrench_rate: float = option(
        50.0,
        "Largest number of messages per second of data on damper/predicted_wrench "
        "(geometry_msgs/WrenchStamped), for standard tools: the last sample of each valid "
        "block; 0: none.",
        minimum=0.0,
        maximum=10_000.0,
    )
    signals_rate: float = option(
        100.0,
        "Largest number of messages per second of data on damper/signals (DamperSignals): "
        "displacement, velocity, current, measured and predicted force at one stamp, for "
        "plotting tools and for the page of the node live; 0: none. Increase it for motion "
        "faster than a few hertz.",
        minimum=0.0,
        maximum=10_000.0,
    )
    frame_id: str = option("damper", "Frame of the published forces, x along the damper's rod.")


class ModelNode(Node):
    """Publishes a prediction for every block of samples, valid or not."""

    def __init__(self, cli_args: list[str] | None = None) -> None:
        super().__init__("model", cli_args=cli_args)
        self._options = NodeParameters(self, ModelParameters).values
        self._predictor = ForcePredictor(self._options.predictor, self._options.grid)
        self._error = RunningError(self._options.error_memory)
        self._message = PredictionMessage(self._options.frame_id)
        self._last: Prediction | None = None
        self._slowest = 0.0
        self._oldest = math.nan
        self._skipped = 0
        self._rest = PostponedWork()
        self._force = quality.publisher(self, PredictedForce, "damper/predicted_force")
        self._wrench = WrenchMirror(self, self._options.wrench_rate, self._options.frame_id)
        self._signals = SignalMirror(
            self,
            self._options.signals_rate,
            self._options.frame_id,
            self._predictor.current_at,
        )
        self._parameter_input = ParameterInput(
            self,
            self._predictor.set_parameters,
            self._predictor,
            self._options,
            replaced=self._error.reset,
        )
        self._inputs = Inputs(self, quality.stream, self._take_block, self._predictor.add_current)
        self._diagnostics = Diagnostics(
            self,
            {
                "input": lambda: self._inputs.samples_finding(self._predictor.sequence),
                "current": self._inputs.current_finding,
                "parameters": lambda: self._parameter_input.finding("predicting"),
                "prediction": self._prediction_finding,
                "latency": self._latency_finding,
            },
        )

        file = self._options.parameter_file
        self.get_logger().info(
            f"waiting for {self.resolve_topic_name(SAMPLES_TOPIC)}, "
            f"{self.resolve_topic_name(CURRENT_TOPIC)} and "
            f"{self.resolve_topic_name(PARAMETERS_TOPIC)}"
            + (f"; until then the parameters are those of {file}" if file else "")
        )

    def _take_block(self, block: SampleBlock) -> None:
        began = time.perf_counter()
        self._rest.finish()
        now_ns = self.get_clock().now().nanoseconds
        late = _LATE * self._options.predictor.max_age
        if self._options.newest_first and self._predictor.freshness.are_older(
            block.end_ns, now_ns, late
        ):
            block, skipped = self._inputs.skip_to_newest(block, self._predictor.predict)
            self._skipped += skipped
            now_ns = self.get_clock().now().nanoseconds
        prediction = self._predictor.predict(block, now_ns)
        self._force.publish(self._message.of(prediction))
        self._rest.postpone(partial(self._finish, prediction, block))
        self._slowest = max(self._slowest, time.perf_counter() - began)
        age = self._predictor.freshness.age
        self._oldest = age if math.isnan(self._oldest) else max(self._oldest, age)

    def finish_in_time(self) -> float:
        """Do the rest of the work on the last block; see :class:`PostponedWork`."""
        return self._rest.finish_in_time()

    def _finish(self, prediction: Prediction, block: SampleBlock) -> None:
        """Do what a block needs besides its force."""
        self._last = prediction
        if prediction.continuity:
            self.get_logger().warning(prediction.continuity, throttle_duration_sec=10.0)
        self._signals.publish(prediction, block)
        measured = prediction.at_its_samples(block.force)
        if prediction.valid:
            self._error.add(prediction.force, measured, block.period)
        elif (valid := prediction.valid_samples).any():
            self._error.add(prediction.force[valid], measured[valid], block.period)
        if not prediction.newest_doubt:
            self._wrench.publish(prediction)
        self._predictor.catch_up()

    def _prediction_finding(self) -> Finding:
        nrmse = self._error.nrmse
        values = {"NRMSE": f"{nrmse:.4f}"}
        if self._last is None or self._inputs.silent:
            return Finding(STALE, "nothing to predict: no samples come", values)
        doubt = self._last.newest_doubt
        values["doubt"] = doubt.kind.name
        if doubt:
            return Finding(
                ERROR if doubt.kind.grave else WARN, f"not valid: {doubt.sentence}", values
            )
        if math.isnan(nrmse):
            return Finding(OK, "valid", values)
        level = ERROR if nrmse > _BAD_NRMSE else WARN if nrmse > _POOR_NRMSE else OK
        return Finding(level, f"valid; NRMSE {nrmse:.1%} of the measured force", values)

    def _latency_finding(self) -> Finding:
        slowest, self._slowest = self._slowest, 0.0
        oldest, self._oldest = self._oldest, math.nan
        skipped, self._skipped = self._skipped, 0
        if slowest == 0.0:
            return Finding(STALE, "no block since the last report")
        sentence = f"at most {1e3 * slowest:.2f} ms from a block to its prediction"
        if math.isnan(oldest):
            sentence += "; the stamps are not those of a running machine: no age is known"
        else:
            sentence += f"; the samples were up to {1e3 * oldest:.0f} ms old"
        if skipped:
            sentence += f"; {skipped} blocks have no force for newer ones had come: an overload?"
        limit = self._options.predictor.max_age
        late = skipped > 0 or (limit > 0.0 and oldest > limit)
        return Finding(
            WARN if late else OK,
            sentence,
            {
                "slowest [ms]": f"{1e3 * slowest:.3f}",
                "age [ms]": f"{1e3 * oldest:.1f}",
                "skipped blocks": skipped,
            },
        )


def main() -> int:
    """Run the node, or one in each of several namespaces."""
    return run(ModelNode, ModelParameters, between=ModelNode.finish_in_time, hosted=HELP)
