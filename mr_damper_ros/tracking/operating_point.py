"""Records of a damper, one for each operating point (peak velocity, current).

This module also defines when two operating points count as the same. A record holds the first
accepted fit, which is the baseline of the force scale; the size of its force, by which later forces
are judged to belong to the same damper or not; the measured temperatures with their force scales;
and the newest good window, for the global identification.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any

import numpy as np

from mr_damper_ros.estimation.covariance import SAME_MOTION
from mr_damper_ros.estimation.window_fit import WindowFit
from mr_damper_ros.kinematics.peak_velocity import MEMORY
from mr_damper_ros.kinematics.periodic_motion import PHASES
from mr_damper_ros.kinematics.window import MOST_UNUSED, Window
from mr_damper_ros.models.current_dependence import LARGEST_GROWTH
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.quantities import MODEL_ERROR, SAME_CURRENT
from mr_damper_ros.signals.arrays import Array, Positive
from mr_damper_ros.signals.blocks import NANOSECONDS

OperatingPoint = tuple[float, float]
"""Peak velocity [m/s] and current [A]."""

SAME_SPEED = 1.0 + SAME_MOTION
"""Two points are the same operating point if their peak velocities differ by at most this factor,
and their currents by at most :data:`SAME_CURRENT` [A]."""

_COMPARABLE = (4.0, 2.0)
"""Forces and residuals are compared within these multiples of the tolerances: 1.5 times the speed,
and 0.1 A. In random motion the peak velocity varies by as much from window to window; with tighter
tolerances every window would be a new point."""

COMPARABLE_SPEED = SAME_SPEED ** _COMPARABLE[0]
"""Motions with peak velocities, or half-cycles, within this factor are comparable."""

MOST_SAMPLES = 500
MOST_WINDOWS = 100
"""Largest numbers of samples of a kept window, and of kept windows, one per operating point."""

_MOST_INTERVALS = 6
"""Largest number of intervals into which a continuous range of currents is divided."""

_MOST_POINTS = 2 * MOST_WINDOWS
"""Largest number of records, which bounds the state on disk. The oldest without a window go first.
"""

RECENT = MEMORY
"""Seconds for which an operating point counts as recent. A set must hold at all recent points."""


def nearest_same(
    points: Sequence[OperatingPoint],
    wanted: OperatingPoint,
    within: tuple[float, float] = (1.0, 1.0),
) -> int | None:
    """Index of the nearest point that is the same operating point; None without one.

    ``within`` are multiples of the tolerances of speed and current.
    """
    best, nearest = 1.0, None
    for index, point in enumerate(points):
        speed, current = _apart(point, wanted)
        distance = max(speed / within[0], current / within[1])
        if distance <= best:
            best, nearest = distance, index
    return nearest


def nearest_comparable(points: Sequence[OperatingPoint], wanted: OperatingPoint) -> int | None:
    """Index of the nearest point with a comparable force; None without one."""
    return nearest_same(points, wanted, _COMPARABLE)


def _apart(one: OperatingPoint, other: OperatingPoint) -> tuple[float, float]:
    """Differences of two points in speed and current, as multiples of the tolerances."""
    ratio = math.log(max(one[0], 1e-9) / max(other[0], 1e-9))
    return abs(ratio) / math.log(SAME_SPEED), abs(one[1] - other[1]) / SAME_CURRENT


def parts_by_current(model: Model, window: Window, tolerance: float) -> list[Window]:
    """Parts of a window within which the current is about constant.

    If the current is constant, the window itself is the only part. Levels of the current more than
    ``tolerance`` [A] apart become separate parts; a continuous range is divided into equal
    intervals. Each part is an operating point, whose fit does not depend on the law's dependence on
    the current. Samples at the start of the window at which the force of the ``model`` depends on
    the unknown past do not count towards the smallest size of a part.
    """
    if float(np.ptp(window.current)) <= tolerance:
        return [window]
    levels = np.unique(window.current)
    widest = max(float(np.ptp(levels)) / _MOST_INTERVALS, tolerance)
    gaps = np.flatnonzero(np.diff(levels) > tolerance)
    edges = (0.5 * (levels[gaps] + levels[gaps + 1])).tolist()
    for stretch in np.split(levels, gaps + 1):
        count = math.ceil(float(np.ptp(stretch)) / widest)
        edges += np.linspace(stretch[0], stretch[-1], count + 1)[1:-1].tolist()
    place = np.searchsorted(np.sort(edges), window.current, side="right")
    lead_in = round(MOST_UNUSED * window.sample_count) if model.needs_past(window) else 0
    chosen = [place == number for number in range(len(edges) + 1)]
    return [
        window.part(each)
        for each in chosen
        if np.count_nonzero(each[lead_in:]) >= PHASES and np.ptp(window.force[each]) > 0.0
    ]


def thinned_to_keep(window: Window, *, with_past: bool, parts: int = 1) -> Window:
    """A window thinned to a few hundred samples, to be kept.

    For one of several ``parts`` of a window fewer samples are kept, down to a quarter of the usual
    number. ``with_past`` also keeps the motion between the samples, for a law with memory.
    """
    few = window.thinned(MOST_SAMPLES // min(parts, 4))
    return few if with_past else Window(few.motion, few.force, few.current)


@dataclass(frozen=True)
class KnownForce:
    """Size [N] (standard deviation) of the force at a peak velocity [m/s] and a current [A].

    ``largest`` [N] is the largest force there.
    """

    peak_velocity: Positive
    current: float
    size: Positive
    largest: Positive

    @property
    def operating_point(self) -> OperatingPoint:
        """Peak velocity [m/s] and current [A]."""
        return self.peak_velocity, self.current


@dataclass(frozen=True, eq=False)
class PointRecord:
    """Record of one operating point.

    ``baseline`` (p,) are the parameters of the first accepted fit, with the peak velocity limited
    to the range ``held`` [m/s] if there is one, and ``force`` is the first accepted force; later
    windows do not change them. ``temperatures`` (n, 3) holds the measured
    temperature [°C], the force scale and its standard error. ``window`` is the newest good window,
    ``stamp_ns`` the stamp of its last sample, and ``number`` its consecutive number, 0 without one.
    A record that travels with a job may have the number of its window alone.
    """

    point: OperatingPoint
    baseline: Array | None = None
    force: KnownForce | None = None
    temperatures: Array = field(default_factory=lambda: np.empty((0, 3)))
    window: Window | None = None
    stamp_ns: int = 0
    number: int = 0
    held: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class KnownPoints:
    """The records of all operating points, in the order of their creation."""

    records: tuple[PointRecord, ...] = ()

    def at(self, point: OperatingPoint) -> PointRecord:
        """The record of an operating point; an empty record if there is none."""
        place = nearest_same([each.point for each in self.records], point)
        return PointRecord(point) if place is None else self.records[place]

    def noted(self, point: OperatingPoint, **entries: Any) -> KnownPoints:
        """Return the records with these entries set at an operating point."""
        before = self.at(point)
        after = replace(before, **entries)
        if before in self.records:
            return self._changed(lambda each: after if each is before else each)
        return KnownPoints((*self.records, after))

    # Baselines

    @property
    def baselines(self) -> tuple[PointRecord, ...]:
        """The records with a baseline, oldest first."""
        return tuple(each for each in self.records if each.baseline is not None)

    def with_baseline(self, fit: WindowFit) -> KnownPoints:
        """Return the records with a fit as the baseline of its operating point, if it has none."""
        if self.at(fit.operating_point).baseline is not None:
            return self
        held = fit.held if np.isfinite(fit.held).all() else None
        return self.noted(fit.operating_point, baseline=fit.parameters, held=held)

    # Windows

    @property
    def kept(self) -> tuple[PointRecord, ...]:
        """Records with a window, the newest window last."""
        with_window = [each for each in self.records if each.number]
        return tuple(sorted(with_window, key=lambda each: each.number))

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest window; 0 without one."""
        return next((each.stamp_ns for each in reversed(self.kept)), 0)

    @property
    def windows(self) -> tuple[Window, ...]:
        """The newest good window of each operating point, oldest first."""
        return tuple(each.window for each in self.kept if each.window is not None)

    def with_recent_windows(self, end_ns: float) -> KnownPoints:
        """Return the records, with the windows of the :data:`RECENT` seconds before a stamp [ns].

        Of the other windows, the number alone stays.
        """
        since = end_ns - round(RECENT * NANOSECONDS)
        return self._changed(
            lambda each: each if since <= each.stamp_ns <= end_ns else replace(each, window=None)
        )

    def with_window(self, window: Window, point: OperatingPoint, stamp_ns: int = 0) -> KnownPoints:
        """Return the records with a window, in place of the older window at its point.

        ``stamp_ns`` is the stamp of its last sample.
        """
        number = max((each.number for each in self.records), default=0) + 1
        known = self.noted(point, window=window, stamp_ns=stamp_ns, number=number)
        while len(known.kept) > MOST_WINDOWS:
            known = known.noted(known.kept[0].point, window=None, number=0)
        return known

    def updated(self, after: KnownPoints) -> KnownPoints:
        """Return the records ``after`` a job, with the windows that did not come with the job.

        If there are too many records, the oldest without a window are left out.
        """
        windows = {each.number: each.window for each in self.records}
        after = after._changed(
            lambda each: replace(each, window=each.window or windows.get(each.number))
        )
        idle = [each for each in after.records if not each.number]
        idle = idle[: max(len(after.records) - _MOST_POINTS, 0)]
        return KnownPoints(tuple(each for each in after.records if each not in idle))

    def without_temperatures(self) -> KnownPoints:
        """Return the records without their temperatures, because the force has changed since."""
        none = PointRecord((0.0, 0.0)).temperatures
        return self._changed(lambda each: replace(each, temperatures=none))

    def _changed(self, change: Callable[[PointRecord], PointRecord]) -> KnownPoints:
        return KnownPoints(tuple(map(change, self.records)))

    # Forces

    def known_force(self, wanted: OperatingPoint) -> KnownForce | None:
        """The first accepted force at the nearest comparable operating point, or None."""
        place = nearest_comparable([force.operating_point for force in self.forces], wanted)
        return None if place is None else self.forces[place]

    @property
    def forces(self) -> tuple[KnownForce, ...]:
        """The first accepted forces, oldest first."""
        return tuple(each.force for each in self.records if each.force is not None)

    def objection(self, found: KnownForce, limit: float, expected: float = math.nan) -> str:
        """Why this damper cannot give a force, in words; empty if it can.

        ``limit`` is the largest factor, up or down, by which a damper changes. ``expected`` [1] is
        the force relative to the first accepted set, NaN if unknown at this point.
        """
        here = self.known_force(found.operating_point)
        if here is not None:
            expected = found.size / here.size
        if not math.isnan(expected) and not 1.0 / limit <= expected <= limit:
            return f"the force is {expected:.3g} times the first accepted force"
        for known in self.forces:
            # Between two speeds, the force changes by at most the ratio of the speeds.
            ratio = found.peak_velocity / known.peak_velocity
            _, current = _apart(found.operating_point, known.operating_point)
            besides = limit * (LARGEST_GROWTH if current > _COMPARABLE[1] else 1.0)
            low, high = min(1.0, ratio) / besides, max(1.0, ratio) * besides
            if found.size > high * known.size or found.largest > high * known.largest:
                return f"the force reaches {found.largest:.3g} N instead of {known.largest:.3g} N"
            if found.size < low * known.size:
                return (
                    f"the standard deviation of the force is {found.size:.3g} N instead of "
                    f"{known.size:.3g} N"
                )
        return ""


