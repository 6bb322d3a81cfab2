"""What a running system publishes, into the record that people see."""

from __future__ import annotations

import math
import struct

from diagnostic_msgs.msg import DiagnosticArray
from mr_damper_msgs.msg import DamperParameters, DamperSignals, FitReport
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Temperature

from mr_damper_ros.live.live_record import Concern, LiveRecord, SetSeen, WindowSeen
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import to_nanoseconds
from mr_damper_ros.nodes.signal_mirror import SIGNALS_TOPIC
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import Verdict

_WAITING = 50
"""Signals that may wait; then the oldest go. Nobody waits for whoever only looks."""

_SAME = (
    *("nrmse_before", "nrmse_after", "force_scale", "temperature", "current", "peak_velocity"),
    *("amplitude", "frequency"),
)
"""Figures of a window that are called as in FitReport."""


_HEAD = 4
"""Bytes of a serialised message before its fields: what their order is."""


def signals_in(data: bytes) -> tuple[float, ...]:
    """Time [s] and the numbers of serialised DamperSignals, in the order of the message.

    Plain CDR. rclpy's own way makes three objects of a message, a hundred times a second: half of
    what it costs to look.
    """
    order = "<" if data[1] & 1 else ">"
    seconds, nanoseconds, name_length = struct.unpack_from(f"{order}iII", data, _HEAD)
    before = 12 + name_length
    numbers = struct.unpack_from(f"{order}6d?", data, _HEAD + before + -before % 8)
    return (seconds + nanoseconds / NANOSECONDS, *numbers)


def listen(node: Node, record: LiveRecord) -> None:
    """Subscribe a node to all that is shown, in its namespace, and keep it in the record."""
    seen = _Ear(record, node.get_namespace().strip("/"))
    looking = QoSProfile(
        reliability=ReliabilityPolicy.BEST_EFFORT, history=HistoryPolicy.KEEP_LAST, depth=_WAITING
    )
    node.create_subscription(DamperSignals, SIGNALS_TOPIC, seen.signals, looking, raw=True)
    for kind, topic, hear, profile in (
        (DamperParameters, "damper/parameters", seen.parameters, quality.latched()),
        (Temperature, "damper/fluid_temperature", seen.temperature, quality.stream(_WAITING)),
        (FitReport, "damper/fit_report", seen.report, quality.stream(_WAITING)),
        (DiagnosticArray, "/diagnostics", seen.diagnostics, quality.stream(_WAITING)),
    ):
        node.create_subscription(kind, topic, hear, profile)


class _Ear:
    """Takes messages apart; ``namespace`` is that of the diagnostics to keep, empty for all."""

    def __init__(self, record: LiveRecord, namespace: str) -> None:
        self._record = record
        self._prefix = f"{namespace}/" if namespace else ""

    def signals(self, data: bytes) -> None:
        time_s, displacement, velocity, current, measured, predicted, _, valid = signals_in(data)
        self._record.add_signals(
            time_s, displacement, velocity, current, measured, predicted, valid=bool(valid)
        )

    def temperature(self, message: Temperature) -> None:
        self._record.add_fluid_temperature(message.temperature, message.variance**0.5)

    def report(self, message: FitReport) -> None:
        named = Verdict.__members__.values()
        verdict = next((item.name for item in named if item == message.verdict), "NOT_TOLD")
        self._record.add_window(
            WindowSeen(
                figures={
                    **{name: getattr(message, name) for name in _SAME},
                    "time": to_nanoseconds(message.header.stamp) / NANOSECONDS,
                    "force_scale_error": message.force_scale_standard_error,
                    "fit_duration": message.duration,
                    "verdict": float(message.verdict),
                },
                verdict=verdict,
                reason=message.reason,
                parameter_set=message.parameter_set,
                accepted=message.accepted,
                coefficients={
                    name: (value, error)
                    for name, value, error in zip(
                        message.coefficient_names,
                        message.coefficients,
                        message.coefficient_standard_errors,
                        strict=False,
                    )
                    if math.isfinite(value)
                },
            )
        )

    def parameters(self, message: DamperParameters) -> None:
        count = len(message.names)
        arrays = (message.values, message.standard_errors, message.observable, message.units)
        if any(len(array) != count for array in arrays):
            return
        self._record.set_parameters(
            SetSeen(
                time=to_nanoseconds(message.header.stamp) / NANOSECONDS,
                set_id=message.id,
                model=message.model,
                source=message.source,
                node=message.node,
                nrmse=message.nrmse,
                names=list(message.names),
                units=list(message.units),
                values=list(message.values),
                standard_errors=list(message.standard_errors),
                observable=list(message.observable),
                peak_velocity_range=(message.peak_velocity_min, message.peak_velocity_max),
                current_range=(message.current_min, message.current_max),
            )
        )

    def diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(self._prefix):
                self._record.add_concern(
                    Concern(
                        status.name.removeprefix(self._prefix),
                        int.from_bytes(status.level, "little"),
                        status.message,
                        {entry.key: entry.value for entry in status.values},
                    )
                )
