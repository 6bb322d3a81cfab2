"""Work on a block that others need not wait for."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

_HEAD_START = 1e-3
"""Seconds from what was published to the rest of the work: on a computer with no processor to
spare who waits for it may be put on this one, and would wait for that work, too."""


class PostponedWork:
    """The rest of the work on the newest block, until its time has come."""

    def __init__(self) -> None:
        self._work: Callable[[], None] | None = None
        self._due = math.inf

    def postpone(self, work: Callable[[], None]) -> None:
        """Do this a moment from now; what was postponed before has been done."""
        self._work, self._due = work, time.perf_counter() + _HEAD_START

    def finish(self) -> None:
        """Do it now, unless it is done already."""
        work, self._work = self._work, None
        if work is not None:
            work()

    def finish_in_time(self) -> float:
        """Do it if its time has come; returns the seconds until then, infinite for nothing."""
        if self._work is None:
            return math.inf
        left = self._due - time.perf_counter()
        if left > 0.0:
            return left
        self.finish()
        return math.inf
