"""A data acquisition device that is not there: a sine, and what a damper makes of it, in volts."""

from __future__ import annotations

import math
import time

import numpy as np

from mr_damper_ros.rig.acquisition.analog_input import IDLE, AnalogChannels, Connect, Readings
from mr_damper_ros.signals.arrays import Array


def connector(channels: AnalogChannels) -> Connect:
    """What connects to a simulated device of these channels."""
    return lambda: _SimulatedInput(channels)


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
