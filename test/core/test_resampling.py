"""Samples that were taken unevenly, brought to other times."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.signals.resampling import between_uneven

ROUNDING = 1e-9
"""Of values of the order of the squares of the places."""

NEXT_TO_NONE = 0.02
"""Of the amplitude: between samples two periods apart the sine itself bends ten times that."""

WANTED = np.arange(0.25, 10.0, 0.5)


@given(
    st.integers(0, 2**32 - 1),
    st.floats(-1.0, 1.0),
    st.floats(-1.0, 1.0),
    st.floats(-1.0, 1.0),
)
def test_a_parabola_is_found_between_its_samples(
    seed: int, offset: float, slope: float, bend: float
) -> None:
    places = np.arange(12.0) + np.random.default_rng(seed).uniform(-0.5, 0.5, 12)

    def parabola(at: np.ndarray) -> np.ndarray:
        return offset + slope * at + bend * at * at

    inside = WANTED[(places[0] <= WANTED) & (places[-1] >= WANTED)]
    found = between_uneven(inside, places, parabola(places))
    np.testing.assert_allclose(found, parabola(inside), atol=ROUNDING)


def test_far_from_a_parabola_it_stays_near_the_line() -> None:
    # A sine of ten samples a cycle: the bend that all have together is next to none.
    places = np.arange(30.0) + np.random.default_rng(0).uniform(-0.5, 0.5, 30)
    values = np.sin(0.2 * np.pi * places)
    off = between_uneven(WANTED, places, values) - np.interp(WANTED, places, values)
    assert np.max(np.abs(off)) < NEXT_TO_NONE


@pytest.mark.parametrize("places", [[0.0, 1.0], [2.0, 2.0, 2.0]])
def test_too_few_samples_have_no_bend(places: list[float]) -> None:
    at = np.array(places)
    found = between_uneven(np.array([0.5]), at, at)
    np.testing.assert_array_equal(found, np.interp([0.5], at, at))
