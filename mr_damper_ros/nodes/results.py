"""Between what is identified or predicted and its messages."""

from __future__ import annotations

import array
import math
from collections.abc import Iterable

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from mr_damper_msgs.msg import DamperParameters, FitReport, PredictedForce
from sensor_msgs.msg import Temperature
from std_msgs.msg import Header

from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet, check_name, known_model
from mr_damper_ros.nodes.messages import header, set_stamp, to_field, to_nanoseconds, to_stamp
from mr_damper_ros.tracking.prediction import Prediction
from mr_damper_ros.tracking.reports import Report


def parameters_message(parameters: ParameterSet, frame_id: str, node: str) -> DamperParameters:
    """The message of a parameter set, from the node of this fully qualified name."""
    return DamperParameters(
        header=header(parameters.stamp_ns, frame_id),
        id=parameters.set_id,
        model=parameters.model,
        names=list(parameters.law.parameter_names),
        units=list(parameters.law.units.values()),
        values=to_field(parameters.values),
        standard_errors=to_field(parameters.standard_errors),
        discrepancies=to_field(parameters.discrepancies),
        observable=parameters.observable.tolist(),
        source=parameters.source,
        node=node,
        peak_velocity_min=parameters.peak_velocity_range[0],
        peak_velocity_max=parameters.peak_velocity_range[1],
        current_min=parameters.current_range[0],
        current_max=parameters.current_range[1],
        nrmse=parameters.nrmse,
        largest_force=parameters.largest_force,
    )


def parameter_set(message: DamperParameters) -> ParameterSet:
    """The parameter set in a message.

    Raises ParameterError, with a sentence, where the message cannot be used.
    """
    law = known_model(message.model)
    check_name("name of the node", message.node)
    if tuple(message.names) != law.parameter_names:
        raise ParameterError(
            f"the parameters of model '{law.name}' must be {', '.join(law.parameter_names)}, "
            "in this order"
        )
    return ParameterSet(
        values=np.array(message.values),
        standard_errors=np.array(message.standard_errors),
        discrepancies=np.array(message.discrepancies or [math.nan] * len(law.parameter_names)),
        observable=np.array(message.observable, dtype=bool),
        set_id=message.id,
        source=message.source,
        peak_velocity_range=(message.peak_velocity_min, message.peak_velocity_max),
        current_range=(message.current_min, message.current_max),
        nrmse=message.nrmse,
        stamp_ns=to_nanoseconds(message.header.stamp),
        model=message.model,
        largest_force=message.largest_force,
    )


def report_message(report: Report, duration: float, frame_id: str, node: str) -> FitReport:
    """The message of a report; ``duration`` [s] is the time that the fit took."""
    return FitReport(
        header=header(report.stamp_ns, frame_id),
        window_start=to_stamp(report.window_start_ns),
        window_duration=(report.stamp_ns - report.window_start_ns) * 1e-9,
        samples=report.sample_count,
        method=report.method,
        evaluations=report.evaluations,
        duration=duration,
        nrmse_before=report.nrmse_before,
        nrmse_after=report.nrmse_after,
        verdict=report.verdict,
        accepted=report.accepted,
        confirms=report.confirms,
        reason=report.reason or "it predicts better than the set before",
        parameter_set=report.set_id,
        node=node,
        force_scale=report.scale.value,
        force_scale_standard_error=report.scale.standard_error,
        force_scale_discrepancy=report.scale.discrepancy,
        peak_velocity=report.peak_velocity,
        amplitude=report.amplitude,
        frequency=report.frequency,
        current=report.current,
        temperature=report.temperature,
        coefficient_names=list(report.coefficient_names),
        coefficients=to_field(report.coefficients),
        coefficient_standard_errors=to_field(report.coefficient_errors),
        coefficient_discrepancies=to_field(report.coefficient_discrepancies),
    )


def fluid_temperature_message(report: Report, frame_id: str) -> Temperature:
    """The message of the temperature that the force of a report's window tells."""
    return Temperature(
        header=header(report.stamp_ns, frame_id),
        temperature=report.fluid.celsius,
        variance=report.fluid.standard_error**2,
    )


def coefficients_message(report: Report, frame_id: str) -> DiagnosticArray:
    """The coefficients of a report as named numbers, for plotting tools."""
    errors = report.coefficient_errors
    named = zip(report.coefficient_names, report.coefficients, errors, strict=True)
    return _named_numbers("coefficients", report.set_id, report.stamp_ns, frame_id, named)


def parameter_numbers_message(parameters: ParameterSet, frame_id: str) -> DiagnosticArray:
    """The parameters of a set as named numbers, for plotting tools."""
    errors = np.where(parameters.observable, parameters.standard_errors, np.nan)
    named = zip(parameters.law.parameter_names, parameters.values, errors, strict=True)
    return _named_numbers("parameters", parameters.set_id, parameters.stamp_ns, frame_id, named)


def _named_numbers(
    kind: str,
    set_id: str,
    stamp_ns: int,
    frame_id: str,
    named: Iterable[tuple[str, float, float]],
) -> DiagnosticArray:
    """Plotting tools know this message: each of its pairs is a curve, called by its key.

    An error is called as its value, with ``_error`` after it; those that are not known are left
    out.
    """
    pairs = [pair for name, x, error in named for pair in ((name, x), (f"{name}_error", error))]
    status = DiagnosticStatus(
        level=DiagnosticStatus.OK,
        name=kind,
        message=set_id,
        values=[KeyValue(key=key, value=f"{x:.9g}") for key, x in pairs if np.isfinite(x)],
    )
    return DiagnosticArray(header=header(stamp_ns, frame_id), status=[status])


class PredictionMessage:
    """The message of the prediction for one block, always the same one: made anew it costs more."""

    def __init__(self, frame_id: str) -> None:
        self._message = PredictedForce(header=Header(frame_id=frame_id))

    def of(self, prediction: Prediction) -> PredictedForce:
        """Fill the message; it holds until the next call."""
        message = self._message
        set_stamp(message.header.stamp, prediction.start_ns)
        message.seq = prediction.sequence
        message.period = prediction.period
        message.force = to_field(prediction.force)
        message.parameter_set = prediction.set_id
        message.sample_doubts = array.array("B", prediction.doubts.tobytes())
        message.valid = prediction.valid
        message.doubt = int(prediction.doubt.kind)
        message.reason = prediction.reason
        return message
