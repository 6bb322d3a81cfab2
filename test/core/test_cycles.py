"""A segment contains a cycle if it shows the force at all signs of v and a."""

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.kinematics.window import averages, holds_cycle

COUNT = 2000


def sine(cycles: float, phase: float = 0.0, noise: float = 0.0) -> np.ndarray:
    """So many cycles of a 5 mm sine in 2000 samples, from a phase [cycles] on."""
    t = np.linspace(0.0, cycles, COUNT, endpoint=False)
    error = np.random.default_rng(0).normal(0.0, noise, COUNT) if noise else 0.0
    return np.asarray(5e-3 * np.sin(2.0 * np.pi * (t + phase)) + error)


@known.fixed(60)
@given(st.floats(1.15, 200.0), st.floats(0.0, 1.0), st.sampled_from([0.0, 1e-6, 1e-5]))
def test_more_than_a_cycle_of_a_sine_is_one(cycles: float, phase: float, noise: float) -> None:
    assert holds_cycle(sine(cycles, phase, noise))


@known.fixed(60)
@given(st.floats(0.05, 0.5), st.floats(0.0, 1.0), st.sampled_from([0.0, 1e-6, 5e-6]))
def test_half_a_cycle_of_a_sine_is_none(cycles: float, phase: float, noise: float) -> None:
    assert not holds_cycle(sine(cycles, phase, noise))


@pytest.mark.parametrize("seed", range(5))
def test_random_motion_is_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    waves = [rng.normal() * sine(k * rng.uniform(0.9, 1.1), rng.uniform()) for k in range(2, 20)]
    assert holds_cycle(np.sum(waves, axis=0))


@pytest.mark.parametrize(
    "displacement",
    [
        # One direction of motion occurs with only one sign of the acceleration.
        *(sine(0.7, phase) for phase in (0.0, 0.5)),
        # The top of a slow sine moves up and down, but never decelerates at the bottom.
        sine(0.1, 0.2, 1e-6),
        # No motion, or hardly a sample.
        *(np.zeros(COUNT), np.ones(3), np.empty(0), np.arange(9.0)),
    ],
)
def test_a_part_of_a_cycle_or_no_motion_is_none(displacement: np.ndarray) -> None:
    assert not holds_cycle(displacement)


def test_averages_are_of_whole_groups_at_the_end() -> None:
    assert averages(np.arange(7.0), 3).tolist() == [2.0, 5.0]
    assert averages(np.arange(3.0), 3).tolist() == [0.0, 1.0, 2.0]
