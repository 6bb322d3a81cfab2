"""Data acquisition devices: channels, readings, and the libraries of the vendors."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from mr_damper_ros.rig.sources.device_source import POLL, SILENCE, Portions
from mr_damper_ros.signals.arrays import Array

MOST_READ = 10_000
"""Largest number of readings per channel in one read."""

BUFFERED = 10.0
"""Length of the driver's buffer [s], for a busy computer."""


class Readings(NamedTuple):
    """``values`` (channels, n) [V], in the order of the channels, at a sample ``rate`` [Hz].

    If the device gives ``stamps`` (n,) [s], by any clock, ``rate`` has no meaning.
    """

    values: Array
    rate: float
    stamps: Array | None = None


@dataclass(frozen=True)
class AnalogChannels:
    """The requested channels of a ``device``, each from -range to +range [V]."""

    device: str
    names: tuple[str, ...]
    ranges: tuple[float, ...]
    rate: float
    differential: bool


@dataclass(frozen=True)
class Driver:
    """Reads channels through a library: a Python module, and the packages to install for it.

    ``what`` is the name in messages for a device without a name.
    """

    read: Callable[[Any, AnalogChannels], Portions[Readings]]
    module: str = ""
    install: str = ""
    what: str = ""

    def connector(self, channels: AnalogChannels) -> Callable[[], Portions[Readings]]:
        """A function that connects to the channels; raises ValueError if the library is missing."""
        library = None
        if self.module:
            try:
                library = import_module(self.module)
            except (ImportError, OSError, RuntimeError) as error:
                raise ValueError(
                    f"the library of daq.driver, {self.module}, is not installed: pip install "
                    f"{self.install} ({error})"
                ) from error
        return partial(self.read, library, channels)


