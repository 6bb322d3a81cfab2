"""The force scale against the baseline, and the two kinds of errors of a fit."""

import dataclasses
import math

import known
import numpy as np
import pytest
from known import SIGMOID

from benchmarks import following
from mr_damper_ros.estimation.covariance import CyclePhases, NoiseModel, error_covariances
from mr_damper_ros.estimation.window_fit import WindowFit, fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking import force_scale as tracking
from mr_damper_ros.tracking.force_scale import ForceScale, WindowScale, force_scale, widened
from mr_damper_ros.tracking.operating_point import KnownPoints

WEAKER = known.weaker(0.9)

NOISELESS = 1e-12
"""Relative: rounding in a fit to a force without noise."""


def fit_of(run: known.Run) -> WindowFit:
    return fit_window(SIGMOID, run.window, known.PLAUSIBLE, method="least_squares")


def scale_of(known_points: KnownPoints, run: known.Run) -> ForceScale:
    return force_scale(SIGMOID, run.window, fit_of(run), known_points.baselines)


def scale_between(before: known.Run, after: known.Run) -> tuple[float, float]:
    known_points = KnownPoints()
    known_points = known_points.with_baseline(fit_of(before))
    scale = scale_of(known_points, after)
    return scale.value, scale.standard_error


def test_a_weaker_damper_has_a_smaller_scale() -> None:
    value, _ = scale_between(known.run(seed=None), known.run(WEAKER, seed=None))
    assert value == pytest.approx(0.9, rel=NOISELESS)


def test_the_standard_error_is_the_scatter() -> None:
    baseline = known.run(seed=None)
    scales = [scale_between(baseline, known.run(seed=seed)) for seed in range(60)]
    values, errors = np.array(scales).T
    # Relative: a standard deviation from 60 draws is accurate to 9 %.
    assert np.std(values) / np.mean(errors) == pytest.approx(1.0, rel=0.2)


def test_without_a_baseline_there_is_no_scale() -> None:
    scale = scale_of(KnownPoints(), known.run())
    assert math.isnan(scale.value)
    assert math.isnan(scale.standard_error)


@pytest.mark.parametrize(
    "elsewhere", [{"current": 1.2}, {"amplitude": 7.5e-3}, {"frequency": 2.0}], ids=str
)
def test_another_operating_point_has_another_baseline(elsewhere: dict[str, float]) -> None:
    known_points = KnownPoints()
    known_points = known_points.with_baseline(fit_of(known.run()))
    assert math.isnan(scale_of(known_points, known.run(**elsewhere)).value)


EDGE = 0.001
"""Relative change of the amplitude or current, smaller than a test machine can control."""

ACROSS_THE_EDGE = 2.5 * EDGE
"""Relative: the two runs differ by two such changes, and their forces by no more."""


@pytest.mark.parametrize("what", ["peak velocity", "current"])
def test_an_operating_point_at_the_edge_of_a_cell_has_one_baseline(what: str) -> None:
    speed, current = 1.1**-33.5, 0.5
    if what == "current":
        speed, current = 1.1**-33.0, 0.525
    known_points = KnownPoints()
    for factor, parameters in ((1.0 - EDGE, known.PLAUSIBLE), (1.0 + EDGE, WEAKER)):
        amplitude = speed / (2.0 * math.pi) * (factor if what == "peak velocity" else 1.0)
        i = current * (factor if what == "current" else 1.0)
        run = known.run(parameters, amplitude=amplitude, current=i, seed=None)
        scale = scale_of(known_points, run)
        known_points = known_points.with_baseline(fit_of(run))
    assert scale.value == pytest.approx(0.9, rel=ACROSS_THE_EDGE)


@pytest.mark.parametrize("factor", [-4e-4, 0.0])
def test_a_force_against_that_of_the_baseline_tells_no_scale(factor: float) -> None:
    reference = known.run(seed=None).force
    known_to = np.ones((reference.size, 1)), np.ones((1, 1))
    assert math.isnan(tracking.scale_between(reference, factor * reference, *known_to).value)


def test_a_baseline_beyond_all_measure_tells_no_scale() -> None:
    run = known.run(frequency=2.0)
    displacement = run.displacement + 2e-3 * np.sin(9.1 * np.arange(2000) * run.period)
    window = Window.from_samples(displacement, run.force, run.current, run.period)
    fit = fit_window(SIGMOID, window, known.PLAUSIBLE, method="least_squares")
    absurd = fit.parameters.copy()
    absurd[SIGMOID.strength_indices] *= 1e100
    known_points = KnownPoints()
    known_points = known_points.with_baseline(dataclasses.replace(fit, parameters=absurd))
    assert window.motion.sine is None
    assert math.isnan(force_scale(SIGMOID, window, fit, known_points.baselines).value)


# -- fit errors are of two kinds: a misfit that repeats in every cycle is not noise ----------------

N, CYCLE = 2000, 800.0
PHASES = CyclePhases.at(np.arange(N) / CYCLE)

SCATTER = (0.75, 1.3)
"""Allowed ratio of standard deviations: scatter of the runs, and 20 % error of the estimate."""


def design(phase: float) -> Array:
    """Two columns of a motion that repeats in every cycle, shape (N, 2)."""
    angle = 2.0 * np.pi * (np.arange(N) / CYCLE + phase)
    return np.column_stack((np.sin(angle), np.cos(angle)))


def repeated(memory: float, misfit: float) -> tuple[Array, Array, Array]:
    """Fits (r, 2) of windows with random phases, and their errors of both kinds (r, 2)."""
    fits, repeatabilities, discrepancies = [], [], []
    rng = np.random.default_rng(9)
    for seed in range(300):
        phase = rng.random()
        columns = design(phase)
        third = np.sin(6.0 * np.pi * (np.arange(N) / CYCLE + phase))
        measured = (
            columns @ [100.0, 10.0] + misfit * third + known.correlated_noise(N, memory, seed)
        )
        fit = np.linalg.lstsq(columns, measured, rcond=None)[0]
        errors = error_covariances(columns, columns @ fit - measured, PHASES)
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
    times = [
        NoiseModel.of(known.correlated_noise(N, memory, seed)).integrated_time for seed in range(40)
    ]
    assert np.mean(times) == pytest.approx((1.0 + memory) / (1.0 - memory), rel=0.05)


@pytest.mark.parametrize("widening", [0.5, 1.0, 3.0])
def test_an_irregular_scale_is_as_uncertain_as_it_scatters(widening: float) -> None:
    seen: tuple[WindowScale, ...] = ()
    rng, found = np.random.default_rng(1), []
    for k in range(60):
        scale = ForceScale(1.0 + widening * 0.01 * rng.standard_normal(), 0.01, 0.1)
        scale, seen = widened(scale, seen, k * 10, k * 10 + 9)
        found.append(scale)
    assert all(scale.standard_error == 0.1 for scale in found[:5])  # the misfit is not known yet
    # As above, but from fewer runs.
    low, high = (bound * 0.01 * max(widening, 1.0) for bound in (0.6, 1.6))
    assert low < np.median([scale.standard_error for scale in found[20:]]) < high


def test_the_published_errors_of_a_damper_of_another_law_are_its_scatter() -> None:
    motion = following.many_tones(50.0)
    scales, errors, _ = following.published_scales(motion, 1.5e-4, windows=24)
    assert 0.3 < following.chi_square(scales, errors) < 3.0
