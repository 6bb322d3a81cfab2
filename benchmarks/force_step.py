"""A sudden loss of a tenth of the force, followed window by window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks import following
from benchmarks.figure import Figure
from mr_damper_ros.emulation.emulator import ConstantDamper, scaled
from mr_damper_ros.emulation.faults import fault_of
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.law import sine_force
from mr_damper_ros.tracking.tracker import TrackerSettings

FACTOR = 0.9
WITHIN = 0.01
OFFSETS = tuple(place / 8.0 for place in range(8))
"""When the step comes, in parts of a hop after the end of a window."""

_BEFORE, _AFTER = 8.0, 10.0


def windows_until_right(offset: float, settings: TrackerSettings) -> float:
    """Time from the step until the set in use is within 1 %, in lengths of a window.

    Within 1 % is the norm of the error of the force over a cycle against that of the force.
    Infinite where that never happens; a set that becomes wrong again does not count.
    """
    time = _BEFORE + offset * following.HOP
    run = following.recording(
        ConstantDamper(THESIS_28_CELSIUS),
        time + _AFTER,
        seed=round(100 * offset),
        faults=[fault_of(f"force_loss:{FACTOR}@{time}")],
    )
    cycle = following.one_cycle()
    truth = sine_force(scaled(THESIS_28_CELSIUS, FACTOR), *cycle, following.CURRENT)
    right_since = np.inf
    for step in following.follow(run, settings):
        elapsed = (following.sample_of(run, step.report.stamp_ns) + 1) * run.period - time
        if elapsed <= 0.0:
            continue
        error = sine_force(step.parameters, *cycle, following.CURRENT) - truth
        right = bool(np.linalg.norm(error) <= WITHIN * np.linalg.norm(truth))
        right_since = min(right_since, elapsed) if right else np.inf
    return float(right_since) / following.WINDOW


def measure(settings: TrackerSettings, offsets: Sequence[float] = OFFSETS) -> list[float]:
    """The same for steps at several times within a hop."""
    return [windows_until_right(offset, settings) for offset in offsets]


def figures(offsets: Sequence[float] = OFFSETS) -> list[Figure]:
    """``step_windows`` and ``ukf_step_windows``."""
    found, recursive = (
        measure(TrackerSettings(tracker=name), offsets) for name in ("window", "recursive")
    )
    return [
        Figure(
            "step_windows",
            max(found),
            f"Step of -10 % in force: time until the set in use is right within 1 % for good, in "
            f"windows of {following.WINDOW:g} s (a window every {following.HOP:g} s); the longest "
            f"of {len(found)} steps at different times within a hop.",
            (0.0, 2.0),
            f"Mean: {float(np.mean(found)):.2f}.",
        ),
        Figure(
            "ukf_step_windows",
            max(recursive),
            "The same by the recursive Kalman filter.",
            note=f"Mean: {float(np.mean(recursive)):.2f}.",
        ),
    ]
