"""Peak velocity of any motion."""

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_motion import BandLimitedRandom

from mr_damper_ros.kinematics.motion_follower import MotionFollower
from mr_damper_ros.kinematics.peak_velocity import (
    HALF_CYCLES,
    MEMORY,
    PeakVelocity,
    StreamPeakVelocity,
)
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.tracking.window_assembler import WindowAssembler, WindowSettings

PERIOD = 1e-3
TIME = np.arange(6000) * PERIOD
RANDOM = BandLimitedRandom(rms=3e-3, low=0.5, high=4.0, seed=4)

SAMPLED = 2e-3
"""Relative: half-cycles end at a sample instead of the reversal itself."""

OF_FEW = 0.02
"""Relative: the additional error with only one or two half-cycles whose speed changes."""

ROUNDING = 1e-12
"""Relative: sums over different parts of the same samples."""


def sine(frequency: float, speed: float | Array = 0.03, time: Array = TIME) -> tuple[Array, Array]:
    """Velocity and acceleration."""
    omega = 2.0 * np.pi * frequency
    return np.asarray(speed * np.sin(omega * time)), np.asarray(
        speed * omega * np.cos(omega * time)
    )


def random_motion(time: Array = TIME) -> tuple[Array, Array]:
    motion = RANDOM.at(time)
    return motion.velocity, motion.acceleration


@pytest.mark.parametrize("frequency", [1.0, 3.0, 12.0])
def test_in_a_sine_it_is_the_peak_soon_and_then_more_exactly(frequency: float) -> None:
    found = PeakVelocity(PERIOD).follow(*sine(frequency))
    # The first half-cycle may have begun before the stream.
    np.testing.assert_allclose(found[1.1 / frequency < TIME], 0.03, rtol=OF_FEW)
    late = (0.5 * HALF_CYCLES + 1.0) / frequency < TIME
    np.testing.assert_allclose(found[late], 0.03, rtol=SAMPLED)


@known.fixed(20)
@given(faster=st.floats(0.7, 5.0), larger=st.floats(1e-2, 1e2))
def test_a_faster_or_larger_motion_has_a_peak_velocity_higher_in_proportion(
    faster: float, larger: float
) -> None:
    velocity, acceleration = random_motion()
    factor = faster * larger
    found = PeakVelocity(PERIOD).follow(velocity, acceleration)
    played = PeakVelocity(PERIOD / faster).follow(factor * velocity, factor * faster * acceleration)
    np.testing.assert_allclose(played, factor * found, rtol=ROUNDING)


def test_noise_of_the_velocity_does_not_count_as_half_cycles() -> None:
    """Otherwise the angular frequency would be that of the noise between two reversals."""
    velocity, acceleration = sine(0.5)
    deviation = 1e-3
    noise = np.random.default_rng(1).normal(0.0, deviation, TIME.size)
    found = PeakVelocity(PERIOD).follow(velocity + noise, acceleration)
    # Standard deviations of the velocity noise, exceeded by hardly any of 6000 samples.
    assert np.all(np.abs(found[TIME > 2.5] - 0.03) < 5.0 * deviation)


@pytest.mark.parametrize("memory", [MEMORY, 0.05])
def test_windows_and_streams_have_the_same_peak_velocity(memory: float) -> None:
    displacement = RANDOM.at(TIME).displacement
    follower = MotionFollower(PERIOD, 0.0, memory)
    assembler = WindowAssembler(WindowSettings(2.0, 1.0, centre_memory=memory, looks=0))
    assembler.add_current(0, 1.0)
    followed, windows = [], []
    for first in range(0, TIME.size, 50):
        part = displacement[first : first + 50]
        followed.append(follower.follow(part).peak_velocity)
        stamp = round(first * PERIOD * NANOSECONDS)
        block = SampleBlock(stamp, first, PERIOD, part, np.zeros(50))
        windows += assembler.add_block(block) + assembler.add_current(block.end_ns, 1.0)
    stream = np.concatenate(followed)
    assert len(windows) == 5
    for window in windows:
        first = round(window.start_ns / NANOSECONDS / PERIOD)
        assert window.peak_velocity is not None
        np.testing.assert_array_equal(window.peak_velocity, stream[first : first + 2000])


@pytest.mark.parametrize("size", [1, 10, 1000])
def test_the_start_of_a_stream_has_the_same_peak_velocity_in_blocks_of_any_size(size: int) -> None:
    # The observer settles within the first blocks; 7 divides none of the sizes.
    displacement = RANDOM.at(TIME).displacement[:1000]

    def followed(size: int) -> Array:
        peak = StreamPeakVelocity(PERIOD)
        parts = [displacement[first : first + size] for first in range(0, 1000, size)]
        return np.concatenate([peak.follow(part) for part in parts])

    # Matrix products of different sizes round differently.
    np.testing.assert_allclose(followed(size), followed(7), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("memory", [10.0, 0.3])
@pytest.mark.parametrize("seed", range(6))
def test_many_samples_at_once_are_followed_like_each_alone(seed: int, memory: float) -> None:
    rng = np.random.default_rng(seed)
    time = PERIOD * np.arange(20_000)
    frequency = 10.0 ** rng.uniform(-0.5, 1.5)
    velocity = np.sin(2.0 * np.pi * frequency * time * (1.0 + 0.01 * time))
    velocity *= (np.sin(0.5 * time) > -0.5) + 1e-3 * seed * rng.standard_normal(time.size)
    acceleration = np.gradient(velocity, PERIOD)
    once, single = PeakVelocity(PERIOD, memory), PeakVelocity(PERIOD, memory)
    found = once.time_scales(velocity, acceleration)
    expected = np.concatenate(
        [single.time_scales(velocity[k : k + 1], acceleration[k : k + 1]) for k in range(time.size)]
    )
    np.testing.assert_array_equal(found, expected)
    assert vars(once) == vars(single)
