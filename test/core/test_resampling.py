"""Samples resampled to other times, smoothed, and joined to those of other channels."""

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import savgol_coeffs, savgol_filter

from mr_damper_ros.kinematics.motion import SavitzkyGolay
from mr_damper_ros.rig.blocks import aligned
from mr_damper_ros.signals.arrays import white_noise
from mr_damper_ros.signals.blocks import RigBlock
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
    # The values are as large as the cubed times.
    np.testing.assert_allclose(found, np.polyval(cubic, wanted), atol=1e-6 * count**3)


def test_white_noise_stays_white() -> None:
    # A smoother chooses its length from the noise, which it recognises by its whiteness.
    count = 4000
    noise = np.random.default_rng(1).standard_normal(count)
    brought = at_uniform_times(np.arange(count) - 0.5, uneven(count, seed=2), noise)
    # Relative error of the noise estimated from a few thousand samples.
    assert white_noise(brought) == pytest.approx(white_noise(noise), rel=0.1)


@pytest.mark.parametrize("places", [[0.0], [0.0, 1.0], [2.0] * 20])
def test_few_samples_or_such_of_one_stamp_have_a_finite_value(places: list[float]) -> None:
    at = np.array(places)
    assert np.isfinite(at_uniform_times(np.array([0.5]), at, at)).all()


# -- the Savitzky-Golay filter: exact for polynomials, and equal to SciPy's ------------------------

STEP = 2e-3
SCIPY_ROUNDING = 1e-6
"""As ROUNDING, for SciPy's filter with up to 200 samples; it does not scale the powers."""


@known.fixed(40)
@given(st.integers(3, 100), st.integers(0, 300), st.integers(0, 2), st.integers(0, 1000))
def test_it_is_the_filter_of_scipy(half: int, more: int, order: int, seed: int) -> None:
    length = 2 * half + 1
    values = np.random.default_rng(seed).normal(size=length + more)
    found = SavitzkyGolay(length, 4)
    expected = savgol_filter(values, length, 4, deriv=order, delta=STEP)
    difference = found.derivative(values, order, STEP) - expected
    assert np.max(np.abs(difference)) < SCIPY_ROUNDING * np.max(np.abs(expected))
    weights = savgol_coeffs(length, 4, deriv=2)
    assert found.noise_gain() == pytest.approx(weights @ weights, rel=SCIPY_ROUNDING)


# -- channels sampled at different times are resampled to common times -----------------------------

PERIOD = 1e-3
START = 1_700_000_000_000_000_000


def motion(time: np.ndarray) -> np.ndarray:
    return 0.005 * np.sin(2.0 * np.pi * 3.0 * time)


def pull(time: np.ndarray) -> np.ndarray:
    return 900.0 * np.cos(2.0 * np.pi * 3.0 * time)


def skewed(lateness: float, sizes: list[int], missing: int = -1) -> list[RigBlock]:
    """Blocks whose force was sampled ``lateness`` seconds earlier; block ``missing`` is lost."""
    blocks, first = [], 0
    for place, size in enumerate(sizes):
        time = (first + np.arange(size)) * PERIOD
        late, later = max(lateness, 0.0), max(-lateness, 0.0)
        block = RigBlock(
            START + first * 1_000_000,
            first if size else 0,  # a source without new samples yields block 0
            PERIOD,
            motion(time - later),
            pull(time - late),
            np.full(size, 0.5),
            np.full(size, 30.0),
        )
        first += size
        if place != missing:
            blocks.append(block)
    return blocks


@pytest.mark.parametrize("lateness", [2.7e-3, 0.4e-3, 1e-3, -3.1e-3, -0.2e-3])
@pytest.mark.parametrize("sizes", [[100, 100], [1] * 60, [3, 50, 0, 2, 7, 40]])
def test_both_are_what_they_were_at_the_stamp(lateness: float, sizes: list[int]) -> None:
    blocks = list(aligned(skewed(lateness, sizes), lateness))
    for block in blocks:
        time = (block.start_ns - START) * 1e-9 + np.arange(block.sample_count) * PERIOD
        np.testing.assert_allclose(block.displacement, motion(time), atol=1e-9)
        np.testing.assert_allclose(block.force, pull(time), atol=1e-3)
    numbers = np.concatenate([b.sequence + np.arange(b.sample_count) for b in blocks])
    assert (np.diff(numbers) == 1).all()
    # Only samples at the beginning have no partner.
    assert numbers[-1] == sum(sizes) - 1
    assert numbers[0] <= 6


def test_after_a_gap_nothing_is_made_of_what_was_before() -> None:
    blocks = list(aligned(skewed(2.5e-3, [40] * 5, missing=2), 2.5e-3))
    assert [block.sequence for block in blocks] == [4, 40, 124, 160]
    for block in blocks:
        time = (block.start_ns - START) * 1e-9 + np.arange(block.sample_count) * PERIOD
        np.testing.assert_allclose(block.displacement, motion(time), atol=1e-9)
