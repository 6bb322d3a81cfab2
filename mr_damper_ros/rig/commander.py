"""When a command holds: a dead man's handle, for all that moves or heats."""

from __future__ import annotations

import math

STAMP_TOLERANCE = 0.05
"""Seconds that a command may be stamped ahead: what the clocks of two computers may differ."""


class Commander:
    """The latest of commands that come and stop coming; each holds for a while from its stamp on.

    Times are seconds of one steady clock, which nobody sets. ``timeout`` [s] is how long a command
    holds, ``tolerance`` [s] how far ahead it may be stamped. ``refused`` counts the commands that
    were not taken.
    """

    def __init__(self, timeout: float, tolerance: float = STAMP_TOLERANCE) -> None:
        self.refused = 0
        self._timeout = timeout
        self._tolerance = tolerance
        self._until = -math.inf
        self._stamp_ns: int | None = None

    def refuse(self, reason: str) -> str:
        """Count a command that is not taken; returns the reason."""
        self.refused += 1
        return reason

    def _objection(self, stamp_ns: int, age: float, now: float) -> str:
        """Why a command that was decided ``age`` [s] ago cannot hold now; empty where it can."""
        if age < -self._tolerance:
            return (
                f"the command is stamped {-age:.3g} s ahead, where {self._tolerance:g} s are "
                "tolerated: set the clocks of both computers"
            )
        if not age <= self._timeout:
            return (
                f"the command is {age:.3g} s old, and command_timeout is {self._timeout:g} s: set "
                "the clocks of both computers, or command more often"
            )
        if self._stamp_ns is not None and stamp_ns < self._stamp_ns and now < self._until:
            return "the command came after a newer one"
        return ""

    def _hold(self, stamp_ns: int, age: float, now: float) -> None:
        """Let a command hold from its stamp on, or from now where that is ahead."""
        # One that is stamped ahead must not keep out those that are stamped right.
        self._stamp_ns = stamp_ns + round(1e9 * min(age, 0.0))
        self._until = now + self._timeout - max(age, 0.0)
