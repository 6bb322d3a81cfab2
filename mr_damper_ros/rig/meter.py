"""An instrument that reports more slowly than the samples come."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.rig.rig_block import RigBlock
from mr_damper_ros.signals.arrays import Array


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

    def read(self, block: RigBlock, values: Array, ahead_ns: int = 0) -> list[Reading]:
        """Return the readings in a block; ``values`` has shape (n,).

        ``ahead_ns``: how far the instrument's own clock is ahead of that of the samples.
        """
        every = max(round(self._period / block.period), 1)
        regular = set(range(-block.sequence % every, values.size, every))
        moved = np.flatnonzero(np.diff(values, prepend=self._last))
        readings = []
        for index in sorted(regular.union(moved.tolist())):
            value = float(values[index])
            if index in regular or abs(value - self._last) > self._step:
                self._last = value
                if not math.isnan(value):
                    readings.append(Reading(block.stamp_ns(index) + ahead_ns, value))
        return readings
