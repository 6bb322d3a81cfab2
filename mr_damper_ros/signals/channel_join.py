"""Two channels that were measured by themselves, joined on the samples of one of them.

The leader's samples are taken as they are; the other channel is interpolated at their times, by a
cubic through the four samples around where it has them. Nothing is invented: where the neighbours
are missing there is no joined sample, and the count goes on: whoever takes them sees a loss.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.even_stamps import EvenSample
from mr_damper_ros.signals.stamped_channel import StampedChannel

_NEIGHBOURS, _JITTERING_NEIGHBOURS = 1.6, 2.0
"""Sample periods: further apart, there is a lost one between two samples."""

_PATIENCE = 0.3
"""Seconds that a sample of the leader waits for the other channel."""


@dataclass(frozen=True, eq=False)
class JoinedRun:
    """Samples without a gap: number and time [ns] of the first, and both values (n,) of each."""

    index: int
    start_ns: int
    leading: Array
    following: Array


class ChannelJoin:
    """Joins a follower to the samples of a leader.

    With ``own_clocks`` each channel is stamped by a clock of its own; both are then brought to that
    of this computer by when the messages arrive. With ``sampled_at_stamps`` the values were taken
    when their stamps say, and the leader's are interpolated onto its even clock, too. Counted: the
    leader's samples that had no partner.
    """

    def __init__(
        self,
        leader: StampedChannel[float],
        follower: StampedChannel[float],
        *,
        own_clocks: bool = False,
        sampled_at_stamps: bool = False,
    ) -> None:
        self.leader, self.follower = leader, follower
        self._own_clocks = own_clocks
        self._at_stamps = sampled_at_stamps
        self._leading: deque[EvenSample[float]] = deque()
        self._following: deque[EvenSample[float]] = deque()
        self._last: EvenSample[float] | None = None
        self.without_partner = 0

    def lead(self, stamp_ns: int, arrival_ns: int, value: float) -> None:
        """Take in a value of the leader."""
        self._leading.extend(self.leader.add(stamp_ns, arrival_ns, value))

    def follow(self, stamp_ns: int, arrival_ns: int, value: float) -> None:
        """Take in a value of the follower."""
        self._following.extend(self.follower.add(stamp_ns, arrival_ns, value))

    def take(self) -> list[JoinedRun]:
        """The samples that can be joined by now."""
        if not self._leading or not self._following:
            return []
        base = self._leading[0].time_ns
        samples = list(self._leading)
        wanted = np.array([sample.time_ns - base for sample in samples], dtype=np.float64)
        ahead = self._ahead_ns(base)
        times = self._times(self._following, base) + ahead
        values = np.array([sample.value for sample in self._following])
        # Two samples of the other channel must lie behind.
        ready = int(np.searchsorted(wanted, times[-2], side="right")) if times.size > 1 else 0
        newest = float(wanted[-1])
        overdue = int(np.searchsorted(wanted, newest - _PATIENCE * NANOSECONDS, side="left"))
        count = max(ready, overdue)
        if self._at_stamps:
            count = min(count, max(len(samples) - 2, 0))
        if count == 0:
            return []
        following, known = interpolated(times, values, wanted[:count], self._longest(self.follower))
        leading = np.array([sample.value for sample in samples[:count]])
        if self._at_stamps:
            before = [self._last] if self._last is not None else []
            own = self._times([*before, *samples], base)
            leading, there = interpolated(
                own,
                np.array([sample.value for sample in (*before, *samples)]),
                wanted[:count],
                self._longest(self.leader),
            )
            known &= there
        self._forget(count, float(wanted[count - 1]), times)
        self.without_partner += int(np.count_nonzero(~known))
        return self._runs(samples[:count], leading, following, known)

    def _longest(self, channel: StampedChannel[float]) -> float:
        """Time [ns] between two neighbours at most."""
        periods = _JITTERING_NEIGHBOURS if self._at_stamps else _NEIGHBOURS
        return periods * channel.period * NANOSECONDS

    def _times(self, samples: Iterable[EvenSample[float]], base: int) -> Array:
        return np.array(
            [(s.stamp_ns if self._at_stamps else s.time_ns) - base for s in samples],
            dtype=np.float64,
        )

    def _ahead_ns(self, stamp_ns: int) -> float:
        """What is to be added to the follower's times for those of the leader."""
        if not self._own_clocks:
            return 0.0
        return float(self.follower.clock.ahead_ns(stamp_ns) - self.leader.clock.ahead_ns(stamp_ns))

    def _forget(self, count: int, until: float, times: Array) -> None:
        for _ in range(count):
            self._last = self._leading.popleft()
        for _ in range(max(int(np.searchsorted(times, until)) - 2, 0)):
            self._following.popleft()

    def _runs(
        self, samples: list[EvenSample[float]], leading: Array, following: Array, known: np.ndarray
    ) -> list[JoinedRun]:
        index = np.array([sample.index for sample in samples])
        kept = np.flatnonzero(known)
        if kept.size == 0:
            return []
        breaks = np.flatnonzero(np.diff(index[kept]) != 1) + 1
        return [
            JoinedRun(
                int(index[part[0]]),
                self._start_ns(samples[part[0]].time_ns),
                leading[part],
                following[part],
            )
            for part in np.split(kept, breaks)
        ]

    def _start_ns(self, time_ns: int) -> int:
        return time_ns + (self.leader.clock.ahead_ns(time_ns) if self._own_clocks else 0)


def interpolated(
    times: Array, values: Array, wanted: Array, longest: float
) -> tuple[Array, np.ndarray]:
    """Values (m,) at the ``wanted`` times, and a mask of those that lie between two neighbours.

    Neighbours are at most ``longest`` apart. ``times`` (n,) rise; a cubic goes through the four
    around where they are all neighbours, else a straight line through the two.
    """
    n = times.size
    if n < 2:
        return np.full(wanted.size, np.nan), np.zeros(wanted.size, dtype=bool)
    after = np.clip(np.searchsorted(times, wanted, side="left"), 1, n - 1)
    t0, t1 = times[after - 1], times[after]
    # A sample that is met exactly needs no neighbour.
    met = (wanted == t0) | (wanted == t1)
    known = ((wanted >= t0) & (wanted <= t1) & (t1 - t0 <= longest)) | met
    width = np.where(t1 > t0, t1 - t0, 1.0)
    place = np.clip((wanted - t0) / width, 0.0, 1.0)
    line = values[after - 1] + (values[after] - values[after - 1]) * place
    line = np.where(wanted == t1, values[after], line)
    inner = (after >= 2) & (after <= n - 2)
    i = np.clip(after, 2, max(n - 2, 2)) if n >= 4 else after
    if n < 4:
        return line, known
    near = inner & (times[i - 1] - times[i - 2] <= longest) & (times[i + 1] - times[i] <= longest)
    nodes = [i - 2, i - 1, i, i + 1]
    cubic = np.zeros(wanted.size)
    for own in nodes:
        weight = np.ones(wanted.size)
        for other in nodes:
            if other is not own:
                apart = times[own] - times[other]
                weight *= (wanted - times[other]) / np.where(apart == 0.0, 1.0, apart)
        cubic += weight * values[own]
    return np.where(near & ~met, cubic, line), known
