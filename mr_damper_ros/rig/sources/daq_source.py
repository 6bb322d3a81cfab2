"""Analogue channels of a data acquisition device as a source."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.rig.blocks import Measured
from mr_damper_ros.rig.sources.analog_input import DRIVERS, AnalogChannels, Readings
from mr_damper_ros.rig.sources.device_source import DeviceSource, Portion
from mr_damper_ros.rig.sources.row_times import CountedRows, StampedRows, TimedSample
from mr_damper_ros.rig.sources.rows import Row
from mr_damper_ros.rig.sources.source import SourceState, StreamSettings
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock
from mr_damper_ros.signals.clocks import CountedTimes

_QUANTITIES = ("displacement", "force", "current")

SATURATED = "at the end of its range"
"""Suffix after the name of a channel in the keys of :meth:`Source.state`: a sample count."""

_FULL = 0.999
"""Fraction of the range above which a channel counts as saturated."""


def _scale(name: str, unit: str) -> float:
    return option(  # type: ignore[no-any-return]
        1.0, f"Scale of the {name} [{unit}/V]; a negative value reverses the sign."
    )


def _offset(name: str, unit: str) -> float:
    return option(0.0, f"Offset added to the scaled {name} [{unit}].")  # type: ignore[no-any-return]


def _range(name: str) -> float:
    return option(  # type: ignore[no-any-return]
        10.0,
        f"Range of the {name} channel, plus and minus this [V]; clipped samples are omitted.",
        within=(1e-6, 1e12),
    )


@dataclass(frozen=True)
class DaqOptions(ParameterTable):
    """The device of ``source: daq``."""

    driver: str = option(
        "simulated",
        "Driver: nidaqmx (National Instruments), labjack (T4, T7, T8), mcc (Measurement "
        "Computing), lsl (a stream of the lab streaming layer), or simulated.",
        choices=tuple(DRIVERS),
    )
    device: str = option(
        "",
        "Device: Dev1 of NI; a serial number, name or address of LabJack; name or number of "
        "MCC (empty: the only one); the name of an LSL stream.",
    )
    rate: float = option(
        1000.0,
        "Requested sample rate [Hz]; an LSL stream has its own.",
        within=(1.0, 100_000.0),
    )
    differential: bool = option(
        True,
        "Whether channels of NI, LabJack and MCC are wired differentially instead of to ground.",
    )
    displacement_channel: str = option(
        "",
        "Channel of the displacement: ai0 of NI, AIN0 of LabJack, 0 of MCC, label or number of "
        "LSL.",
    )
    displacement_scale: float = _scale("displacement", "m")
    displacement_offset: float = _offset("displacement", "m")
    displacement_range: float = _range("displacement")
    force_channel: str = option("", "Channel of the force.")
    force_scale: float = _scale("force", "N")
    force_offset: float = _offset("force", "N")
    force_range: float = _range("force")
    current_channel: str = option("", "Channel of the coil current; empty: none.")
    current_scale: float = _scale("current", "A")
    current_offset: float = _offset("current", "A")
    current_range: float = _range("current")

    def objection(self) -> str:
        """Return the reason if an option is missing or invalid, or an empty string."""
        if self.driver in ("nidaqmx", "lsl") and not self.device:
            what = "the device, such as Dev1" if self.driver == "nidaqmx" else "the LSL stream"
            return f"daq.driver is {self.driver}, but daq.device is empty: name {what}"
        for name in _QUANTITIES:
            if getattr(self, f"{name}_scale") == 0.0:
                return f"daq.{name}_scale is 0: give the {name} per volt"
            needed = name != "current" and self.driver != "simulated"
            channel = getattr(self, f"{name}_channel")
            if needed and not channel:
                return f"daq.{name}_channel is empty: name the channel of the {name}"
            if self.driver == "mcc" and channel and not channel.isdigit():
                return f"MCC has no channel '{channel}': they are called 0, 1 and so on"
        return ""


class DaqSource(DeviceSource[Readings]):
    """Samples of analogue channels; the source reconnects to a lost device."""

    options = DaqOptions
    prefix = "daq."

    def __init__(self, settings: DaqOptions, stream: StreamSettings) -> None:
        super().__init__(settings, stream)
        # Number of saturated samples by channel: in total, and at the last report.
        self._saturated: dict[str, int] = {}
        self._reported: dict[str, int] = {}
        self._missing = 0

    @property
    def _wanted(self) -> list[str]:
        """The quantities with a channel."""
        given = self.settings
        return [
            name for name in _QUANTITIES
            if given.driver == "simulated" or getattr(given, f"{name}_channel")
        ]  # fmt: skip

    def open(self) -> list[str]:
        """Load the library; the connection is made when the streaming starts."""
        given: DaqOptions = self.settings
        wanted = self._wanted
        channels = AnalogChannels(
            given.device,
            tuple(getattr(given, f"{name}_channel") for name in wanted),
            tuple(getattr(given, f"{name}_range") for name in wanted),
            given.rate,
            given.differential,
        )
        driver = DRIVERS[given.driver]
        self._connect = driver.connector(channels)
        self._name = given.device or driver.what
        places = zip(wanted, channels.names, strict=True)
        return [
            f"{given.driver} {given.device}: "
            + ", ".join(f"{name} from {channel or 'a sine'}" for name, channel in places)
        ]

    def blocks(self, start_ns: int) -> Iterator[RigBlock]:
        """Yield the samples as the device takes them."""
        self._saturated = dict.fromkeys(self._wanted, 0)
        self._reported = dict(self._saturated)
        self._missing = 0
        self._times = None
        return self._read(self._connect, self._name, start_ns)

    def state(self) -> SourceState:
        """The state of the device, and the number of saturated samples by channel."""
        reader = self._reader
        if reader is None:
            return SourceState("", {})
        values: dict[str, object] = {
            "connections": reader.connections,
            **{f"{name} {SATURATED}": n for name, n in self._saturated.items()},
            "without a value": self._missing,
            **(self._times.values() if self._times is not None else {}),
        }
        return SourceState(self._fault(reader.fault), values)

    def _samples(self, portion: Portion[Readings], *, begins: bool) -> Iterator[TimedSample | None]:
        """Convert readings to units and times; the last one was taken at the arrival."""
        values, rate, stamps = portion.data
        if self._times is None:
            self._times = (
                CountedRows(CountedTimes(rate, checks_rate=False))
                if stamps is None
                else StampedRows(1.0)
            )
        count = values.shape[1]
        channels = self._in_units(values)
        ago = (count - 1 - np.arange(count)) / rate if rate > 0.0 else np.zeros(count)
        taken = portion.arrival_ns - np.round(ago * NANOSECONDS).astype(np.int64)
        stamped = [None] * count if stamps is None else stamps.tolist()
        for stamp, taken_ns, row in zip(stamped, taken.tolist(), channels.T.tolist(), strict=True):
            for sample in self._times.add(Row(Measured(*row), None, stamp), taken_ns):
                # Unusable samples are also numbered, so that they count as missing.
                yield sample if sample.measured.possible else None

    def _in_units(self, volts: Array) -> Array:
        """The channels in units, shape (3, n); NaN if a value is missing or saturated."""
        channels = np.full((len(_QUANTITIES), volts.shape[1]), math.nan)
        for name, values in zip(self._wanted, volts, strict=True):
            scale, offset, limit = (
                getattr(self.settings, f"{name}_{what}") for what in ("scale", "offset", "range")
            )
            known = np.isfinite(values)
            full = known & (np.abs(values) >= _FULL * limit)
            self._saturated[name] += int(np.count_nonzero(full))
            self._missing += int(np.count_nonzero(~known))
            sound = known & ~full
            channels[_QUANTITIES.index(name)] = np.where(sound, scale * values + offset, math.nan)
        return channels

    def _fault(self, of_device: str) -> str:
        """The present fault, as a sentence; empty without a fault."""
        reported, self._reported = self._reported, dict(self._saturated)
        if of_device:
            return of_device
        if self._silent:
            return f"no samples arrive from {self.settings.driver} {self.settings.device}"
        for name, count in self._reported.items():
            new = count - reported[name]
            if new:
                limit = getattr(self.settings, f"{name}_range")
                return f"the {name} is {SATURATED} of {limit:g} V: {new} samples of it were omitted"
        return ""
