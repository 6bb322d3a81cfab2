"""What a damper has been measured to give, and whether a new force can be that of the same damper.

Temperature and wear change the force of a damper by a factor of two or so, and by steps or creeping
it never comes to more. What is compared is the size of the force at an operating point with the
first accepted there. Where that point is new, the force may differ from each known one by what
another speed or another current can do besides.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from mr_damper_ros.tracking.reservoir import OperatingPoint

_SAME_VELOCITY = math.log(1.5)
_SAME_CURRENT = 0.1
"""Forces are comparable within half again the peak velocity and this current [A]."""

_OTHER_SPEED = 2.0
"""At another speed the force lies between the same and in proportion, within this factor."""

_OTHER_CURRENT = 30.0
"""At another current it may be so many times as large or as small: the range of these dampers."""


@dataclass(frozen=True)
class KnownForce:
    """Size [N] (standard deviation) of the force at a peak velocity [m/s] and a current [A].

    ``largest`` [N] is the largest force there.
    """

    peak_velocity: float
    current: float
    size: float
    largest: float

    @property
    def operating_point(self) -> OperatingPoint:
        """Peak velocity [m/s] and current [A]."""
        return self.peak_velocity, self.current


class KnownForces:
    """The first accepted force at each operating point, which nothing later moves.

    ``level`` is that of the running set against them, 1 = as at first.
    """

    def __init__(self, known: Iterable[KnownForce] = (), level: float = 1.0) -> None:
        """Begin with these, oldest first."""
        self._known = list(known)
        self.level = level

    @property
    def known(self) -> tuple[KnownForce, ...]:
        """All of them, oldest first."""
        return tuple(self._known)

    def objection(self, found: KnownForce, limit: float, expected: float = math.nan) -> str:
        """Why a force cannot be this damper's, in words; empty where it can.

        ``limit``: factor, up or down, within which a damper changes. ``expected`` [1]: the force
        over that of the law as it was at first, NaN where the law is not known there.
        """
        here = self._nearest(found)
        if here is not None:
            expected = found.size / here.size
        if not math.isnan(expected) and not 1.0 / limit <= expected <= limit:
            return f"the force is {expected:.3g} times what it was at first"
        for known in self._known:
            ratio = found.peak_velocity / known.peak_velocity
            besides = limit * _besides(found, known)
            low, high = min(1.0, ratio) / besides, max(1.0, ratio) * besides
            if found.size > high * known.size or found.largest > high * known.largest:
                return f"the force reaches {found.largest:.3g} N, {known.largest:.3g} N at first"
            if found.size < low * known.size:
                return f"the force spreads by {found.size:.3g} N, {known.size:.3g} N at first"
        return ""

    def changes_too_much(self, factor: float, limit: float) -> bool:
        """Whether a change of the running set's force by this factor leads beyond the limit."""
        return bool(self._known) and not 1.0 / limit <= self.level * factor <= limit

    def change_at(self, found: KnownForce, otherwise: float) -> float:
        """Relative change of a force against that known at its operating point.

        Besides the change that the running set has seen elsewhere; ``otherwise`` where it is new.
        """
        here = self._nearest(found)
        return otherwise if here is None else found.size / (here.size * self.level) - 1.0

    def follow(self, found: KnownForce) -> None:
        """Take in a force that was accepted; the first of its operating point is kept."""
        here = self._nearest(found)
        if here is not None:
            self.level = found.size / here.size
        elif min(found.size, found.peak_velocity, found.largest) > 0.0:
            self._known.append(found)

    def _nearest(self, wanted: KnownForce) -> KnownForce | None:
        best, nearest = 1.0, None
        for known in self._known:
            distance = max(
                abs(_log_ratio(wanted, known)) / _SAME_VELOCITY,
                abs(wanted.current - known.current) / _SAME_CURRENT,
            )
            if distance <= best:
                best, nearest = distance, known
        return nearest


def _log_ratio(one: KnownForce, other: KnownForce) -> float:
    return math.log(max(one.peak_velocity, 1e-9) / other.peak_velocity)


def _besides(one: KnownForce, other: KnownForce) -> float:
    """Factor on the force besides its change, between two operating points."""
    if abs(one.current - other.current) > _SAME_CURRENT:
        return _OTHER_CURRENT
    return 1.0 if abs(_log_ratio(one, other)) <= _SAME_VELOCITY else _OTHER_SPEED
