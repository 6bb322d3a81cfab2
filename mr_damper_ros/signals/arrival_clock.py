"""A device's clock beside that of this computer, from when stamped messages arrive.

Arrival less stamp is the offset of the clocks plus what the message took on its way. That is never
less than a shortest time, and now and then not much more; so the smallest of each second lie on a
line, whose slope is the rate of the device's clock. The shortest time of the way stays in the
offset: nothing tells the two apart.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from mr_damper_ros.signals.blocks import NANOSECONDS

_SECONDS = 60
"""Seconds that the line is drawn through."""

_FEWEST = 5
"""Seconds from which on there is a rate; before there is only an offset."""


class ArrivalClock:
    """Tells how far the clock of this computer is ahead of that of the stamps."""

    def __init__(self) -> None:
        self._least: deque[tuple[int, int]] = deque(maxlen=_SECONDS)
        self._second: int | None = None
        self._line = (0.0, 0.0, 0)

    @property
    def rate(self) -> float:
        """How much faster this computer's clock goes [1]; 0 as long as it is not known."""
        return self._line[0]

    def add(self, stamp_ns: int, arrival_ns: int) -> None:
        """Take in the stamp of a message and when it arrived [ns]."""
        ahead = arrival_ns - stamp_ns
        second = stamp_ns // NANOSECONDS
        if self._second is not None and second < self._second - 1:
            self._least.clear()  # one of the clocks was set
        if second != self._second:
            self._draw()
            self._second = second
            self._least.append((stamp_ns, ahead))
        elif ahead < self._least[-1][1]:
            self._least[-1] = (stamp_ns, ahead)
        else:
            return
        if len(self._least) <= _FEWEST:
            self._draw()

    def ahead_ns(self, stamp_ns: int) -> int:
        """What is to be added to a stamp for the time of this computer [ns]."""
        rate, offset, base = self._line
        return round(offset + rate * (stamp_ns - base))

    def _draw(self) -> None:
        if not self._least:
            return
        base = self._least[-1][0]
        times, ahead = np.array([(t - base, a) for t, a in self._least], dtype=np.float64).T
        if times.size < _FEWEST:
            self._line = (0.0, float(ahead.min()), base)
            return
        slope, offset = np.polyfit(times, ahead, 1)
        self._line = (float(slope), float(offset), base)
