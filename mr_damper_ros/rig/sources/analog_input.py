"""Data acquisition devices: the channels wanted, readings of them, and the vendors' libraries."""

from __future__ import annotations

import math
import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from mr_damper_ros.rig.sources.device_source import POLL, SILENCE, Device
from mr_damper_ros.signals.arrays import Array

MOST_READ = 10_000
"""Readings of a channel that are taken at a time."""

IDLE = 0.005
"""Seconds until a device that had nothing is looked at again."""

BUFFERED = 10.0
"""Seconds that the driver keeps for a computer that is busy."""


class Readings(NamedTuple):
    """``values`` (channels, n) [V], in the order of the channels, taken at a ``rate`` [Hz].

    Of a device that stamps, ``stamps`` (n,) [s] on any clock, and the rate is of no meaning.
    """

    values: Array
    rate: float
    stamps: Array | None = None


@dataclass(frozen=True)
class AnalogChannels:
    """The channels of a ``device`` that are wanted, each from -range to +range [V]."""

    device: str
    names: tuple[str, ...]
    ranges: tuple[float, ...]
    rate: float
    differential: bool


Connect = Callable[[], Device[Readings]]


class _VendorDevice(ABC):
    """A device that a vendor's library reads at its own rate, until it is lost."""

    def __init__(self, library: Any, channels: AnalogChannels, name: str) -> None:
        self._library = library
        self._name = name
        self._failures = self._raised()
        self._rate = 0.0
        try:
            self._begin(channels)
        except self._failures as error:
            self.close()
            raise OSError(f"{self._name}: {self._why(error)}") from error

    @abstractmethod
    def _raised(self) -> tuple[type[Exception], ...]:
        """What the library raises."""

    @abstractmethod
    def _begin(self, channels: AnalogChannels) -> None:
        """Connect, and have the device read its channels."""

    @abstractmethod
    def _take(self) -> Readings | None:
        """What has come since the last call; None for nothing."""

    @abstractmethod
    def _ends(self) -> list[Callable[[], object]]:
        """What is to be called at the end, whatever each raises."""

    def _why(self, error: Exception) -> str:
        """What the library says, in one line."""
        return " ".join(str(error).split())

    def read(self) -> Readings | None:
        """See :class:`Device`."""
        try:
            found = self._take()
        except self._failures as error:
            raise ConnectionError(f"{self._name} was lost: {self._why(error)}") from error
        if found is None:
            time.sleep(IDLE)
        return found

    def close(self) -> None:
        """See :class:`Device`."""
        for end in self._ends():
            with suppress(*self._failures):
                end()


class _NationalInstruments(_VendorDevice):
    """One task with all channels, by nidaqmx and the driver NI-DAQmx."""

    _task: Any = None

    def _raised(self) -> tuple[type[Exception], ...]:
        return (self._library.errors.Error, OSError)

    def _begin(self, channels: AnalogChannels) -> None:
        constants = self._library.constants
        wiring = constants.TerminalConfiguration
        self._task = self._library.Task()
        for name, limit in zip(channels.names, channels.ranges, strict=True):
            self._task.ai_channels.add_ai_voltage_chan(
                f"{channels.device}/{name}",
                terminal_config=wiring.DIFF if channels.differential else wiring.RSE,
                min_val=-limit,
                max_val=limit,
            )
        timing = self._task.timing
        timing.cfg_samp_clk_timing(
            channels.rate,
            sample_mode=constants.AcquisitionType.CONTINUOUS,
            samps_per_chan=round(BUFFERED * channels.rate),
        )
        self._rate = float(timing.samp_clk_rate)
        reader = self._library.stream_readers.AnalogMultiChannelReader
        self._reader = reader(self._task.in_stream)
        self._task.start()
        self._count = len(channels.names)

    def _take(self) -> Readings | None:
        ready = min(int(self._task.in_stream.avail_samp_per_chan), MOST_READ)
        if ready == 0:
            return None
        values = np.empty((self._count, ready))
        taken = self._reader.read_many_sample(values, ready, POLL)
        return Readings(values[:, :taken], self._rate)

    def _ends(self) -> list[Callable[[], object]]:
        return [] if self._task is None else [self._task.close]

    def _why(self, error: Exception) -> str:
        # After the first lines come names and codes.
        return " ".join(str(error).split("\n\n")[0].split())


