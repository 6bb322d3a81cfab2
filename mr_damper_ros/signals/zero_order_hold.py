"""Coil current on the sample clock: each value holds until the next one is stamped."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import LATE_NS, NANOSECONDS

KEEP_CURRENT = 3600.0
"""Seconds of values that a stream keeps: where a bag is played as fast as it goes, the current may
come far ahead of the samples that it belongs to."""

_SURPLUS = 8
"""One part in so many may be older than what is kept: to let go of them moves all the others, which
takes milliseconds where an hour of a fast supply is kept."""


class CurrentError(ValueError):
    """A value of the current that cannot be used; the message says why."""


class ZeroOrderHold:
    """Stamped values of the supply current, held from each stamp to the next."""

    def __init__(self, keep: float) -> None:
        """Keep at least the last ``keep`` seconds of values; infinite: all of them."""
        self._keep_ns = round(min(keep * NANOSECONDS, 2.0**62))
        self._stamps = array("q")
        self._values = array("d")
        self._jumped = False

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the newest value; None before the first."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp_ns: int, current: float) -> None:
        """Add a value [A]; one that jumps back in time takes the place of all that came after.

        A value that is only late takes its place among the others. Raises CurrentError for one
        that is not finite.
        """
        if not math.isfinite(current):
            raise CurrentError(f"the current is {current}: it must be a finite number")
        place = bisect_left(self._stamps, stamp_ns)
        back_ns = self._stamps[-1] - stamp_ns if self._stamps else 0
        if back_ns > LATE_NS:
            self._jumped = True
            del self._stamps[place:], self._values[place:]
        elif place < len(self._stamps) and self._stamps[place] == stamp_ns:
            del self._stamps[place], self._values[place]
        self._stamps.insert(place, stamp_ns)
        self._values.insert(place, current)
        # One value older than the horizon stays: it holds up to the next.
        surplus = bisect_right(self._stamps, self._stamps[-1] - self._keep_ns) - 1
        if surplus > len(self._stamps) // _SURPLUS:
            del self._stamps[:surplus], self._values[:surplus]

    def follow_jump(self) -> None:
        """Forget the values of the time before, now that the samples have jumped back.

        If the current jumped first, its values are those of the new time already.
        """
        if not self._jumped:
            del self._stamps[:], self._values[:]
        self._jumped = False

    def known_from(self, stamp_ns: int) -> bool:
        """Whether a value is in force at the stamp."""
        return bool(self._stamps) and self._stamps[0] <= stamp_ns

    def around(self, stamp_ns: int) -> tuple[int, int | None]:
        """Stamp of the value in force at a stamp, and that of the next (None: there is none yet).

        As for :meth:`at`, the first value is taken before it is stamped; there must be one.
        """
        following = bisect_right(self._stamps, stamp_ns) or 1
        later = self._stamps[following] if following < len(self._stamps) else None
        return self._stamps[following - 1], later

    def constant(self, start_ns: int, period: float, count: int) -> float | None:
        """The one value [A] that :meth:`at` gives for these samples; None where there are more."""
        following = bisect_right(self._stamps, start_ns) or 1
        if following < len(self._stamps):
            step = _first_sample(self._stamps[following] - start_ns, period)
            if step < count:
                return None
        return self._values[following - 1]

    def span(self, start_ns: int, end_ns: int) -> tuple[float, float] | None:
        """Lowest and highest value [A] in force from one stamp to another; None if unknown then."""
        if end_ns < start_ns or not self.known_from(start_ns):
            return None
        first, last = (bisect_right(self._stamps, stamp) for stamp in (start_ns, end_ns))
        values = self._values[first - 1 : last]
        return min(values), max(values)

    def at(self, start_ns: int, period: float, count: int) -> Array:
        """Current [A] at ``count`` samples from ``start_ns``, ``period`` [s] apart, shape (n,).

        Before the first value that value is taken: ask :meth:`known_from`.
        """
        following = bisect_right(self._stamps, start_ns) or 1
        result = np.full(count, self._values[following - 1])
        for place in range(following, len(self._stamps)):
            index = _first_sample(self._stamps[place] - start_ns, period)
            if index >= count:
                break
            result[max(index, 0) :] = self._values[place]
        return result


def _first_sample(delay_ns: int, period: float) -> int:
    """The first sample that a step this much after sample 0 shows in."""
    # Rounding of the stamp to nanoseconds must not move a step by one sample.
    return math.ceil(delay_ns / (period * NANOSECONDS) - 1e-3)
