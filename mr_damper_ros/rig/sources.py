"""Where the bridge's samples come from: recordings, or the emulated rig. No ROS here."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.rig.emulator import (
    CurrentSchedule,
    Damper,
    EmulatedRig,
    RigBlock,
    RigSettings,
    ThermalModel,
)
from mr_damper_ros.rig.excitation import Excitation
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.recording import Recording

_PAUSE_NS = NANOSECONDS
"""Time left out of the stamps between two recordings, and before a recording starts again: no
window may reach from the end of one motion into the beginning of another."""


def recorded_blocks(
    recordings: Sequence[Recording], block_size: int, start_ns: int, *, loop: bool
) -> Iterator[RigBlock]:
    """Blocks of recordings one after the other, stamped from ``start_ns`` on and counted through.

    Where it loops, stamps and count go on. Unknown temperatures are NaN.
    """
    sequence = 0
    for _ in itertools.count() if loop else range(1):
        for recording in recordings:
            count = recording.sample_count
            temperature = (
                np.full(count, math.nan) if recording.temperature is None else recording.temperature
            )
            for first in range(0, count, block_size):
                part = slice(first, first + block_size)
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


def emulated_blocks(
    damper: Damper,
    excitation: Excitation,
    current: Callable[[], float],
    thermal: ThermalModel,
    settings: RigSettings,
    block_size: int,
) -> Iterator[RigBlock]:
    """Blocks of the emulated rig, for ever; ``current`` [A] is asked before each of them."""
    # The schedule is a list that grows while the rig reads it: this is the supply being turned.
    times, currents = [0.0], [current()]
    rig = EmulatedRig(
        damper, excitation, CurrentSchedule(times, currents), settings=settings, thermal=thermal
    )
    taken = 0
    while True:
        present = current()
        if present != currents[-1]:
            times.append(max(taken * settings.period, math.nextafter(times[-1], math.inf)))
            currents.append(present)
        yield rig.next_block(block_size)
        taken += block_size


@dataclass(frozen=True)
class Reading:
    """A value and its stamp."""

    stamp_ns: int
    value: float


class Meter:
    """Picks from samples what an instrument with a slower rate of its own would have reported.

    That is a reading every ``period`` seconds, and one wherever the value has moved by more than
    ``step`` since the last. Unknown values (NaN) are not reported.
    """

    def __init__(self, period: float, *, step: float = math.inf) -> None:
        self._period = period
        self._step = step
        self._last = math.nan

    def read(self, block: RigBlock, values: Array) -> list[Reading]:
        """Return the readings in a block; ``values`` has shape (n,)."""
        every = max(round(self._period / block.period), 1)
        regular = set(range(-block.sequence % every, values.size, every))
        moved = np.flatnonzero(np.diff(values, prepend=self._last))
        readings = []
        for index in sorted(regular.union(moved.tolist())):
            value = float(values[index])
            if index in regular or abs(value - self._last) > self._step:
                self._last = value
                if not math.isnan(value):
                    stamp_ns = block.start_ns + round(index * block.period * NANOSECONDS)
                    readings.append(Reading(stamp_ns, value))
        return readings
