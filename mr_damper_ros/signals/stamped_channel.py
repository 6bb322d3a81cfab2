"""Channels of stamped values: sorting, numbering, estimation of sample times, and joining."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import LATE_NS, NANOSECONDS
from mr_damper_ros.signals.clocks import PAUSE_NS, ArrivalClock, StampClock

V = TypeVar("V")
"""Type of a stamped value: a number, or all values measured at one time."""

_MARGIN = 0.12
"""A stamp may deviate by half a period plus this fraction of a period, for errors of the clock."""

_WAITING = 3
"""Number of samples that wait until later ones confirm their index; if all are late, more wait."""

_ENOUGH = 256
"""Number of stamps from which a clock is estimated, and with which it is checked; for slow samples
``_STRETCH`` suffice."""

_LARGEST_UNTIMELY_PART = 0.2
"""Fraction of the checked stamps that may be too early or late before the clock is estimated again.
"""

_STRETCH = 16
"""Number of successive sample intervals whose total duration is measured."""

_PERIOD_QUANTILES, _INITIAL_DELAYS = (0.1, 0.25, 0.5), (-0.4, 0.0, 0.4)
"""Initial values that are tried. For the period: quantiles of the durations of ``_STRETCH``
intervals, of which the shortest contain no lost samples. For the mean delay of the first stamps:
values in sample periods. With half a period of jitter and a twentieth of the samples lost, 36 of 40
streams are numbered correctly from the first second; with a single period and delay, only 25."""

_CLOCK_GAINS = (0.05, 0.001)
"""Gains by which a tried clock corrects its offset and its rate for the error of a stamp. With
twice the first and five times the second gain, only 30 of the 40 streams are numbered correctly."""


@dataclass(frozen=True)
class NumberedSample(Generic[V]):
    """A sample with its index, its estimated time [ns], its stamp [ns] and its value."""

    index: int
    time_ns: int
    stamp_ns: int
    value: V


_SET_BACK = 16
"""After this number of late values in a row, the clock of the stamps was set back."""


_COUNTS = ("received", "repeated", "late", "not_finite", "jumps", "lost", "unclear")


class StampedChannel(Generic[V]):
    """Sorts values by their stamps [ns] and estimates the index and time of each sample.

    A value is released when a stamp arrives that is ``hold_back`` [s] later, so that delayed values
    can be sorted in. The order restarts if the stamps are set back, and the estimation of the times
    if they leap in either direction. The ``period`` [s] is estimated
    from the first few hundred stamps and is NaN before. ``counts`` holds the numbers of received
    values, of unusable ones and of jumps back in time, by name; "lost" are the skipped indices,
    "unclear" the samples omitted near them because their index is uncertain.
    """

    def __init__(self, hold_back: float) -> None:
        self._hold_ns = round(hold_back * NANOSECONDS)
        # Stamp [ns], arrival [ns] and value of each sample.
        self._held: list[tuple[int, int, V]] = []
        self._released: int | None = None
        self._late_in_a_row = 0
        # Arrival [ns] of the last numbered sample.
        self._arrival_ns = 0
        self.clock = ArrivalClock()
        self.counts = dict.fromkeys(_COUNTS, 0)
        self.period = math.nan
        self._clock: StampClock | None = None
        self._begun: list[tuple[int, V]] = []
        self._next = 0
        self._doubts: deque[bool] = deque(maxlen=_ENOUGH)
        # Samples and the delay of their stamps [sample periods].
        self._waiting: list[tuple[NumberedSample[V], float]] = []

    def figures(self) -> dict[str, object]:
        """The counts and the sample rate, by name."""
        return {**self.counts, "rate [Hz]": f"{1.0 / self.period:.6g}"}

    def add(self, stamp_ns: int, arrival_ns: int, value: V) -> list[NumberedSample[V]]:
        """Add a value; returns the samples whose order and index are now certain."""
        counts, held = self.counts, self._held
        counts["received"] += 1
        if isinstance(value, float) and not math.isfinite(value):
            counts["not_finite"] += 1
            return []
        self.clock.add(stamp_ns, arrival_ns)
        certain: list[NumberedSample[V]] = []
        behind_ns = 0 if self._released is None else self._released - stamp_ns
        if behind_ns >= LATE_NS or (behind_ns > 0 and self._late_in_a_row >= _SET_BACK):
            counts["jumps"] += 1
            held.clear()
            certain = self._number_anew(self._late_in_a_row)
        elif behind_ns > 0:
            counts["late"] += 1
            self._late_in_a_row += 1
            return []
        self._late_in_a_row = 0
        place = bisect_left(held, stamp_ns, key=lambda item: item[0])
        if stamp_ns == self._released and not held and self._is_other(value):
            # The stamps are frozen: the count gives the time.
            return self._count_on(value)
        if stamp_ns == self._released or (place < len(held) and held[place][0] == stamp_ns):
            counts["repeated"] += 1
            return []
        held.insert(place, (stamp_ns, arrival_ns, value))
        while held and held[-1][0] - held[0][0] >= self._hold_ns:
            self._released, arrived_ns, value = held.pop(0)
            certain += self._number(self._released, arrived_ns, value)
            self._arrival_ns = arrived_ns
        return certain

    def _is_other(self, value: V) -> bool:
        """Whether a value differs from the last one, whose index is known."""
        return bool(self._waiting) and value != self._waiting[-1][0].value

    def _count_on(self, value: V) -> list[NumberedSample[V]]:
        """Number a value whose stamp is that of the last one."""
        assert self._clock is not None
        time_ns = self._clock.at(self._next)
        self._waiting.append((NumberedSample(self._next, time_ns, time_ns, value), 0.0))
        self._next += 1
        return self._certain()

    def _pause_ns(self, stamped_ns: int, waited_ns: int) -> int:
        """Length of a pause [ns] by the stamps and by the arrivals: the shorter one counts."""
        return min(stamped_ns, waited_ns)

    def _number_anew(self, lost: int) -> list[NumberedSample[V]]:
        """Forget the clock of the stamps after ``lost`` samples; returns the samples that wait."""
        certain = [sample for sample, _ in self._waiting]
        if self._clock is not None:
            self.counts["lost"] += lost
            self._next += lost
        self._doubts.clear()
        self._clock, self._waiting, self._begun = None, [], []
        return certain

    def _number(self, stamp_ns: int, arrival_ns: int, value: V) -> list[NumberedSample[V]]:
        """Number the next sample; returns the samples whose index is now certain."""
        certain: list[NumberedSample[V]] = []
        if self._clock is not None:
            late_ns = stamp_ns - self._clock.at(self._next)
            doubtful = sum(self._doubts) > _LARGEST_UNTIMELY_PART * _ENOUGH
            # If the samples have not paused for so long, the clock of the stamps was set.
            passed_ns = self._pause_ns(late_ns, arrival_ns - self._arrival_ns)
            leapt = late_ns > PAUSE_NS and passed_ns < 0.5 * late_ns
            # After a longer silence, the clock is too uncertain to count lost samples.
            if abs(late_ns) < LATE_NS and not doubtful and not leapt:
                return self._place(stamp_ns, value, late_ns / (self.period * NANOSECONDS))
            certain = self._number_anew(max(round(passed_ns / (self.period * NANOSECONDS)), 0))
        self._begun.append((stamp_ns, value))
        since_ns = stamp_ns - self._begun[0][0]
        if len(self._begun) >= _ENOUGH or (len(self._begun) >= _STRETCH and since_ns >= LATE_NS):
            certain += self._begin()
        return certain

    def _begin(self) -> list[NumberedSample[V]]:
        """Estimate the clock from the collected samples and number these samples."""
        begun, self._begun = self._begun, []
        self.period, numbers, first_ns = _count([stamp for stamp, _ in begun])
        self._clock = clock = StampClock(self._next, first_ns, self.period)
        pairs = [(self._next + int(n), stamp) for n, (stamp, _) in zip(numbers, begun, strict=True)]
        for index, stamp in (*pairs, *reversed(pairs)):
            clock.learn(index, stamp)
        # A loss among the very first samples cannot be detected, so they are omitted.
        skipped = min(_STRETCH, len(begun) // 3)
        self._next += int(numbers[skipped])
        certain: list[NumberedSample[V]] = []
        for stamp_ns, value in begun[skipped:]:
            late = (stamp_ns - clock.at(self._next)) / (self.period * NANOSECONDS)
            certain += self._place(stamp_ns, value, late)
        return certain

    def _place(self, stamp_ns: int, value: V, late: float) -> list[NumberedSample[V]]:
        clock, waiting = self._clock, self._waiting
        assert clock is not None
        most = 0.5 + _MARGIN
        self._doubts.append(abs(late) > most)
        if late > most:
            # The index of late samples near a loss is uncertain, so they are omitted.
            while waiting and waiting[-1][1] >= 0.5 - _MARGIN:
                waiting.pop()
                self.counts["unclear"] += 1
            skipped = math.ceil(late - most)
            self.counts["lost"] += skipped
            self._next += skipped
            late -= skipped
        elif late < -most and waiting:
            # The index of the previous sample was too high.
            self._next -= 1
            waiting.pop()
            self.counts["unclear"] += 1
            late += 1.0
        clock.learn(self._next, stamp_ns)
        waiting.append((NumberedSample(self._next, clock.at(self._next), stamp_ns, value), late))
        self._next += 1
        return self._certain()

    def _certain(self) -> list[NumberedSample[V]]:
        """The waiting samples whose index is now certain."""
        clock, waiting = self._clock, self._waiting
        assert clock is not None
        # After an undetected loss all stamps are late, so a stamp that is not late excludes a loss.
        if len(waiting) <= _WAITING or all(late >= 0.5 - _MARGIN for _, late in waiting):
            return []
        certain = waiting[:-_WAITING]
        del waiting[:-_WAITING]
        # The clock has become more accurate since these samples arrived.
        return [replace(each, time_ns=clock.at(each.index)) for each, _ in certain]


def _count(stamps_ns: list[int]) -> tuple[float, np.ndarray, int]:
    """Period [s] of samples with these stamps, their indices (n,), and the time of index 0 [ns].

    Clocks with several initial values are tried, and the one with the lowest cost is chosen. The
    cost contains the remaining jitter and a penalty for each loss, as in the Bayesian information
    criterion.
    """
    stamps: Array = (np.asarray(stamps_ns, dtype=np.int64) - stamps_ns[0]).astype(np.float64)
    stretch = min(_STRETCH, stamps.size // 3)
    half = max(stretch // 2, 1)
    # Averages over a few stamps have less jitter.
    means = np.convolve(stamps, np.full(half, 1.0 / half), "valid")
    guesses = np.quantile(means[stretch:] - means[:-stretch], _PERIOD_QUANTILES) / stretch
    best = (math.inf, 1.0, np.arange(stamps.size), 0.0)
    for guess in guesses.tolist():
        times = stamps / guess
        mean = float(np.mean(times[:half] - np.arange(half)))
        for begin in _INITIAL_DELAYS:
            numbers, _ = _numbered(times - mean + begin, _CLOCK_GAINS)
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
    """Indices of samples stamped at ``times`` [sample periods], and the penalty of this numbering.

    ``follows`` are the gains with which the clock follows the error of a stamp, in offset and rate.
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


