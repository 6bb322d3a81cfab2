"""Identification of the extended law: compliance, stiffness and offset besides the sixteen."""

import math
from dataclasses import replace
from functools import cache
from itertools import product

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known import EXTENDED, SIGMOID
from random_motion import BandLimitedRandom

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.motion import window_motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.first_order_lag import FirstOrderLag
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.sigmoid.following import EXTENDED_NAMES
from mr_damper_ros.models.sigmoid.law import operating_point_coefficients

LAW = MODELS["sigmoid_lag"]
TRUTH = np.append(known.PLAUSIBLE, [3e-8, 1500.0, -40.0, 0.0])
PERIOD = 1e-3
LEAD_IN = 500
"""Samples before a window, in which the true lag settles."""

STANDARD_ERRORS = 4.0
"""Largest error of an estimate in standard errors; one test in a hundred exceeds it by chance."""

BY_DIFFERENCES = 1e-4
"""Relative to the largest derivative: the curvature error of these finite differences."""

FINE = 1e-3
"""Relative to the spread of the force: the interpolation error."""


@cache
def window(
    frequency: float = 1.0, current: float = 1.0, seed: int | None = 0, samples: int = 2000
) -> Window:
    """A window of the known damper: a sine, or a random motion if the frequency is 0."""
    # A sine is known between the samples too, so the damper is simulated with a finer step.
    finer = 1 if frequency == 0.0 else 10
    time = np.arange((LEAD_IN + samples) * finer) * PERIOD / finer
    if frequency == 0.0:
        displacement = BandLimitedRandom(5e-3, 0.5, 3.0, seed=1).at(time).displacement
    else:
        displacement = 8e-3 * np.sin(2.0 * np.pi * frequency * time + 1.0)
    motion = window_motion(displacement, PERIOD / finer)
    force = LAW.force(TRUTH, motion, current, PERIOD / finer)[::finer]
    if seed is not None:
        force = force + np.random.default_rng(seed).normal(0.0, known.NOISE, force.size)
    whole = Window.from_samples(displacement[::finer], force, current, PERIOD)
    return whole.part(slice(LEAD_IN, None))


# The slow window is one cycle; less would leave some of the scales undetermined.
MOTIONS = pytest.mark.parametrize("frequency", [0.5, 3.0, 0.0], ids=["slow", "fast", "random"])


@MOTIONS
def test_a_part_sees_the_lag_of_the_whole(frequency):
    whole = window(frequency, seed=None)
    spread = np.std(whole.force)
    chunks = np.arange(whole.sample_count) // 50 % 4 == 3
    for part in (whole, whole.part(chunks), whole.part(chunks).part(slice(10, None, 7))):
        error = EXTENDED.window_force(part, TRUTH) - part.force
        assert known.rms(error) < FINE * spread
    whole = window(frequency, seed=None)
    thinned = whole.thinned(100)
    assert 100 <= thinned.sample_count < 200
    error = EXTENDED.window_force(thinned, TRUTH) - thinned.force
    # Leaving out samples may cost five times the interpolation error.
    assert known.rms(error) < 5.0 * FINE * np.std(whole.force)


def test_a_window_without_its_period_cannot_have_a_lag():
    whole = window()
    lone = Window(whole.motion, whole.force, whole.current)
    with pytest.raises(ValueError, match="the sample period of the window is unknown"):
        fit_window(EXTENDED, lone, TRUTH)


@cache
def pooled(most: int) -> Misfit:
    windows = [window(f, i, samples=600) for f in (0.0, 2.0) for i in (0.0, 1.0)]
    windows = [w.thinned(most) for w in windows]
    return Misfit(EXTENDED, windows, [known.NOISE] * 4, TRUTH)


@pytest.mark.parametrize("most", [100, 5000], ids=["thinned", "whole"])
def test_the_jacobian_of_all_twenty_is_that_of_differences(most):
    misfit = pooled(most)
    jacobian = misfit.jacobian(TRUTH)
    for column, name in enumerate(EXTENDED_NAMES):
        size = 1e-5 * (abs(TRUTH[column]) or 1.0)
        step = size * np.eye(20)[column]
        expected = (misfit.residual(TRUTH + step) - misfit.residual(TRUTH - step)) / (2 * size)
        np.testing.assert_allclose(
            jacobian[:, column],
            expected,
            atol=BY_DIFFERENCES * np.abs(expected).max(),
            err_msg=name,
        )
    np.testing.assert_array_equal(misfit.jacobian(TRUTH, [3, 16]), jacobian[:, [3, 16]])


QUICK = EvolutionSettings(generations=40, population=8)
NONE = np.zeros(4)
CURRENTS = (0.0, 0.4, 0.8, 1.2)