def _nidaqmx(channels: AnalogChannels) -> Connect:
    try:
        library = import_module("nidaqmx")
        import_module("nidaqmx.stream_readers")
    except ImportError as error:
        raise ValueError(
            "daq.driver is nidaqmx, which is not installed: pip install nidaqmx==1.7.0, and NI's "
            "own driver NI-DAQmx"
        ) from error
    return lambda: _NationalInstruments(library, channels, channels.device)


_SINGLE_ENDED = 199
"""What LJM calls the ground as the negative input of a channel."""

_MISSED = -9999.0
"""Stands in the readings of a LabJack where it had to leave one out."""


class _LabJack(_VendorDevice):
    """The stream of a T4, T7 or T8, by labjack-ljm and LabJack's library LJM."""

    _handle: int | None = None

    def _raised(self) -> tuple[type[Exception], ...]:
        # Without the library LJM its functions are those of None.
        return (self._library.LJMError, AttributeError, OSError)

    def _begin(self, channels: AnalogChannels) -> None:
        ljm, names = self._library, list(channels.names)
        self._count = len(names)
        self._handle = ljm.openS("ANY", "ANY", channels.device or "ANY")
        settings: dict[str, float] = {}
        for name, limit in zip(names, channels.ranges, strict=True):
            settings[f"{name}_RANGE"] = limit
            # Wired differentially, a channel has the next one as its negative input.
            number = int("".join(filter(str.isdigit, name)) or 0)
            negative = number + 1 if channels.differential else _SINGLE_ENDED
            settings[f"{name}_NEGATIVE_CH"] = negative
        ljm.eWriteNames(self._handle, len(settings), list(settings), list(settings.values()))
        ljm.writeLibraryConfigS(
            ljm.constants.STREAM_SCANS_RETURN, ljm.constants.STREAM_SCANS_RETURN_ALL_OR_NONE
        )
        addresses = ljm.namesToAddresses(self._count, names)[0]
        unknown = ljm.constants.INVALID_NAME_ADDRESS
        if unknown in addresses:
            name = names[addresses.index(unknown)]
            raise OSError(f"it has no channel {name}: they are AIN0, AIN1 and so on")
        scans = max(round(channels.rate / 50.0), 1)
        self._rate = float(
            ljm.eStreamStart(self._handle, scans, self._count, addresses, channels.rate)
        )

    def _take(self) -> Readings | None:
        try:
            values, _, _ = self._library.eStreamRead(self._handle)
        except self._library.LJMError as error:
            if error.errorCode == self._library.errorcodes.NO_SCANS_RETURNED:
                return None
            raise
        found = np.array(values, dtype=np.float64).reshape(-1, self._count).T
        return Readings(np.where(found == _MISSED, np.nan, found), self._rate)

    def _ends(self) -> list[Callable[[], object]]:
        if self._handle is None:
            return []
        return [
            partial(end, self._handle) for end in (self._library.eStreamStop, self._library.close)
        ]

    def _why(self, error: Exception) -> str:
        if isinstance(error, AttributeError):
            return "LabJack's library LJM is not installed"
        return super()._why(error)


def _labjack(channels: AnalogChannels) -> Connect:
    try:
        library = import_module("labjack.ljm")
    except ImportError as error:
        raise ValueError(
            "daq.driver is labjack, which is not installed: pip install labjack-ljm==1.23.0, and "
            "LabJack's own library LJM"
        ) from error
    return lambda: _LabJack(library, channels, channels.device or "the LabJack")


