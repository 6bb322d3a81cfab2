"""Estimates of clocks from stamps, arrival times and sample counts."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from mr_damper_ros.signals.arrays import SIGMAS
from mr_damper_ros.signals.blocks import NANOSECONDS

_JITTER = math.sqrt(1.0 / 12.0)
"""Standard deviation of a stamp [sample periods], for a uniform error within ± half a period."""

_RATE = 0.02
"""Initial standard deviation of the rate [1], because a stated period is rounded. If the rate of
samples differs from the stated rate by more than this fraction, they are not used."""

_MEMORY = 2.0
"""Approximate duration [s] of the newest stamps that determine the present offset."""


class StampClock:
    """Estimates the clock of samples ``period`` [s] apart from their indices and stamps [ns]."""

    def __init__(self, index: int, stamp_ns: int, period: float) -> None:
        self._period_ns = period * NANOSECONDS
        # Offset [sample periods] from the stamp of the reference index, and rate error [1].
        self._index, self._stamp_ns = index, stamp_ns
        self._offset, self._rate = 0.0, 0.0
        self._cov = (_JITTER**2, 0.0, _RATE**2)
        self._drift = _JITTER**2 * (period / _MEMORY) ** 4

    def at(self, index: int) -> int:
        """Estimated time [ns] of a sample."""
        samples = index - self._index
        return self._stamp_ns + round(
            (samples + self._offset + self._rate * samples) * self._period_ns
        )

    def learn(self, index: int, stamp_ns: int) -> None:
        """Update the clock with the stamp of a later sample."""
        samples = index - self._index
        p00, p01, p11 = self._cov
        p00 += samples * (2.0 * p01 + samples * p11)
        p01 += samples * p11
        p11 += abs(samples) * self._drift
        offset = self._offset + self._rate * samples
        error = (stamp_ns - self._stamp_ns) / self._period_ns - samples - offset
        spread = p00 + _JITTER**2
        limit = SIGMAS * math.sqrt(spread)
        error = min(max(error, -limit), limit)
        by_offset, by_rate = p00 / spread, p01 / spread
        self._rate += by_rate * error
        self._cov = (p00 - by_offset * p00, p01 - by_offset * p01, p11 - by_rate * p01)
        # Moving the reference keeps the numbers small.
        step = samples * self._period_ns
        whole = round(step)
        self._index, self._stamp_ns = index, self._stamp_ns + whole
        self._offset = offset + by_offset * error + (step - whole) / self._period_ns


_SECONDS = 60
"""Duration [s] of the arrivals to which the line is fitted."""

_CHECKED = 5
"""Time [s] of arrivals before the rate is estimated; at first only the offset is estimated."""

_BOUNDED, _SCATTERS = 10, 4.0
"""Time [s] of arrivals before the error of the rate is bounded. Within all arrivals, this error may
shift the line by so many times their scatter about it, because delays often change slowly."""


class ArrivalClock:
    """Estimates how far the clock of this computer is ahead of the clock of the stamps.

    It fits a line to the smallest difference between arrival time and stamp in each second.
    """

    def __init__(self) -> None:
        self._least: deque[tuple[int, int]] = deque(maxlen=_SECONDS)
        self._second: int | None = None
        self._line = (0.0, 0.0, 0)
        self.rate_bound = math.inf
        """Bound of the error of the rate [1]; infinite while unknown."""

    @property
    def rate(self) -> float:
        """Relative rate by which the clock of this computer is faster [1]; 0 while unknown."""
        return self._line[0]

    def add(self, stamp_ns: int, arrival_ns: int) -> None:
        """Add the stamp [ns] and the arrival time [ns] of a message."""
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
        """Time [ns] to add to a stamp to convert it to the clock of this computer."""
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
        if times.size >= _BOUNDED:
            scatter = float(np.ptp(ahead - slope * times))
            self.rate_bound = _SCATTERS * scatter / float(np.ptp(times))
        self._line = (float(slope), float(offset), base)


PAUSE_NS = 250_000_000
"""If the delay of the samples exceeds this time for a second, the source has paused. If samples are
early by more than this, they were queued, or their rate is higher than stated."""

_SILENCE_NS = 2 * NANOSECONDS
"""After this time without a sample, a delay counts as a pause at once."""

_LATE = 64
"""A count that goes back by at most this number belongs to a delayed sample. After this number of
such samples in a row, the count has been restarted."""


_COUNTS = ("received", "lost", "late", "pauses", "recounts", "held_back")


class CountedTimes:
    """Indices and times [ns] of samples with a stated ``rate`` [Hz].

    ``modulus`` is the number of samples after which the sender's sequence number returns to 0; it
    is None for a sender without sequence numbers. With ``checks_rate``, samples are discarded until
    the rate has been checked, and as long as it is wrong. ``counts`` holds the numbers of received
    samples, of unusable samples and of interruptions.
    """

    def __init__(
        self, rate: float, modulus: int | None = None, *, checks_rate: bool = True
    ) -> None:
        self.period = 1.0 / rate
        self._period_ns = NANOSECONDS / rate
        self._modulus = modulus
        self._checks_rate = checks_rate
        self._clock = ArrivalClock()
        self._index = -1
        self._count: int | None = None
        self._arrival_ns: int | None = None
        # Start of the present second of arrivals, and the smallest delay within it.
        self._second_ns, self._least_ns = 0, 0
        self._late_in_a_row = 0
        self._checked_from = 0
        self._is_interrupted = False
        self.counts = dict.fromkeys(_COUNTS, 0)

    @property
    def rate_error(self) -> float:
        """Relative rate by which the samples arrive faster than stated [1]; 0 while unknown."""
        return -self._clock.rate

    @property
    def being_checked(self) -> bool:
        """Whether the check of the rate is still in progress."""
        seen = (self._index - self._checked_from) * self.period
        return self._checks_rate and self._index >= 0 and seen < _CHECKED

    @property
    def rate_is_wrong(self) -> bool:
        """Whether the rate differs so much from the stated one that the samples cannot be used."""
        return self._checks_rate and abs(self._clock.rate) > _RATE

    def time_ns(self, index: int) -> int:
        """Time of a sample [ns] on the clock of the arrivals."""
        nominal_ns = round(index * self._period_ns)
        return nominal_ns + self._clock.ahead_ns(nominal_ns)

    def skip(self, number: int = 1) -> None:
        """Count ``number`` unreadable samples as lost; sequence numbers make this unnecessary."""
        if self._modulus is None and self._arrival_ns is not None:
            self._index += number
            self.counts["lost"] += number

    def interrupted(self) -> None:
        """Record a lost connection: the arrival time alone then places the next sample."""
        self._is_interrupted = True

    def add(self, count: int | None, arrival_ns: int) -> int | None:
        """Index of a sample that has arrived; None if it cannot be used."""
        self.counts["received"] += 1
        step = self._step(count, arrival_ns)
        if step is None:
            self.counts["late"] += 1
            return None
        self._index += step
        nominal_ns = round(self._index * self._period_ns)
        late_ns = arrival_ns - nominal_ns - self._clock.ahead_ns(nominal_ns)
        if self._arrival_ns is None or late_ns < -PAUSE_NS:
            # After the first sample, or with a wrong clock, the check of the rate restarts.
            self._begin_clock(arrival_ns)
            self._checked_from = self._index
            late_ns = 0
        elif self._is_interrupted:
            self._begin_clock(arrival_ns)
            late_ns = 0
        elif self._paused(arrival_ns, late_ns):
            self._index += max(round(late_ns / self._period_ns), 0)
            self.counts["pauses"] += 1
            nominal_ns, late_ns = round(self._index * self._period_ns), 0
        self._arrival_ns = arrival_ns
        if late_ns <= PAUSE_NS:
            # A larger delay may be a pause, which must not affect the clock.
            self._clock.add(nominal_ns, arrival_ns)
        self._is_interrupted = False
        if self.being_checked or self.rate_is_wrong:
            self.counts["held_back"] += 1
            return None
        return self._index

    def _step(self, count: int | None, arrival_ns: int) -> int | None:
        """Increase of the index since the last sample; None for a delayed sample."""
        if self._arrival_ns is None or self._is_interrupted:
            self._count = None if count is None else count % (self._modulus or 1)
            return self._passed(arrival_ns)
        if self._modulus is None or count is None or self._count is None:
            return 1
        count %= self._modulus
        forward = (count - self._count) % self._modulus
        back = -forward % self._modulus
        if back <= min(_LATE, self._modulus // 4) and self._late_in_a_row < _LATE:
            self._late_in_a_row += 1
            return None
        self._late_in_a_row = 0
        self._count = count
        longest_ns = arrival_ns - self._arrival_ns + NANOSECONDS
        if forward == 0 or (forward > 1 and forward * self._period_ns > longest_ns):
            # The count has advanced by more than the elapsed time allows, so it has been restarted.
            self.counts["recounts"] += 1
            return self._passed(arrival_ns)
        self.counts["lost"] += forward - 1
        return forward

    def _passed(self, arrival_ns: int) -> int:
        """Number of samples since the last one according to the elapsed time; at least 1."""
        if self._arrival_ns is None:
            return 1
        return max(round((arrival_ns - self.time_ns(self._index)) / self._period_ns), 1)

    def _begin_clock(self, arrival_ns: int) -> None:
        self._clock = ArrivalClock()
        self._second_ns, self._least_ns = arrival_ns, 0

    def _paused(self, arrival_ns: int, late_ns: int) -> bool:
        """Whether the source has paused: the delay has grown for longer than a burst lasts."""
        assert self._arrival_ns is not None
        if arrival_ns - self._arrival_ns > _SILENCE_NS and late_ns > PAUSE_NS:
            self._second_ns, self._least_ns = arrival_ns, 0
            return True
        if arrival_ns - self._second_ns < NANOSECONDS:
            self._least_ns = min(self._least_ns, late_ns)
            return False
        paused = self._least_ns > PAUSE_NS
        self._second_ns, self._least_ns = arrival_ns, 0 if paused else late_ns
        if paused:
            # Without a silence the rate may have changed, so its check restarts.
            self._checked_from = self._index
            self._clock = ArrivalClock()
        return paused
