"""Samples that were taken unevenly, brought to other times."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.signals.arrays import white_noise
from mr_damper_ros.signals.uniform_grid import at_uniform_times


def uneven(count: int, seed: int) -> np.ndarray:
    return np.arange(count) + np.random.default_rng(seed).uniform(-0.5, 0.5, count)


@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4),
    st.integers(4, 30),
)
def test_a_cubic_is_found_at_even_times(seed: int, cubic: list[float], count: int) -> None:
    places = uneven(count, seed)
    wanted = np.arange(count) - 0.5
    found = at_uniform_times(wanted, places, np.polyval(cubic, places))
    # Of values of the order of the cubes of the places.
    np.testing.assert_allclose(found, np.polyval(cubic, wanted), atol=1e-6 * count**3)


def test_white_noise_stays_white() -> None:
    # A smoother finds its length from the noise, which it knows by its being white.
    count = 4000
    noise = np.random.default_rng(1).standard_normal(count)
    brought = at_uniform_times(np.arange(count) - 0.5, uneven(count, seed=2), noise)
    # Part by which the white noise of a few thousand samples may seem to change.
    assert white_noise(brought) == pytest.approx(white_noise(noise), rel=0.1)


@pytest.mark.parametrize("places", [[0.0], [0.0, 1.0], [2.0] * 20])
def test_few_samples_or_such_of_one_stamp_have_a_finite_value(places: list[float]) -> None:
    at = np.array(places)
    assert np.isfinite(at_uniform_times(np.array([0.5]), at, at)).all()
