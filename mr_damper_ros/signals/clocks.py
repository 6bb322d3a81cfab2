"""The clocks behind stamps, arrivals and counts."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.signals.blocks import NANOSECONDS

_JITTER = 0.3
"""Standard deviation of a stamp [sample periods]: that of ± half a period, evenly distributed."""

_RATE = 0.02
"""Standard deviation of the rate at the start [1]: periods are stated in round numbers. Samples
that come so much faster or slower than stated cannot be used."""

_MEMORY = 2.0
"""Seconds of stamps that the present offset rests on, or so."""

_OUTLIER = 4.0
"""A stamp further away, in its own standard deviations, counts as if it were no further."""


class StampClock:
    """Follows the stamps [ns] of samples ``period`` [s] apart, which are counted by an index."""

    def __init__(self, index: int, stamp_ns: int, period: float) -> None:
        self._period_ns = period * NANOSECONDS
        # Offset [sample periods] from the reference stamp of the reference index, and rate [1].
        self._index, self._stamp_ns = index, stamp_ns
        self._offset, self._rate = 0.0, 0.0
        self._cov = (_JITTER**2, 0.0, _RATE**2)
        self._drift = _JITTER**2 * (period / _MEMORY) ** 4

    def at(self, index: int) -> int:
        """The time [ns] at which a sample was taken."""
        samples = index - self._index
        return self._stamp_ns + round(
            (samples + self._offset + self._rate * samples) * self._period_ns
        )

    def learn(self, index: int, stamp_ns: int) -> None:
        """Take in the stamp of a later sample."""
        samples = index - self._index
        p00, p01, p11 = self._cov
        p00 += samples * (2.0 * p01 + samples * p11)
        p01 += samples * p11
        p11 += abs(samples) * self._drift
        offset = self._offset + self._rate * samples
        error = (stamp_ns - self._stamp_ns) / self._period_ns - samples - offset
        spread = p00 + _JITTER**2
        limit = _OUTLIER * math.sqrt(spread)
        error = min(max(error, -limit), limit)
        by_offset, by_rate = p00 / spread, p01 / spread
        self._rate += by_rate * error
        self._cov = (p00 - by_offset * p00, p01 - by_offset * p01, p11 - by_rate * p01)
        # The reference moves along, so that no number grows.
        step = samples * self._period_ns
        whole = round(step)
        self._index, self._stamp_ns = index, self._stamp_ns + whole
        self._offset = offset + by_offset * error + (step - whole) / self._period_ns


_SECONDS = 60
"""Seconds that the line is drawn through."""

_CHECKED = 5
"""Seconds of arrivals that show their rate; before there is only an offset."""


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
        if len(self._least) <= _CHECKED:
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
        if times.size < _CHECKED:
            self._line = (0.0, float(ahead.min()), base)
            return
        slope, offset = np.polyfit(times, ahead, 1)
        self._line = (float(slope), float(offset), base)


_PAUSE_NS = 250_000_000
"""The least lateness within a second from which on there was a pause. So much too early come
samples that had been waiting, or such of a higher rate."""

_SILENCE_NS = 2 * NANOSECONDS
"""After so long without a sample there was one in any case."""

_LATE, _MOST_LATE = 64, 16
"""A count this far back is a sample that was overtaken; so many in a row are a new count."""


@dataclass
class ArrivalCounts:
    """What has come, and what of it was of no use."""

    received: int = 0
    lost: int = 0
    late: int = 0
    pauses: int = 0
    recounts: int = 0
    held_back: int = 0


class CountedTimes:
    """Numbers and times [ns] of samples at a stated ``rate`` [Hz].

    ``counts`` is after how many the sender's count begins at 0 again; None where it does not count.
    With ``checks_rate`` nothing is of use before the rate has been found to be right, and from when
    it is found wrong.
    """

    def __init__(self, rate: float, counts: int | None = None, *, checks_rate: bool = True) -> None:
        self.period = 1.0 / rate
        self._period_ns = NANOSECONDS / rate
        self._counts = counts
        self._checks_rate = checks_rate
        self._clock = ArrivalClock()
        self._index = -1
        self._count: int | None = None
        self._arrival_ns: int | None = None
        # Of the present second of arrivals: since when, and the least lateness.
        self._second_ns, self._least_ns = 0, 0
        self._late_in_a_row = 0
        self._checked_from = 0
        self._is_interrupted = False
        self.counts = ArrivalCounts()

    @property
    def rate_error(self) -> float:
        """How much faster the samples come than stated [1]; 0 as long as it is not known."""
        return -self._clock.rate

    @property
    def being_checked(self) -> bool:
        """Whether it is not known yet if the rate is right."""
        seen = (self._index - self._checked_from) * self.period
        return self._checks_rate and self._index >= 0 and seen < _CHECKED

    @property
    def rate_is_wrong(self) -> bool:
        """Whether the samples come so much faster or slower that they cannot be used."""
        return self._checks_rate and abs(self._clock.rate) > _RATE

    def time_ns(self, index: int) -> int:
        """When a sample was taken, by the clock of the arrivals."""
        nominal_ns = round(index * self._period_ns)
        return nominal_ns + self._clock.ahead_ns(nominal_ns)

    def skip(self, number: int = 1) -> None:
        """So many samples have come that cannot be read; a sender that counts need not be told."""
        if self._counts is None and self._arrival_ns is not None:
            self._index += number
            self.counts.lost += number

    def interrupted(self) -> None:
        """The connection was lost: where the next sample belongs, only the time tells."""
        self._is_interrupted = True

    def add(self, count: int | None, arrival_ns: int) -> int | None:
        """The number of a sample that has come; None where it is of no use."""
        self.counts.received += 1
        step = self._step(count, arrival_ns)
        if step is None:
            self.counts.late += 1
            return None
        self._index += step
        nominal_ns = round(self._index * self._period_ns)
        late_ns = arrival_ns - nominal_ns - self._clock.ahead_ns(nominal_ns)
        if self._arrival_ns is None or late_ns < -_PAUSE_NS:
            # The first, or a clock that was wrong: what follows is looked at anew.
            self._begin_clock(arrival_ns)
            self._checked_from = self._index
            late_ns = 0
        elif self._is_interrupted:
            self._begin_clock(arrival_ns)
            late_ns = 0
        elif self._paused(arrival_ns, late_ns):
            self._index += max(round(late_ns / self._period_ns), 0)
            self.counts.pauses += 1
            nominal_ns, late_ns = round(self._index * self._period_ns), 0
        self._arrival_ns = arrival_ns
        if late_ns <= _PAUSE_NS:
            # Else there may be a pause, which is none of the clock's.
            self._clock.add(nominal_ns, arrival_ns)
        self._is_interrupted = False
        if self.being_checked or self.rate_is_wrong:
            self.counts.held_back += 1
            return None
        return self._index

    def _step(self, count: int | None, arrival_ns: int) -> int | None:
        """How much further than the last one a sample is; None for one that comes too late."""
        if self._arrival_ns is None or self._is_interrupted:
            self._count = None if count is None else count % (self._counts or 1)
            return self._passed(arrival_ns)
        if self._counts is None or count is None or self._count is None:
            return 1
        count %= self._counts
        forward = (count - self._count) % self._counts
        back = -forward % self._counts
        if back <= min(_LATE, self._counts // 4) and self._late_in_a_row < _MOST_LATE:
            self._late_in_a_row += 1
            return None
        self._late_in_a_row = 0
        self._count = count
        longest_ns = arrival_ns - self._arrival_ns + NANOSECONDS
        if forward == 0 or (forward > 1 and forward * self._period_ns > longest_ns):
            # Further on than time has passed: it is another count.
            self.counts.recounts += 1
            return self._passed(arrival_ns)
        self.counts.lost += forward - 1
        return forward

    def _passed(self, arrival_ns: int) -> int:
        """Samples from the last one to one that comes now, as time has passed; at least 1."""
        if self._arrival_ns is None:
            return 1
        return max(round((arrival_ns - self.time_ns(self._index)) / self._period_ns), 1)

    def _begin_clock(self, arrival_ns: int) -> None:
        self._clock = ArrivalClock()
        self._second_ns, self._least_ns = arrival_ns, 0

    def _paused(self, arrival_ns: int, late_ns: int) -> bool:
        """Whether samples come later than they did, and not just in bursts."""
        assert self._arrival_ns is not None
        if arrival_ns - self._arrival_ns > _SILENCE_NS and late_ns > _PAUSE_NS:
            self._second_ns, self._least_ns = arrival_ns, 0
            return True
        if arrival_ns - self._second_ns < NANOSECONDS:
            self._least_ns = min(self._least_ns, late_ns)
            return False
        paused = self._least_ns > _PAUSE_NS
        self._second_ns, self._least_ns = arrival_ns, 0 if paused else late_ns
        if paused:
            # Such as never fall silent may come at another rate: that is to be found anew.
            self._checked_from = self._index
            self._clock = ArrivalClock()
        return paused
