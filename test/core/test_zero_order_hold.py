"""Each value of the current holds until the next one is stamped."""

from __future__ import annotations

import math
from bisect import bisect

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.signals.blocks import CurrentError, ZeroOrderHold

PERIOD = 1e-3
MILLISECOND = 1_000_000


def hold(values: dict[int, float]) -> ZeroOrderHold:
    """Values [A] by their time in milliseconds."""
    made = ZeroOrderHold(keep=60.0)
    for time, value in values.items():
        made.add(time * MILLISECOND, value)
    return made


def test_a_value_holds_from_its_stamp_to_the_next() -> None:
    made = hold({0: 1.0, 3: 2.0, 5: 3.0})
    np.testing.assert_array_equal(made.at(0, PERIOD, 7), [1.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0])


@known.fixed(200)
@given(
    values=st.dictionaries(st.integers(0, 40), st.sampled_from([0.5, 1.0, 1.5]), min_size=1),
    start=st.integers(0, 40),
    count=st.integers(1, 12),
)
def test_what_is_called_constant_is(values: dict[int, float], start: int, count: int) -> None:
    made = hold(dict(sorted(values.items())))
    samples = made.at(start * MILLISECOND, PERIOD, count)
    constant = made.constant(start * MILLISECOND, PERIOD, count)
    if constant is not None:
        np.testing.assert_array_equal(samples, np.full(count, constant))
    else:
        assert any(start < time < start + count for time in values)


def test_values_that_are_too_old_go_many_at_once() -> None:
    """Each time moves all that stay: at every one of a million values it would hold up a stream."""
    made = ZeroOrderHold(keep=1.0)
    begins = []
    for time in range(5000):
        made.add(time * MILLISECOND, 1.0)
        begins.append(bisect(range(time), False, key=lambda t: made.known_from(t * MILLISECOND)))
    kept = np.arange(5000) - begins
    assert np.min(kept[1000:]) >= 1000
    assert np.max(kept) <= 2 * 1002
    assert np.count_nonzero(np.diff(begins)) < 50


def test_a_result_belongs_to_who_asked_for_it() -> None:
    made = hold({0: 1.0})
    made.at(0, PERIOD, 5)[:] = 9.0
    np.testing.assert_array_equal(made.at(0, PERIOD, 5), np.full(5, 1.0))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_value_that_is_not_finite_is_refused(value: float) -> None:
    made = hold({0: 1.0})
    with pytest.raises(CurrentError, match=f"the current is {value}: it must be a finite number"):
        made.add(MILLISECOND, value)
    assert made.last_stamp_ns == 0
