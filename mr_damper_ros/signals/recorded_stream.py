"""A recording as the stream that it once was: blocks of samples and readings of the current."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.recording import Recording

BLOCK_SIZE = 10
"""Samples in a block, as the bridge sends them by default."""


class CurrentReading(NamedTuple):
    """The supply current [A] from a stamp on."""

    stamp_ns: int
    current: float


class TemperatureReading(NamedTuple):
    """The temperature [°C] of the damper now."""

    celsius: float


StreamItem = SampleBlock | CurrentReading | TemperatureReading


def stream_of(recording: Recording, block_size: int = BLOCK_SIZE) -> Iterator[StreamItem]:
    """The samples of a recording in blocks, each after the readings for its samples.

    The current is read where it changes and at the last sample of each block, the temperature,
    where it was measured, once a block. Raises ValueError for a block size below 1.
    """
    if block_size < 1:
        raise ValueError(f"the block size is {block_size}: it must be at least 1")
    changes = np.flatnonzero(np.diff(recording.current, prepend=math.nan))
    for first in range(0, recording.sample_count, block_size):
        last = min(first + block_size, recording.sample_count) - 1
        inside = changes[np.searchsorted(changes, first) : np.searchsorted(changes, last)]
        for place in (*inside.tolist(), last):
            yield CurrentReading(recording.stamp_ns(place), float(recording.current[place]))
        if recording.temperature is not None:
            yield TemperatureReading(float(recording.temperature[last]))
        part = slice(first, last + 1)
        yield SampleBlock(
            recording.stamp_ns(first),
            first,
            recording.period,
            recording.displacement[part],
            recording.force[part],
        )
