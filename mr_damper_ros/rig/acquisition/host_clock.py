"""The clock of stamps beside the steady one by which arrivals are timed."""

from __future__ import annotations

import time
from collections.abc import Callable

_SET_NS = 20_000_000
"""The computer's clock was set where it has moved by more than so many nanoseconds."""


class HostClock:
    """Makes stamps of times of the steady clock; the two show ``start_ns`` now.

    When the computer's clock is set, the stamps follow it, as those of other devices do.
    """

    def __init__(
        self,
        start_ns: int,
        steady: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        self._steady, self._wall = steady, wall
        self._apart_ns = wall() - steady()
        self.ahead_ns = start_ns - steady()
        """What is to be added to a time of the steady clock for its stamp."""

    def look(self) -> bool:
        """Whether the computer's clock was set since the last look."""
        moved_ns = self._wall() - self._steady() - self._apart_ns
        if abs(moved_ns) > _SET_NS:
            self._apart_ns += moved_ns
            self.ahead_ns += moved_ns
            return True
        return False
