"""Whether a motion has come to rest."""

from __future__ import annotations

import math

_STILL = 0.01
"""A move by less than this part of the amplitude is none ..."""

_DWELL = 0.4
"""... and a rest is longer than this part of a half-cycle without one. A sine stays within a
hundredth of its amplitude for a tenth of a half-cycle; one of a tenth of the amplitude that was
usual, for a third."""

_SHORTEST = 0.1
"""Seconds; noise and the delay of an observer take some hundredths."""

_LONG = 2.0
"""A rest is told after so long [s] already ..."""

_LONG_DWELL = 0.16
"""... if that is this part of a half-cycle."""


class RestWatch:
    """Follows a displacement of samples ``period`` [s] apart."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._anchor = math.nan
        self._since = 0
        self.resting = False

    def follow(
        self,
        low: float,
        high: float,
        newest: float,
        count: int,
        amplitude: float,
        half_cycle: float,
    ) -> None:
        """Follow ``count`` samples that lie within ``low`` and ``high`` [m], by their newest.

        ``amplitude`` [m] and ``half_cycle`` [s] are those of the latest motion, the latter NaN
        before one is known: then nothing is called a rest.
        """
        still = _STILL * amplitude
        if not (self._anchor - still <= low and high <= self._anchor + still):
            self._anchor, self._since = newest, 0
            self.resting = False
            return
        self._since += count
        enough = max(_SHORTEST, min(_DWELL * half_cycle, max(_LONG, _LONG_DWELL * half_cycle)))
        self.resting = self._since * self._period > enough