class _MeasurementComputing(_VendorDevice):
    """A scan without end over the channels from the lowest to the highest, by uldaq."""

    _device: Any = None
    _inputs: Any = None

    def _raised(self) -> tuple[type[Exception], ...]:
        return (self._library.ULException, OSError)

    def _begin(self, channels: AnalogChannels) -> None:
        uldaq = self._library
        found = uldaq.get_daq_device_inventory(uldaq.InterfaceType.ANY)
        named = [each for each in found if channels.device in ("", each.unique_id, str(each))]
        if not named:
            known = ", ".join(f"{each} ({each.unique_id})" for each in found) or "none at all"
            raise OSError(f"there is no such device; found: {known}")
        self._device = uldaq.DaqDevice(named[0])
        self._device.connect()
        self._inputs = self._device.get_ai_device()
        if self._inputs is None or not self._inputs.get_info().has_pacer():
            raise OSError("it has no analogue inputs that are read by a clock of its own")
        modes = uldaq.AiInputMode
        mode = modes.DIFFERENTIAL if channels.differential else modes.SINGLE_ENDED
        places = [int(name) for name in channels.names]
        low, high = min(places), max(places)
        count = self._inputs.get_info().get_num_chans_by_mode(mode)
        if high >= count:
            wiring = "wired differentially" if channels.differential else "wired to ground"
            raise OSError(f"it has no channel {high}: {count} can be {wiring}")
        self._places = [place - low for place in places]
        across = high - low + 1
        self._held = max(round(BUFFERED * channels.rate), 1)
        self._buffer = uldaq.create_float_buffer(across, self._held)
        self._values = np.frombuffer(self._buffer).reshape(self._held, across)
        self._taken = 0
        self._rate = float(
            self._inputs.a_in_scan(
                low,
                high,
                mode,
                _mcc_range(self._inputs.get_info().get_ranges(mode), max(channels.ranges)),
                self._held,
                channels.rate,
                uldaq.ScanOption.CONTINUOUS,
                uldaq.AInScanFlag.DEFAULT,
                self._buffer,
            )
        )

    def _take(self) -> Readings | None:
        status, transfer = self._inputs.get_scan_status()
        ready = int(transfer.current_scan_count) - self._taken
        if ready > self._held:
            raise OSError("it has overwritten samples that were not yet read")
        if ready <= 0:
            if status != self._library.ScanStatus.RUNNING:
                raise OSError("it has stopped to sample")
            return None
        ready = min(ready, MOST_READ)
        rows = np.arange(self._taken, self._taken + ready) % self._held
        self._taken += ready
        return Readings(self._values[rows][:, self._places].T, self._rate)

    def _ends(self) -> list[Callable[[], object]]:
        inputs, device = self._inputs, self._device
        self._inputs = self._device = None
        ends = [] if inputs is None else [inputs.scan_stop]
        return ends if device is None else [*ends, device.disconnect, device.release]

    def _why(self, error: Exception) -> str:
        # Without the name of its number.
        return " ".join((getattr(error, "error_message", "") or str(error)).split())


def _mcc_range(ranges: Any, wanted: float) -> Any:
    """The smallest range of the device from minus to plus what is wanted [V]; raises OSError."""
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


def _mcc(channels: AnalogChannels) -> Connect:
    try:
        library = import_module("uldaq")
    except ImportError as error:
        raise ValueError(
            "daq.driver is mcc, for which uldaq is not installed: pip install uldaq==1.2.3, and "
            "MCC's own library UL for Linux (libuldaq)"
        ) from error
    except OSError as error:  # it loads the library when it is imported
        raise ValueError(
            "daq.driver is mcc, and uldaq does not find MCC's library UL for Linux: install "
            f"libuldaq ({error})"
        ) from error
    for name in channels.names:
        if not name.isdigit():
            raise ValueError(f"MCC has no channel '{name}': they are called 0, 1 and so on")
    return lambda: _MeasurementComputing(library, channels, channels.device or "the MCC device")


