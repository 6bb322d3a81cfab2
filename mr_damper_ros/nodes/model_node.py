"""Node that predicts the force of the damper, block by block, for controllers."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from mr_damper_msgs.msg import DamperSignals, MtsSamples, PredictedForce
from rclpy.node import Node
from std_msgs.msg import Header

from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.block_node import BlockNode, SetOptions
from mr_damper_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Finding
from mr_damper_ros.nodes.inputs import CURRENT_TOPIC, SAMPLES_TOPIC
from mr_damper_ros.nodes.messages import (
    JOINED_FORCES_TOPIC,
    JOINED_SAMPLES_TOPIC,
    PARAMETERS_TOPIC,
    fill_prediction,
    header,
    set_stamp,
    to_field,
)
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.rig.blocks import Decimator
from mr_damper_ros.settings.option_table import group, option
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.signals.error_sums import RunningError
from mr_damper_ros.signals.uniform_grid import GridSettings
from mr_damper_ros.tracking.predictor import ForcePredictor, Prediction, PredictorSettings

_LATE = 0.8
"""A block older than this fraction of ``max_age`` is skipped if a newer one waits, because its
force would soon be invalid."""

_POOR_NRMSE, _BAD_NRMSE = 0.3, 0.6
"""NRMSE of valid forces over the last seconds above which there is a warning, or an error."""


@dataclass(frozen=True)
class ModelParameters(SetOptions):
    """Parameters of the model node.

    For every block on mts/samples it publishes the predicted force on damper/predicted_force, from
    the displacement, the supply current and the newest parameters. An unreliable force is marked
    ``valid: false``, with the reason in words.
    """

    predictor: PredictorSettings = group(PredictorSettings, flat=True)
    newest_first: bool = option(
        True,
        "Whether to skip to the newest block if live samples are so late that their forces would "
        "soon be outdated (max_age). Skipped blocks update the motion, but their forces are not "
        "published, and the diagnostics count them (`latency`). Every block of a played "
        "recording is predicted.",
    )
    grid: GridSettings = group(GridSettings, flat=True)
    wrench_rate: float = option(
        50.0,
        "Largest number of messages per second of data on damper/predicted_wrench "
        "(geometry_msgs/WrenchStamped), for standard tools: the last sample of each valid "
        "block; 0: none.",
        within=(0.0, 10_000.0),
    )
    signals_rate: float = option(
        100.0,
        "Largest number of messages per second of data on damper/signals (DamperSignals): "
        "displacement, velocity, current, measured and predicted force at one stamp, for "
        "plotting tools; 0: none. Increase it for motion faster than a few hertz.",
        within=(0.0, 10_000.0),
    )
    frame_id: str = option("damper", "Frame of the published forces, x along the damper's rod.")


class SignalMirror:
    """Publishes measured and predicted force of the same samples, if there are subscribers.

    ``rate`` is the largest number of samples per second of data; with 0 nothing is published.
    ``current_at`` returns the current [A] at a stamp [ns].
    """

    def __init__(
        self, node: Node, rate: float, frame_id: str, current_at: Callable[[int], float]
    ) -> None:
        self._decimator = Decimator(rate)
        self._current_at = current_at
        self._message = DamperSignals(header=Header(frame_id=frame_id))
        self._publisher = quality.publisher(node, DamperSignals, "damper/signals")

    def publish(self, prediction: Prediction, block: SampleBlock) -> None:
        """Publish the samples of a block that are due; only samples with a prediction are used."""
        if not quality.has_subscribers(self._publisher):
            return
        message = self._message
        displacement, measured = map(prediction.at_its_samples, (block.displacement, block.force))
        for k, stamp_ns in self._decimator.due(
            prediction.start_ns, prediction.period, prediction.force.size
        ):
            set_stamp(message.header.stamp, stamp_ns)
            predicted = float(prediction.force[k])
            message.displacement = float(displacement[k])
            message.velocity = float(prediction.velocity[k])
            message.current = self._current_at(stamp_ns)
            message.measured_force = float(measured[k])
            message.predicted_force = predicted
            message.force_error = predicted - message.measured_force
            message.valid = not prediction.doubts[k]
            self._publisher.publish(message)


_JOINED = 0.1
"""Duration [s] of a joined block."""


class JoinedMirror:
    """Publishes all samples and their predicted force in larger blocks, if there are subscribers.

    The cost of a message hardly depends on its number of samples. Every 0.1 s of data gives two
    messages with the same sequence number and stamp.
    """

    def __init__(self, node: Node, frame_id: str) -> None:
        self._frame_id = frame_id
        self._samples = quality.publisher(node, MtsSamples, JOINED_SAMPLES_TOPIC)
        self._forces = quality.publisher(node, PredictedForce, JOINED_FORCES_TOPIC)
        self._first: Prediction | None = None
        self._parts: list[tuple[np.ndarray, ...]] = []

    def publish(self, prediction: Prediction, block: SampleBlock) -> None:
        """Add a block; publish when the joined block is complete, or before a numbering gap."""
        if not quality.has_subscribers(self._samples):
            self._first, self._parts = None, []
            return
        count = sum(part[0].size for part in self._parts)
        if self._first is not None and prediction.sequence != self._first.sequence + count:
            self._send(self._first)
            count = 0
        self._first = self._first or prediction
        displacement, force = map(prediction.at_its_samples, (block.displacement, block.force))
        self._parts.append((displacement, force, prediction.force, prediction.doubts))
        if (count + prediction.force.size) * prediction.period >= _JOINED:
            self._send(self._first)

    def _send(self, first: Prediction) -> None:
        joined = map(np.concatenate, zip(*self._parts, strict=True))
        displacement, measured, predicted, doubts = joined
        self._first, self._parts = None, []
        stamped = header(first.start_ns, self._frame_id)
        self._samples.publish(
            MtsSamples(
                header=stamped,
                seq=first.sequence,
                period=first.period,
                displacement=to_field(displacement),
                force=to_field(measured),
            )
        )
        self._forces.publish(
            PredictedForce(
                header=stamped,
                seq=first.sequence,
                period=first.period,
                force=to_field(predicted),
                sample_doubts=array("B", doubts.astype(np.uint8).tobytes()),
            )
        )


class WrenchMirror:
    """Publishes the last force of valid blocks as a wrench, at most ``rate`` per second of data."""

    def __init__(self, node: Node, rate: float, frame_id: str) -> None:
        self._decimator = Decimator(rate)
        self._frame_id = frame_id
        self._publisher = quality.publisher(node, WrenchStamped, "damper/predicted_wrench")

    def publish(self, prediction: Prediction) -> None:
        """Publish the last sample of a block, if it is due and there are subscribers."""
        if not quality.has_subscribers(self._publisher):
            return
        period = prediction.period
        last_ns = prediction.start_ns + round((prediction.force.size - 1) * period * NANOSECONDS)
        for _, stamp_ns in self._decimator.due(last_ns, period, 1):
            wrench = Wrench(force=Vector3(x=float(prediction.force[-1])))
            stamped = header(stamp_ns, self._frame_id)
            self._publisher.publish(WrenchStamped(header=stamped, wrench=wrench))


class ModelNode(BlockNode[ModelParameters, Prediction]):
    """Publishes a prediction for every block of samples, valid or not."""

    answer, doing = "prediction", "predicting"

    def __init__(self, cli_args: list[str] | None = None) -> None:
        super().__init__("model", ModelParameters, cli_args)
        options = self._options
        predictor = ForcePredictor(options.predictor, options.grid)
        if options.newest_first:
            self._late = _LATE * options.predictor.max_age
        self._error = RunningError(options.error_memory)
        self._message = PredictedForce(header=Header(frame_id=options.frame_id))
        self._last: Prediction | None = None
        self._force = quality.publisher(self, PredictedForce, "damper/predicted_force")
        self._wrench = WrenchMirror(self, options.wrench_rate, options.frame_id)
        self._joined = JoinedMirror(self, options.frame_id)
        self._signals = SignalMirror(
            self, options.signals_rate, options.frame_id, predictor.current_at
        )
        self._listen(predictor, options.predictor.max_age, self._error)
        self._diagnose({"prediction": self._prediction_finding})
        file = options.parameter_file
        self.get_logger().info(
            f"waiting for {self.resolve_topic_name(SAMPLES_TOPIC)}, "
            f"{self.resolve_topic_name(CURRENT_TOPIC)} and "
            f"{self.resolve_topic_name(PARAMETERS_TOPIC)}"
            + (f"; until then the parameters of {file} are used" if file else "")
        )

    def _publish_answer(self, block: SampleBlock, now_ns: int) -> Prediction:
        prediction = self._predictor.predict(block, now_ns)
        self._force.publish(fill_prediction(self._message, prediction))
        return prediction

    def _finish(self, prediction: Prediction, block: SampleBlock) -> None:
        self._last = prediction
        if prediction.continuity:
            self.get_logger().warning(prediction.continuity, throttle_duration_sec=10.0)
        self._signals.publish(prediction, block)
        self._joined.publish(prediction, block)
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
            return Finding(STALE, "nothing to predict: no samples arrive", values)
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


def main() -> int:
    """Run the node, or one in each of several namespaces."""
    return run(ModelNode, ModelParameters, between=ModelNode.finish_in_time, hosted=True)
