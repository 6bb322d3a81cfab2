"""Work done between two blocks does not change the results."""

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.kinematics.motion_follower import MotionCentre, MotionFollower
from mr_damper_ros.kinematics.observer import CausalDifferentiator
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.tracking.predictor import ForcePredictor, PredictorSettings

PERIOD = 1e-3
STEADY = known.run(current=1.0, samples=4000, seed=None).displacement
UNSTEADY = STEADY * np.linspace(1.0, 2.0, STEADY.size)
SETS = [
    ParameterSet(known.PLAUSIBLE * scale, set_id=f"{scale}", current_range=(0.0, 2.0))
    for scale in (1.0, 1.1)
]


def predictor() -> ForcePredictor:
    made = ForcePredictor(PredictorSettings())
    made.set_parameters(SETS[0])
    made.add_current(known.T0, 1.0)
    return made


def blocks(displacement: Array, *sizes: int) -> list[SampleBlock]:
    return known.blocks(displacement, np.zeros(displacement.size), sizes)


@known.fixed(6)
@given(
    st.sampled_from([STEADY, UNSTEADY]),
    st.lists(st.sampled_from([7, 10, 40]), min_size=1, max_size=4),
    st.integers(0, 2**32 - 1),
)
def test_catching_up_changes_no_prediction(
    displacement: Array, sizes: list[int], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    prompt, late = predictor(), predictor()
    for number, block in enumerate(blocks(displacement[:2000], *sizes)):
        if rng.random() < 0.1:
            # The value computed in advance is no longer valid.
            change = int(rng.integers(2))
            for made in (prompt, late):
                if change:
                    made.set_parameters(SETS[number % 2])
                else:
                    made.add_current(block.start_ns, 0.5 + 0.1 * (number % 5))
        first, second = prompt.predict(block), late.predict(block)
        np.testing.assert_array_equal(first.force, second.force)
        assert (first.valid, first.reason, first.set_id) == (
            second.valid,
            second.reason,
            second.set_id,
        )
        prompt.catch_up()


@pytest.mark.parametrize("size", [1, 10])
@pytest.mark.parametrize("end", [2003, 2017, 2030])
def test_what_comes_after_a_sine_is_followed_as_if_there_had_been_none(size: int, end: int) -> None:
    motion = STEADY.copy()
    motion[end:] *= np.linspace(1.0, 3.0, motion.size - end)
    follower, observer = MotionFollower(PERIOD, 40.0, 10.0), CausalDifferentiator(PERIOD, 40.0)
    was_steady = 0
    for first in range(0, 2500, size):
        block = motion[first : first + size]
        found, (_, velocity, _) = follower.follow(block), observer.follow(block)
        follower.catch_up()
        was_steady += follower.steady
        if first > end and not follower.steady:
            # [m/s].
            np.testing.assert_allclose(found.velocity, velocity, atol=1e-12)
    assert was_steady > 100 // size
    assert not follower.steady


def test_a_rest_is_one_for_as_long_as_it_lasts() -> None:
    """Constant displacement is never a steady sine, even if a sine fits it well."""
    time = np.arange(8000) * PERIOD
    moves = (time < 3.0) | (time >= 7.0)
    noise = np.random.default_rng(0).normal(0.0, 1e-6, time.size)
    displacement = np.where(moves, 5e-3 * np.sin(2.0 * np.pi * time), 0.0) + noise
    follower = MotionFollower(PERIOD, 0.0, 10.0)
    resting = []
    for block in np.split(displacement, 400):
        follower.follow(block)
        follower.catch_up()
        resting.append(follower.resting)
    assert not any(resting[100:150])
    assert all(resting[175:349])
    assert not any(resting[360:])


def test_a_spike_of_the_sensor_does_not_move_the_centre() -> None:
    follower, spiked = MotionFollower(PERIOD, 0.0, 10.0), MotionFollower(PERIOD, 0.0, 10.0)
    for first in range(0, UNSTEADY.size, 10):
        spike = 0.05 * (np.arange(first, first + 10) == 1234)
        motion = follower.follow(UNSTEADY[first : first + 10])
        found = spiked.follow(UNSTEADY[first : first + 10] + spike)
        assert np.all(np.isfinite(found.displacement))
    np.testing.assert_allclose(found.displacement, motion.displacement, atol=1e-5)
    np.testing.assert_allclose(found.peak_velocity, motion.peak_velocity, rtol=0.01)


def test_a_sine_of_many_seconds_does_not_rest_at_its_dead_centres() -> None:
    # It stays within a hundredth of its amplitude for 2.3 to 2.7 s there.
    centre, time = MotionCentre(10.0, 0.05), np.arange(0.0, 200.0, 0.05)
    displacement = 0.01 * np.sin(2.0 * np.pi * 0.02 * time)
    resting = []
    for value in displacement:
        centre.follow(np.array([value]))
        resting.append(centre.resting)
    known = time > 100.0  # after two cycles
    assert not np.any(np.array(resting)[known])
