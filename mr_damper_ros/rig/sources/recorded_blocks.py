"""Recordings as a stream of blocks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from mr_damper_ros.rig.rig_block import RigBlock
from mr_damper_ros.rig.sources.source import StreamSettings
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import Recording

_PAUSE_NS = NANOSECONDS
"""Time left out of the stamps between two recordings, and before a recording starts again: no
window may reach from the end of one motion into the beginning of another."""


def recorded_blocks(
    recordings: Sequence[Recording], stream: StreamSettings, start_ns: int
) -> Iterator[RigBlock]:
    """Blocks of recordings one after the other, stamped from ``start_ns`` on and counted through.

    Where it loops, stamps and count go on. Unknown temperatures are NaN.
    """
    sequence = 0
    for _ in itertools.count() if stream.loop else range(1):
        for recording in recordings:
            count = recording.sample_count
            temperature = (
                np.full(count, math.nan) if recording.temperature is None else recording.temperature
            )
            for first in range(0, count, stream.block_size):
                part = slice(first, first + stream.block_size)
                yield RigBlock(
                    start_ns=start_ns + round(first * recording.period * NANOSECONDS),
                    sequence=sequence + first,
                    period=recording.period,
                    displacement=recording.displacement[part],
                    force=recording.force[part],
                    current=recording.current[part],
                    temperature=temperature[part],
                )
            sequence += count
            start_ns += round(count * recording.period * NANOSECONDS) + _PAUSE_NS


def checked(recordings: Sequence[Recording]) -> list[str]:
    """What the recordings are, in sentences; raises RecordingError where one is not plausible."""
    found = []
    for recording in recordings:
        recording.check_plausible()
        details = "".join(f"; {key}: {value}" for key, value in recording.details.items())
        found.append(
            f"{recording.name}: {recording.sample_count} samples, {recording.duration:.3g} s"
            + details
        )
    return found
