"""Analogue channels of a data acquisition device as a source, through the library of its vendor."""

from __future__ import annotations

import math
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from mr_damper_ros.data_check.findings import Finding, Kind
from mr_damper_ros.rig.blocks import Measured
from mr_damper_ros.rig.sources.device_source import (
    POLL,
    CountedRows,
    DeviceSource,
    Portion,
    Portions,
    Row,
    RowTimes,
    library,
)
from mr_damper_ros.settings.option_table import ParameterTable, groups, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS

MOST_READ = 10_000
"""Largest number of readings per channel in one read."""

BUFFERED = 10.0
"""Length of the driver's buffer [s], for a busy computer."""


class Readings(NamedTuple):
    """``values`` (channels, n) [V], in the order of the channels, at a sample ``rate`` [Hz]."""

    values: Array
    rate: float


@dataclass(frozen=True)
class Driver:
    """Reads channels through a library: a Python module, and the packages to install for it.

    ``what`` is the name in messages for a device without a name.
    """

    read: Callable[[Any, DaqOptions], Portions[Readings]]
    module: str = ""
    install: str = ""
    what: str = ""

    def connector(self, given: DaqOptions) -> Callable[[], Portions[Readings]]:
        """A function that connects to the channels; raises ValueError if the library is missing."""
        module = library(self.module, "daq.driver", self.install) if self.module else None
        return partial(self.read, module, given)


def _national_instruments(nidaqmx: Any, given: DaqOptions) -> Portions[Readings]:
    """One task with all channels, through nidaqmx and the driver NI-DAQmx."""
    constants = nidaqmx.constants
    wiring = constants.TerminalConfiguration
    with nidaqmx.Task() as task:
        for each in given.used.values():
            task.ai_channels.add_ai_voltage_chan(
                f"{given.device}/{each.channel}",
                terminal_config=wiring.DIFF if given.differential else wiring.RSE,
                min_val=-each.range,
                max_val=each.range,
            )
        task.timing.cfg_samp_clk_timing(
            given.rate,
            sample_mode=constants.AcquisitionType.CONTINUOUS,
            samps_per_chan=round(BUFFERED * given.rate),
        )
        rate = float(task.timing.samp_clk_rate)
        readers = import_module("nidaqmx.stream_readers")
        reader = readers.AnalogMultiChannelReader(task.in_stream)
        task.start()
        yield None
        while True:
            ready = min(int(task.in_stream.avail_samp_per_chan), MOST_READ)
            if ready == 0:
                yield None
                continue
            values = np.empty((len(given.used), ready))
            taken = reader.read_many_sample(values, ready, POLL)
            yield Readings(values[:, :taken], rate)


_SINGLE_ENDED = 199
"""LJM's number for ground as the negative input of a channel."""

_MISSED = -9999.0
"""Value that a LabJack gives in place of a skipped sample."""


def _labjack(ljm: Any, given: DaqOptions) -> Portions[Readings]:
    """The stream of a T4, T7 or T8, through labjack-ljm and LabJack's library LJM."""
    names = given.names
    with ExitStack() as stack:
        try:
            handle = ljm.openS("ANY", "ANY", given.device or "ANY")
        except AttributeError:  # without the library, the module has no functions
            raise OSError("LabJack's library LJM is not installed") from None
        stack.callback(ljm.close, handle)
        settings: dict[str, float] = {}
        for each in given.used.values():
            name = each.channel
            settings[f"{name}_RANGE"] = each.range
            # The negative input of a differential channel is the next channel.
            number = int("".join(filter(str.isdigit, name)) or 0)
            negative = number + 1 if given.differential else _SINGLE_ENDED
            settings[f"{name}_NEGATIVE_CH"] = negative
        ljm.eWriteNames(handle, len(settings), list(settings), list(settings.values()))
        ljm.writeLibraryConfigS(
            ljm.constants.STREAM_SCANS_RETURN, ljm.constants.STREAM_SCANS_RETURN_ALL_OR_NONE
        )
        addresses = ljm.namesToAddresses(len(names), names)[0]
        unknown = ljm.constants.INVALID_NAME_ADDRESS
        if unknown in addresses:
            name = names[addresses.index(unknown)]
            raise OSError(f"it has no channel {name}: the channels are AIN0, AIN1 and so on")
        scans = max(round(given.rate / 50.0), 1)
        rate = float(ljm.eStreamStart(handle, scans, len(names), addresses, given.rate))
        stack.callback(ljm.eStreamStop, handle)
        yield None
        while True:
            try:
                values, _, _ = ljm.eStreamRead(handle)
            except ljm.LJMError as error:
                if error.errorCode != ljm.errorcodes.NO_SCANS_RETURNED:
                    raise
                yield None
                continue
            found = np.array(values, dtype=np.float64).reshape(-1, len(names)).T
            yield Readings(np.where(found == _MISSED, np.nan, found), rate)


