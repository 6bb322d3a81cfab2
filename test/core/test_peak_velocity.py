"""Peak velocity of any motion."""

from __future__ import annotations

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.damper.sigmoid import Array
from mr_damper_ros.kinematics.motion import window_motion
from mr_damper_ros.kinematics.peak_velocity import (
    HALF_CYCLES,
    MEMORY,
    PeakVelocity,
    StreamPeakVelocity,
    peak_velocity_of_window,
)
from mr_damper_ros.rig.excitation import BandLimitedRandom
from mr_damper_ros.streaming.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.streaming.motion_follower import MotionFollower
from mr_damper_ros.streaming.windows import WindowAssembler

PERIOD = 1e-3
TIME = np.arange(6000) * PERIOD
WORST_OF_ALL = 5.0
"""Standard deviations that none of some thousand samples of noise exceeds."""
RANDOM = BandLimitedRandom(rms=3e-3, low=0.5, high=4.0, seed=4)

SAMPLED = 1e-4
"""Relative: the highest sample of a sine lies this close to its peak."""


def sine(frequency: float, speed: float | Array = 0.03, time: Array = TIME) -> Array:
    return np.asarray(speed * np.sin(2.0 * np.pi * frequency * time))


@pytest.mark.parametrize("frequency", [0.1, 0.5, 1.0, 3.0])
def test_in_a_sine_it_is_the_peak_from_the_first_peak_on(frequency: float) -> None:
    found = PeakVelocity(PERIOD).follow(sine(frequency))
    after = 0.25 / frequency < TIME
    np.testing.assert_allclose(found[after], 0.03, rtol=SAMPLED)


@pytest.mark.parametrize("frequency", [0.1, 0.5, 3.0])
def test_a_window_knows_the_peak_of_its_first_half_cycle_from_the_start(frequency: float) -> None:
    found = peak_velocity_of_window(sine(frequency), PERIOD)
    np.testing.assert_allclose(found, 0.03, rtol=SAMPLED)


@pytest.mark.parametrize("cycles", [0.5, 2.0])
@pytest.mark.parametrize("remnant", [1, 30])
def test_a_window_that_begins_right_before_a_reversal_knows_it_too(
    cycles: float, remnant: int
) -> None:
    """Its first samples belong to a half-cycle whose peak it has not seen."""
    time = np.arange(-remnant, round(1000 * cycles)) * PERIOD
    found = peak_velocity_of_window(sine(1.0, time=time), PERIOD)
    np.testing.assert_allclose(found, 0.03, rtol=SAMPLED)


def test_it_is_never_below_the_speed() -> None:
    velocity = RANDOM.at(TIME).velocity
    assert np.all(PeakVelocity(PERIOD).follow(velocity) >= np.abs(velocity))


@known.fixed(40)
@given(sizes=st.lists(st.integers(1, 400), min_size=1, max_size=6))
def test_it_does_not_depend_on_the_size_of_the_blocks(sizes: list[int]) -> None:
    velocity = RANDOM.at(TIME[:2000]).velocity
    follower, parts, first, place = PeakVelocity(PERIOD, memory=0.4), [], 0, 0
    while first < velocity.size:
        last = first + sizes[place % len(sizes)]
        parts.append(follower.follow(velocity[first:last]))
        first, place = last, place + 1
    whole = PeakVelocity(PERIOD, memory=0.4).follow(velocity)
    np.testing.assert_array_equal(np.concatenate(parts), whole)


@known.fixed(20)
@given(faster=st.floats(0.7, 5.0), larger=st.floats(1e-2, 1e2))
def test_a_faster_or_larger_motion_has_a_peak_velocity_higher_in_proportion(
    faster: float, larger: float
) -> None:
    velocity = RANDOM.at(TIME).velocity
    found = PeakVelocity(PERIOD).follow(velocity)
    played = PeakVelocity(PERIOD / faster).follow(faster * larger * velocity)
    np.testing.assert_allclose(played, faster * larger * found, rtol=1e-12)


def test_a_smaller_motion_is_known_after_some_half_cycles() -> None:
    frequency, change = 2.0, 1.5
    velocity = sine(frequency, np.where(change > TIME, 0.05, 0.03))
    found = PeakVelocity(PERIOD).follow(velocity)
    forgotten = change + 0.5 * (HALF_CYCLES + 1) / frequency
    late = forgotten < TIME
    np.testing.assert_allclose(found[late], 0.03, rtol=SAMPLED)
    before = (change < TIME) & (forgotten - 0.6 / frequency > TIME)
    np.testing.assert_allclose(found[before], 0.05, rtol=SAMPLED)


def test_in_a_rest_the_motion_is_forgotten() -> None:
    time = np.arange(round((MEMORY + 4.0) / PERIOD)) * PERIOD
    velocity = np.where(time < 2.0, sine(2.0, time=time), 0.0)
    found = PeakVelocity(PERIOD).follow(velocity)
    assert found[-1] == 0.0
    assert found[round(MEMORY / PERIOD) - 1] == pytest.approx(0.03, rel=SAMPLED)


def test_noise_does_not_count_as_half_cycles() -> None:
    """Else the larger motion would be forgotten at the first reversals of the smaller one."""
    frequency, change, noise = 2.0, 1.5, 1e-3
    velocity = sine(frequency, np.where(change > TIME, 0.05, 0.03))
    velocity += np.random.default_rng(1).normal(0.0, noise, TIME.size)
    found = PeakVelocity(PERIOD).follow(velocity)
    forgotten = change + 0.5 * (HALF_CYCLES - 1) / frequency
    before = (change < TIME) & (forgotten > TIME)
    assert np.all(found[before] > 0.05 - noise)
    assert found[-1] < 0.03 + WORST_OF_ALL * noise


def test_windows_and_streams_have_the_same_peak_velocity() -> None:
    displacement = RANDOM.at(TIME).displacement
    follower, assembler = MotionFollower(PERIOD, 40.0, MEMORY), WindowAssembler(2.0, 1.0)
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


def test_a_recording_and_a_stream_have_nearly_the_same_peak_velocity() -> None:
    displacement = RANDOM.at(TIME).displacement
    whole = window_motion(displacement, PERIOD)
    stream = StreamPeakVelocity(PERIOD).follow(displacement)
    # A peak may be forgotten a half-cycle sooner or later where it hardly counts as one.
    same = np.abs(stream / whole.peak_velocity - 1.0) < 0.01
    assert np.mean(same[1000:]) > 0.9
