"""Analogue inputs of MCC (Measurement Computing), by uldaq and the library UL for Linux."""

from __future__ import annotations

import re
import time
from contextlib import suppress
from importlib import import_module
from typing import Any

import numpy as np

from mr_damper_ros.rig.sources.analog_input import (
    BUFFERED,
    IDLE,
    MOST_READ,
    AnalogChannels,
    Connect,
    Readings,
)


def connector(channels: AnalogChannels) -> Connect:
    """What connects to the device; raises ValueError where the library is missing."""
    try:
        uldaq: Any = import_module("uldaq")
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
    return lambda: _MccScan(uldaq, channels)


class _MccScan:
    """A scan without end over the channels from the lowest to the highest that is wanted."""

    def __init__(self, uldaq: Any, channels: AnalogChannels) -> None:
        self._uldaq = uldaq
        self._name = channels.device or "the MCC device"
        self._failures: tuple[type[Exception], ...] = (uldaq.ULException, OSError)
        self._device: Any = None
        self._inputs: Any = None
        try:
            self._begin(channels)
        except self._failures as error:
            self.close()
            raise OSError(f"{self._name}: {_why(error)}") from error

    def _begin(self, channels: AnalogChannels) -> None:
        uldaq = self._uldaq
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
                _range(self._inputs.get_info().get_ranges(mode), max(channels.ranges)),
                self._held,
                channels.rate,
                uldaq.ScanOption.CONTINUOUS,
                uldaq.AInScanFlag.DEFAULT,
                self._buffer,
            )
        )

    def read(self) -> Readings | None:
        try:
            status, transfer = self._inputs.get_scan_status()
        except self._failures as error:
            raise ConnectionError(f"{self._name} was lost: {_why(error)}") from error
        ready = int(transfer.current_scan_count) - self._taken
        if ready > self._held:
            raise ConnectionError(f"{self._name} has overwritten samples that were not yet read")
        if ready <= 0 and status != self._uldaq.ScanStatus.RUNNING:
            raise ConnectionError(f"{self._name} was lost: it has stopped to sample")
        ready = min(ready, MOST_READ)
        if ready <= 0:
            time.sleep(IDLE)
            return None
        rows = np.arange(self._taken, self._taken + ready) % self._held
        self._taken += ready
        return Readings(self._values[rows][:, self._places].T, self._rate)

    def close(self) -> None:
        ends = [self._inputs.scan_stop] if self._inputs is not None else []
        if self._device is not None:
            ends += [self._device.disconnect, self._device.release]
        for end in ends:
            with suppress(*self._failures):
                end()
        self._inputs = self._device = None


def _range(ranges: Any, wanted: float) -> Any:
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


def _why(error: Exception) -> str:
    """What the library says, without the name of its number."""
    return " ".join((getattr(error, "error_message", "") or str(error)).split())
