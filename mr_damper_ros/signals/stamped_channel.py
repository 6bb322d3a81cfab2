"""Channels of stamped values as they arrive: in order, counted, at their times, and joined."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import LATE_NS, NANOSECONDS
from mr_damper_ros.signals.clocks import ArrivalClock, StampClock

V = TypeVar("V")
"""What is stamped: a number, or all that was measured at a time."""

_MARGIN = 0.12
"""A stamp may be off by half a period, and by this part of one more for what the clock is wrong."""

_WAITING = 3
"""Samples that wait for the next ones to tell where they belong; more where those are late, too."""

_LONGEST = 1.0
"""Seconds without a stamp after which the clock is not known well enough to count through, and in
which it is found from what has come."""

_ENOUGH, _FEWEST = 256, 12
"""Stamps that a clock is found from, and by which it is doubted; where they come slowly, fewer."""

_DOUBTFUL = 0.2
"""Part of them that may look lost or unclear before the clock is found anew."""

_STRETCH = 16
"""Stamps whose distance is looked at."""

_GUESSES, _BEGINS = (0.1, 0.25, 0.5), (-0.4, 0.0, 0.4)
"""Quantiles of the distances that are tried for the period, for in the shortest nothing was lost,
and sample periods that the first stamps may be late on the whole. With half a period of jitter and
a twentieth lost, 36 of 40 streams are counted right from the first second; with one of each, 25."""

_FOLLOWS = (0.05, 0.001)
"""Parts of what a stamp is off that a tried clock takes over, in offset and rate. Twice and five
times as much counts 30 of those streams right."""

_REMEMBERED = 64
"""Stamps that are remembered, so that one that comes again is known."""

_PATIENCE = 0.3
"""Seconds that a sample of the leader waits for the other channel."""


@dataclass(frozen=True)
class EvenSample(Generic[V]):
    """A sample by its number, when it was taken by the clock [ns], its stamp and its value."""

    index: int
    time_ns: int
    stamp_ns: int
    value: V


class EvenStamps(Generic[V]):
    """Finds the numbers and times of samples; stamps [ns] come in their order.

    The period is found from the first few hundred. ``lost`` counts the numbers that were skipped,
    ``unclear`` the samples that were left out.
    """

    def __init__(self) -> None:
        self.period = math.nan
        """Time [s] between two samples; NaN until it is known."""
        self._clock: StampClock | None = None
        self._begun: list[tuple[int, V]] = []
        self._next = 0
        self._doubts: deque[bool] = deque(maxlen=_ENOUGH)
        # With how late each was stamped [sample periods].
        self._waiting: list[tuple[EvenSample[V], float]] = []
        self.lost = 0
        self.unclear = 0

    def add(self, stamp_ns: int, value: V) -> list[EvenSample[V]]:
        """Take in a sample; returns those that are certain now."""
        certain: list[EvenSample[V]] = []
        if self._clock is not None:
            late_ns = stamp_ns - self._clock.at(self._next)
            doubtful = sum(self._doubts) > _DOUBTFUL * _ENOUGH
            if abs(late_ns) < _LONGEST * NANOSECONDS and not doubtful:
                return self._place(stamp_ns, value, late_ns / (self.period * NANOSECONDS))
            self._doubts.clear()
            certain = [sample for sample, _ in self._waiting]
            skipped = max(round(late_ns / (self.period * NANOSECONDS)), 0)
            self.lost += skipped
            self._next += skipped
            self._clock, self._waiting = None, []
        self._begun.append((stamp_ns, value))
        since = (stamp_ns - self._begun[0][0]) / NANOSECONDS
        if len(self._begun) >= _ENOUGH or (len(self._begun) >= _FEWEST and since >= _LONGEST):
            certain += self._begin()
        return certain

    def _begin(self) -> list[EvenSample[V]]:
        """Find the clock from what has come, and begin with that."""
        begun, self._begun = self._begun, []
        self.period, numbers, first_ns = _count([stamp for stamp, _ in begun])
        clock = StampClock(self._next, first_ns, self.period)
        pairs = [(self._next + int(n), stamp) for n, (stamp, _) in zip(numbers, begun, strict=True)]
        for index, stamp in (*pairs, *reversed(pairs)):
            clock.learn(index, stamp)
        self._clock = clock
        # A loss among the very first would not show: they are left out.
        skipped = min(_STRETCH, len(begun) // 3)
        self._next += int(numbers[skipped])
        certain: list[EvenSample[V]] = []
        for stamp_ns, value in begun[skipped:]:
            late = (stamp_ns - clock.at(self._next)) / (self.period * NANOSECONDS)
            certain += self._place(stamp_ns, value, late)
        return certain

    def _place(self, stamp_ns: int, value: V, late: float) -> list[EvenSample[V]]:
        clock = self._clock
        assert clock is not None
        self._doubts.append(abs(late) > 0.5 + _MARGIN)
        if late > 0.5 + _MARGIN:
            skipped = math.ceil(late - 0.5 - _MARGIN)
            self._leave_out_late_ones()
            self.lost += skipped
            self._next += skipped
            late -= skipped
        elif late < -0.5 - _MARGIN and self._waiting:
            # The one before was taken for a later one than it is.
            self._next -= 1
            self._waiting.pop()
            self.unclear += 1
            late += 1.0
        clock.learn(self._next, stamp_ns)
        sample = EvenSample(self._next, clock.at(self._next), stamp_ns, value)
        self._waiting.append((sample, late))
        self._next += 1
        # After a loss that has not shown, all are late: one that is not tells that there is none.
        if len(self._waiting) <= _WAITING or all(
            late >= 0.5 - _MARGIN for _, late in self._waiting
        ):
            return []
        certain = self._waiting[:-_WAITING]
        del self._waiting[:-_WAITING]
        # What has been learnt since makes their times better.
        return [replace(each, time_ns=clock.at(each.index)) for each, _ in certain]

    def _leave_out_late_ones(self) -> None:
        """Samples were lost, and of those stamped so late it is not clear on which side."""
        while self._waiting and self._waiting[-1][1] >= 0.5 - _MARGIN:
            self._waiting.pop()
            self.unclear += 1


def _count(stamps_ns: list[int]) -> tuple[float, np.ndarray, int]:
    """Period [s] of samples with these stamps, their numbers (n,), and the time of number 0 [ns].

    Clocks that begin a little differently are tried; that is the right one against which the least
    speaks: the jitter that it leaves, and each loss that it needs (as in the Bayesian information
    criterion).
    """
    stamps: Array = (np.asarray(stamps_ns, dtype=np.int64) - stamps_ns[0]).astype(np.float64)
    stretch = min(_STRETCH, stamps.size // 3)
    half = max(stretch // 2, 1)
    # Means of a few jitter less.
    means = np.convolve(stamps, np.full(half, 1.0 / half), "valid")
    guesses = np.quantile(means[stretch:] - means[:-stretch], _GUESSES) / stretch
    best = (math.inf, 1.0, np.arange(stamps.size), 0.0)
    for guess in guesses.tolist():
        times = stamps / guess
        mean = float(np.mean(times[:half] - np.arange(half)))
        for begin in _BEGINS:
            numbers, _ = _numbered(times - mean + begin, _FOLLOWS)
            slope, offset, against = 1.0, 0.0, 0
            for _ in range(4):
                slope, offset = (float(value) for value in np.polyfit(numbers, stamps, 1))
                numbers, against = _numbered((stamps - offset) / slope)
            jitter = float(np.std((stamps - offset) / slope - numbers))
            cost = stamps.size * math.log(max(jitter, 1e-3)) + against * math.log(stamps.size)
            if cost < best[0]:
                best = cost, slope, numbers, offset
    _, period, numbers, offset = best
    return period / NANOSECONDS, numbers, stamps_ns[0] + round(offset)


def _numbered(times: Array, follows: tuple[float, float] = (0.0, 0.0)) -> tuple[np.ndarray, int]:
    """Numbers of stamps that a clock shows at ``times`` [periods], and what speaks against it.

    The clock follows the stamps with these parts of what they are off, in offset and rate.
    """
    numbers, following, against, off, rate = [], 0, 0, 0.0, 0.0
    for time in times.tolist():
        off += rate
        late = time - following - off
        if late > 0.5 + _MARGIN:
            skipped = math.ceil(late - 0.5 - _MARGIN)
            following += skipped
            late -= skipped
            against += skipped
        elif late < -0.5 - _MARGIN:
            following -= 1
            late += 1.0
            against += 3
        off += follows[0] * late
        rate += follows[1] * late
        numbers.append(following)
        following += 1
    return np.array(numbers), against


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
    Stamps that are set back begin anew.
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
            if self._released - stamp_ns < LATE_NS:
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
        # Two that were sampled at their stamps may both be off by half a period.
        periods = 2.0 if self._at_stamps else 1.5 + _MARGIN
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
    place = np.clip((wanted - t0) / np.where(t1 > t0, t1 - t0, 1.0), 0.0, 1.0)
    line = values[after - 1] + (values[after] - values[after - 1]) * place
    line = np.where(wanted == t1, values[after], line)
    if n < 4:
        return line, known
    around = np.clip(after, 2, n - 2) + np.arange(-2, 2)[:, np.newaxis]
    nodes = times[around]
    near = (after >= 2) & (after <= n - 2) & (np.diff(nodes, axis=0)[[0, 2]] <= longest).all(axis=0)
    cubic = np.zeros(wanted.size)
    for own in range(4):
        others = [other for other in range(4) if other != own]
        apart = nodes[own] - nodes[others]
        ways = (wanted - nodes[others]) / np.where(apart == 0.0, 1.0, apart)
        cubic += ways.prod(axis=0) * values[around[own]]
    return np.where(near & ~met, cubic, line), known
