"""What is known of a damper at each operating point (peak velocity, current): a record for each.

What the same operating point is, is said here, for all that asks. A record holds the first accepted
fit (the baseline of the force scale) and the size of its force, by which a later one is told from
another damper's, the temperatures seen with their force scales, and the newest good window, for the
global identification.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.arrays import Array
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
MOST_WINDOWS = 100
"""So many windows are kept, one of each operating point, thinned to so many samples."""

RECENT = 10.0
"""Operating points of so many seconds are those that a set will be used at."""

_OTHER_SPEED = 2.0
"""At another speed the force lies between the same and in proportion, within this factor."""

_OTHER_CURRENT = 30.0
"""At another current it may be so many times as large or as small: the range of these dampers."""


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
    """A window as it is kept for the global identification, and its operating point."""

    window: Window
    point: OperatingPoint


def thinned_to_keep(window: Window, *, with_past: bool, parts: int = 1) -> Kept:
    """A window with the few hundred samples of which it is kept.

    One of several ``parts`` of a window is kept with fewer.
    The motion between the samples goes ``with_past`` only: a law without memory needs none.
    """
    few = window.thinned(max(_MOST_SAMPLES // parts, _FEWEST_SAMPLES))
    kept = few if with_past else Window(few.motion, few.force, few.current)
    return Kept(kept, window.operating_point)


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


@dataclass(frozen=True, eq=False)
class PointRecord:
    """What is known at an operating point.

    ``baseline``: the first accepted fit, and ``force``: its force, which nothing later moves;
    ``temperatures`` (n, 3): measured temperature [°C], force scale and its standard error;
    ``window``: the newest good one, ``stamp_ns``: that of its last sample, and its running
    ``number``.
    """

    point: OperatingPoint
    baseline: WindowFit | None = None
    force: KnownForce | None = None
    temperatures: Array = field(default_factory=lambda: np.empty((0, 3)))
    window: Window | None = None
    stamp_ns: int = 0
    number: int = 0


@dataclass(frozen=True, eq=False)
class KnownPoints:
    """The records of all operating points, in the order in which these were first seen."""

    records: tuple[PointRecord, ...] = ()

    def at(self, point: OperatingPoint) -> PointRecord:
        """The record of an operating point; an empty one where nothing is known of it."""
        place = nearest_same([each.point for each in self.records], point)
        return PointRecord(point) if place is None else self.records[place]

    def noted(self, point: OperatingPoint, **entries: Any) -> KnownPoints:
        """The same with these entries in the record of an operating point."""
        before = self.at(point)
        after = replace(before, **entries)
        if any(each is before for each in self.records):
            return KnownPoints(tuple(after if r is before else r for r in self.records))
        return KnownPoints((*self.records, after))

    # Baselines

    @property
    def baselines(self) -> tuple[WindowFit, ...]:
        """The first accepted fits, oldest first."""
        return tuple(each.baseline for each in self.records if each.baseline is not None)

    def with_baseline(self, fit: WindowFit) -> KnownPoints:
        """The same with a fit as the baseline of its operating point, unless that has one."""
        if self.at(fit.operating_point).baseline is not None:
            return self
        return self.noted(fit.operating_point, baseline=fit)

    # Windows

    @property
    def kept(self) -> tuple[PointRecord, ...]:
        """Records with a window, of which the newest is the last."""
        with_window = [each for each in self.records if each.window is not None]
        return tuple(sorted(with_window, key=lambda each: each.number))

    @property
    def windows(self) -> tuple[Window, ...]:
        """The newest good window of each operating point, oldest first."""
        return tuple(each.window for each in self.kept if each.window is not None)

    def recent(self, end_ns: int) -> tuple[Window, ...]:
        """The windows of the last :data:`RECENT` seconds up to a stamp [ns], oldest first."""
        since = end_ns - round(RECENT * NANOSECONDS)
        return tuple(
            each.window
            for each in self.kept
            if each.window is not None and since <= each.stamp_ns <= end_ns
        )

    def with_window(self, kept: Kept, stamp_ns: int = 0) -> KnownPoints:
        """The same with a window up to this stamp in place of the older one at its point."""
        number = max((each.number for each in self.records), default=0) + 1
        known = self.noted(kept.point, window=kept.window, stamp_ns=stamp_ns, number=number)
        while len(known.kept) > MOST_WINDOWS:
            known = known.noted(known.kept[0].point, window=None)
        return known

    def without_temperatures(self) -> KnownPoints:
        """The same without the temperatures seen, with which the force was another."""
        none = PointRecord((0.0, 0.0)).temperatures
        return KnownPoints(tuple(replace(each, temperatures=none) for each in self.records))

    # Forces

    def known_force(self, wanted: OperatingPoint) -> KnownForce | None:
        """The first accepted force at the nearest operating point with a comparable one."""
        forces = self._forces
        place = nearest_comparable([force.operating_point for force in forces], wanted)
        return None if place is None else forces[place]

    @property
    def _forces(self) -> tuple[KnownForce, ...]:
        return tuple(each.force for each in self.records if each.force is not None)

    @property
    def knows_forces(self) -> bool:
        """Whether any force is known."""
        return bool(self._forces)

    def objection(self, found: KnownForce, limit: float, expected: float = math.nan) -> str:
        """Why a force cannot be this damper's, in words; empty where it can.

        ``limit``: factor, up or down, within which a damper changes. ``expected`` [1]: the force
        over that of the law as it was at first, NaN where the law is not known there.
        """
        here = self.known_force(found.operating_point)
        if here is not None:
            expected = found.size / here.size
        if not math.isnan(expected) and not 1.0 / limit <= expected <= limit:
            return f"the force is {expected:.3g} times the first one"
        for known in self._forces:
            ratio = found.peak_velocity / known.peak_velocity
            besides = limit * _besides(found, known)
            low, high = min(1.0, ratio) / besides, max(1.0, ratio) * besides
            if found.size > high * known.size or found.largest > high * known.largest:
                return f"the force reaches {found.largest:.3g} N, at first {known.largest:.3g} N"
            if found.size < low * known.size:
                return (
                    f"the standard deviation of the force is {found.size:.3g} N, at first "
                    f"{known.size:.3g} N"
                )
        return ""


def _besides(one: KnownForce, other: KnownForce) -> float:
    """Factor on the force besides its change, between two operating points."""
    speed, current = _apart(one.operating_point, other.operating_point)
    if current > _COMPARABLE[1]:
        return _OTHER_CURRENT
    return 1.0 if speed <= _COMPARABLE[0] else _OTHER_SPEED


_AT_ONE_POINT = 15
"""So many of the newest at an operating point tell what is usual there."""

_NO_NOISE = 1e-4
"""An NRMSE below this is better than any load cell: smaller ones are not told apart."""

_ELSEWHERE = 0.05
"""Part of the force that a law may usually leave where it has never been fitted: of the records of
a commercial damper the median is 0.08."""

Residual = tuple[float, ...]
"""RMSE [N] and NRMSE of a good window; peak velocity [m/s] and current [A] if it has one current.
"""


def excess_residual(
    seen: Sequence[Residual], rmse: float, nrmse: float, point: OperatingPoint | None = None
) -> float:
    """Residual, RMSE [N] and NRMSE, over the usual one of those seen, oldest first; 1 of none.

    A sensor's noise keeps its newtons, a model's error its share of the force: a disturbance
    exceeds both. Of an operating point that is new, it is not known what the law leaves there: a
    residual that is large for the others may be usual.
    """
    if not seen:
        return 1.0
    near = [
        each
        for each in seen
        if point is None or not each[2:] or nearest_comparable([(each[2], each[3])], point) == 0
    ]
    known = (near or seen)[-_AT_ONE_POINT:]
    usual_rmse, usual_nrmse = median(e[0] for e in known), median(e[1] for e in known)
    # A force without noise, as a simulation has it, leaves rounding: that is no measure.
    spread = rmse / max(nrmse, _NO_NOISE)
    usual_nrmse = max(usual_nrmse, _NO_NOISE if near else _ELSEWHERE)
    return min(rmse / max(usual_rmse, _NO_NOISE * spread), nrmse / usual_nrmse)
