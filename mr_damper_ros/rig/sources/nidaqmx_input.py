"""Analogue inputs of National Instruments, by nidaqmx and the driver NI-DAQmx."""

from __future__ import annotations

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
from mr_damper_ros.rig.sources.device_source import POLL


def connector(channels: AnalogChannels) -> Connect:
    """What connects to the device; raises ValueError where the library is missing."""
    try:
        nidaqmx: Any = import_module("nidaqmx")
        import_module("nidaqmx.stream_readers")
    except ImportError as error:
        raise ValueError(
            "daq.driver is nidaqmx, which is not installed: pip install nidaqmx==1.7.0, and NI's "
            "own driver NI-DAQmx"
        ) from error
    return lambda: _NidaqmxTask(nidaqmx, channels)


class _NidaqmxTask:
    """One task with all channels, which the device reads at its own rate."""

    def __init__(self, nidaqmx: Any, channels: AnalogChannels) -> None:
        self._name = channels.device
        self._failures: tuple[type[Exception], ...] = (nidaqmx.errors.Error, OSError)
        constants = nidaqmx.constants
        wiring = constants.TerminalConfiguration
        self._task: Any = None
        try:
            self._task = nidaqmx.Task()
            for name, limit in zip(channels.names, channels.ranges, strict=True):
                self._task.ai_channels.add_ai_voltage_chan(
                    f"{channels.device}/{name}",
                    terminal_config=wiring.DIFF if channels.differential else wiring.RSE,
                    min_val=-limit,
                    max_val=limit,
                )
            self._task.timing.cfg_samp_clk_timing(
                channels.rate,
                sample_mode=constants.AcquisitionType.CONTINUOUS,
                samps_per_chan=round(BUFFERED * channels.rate),
            )
            self._rate = float(self._task.timing.samp_clk_rate)
            self._reader = nidaqmx.stream_readers.AnalogMultiChannelReader(self._task.in_stream)
            self._task.start()
        except self._failures as error:
            self.close()
            raise OSError(f"{self._name}: {_why(error)}") from error
        self._count = len(channels.names)

    def read(self) -> Readings | None:
        try:
            ready = min(int(self._task.in_stream.avail_samp_per_chan), MOST_READ)
            if ready == 0:
                time.sleep(IDLE)
                return None
            values = np.empty((self._count, ready))
            taken = self._reader.read_many_sample(values, ready, POLL)
        except self._failures as error:
            raise ConnectionError(f"{self._name} was lost: {_why(error)}") from error
        return Readings(values[:, :taken], self._rate)

    def close(self) -> None:
        if self._task is not None:
            with suppress(*self._failures):
                self._task.close()


def _why(error: Exception) -> str:
    """The first lines of what the driver says: after them come names and codes."""
    return " ".join(str(error).split("\n\n")[0].split())
