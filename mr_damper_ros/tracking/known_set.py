"""A parameter set that has been in use, and what motions and currents it is for."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mr_damper_ros.models.parameter_set import ParameterSet

SAME_CURRENT = 0.05
"""Currents [A] within this of each other are one operating point."""

_SAME_SPEED = 1.1
_SAME_TIME = 1.5
"""A set whose range begins and ends as that of another takes its place, if it came in a motion
about as fast."""

Span = tuple[float, float]
"""The lowest and the highest current [A] of one window, or of several."""


@dataclass(frozen=True, eq=False)
class KnownSet:
    """A set, and the stamp up to which it fits the samples (None: it does not age).

    ``half_cycle`` [s] of the motion in which it came, NaN where that was not known. ``currents`` of
    the windows that it fits, None where that is not known: it then counts for all. ``whole``:
    whether it is for all operating points, and no window's.
    """

    parameters: ParameterSet
    confirmed_ns: int | None
    half_cycle: float = math.nan
    currents: Span | None = None
    whole: bool = False

    def replaces(self, other: KnownSet) -> bool:
        """Whether the set is for the motions and currents of another."""
        times = self.half_cycle, other.half_cycle
        mine, its = self.parameters, other.parameters
        speeds = zip(mine.peak_velocity_range, its.peak_velocity_range, strict=True)
        currents = zip(mine.current_range, its.current_range, strict=True)
        return (
            not max(times) > _SAME_TIME * min(times)
            and all(max(pair) <= _SAME_SPEED * min(pair) for pair in speeds)
            and all(a == b or abs(a - b) <= SAME_CURRENT for a, b in currents)
        )

    def covers(self, other: KnownSet) -> bool:
        """Whether the set holds at all currents that another is known to hold at."""
        low, high = other.parameters.current_range
        return all(
            within(current, self.parameters.current_range)
            for current in (low, high)
            if math.isfinite(current)
        )

    def is_for(self, speed: float, current: float, margin: float) -> bool:
        """Whether the set was identified at a peak velocity [m/s] and a current [A]."""
        slow, fast = self.parameters.peak_velocity_range
        return bool(
            slow * (1.0 - margin) <= speed <= fast * (1.0 + margin)
            and within(current, self.parameters.current_range)
        )

    def fits_at(self, current: float) -> bool:
        """Whether a current [A] is among those of its windows."""
        return self.currents is None or within(current, self.currents)


def within(current: float, span: Span) -> bool:
    """Whether a current [A] lies in a span, but for what counts as the same."""
    return span[0] - SAME_CURRENT <= current <= span[1] + SAME_CURRENT


def is_one(span: Span) -> bool:
    """Whether a span of currents is one operating point."""
    return span[1] - span[0] <= 2.0 * SAME_CURRENT


def joined(one: Span | None, other: Span | None) -> Span | None:
    """The span over both; None stands for one that is not known."""
    if one is None or other is None:
        return one or other
    return min(one[0], other[0]), max(one[1], other[1])
