"""Centre of a motion that is still going on."""

from __future__ import annotations

import math
from collections import deque

from mr_damper_ros.damper.sigmoid import Array

_STRETCHES = 64


class MotionCentre:
    """Middle of the span of the displacement over the last ``memory`` seconds.

    It is exact for any steady motion of which a whole cycle lies within the memory. It is kept by
    the lowest and highest value of short stretches, so that its cost does not grow with the rate.
    """

    def __init__(self, memory: float, period: float) -> None:
        self._length = max(round(memory / period / _STRETCHES), 1)
        self._lowest: deque[float] = deque([math.inf], maxlen=_STRETCHES)
        self._highest: deque[float] = deque([-math.inf], maxlen=_STRETCHES)
        self._in_stretch = 0
        self._direction = 0
        self._turning = math.nan
        self.reversals = 0

    def follow(self, displacement: Array) -> float:
        """Centre [m] after these samples of shape (n,), n >= 1."""
        if self._in_stretch >= self._length:
            self._lowest.append(math.inf)
            self._highest.append(-math.inf)
            self._in_stretch = 0
        low, high = float(displacement.min()), float(displacement.max())
        self._lowest[-1] = min(self._lowest[-1], low)
        self._highest[-1] = max(self._highest[-1], high)
        self._in_stretch += displacement.size
        bottom, top = min(self._lowest), max(self._highest)
        self._count_reversals(low, high, 0.25 * (top - bottom))
        return 0.5 * (bottom + top)

    def _count_reversals(self, low: float, high: float, threshold: float) -> None:
        # A reversal counts once the motion has come back by a quarter of its span: noise does not.
        if math.isnan(self._turning):
            self._turning = low
            return
        if self._direction >= 0:
            self._turning = max(self._turning, high)
            if self._turning - low > threshold > 0.0:
                self.reversals += self._direction > 0
                self._direction, self._turning = -1, low
                return
        if self._direction <= 0:
            self._turning = min(self._turning, low)
            if high - self._turning > threshold > 0.0:
                self.reversals += self._direction < 0
                self._direction, self._turning = 1, high
