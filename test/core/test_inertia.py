"""The mass between load cell and damper is found, and its inertia taken off the force."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import known
import numpy as np
import pytest

import mr_damper_ros as mr
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import peak_velocity_of_period
from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion

MASS, NOISE, PERIOD = 2.0, 0.03, 0.01
"""Kilograms; part of the force's standard deviation; seconds."""

WEAK = known.PLAUSIBLE.copy()
WEAK[known.index("f0")] *= 0.2
"""A damper whose force does not hide the inertia."""


@cache
def shaken() -> dict[str, Any]:
    """Random motion up to 12 Hz for 30 s with a current that is stepped, measured at 100 Hz."""
    fine = PERIOD / 10
    time = np.arange(30_000) * fine
    u, v, a = PeriodicMotion(MotionKind.RANDOM, 0.01, 0.5, 12.0, 30.0, 1).at(time)
    motion = Motion(u, v, a, peak_velocity_of_period(v, a, fine), sine=None)
    rng = np.random.default_rng(0)
    current = np.repeat(rng.uniform(0.0, 1.5, 15), 2000)
    damper = known.SIGMOID.continuous.force(WEAK, motion, current, fine)
    force = (damper + MASS * a)[::10]
    force += NOISE * force.std() * rng.standard_normal(force.size)
    return {
        "displacement": u[::10],
        "force": force,
        "current": current[::10],
        "period": PERIOD,
    }


def test_the_mass_is_found_with_the_law() -> None:
    found = mr.identify(**shaken(), fit_mass=True)
    assert found.mass is not None
    assert found.mass.value == pytest.approx(MASS, rel=0.1)
    assert abs(found.mass.value - MASS) < 3.0 * found.mass.standard_error
    assert "kg between load cell and damper" in str(found)


def test_a_known_mass_is_taken_off_the_force() -> None:
    truth = mr.ParameterSet(WEAK)
    with_it, without = (mr.validate(truth, **shaken(), mass=mass).nrmse for mass in (MASS, 0.0))
    assert with_it < without


@pytest.mark.parametrize("mass", [-1.0, math.nan, math.inf])
def test_a_mass_that_cannot_be_is_refused(mass: float) -> None:
    with pytest.raises(ValueError, match="give kilograms"):
        mr.identify(**shaken(), mass=mass)
