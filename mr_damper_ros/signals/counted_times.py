"""Samples that come evenly, at a stated rate, counted by their sender or by nobody.

The number of a sample tells when it was taken, on a clock of the sender's; when samples arrive
tells how that clock stands beside this computer's (:mod:`mr_damper_ros.signals.arrival_clock`).
Where the sender paused, was started again or lost count, the number goes on by the time that has
passed, so that whoever takes the samples sees a gap of the right length.
"""

from __future__ import annotations

from dataclasses import dataclass

from mr_damper_ros.signals.arrival_clock import ArrivalClock
from mr_damper_ros.signals.blocks import NANOSECONDS

_CHECKED = 5.0
"""Seconds of samples that show their rate by when they arrive, and are held back."""

_WRONG_RATE = 0.02
"""Difference of the rate from the stated one at which nothing of it can be used."""

_PAUSE_NS = 250_000_000
"""The least lateness within a second from which on there was a pause."""

_SILENCE_NS = 2 * NANOSECONDS
"""After so long without a sample there was one in any case."""

_AHEAD_NS = 200_000_000
"""So much too early come samples that had been waiting, or such of a higher rate."""

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
        return self._checks_rate and abs(self._clock.rate) > _WRONG_RATE

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
        if self._arrival_ns is None or late_ns < -_AHEAD_NS:
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
