"""The fit of one window reaches the noise, finds the truth and knows its own error."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import known
import numpy as np
import pytest
from random_motion import BandLimitedRandom

from mr_damper_ros.damper.published import LITERATURE, THESIS_28_CELSIUS, THESIS_71_CELSIUS
from mr_damper_ros.damper.sigmoid import (
    COEFFICIENT_NAMES,
    SCALE_INDICES,
    Array,
    Coefficients,
    coefficient_jacobian,
    force_from_coefficients,
    operating_point_coefficients,
)
from mr_damper_ros.identification.fit import METHODS, WindowFit, fit_window
from mr_damper_ros.identification.search import LocalSearch
from mr_damper_ros.identification.window import ScaleMisfit, Window
from mr_damper_ros.kinematics.peak_velocity import peak_velocity_of_window
from mr_damper_ros.rig import thesis
from mr_damper_ros.rig.thesis import Condition

AT_THE_NOISE = 1.01
"""RMSE of a fit over that of the truth."""

SAME_MINIMUM = 1e-3
"""Two methods agree in every coefficient to this part of its standard error."""

CLEAN = [c for c in thesis.CONDITIONS if thesis.is_clean(c)]


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
        fits = {m: fit_window(run.window, LITERATURE, method=m) for m in METHODS}
        result[condition] = Case(run, fits)
    return result


def test_there_are_thirty_conditions() -> None:
    assert len(CLEAN) == 30


@pytest.mark.parametrize("condition", CLEAN, ids=lambda c: c.name)
def test_a_thesis_condition_is_fitted_down_to_the_noise(
    cases: dict[Condition, Case], condition: Condition
) -> None:
    case = cases[condition]
    fit = case.fits["nelder_mead"]
    assert fit.rmse <= AT_THE_NOISE * case.run.noise_rms
    assert fit.success, fit.message


@pytest.mark.parametrize("condition", CLEAN, ids=lambda c: c.name)
def test_both_methods_find_the_same_minimum(
    cases: dict[Condition, Case], condition: Condition
) -> None:
    simplex, gauss = (cases[condition].fits[m] for m in METHODS)
    np.testing.assert_allclose(
        (simplex.coefficients - gauss.coefficients) / standard_errors(gauss),
        0.0,
        atol=SAME_MINIMUM,
    )


def test_the_coefficients_are_recovered_within_three_standard_errors(
    cases: dict[Condition, Case],
) -> None:
    errors = np.abs([case.errors for case in cases.values()])
    assert errors.size == 210
    assert np.mean(errors <= 3.0) >= 0.99


def test_the_errors_have_the_size_that_the_fits_claim(cases: dict[Condition, Case]) -> None:
    errors = np.array([case.errors for case in cases.values()])
    # 210 squares of standard normal numbers, correlated within a fit: 1 within 0.25.
    assert np.mean(errors**2) == pytest.approx(1.0, abs=0.25)


def test_the_recordings_of_the_rig_are_fitted_down_to_the_noise_too() -> None:
    # The rig adds noise to the displacement, as a transducer does.
    condition = thesis.find("7.5mm_3Hz_1.0A")
    recording = thesis.synthesise(condition, seed=1)
    window = Window.from_samples(
        recording.displacement, recording.force, recording.current, recording.period
    )
    assert fit_window(window, LITERATURE).rmse <= AT_THE_NOISE * known.NOISE * 1.01


# -- statistics over many noise realisations -------------------------------------------------

SEEDS = 200
TRUTH = known.run(current=1.0, seed=None)


@pytest.fixture(scope="module")
def realisations() -> list[WindowFit]:
    """Fits of one condition with 200 realisations of the noise."""
    return [
        fit_window(
            known.run(current=1.0, seed=seed).window, known.PLAUSIBLE, method="least_squares"
        )
        for seed in range(SEEDS)
    ]


def cramer_rao_bound(run: known.Run) -> Array:
    """Smallest covariance (7, 7) that unbiased coefficients can have."""
    jacobian = coefficient_jacobian(Coefficients(*run.coefficients), run.velocity, run.acceleration)
    return np.asarray(known.NOISE**2 * np.linalg.inv(jacobian.T @ jacobian))


def test_the_95_percent_intervals_cover_95_percent(realisations: list[WindowFit]) -> None:
    inside = [
        np.abs(fit.coefficients - TRUTH.coefficients) <= 1.96 * standard_errors(fit)
        for fit in realisations
    ]
    assert 0.91 <= np.mean(inside) <= 0.98
    # Three standard errors of a share of 200.
    for name, share in zip(COEFFICIENT_NAMES, np.mean(inside, axis=0), strict=True):
        assert 0.90 <= share <= 0.995, name


def test_the_variance_is_at_the_cramer_rao_bound(realisations: list[WindowFit]) -> None:
    errors = np.array([fit.coefficients - TRUTH.coefficients for fit in realisations])
    ratio = np.mean(errors**2, axis=0) / np.diag(cramer_rao_bound(TRUTH))
    # A variance from 200 draws has a standard error of 10 %.
    assert np.mean(ratio) <= 1.15, dict(zip(COEFFICIENT_NAMES, ratio.round(2), strict=True))
    assert np.min(ratio) >= 0.6, "below the bound: the test itself is wrong"


def test_the_reported_covariance_is_the_bound(realisations: list[WindowFit]) -> None:
    reported = np.mean([fit.coefficient_covariance for fit in realisations], axis=0)
    bound = cramer_rao_bound(TRUTH)
    scale = np.sqrt(np.diag(bound))
    np.testing.assert_allclose(
        reported / np.outer(scale, scale), bound / np.outer(scale, scale), atol=0.1
    )


def test_the_coefficients_are_unbiased(realisations: list[WindowFit]) -> None:
    errors = np.array([fit.coefficients - TRUTH.coefficients for fit in realisations])
    bias = errors.mean(axis=0) / (errors.std(axis=0) / math.sqrt(SEEDS))
    assert np.max(np.abs(bias)) < 4.0, dict(zip(COEFFICIENT_NAMES, bias.round(1), strict=True))


# -- starts ----------------------------------------------------------------------------------

STARTS = {
    "the truth": known.PLAUSIBLE,
    "literature": LITERATURE,
    "cold": THESIS_28_CELSIUS,
    "warm, of the other basin": THESIS_71_CELSIUS,
    "mirrored": known.PLAUSIBLE * np.where(np.isin(np.arange(16), SCALE_INDICES), -1.0, 1.0),
    "ten times too strong": known.PLAUSIBLE * np.where(np.arange(16) == 0, 10.0, 1.0),
    "all zero": np.zeros(16),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS.keys())
def test_the_minimum_does_not_depend_on_the_start(start: Array, method: str) -> None:
    run = known.run(current=1.0, seed=3)
    fit = fit_window(run.window, start, method=method)
    assert np.max(np.abs((fit.coefficients - run.coefficients) / standard_errors(fit))) < 4.0


@pytest.mark.parametrize("factor", [1e-3, 1e3], ids=["millinewtons", "meganewtons"])
def test_the_fit_does_not_depend_on_the_size_of_the_damper(factor: float) -> None:
    run = known.run(current=1.0, seed=3)
    usual = fit_window(run.window, LITERATURE)
    scaled = fit_window(
        Window(run.window.motion, factor * run.force, run.window.current), LITERATURE
    )
    forces = np.isin(COEFFICIENT_NAMES, ("f_t", "f_d"))
    expected = usual.coefficients * np.where(forces, factor, 1.0)
    errors = standard_errors(usual) * np.where(forces, factor, 1.0)
    np.testing.assert_allclose((scaled.coefficients - expected) / errors, 0.0, atol=0.02)


def test_the_yield_force_is_positive() -> None:
    run = known.run(thesis.parameters(thesis.find("2.5mm_1Hz_0.5A")), current=0.5)
    fit = fit_window(run.window, STARTS["mirrored"])
    assert fit.coefficients[0] > 0.0
    assert fit.coefficients[1] > 0.0


def test_the_shape_parameters_keep_the_values_of_the_start() -> None:
    fit = fit_window(known.run(current=1.0).window, THESIS_71_CELSIUS)
    np.testing.assert_array_equal(fit.parameters[known.SHAPE], THESIS_71_CELSIUS[known.SHAPE])


def test_the_parameters_have_the_coefficients_of_the_fit() -> None:
    run = known.run(current=1.0)
    fit = fit_window(run.window, THESIS_28_CELSIUS)
    again = ScaleMisfit(run.window, fit.parameters)
    assert again.sum_of_squares(again.start) == pytest.approx(
        fit.rmse**2 * fit.sample_count, rel=1e-9
    )


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("start", [known.PLAUSIBLE, LITERATURE], ids=["from the truth", "cold"])
def test_a_force_without_noise_is_fitted_exactly_and_without_a_warning(
    start: Array, method: str
) -> None:
    run = known.run(current=1.0, seed=None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit = fit_window(run.window, start, method=method)
    np.testing.assert_allclose(fit.coefficients, run.coefficients, rtol=1e-6)


def test_a_warm_start_needs_few_evaluations() -> None:
    before = fit_window(known.run(current=1.0, seed=1).window, LITERATURE).parameters
    window = known.run(current=1.0, seed=2).window
    assert fit_window(window, before, method="least_squares").evaluations < 30
    assert fit_window(window, before, method="nelder_mead").evaluations < 600


@pytest.mark.parametrize("start", [known.PLAUSIBLE, LITERATURE], ids=["near", "far"])
def test_nelder_mead_finds_the_minimum_without_a_polish(start: Array) -> None:
    run = known.run(current=1.0, seed=5)
    near = fit_window(run.window, start, method="least_squares")
    away = near.parameters.copy()
    away[SCALE_INDICES] *= np.array([1.1, 0.9, 1.2, 0.8, 1.1, 0.9, 1.2])
    misfit = ScaleMisfit(run.window, away)
    search = LocalSearch(misfit, misfit.start)
    search.nelder_mead()
    # Within 0.1 % of the residual; the polish that follows in a fit takes the rest.
    assert math.sqrt(search.best_cost / near.sample_count) <= 1.002 * near.rmse


def test_random_motion_is_fitted_down_to_the_noise() -> None:
    motion = BandLimitedRandom(rms=4e-3, low=0.2, high=3.0, seed=2).at(np.arange(4000) * 1e-3)
    v_m = peak_velocity_of_window(motion.velocity, motion.acceleration, 1e-3)
    coefficients = operating_point_coefficients(known.PLAUSIBLE, v_m, 0.8)
    clean = force_from_coefficients(coefficients, motion.velocity, motion.acceleration)
    measured = clean + np.random.default_rng(1).normal(0.0, known.NOISE, clean.size)
    window = Window.from_samples(motion.displacement, measured, 0.8, 1e-3)
    assert window.motion.sine is None
    start = known.PLAUSIBLE.copy()
    start[SCALE_INDICES] *= 1.5
    fit = fit_window(window, start)
    assert fit.rmse <= 1.05 * known.NOISE
    np.testing.assert_allclose(
        fit.parameters[SCALE_INDICES], known.PLAUSIBLE[SCALE_INDICES], rtol=0.15, atol=0.02
    )


# -- outliers --------------------------------------------------------------------------------


def with_outliers(seed: int) -> known.Run:
    """A run in which every twentieth sample is far off to one side."""
    run = known.run(current=1.0, seed=seed)
    rng = np.random.default_rng(1000 + seed)
    hit = rng.random(run.force.size) < 0.05
    measured = run.force + np.where(hit, rng.uniform(200.0, 600.0, hit.size), 0.0)
    return known.Run(**{**vars(run), "force": measured})


def test_outliers_spoil_the_plain_fit() -> None:
    run = with_outliers(0)
    fit = fit_window(run.window, LITERATURE)
    bound = np.sqrt(np.diag(cramer_rao_bound(run)))
    assert np.max(np.abs(fit.coefficients - run.coefficients) / bound) > 20.0


def test_outliers_hardly_touch_the_robust_fit() -> None:
    errors = []
    for seed in range(10):
        run = with_outliers(seed)
        fit = fit_window(run.window, LITERATURE, robust=True)
        errors.append(
            (fit.coefficients - run.coefficients) / np.sqrt(np.diag(cramer_rao_bound(run)))
        )
    # One-sided outliers leave Huber's estimate a bias of a few bounds in the offset.
    assert np.median(np.abs(errors)) < 2.0
    assert np.max(np.abs(errors)) < 10.0


def test_without_outliers_the_robust_fit_is_nearly_as_good() -> None:
    variances = np.zeros(7)
    for seed in range(40):
        run = known.run(current=1.0, seed=seed)
        fit = fit_window(run.window, known.PLAUSIBLE, method="least_squares", robust=True)
        variances += (fit.coefficients - run.coefficients) ** 2 / 40.0
    ratio = variances / np.diag(cramer_rao_bound(TRUTH))
    # Huber's constant is chosen for 95 % efficiency; 40 draws are good for 22 %.
    assert np.mean(ratio) < 1.4


# -- stop and errors -------------------------------------------------------------------------


def test_a_stop_returns_the_best_so_far_and_says_so() -> None:
    run = known.run(current=1.0)
    asked = 0

    def after_fifty() -> bool:
        nonlocal asked
        asked += 1
        return asked > 50

    fit = fit_window(run.window, LITERATURE, should_stop=after_fifty)
    assert not fit.success
    assert "best so far" in fit.message
    assert fit.evaluations == 50
    assert fit.nrmse < 0.5, "fifty evaluations must have led somewhere"


def test_a_stop_before_the_first_evaluation_returns_the_start() -> None:
    fit = fit_window(known.run().window, LITERATURE, should_stop=lambda: True)
    assert not fit.success
    np.testing.assert_allclose(fit.parameters, LITERATURE)


def test_an_unknown_method_is_named_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match="'simplex' is unknown: use one of nelder_mead, least"):
        fit_window(known.run().window, LITERATURE, method="simplex")


def test_a_force_that_does_not_change_is_refused() -> None:
    window = known.run().window
    still = Window(window.motion, np.full(window.sample_count, 3.0), window.current)
    with pytest.raises(ValueError, match="the force does not change"):
        fit_window(still, LITERATURE)


def test_a_window_of_unequal_lengths_is_refused() -> None:
    window = known.run().window
    with pytest.raises(ValueError, match=r"force has shape \(1999,\), the motion 2000 samples"):
        Window(window.motion, window.force[1:], window.current)


@pytest.mark.parametrize("name", ["force", "current"])
def test_a_window_with_nan_is_refused(name: str) -> None:
    window = known.run().window
    arrays = {"force": window.force.copy(), "current": window.current.copy()}
    arrays[name][7] = np.nan
    with pytest.raises(ValueError, match=f"the {name} holds NaN or infinite values"):
        Window(window.motion, arrays["force"], arrays["current"])


def test_the_operating_point_of_a_sine_is_its_peak_velocity() -> None:
    run = known.run(current=0.7)
    assert run.window.operating_point == pytest.approx((run.top_speed, 0.7), rel=1e-6)


def test_a_part_of_a_window_keeps_its_samples_together() -> None:
    window = known.run().window
    mask = np.arange(window.sample_count) % 3 == 0
    part = window.part(mask)
    np.testing.assert_array_equal(part.force, window.force[mask])
    np.testing.assert_array_equal(part.motion.velocity, window.motion.velocity[mask])
    np.testing.assert_array_equal(part.motion.acceleration, window.motion.acceleration[mask])
    assert part.sample_count == mask.sum()
