"""Centre of a motion that is still going on."""

from __future__ import annotations

import math
from collections import deque

from mr_damper_ros.signals.arrays import Array

_STRETCHES = 64

_SMALLEST_RETURN = 1e-4
"""A reversal counts once the motion has come back by this [m] and by a quarter of its span."""


class MotionCentre:
    """Middle of the span of the displacement over the last ``memory`` seconds.

    It is exact for any steady motion of which a whole cycle lies within the memory. It is kept by
    the lowest and highest value of short stretches, so that its cost does not grow with the rate.

    ``reversals`` counts the changes of direction; ``half_cycle`` [s] is the time between the last
    two of them, NaN before.
    """

    def __init__(self, memory: float, period: float) -> None:
        self._memory = max(round(memory / period), 1)
        self._length = max(self._memory // _STRETCHES, 1)
        # Of each stretch: number of samples, lowest and highest value [m].
        self._counts: deque[int] = deque()
        self._lows: deque[float] = deque()
        self._highs: deque[float] = deque()
        self._remembered = 0
        self._direction = 0
        self._bottom, self._top = math.inf, -math.inf
        self._count = 0
        self._turned_at = 0
        self._period = period
        self.reversals = 0
        self.half_cycle = math.nan

    def follow(self, displacement: Array) -> float:
        """Centre [m] after these samples of shape (n,), n >= 1."""
        low, high = float(displacement.min()), float(displacement.max())
        if not self._counts or self._counts[-1] >= self._length:
            self._counts.append(0)
            self._lows.append(low)
            self._highs.append(high)
        self._counts[-1] += displacement.size
        self._lows[-1] = min(self._lows[-1], low)
        self._highs[-1] = max(self._highs[-1], high)
        self._remembered += displacement.size
        while self._remembered - self._counts[0] >= self._memory:
            self._remembered -= self._counts.popleft()
            self._lows.popleft()
            self._highs.popleft()
        self._count += displacement.size
        bottom, top = min(self._lows), max(self._highs)
        self._bottom, self._top = min(self._bottom, low), max(self._top, high)
        self._count_reversals(float(displacement[-1]), max(0.25 * (top - bottom), _SMALLEST_RETURN))
        return 0.5 * (bottom + top)

    def _count_reversals(self, newest: float, threshold: float) -> None:
        if self._direction >= 0 and self._top - newest > threshold:
            self._turn(-1)
            self._bottom = newest
        elif self._direction <= 0 and newest - self._bottom > threshold:
            self._turn(1)
            self._top = newest

    def _turn(self, direction: int) -> None:
        if self._direction != 0:
            self.reversals += 1
            if self.reversals > 1:
                self.half_cycle = (self._count - self._turned_at) * self._period
            self._turned_at = self._count
        self._direction = direction
