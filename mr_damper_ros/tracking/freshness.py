"""How old the samples are on the clock of the computer, where they come from a running machine.

The stamps of a recording that is played tell when it was recorded, and nothing of how late the
samples come. So a stream counts as live once its stamps have been within a minute of the clock,
and stays so until they jump back: a computer that falls behind does not turn it into a recording.
"""

from __future__ import annotations

import math

from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.validity import NO_DOUBT, Doubt, DoubtKind

_LIVE = 60.0
"""Stamps within so many seconds of the clock are those of a running machine."""


class Freshness:
    """Follows the age of the samples of a stream.

    ``max_age`` [s] is the limit; 0: none, nothing is taken for live. ``age`` [s] is that of the
    last samples, NaN where they are not live.
    """

    def __init__(self, max_age: float) -> None:
        self._max_age = max_age
        self.live = False
        self.age = math.nan

    def restart(self) -> None:
        """The stamps have jumped back: whether they are live shows again."""
        self.live = False
        self.age = math.nan

    def are_older(self, stamp_ns: int, now_ns: int, limit: float) -> bool:
        """Whether live samples up to the stamp are older than the limit [s]."""
        return self.live and (now_ns - stamp_ns) / NANOSECONDS > limit

    def judge(self, stamp_ns: int, now_ns: int | None) -> Doubt:
        """Whether samples up to the stamp are too old by the clock; None: there is no clock."""
        if now_ns is None or self._max_age == 0.0:
            return NO_DOUBT
        age = (now_ns - stamp_ns) / NANOSECONDS
        self.live = self.live or abs(age) <= _LIVE
        if not self.live:
            return NO_DOUBT
        self.age = age
        if abs(age) <= self._max_age:
            return NO_DOUBT
        if age > 0.0:
            sentence = (
                f"the samples are {age:.2f} s old, and max_age is {self._max_age:g} s: is the "
                "computer overloaded, or its clock not that of the samples?"
            )
        else:
            sentence = (
                f"the samples are stamped {-age:.2f} s in the future: are the clocks of the "
                "computers set alike? for a replay set max_age to 0"
            )
        return Doubt(DoubtKind.OUTDATED, sentence)