def _national_instruments(library: Any, channels: AnalogChannels) -> Portions[Readings]:
    """One task with all channels, through nidaqmx and the driver NI-DAQmx."""
    constants = library.constants
    wiring = constants.TerminalConfiguration
    with library.Task() as task:
        for name, limit in zip(channels.names, channels.ranges, strict=True):
            task.ai_channels.add_ai_voltage_chan(
                f"{channels.device}/{name}",
                terminal_config=wiring.DIFF if channels.differential else wiring.RSE,
                min_val=-limit,
                max_val=limit,
            )
        task.timing.cfg_samp_clk_timing(
            channels.rate,
            sample_mode=constants.AcquisitionType.CONTINUOUS,
            samps_per_chan=round(BUFFERED * channels.rate),
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
            values = np.empty((len(channels.names), ready))
            taken = reader.read_many_sample(values, ready, POLL)
            yield Readings(values[:, :taken], rate)


_SINGLE_ENDED = 199
"""LJM's number for ground as the negative input of a channel."""

_MISSED = -9999.0
"""Value that a LabJack gives in place of a skipped sample."""


def _labjack(ljm: Any, channels: AnalogChannels) -> Portions[Readings]:
    """The stream of a T4, T7 or T8, through labjack-ljm and LabJack's library LJM."""
    names = list(channels.names)
    with ExitStack() as stack:
        try:
            handle = ljm.openS("ANY", "ANY", channels.device or "ANY")
        except AttributeError:  # without the library, the module has no functions
            raise OSError("LabJack's library LJM is not installed") from None
        stack.callback(ljm.close, handle)
        settings: dict[str, float] = {}
        for name, limit in zip(names, channels.ranges, strict=True):
            settings[f"{name}_RANGE"] = limit
            # The negative input of a differential channel is the next channel.
            number = int("".join(filter(str.isdigit, name)) or 0)
            negative = number + 1 if channels.differential else _SINGLE_ENDED
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
        scans = max(round(channels.rate / 50.0), 1)
        rate = float(ljm.eStreamStart(handle, scans, len(names), addresses, channels.rate))
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


def _measurement_computing(uldaq: Any, channels: AnalogChannels) -> Portions[Readings]:
    """An endless scan over the channels from the lowest to the highest, through uldaq."""
    found = uldaq.get_daq_device_inventory(uldaq.InterfaceType.ANY)
    named = [each for each in found if channels.device in ("", each.unique_id, str(each))]
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
        mode = modes.DIFFERENTIAL if channels.differential else modes.SINGLE_ENDED
        numbers = [int(name) for name in channels.names]
        low, high = min(numbers), max(numbers)
        count = inputs.get_info().get_num_chans_by_mode(mode)
        if high >= count:
            wiring = "wired differentially" if channels.differential else "wired to ground"
            raise OSError(f"it has no channel {high}: {count} channels can be {wiring}")
        span = _mcc_range(inputs.get_info().get_ranges(mode), max(channels.ranges))
        held = max(round(BUFFERED * channels.rate), 1)
        buffer = uldaq.create_float_buffer(high - low + 1, held)
        values = np.frombuffer(buffer).reshape(held, high - low + 1)
        wanted = [number - low for number in numbers]
        option, flags = uldaq.ScanOption.CONTINUOUS, uldaq.AInScanFlag.DEFAULT
        stack.callback(inputs.scan_stop)
        rate = float(
            inputs.a_in_scan(low, high, mode, span, held, channels.rate, option, flags, buffer)
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


def _lab_stream(pylsl: Any, channels: AnalogChannels) -> Portions[Readings]:
    """A stream of the lab streaming layer, through pylsl.

    Its stamps come from the sender, converted to the clock of this computer.
    """
    found = pylsl.resolve_byprop("name", channels.device, 1, SILENCE)
    if not found:
        raise OSError(f"there is no stream '{channels.device}' on the network")
    if found[0].channel_format() == pylsl.cf_string:
        raise OSError("it contains text, not numbers")
    inlet = pylsl.StreamInlet(
        found[0],
        max_buflen=round(BUFFERED),
        recover=False,
        processing_flags=pylsl.proc_clocksync,
        as_numpy=True,
    )
    labels = inlet.info(SILENCE).get_channel_labels() or []
    with ExitStack() as stack:
        inlet.open_stream(SILENCE)
        stack.callback(inlet.close_stream)
        count = found[0].channel_count()
        places = [_place(name, labels, count) for name in channels.names]
        yield None
        while True:
            samples, stamps = inlet.pull_chunk(POLL, MOST_READ, min_samples=1)
            if len(stamps) == 0:
                yield None
                continue
            values = np.asarray(samples, dtype=np.float64).T[places]
            yield Readings(values, 0.0, np.asarray(stamps, dtype=np.float64))


def _place(name: str, labels: list[str | None], count: int) -> int:
    """Index of a channel, by its label or its number from 0; raises OSError."""
    if name in labels:
        return labels.index(name)
    if name.isdigit() and int(name) < count:
        return int(name)
    known = ", ".join(label for label in labels if label) or "none has a label"
    raise OSError(f"it has no channel '{name}', but {count} others ({known})")


def _simulated(_: Any, channels: AnalogChannels) -> Portions[Readings]:
    """Displacement of 5 V and force of 7 V at 1 Hz, current of 1.5 V, each clipped at its range."""
    limits = np.array(channels.ranges)[:, np.newaxis]
    began, taken = time.monotonic(), 0
    while True:
        yield None
        until = math.floor((time.monotonic() - began) * channels.rate)
        phase = 2.0 * math.pi * np.arange(taken, until) / channels.rate
        taken = until
        force = 7.0 * np.tanh(3.0 * np.cos(phase))
        volts: Array = np.stack([5.0 * np.sin(phase), force, np.full(phase.size, 1.5)])
        volts = volts[: limits.size]
        yield Readings(np.clip(volts, -limits, limits), channels.rate) if phase.size else None


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
    "lsl": Driver(_lab_stream, "pylsl", "pylsl==1.18.6"),
}
"""Drivers by the value of the option ``driver``."""
