"""The lag of the force behind the current, estimated from windows and applied to windows."""

import numpy as np
import pytest

from mr_damper_ros.estimation.current_lag import CurrentLag, with_lag
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.arrays import Array

PERIOD = 1e-3
COUNT = 2000
NEAR = 3e-3
"""Largest error [s] of an estimate: one step of the compared lags and the error of the law."""


def pulses(period: float, duty: float = 0.5) -> Array:
    """Current [A] of 0 and 1.2 A, with 0.1 s before the window."""
    return 1.2 * (((np.arange(COUNT + 200) * PERIOD) % period) < duty * period)


def window_with(lag: float, current: Array, seed: int = 0) -> Window:
    """Random motion of a damper whose force follows the current with a ``lag`` [s]."""
    rng = np.random.default_rng(seed)
    time, rates = PERIOD * np.arange(COUNT), 2.0 * np.pi * rng.uniform(0.5, 4.0, 8)
    angles = np.outer(time, rates) + rng.uniform(0.0, 2.0 * np.pi, 8)
    u, v = 1e-3 * np.sin(angles).sum(axis=1), 1e-3 * (np.cos(angles) @ rates)
    acts = current[100 - round(lag / PERIOD) :][:COUNT]
    force = (50.0 + 600.0 * np.tanh(acts)) * np.tanh(v / 5e-3) + 900.0 * v
    force += 5.0 * rng.standard_normal(COUNT)
    return Window.from_samples(u, force, current[100 : 100 + COUNT], PERIOD)


@pytest.mark.parametrize("lag", [0.008, -0.035])
def test_one_window_shows_the_lag_of_a_current_that_switches(lag: float) -> None:
    found, error = CurrentLag().after(window_with(lag, pulses(0.37))).estimate
    assert found == pytest.approx(lag, abs=NEAR)
    assert error < NEAR


def test_of_lags_half_a_period_apart_the_smaller_one_is_chosen() -> None:
    found, _ = CurrentLag().after(window_with(0.01, pulses(0.16))).estimate
    assert found == pytest.approx(0.01, abs=NEAR)


def test_a_constant_current_shows_no_lag() -> None:
    evidence = CurrentLag().after(window_with(0.01, np.full(COUNT + 200, 0.8)))
    assert evidence.significant == 0.0


def test_a_force_without_a_lag_gets_none() -> None:
    evidence = CurrentLag()
    for seed in range(4):
        evidence = evidence.after(window_with(0.0, pulses(0.37), seed))
    assert evidence.significant == 0.0


def test_a_lag_that_changes_is_followed() -> None:
    evidence = CurrentLag()
    for seed in range(30):
        lag = 0.008 if seed < 10 else -0.02
        evidence = evidence.after(window_with(lag, pulses(0.37), seed))
    assert evidence.significant == pytest.approx(-0.02, abs=NEAR)


@pytest.mark.parametrize("lag", [0.012, -0.03])
def test_a_window_with_the_lag_applied_shows_none(lag: float) -> None:
    window, known = with_lag(window_with(lag, pulses(0.37)), lag)
    count = round(abs(lag) / PERIOD)
    assert known == (slice(count, COUNT) if lag > 0.0 else slice(0, COUNT - count))
    assert window.sample_count == COUNT - count
    assert CurrentLag().after(window).significant == 0.0
