"""The lag, the stiffness and the offset that extend the sigmoid law."""

from __future__ import annotations

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.damper.extension import (
    EXTENDED_NAMES,
    Extension,
    FirstOrderLag,
    extension_of,
    is_extended,
    lagged,
    name_of_law,
)
from mr_damper_ros.damper.models import MODELS

PERIOD = 1e-3
COUNT = 400

ROUNDING = 1e-9
"""Relative to a signal of unit size."""

LARGEST = 1e3
"""Largest constant that is lagged; its rounding is as much larger."""

BY_DIFFERENCES = 1e-7
"""Of a signal of unit size: rounding over steps of a millionth of the time constant, with room."""

BY_SMALL_DIFFERENCES = 1e-5
"""Relative to the largest derivative: rounding over steps of a nanosecond."""

BY_ONE_SIDE = 0.05
"""Relative: a lag has no smaller side than none, and one-sided differences keep the curvature."""

CHANGING = 5e-3 + 4e-3 * np.abs(np.sin(np.arange(COUNT) / 50.0))


def signal(columns: int = 1) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(COUNT, columns)).squeeze()


def recursion(values: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """The lag as written in its definition, step by step."""
    late = np.array(values)
    for k in range(1, len(values)):
        ratio = PERIOD / tau[k]
        decay = np.exp(-ratio)
        mean = (1.0 - decay) / ratio
        late[k] = decay * late[k - 1] + (mean - decay) * values[k - 1] + (1.0 - mean) * values[k]
    return late


@pytest.mark.parametrize("tau", [2e-3, 0.05, CHANGING, np.where(CHANGING > 7e-3, 1e-5, 2e-3)])
@pytest.mark.parametrize("columns", [1, 3])
def test_the_lag_is_the_recursion_that_defines_it(tau, columns):
    values = signal(columns)
    expected = recursion(values, np.broadcast_to(tau, COUNT))
    np.testing.assert_allclose(FirstOrderLag(tau, PERIOD)(values), expected, atol=ROUNDING)


def test_a_ramp_comes_late_by_the_time_constant():
    ramp = np.arange(COUNT) * PERIOD
    late = FirstOrderLag(5e-3, PERIOD)(ramp)
    np.testing.assert_allclose((ramp - late)[100:], 5e-3, atol=ROUNDING)


@pytest.mark.parametrize("tau", [1e-4, 5e-3, 2.0])
def test_a_periodic_lag_is_the_lag_after_many_periods(tau):
    values = signal()[:100]
    often = int(30.0 * tau / (100 * PERIOD)) + 2
    expected = FirstOrderLag(tau, PERIOD)(np.tile(values, often))[-100:]
    np.testing.assert_allclose(
        FirstOrderLag(tau, PERIOD, periodic=True)(values), expected, atol=ROUNDING
    )


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("tau", [1e-3, 5e-3, 0.1])
def test_the_derivative_by_the_time_constant_is_that_of_differences(tau, periodic):
    values, step = signal(), 1e-6 * tau
    above, below = (
        FirstOrderLag(t, PERIOD, periodic=periodic)(values) for t in (tau + step, tau - step)
    )
    lag = FirstOrderLag(tau, PERIOD, periodic=periodic)
    derivative = lag.derivative(values, lag(values))
    expected = (above - below) / (2.0 * step)
    np.testing.assert_allclose(derivative * tau, expected * tau, atol=BY_DIFFERENCES)


def test_the_derivative_by_a_changing_time_constant_is_that_of_differences():
    values, weight, step = signal(), np.linspace(0.0, 2.0, COUNT), 1e-9
    above, below = (FirstOrderLag(CHANGING + s * weight, PERIOD)(values) for s in (step, -step))
    lag = FirstOrderLag(CHANGING, PERIOD)
    derivative = lag.derivative(values, lag(values), weight)
    expected = (above - below) / (2.0 * step)
    allowed = BY_SMALL_DIFFERENCES * np.abs(expected).max()
    np.testing.assert_allclose(derivative, expected, atol=allowed)


def test_the_derivative_exists_where_there_is_no_lag_yet():
    values, step = signal(), 1e-3 * PERIOD
    lag = FirstOrderLag(0.0, PERIOD)
    expected = (FirstOrderLag(step, PERIOD)(values) - values) / step
    np.testing.assert_allclose(lag.derivative(values, lag(values)), expected, rtol=BY_ONE_SIDE)


@known.fixed(30)
@given(tau=st.floats(0.0, 1.0), level=st.floats(-LARGEST, LARGEST))
def test_a_constant_is_not_changed_and_no_value_is_exceeded(tau, level):
    lag = FirstOrderLag(tau, PERIOD)
    np.testing.assert_allclose(lag(np.full(COUNT, level)), level, atol=LARGEST * ROUNDING)
    values = signal()
    late = lag(values)
    assert values.min() - ROUNDING <= late.min() <= late.max() <= values.max() + ROUNDING


def test_a_time_constant_is_never_negative():
    current = np.array([-2.0, 0.0, 1.0])
    np.testing.assert_allclose(
        Extension(-1e-3, 2e-3, 0.0, 0.0).time_constant(current), [3e-3, 0.0, 1e-3]
    )


def test_the_names_are_those_of_the_model():
    assert MODELS["sigmoid_lag"].parameter_names == EXTENDED_NAMES


def test_an_array_tells_its_law():
    extended = np.append(known.PLAUSIBLE, [1e-3, 2e-3, 3.0, 4.0])
    assert not is_extended(known.PLAUSIBLE)
    assert is_extended(extended)
    assert (name_of_law(known.PLAUSIBLE), name_of_law(extended)) == ("sigmoid", "sigmoid_lag")
    assert extension_of(extended) == (1e-3, 2e-3, 3.0, 4.0)
    with pytest.raises(ValueError, match="there are 17 parameters: the sigmoid law has 16"):
        is_extended(np.zeros(17))


@pytest.mark.parametrize("tau", [5e-3, CHANGING])
def test_a_lag_goes_on_from_its_state(tau):
    values = signal()
    whole = lagged(values, tau, PERIOD)
    first = slice(0, 150)
    rest = lagged(
        values[150:],
        np.broadcast_to(tau, COUNT)[150:],
        PERIOD,
        (values[first][-1], whole[first][-1]),
    )
    np.testing.assert_allclose(rest, whole[150:], atol=ROUNDING)
