"""What data acquisition devices have in common: the channels wanted, and readings of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from mr_damper_ros.rig.acquisition.device_reader import Device
from mr_damper_ros.signals.arrays import Array

MOST_READ = 10_000
"""Readings of a channel that are taken at a time."""

IDLE = 0.005
"""Seconds until a device that had nothing is looked at again."""


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
