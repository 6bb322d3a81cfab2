"""The fit of one window reaches the noise, finds the truth and estimates its error correctly."""

import math
import warnings
from dataclasses import dataclass

import known
import numpy as np
import pytest
from known import SIGMOID

from mr_damper_ros.estimation.window_fit import WINDOW_METHODS, WindowFit, fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import published as thesis
from mr_damper_ros.models.published import (
    LITERATURE,
    THESIS_28_CELSIUS,
    THESIS_71_CELSIUS,
    Condition,
)
from mr_damper_ros.models.sigmoid.law import COEFFICIENT_NAMES, SCALE_INDICES
from mr_damper_ros.signals.arrays import Array
from studies.thesis.facts import is_clean

STANDARD_ERRORS = 4.0
"""Largest error of an estimate in standard errors; chance exceeds it once in 16 000."""

CLEAN = [c for c in thesis.CONDITIONS if is_clean(c)]


@dataclass(frozen=True, eq=False)
class Case:
    """One re-synthesised condition with its fits by both methods."""

    run: known.Run
    fits: dict[str, WindowFit]

    @property
    def errors(self) -> Array:
        """Errors (7,) of the coefficients in standard errors."""
        fit = self.fits["nelder_mead"]
        return (fit.coefficients - self.run.coefficients) / standard_errors(fit)


def standard_errors(fit: WindowFit) -> Array:
    return np.sqrt(np.diag(fit.coefficient_covariance))


@pytest.fixture(scope="module")
def cases() -> dict[Condition, Case]:
    """The thirty clean conditions, searched from the literature's set."""
    result = {}
    for seed, condition in enumerate(CLEAN):
        run = known.run(
            thesis.parameters(condition),
            amplitude=condition.amplitude,
            frequency=condition.frequency,
            current=condition.current,
            seed=seed,
            samples=known.THESIS_SAMPLES,
        )
        fits = {m: fit_window(SIGMOID, run.window, LITERATURE, method=m) for m in WINDOW_METHODS}
        result[condition] = Case(run, fits)
    return result


@pytest.mark.parametrize("condition", CLEAN, ids=lambda c: c.name)
def test_a_thesis_condition_is_fitted_down_to_the_noise(
    cases: dict[Condition, Case], condition: Condition
) -> None:
    case = cases[condition]
    fit = case.fits["nelder_mead"]
    # RMSE of the fit over that of the truth: the search ends in the minimum, which is no higher.
    assert fit.rmse <= 1.0001 * case.run.noise_rms
    assert fit.success, fit.message
    simplex, gauss = (cases[condition].fits[m] for m in WINDOW_METHODS)
    # In standard errors: both searches end in one minimum, to a tenth of this.
    np.testing.assert_allclose(
        (simplex.coefficients - gauss.coefficients) / standard_errors(gauss), 0.0, atol=3e-4
    )


# -- statistics over many noise realisations -------------------------------------------------

SEEDS = 200
TRUTH = known.run(current=1.0, seed=None)


@pytest.fixture(scope="module")
def realisations() -> list[WindowFit]:
    """Fits of one condition with 200 realisations of the noise."""
    return [
        fit_window(
            SIGMOID,
            known.run(current=1.0, seed=seed).window,
            known.PLAUSIBLE,
            method="least_squares",
        )
        for seed in range(SEEDS)
    ]


def cramer_rao_bound(run: known.Run) -> Array:
    """Smallest covariance (7, 7) of unbiased coefficients."""
    moved, current = (run.displacement, run.velocity, run.acceleration), run.current
    derivatives = known.parameter_jacobian(run.parameters, *moved, np.full(run.force.size, current))
    by_parameters = SIGMOID.coefficient_gradient(run.parameters, run.top_speed, current)
    jacobian = derivatives[:, SCALE_INDICES] @ np.linalg.inv(by_parameters[:, SCALE_INDICES])
    return np.asarray(known.NOISE**2 * np.linalg.inv(jacobian.T @ jacobian))


def within_95_percent(fits: list[WindowFit]) -> Array:
    """Whether the interval of each fit and coefficient contains the truth, shape (fits, 7)."""
    return np.array(
        [
            np.abs(fit.coefficients - TRUTH.coefficients) <= 1.96 * standard_errors(fit)
            for fit in fits
        ]
    )


