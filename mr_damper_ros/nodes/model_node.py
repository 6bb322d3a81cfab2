"""Node that predicts the force of the damper, block by block, for controllers."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass
from functools import partial

import numpy as np
from geometry_msgs.msg import Vector3, Wrench, WrenchStamped
from mr_damper_msgs.msg import DamperSignals, MtsSamples, PredictedForce
from std_msgs.msg import Header

from mr_damper_ros.nodes import messages, quality
from mr_damper_ros.nodes.block_node import BlockNode, SetOptions
from mr_damper_ros.nodes.diagnostics import ERROR, OK, STALE, WARN, Finding
from mr_damper_ros.nodes.inputs import CURRENT_TOPIC, SAMPLES_TOPIC
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.rig.blocks import Decimator
from mr_damper_ros.settings.option_table import group, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.signals.error_sums import RunningError
from mr_damper_ros.signals.uniform_grid import GridSettings
from mr_damper_ros.tracking.predictor import ForcePredictor, Prediction, PredictorSettings

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


class ModelNode(BlockNode[ModelParameters, Prediction]):
    """Publishes a prediction for every block of samples, valid or not."""

    answer, doing = "prediction", "predicting"

    def __init__(self) -> None:
        super().__init__("model", ModelParameters)
        options = self._options
        predictor = ForcePredictor(options.predictor, options.grid)
        if options.newest_first:
            # The force of an older block would soon be invalid.
            self._late = 0.8 * options.predictor.max_age
        self._error = RunningError(options.error_memory)
        self._message = PredictedForce(header=Header(frame_id=options.frame_id))
        self._last: Prediction | None = None
        self._force = quality.publisher(self, PredictedForce, "damper/predicted_force")
        self._signal_rate, self._wrench_rate = map(
            Decimator, (options.signals_rate, options.wrench_rate)
        )
        self._signal = DamperSignals(header=Header(frame_id=options.frame_id))
        self._signals = quality.publisher(self, DamperSignals, "damper/signals")
        self._wrench = quality.publisher(self, WrenchStamped, "damper/predicted_wrench")
        self._joined_samples = quality.publisher(self, MtsSamples, messages.JOINED_SAMPLES_TOPIC)
        self._joined_forces = quality.publisher(self, PredictedForce, messages.JOINED_FORCES_TOPIC)
        # First prediction of the joined block, and the arrays of its parts.
        self._first: Prediction | None = None
        self._parts: list[tuple[np.ndarray, ...]] = []
        self._listen(predictor)
        self._diagnose({"prediction": self._prediction_finding})
        file = options.parameter_file
        self.get_logger().info(
            f"waiting for {self.resolve_topic_name(SAMPLES_TOPIC)}, "
            f"{self.resolve_topic_name(CURRENT_TOPIC)} and "
            f"{self.resolve_topic_name(messages.PARAMETERS_TOPIC)}"
            + (f"; until then the parameters of {file} are used" if file else "")
        )

    def _publish_answer(self, block: SampleBlock, now_ns: int | None) -> Prediction:
        prediction = self._predictor.predict(block, now_ns)
        self._force.publish(messages.fill_prediction(self._message, prediction))
        return prediction

    def _finish(self, prediction: Prediction, block: SampleBlock) -> None:
        self._last = prediction
        if prediction.continuity:
            self.get_logger().warning(prediction.continuity, throttle_duration_sec=10.0)
        displacement, measured = map(prediction.at_its_samples, (block.displacement, block.force))
        # Messages without subscribers are not made; publishing them would take the same time.
        if self._signals.get_subscription_count():
            self._publish_signals(prediction, displacement, measured)
        if self._joined_samples.get_subscription_count():
            self._join(prediction, displacement, measured)
        else:
            self._first, self._parts = None, []
        valid = prediction.valid_samples
        if valid.any():
            self._error.add(prediction.force[valid], measured[valid], block.period)
        if not prediction.newest_doubt and self._wrench.get_subscription_count():
            self._publish_wrench(prediction)
        self._predictor.catch_up()

    def _publish_signals(
        self, prediction: Prediction, displacement: Array, measured: Array
    ) -> None:
        """Publish the samples of a block that are due, with their predicted force."""
        message = self._signal
        for k, stamp_ns in self._signal_rate.due(
            prediction.start_ns, prediction.period, prediction.force.size
        ):
            messages.set_stamp(message.header.stamp, stamp_ns)
            predicted = float(prediction.force[k])
            message.displacement = float(displacement[k])
            message.velocity = float(prediction.velocity[k])
            message.current = self._predictor.current_at(stamp_ns)
            message.measured_force = float(measured[k])
            message.predicted_force = predicted
            message.force_error = predicted - message.measured_force
            message.valid = not prediction.doubts[k]
            self._signals.publish(message)

    def _publish_wrench(self, prediction: Prediction) -> None:
        period = prediction.period
        last_ns = prediction.start_ns + round((prediction.force.size - 1) * period * NANOSECONDS)
        for _, stamp_ns in self._wrench_rate.due(last_ns, period, 1):
            wrench = Wrench(force=Vector3(x=float(prediction.force[-1])))
            stamped = messages.header(stamp_ns, self._options.frame_id)
            self._wrench.publish(WrenchStamped(header=stamped, wrench=wrench))

    def _join(self, prediction: Prediction, displacement: Array, measured: Array) -> None:
        """Add a block; publish what lasts for 0.1 s, or before a numbering gap.

        Its message costs hardly more than that of a small block.
        """
        count = sum(part[0].size for part in self._parts)
        if self._first is not None and prediction.sequence != self._first.sequence + count:
            self._publish_joined(self._first)
            count = 0
        self._first = self._first or prediction
        self._parts.append((displacement, measured, prediction.force, prediction.doubts))
        if (count + prediction.force.size) * prediction.period >= 0.1:
            self._publish_joined(self._first)

    def _publish_joined(self, first: Prediction) -> None:
        """Publish samples and forces as two messages with the same sequence number and stamp."""
        *joined, doubts = map(np.concatenate, zip(*self._parts, strict=True))
        self._first, self._parts = None, []
        common = {
            "header": messages.header(first.start_ns, self._options.frame_id),
            "seq": first.sequence,
            "period": first.period,
        }
        displacement, measured, predicted = map(messages.to_field, joined)
        self._joined_samples.publish(
            MtsSamples(**common, displacement=displacement, force=measured)
        )
        sample_doubts = array("B", doubts.astype(np.uint8).tobytes())
        self._joined_forces.publish(
            PredictedForce(**common, force=predicted, sample_doubts=sample_doubts)
        )

    def _prediction_finding(self) -> Finding:
        nrmse = self._error.nrmse
        values = {
            "NRMSE": f"{nrmse:.4f}",
            "zero of the load cell [N]": f"{self._predictor.zero:.1f}",
        }
        if self._last is None or self._inputs.samples.silent:
            return Finding(STALE, "nothing to predict: no samples arrive", values)
        doubt = self._last.newest_doubt or self._last.set_doubt
        values["doubt"] = doubt.kind.name
        if doubt:
            told = "not valid" if self._last.newest_doubt else "valid in part of the cycle"
            return Finding(ERROR if doubt.kind.grave else WARN, f"{told}: {doubt.sentence}", values)
        # Over a fraction of a cycle the measured force varies little, and its NRMSE says nothing.
        if math.isnan(nrmse) or self._error.duration < 0.5 * self._options.error_memory:
            return Finding(OK, "valid", values)
        level = ERROR if nrmse > _BAD_NRMSE else WARN if nrmse > _POOR_NRMSE else OK
        return Finding(level, f"valid; NRMSE {nrmse:.1%} of the measured force", values)


main = partial(run, ModelNode, ModelParameters, between=ModelNode.finish_in_time)
