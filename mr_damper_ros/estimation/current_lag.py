"""Lag of the force behind the supply current, estimated from window to window without a law.

The force of a damper follows the stamped current with a lag: that of the coil, minus the time by
which the current is stamped or read too late. The lag is the shift of the current with which a
linear combination of simple functions of motion and current explains the force best. This needs no
parameter set, so that a wrong set does not bias it, and the first set already gets the right
current.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.quantities import SAME_CURRENT
from mr_damper_ros.signals.arrays import Array

LARGEST_LAG = 0.08
"""Largest magnitude of a lag [s]."""

_GRID = np.arange(-LARGEST_LAG, 0.0401, 0.002)
"""Lags [s] that are compared."""

_USUAL = 0.03
"""Standard deviation [s] of the lags of supply channels. It decides between lags that explain a
window equally well, such as those half a period apart of a periodic current."""

_INDEPENDENT = 0.02
"""Time [s] after which the errors of the combination are independent."""

_MEMORY, _SHARE = 0.9, 0.5
"""Factor on the earlier evidence at each window, and weight of a window, because each sample is in
two windows."""

_LAW_ERROR = 2e-3
"""Additional standard error [s], because the combination is no exact law."""

_SIGNIFICANT = 2.0
"""A lag counts from this many standard errors on."""

_SAMPLES = 1000
"""Approximate number of samples of a window that are used."""


@dataclass(frozen=True, eq=False)
class CurrentLag:
    """The evidence for each of the compared lags, of all windows so far.

    ``costs`` (m,) are negative log-likelihoods; raises ValueError for another number of them.
    """

    costs: Array = field(default_factory=lambda: np.zeros(_GRID.size))

    def __post_init__(self) -> None:
        if self.costs.shape != _GRID.shape:
            raise ValueError(f"{self.costs.size} lags are compared instead of {_GRID.size}")

    @property
    def estimate(self) -> tuple[float, float]:
        """The most probable lag [s] and its standard error [s]."""
        costs = self.costs + 0.5 * (_GRID / _USUAL) ** 2
        best = float(_GRID[np.argmin(costs)])
        weights = np.exp(costs.min() - costs)
        variance = float(weights @ (_GRID - best) ** 2 / weights.sum())
        return best, math.sqrt(variance + _LAW_ERROR**2)

    @property
    def significant(self) -> float:
        """The lag [s] if it is significant, otherwise 0."""
        lag, error = self.estimate
        return lag if abs(lag) > _SIGNIFICANT * error else 0.0

    def after(self, window: Window) -> CurrentLag:
        """The evidence after a window with its current as stamped."""
        errors = _errors(window)
        if errors is None:
            return self
        count = window.sample_count * window.period / _INDEPENDENT
        found = 0.5 * count * np.log(np.maximum(errors / errors.min(), 1.0))
        return CurrentLag(_MEMORY * self.costs + _SHARE * found)


def with_lag(window: Window, lag: float) -> tuple[Window, slice]:
    """The window with its current ``lag`` [s] later, and which of its samples these are.

    The samples of unknown current, at one of the ends, are left out.
    """
    shift, count = round(lag / window.period), window.sample_count
    if shift == 0 or window.has_constant_current or abs(shift) >= count:
        return window, slice(0, count)
    known = slice(max(shift, 0), count + min(shift, 0))
    return _shifted(window, shift).part(known), known


def _shifted(window: Window, shift: int) -> Window:
    places = np.arange(window.sample_count) - shift
    current = window.current[places.clip(0, window.sample_count - 1)]
    whole = None if window.whole is None else _shifted(window.whole, shift)
    return replace(window, current=current, whole=whole)


def _errors(window: Window) -> Array | None:
    """Squared error [N²] of the combination with each of the lags; None without evidence."""
    current, spread = window.current, float(np.ptp(window.current))
    shifts = np.rint(_GRID / window.period).astype(int)
    first, end = max(int(shifts[-1]), 0), current.size + min(int(shifts[0]), 0)
    if spread <= 2.0 * SAME_CURRENT or end - first < 0.5 * current.size:
        return None
    step = max((end - first) // _SAMPLES, 1)
    used = slice(first, end, step)
    motion = _functions_of_motion(window)[used]
    force = window.force[used] - float(np.mean(window.force[used]))
    level = (current - 0.5 * (current.max() + current.min())) / spread
    errors = {}
    for shift in np.unique(shifts).tolist():
        here = level[first - shift : end - shift : step, np.newaxis]
        table = np.hstack([motion, here * motion, here**2 * motion])
        normal = table.T @ table
        normal[np.diag_indices_from(normal)] += 1e-8 * np.trace(normal)
        product = table.T @ force
        errors[shift] = float(force @ force - product @ np.linalg.solve(normal, product))
    found = np.array([errors[shift] for shift in shifts.tolist()])
    return found if found.min() > 0.0 else None


def _functions_of_motion(window: Window) -> Array:
    """Functions of the motion (n, 6) that resemble the parts of a damper force."""
    motion = window.motion
    u, v, a = (
        each / max(float(np.std(each)), 1e-300)
        for each in (motion.displacement, motion.velocity, motion.acceleration)
    )
    columns = np.ones(u.size), v, u, np.tanh(3.0 * v + a), np.tanh(6.0 * v - a), np.tanh(10.0 * v)
    return np.stack(columns, axis=1)