def test_many_fits_are_unbiased_and_as_certain_as_they_say(realisations: list[WindowFit]) -> None:
    # Share from 200 fits with correlated coefficients: its standard error is 0.6 to 1.5 %.
    assert np.mean(within_95_percent(realisations)) == pytest.approx(0.95, abs=0.03)
    shares = np.mean(within_95_percent(realisations), axis=0)
    for name, share in zip(COEFFICIENT_NAMES, shares, strict=True):
        # Three standard errors of a share of 200.
        assert share == pytest.approx(0.95, abs=0.046), name
    errors = np.array([fit.coefficients - TRUTH.coefficients for fit in realisations])
    bound = cramer_rao_bound(TRUTH)
    ratio = np.mean(errors**2, axis=0) / np.diag(bound)
    # Mean variance over the bound; a variance from 200 draws has a standard error of 0.1.
    assert np.mean(ratio) <= 1.15, dict(zip(COEFFICIENT_NAMES, ratio.round(2), strict=True))
    # Smallest variance over the bound: four standard errors; a lower value is a fault of the test.
    assert np.min(ratio) >= 0.6, "below the bound: the test itself is wrong"
    reported = np.mean([fit.coefficient_covariance for fit in realisations], axis=0)
    scale = np.sqrt(np.outer(np.diag(bound), np.diag(bound)))
    # Relative to the bound: the mean of 200 measured noise variances is accurate to 0.2 %.
    np.testing.assert_allclose(reported / scale, bound / scale, atol=0.02)
    bias = errors.mean(axis=0) / (errors.std(axis=0) / math.sqrt(SEEDS))
    assert np.max(np.abs(bias)) < STANDARD_ERRORS, bias.round(1)


# -- starts ----------------------------------------------------------------------------------

STARTS = {
    "the truth": known.PLAUSIBLE,
    "literature": LITERATURE,
    "cold": THESIS_28_CELSIUS,
    "warm, of the other basin": THESIS_71_CELSIUS,
    "mirrored": known.PLAUSIBLE * np.where(np.isin(np.arange(16), SCALE_INDICES), -1.0, 1.0),
    "ten times too strong": known.weaker(10.0),
    "all zero": np.zeros(16),
}


@pytest.mark.parametrize("method", WINDOW_METHODS)
@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS.keys())
def test_the_minimum_does_not_depend_on_the_start(start: Array, method: str) -> None:
    run = known.run(current=1.0, seed=3)
    fit = fit_window(SIGMOID, run.window, start, method=method)
    errors = (fit.coefficients - run.coefficients) / standard_errors(fit)
    assert np.max(np.abs(errors)) < STANDARD_ERRORS


@pytest.mark.parametrize("method", WINDOW_METHODS)
@pytest.mark.parametrize("start", [known.PLAUSIBLE, LITERATURE], ids=["from the truth", "cold"])
def test_a_force_without_noise_is_fitted_exactly_and_without_a_warning(
    start: Array, method: str
) -> None:
    run = known.run(current=1.0, seed=None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = fit_window(SIGMOID, run.window, start, method=method)
    # Relative: without noise the search converges quadratically, to rounding.
    np.testing.assert_allclose(fit.coefficients, run.coefficients, rtol=1e-11)


# -- stop and errors -------------------------------------------------------------------------


def test_a_stop_returns_the_best_so_far_and_says_so() -> None:
    run = known.run(current=1.0)
    asked = 0

    def after_fifty() -> bool:
        nonlocal asked
        asked += 1
        return asked > 50

    fit = fit_window(SIGMOID, run.window, LITERATURE, should_stop=after_fifty)
    assert not fit.success
    assert "best result so far" in fit.message
    assert fit.evaluations == 50
    # NRMSE: 39 at the start, 1 for a constant force.
    assert fit.nrmse < 0.5, "fifty evaluations must have led somewhere"


def test_an_unknown_method_a_constant_force_and_unequal_lengths_are_refused() -> None:
    window = known.run().window
    with pytest.raises(ValueError, match="'simplex' is unknown: use one of nelder_mead, least"):
        fit_window(SIGMOID, window, LITERATURE, method="simplex")
    still = Window(window.motion, np.full(window.sample_count, 3.0), window.current)
    with pytest.raises(ValueError, match="the force does not change"):
        fit_window(SIGMOID, still, LITERATURE)
    with pytest.raises(ValueError, match=r"force has shape \(1999,\), the motion 2000 samples"):
        Window(window.motion, window.force[1:], window.current)
