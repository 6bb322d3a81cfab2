"""Good windows at different operating points, kept for the global identification."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.blocks import NANOSECONDS

_SAME_VELOCITY = math.log(1.1)
"""Peak velocities within 10 % of each other are one operating point."""

_SAME_CURRENT = 0.05
"""Currents [A] within this of each other are one operating point."""

_MOST_SAMPLES = 500
_FEWEST_SAMPLES = 125
_MOST_WINDOWS = 100

RECENT = 10.0
"""Operating points of so many seconds are those that a set will be used at."""

OperatingPoint = tuple[float, float]
"""Peak velocity [m/s] and current [A]."""


def nearest_same(points: Sequence[OperatingPoint], wanted: OperatingPoint) -> int | None:
    """Index of the nearest of the points that is the same operating point; None if none is."""
    best, nearest = 1.0, None
    for index, (v_m, current) in enumerate(points):
        ratio = math.log(max(v_m, 1e-9) / max(wanted[0], 1e-9))
        distance = max(abs(ratio) / _SAME_VELOCITY, abs(current - wanted[1]) / _SAME_CURRENT)
        if distance <= best:
            best, nearest = distance, index
    return nearest


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