def _measurement_computing(uldaq: Any, given: DaqOptions) -> Portions[Readings]:
    """An endless scan over the channels from the lowest to the highest, through uldaq."""
    found = uldaq.get_daq_device_inventory(uldaq.InterfaceType.ANY)
    named = [each for each in found if given.device in ("", each.unique_id, str(each))]
    if not named:
        known = ", ".join(f"{each} ({each.unique_id})" for each in found) or "none at all"
        raise OSError(f"there is no such device; found: {known}")
    with ExitStack() as stack:
        device = uldaq.DaqDevice(named[0])
        stack.callback(device.release)
        device.connect()
        stack.callback(device.disconnect)
        inputs = device.get_ai_device()
        if inputs is None or not inputs.get_info().has_pacer():
            raise OSError("it has no analogue inputs that its own clock can sample")
        modes = uldaq.AiInputMode
        mode = modes.DIFFERENTIAL if given.differential else modes.SINGLE_ENDED
        numbers = [int(name) for name in given.names]
        low, high = min(numbers), max(numbers)
        count = inputs.get_info().get_num_chans_by_mode(mode)
        if high >= count:
            wiring = "wired differentially" if given.differential else "wired to ground"
            raise OSError(f"it has no channel {high}: {count} channels can be {wiring}")
        span = _mcc_range(
            inputs.get_info().get_ranges(mode), max(each.range for each in given.used.values())
        )
        held = max(round(BUFFERED * given.rate), 1)
        buffer = uldaq.create_float_buffer(high - low + 1, held)
        values = np.frombuffer(buffer).reshape(held, high - low + 1)
        wanted = [number - low for number in numbers]
        option, flags = uldaq.ScanOption.CONTINUOUS, uldaq.AInScanFlag.DEFAULT
        stack.callback(inputs.scan_stop)
        rate = float(
            inputs.a_in_scan(low, high, mode, span, held, given.rate, option, flags, buffer)
        )
        taken = 0
        yield None
        while True:
            status, transfer = inputs.get_scan_status()
            ready = int(transfer.current_scan_count) - taken
            if ready > held:
                raise OSError("it has overwritten samples that were not yet read")
            if ready <= 0:
                if status != uldaq.ScanStatus.RUNNING:
                    raise OSError("it has stopped sampling")
                yield None
                continue
            ready = min(ready, MOST_READ)
            rows = np.arange(taken, taken + ready) % held
            taken += ready
            yield Readings(values[rows][:, wanted].T, rate)


def _mcc_range(ranges: Any, wanted: float) -> Any:
    """The smallest range of the device that includes ±``wanted`` [V]; raises OSError."""
    fitting = {}
    for each in ranges:
        match = re.fullmatch(r"BIP(\d*)(?:PT(\d+))?VOLTS", each.name)
        if match:
            fitting[float(f"{match[1] or 0}.{match[2] or 0}")] = each
    able = [volts for volts in fitting if volts >= wanted * (1.0 - 1e-9)]
    if not able:
        known = ", ".join(f"±{volts:g} V" for volts in sorted(fitting)) or "none below zero"
        raise OSError(f"it has no range of ±{wanted:g} V; its ranges: {known}")
    return fitting[min(able)]


def _simulated(_: Any, given: DaqOptions) -> Portions[Readings]:
    """Displacement of 5 V and force of 7 V at 1 Hz, current of 1.5 V, each clipped at its range."""
    limits = np.array([[each.range] for each in given.used.values()])
    began, taken = time.monotonic(), 0
    while True:
        yield None
        until = math.floor((time.monotonic() - began) * given.rate)
        phase = 2.0 * math.pi * np.arange(taken, until) / given.rate
        taken = until
        force = 7.0 * np.tanh(3.0 * np.cos(phase))
        volts: Array = np.stack([5.0 * np.sin(phase), force, np.full(phase.size, 1.5)])
        yield Readings(np.clip(volts, -limits, limits), given.rate) if phase.size else None


DRIVERS = {
    "simulated": Driver(_simulated),
    "nidaqmx": Driver(
        _national_instruments, "nidaqmx", "nidaqmx==1.7.0, and NI's own driver NI-DAQmx"
    ),
    "labjack": Driver(
        _labjack, "labjack.ljm", "labjack-ljm==1.23.0, and LabJack's own library LJM", "the LabJack"
    ),
    "mcc": Driver(
        _measurement_computing,
        "uldaq",
        "uldaq==1.2.3, and MCC's own library UL for Linux (libuldaq)",
        "the MCC device",
    ),
}
"""Drivers by the value of the option ``driver``."""


_QUANTITIES = ("displacement", "force", "current")
_MISSING = "without a value"

SATURATED = "at the end of its range"
"""Suffix after the name of a channel in the keys of :meth:`Source.state`: a sample count."""

_FULL = 0.999
"""Fraction of the range above which a channel counts as saturated."""