@dataclass(frozen=True, eq=False)
class JoinedRun:
    """Joined samples without a gap: index and time [ns] of the first, and values (n,) of both."""

    index: int
    start_ns: int
    leading: Array
    following: Array


class ChannelJoin:
    """Joins the values of a follower channel to the samples of a leader channel.

    With ``own_clocks``, each channel is stamped by its own clock, and both are converted to the
    clock of this computer by the arrival times of the messages. With ``sampled_at_stamps``, values
    were measured at the times of their stamps, so the values of the leader are also interpolated
    onto its uniform time grid. ``without_partner`` counts the samples of the leader for which the
    follower has no value.
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
        self._leading: deque[NumberedSample[float]] = deque()
        self._following: deque[NumberedSample[float]] = deque()
        self._last: list[NumberedSample[float]] = []
        self.without_partner = 0

    def lead(self, stamp_ns: int, arrival_ns: int, value: float) -> None:
        """Add a value of the leader."""
        _extend(self._leading, self.leader.add(stamp_ns, arrival_ns, value))

    def follow(self, stamp_ns: int, arrival_ns: int, value: float) -> None:
        """Add a value of the follower."""
        _extend(self._following, self.follower.add(stamp_ns, arrival_ns, value))

    def take(self) -> list[JoinedRun]:
        """The samples that can be joined now."""
        if not self._leading or len(self._following) < 2:
            return []
        samples = list(self._leading)
        base = samples[0].time_ns
        wanted = np.array([sample.time_ns - base for sample in samples], dtype=np.float64)
        times, values = self._table(self._following, base)
        if self._own_clocks:
            times += self.follower.clock.ahead_ns(base) - self.leader.clock.ahead_ns(base)
        # The cubic needs two samples of the follower after the sample of the leader.
        ready = int(np.searchsorted(wanted, times[-2], side="right"))
        overdue = int(np.searchsorted(wanted, wanted[-1] - PAUSE_NS))
        count = max(ready, overdue)
        if self._at_stamps:
            count = min(count, max(len(samples) - 2, 0))
        if count == 0:
            return []
        wanted = wanted[:count]
        following, known = interpolated(times, values, wanted, self._longest(self.follower))
        leading = np.array([sample.value for sample in samples[:count]])
        if self._at_stamps:
            own = self._table([*self._last, *samples], base)
            leading, there = interpolated(own[0], own[1], wanted, self._longest(self.leader))
            known &= there
        self._last = [samples[count - 1]]
        for _ in range(count):
            self._leading.popleft()
        for _ in range(max(int(np.searchsorted(times, wanted[-1])) - 2, 0)):
            self._following.popleft()
        self.without_partner += int(np.count_nonzero(~known))
        kept = np.flatnonzero(known)
        index = np.array([sample.index for sample in samples])
        parts = np.split(kept, np.flatnonzero(np.diff(index[kept]) != 1) + 1)
        runs = []
        for part in filter(len, parts):
            first = samples[part[0]]
            ahead_ns = self.leader.clock.ahead_ns(first.time_ns) if self._own_clocks else 0
            start_ns = first.time_ns + ahead_ns
            runs.append(JoinedRun(first.index, start_ns, leading[part], following[part]))
        return runs

    def _longest(self, channel: StampedChannel[float]) -> float:
        """Longest time [ns] between two neighbouring samples."""
        # Each of two values sampled at their stamps may deviate by half a period.
        periods = 2.0 if self._at_stamps else 1.5 + _MARGIN
        return periods * channel.period * NANOSECONDS

    def _table(self, samples: Iterable[NumberedSample[float]], base: int) -> Array:
        """Times [ns] after ``base`` and values of the samples, shape (2, n)."""
        rows = [(s.stamp_ns if self._at_stamps else s.time_ns, s.value) for s in samples]
        return np.array([(time - base, value) for time, value in rows], dtype=np.float64).T


def _extend(waiting: deque[NumberedSample[float]], added: list[NumberedSample[float]]) -> None:
    """Append samples; those from before a leap of their clock are dropped."""
    for sample in added:
        if waiting and not 0 <= sample.time_ns - waiting[-1].time_ns < LATE_NS:
            waiting.clear()
        waiting.append(sample)


def interpolated(
    times: Array, values: Array, wanted: Array, longest: float
) -> tuple[Array, np.ndarray]:
    """Values (m,) at the times ``wanted`` (m,), and a mask of the times between two neighbours.

    Neighbours are at most ``longest`` apart, and ``times`` (n,) ascend. The interpolation is cubic
    through the four surrounding samples if all of them are neighbours, and linear otherwise.
    """
    n = times.size
    if n < 2:
        return np.full(wanted.size, np.nan), np.zeros(wanted.size, dtype=bool)
    after = np.clip(np.searchsorted(times, wanted), 1, n - 1)
    before = times[after - 1]
    # A time that coincides with a sample needs no neighbour.
    met = (wanted == before) | (wanted == times[after])
    between = (wanted >= before) & (wanted <= times[after]) & (times[after] - before <= longest)
    line = np.interp(wanted, times, values)
    if n < 4:
        return line, between | met
    around = np.clip(after, 2, n - 2) + np.arange(-2, 2)[:, np.newaxis]
    nodes = times[around]
    near = (after >= 2) & (after <= n - 2) & (np.diff(nodes, axis=0)[[0, 2]] <= longest).all(axis=0)
    cubic = np.zeros(wanted.size)
    for own in range(4):
        others = [other for other in range(4) if other != own]
        apart = nodes[own] - nodes[others]
        ways = (wanted - nodes[others]) / np.where(apart == 0.0, 1.0, apart)
        cubic += ways.prod(axis=0) * values[around[own]]
    return np.where(near & ~met, cubic, line), between | met
