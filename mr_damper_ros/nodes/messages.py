"""Converts between messages and the core types: arrays, stamps, parameter sets, reports."""

from __future__ import annotations

import array
import math
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from mr_damper_msgs.msg import (
    DamperParameters,
    FitReport,
    MtsSamples,
    PredictedForce,
    SupplyCurrent,
)
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import Header

from mr_damper_ros.models.domain import Origin
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet, check_name, known_model
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import (
    NANOSECONDS,
    BlockError,
    RigBlock,
    SampleBlock,
    SuspensionState,
    check_live,
    fits_a_stamp,
)
from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.force_scale import ForceScale
from mr_damper_ros.tracking.predictor import Prediction
from mr_damper_ros.tracking.reports import Report

PARAMETERS_TOPIC, REPORT_TOPIC = "damper/parameters", "damper/fit_report"
JOINED_SAMPLES_TOPIC, JOINED_FORCES_TOPIC = "damper/joined_samples", "damper/joined_forces"
SUSPENSION_TOPIC = "suspension/motion"

SHOWN = 100
"""Shown characters of a name: a message may hold a megabyte of them."""


def to_stamp(nanoseconds: int) -> Time:
    """A stamp from nanoseconds since the epoch; raises ValueError if a stamp cannot hold it."""
    stamp = Time()
    set_stamp(stamp, nanoseconds)
    return stamp


def set_stamp(stamp: Time, nanoseconds: int) -> None:
    """Set a stamp to nanoseconds since the epoch; raises ValueError like :func:`to_stamp`."""
    if not fits_a_stamp(nanoseconds):
        raise ValueError(f"{nanoseconds} ns is not a time that a stamp can hold")
    stamp.sec, stamp.nanosec = divmod(nanoseconds, NANOSECONDS)


