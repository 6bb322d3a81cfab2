"""Errors of a fit are of two kinds, and a misfit that repeats every cycle is not noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks import following
from mr_damper_ros.estimation.covariance import NoiseModel, error_covariances
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.force_scale import ForceScale, WindowScale, widened

N, CYCLE = 2000, 800.0

SCATTER = (0.75, 1.3)
"""Of a standard deviation from so many runs, and an estimate that is good for a fifth."""


def noise(memory: float, seed: int) -> Array:
    """Noise of unit variance whose autocorrelation falls as memory^lag, shape (N,)."""
    white = np.random.default_rng(seed).normal(0.0, math.sqrt(1.0 - memory**2), N + 500)
    return np.asarray(lfilter([1.0], [1.0, -memory], white)[500:])


def design(phase: float) -> Array:
    """Two columns of a motion that repeats in every cycle, shape (N, 2)."""
    angle = 2.0 * np.pi * (np.arange(N) / CYCLE + phase)
    return np.column_stack((np.sin(angle), np.cos(angle)))


def repeated(memory: float, misfit: float) -> tuple[Array, Array, Array]:
    """Fits (r, 2) of windows that begin at any phase, and their errors of both kinds (r, 2)."""
    fits, repeatabilities, discrepancies = [], [], []
    rng = np.random.default_rng(9)
    for seed in range(300):
        phase = rng.random()
        columns = design(phase)
        third = np.sin(6.0 * np.pi * (np.arange(N) / CYCLE + phase))
        measured = columns @ [100.0, 10.0] + misfit * third + noise(memory, seed)
        fit = np.linalg.lstsq(columns, measured, rcond=None)[0]
        errors = error_covariances(columns, columns @ fit - measured, CYCLE)
        fits.append(fit)
        repeatabilities.append(np.diag(errors.repeatability))
        discrepancies.append(np.diag(errors.discrepancy))
    return np.array(fits), np.array(repeatabilities), np.array(discrepancies)


@pytest.mark.parametrize("memory", [0.0, 0.8, 0.95])
@pytest.mark.parametrize("misfit", [0.0, 20.0])
def test_the_repeatability_is_the_scatter_from_window_to_window(
    memory: float, misfit: float
) -> None:
    fits, repeatabilities, _ = repeated(memory, misfit)
    ratios = np.sqrt(repeatabilities.mean(axis=0)) / fits.std(axis=0)
    assert np.all((ratios > SCATTER[0]) & (ratios < SCATTER[1]))


def test_a_misfit_is_a_discrepancy_and_noise_is_none() -> None:
    _, repeatabilities, by_misfit = repeated(0.0, 20.0)
    assert np.all(by_misfit.mean(axis=0) > 4.0 * repeatabilities.mean(axis=0))
    _, _, by_noise = repeated(0.8, 0.0)
    assert np.median(by_noise) == 0.0


@pytest.mark.parametrize("memory", [0.0, 0.5, 0.8, 0.95])
def test_the_integrated_time_is_that_of_the_noise(memory: float) -> None:
    times = [NoiseModel.of(noise(memory, seed)).integrated_time for seed in range(40)]
    assert np.mean(times) == pytest.approx((1.0 + memory) / (1.0 - memory), rel=0.15)


@pytest.mark.parametrize("widening", [0.5, 1.0, 3.0])
def test_an_irregular_scale_is_as_uncertain_as_it_scatters(widening: float) -> None:
    seen: tuple[WindowScale, ...] = ()
    rng, found = np.random.default_rng(1), []
    for k in range(60):
        scale = ForceScale(1.0 + widening * 0.01 * rng.standard_normal(), 0.01, 0.1)
        scale, seen = widened(scale, seen, k * 10, k * 10 + 9)
        found.append(scale)
    assert all(scale.standard_error == 0.1 for scale in found[:5])  # not known yet: the misfit
    # The same of fewer runs.
    low, high = (bound * 0.01 * max(widening, 1.0) for bound in (0.6, 1.6))
    assert low < np.median([scale.standard_error for scale in found[20:]]) < high


def test_the_published_errors_of_a_damper_of_another_law_are_its_scatter() -> None:
    motion = following.random_motion(50.0, seed=1)
    scales, errors, _ = following.published_scales(motion, following.bouc_wen(1.5e-4), windows=24)
    assert 0.3 < following.chi_square(scales, errors) < 3.0
