"""Covariances tell the truth for white and for correlated residuals, and NaN for the unknown."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from mr_damper_ros.estimation.covariance import correlation_length, least_squares_covariance
from mr_damper_ros.models import MODELS
from mr_damper_ros.signals.arrays import Array

N = 2000


def design(seed: int = 0) -> Array:
    """Three smooth columns of very different size."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, N)
    columns = np.column_stack((np.ones(N), np.sin(12.0 * t), t**2 + 0.1 * rng.normal(size=N)))
    return np.asarray(columns * np.array([1.0, 1e-3, 1e4]))


def correlated(seed: int, memory: float, scale: float = 1.0) -> Array:
    """A residual of unit variance whose autocorrelation falls as memory^lag."""
    white = np.random.default_rng(seed).normal(0.0, np.sqrt(1.0 - memory**2), N + 500)
    return np.asarray(scale * lfilter([1.0], [1.0, -memory], white)[500:])


def test_what_is_unknown_leaves_the_others_alone_where_the_residual_is_correlated() -> None:
    jacobian, residual = design(), correlated(0, 0.95)
    padded = np.insert(jacobian, 1, 0.0, axis=1)
    covariance = least_squares_covariance(padded, residual)
    assert np.isnan(np.diag(covariance)).tolist() == [False, True, False, False]
    rest = np.delete(np.delete(covariance, 1, axis=0), 1, axis=1)
    expected = least_squares_covariance(jacobian, residual)
    np.testing.assert_allclose(rest, expected, rtol=0.01)


@pytest.mark.parametrize("memory", [0.0, 0.8, 0.95])
def test_the_covariance_is_that_of_repeated_experiments(memory: float) -> None:
    jacobian = design()
    solve = np.linalg.pinv(jacobian)
    estimates, claimed = [], []
    for seed in range(300):
        noise = correlated(seed, memory)
        estimate = solve @ noise
        estimates.append(estimate)
        claimed.append(np.diag(least_squares_covariance(jacobian, noise - jacobian @ estimate)))
    ratio = np.mean(claimed, axis=0) / np.var(estimates, axis=0)
    # Standard errors within a quarter; a variance from 300 draws is good for 8 %.
    assert np.all((ratio > 0.75**2) & (ratio < 1.25**2)), ratio


@pytest.mark.parametrize("memory", [0.5, 0.8, 0.95])
def test_the_length_of_a_correlation_is_found(memory: float) -> None:
    exact = 4.0 * np.log(0.05) / np.log(memory)
    lengths = [correlation_length(correlated(seed, memory)) for seed in range(30)]
    assert np.median(lengths) == pytest.approx(exact, rel=0.4)


@pytest.mark.parametrize("residual", [np.zeros(N), np.ones(10)], ids=["zero", "short"])
def test_a_residual_that_says_nothing_counts_as_white(residual: Array) -> None:
    assert correlation_length(residual) == 0


def test_the_error_of_k5_is_that_of_a_quotient() -> None:
    scales = np.array([50.0, 1.0, 1.0, 1.0, 1.0, 1.0, 4.0])
    covariance = np.diag([4.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.09])
    covariance[0, 6] = covariance[6, 0] = 0.3
    draws = np.random.default_rng(0).multivariate_normal(scales, covariance, 200_000)
    errors = MODELS["sigmoid"].fitted_errors(scales, covariance)[1]
    assert errors[6] == pytest.approx(np.std(draws[:, 6] / draws[:, 0]), rel=0.02)
    np.testing.assert_allclose(errors[:6], np.sqrt(np.diag(covariance))[:6])