def runs(extension: np.ndarray, currents: tuple[float, ...]) -> list[Window]:
    """Sines of two speeds and two amplitudes at each current."""
    parameters = np.append(known.PLAUSIBLE, extension)
    windows = []
    for seed, (amplitude, frequency, current) in enumerate(
        product((3e-3, 10e-3), (1.0, 4.0), currents)
    ):
        run = known.run(
            amplitude=amplitude, frequency=frequency, current=current, samples=600, seed=seed
        )
        window = run.window
        late = EXTENDED.window_force(window, parameters) - SIGMOID.window_force(
            window, known.PLAUSIBLE
        )
        windows.append(replace(window, force=window.force + late))
    return windows


@pytest.fixture(scope="module")
def found() -> GlobalFit:
    return identify_global(EXTENDED, runs(TRUTH[16:], CURRENTS), np.append(LITERATURE, NONE), QUICK)


def test_the_extension_is_found_with_the_sixteen(found):
    got = found.parameter_set
    assert got.model == "sigmoid_lag"
    errors = (got.values - TRUTH)[16:19] / got.standard_errors[16:19]
    assert np.max(np.abs(errors)) < STANDARD_ERRORS
    # Relative: these runs determine lag and stiffness to 5 %, so that four standard errors are few.
    np.testing.assert_allclose(got.values[16:18], TRUTH[16:18], rtol=0.2)
    windows = runs(TRUTH[16:], CURRENTS)
    left = [EXTENDED.window_force(w, found.parameter_set.values) - w.force for w in windows]
    # RMSE over the noise, which 9600 samples determine to 0.7 %.
    assert known.rms(np.concatenate(left)) < 1.02 * known.NOISE
    assert found.parameter_set.observable[16:19].all()
    block = found.covariance[16:19, 16:19]
    np.testing.assert_allclose(np.sqrt(np.diag(block)), found.parameter_set.standard_errors[16:19])
    assert not found.parameter_set.observable[-1]
    assert math.isnan(found.parameter_set.standard_errors[-1])
    assert found.parameter_set.values[-1] == 0.0
    coefficients, errors, _ = found.coefficients((0.1, 0.6))
    truth = np.concatenate(operating_point_coefficients(known.PLAUSIBLE, 0.1, 0.6))
    assert np.all(errors > 0.0)
    assert np.all(np.abs(coefficients - known.positive(truth)) < STANDARD_ERRORS * errors)


def test_a_set_on_a_bound_is_the_best_one_there():
    windows = [
        known.run(amplitude=a, frequency=2.0, seed=seed, samples=500, period=2e-3).window
        for seed, a in enumerate((2e-3, 5e-3, 8e-3))
    ]
    settings = EvolutionSettings(generations=40, population=8)
    fit = identify_global(LAW, windows, LAW.initial_values()[0], settings)
    found, misfit = fit.parameter_set, Misfit(LAW, windows, fit.noise.tolist())
    assert found.as_dict()["compliance"] == 0.0
    others = misfit.jacobian(found.values, np.flatnonzero(found.observable).tolist())
    removable = np.linalg.qr(others)[0].T @ misfit.residual(found.values)
    # Part of the misfit that the other parameters could still remove.
    assert removable @ removable < 1e-5 * misfit.sample_count


@pytest.mark.parametrize("seed", [0, 1])
def test_the_richer_law_leaves_no_more_than_the_one_that_it_contains(seed):
    """Even if neither law follows the force, the extended fit is the closer one."""
    run = known.run(seed=seed, samples=500, period=4e-3)
    time = np.arange(run.force.size) * run.period
    force = run.force + 60.0 * np.sin(2.0 * np.pi * 5.0 * time + seed)
    window = Window.from_samples(run.displacement, force, run.current, run.period)
    plain = identify_global(SIGMOID, [window], LITERATURE, QUICK)
    start = EXTENDED.initial_values()[0]
    rich = identify_global(EXTENDED, [window], start, QUICK)
    # Relative: rounding of two equal NRMSE.
    assert rich.nrmse[0] <= plain.nrmse[0] * (1.0 + 1e-6)


# -- the compliance, the stiffness and the offset that extend the sigmoid law ----------------------

COUNT = 400

ROUNDING = 1e-9
"""Relative to a signal of unit size."""

LARGEST = 1e3
"""Largest constant that is filtered; rounding grows in proportion."""

CHANGING = 5e-3 + 4e-3 * np.abs(np.sin(np.arange(COUNT) / 50.0))


def signal(columns: int = 1) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(COUNT, columns)).squeeze()


def constant(tau: float) -> np.ndarray:
    return np.full(COUNT, tau)


def recursion(values: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """The lag as defined, step by step."""
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
    # At the boundary of two periods both have the same mean of two time constants.
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
