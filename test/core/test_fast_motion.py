"""Motion with few samples per cycle: its derivatives, and the force of a law with memory."""

import numpy as np
import pytest

from mr_damper_ros.kinematics.motion import Motion, window_motion
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.quantities import LoopReading
from mr_damper_ros.signals.arrays import Array

FINE, STRIDE = 1e-3, 10


def shaken() -> tuple[Array, Array, Array]:
    """Displacement, velocity and acceleration of random motion up to 12 Hz, sampled at 1 kHz."""
    time = np.arange(30_000) * FINE
    return PeriodicMotion(MotionKind.RANDOM, 0.02, 0.5, 12.0, 30.0, 1).at(time)


def test_the_velocity_at_eight_samples_per_cycle() -> None:
    u, v, a = (values[::STRIDE] for values in shaken())
    found = window_motion(u, STRIDE * FINE)
    assert np.std(found.velocity - v) < 0.002 * np.std(v)
    assert np.std(found.acceleration - a) < 0.005 * np.std(a)


@pytest.mark.parametrize("name", ["bouc_wen", "series_springs"])
def test_a_resolved_window_has_the_force_of_fine_samples(name: str) -> None:
    u, v, a = shaken()
    law = MODELS[name]
    values = law.starts(LoopReading(500.0, 0.0, 0.2, 0.02))[0]
    force, _ = law.follow(values, Motion(u, v, a, np.abs(v), None), np.ones(u.size), FINE, None)
    window = Window.from_samples(u[::STRIDE], force[::STRIDE], 1.0, STRIDE * FINE)
    left = [
        np.std((law.window_force(w, values) - w.force)[500:]) / np.std(window.force)
        for w in (window, window.resolved())
    ]
    assert left[1] < 0.015 < left[0]


def test_samples_that_are_close_enough_stay_as_they_are() -> None:
    u, v, _ = shaken()
    window = Window.from_samples(u, v, 1.0, FINE)
    assert window.resolved() is window
