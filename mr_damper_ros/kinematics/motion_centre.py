"""Centre of a motion that is still going on, and whether it has come to rest."""

from __future__ import annotations

import math
from collections import deque

from mr_damper_ros.signals.arrays import Array, span_of

_HALF_CYCLES = 4
"""A random motion turns at irregular times: so many of its half-cycles tell how slowly."""

_AT_ONCE = 16
"""Samples of which no more than the last is looked at for a reversal."""

_STRETCHES = 64

_LONGEST = 10
"""A slow cycle is kept whole for up to so many memories."""

_CYCLE = 3
"""Reversals from the begin of a cycle to its end."""

_SMALLEST_RETURN = 1e-4
"""A reversal counts once the motion has come back by this [m] and by a quarter of its span."""

_STILL = 0.01
"""A move by less than this part of the amplitude is none ..."""

_DWELL = 0.4
"""... and a rest is longer than this part of a half-cycle without one. A sine stays within a
hundredth of its amplitude for a tenth of a half-cycle; one of a tenth of the amplitude that was
usual, for a third."""

_SHORTEST = 0.1
"""Seconds; noise and the delay of an observer take some hundredths."""

_LONG = 2.0
"""A rest is told after so long [s] already ..."""

_LONG_DWELL = 0.16
"""... if that is this part of a half-cycle."""


class MotionCentre:
    """Middle of the span of the displacement over the last ``memory`` seconds.

    It is exact for any steady motion. Where the last whole cycle is longer than the memory it is
    taken over that cycle. It is kept by the lowest and highest value of short stretches, so that
    its cost does not grow with the rate.

    ``reversals`` counts the changes of direction; ``half_cycle`` [s] is the time between the last
    two of them, NaN before. ``resting``: the displacement has hardly changed for longer than any
    reversal of the latest motion took.
    """

    def __init__(self, memory: float, period: float) -> None:
        self._memory = max(round(memory / period), 1)
        self._length = max(self._memory // _STRETCHES, 1)
        # Of each stretch: number of samples, lowest and highest value [m].
        self._counts: deque[int] = deque()
        self._lows: deque[float] = deque()
        self._highs: deque[float] = deque()
        self._remembered = 0
        self._turns: deque[int] = deque(maxlen=_CYCLE)
        self._half_cycles: deque[float] = deque(maxlen=_HALF_CYCLES)
        self._rest = RestWatch(period)
        self._direction = 0
        self._bottom, self._top = math.inf, -math.inf
        self._count = 0
        self._turned_at = 0
        self._period = period
        self.reversals = 0
        self.half_cycle = math.nan

    def follow(self, displacement: Array) -> float:
        """Centre [m] after these samples of shape (n,), n >= 1."""
        for first in range(0, displacement.size, _AT_ONCE):
            centre = self._follow(displacement[first : first + _AT_ONCE])
        return centre

    def _follow(self, displacement: Array) -> float:
        low, high = span_of(displacement)
        if not self._counts or self._counts[-1] >= self._length:
            self._counts.append(0)
            self._lows.append(low)
            self._highs.append(high)
        self._counts[-1] += displacement.size
        self._lows[-1] = min(self._lows[-1], low)
        self._highs[-1] = max(self._highs[-1], high)
        self._remembered += displacement.size
        while self._remembered - self._counts[0] >= self._needed:
            self._remembered -= self._counts.popleft()
            self._lows.popleft()
            self._highs.popleft()
        self._count += displacement.size
        bottom, top = min(self._lows), max(self._highs)
        self._bottom, self._top = min(self._bottom, low), max(self._top, high)
        newest = float(displacement[-1])
        self._count_reversals(newest, max(0.25 * (top - bottom), _SMALLEST_RETURN))
        amplitude = 0.5 * (top - bottom)
        self._rest.follow(low, high, newest, displacement.size, amplitude, self.usual_half_cycle)
        return 0.5 * (bottom + top)

    @property
    def resting(self) -> bool:
        """Whether the displacement has hardly changed for longer than at any reversal."""
        return self._rest.resting

    @property
    def usual_half_cycle(self) -> float:
        """The longest [s] of the latest half-cycles; NaN before the first."""
        return max(self._half_cycles, default=math.nan)

    @property
    def _needed(self) -> int:
        """Samples to remember: the memory's, or those since the begin of the last cycle."""
        if len(self._turns) < _CYCLE:
            return _LONGEST * self._memory
        return min(max(self._memory, self._count - self._turns[0]), _LONGEST * self._memory)

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
                self._half_cycles.append(self.half_cycle)
            self._turned_at = self._count
            self._turns.append(self._count)
        self._direction = direction


class RestWatch:
    """Follows a displacement of samples ``period`` [s] apart."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._anchor = math.nan
        self._since = 0
        self.resting = False

    def follow(
        self,
        low: float,
        high: float,
        newest: float,
        count: int,
        amplitude: float,
        half_cycle: float,
    ) -> None:
        """Follow ``count`` samples that lie within ``low`` and ``high`` [m], by their newest.

        ``amplitude`` [m] and ``half_cycle`` [s] are those of the latest motion, the latter NaN
        before one is known: then nothing is called a rest.
        """
        still = _STILL * amplitude
        if not (self._anchor - still <= low and high <= self._anchor + still):
            self._anchor, self._since = newest, 0
            self.resting = False
            return
        self._since += count
        enough = max(_SHORTEST, min(_DWELL * half_cycle, max(_LONG, _LONG_DWELL * half_cycle)))
        self.resting = self._since * self._period > enough
