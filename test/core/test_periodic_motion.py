"""Periodic motions are exact and never exceed their stated limits."""

import math
from dataclasses import replace

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion, RepeatedMatch

ROUNDING = 1e-9
"""Relative tolerance."""

SWEEP = PeriodicMotion(MotionKind.SWEEP, 0.008, 0.6, 3.4, 2.0)
RANDOM = PeriodicMotion(MotionKind.RANDOM, 0.008, 0.6, 3.4, 2.0, 3)
SINE = PeriodicMotion(MotionKind.SINE, 0.008, 2.5)
KINDS = pytest.mark.parametrize("motion", [SINE, SWEEP, RANDOM], ids=lambda one: one.kind.value)


@st.composite
def motions(draw: st.DrawFn) -> PeriodicMotion:
    period = draw(st.floats(1.0, 10.0))
    low = draw(st.floats(0.2, 5.0))
    high = low + draw(st.floats(6.0, 20.0)) / period
    kind = draw(st.sampled_from(MotionKind))
    return PeriodicMotion(kind, 0.01, low, high, period, draw(st.integers(0, 9999)))


@known.fixed(60)
@given(motions())
def test_no_sample_is_beyond_what_it_says(motion: PeriodicMotion) -> None:
    time = np.linspace(0.0, motion.length, 20_011)
    displacement, velocity, _ = motion.at(time)
    assert np.abs(displacement).max() <= motion.amplitude * (1.0 + ROUNDING)
    assert np.abs(velocity).max() <= motion.peak_velocity * (1.0 + ROUNDING)
    assert motion.peak_velocity <= motion.growing_velocity


@KINDS
def test_velocity_and_acceleration_are_derivatives(motion: PeriodicMotion) -> None:
    time = np.arange(40_000) * 1e-4
    displacement, velocity, acceleration = motion.at(time)
    for value, slope in ((displacement, velocity), (velocity, acceleration)):
        error = np.abs(np.gradient(value, time) - slope)[1:-1].max()
        # Relative error of a second difference with many samples per cycle.
        assert error < 1e-4 * np.abs(slope).max()


def test_a_swept_sine_goes_from_the_lowest_frequency_to_the_highest_and_back() -> None:
    time = np.arange(200_000) * 1e-4
    displacement, velocity, _ = replace(SWEEP, period=20.0).at(time)
    crossings = time[1:][(displacement[:-1] < 0.0) & (displacement[1:] >= 0.0)]
    frequencies = 1.0 / np.diff(crossings)
    assert frequencies.max() == pytest.approx(3.4, rel=0.02)
    assert np.abs(velocity).max() == pytest.approx(2.0 * math.pi * 3.4 * 0.008, rel=0.02)
    assert velocity[[0, -1]] == pytest.approx(2.0 * math.pi * 0.6 * 0.008, rel=0.02)


@pytest.mark.parametrize(
    ("given_values", "sentence"),
    [
        ((MotionKind.SINE, math.nan, 1.0), "amplitude is nan"),
        ((MotionKind.SINE, 0.01, 0.0), "frequency is 0"),
        ((MotionKind.SWEEP, 0.01, 2.0, 1.0, 4.0), "must be higher"),
        ((MotionKind.SWEEP, 0.01, 1.0, 1.5, 0.5), "too short"),
        ((MotionKind.RANDOM, 0.01, 1.0, 2.0, 1.0), "too short"),
        ((MotionKind.RANDOM, 0.01, 1.0, 1e9, 1e9), "too many cycles"),
        ((MotionKind.RANDOM, 0.01, 1e-9, 3000.0, 1.0), "too many cycles"),
        ((MotionKind.SWEEP, 0.01, 1.0, 1e308, 1e308), "too many cycles"),
        ((MotionKind.RANDOM, 0.01, 1.0, 9.0, 1.0, -1), "seed is -1"),
    ],
)
def test_what_is_no_motion_is_refused(given_values: tuple[object, ...], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        PeriodicMotion(*given_values)  # type: ignore[arg-type]


@KINDS
def test_a_motion_is_known_wherever_it_begins(motion: PeriodicMotion) -> None:
    match = RepeatedMatch(motion, 1e-3)
    displacement = motion.at(0.123 + np.arange(4000) * 1e-3)[0]
    assert match.left_of(0.02 + displacement) < 1e-6
    assert match.left_of(1.1 * displacement) == pytest.approx(0.1, rel=0.05)
