"""Analogue inputs of LabJack T4, T7 and T8, by labjack-ljm and LabJack's library LJM."""

from __future__ import annotations

import time
from contextlib import suppress
from importlib import import_module
from typing import Any

import numpy as np

from mr_damper_ros.rig.sources.analog_input import IDLE, AnalogChannels, Connect, Readings

_SINGLE_ENDED = 199
"""What LJM calls the ground as the negative input of a channel."""

_MISSED = -9999.0
"""Stands in the readings where the device had to leave one out."""


def connector(channels: AnalogChannels) -> Connect:
    """What connects to the device; raises ValueError where the library is missing."""
    try:
        ljm: Any = import_module("labjack.ljm")
    except ImportError as error:
        raise ValueError(
            "daq.driver is labjack, which is not installed: pip install labjack-ljm==1.23.0, and "
            "LabJack's own library LJM"
        ) from error
    return lambda: _LabjackStream(ljm, channels)


class _LabjackStream:
    """The stream of a device, which reads its channels at its own rate."""

    def __init__(self, ljm: Any, channels: AnalogChannels) -> None:
        self._ljm = ljm
        self._name = channels.device or "the LabJack"
        # Without the library LJM its functions are those of None.
        self._failures: tuple[type[Exception], ...] = (ljm.LJMError, AttributeError, OSError)
        self._count = len(channels.names)
        self._handle: int | None = None
        try:
            self._handle = ljm.openS("ANY", "ANY", channels.device or "ANY")
            settings: dict[str, float] = {}
            for name, limit in zip(channels.names, channels.ranges, strict=True):
                settings[f"{name}_RANGE"] = limit
                settings[f"{name}_NEGATIVE_CH"] = _negative(name, channels)
            ljm.eWriteNames(self._handle, len(settings), list(settings), list(settings.values()))
            ljm.writeLibraryConfigS(
                ljm.constants.STREAM_SCANS_RETURN, ljm.constants.STREAM_SCANS_RETURN_ALL_OR_NONE
            )
            addresses = ljm.namesToAddresses(self._count, list(channels.names))[0]
            unknown = ljm.constants.INVALID_NAME_ADDRESS
            if unknown in addresses:
                name = channels.names[addresses.index(unknown)]
                raise OSError(f"it has no channel {name}: they are AIN0, AIN1 and so on")
            scans = max(round(channels.rate / 50.0), 1)
            self._rate = float(
                ljm.eStreamStart(self._handle, scans, self._count, addresses, channels.rate)
            )
        except self._failures as error:
            self.close()
            raise OSError(f"{self._name}: {_why(error)}") from error

    def read(self) -> Readings | None:
        try:
            values, _, _ = self._ljm.eStreamRead(self._handle)
        except self._failures as error:
            if getattr(error, "errorCode", None) == self._ljm.errorcodes.NO_SCANS_RETURNED:
                time.sleep(IDLE)
                return None
            raise ConnectionError(f"{self._name} was lost: {_why(error)}") from error
        found = np.array(values, dtype=np.float64).reshape(-1, self._count).T
        return Readings(np.where(found == _MISSED, np.nan, found), self._rate)

    def close(self) -> None:
        if self._handle is None:
            return
        for end in (self._ljm.eStreamStop, self._ljm.close):
            with suppress(*self._failures):
                end(self._handle)


def _negative(name: str, channels: AnalogChannels) -> float:
    """The negative input of a channel: the next one, where it is wired differentially."""
    if not channels.differential:
        return _SINGLE_ENDED
    number = int("".join(character for character in name if character.isdigit()) or 0)
    return number + 1


def _why(error: Exception) -> str:
    if isinstance(error, AttributeError):
        return "LabJack's library LJM is not installed"
    return " ".join(str(error).split())
