"""Replay of a bag through the engine into the record of the live page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mr_damper_ros.io.bag_files import opened_bag
from mr_damper_ros.io.bag_reader import bag_stream
from mr_damper_ros.live.live_record import LiveRecord, SetSeen, WindowSeen
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.signals.recording import CurrentReading, StreamItem
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from mr_damper_ros.tracking.predictor import Prediction
from mr_damper_ros.tracking.reports import Report
from mr_damper_ros.tracking.validity import DoubtKind

_RATE = 100.0
"""Rate of the signals [1/s], equal to that of the model node."""

_SET_POINTS = (
    ("/supply/current_command", "mr_damper_msgs/msg/CurrentCommand", "current_command", "current"),
    ("/damper/desired_force", "mr_damper_msgs/msg/DesiredForce", "desired_force", "force"),
)
"""Topic, message type, name in the record, and field of the message."""

_MOST_SIGNALS = 1_000_000
"""Capacity of the table ``signals``, almost three hours."""


def title_of(path: Path) -> str:
    """Name, operator, note and file name of a recording."""
    with opened_bag(path) as bag:
        told = [bag.details.get(key, "") for key in ("name", "operator", "note")]
    return ", ".join(dict.fromkeys([*filter(None, told), path.name]))


def start_of(path: Path) -> ParameterSet | None:
    """The set in use at the start of the recording; None if the bag does not contain it."""
    with opened_bag(path) as bag:
        text = bag.details.get("start_set", "")
    return ParameterSet.from_yaml(text) if text else None


def empty_record(path: Path) -> LiveRecord:
    """A record with room for the signals of a bag, for :func:`replay_into`; raises BagError."""
    return LiveRecord(recorded=title_of(path), signals_kept=_MOST_SIGNALS)


def replay_into(
    record: LiveRecord,
    path: Path,
    start: ParameterSet | None = None,
    settings: EngineSettings | None = None,
) -> None:
    """Replay a bag into a record, with the same results as the live identifier and model.

    Without ``start``, the initial set is the set in use at the start of the recording. Raises
    BagError or ParameterError if the bag or the set cannot be used.
    """
    start = start or start_of(path)
    if start is not None and settings is None:
        settings = EngineSettings().for_law(start.model)
    engine = Engine(settings, start)
    if start is not None:
        record.set_parameters(_set_seen(start, 0.0))
    held = _Held(_set_points(path))
    for block, prediction in engine.follow(held.currents_of(bag_stream(path))):
        _show(record, block, prediction, held)
        _show_publications(record, engine)
    _show_publications(record, engine)


def _show_publications(record: LiveRecord, engine: Engine) -> None:
    for published in engine.take_publications():
        report = published.report
        record.add_window(_window_seen(report, published.duration))
        if published.parameters is not None:
            seen = _set_seen(published.parameters, report.stamp_ns / NANOSECONDS)
            record.set_parameters(seen)


class _Held:
    """The current and the setpoints at a sample."""

    def __init__(self, set_points: dict[str, list[tuple[int, float]]]) -> None:
        self._waiting = {name: iter(values) for name, values in set_points.items()}
        self._next = {name: next(values, None) for name, values in self._waiting.items()}
        self.current = math.nan

    def currents_of(self, stream: Iterator[StreamItem]) -> Iterator[StreamItem]:
        """Yield the items of the stream; ``current`` holds the last current [A]."""
        for item in stream:
            if isinstance(item, CurrentReading):
                self.current = item.current
            yield item

    def follow(self, record: LiveRecord, stamp_ns: int) -> None:
        """Pass the setpoints up to this stamp [ns] to the record."""
        for name, values in self._waiting.items():
            while (found := self._next[name]) is not None and found[0] <= stamp_ns:
                record.set_point(name, found[1])
                self._next[name] = next(values, None)


def _set_points(path: Path) -> dict[str, list[tuple[int, float]]]:
    found: dict[str, list[tuple[int, float]]] = {}
    with opened_bag(path) as bag:
        fields = {
            bag.topic(topic, kind, required=False): (name, field)
            for topic, kind, name, field in _SET_POINTS
        }
        fields.pop("", None)
        for topic, message in bag.decoded(set(fields)) if fields else ():
            name, field = fields[topic]
            stamp = message.header.stamp
            stamp_ns = int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
            found.setdefault(name, []).append((stamp_ns, float(getattr(message, field))))
    return found


def _show(record: LiveRecord, block: SampleBlock, prediction: Prediction, held: _Held) -> None:
    count, period = prediction.force.size, prediction.period
    arrived = slice(block.sample_count - count, None)
    displacement, measured = block.displacement[arrived], block.force[arrived]
    valid = prediction.doubts == DoubtKind.NONE
    start = prediction.start_ns / NANOSECONDS
    record.add_samples(start, period, displacement, measured, prediction.force, valid)
    times = start + period * np.arange(count)
    ticks = np.floor(times * _RATE + 1e-6)
    for k in np.flatnonzero(np.diff(ticks, prepend=np.floor((start - period) * _RATE + 1e-6))):
        held.follow(record, prediction.start_ns + round(k * period * NANOSECONDS))
        record.add_signals(
            float(times[k]),
            float(displacement[k]),
            float(prediction.velocity[k]),
            held.current,
            float(measured[k]),
            float(prediction.force[k]),
            valid=bool(valid[k]),
        )


def _window_seen(report: Report, duration: float) -> WindowSeen:
    coefficients = zip(
        report.coefficient_names,
        report.coefficients.tolist(),
        report.coefficient_errors.tolist(),
        strict=True,
    )
    return WindowSeen(
        figures={
            "time": report.stamp_ns / NANOSECONDS,
            "nrmse_before": report.nrmse_before,
            "nrmse_after": report.nrmse_after,
            "force_scale": report.scale.value,
            "force_scale_error": report.scale.standard_error,
            "temperature": report.temperature,
            "fluid_temperature": report.fluid.celsius,
            "fluid_temperature_error": report.fluid.standard_error,
            "current": report.current,
            "peak_velocity": report.peak_velocity,
            "amplitude": report.amplitude,
            "frequency": report.frequency,
            "fit_duration": duration,
            "verdict": float(report.verdict),
        },
        verdict=report.verdict.name,
        reason=report.reason,
        parameter_set=report.set_id,
        accepted=report.accepted,
        coefficients={
            n: (value, error) for n, value, error in coefficients if math.isfinite(value)
        },
    )


def _set_seen(found: ParameterSet, since: float) -> SetSeen:
    return SetSeen(
        time=since,
        set_id=found.set_id,
        model=found.model,
        source=str(found.source),
        node="",
        nrmse=found.nrmse,
        names=found.law.parameter_names,
        units=[parameter.unit for parameter in found.law.parameters],
        values=found.values.tolist(),
        standard_errors=found.standard_errors.tolist(),
        observable=found.observable.tolist(),
        peak_velocity_range=found.peak_velocity_range,
        current_range=found.current_range,
    )