class _LabStream(_VendorDevice):
    """A stream of the lab streaming layer, by pylsl.

    Its stamps are those of its sender on the clock of this computer.
    """

    _inlet: Any = None

    def _raised(self) -> tuple[type[Exception], ...]:
        lost = self._library.util
        return (lost.LostError, lost.InternalError, OSError, RuntimeError, ValueError)

    def _begin(self, channels: AnalogChannels) -> None:
        pylsl = self._library
        found = pylsl.resolve_byprop("name", channels.device, 1, SILENCE)
        if not found:
            raise OSError(f"there is no stream '{channels.device}' on the network")
        if found[0].channel_format() == pylsl.cf_string:
            raise OSError("it holds texts, not numbers")
        self._inlet = pylsl.StreamInlet(
            found[0],
            max_buflen=round(BUFFERED),
            recover=False,
            processing_flags=pylsl.proc_clocksync,
            as_numpy=True,
        )
        labels = self._inlet.info(SILENCE).get_channel_labels() or []
        self._inlet.open_stream(SILENCE)
        count = found[0].channel_count()
        self._places = [_place(name, labels, count) for name in channels.names]

    def _take(self) -> Readings | None:
        samples, stamps = self._inlet.pull_chunk(POLL, MOST_READ, min_samples=1)
        if len(stamps) == 0:
            return None
        values = np.asarray(samples, dtype=np.float64).T[self._places]
        return Readings(values, 0.0, np.asarray(stamps, dtype=np.float64))

    def _ends(self) -> list[Callable[[], object]]:
        inlet, self._inlet = self._inlet, None
        return [] if inlet is None else [inlet.close_stream]


def _place(name: str, labels: list[str | None], count: int) -> int:
    """The place of a channel, by its label or its number from 0; raises OSError."""
    if name in labels:
        return labels.index(name)
    if name.isdigit() and int(name) < count:
        return int(name)
    known = ", ".join(label for label in labels if label) or "none has a label"
    raise OSError(f"it has {count} channels ({known}), and no '{name}'")


def _lsl(channels: AnalogChannels) -> Connect:
    try:
        library = import_module("pylsl")
    except (ImportError, RuntimeError, OSError) as error:
        raise ValueError(
            "daq.driver is lsl, for which pylsl is not installed: pip install pylsl==1.18.6"
        ) from error
    return lambda: _LabStream(library, channels, f"the stream '{channels.device}'")


class _SimulatedInput:
    """1 Hz: 5 V of displacement, 7 V of force, 1.5 V of current; clipped at the ranges."""

    def __init__(self, channels: AnalogChannels) -> None:
        self._rate = channels.rate
        self._limits = np.array(channels.ranges)[:, np.newaxis]
        self._began = time.monotonic()
        self._taken = 0

    def read(self) -> Readings | None:
        until = math.floor((time.monotonic() - self._began) * self._rate)
        if until == self._taken:
            time.sleep(IDLE)
            return None
        phase = 2.0 * math.pi * np.arange(self._taken, until) / self._rate
        self._taken = until
        volts: Array = np.stack(
            [
                5.0 * np.sin(phase),
                7.0 * np.tanh(3.0 * np.cos(phase)),
                np.full(phase.size, 1.5),
            ]
        )[: self._limits.size]
        return Readings(np.clip(volts, -self._limits, self._limits), self._rate)

    def close(self) -> None:
        pass


DRIVERS: dict[str, Callable[[AnalogChannels], Connect]] = {
    "simulated": lambda channels: lambda: _SimulatedInput(channels),
    "nidaqmx": _nidaqmx,
    "labjack": _labjack,
    "mcc": _mcc,
    "lsl": _lsl,
}
"""What connects to the channels of a device; raises ValueError where its library is missing."""
