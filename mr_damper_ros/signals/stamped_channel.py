"""One channel of stamped values, as they arrive: in order, counted, at their times."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass
from typing import Generic

from mr_damper_ros.signals.arrival_clock import ArrivalClock
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.even_stamps import EvenSample, EvenStamps, V

_REMEMBERED = 64
"""Stamps that are remembered, so that one that comes again is known."""


@dataclass
class ChannelCounts:
    """What has come on a channel, and what of it was of no use."""

    received: int = 0
    repeated: int = 0
    late: int = 0
    not_finite: int = 0
    jumps: int = 0


class StampedChannel(Generic[V]):
    """Puts values in the order of their stamps [ns] and tells when each was taken.

    Values wait until the stamps are ``hold_back`` [s] further, for those that they have overtaken.
    Stamps that jump back by more than a second begin anew.
    """

    def __init__(self, hold_back: float) -> None:
        self._hold_ns = round(hold_back * NANOSECONDS)
        self._waiting: list[tuple[int, V]] = []
        self._seen: deque[int] = deque(maxlen=_REMEMBERED)
        self._released: int | None = None
        self._even: EvenStamps[V] = EvenStamps()
        self.clock = ArrivalClock()
        self.counts = ChannelCounts()

    @property
    def period(self) -> float:
        """Time [s] between two samples; NaN until it is known."""
        return self._even.period

    @property
    def lost(self) -> int:
        """Samples that have never come, as the clock tells."""
        return self._even.lost

    @property
    def unclear(self) -> int:
        """Samples next to lost ones that were left out, for it is not clear where they belong."""
        return self._even.unclear

    def add(self, stamp_ns: int, arrival_ns: int, value: V) -> list[EvenSample[V]]:
        """Take in a value; returns the samples that are in order and certain now."""
        counts = self.counts
        counts.received += 1
        if isinstance(value, float) and not math.isfinite(value):
            counts.not_finite += 1
            return []
        self.clock.add(stamp_ns, arrival_ns)
        if self._released is not None and stamp_ns <= self._released:
            if stamp_ns in self._seen:
                counts.repeated += 1
                return []
            if self._released - stamp_ns < NANOSECONDS:
                counts.late += 1
                return []
            counts.jumps += 1
            self._waiting, self._released = [], None
            self._seen.clear()
        place = bisect_left(self._waiting, stamp_ns, key=lambda item: item[0])
        if place < len(self._waiting) and self._waiting[place][0] == stamp_ns:
            counts.repeated += 1
            return []
        insort(self._waiting, (stamp_ns, value), key=lambda item: item[0])
        found: list[EvenSample[V]] = []
        while self._waiting and self._waiting[-1][0] - self._waiting[0][0] >= self._hold_ns:
            stamp_ns, value = self._waiting.pop(0)
            self._released = stamp_ns
            self._seen.append(stamp_ns)
            found += self._even.add(stamp_ns, value)
        return found
