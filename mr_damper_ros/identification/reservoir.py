"""Accepted windows at different operating points, kept for the global identification."""

from __future__ import annotations

import math

from mr_damper_ros.identification.fit import WindowFit
from mr_damper_ros.identification.window import Window

_VELOCITY_CELL = math.log(1.1)
"""Peak velocities within about 10 % of each other share a cell."""

_CURRENT_CELL = 0.05
"""Currents [A] within this of each other share a cell."""

_MOST_SAMPLES = 500
_MOST_WINDOWS = 100


def cell_of(operating_point: tuple[float, float]) -> tuple[int, int]:
    """The cell of an operating point (peak velocity [m/s], current [A])."""
    v_m, current = operating_point
    return round(math.log(max(v_m, 1e-9)) / _VELOCITY_CELL), round(current / _CURRENT_CELL)


class Reservoir:
    """The newest accepted window of each operating point, thinned to a few hundred samples."""

    def __init__(self) -> None:
        self._windows: dict[tuple[int, int], Window] = {}

    @property
    def windows(self) -> tuple[Window, ...]:
        """All windows kept, oldest first."""
        return tuple(self._windows.values())

    @property
    def operating_points(self) -> int:
        """Number of different operating points."""
        return len(self._windows)

    def add(self, window: Window, fit: WindowFit) -> None:
        """Keep a window in place of the older one at its operating point."""
        cell = cell_of(fit.operating_point)
        self._windows.pop(cell, None)
        stride = max(window.sample_count // _MOST_SAMPLES, 1)
        self._windows[cell] = window.part(slice(None, None, stride))
        if len(self._windows) > _MOST_WINDOWS:
            del self._windows[next(iter(self._windows))]
