"""What makes a window unfit for identification, before anything is fitted to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.damper.sigmoid import Array

LARGEST_SPAN = 0.5
"""A displacement that spans more [m] is taken for millimetres: no damper has such a stroke."""

LARGEST_FORCE = 1e7
"""A force beyond this [N] is no damper's."""

LARGEST_CURRENT = 50.0
"""A coil current beyond this [A] is taken for milliamperes."""

_CLIPPED_PART = 0.02
_CLIPPED_RUN = 8


@dataclass(frozen=True)
class Screening:
    """Limits that a window must keep.

    ``minimum_amplitude`` [m]: half the span of the displacement; ``current_tolerance`` [A]: how
    far the current may change within a window.
    """

    minimum_amplitude: float = 0.5e-3
    current_tolerance: float = 0.05


def fault_of_samples(displacement: Array, force: Array, current: Array, limits: Screening) -> str:
    """Why samples of shape (n,) [m, N, A] cannot be used, in one sentence; empty where they can."""
    for name, array in (("displacement", displacement), ("force", force), ("current", current)):
        if not np.all(np.isfinite(array)):
            return f"the {name} holds NaN or infinite values: repair or cut them out"
    span = float(np.ptp(displacement))
    if span > LARGEST_SPAN:
        return f"the displacement spans {span:.3g} m: is it in millimetres? give it in metres"
    largest = float(np.max(np.abs(force)))
    if largest > LARGEST_FORCE:
        return f"the force reaches {largest:.3g} N: check its unit"
    largest = float(np.max(np.abs(current)))
    if largest > LARGEST_CURRENT:
        return f"the current reaches {largest:.3g} A: is it in milliamperes? give it in amperes"
    if 0.5 * span < limits.minimum_amplitude:
        return (
            f"motion of {0.5e3 * span:.3g} mm is below {1e3 * limits.minimum_amplitude:.3g} mm: "
            "move the damper, or lower minimum_amplitude"
        )
    if np.ptp(force) == 0.0:
        return "the force does not change: is the load cell connected?"
    change = float(np.ptp(current))
    if change > limits.current_tolerance:
        return f"the current changes by {change:.3g} A within the window"
    for name, array in (("force", force), ("displacement", displacement)):
        if _is_clipped(array):
            return f"the {name} is clipped at the end of its range: is the sensor overloaded?"
    return ""


def _is_clipped(array: Array) -> bool:
    """Whether a signal stays at one of its extremes for many samples in a row."""
    for extreme in (array.max(), array.min()):
        at_extreme = array == extreme
        if at_extreme.mean() < _CLIPPED_PART:
            continue
        edges = np.flatnonzero(np.diff(np.concatenate(([0], at_extreme.view(np.int8), [0]))))
        if np.max(edges[1::2] - edges[::2]) >= _CLIPPED_RUN:
            return True
    return False
