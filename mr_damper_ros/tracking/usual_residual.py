"""What the fits of good windows usually leave of the force, apart for every operating point.

Noise is the same in all motions; what a law cannot follow depends on where it is asked to.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median

from mr_damper_ros.tracking.reservoir import OperatingPoint

_REMEMBERED = 150
_AT_ONE_POINT = 15
"""So many of the newest at an operating point tell what is usual there."""

_SAME_VELOCITY = math.log(1.5)
_SAME_CURRENT = 0.1
"""Residuals are comparable within half again the peak velocity and this current [A]."""

_NO_NOISE = 1e-4
"""An NRMSE below this is better than any load cell: smaller ones are not told apart."""

_ELSEWHERE = 0.05
"""Part of the force that a law may usually leave where it has never been fitted: of the records of
a commercial damper the median is 0.08."""


@dataclass(frozen=True)
class SeenResidual:
    """Residual of a good window: RMSE [N] and NRMSE.

    ``peak_velocity`` [m/s] and ``current`` [A] are those of its operating point, NaN where that
    was not kept.
    """

    rmse: float
    nrmse: float
    peak_velocity: float = math.nan
    current: float = math.nan

    @property
    def kept(self) -> tuple[float, ...]:
        """What is known of it, in this order."""
        known = (self.rmse, self.nrmse, self.peak_velocity, self.current)
        return known[:2] if math.isnan(self.peak_velocity) else known

    def is_near(self, point: OperatingPoint) -> bool:
        """Whether the residual is comparable with one at this operating point."""
        speed, current = point
        if math.isnan(self.peak_velocity):
            return True
        ratio = math.log(max(speed, 1e-9) / max(self.peak_velocity, 1e-9))
        return abs(ratio) <= _SAME_VELOCITY and abs(current - self.current) <= _SAME_CURRENT


class UsualResiduals:
    """Remembers the residuals of the newest good windows."""

    def __init__(self, seen: Iterable[SeenResidual] = ()) -> None:
        """Begin with these, oldest first."""
        self._seen = deque(seen, maxlen=_REMEMBERED)

    def __bool__(self) -> bool:
        """Whether any is known."""
        return bool(self._seen)

    @property
    def seen(self) -> tuple[SeenResidual, ...]:
        """All of them, oldest first."""
        return tuple(self._seen)

    def add(self, residual: SeenResidual) -> None:
        """Remember that of a good window."""
        self._seen.append(residual)

    def forget(self) -> None:
        """The rig has become another: nothing is usual any more."""
        self._seen.clear()

    def excess(self, rmse: float, nrmse: float, point: OperatingPoint | None = None) -> float:
        """Residual, RMSE [N] and NRMSE, over the usual one; 1 where none is known.

        A sensor's noise keeps its newtons, a model's error its share of the force: a disturbance
        exceeds both. Of an operating point (peak velocity [m/s], current [A]) that is new, it is
        not known what the law leaves there: a residual that is large for the others may be usual.
        """
        if not self._seen:
            return 1.0
        near = [each for each in self._seen if point is None or each.is_near(point)]
        known = (near or list(self._seen))[-_AT_ONE_POINT:]
        usual_rmse, usual_nrmse = median(e.rmse for e in known), median(e.nrmse for e in known)
        # A force without noise, as a simulation has it, leaves rounding: that is no measure.
        spread = rmse / max(nrmse, _NO_NOISE)
        usual_nrmse = max(usual_nrmse, _NO_NOISE if near else _ELSEWHERE)
        return min(rmse / max(usual_rmse, _NO_NOISE * spread), nrmse / usual_nrmse)
