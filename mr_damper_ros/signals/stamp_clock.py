"""The clock behind the stamps: samples are evenly spaced, the reading of the time jitters.

A test machine's controller samples at a constant period and counts its samples. The stamps that
are put to them, often by a computer that is told of them later, jitter about

    stamp = offset + index · period · (1 + rate)

whose two unknowns are followed by a Kalman filter: the offset from the first stamp on, the rate
from its prior of 0 ± 2 %. Both are remembered for a few seconds, so that a clock may drift.
"""

from __future__ import annotations

import math

from mr_damper_ros.signals.blocks import NANOSECONDS

_JITTER = 0.3
"""Standard deviation of a stamp [sample periods]: that of ± half a period, evenly distributed."""

_RATE = 0.02
"""Standard deviation of the rate at the start [1]: periods are stated in round numbers."""

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
