"""Profile likelihoods: correct intervals, and none for undetermined parameters."""

import math

import known
import numpy as np
import pytest
from known import SIGMOID
from scipy.signal import lfilter

from mr_damper_ros.estimation.covariance import least_squares_covariance
from mr_damper_ros.estimation.observability import parameter_ranges
from mr_damper_ros.estimation.profile_likelihood import ProfileLikelihood
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.misfit import Misfit
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.signals.arrays import Array

MEMORY = 0.9
"""Lag-1 autocorrelation of the residual."""

ALL = np.ones(16, dtype=bool)


def windows(
    currents: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5), memory: float = 0.0
) -> list[Window]:
    made = []
    points = [(a, f, i) for a in (2.5e-3, 10e-3) for f in (1.0, 3.0) for i in currents]
    for seed, (a, f, i) in enumerate(points):
        run = known.run(amplitude=a, frequency=f, current=i, samples=400, period=2.5e-3, seed=seed)
        noise = lfilter([math.sqrt(1.0 - memory**2)], [1.0, -memory], run.force - run.clean)
        made.append(Window.from_samples(run.displacement, run.clean + noise, i, run.period))
    return made


def pooled(chosen: list[Window]) -> Misfit:
    return Misfit(SIGMOID, chosen, [known.NOISE] * len(chosen))


def fitted(misfit: Misfit) -> Array:
    """Gauss-Newton fit of all sixteen parameters, started at the truth."""
    values = known.PLAUSIBLE.copy()
    for _ in range(5):
        jacobian = misfit.jacobian(values)
        sizes = np.linalg.norm(jacobian, axis=0)
        step = np.linalg.lstsq(jacobian / sizes, misfit.residual(values), rcond=None)[0]
        values = values - step / sizes
    return np.asarray(values)


@pytest.fixture(scope="module", params=[0.0, MEMORY], ids=["white", "correlated"])
def fit(request: pytest.FixtureRequest) -> tuple[Misfit, Array]:
    misfit = pooled(windows(memory=request.param))
    return misfit, fitted(misfit)


@pytest.mark.parametrize("name", ["f0", "k5", "k0", "a2"])
def test_the_interval_is_that_of_the_covariance_where_the_law_is_nearly_linear(
    fit: tuple[Misfit, Array], name: str
) -> None:
    misfit, values = fit
    covariance = least_squares_covariance(misfit.jacobian(values), misfit.residual(values))
    place = known.index(name)
    half = 1.96 * math.sqrt(covariance[place, place])
    low, high = (
        ProfileLikelihood(misfit, values, ALL, parameter_ranges(SIGMOID, misfit.windows))
        .of(name)
        .interval
    )
    # Relative difference between the intervals of the likelihood ratio and the standard errors.
    assert (high - low) / (2.0 * half) == pytest.approx(1.0, abs=0.03)
    # Of half the interval: offset of its middle from the estimate of a nonlinear law.
    assert 0.5 * (low + high) == pytest.approx(values[place], abs=0.1 * half)


def test_where_one_current_was_seen_nothing_bounds_the_laws_over_current() -> None:
    misfit = pooled(windows((1.0,)))
    open_names = ("k2", "a2", "I0", "k3", "a3", "I1")
    seen = np.array([name not in open_names for name in PARAMETER_NAMES])
    likelihood = ProfileLikelihood(
        misfit, known.PLAUSIBLE, seen, parameter_ranges(SIGMOID, misfit.windows)
    )
    for name in ("a2", "I0", "I1"):
        assert likelihood.of(name).interval == (-math.inf, math.inf), name
