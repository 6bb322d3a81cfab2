"""How far beyond the identified currents a controller may go: a step, while the force is right."""

from __future__ import annotations

from mr_damper_ros.tracking.validity import Doubt, DoubtKind

_CONFIRMED = 1.0
"""Seconds in which the highest current was needed and the force was valid, until the next step."""

_REFUTED = 30.0
"""Seconds until it is tried again after the force was wrong."""

_REFUTES = (DoubtKind.WRONG, DoubtKind.DRIVING, DoubtKind.TOO_LARGE, DoubtKind.SENSOR)


class Probe:
    """Follows whether currents ``beyond`` [A] the identified ones are right, in steps of ``step``.

    A step of 0 [A] never goes beyond.
    """

    def __init__(self, step: float) -> None:
        self._step = step
        self._needed = self._refuted = 0.0
        self.beyond = 0.0

    def follow(self, duration: float, doubt: Doubt, needed: bool) -> None:
        """Follow so many seconds in which more current was ``needed``, or not."""
        if self._step == 0.0:
            return
        self._refuted = max(self._refuted - duration, 0.0)
        if doubt.kind in _REFUTES and self.beyond > 0.0:
            self.beyond, self._refuted = 0.0, _REFUTED
        if doubt or self._refuted > 0.0:
            self._needed = 0.0
        elif needed:
            self._needed += duration
        if self._needed >= _CONFIRMED:
            self._needed = 0.0
            self.beyond += self._step
