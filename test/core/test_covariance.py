"""Covariances of windows, and model errors from the differences between motions."""

import math
from functools import cache

import known
import numpy as np
import pytest

from mr_damper_ros.estimation.covariance import (
    correlation_length,
    discrepancy_between,
    least_squares_covariance,
    motion_numbers,
    prior_root,
)
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.estimation.record_levels import LevelledProblem, LevelPrior
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.signals.arrays import Array

N = 2000


def design(seed: int = 0) -> Array:
    """Three smooth columns of very different magnitude."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, N)
    columns = np.column_stack((np.ones(N), np.sin(12.0 * t), t**2 + 0.1 * rng.normal(size=N)))
    return np.asarray(columns * np.array([1.0, 1e-3, 1e4]))


def test_what_is_unknown_leaves_the_others_alone_where_the_residual_is_correlated() -> None:
    jacobian, residual = design(), known.correlated_noise(N, 0.95, 0)
    padded = np.insert(jacobian, 1, 0.0, axis=1)
    covariance = least_squares_covariance(padded, residual)
    assert np.isnan(np.diag(covariance)).tolist() == [False, True, False, False]
    rest = np.delete(np.delete(covariance, 1, axis=0), 1, axis=1)
    expected = least_squares_covariance(jacobian, residual)
    np.testing.assert_allclose(rest, expected, rtol=0.01)


def test_the_root_with_a_prior_is_that_of_the_covariance() -> None:
    jacobian = np.random.default_rng(0).normal(size=(50, 3)) * np.array([1.0, 1e-3, 1e4])
    root = prior_root(jacobian)
    expected = np.linalg.inv(np.eye(3) + jacobian.T @ jacobian)
    np.testing.assert_allclose(root @ root.T, expected, rtol=1e-6)


def test_what_rounding_hides_keeps_its_prior() -> None:
    # The data determine only the sum of the first two, far better than doubles resolve.
    jacobian = 1e25 * np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    errors = np.linalg.norm(prior_root(jacobian), axis=1)
    np.testing.assert_allclose(errors, [math.sqrt(0.5), math.sqrt(0.5), 1.0], rtol=1e-12)


@pytest.mark.parametrize("memory", [0.0, 0.8, 0.95])
def test_the_covariance_is_that_of_repeated_experiments(memory: float) -> None:
    jacobian = design()
    solve = np.linalg.pinv(jacobian)
    estimates, claimed = [], []
    for seed in range(300):
        noise = known.correlated_noise(N, memory, seed)
        estimate = solve @ noise
        estimates.append(estimate)
        claimed.append(np.diag(least_squares_covariance(jacobian, noise - jacobian @ estimate)))
    ratio = np.mean(claimed, axis=0) / np.var(estimates, axis=0)
    # Standard errors within 25 %; a variance from 300 draws is accurate to 8 %.
    assert np.all((ratio > 0.75**2) & (ratio < 1.25**2)), ratio


@pytest.mark.parametrize("memory", [0.5, 0.8, 0.95])
def test_the_length_of_a_correlation_is_found(memory: float) -> None:
    exact = 4.0 * np.log(0.05) / np.log(memory)
    lengths = [correlation_length(known.correlated_noise(N, memory, seed)) for seed in range(30)]
    assert np.median(lengths) == pytest.approx(exact, rel=0.2)


@pytest.mark.parametrize("residual", [np.zeros(N), np.ones(10)], ids=["zero", "short"])
def test_a_residual_that_says_nothing_counts_as_white(residual: Array) -> None:
    assert correlation_length(residual) == 1


# -- the differences between motions reveal the model error ----------------------------------------

SAMPLES, MOTIONS, TRIALS = 100, 20, 200

SCATTER = (0.8, 1.25)
"""Allowed ratio of standard deviations: 200 trials (5 %), estimates from twenty motions (16 %)."""

LEVELS = 0.25
"""Relative scatter of the gain from motion to motion."""


def trial(bend: float, seed: int) -> tuple[Array, Array, Array, Array]:
    """Jacobian (n, 2), residual (n,), motions (n,), and the fit (2,) whose truth is (3, 1)."""
    rng = np.random.default_rng(seed)
    columns, measured = [], []
    for _ in range(MOTIONS):
        angle = np.linspace(0.0, 2.0 * np.pi, SAMPLES) * rng.uniform(1.0, 3.0)
        own = np.column_stack((np.sin(angle), np.cos(angle) ** 2))
        truth = np.array([3.0, 1.0]) + bend * rng.standard_normal(2)
        columns.append(own)
        measured.append(own @ truth + 0.1 * rng.standard_normal(SAMPLES))
    jacobian, force = np.concatenate(columns), np.concatenate(measured)
    fit = np.linalg.lstsq(jacobian, force, rcond=None)[0]
    return jacobian, jacobian @ fit - force, np.repeat(np.arange(MOTIONS), SAMPLES), fit


def test_the_error_covers_what_other_motions_would_say() -> None:
    fits, claimed = [], []
    for seed in range(TRIALS):
        jacobian, residual, motions, fit = trial(LEVELS, seed)
        noise = least_squares_covariance(jacobian, residual)
        found = discrepancy_between(jacobian, residual, motions, noise)
        fits.append(fit)
        claimed.append(np.diag(noise + found))
    ratio = np.sqrt(np.mean(claimed, axis=0)) / np.std(fits, axis=0)
    assert np.all((ratio > SCATTER[0]) & (ratio < SCATTER[1]))


def test_noise_alone_is_no_discrepancy() -> None:
    seen = 0
    for seed in range(TRIALS):
        jacobian, residual, motions, _ = trial(0.0, seed)
        noise = least_squares_covariance(jacobian, residual)
        seen += bool(np.any(discrepancy_between(jacobian, residual, motions, noise) != 0.0))
    # Share of trials that may show a discrepancy where there is none: four-sigma errors are rare.
    assert seen <= 0.05 * TRIALS


def test_what_one_motion_alone_determines_is_unknown_and_leaves_the_others_alone() -> None:
    jacobian, residual, motions, _ = trial(LEVELS, 1)
    alone = np.where(motions == 0, jacobian[:, 0], 0.0)
    wider = np.column_stack((jacobian, alone * np.linspace(0.0, 1.0, alone.size)))
    found = discrepancy_between(wider, residual, motions, np.eye(3) * 1e-6)
    assert np.isnan(np.diag(found)).tolist() == [False, False, True]


def sine(
    amplitude: float, strength: float = 1.0, samples: int = 500, start: float = 0.0, hz: float = 2.0
) -> Window:
    """A steady run of the known damper at 2 Hz and 1 A, with its force times ``strength``."""
    run = known.run(amplitude=amplitude, frequency=hz, samples=samples, start=start, period=2e-3)
    return Window.from_samples(run.displacement, strength * run.force, run.current, run.period)


def test_windows_of_one_motion_count_once() -> None:
    windows = [sine(5e-3), sine(5e-3, start=0.1), sine(8e-3), sine(5e-3)]
    assert motion_numbers(windows).tolist() == [0, 0, 1, 0]


@cache
def fitted(spread: float, trend: float = 0.0) -> GlobalFit:
    """Bingham's law, fitted to eight motions whose gains scatter by ``spread``.

    With a ``trend``, they have frequencies of 0.5 to 2 Hz, and gains proportional to this power.
    """
    rng = np.random.default_rng(3)
    hertz = np.geomspace(0.5 if trend else 2.0, 2.0, 8)
    windows = [
        sine(amplitude, strength=(1.0 + spread * rng.standard_normal()) * hz**trend, hz=hz)
        for amplitude, hz in zip(rng.permutation(np.geomspace(2e-3, 12e-3, 8)), hertz, strict=True)
    ]
    law = MODELS["bingham"]
    start = law.initial_values()[0]
    return identify_global(law, windows, start, EvolutionSettings(generations=20, population=8))


def test_a_set_tells_of_motions_that_disagree_and_of_none_that_agree() -> None:
    place = MODELS["bingham"].parameter_names.index("f_y")
    found = [
        math.sqrt(fit.discrepancy[place, place]) / abs(fit.parameter_set.values[place])
        for fit in (fitted(0.0), fitted(LEVELS))
    ]
    assert found[1] > LEVELS / math.sqrt(8) / 2.0 > found[0]


def test_a_coefficient_in_another_motion_is_known_to_what_the_law_does_not_follow() -> None:
    found = []
    for fit in (fitted(0.0), fitted(LEVELS)):
        values, errors, _ = fit.coefficients((0.1, 1.0))
        found.append(float(errors[0] / abs(values[0])))
    assert found[1] > LEVELS / 2.0 > found[0]


def test_a_coefficient_is_known_less_at_a_frequency_far_from_all_others() -> None:
    fit = fitted(0.0, trend=0.6)
    (_, near, _), (_, far, _) = (fit.coefficients((0.1, 1.0), hz) for hz in (1.0, 16.0))
    assert far[0] > 2.0 * near[0]


def test_so_is_the_force() -> None:
    window = sine(5e-3)
    found = [
        float(np.sqrt(np.mean(fitted(spread).force_error(window) ** 2)) / np.std(window.force))
        for spread in (0.0, LEVELS)
    ]
    assert found[1] > LEVELS > found[0]


def test_a_record_with_a_level_of_its_own_keeps_its_rows() -> None:
    windows = [sine(4e-3), sine(5e-3, samples=300), sine(6e-3)]
    pooled = Misfit(known.SIGMOID, windows, [5.0, 5.0, 5.0])
    levelled = LevelledProblem(pooled, LevelPrior((0, 1, 1), 0.1))
    rows = levelled.row_windows
    assert rows.size == levelled.residual(known.PLAUSIBLE).size
    assert np.bincount(rows).tolist() == [502, 300, 502]
