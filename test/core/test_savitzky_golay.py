"""The filter of Savitzky and Golay: right for polynomials, and the same as SciPy's."""

from __future__ import annotations

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import savgol_coeffs, savgol_filter

from mr_damper_ros.kinematics.motion import SavitzkyGolay

PERIOD = 2e-3
SCIPY_ROUNDING = 1e-6
"""The same of SciPy's filter, which does not scale the powers, for up to 200 samples."""


@known.fixed(40)
@given(st.integers(3, 100), st.integers(0, 300), st.integers(0, 2), st.integers(0, 1000))
def test_it_is_the_filter_of_scipy(half: int, more: int, order: int, seed: int) -> None:
    length = 2 * half + 1
    values = np.random.default_rng(seed).normal(size=length + more)
    found = SavitzkyGolay(length, 4)
    expected = savgol_filter(values, length, 4, deriv=order, delta=PERIOD)
    difference = found.derivative(values, order, PERIOD) - expected
    assert np.max(np.abs(difference)) < SCIPY_ROUNDING * np.max(np.abs(expected))
    weights = savgol_coeffs(length, 4, deriv=1)
    assert found.squared_change() == pytest.approx(weights @ weights, rel=SCIPY_ROUNDING)


@pytest.mark.parametrize(("length", "sentence"), [(8, "must be odd"), (3, "above 4, the order")])
def test_a_length_that_cannot_be_is_refused(length: int, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        SavitzkyGolay(length, 4)


def test_too_few_values_are_refused() -> None:
    with pytest.raises(ValueError, match="there are 6 values: at least 7 are needed"):
        SavitzkyGolay(7, 4).derivative(np.zeros(6))
