"""What data acquisition devices have in common: the channels wanted, and readings of them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.rig.sources.device_source import Device
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