@dataclass(frozen=True)
class ChannelOptions(ParameterTable):
    """The channel of one quantity."""

    channel: str = option(
        "",
        "Channel of the displacement, force or coil current: ai0 of NI, AIN0 of LabJack, 0 of MCC. "
        "The current may have none.",
    )
    scale: float = option(
        1.0,
        "Scale of the displacement [m/V], force [N/V] or current [A/V]; a negative value reverses "
        "the sign.",
    )
    offset: float = option(
        0.0, "Offset added to the scaled displacement [m], force [N] or current [A]."
    )
    range: float = option(
        10.0,
        "Range of the channel, plus and minus this [V]; clipped samples are omitted.",
        within=(1e-6, 1e12),
    )


@dataclass(frozen=True)
class DaqOptions(ParameterTable):
    """The device of ``source: daq``."""

    driver: str = option(
        "simulated",
        "Driver: nidaqmx (National Instruments), labjack (T4, T7, T8), mcc (Measurement "
        "Computing) or simulated.",
        choices=tuple(DRIVERS),
    )
    device: str = option(
        "",
        "Device: Dev1 of NI; a serial number, name or address of LabJack; name or number of "
        "MCC (empty: the only one).",
    )
    rate: float = option(1000.0, "Requested sample rate [Hz].", within=(1.0, 100_000.0))
    differential: bool = option(
        True,
        "Whether the channels are wired differentially instead of to ground.",
    )
    channels: dict[str, ChannelOptions] = groups(
        {name: (f"{name}_", ChannelOptions) for name in _QUANTITIES}
    )

    def objection(self) -> str:
        """Return the reason if an option is missing or invalid, or an empty string."""
        if self.driver == "nidaqmx" and not self.device:
            return "daq.driver is nidaqmx, but daq.device is empty: name the device, such as Dev1"
        for name, each in self.channels.items():
            if each.scale == 0.0:
                return f"daq.{name}_scale is 0: give the {name} per volt"
            if not each.channel and name != "current" and self.driver != "simulated":
                return f"daq.{name}_channel is empty: name the channel of the {name}"
            if self.driver == "mcc" and each.channel and not each.channel.isdigit():
                return f"MCC has no channel '{each.channel}': they are called 0, 1 and so on"
        return ""

    @property
    def used(self) -> dict[str, ChannelOptions]:
        """The channels in use, by quantity."""
        simulated = self.driver == "simulated"
        return {name: each for name, each in self.channels.items() if simulated or each.channel}

    @property
    def names(self) -> list[str]:
        """The names of the channels in use."""
        return [each.channel for each in self.used.values()]


class DaqSource(DeviceSource[Readings]):
    """Samples of analogue channels; the source reconnects to a lost device."""

    options = DaqOptions
    prefix = "daq."

    def open(self) -> list[str]:
        """Load the library; the connection is made when the streaming starts."""
        given: DaqOptions = self.settings
        driver = DRIVERS[given.driver]
        self._connect = driver.connector(given)
        self._name = given.device or driver.what
        self.sender = f"{given.driver} {given.device}".strip()
        self.counted = (*(f"{name} {SATURATED}" for name in given.used), _MISSING)
        return [
            f"{given.driver} {given.device}: "
            + ", ".join(f"{k} from {each.channel or 'a sine'}" for k, each in given.used.items())
        ]

    def _new_times(self, data: Readings) -> RowTimes:
        return CountedRows(data.rate, checks_rate=False)

    def _rows(self, portion: Portion[Readings], *, begins: bool) -> Iterator[tuple[Row, int]]:
        """Convert readings to units and times; the last one was taken at the arrival."""
        values, rate = portion.data
        count = values.shape[1]
        ago = (count - 1 - np.arange(count)) / rate
        taken = portion.arrival_ns - np.round(ago * NANOSECONDS).astype(np.int64)
        rows = self._in_units(values).T.tolist()
        for taken_ns, row in zip(taken.tolist(), rows, strict=True):
            yield Row(Measured(*row), None, None), taken_ns

    def _in_units(self, volts: Array) -> Array:
        """The channels in units, shape (3, n); NaN if a value is missing or saturated."""
        channels = np.full((len(_QUANTITIES), volts.shape[1]), math.nan)
        for (name, each), values in zip(self.settings.used.items(), volts, strict=True):
            known = np.isfinite(values)
            full = known & (np.abs(values) >= _FULL * each.range)
            self._counts[f"{name} {SATURATED}"] += int(np.count_nonzero(full))
            self._counts[_MISSING] += int(np.count_nonzero(~known))
            sound = known & ~full
            channels[_QUANTITIES.index(name)] = np.where(
                sound, each.scale * values + each.offset, math.nan
            )
        return channels

    def _finding_of(self, counts: Counter[str]) -> Finding | None:
        for name, each in self.settings.used.items():
            if count := counts[f"{name} {SATURATED}"]:
                how = f" {SATURATED} of {each.range:g} V, and {count} samples were omitted"
                return Kind.CLIPPED.found(name, value=count, how=how)
        if counts[_MISSING]:
            return Kind.NOT_FINITE.found("samples", count=counts[_MISSING])
        return None
