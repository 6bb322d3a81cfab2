"""What the same operating point is, and what is known there besides a parameter set.

Of each operating point (peak velocity, current) the newest good window is kept for the global
identification (:class:`Reservoir`), the first accepted force, by which a new one is told from
another damper's (:class:`KnownForces`), and what a fit usually leaves (:class:`UsualResiduals`).
The tolerance is one and stands here, for baselines and temperatures too.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.blocks import NANOSECONDS

OperatingPoint = tuple[float, float]
"""Peak velocity [m/s] and current [A]."""

SAME_SPEED = 1.1
SAME_CURRENT = 0.05
"""Within this factor of the peak velocity and this current [A] is the same operating point."""

_COMPARABLE = (4.0, 2.0)
"""Forces, and what a law leaves of them, are comparable within so many times that: a speed half
again as large, and 0.1 A. In random motion the peak velocity of a window varies by as much; a
tighter tolerance would make every window of it a new point."""

_MOST_SAMPLES = 500
_FEWEST_SAMPLES = 125
_MOST_WINDOWS = 100

RECENT = 10.0
"""Operating points of so many seconds are those that a set will be used at."""


def nearest_same(points: Sequence[OperatingPoint], wanted: OperatingPoint) -> int | None:
    """Index of the nearest of the points that is the same operating point; None if none is."""
    return _nearest(points, wanted, (1.0, 1.0))


def nearest_comparable(points: Sequence[OperatingPoint], wanted: OperatingPoint) -> int | None:
    """Index of the nearest of the points with a comparable force; None if none has."""
    return _nearest(points, wanted, _COMPARABLE)


def _nearest(
    points: Sequence[OperatingPoint], wanted: OperatingPoint, within: tuple[float, float]
) -> int | None:
    best, nearest = 1.0, None
    for index, point in enumerate(points):
        speed, current = _apart(point, wanted)
        distance = max(speed / within[0], current / within[1])
        if distance <= best:
            best, nearest = distance, index
    return nearest


def _apart(one: OperatingPoint, other: OperatingPoint) -> tuple[float, float]:
    """How far apart two points are in speed and in current, in tolerances."""
    ratio = math.log(max(one[0], 1e-9) / max(other[0], 1e-9))
    return abs(ratio) / math.log(SAME_SPEED), abs(one[1] - other[1]) / SAME_CURRENT


class Kept(NamedTuple):
    """A window as the reservoir keeps it, and its operating point."""

    window: Window
    point: OperatingPoint


def thinned_to_keep(window: Window, *, with_past: bool, parts: int = 1) -> Kept:
    """A window with the few hundred samples of which the reservoir keeps it.

    One of several ``parts`` of a window is kept with fewer.
    The motion between the samples goes ``with_past`` only: a law without memory needs none.
    """
    few = window.thinned(max(_MOST_SAMPLES // parts, _FEWEST_SAMPLES))
    kept = few if with_past else Window(few.motion, few.force, few.current)
    return Kept(kept, window.operating_point)


class Reservoir:
    """The newest good window of each operating point, see :func:`thinned_to_keep`."""

    def __init__(
        self,
        windows: Iterable[Window] = (),
        points: Iterable[OperatingPoint] = (),
        stamps: Iterable[int] = (),
    ) -> None:
        """Begin with these windows, oldest first, their operating points and last stamps [ns].

        Windows without a stamp count as old.
        """
        self._windows = list(windows)
        self._points = list(points)
        self._stamps = list(stamps) or [0] * len(self._windows)

    @property
    def windows(self) -> tuple[Window, ...]:
        """All windows kept, oldest first."""
        return tuple(self._windows)

    @property
    def points(self) -> tuple[OperatingPoint, ...]:
        """The operating point of each window."""
        return tuple(self._points)

    @property
    def stamps(self) -> tuple[int, ...]:
        """Stamp [ns] of the last sample of each window."""
        return tuple(self._stamps)

    def recent(self, end_ns: int) -> tuple[Window, ...]:
        """The windows of the last :data:`RECENT` seconds up to a stamp [ns], oldest first."""
        since = end_ns - round(RECENT * NANOSECONDS)
        return tuple(
            window
            for window, stamp in zip(self._windows, self._stamps, strict=True)
            if since <= stamp <= end_ns
        )

    @property
    def operating_points(self) -> int:
        """Number of different operating points."""
        return len(self._windows)

    def add(self, kept: Kept, stamp_ns: int = 0) -> None:
        """Keep a window up to this stamp in place of the older one at its operating point."""
        window, point = kept
        older = nearest_same(self._points, point)
        if older is None and len(self._windows) == _MOST_WINDOWS:
            older = 0
        if older is not None:
            del self._windows[older], self._points[older], self._stamps[older]
        self._windows.append(window)
        self._points.append(point)
        self._stamps.append(stamp_ns)


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
        points = [known.operating_point for known in self._known]
        index = nearest_comparable(points, wanted.operating_point)
        return None if index is None else self._known[index]


def _besides(one: KnownForce, other: KnownForce) -> float:
    """Factor on the force besides its change, between two operating points."""
    speed, current = _apart(one.operating_point, other.operating_point)
    if current > _COMPARABLE[1]:
        return _OTHER_CURRENT
    return 1.0 if speed <= _COMPARABLE[0] else _OTHER_SPEED


_REMEMBERED = 150
_AT_ONE_POINT = 15
"""So many of the newest at an operating point tell what is usual there."""

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
        known = (self.peak_velocity, self.current)
        return math.isnan(self.peak_velocity) or nearest_comparable([known], point) is not None


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
