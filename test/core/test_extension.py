"""The compliance, the stiffness and the offset that extend the sigmoid law."""

from __future__ import annotations

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mr_damper_ros.models.first_order_lag import FirstOrderLag
from mr_damper_ros.models.sigmoid.following import extension_of, is_extended

PERIOD = 1e-3
COUNT = 400

ROUNDING = 1e-9
"""Relative to a signal of unit size."""

LARGEST = 1e3
"""Largest constant that is lagged; its rounding is as much larger."""

CHANGING = 5e-3 + 4e-3 * np.abs(np.sin(np.arange(COUNT) / 50.0))


def signal(columns: int = 1) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(COUNT, columns)).squeeze()


def constant(tau: float) -> np.ndarray:
    return np.full(COUNT, tau)


def recursion(values: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """The lag as written in its definition, step by step."""
    late = np.array(values)
    for k in range(1, len(values)):
        ratio = PERIOD / (0.5 * (tau[k - 1] + tau[k]))
        decay = np.exp(-ratio)
        mean = (1.0 - decay) / ratio
        late[k] = decay * late[k - 1] + (mean - decay) * values[k - 1] + (1.0 - mean) * values[k]
    return late


@pytest.mark.parametrize(
    "tau", [constant(2e-3), constant(0.05), CHANGING, np.where(CHANGING > 7e-3, 1e-5, 2e-3)]
)
def test_the_lag_is_the_recursion_that_defines_it(tau):
    values = signal()
    expected = recursion(values, tau)
    np.testing.assert_allclose(FirstOrderLag(tau, PERIOD)(values), expected, atol=ROUNDING)


@pytest.mark.parametrize("tau", [1e-4, 5e-3, 2.0, "changing"])
def test_a_periodic_lag_is_the_lag_after_many_periods(tau):
    values = signal()
    taus = CHANGING if tau == "changing" else constant(tau)
    often = int(30.0 * taus.max() / (COUNT * PERIOD)) + 2
    expected = FirstOrderLag(np.tile(taus, often), PERIOD)(np.tile(values, often))[-COUNT:]
    # Where the periods meet, the mean of two time constants is the same in both.
    np.testing.assert_allclose(
        FirstOrderLag(taus, PERIOD, periodic=True)(values), expected, atol=ROUNDING
    )


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("tau", [constant(1e-3), constant(0.1), CHANGING])
def test_the_derivative_is_that_of_differences(tau, periodic):
    values, step = signal(), 1e-9
    of_values, of_tau = signal(2).T, np.array([np.linspace(0.0, 2.0, COUNT), np.zeros(COUNT)])
    above, below = (
        np.column_stack(
            [
                FirstOrderLag(tau + s * t, PERIOD, periodic=periodic)(values + s * v)
                for v, t in zip(of_values, of_tau, strict=True)
            ]
        )
        for s in (step, -step)
    )
    lag = FirstOrderLag(tau, PERIOD, periodic=periodic)
    derivative = lag.derivative(values, lag(values), of_values.T, of_tau.T)
    expected = (above - below) / (2.0 * step)
    # Relative to the largest derivative: rounding over steps of a nanosecond.
    allowed = 1e-5 * np.abs(expected).max()
    np.testing.assert_allclose(derivative, expected, atol=allowed)


@known.fixed(30)
@given(tau=st.floats(0.0, 1.0), level=st.floats(-LARGEST, LARGEST))
def test_a_constant_is_not_changed_and_no_value_is_exceeded(tau, level):
    lag = FirstOrderLag(constant(tau), PERIOD)
    np.testing.assert_allclose(lag(np.full(COUNT, level)), level, atol=LARGEST * ROUNDING)
    values = signal()
    late = lag(values)
    assert values.min() - ROUNDING <= late.min() <= late.max() <= values.max() + ROUNDING


def test_an_array_tells_its_law():
    extended = np.append(known.PLAUSIBLE, [1e-8, 3.0, 4.0, 0.0])
    assert not is_extended(known.PLAUSIBLE)
    assert is_extended(extended)
    assert extension_of(extended) == (1e-8, 3.0, 4.0)
    with pytest.raises(ValueError, match="there are 17 parameters: the sigmoid law has 16"):
        is_extended(np.zeros(17))
