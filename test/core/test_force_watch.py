"""How large an error of a sample is seen, by the noise of the load cell."""

from __future__ import annotations

import numpy as np
import pytest

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.force_watch import ForceWatch

PERIOD = 1e-3
PEAK = 1000.0
LIMIT = 0.2


def watch_of(noise: float) -> tuple[ForceWatch, Array]:
    """One that has followed a second of a sine force, and the next samples of that."""
    watch = ForceWatch(PERIOD, LIMIT)
    angle = 2.0 * np.pi * PERIOD * np.arange(3000)
    force = PEAK * np.sin(angle) + noise * np.random.default_rng(0).standard_normal(angle.size)
    for part in np.split(force, 300):
        watch.judge(part, part)
        watch.learn((part, part), part / PEAK, 1.0, 0.5, steady=True)
    return watch, force[:10]


@pytest.mark.parametrize(("error", "valid"), [(0.19, True), (0.21, False)])
def test_without_noise_the_limit_is_that_of_the_error_itself(error: float, valid: bool) -> None:
    watch, force = watch_of(0.0)
    off = np.where(np.arange(force.size) == 4, error * PEAK, 0.0)
    assert any(watch.judge(force + off, force)) is not valid


def test_much_noise_alone_is_no_wrong_force() -> None:
    noise = 0.04 * PEAK
    watch, force = watch_of(noise)
    beyond = np.where(np.arange(force.size) == 4, 4.0 * noise, 0.0)
    assert not any(watch.judge(force, force + beyond))


def test_noise_leaves_a_margin_to_the_limit() -> None:
    watch, force = watch_of(0.004 * PEAK)
    off = np.where(np.arange(force.size) == 4, 0.195 * PEAK, 0.0)
    assert any(watch.judge(force + off, force))