_NO_NOISE = 1e-4
"""Lower limit of a baseline NRMSE; no load cell reaches a smaller one."""

Residual = tuple[float, ...]
"""RMSE [N] and NRMSE of a good window; at constant current also its operating point [m/s, A]."""


def excess_residual(
    seen: Sequence[Residual], rmse: float, nrmse: float, point: OperatingPoint | None = None
) -> float:
    """Ratio of a residual, RMSE [N] and NRMSE, to the residual baseline of ``seen``, oldest first.

    The ratio is 1 if ``seen`` is empty. Sensor noise is constant in newtons; model error is a
    constant fraction of the force. A disturbance exceeds both, so the smaller ratio counts. At a
    new operating point the residual of the law is unknown, so a larger residual is accepted there.
    """
    if not seen:
        return 1.0
    near = [
        each
        for each in seen
        if point is None or not each[2:] or nearest_comparable([(each[2], each[3])], point) == 0
    ]
    known = near or seen
    usual_rmse, usual_nrmse = median(e[0] for e in known), median(e[1] for e in known)
    # A simulated force has no noise, and its residual is only rounding error.
    spread = rmse / max(nrmse, _NO_NOISE)
    usual_nrmse = max(usual_nrmse, _NO_NOISE if near else MODEL_ERROR)
    return min(rmse / max(usual_rmse, _NO_NOISE * spread), nrmse / usual_nrmse)
