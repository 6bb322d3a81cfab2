"""How long a large force is remembered depends on whether the motion is steady."""

from __future__ import annotations

import numpy as np
import pytest

from mr_damper_ros.tracking.recent_force import RecentForce

PERIOD = 1e-3
HALF_CYCLE = 0.1
LARGE, SMALL = 700.0, 300.0


@pytest.mark.parametrize(("steady", "peak"), [(True, SMALL), (False, LARGE)])
def test_small_half_cycles_are_no_smaller_peak_unless_the_motion_is_steady(
    steady: bool, peak: float
) -> None:
    recent = RecentForce(PERIOD)
    for size, seconds in ((LARGE, 2), (SMALL, 4)):
        time = PERIOD * np.arange(seconds * 1000)
        force = size * np.sign(np.cos(np.pi * time / HALF_CYCLE))
        for part in np.split(force, seconds * 10):
            recent.add((part, part), part / LARGE, HALF_CYCLE, steady=steady)
    assert recent.peak == pytest.approx(peak)


@pytest.mark.parametrize("half_cycle", [HALF_CYCLE, 2.5])
def test_a_large_force_is_forgotten_in_any_motion(half_cycle: float) -> None:
    recent = RecentForce(PERIOD)
    for size, seconds in ((LARGE, 2), (SMALL, 11)):
        for part in np.split(size * np.tile((1.0, -1.0), 500 * seconds), seconds * 10):
            recent.add((part, part), part / LARGE, half_cycle, steady=False)
    assert recent.peak == pytest.approx(SMALL)
