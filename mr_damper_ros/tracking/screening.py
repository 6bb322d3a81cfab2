"""What makes a window unfit for identification, before anything is fitted to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array

LARGEST_SPAN = 0.5
"""A displacement that spans more [m] is taken for millimetres: no damper has such a stroke."""

LARGEST_FORCE = 1e7
"""A force beyond this [N] is no damper's."""

LARGEST_CURRENT = 50.0
"""A coil current beyond this [A] is taken for milliamperes."""

_CLIPPED_PART = 0.02
_CLIPPED_RUN = 8

_RESTING = 0.02
_LONGEST_REST = 0.25
"""A machine is standing still below 2 % of its top speed for this part of a window in a row."""

_DRIVING = 0.1
"""Correlation of force and velocity below minus this: the sign of one of them is wrong."""


@dataclass(frozen=True)
class Screening(CheckedSettings):
    """Limits that a window must keep to be fitted at all."""

    minimum_amplitude: float = option(
        0.5e-3, "Least half span of the displacement [m] in a window.", minimum=0.0, maximum=1.0
    )
    current_tolerance: float = option(
        0.05,
        "Change of the current [A] within a window up to which the window is one operating point; "
        "beyond, its samples are taken apart by their current.",
        minimum=0.0,
        maximum=100.0,
    )


def fault_of_samples(displacement: Array, force: Array, current: Array, limits: Screening) -> str:
    """Why samples of shape (n,) [m, N, A] cannot be used, in one sentence; empty where they can.

    Whether they are finite was asked where they came in: a recording, a block, a window is.
    """
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
            f"motion of {0.5e3 * span:.3g} mm is below {1e3 * limits.minimum_amplitude:.3g} mm, "
            "the least that counts: move the damper more"
        )
    if np.ptp(force) == 0.0:
        return "the force does not change: is the load cell connected?"
    for name, array in (("force", force), ("displacement", displacement)):
        if _is_clipped(array):
            return f"the {name} is clipped at the end of its range: is the sensor overloaded?"
    return ""


def fault_of_motion(velocity: Array, force: Array) -> str:
    """Why motion and force of shape (n,) [m/s, N] of a window do not do; empty where they do.

    A machine that stops within a window leaves a stretch that says nothing of the damper.
    """
    speed = np.abs(velocity)
    resting = np.concatenate(([0], (speed < _RESTING * speed.max()).view(np.int8), [0]))
    edges = np.flatnonzero(np.diff(resting))
    longest = int(np.max(edges[1::2] - edges[::2], initial=0))
    if longest > _LONGEST_REST * speed.size:
        return f"the machine stands still for {longest / speed.size:.0%} of the window"
    return fault_of_sign(velocity, force)


def fault_of_sign(velocity: Array, force: Array) -> str:
    """Why the signs of motion and force (n,) cannot both be right; empty where they can.

    A damper takes power out of the motion, over any stretch of time that holds some cycles.
    """
    centred = force - force.mean()
    power = float(centred @ velocity)
    if power < -_DRIVING * float(np.linalg.norm(centred) * np.linalg.norm(velocity)):
        return (
            "the force drives the motion, which no damper does: reverse the sign of the force or "
            "of the displacement (extension and tension are positive)"
        )
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
