"""Samples that are taken evenly, stamped unevenly, lost now and then, and counted by nobody.

Each stamp is put beside the clock behind the stamps (:mod:`mr_damper_ros.signals.stamp_clock`),
which tells the number of the sample. Where the stamps jitter by half a period, one that is late can
be a late sample or one after a loss; that shows only with the next ones. So the latest few wait,
and those that stay unclear are left out: a sample in the wrong place is worse than none.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.signals.stamp_clock import StampClock

V = TypeVar("V")
"""What is stamped: a number, or all that was measured at a time."""

_HALF, _MARGIN = 0.5, 0.12
"""Sample periods that a stamp may be off, and by how much the clock may be wrong besides."""

_WAITING = 3
"""Samples that wait for the next ones to tell where they belong; more where those are late, too."""

_LONGEST = 1.0
"""Seconds without a stamp after which the clock is not known well enough to count through."""

_ENOUGH, _FEWEST = 256, 12
"""Stamps that a clock is found from; where they come slowly, fewer have to do:"""

_LONGEST_START = 1.0
"""Seconds after which it is found from what has come."""

_STRETCH = 16
"""Stamps whose distance is looked at."""

_GUESSES, _BEGINS = (0.1, 0.25, 0.5), (-0.4, 0.0, 0.4)
"""Quantiles of the distances that are tried for the period, for in the shortest nothing was lost,
and sample periods that the first stamps may be late on the whole."""

_FOLLOWS = ((0.1, 0.005), (0.05, 0.001))
"""Parts of what a stamp is off that a tried clock takes over, in offset and rate."""

_DOUBTFUL, _LOOKED_AT = 0.2, 200
"""Part of so many samples that may look lost or unclear before the clock is found anew."""


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
        self._doubts: deque[bool] = deque(maxlen=_LOOKED_AT)
        # With how late each was stamped [sample periods].
        self._waiting: list[tuple[EvenSample[V], float]] = []
        self.lost = 0
        self.unclear = 0

    def add(self, stamp_ns: int, value: V) -> list[EvenSample[V]]:
        """Take in a sample; returns those that are certain now."""
        certain: list[EvenSample[V]] = []
        if self._clock is not None:
            late_ns = stamp_ns - self._clock.at(self._next)
            doubtful = sum(self._doubts) > _DOUBTFUL * _LOOKED_AT
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
        if len(self._begun) >= _ENOUGH or (len(self._begun) >= _FEWEST and since >= _LONGEST_START):
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
        self._doubts.append(abs(late) > _HALF + _MARGIN)
        if late > _HALF + _MARGIN:
            skipped = math.ceil(late - _HALF - _MARGIN)
            self._leave_out_late_ones()
            self.lost += skipped
            self._next += skipped
            late -= skipped
        elif late < -_HALF - _MARGIN and self._waiting:
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
            late >= _HALF - _MARGIN for _, late in self._waiting
        ):
            return []
        certain = self._waiting[:-_WAITING]
        del self._waiting[:-_WAITING]
        # What has been learnt since makes their times better.
        return [replace(each, time_ns=clock.at(each.index)) for each, _ in certain]

    def _leave_out_late_ones(self) -> None:
        """Samples were lost, and of those stamped so late it is not clear on which side."""
        while self._waiting and self._waiting[-1][1] >= _HALF - _MARGIN:
            self._waiting.pop()
            self.unclear += 1


def _count(stamps_ns: list[int]) -> tuple[float, np.ndarray, int]:
    """Period [s] of samples with these stamps, their numbers (n,), and the time of number 0 [ns].

    Clocks that begin a little differently are tried; that is the right one against which the least
    speaks.
    """
    stamps: Array = (np.asarray(stamps_ns, dtype=np.int64) - stamps_ns[0]).astype(np.float64)
    stretch = min(_STRETCH, stamps.size // 3)
    half = max(stretch // 2, 1)
    # Means of a few jitter less.
    means = np.convolve(stamps, np.full(half, 1.0 / half), "valid")
    guesses = np.quantile(means[stretch:] - means[:-stretch], _GUESSES) / stretch
    counts = [
        numbers
        for guess in guesses.tolist()
        for numbers in (_stepped(stamps / guess, stretch), *_followed(stamps / guess))
    ]
    lines = [_line(stamps, numbers) for numbers in counts]
    _, period, numbers, offset = min(lines, key=lambda line: line[0])
    return period / NANOSECONDS, numbers, stamps_ns[0] + round(offset)


def _line(stamps: Array, numbers: np.ndarray) -> tuple[float, float, np.ndarray, float]:
    """What speaks against the clock that these numbers make, its period, new numbers, its offset.

    The new numbers are those that this clock makes of the stamps. The jitter that it leaves speaks
    against it, and each loss that it needs (as in the Bayesian information criterion).
    """
    slope, offset, against = 1.0, 0.0, 0
    for _ in range(4):
        slope, offset = (float(value) for value in np.polyfit(numbers, stamps, 1))
        numbers, against = _numbered((stamps - offset) / slope)
    jitter = float(np.std((stamps - offset) / slope - numbers))
    cost = stamps.size * math.log(max(jitter, 1e-3)) + against * math.log(stamps.size)
    return cost, slope, numbers, offset


def _stepped(times: Array, stretch: int) -> np.ndarray:
    """Numbers of stamps at ``times`` [periods], by where their means change.

    A loss is where the means before and after it are a period further apart than the count says.
    """
    numbers = np.arange(times.size)
    sums = np.concatenate([[0.0], np.cumsum(times - numbers)])
    place = np.arange(stretch, times.size - stretch + 1)
    apart = (sums[place + stretch] - 2.0 * sums[place] + sums[place - stretch]) / stretch
    while apart.size and apart.max() > _HALF:
        worst = int(np.argmax(apart))
        numbers[place[worst] :] += max(round(float(apart[worst])), 1)
        apart[max(worst - stretch, 0) : worst + stretch + 1] = 0.0
    return numbers


def _followed(times: Array) -> list[np.ndarray]:
    """Numbers of stamps at ``times`` [periods], by clocks that follow the stamps from the first."""
    first = times[: _STRETCH // 2]
    mean = float(np.mean(first - np.arange(first.size)))
    return [
        _numbered(times - mean + begin, follows)[0] for begin in _BEGINS for follows in _FOLLOWS
    ]


def _numbered(times: Array, follows: tuple[float, float] = (0.0, 0.0)) -> tuple[np.ndarray, int]:
    """Numbers of stamps that a clock shows at ``times`` [periods], and what speaks against it.

    The clock follows the stamps with these parts of what they are off, in offset and rate.
    """
    numbers, following, against, off, rate = [], 0, 0, 0.0, 0.0
    for time in times.tolist():
        off += rate
        late = time - following - off
        if late > _HALF + _MARGIN:
            skipped = math.ceil(late - _HALF - _MARGIN)
            following += skipped
            late -= skipped
            against += skipped
        elif late < -_HALF - _MARGIN:
            following -= 1
            late += 1.0
            against += 3
        off += follows[0] * late
        rate += follows[1] * late
        numbers.append(following)
        following += 1
    return np.array(numbers), against