def to_nanoseconds(stamp: Time) -> int:
    """Nanoseconds since the epoch from a stamp."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def header(nanoseconds: int, frame_id: str) -> Header:
    """A header with this stamp."""
    return Header(stamp=to_stamp(nanoseconds), frame_id=frame_id)


def to_field(values: Array) -> array.array[float]:
    """A value for a ``float64[]`` field; about 200 times faster than assigning the ndarray."""
    return array.array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


def from_field(field: array.array[float]) -> Array:
    """The values of a ``float64[]`` field as a view without copying; do not write to it."""
    return np.frombuffer(field, dtype=np.float64)


def samples_message(block: SampleBlock | RigBlock, frame_id: str) -> MtsSamples:
    """The message for a block; it holds displacement and force, but no other channels."""
    return MtsSamples(
        header=header(block.start_ns, frame_id),
        seq=block.sequence,
        period=block.period,
        displacement=to_field(block.displacement),
        force=to_field(block.force),
    )


def sample_block(message: MtsSamples) -> SampleBlock:
    """The block in a message; raises BlockError, with a sentence, if it is invalid."""
    block = SampleBlock(
        start_ns=to_nanoseconds(message.header.stamp),
        sequence=message.seq,
        period=message.period,
        displacement=from_field(message.displacement),
        force=from_field(message.force),
    )
    check_live(block)
    if not fits_a_stamp(block.end_ns):
        raise BlockError(
            "the block ends after the last time that a stamp can hold, in January 2038: is the "
            "clock of its source right?"
        )
    return block


def current_message(stamp_ns: int, current: float, frame_id: str) -> SupplyCurrent:
    """The message for one value of the supply current [A]."""
    return SupplyCurrent(header=header(stamp_ns, frame_id), current=current)


BODY, WHEEL, SUSPENSION, TYRE = "body", "wheel", "suspension", "tyre"
"""Names of the joints that describe the motion of a suspension."""


def suspension_message(now: SuspensionState, stamped: Header) -> JointState:
    """The state of a suspension as joint states; a value that a joint does not have is NaN."""
    return JointState(
        header=stamped,
        name=[BODY, WHEEL, SUSPENSION, TYRE],
        position=[math.nan, math.nan, now.stroke, now.tyre],
        velocity=[now.body, now.wheel, now.extension, math.nan],
    )


def suspension_state(message: JointState, acceleration: float) -> SuspensionState:
    """The suspension state in a message, with this ``acceleration`` of the body [m/s²].

    Raises ValueError if body or wheel have no velocity.
    """
    velocity = dict(zip(message.name, message.velocity, strict=False))
    position = dict(zip(message.name, message.position, strict=False))
    missing = [name for name in (BODY, WHEEL) if not math.isfinite(velocity.get(name, math.nan))]
    if missing:
        raise ValueError(f"the motion has no velocity of the joint {' and '.join(missing)}")
    return SuspensionState(
        velocity[BODY],
        velocity[WHEEL],
        acceleration,
        position.get(SUSPENSION, math.nan),
        position.get(TYRE, math.nan),
    )


_OF_A_SET = ("model", "source", "nrmse", "largest_force")
_ARRAYS_OF_A_SET = ("values", "standard_errors", "discrepancies")
"""Names of the fields that the message and the set share."""


def parameters_message(parameters: ParameterSet, frame_id: str, node: str) -> DamperParameters:
    """The message for a parameter set, from the node of this fully qualified name."""
    low, high = zip(parameters.peak_velocity_range, parameters.current_range, strict=True)
    held = parameters.dependence_range or (0.0, 0.0)
    return DamperParameters(
        header=header(parameters.stamp_ns, frame_id),
        id=parameters.set_id,
        names=list(parameters.law.parameter_names),
        units=list(parameters.law.units.values()),
        observable=parameters.observable.tolist(),
        origin=int(parameters.origin),
        node=node,
        peak_velocity_min=low[0],
        peak_velocity_max=high[0],
        held_velocity_min=held[0],
        held_velocity_max=held[1],
        current_min=low[1],
        current_max=high[1],
        **{name: getattr(parameters, name) for name in _OF_A_SET},
        **{name: to_field(getattr(parameters, name)) for name in _ARRAYS_OF_A_SET},
    )


def _origin(number: int) -> Origin:
    """The origin with this number; raises ParameterError if there is none."""
    try:
        return Origin(number)
    except ValueError as error:
        raise ParameterError(
            f"the origin of the parameters is {number}: the origins are 0 to {max(Origin)}"
        ) from error


def parameter_set(message: DamperParameters) -> ParameterSet:
    """The parameter set in a message.

    Raises ParameterError, with a sentence, if the message is invalid.
    """
    law = known_model(message.model)
    check_name("name of the node", message.node)
    if tuple(message.names) != law.parameter_names:
        raise ParameterError(
            f"the parameters of model '{law.name}' must be {', '.join(law.parameter_names)}, "
            "in this order"
        )
    arrays: dict[str, Any] = {name: np.array(getattr(message, name)) for name in _ARRAYS_OF_A_SET}
    held = message.held_velocity_min, message.held_velocity_max
    return ParameterSet(
        set_id=message.id,
        stamp_ns=to_nanoseconds(message.header.stamp),
        observable=np.array(message.observable, dtype=bool),
        origin=_origin(message.origin),
        peak_velocity_range=(message.peak_velocity_min, message.peak_velocity_max),
        dependence_range=held if any(held) else None,
        current_range=(message.current_min, message.current_max),
        **{name: getattr(message, name) for name in _OF_A_SET},
        **arrays,
    )


_OF_A_REPORT = (
    *("method", "evaluations", "nrmse_before", "nrmse_after", "confirms", "peak_velocity"),
    *("amplitude", "frequency", "current", "temperature", "current_lag", "current_lag_error"),
)
"""Names of the fields that the message and the report share."""


def report_message(report: Report, duration: float, frame_id: str, node: str) -> FitReport:
    """The message for a report; ``duration`` [s] is the computing time of the fit."""
    return FitReport(
        header=header(report.stamp_ns, frame_id),
        window_start=to_stamp(report.window_start_ns),
        window_duration=(report.stamp_ns - report.window_start_ns) * 1e-9,
        samples=report.sample_count,
        duration=duration,
        verdict=report.verdict,
        accepted=report.accepted,
        reason=report.reason or "it predicts better than the previous set",
        parameter_set=report.set_id,
        node=node,
        force_scale=report.scale.value,
        force_scale_standard_error=report.scale.standard_error,
        force_scale_discrepancy=report.scale.discrepancy,
        coefficient_names=list(report.coefficient_names),
        coefficients=to_field(report.coefficients),
        coefficient_standard_errors=to_field(report.coefficient_errors),
        coefficient_discrepancies=to_field(report.coefficient_discrepancies),
        **{name: getattr(report, name) for name in _OF_A_REPORT},
    )


def report_of(message: FitReport) -> Report:
    """The report in a message; a verdict of an unknown number becomes UNKNOWN."""
    return Report(
        window_start_ns=to_nanoseconds(message.window_start),
        stamp_ns=to_nanoseconds(message.header.stamp),
        sample_count=message.samples,
        verdict={int(each): each for each in Verdict}.get(message.verdict, Verdict.UNKNOWN),
        reason=message.reason,
        set_id=message.parameter_set,
        scale=ForceScale(
            message.force_scale,
            message.force_scale_standard_error,
            discrepancy=message.force_scale_discrepancy,
        ),
        coefficient_names=tuple(message.coefficient_names),
        coefficients=from_field(message.coefficients),
        coefficient_errors=from_field(message.coefficient_standard_errors),
        coefficient_discrepancies=from_field(message.coefficient_discrepancies),
        **{name: getattr(message, name) for name in _OF_A_REPORT},
    )


def fluid_temperature_message(report: Report, frame_id: str) -> Temperature:
    """The message for the fluid temperature estimated from the force of a window."""
    return Temperature(
        header=header(report.stamp_ns, frame_id),
        temperature=report.fluid.celsius,
        variance=report.fluid.standard_error**2,
    )


def numbers_message(found: Report | ParameterSet, frame_id: str) -> DiagnosticArray:
    """The coefficients of a report or the parameters of a set as named numbers.

    Plotting tools show the key-value pairs of a status as curves, each named by its key. The key of
    a standard error is the name of its value with ``_error`` appended. Values that are not finite
    are omitted.
    """
    if isinstance(found, Report):
        kind, named = "coefficients", found.known_coefficients
    else:
        kind, named = "parameters", found.known_parameters
    status = DiagnosticStatus(level=DiagnosticStatus.OK, name=kind, message=found.set_id)
    for name, (value, error) in named.items():
        for key, number in ((name, value), (f"{name}_error", error)):
            if math.isfinite(number):
                status.values.append(KeyValue(key=key, value=f"{number:.9g}"))
    return DiagnosticArray(header=header(found.stamp_ns, frame_id), status=[status])


def fill_prediction(message: PredictedForce, prediction: Prediction) -> PredictedForce:
    """Fill the message with the prediction of a block; a new message would take longer."""
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
