"""Identification of any model from one window: truth, errors, memory, bounds, scale."""

from functools import cache

import known
import numpy as np
import pytest
from random_motion import BandLimitedRandom

from mr_damper_ros.estimation.window_fit import fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.misfit import WindowProblem
from mr_damper_ros.models.quantities import SearchEffort

LEAD_IN = 1000
NOISE = 5.0

FITTED = 1.05
"""RMSE over the noise, which 2000 samples determine to 1.6 %."""

ROUNDING = 1e-9
"""Relative, and absolute for numbers of unit size."""


@cache
def window(name: str, *, sine: bool = True, noise: float = NOISE, seed: int = 0) -> Window:
    """Two seconds of a damper of this model, after one second of motion."""
    time = np.arange(LEAD_IN + 2000) * known.PERIOD
    if sine:
        displacement = 5e-3 * np.sin(2.0 * np.pi * time + known.THESIS_PHASE)
    else:
        displacement = BandLimitedRandom(5e-3, 0.5, 3.0, seed=3).at(time).displacement
    whole = Window.from_samples(displacement, np.ones(time.size), 1.0, known.PERIOD)
    force = MODELS[name].force(known.EXAMPLES[name], whole.motion, 1.0, known.PERIOD)
    force += np.random.default_rng(seed).normal(0.0, noise, force.size)
    late = slice(LEAD_IN, None)
    before = whole.motion.peak_velocity[late]
    return Window.from_samples(displacement[late], force[late], 1.0, known.PERIOD, before)


MOTIONS = pytest.mark.parametrize("sine", [True, False], ids=["sine", "random"])


@pytest.mark.parametrize("name", MODELS)
def test_a_model_is_identified_from_its_own_force_and_its_unknowns_stand_for_its_parameters(
    name: str,
) -> None:
    model, here = MODELS[name], window(name)
    fit = fit_window(model, here, model.initial_values()[0], method="least_squares")
    # One run cannot determine the shape of a sigmoid law, and another shape fits nearly as well.
    most = 3.0 if name.startswith("sigmoid") else FITTED
    assert fit.rmse < most * NOISE
    assert fit.success
    low, high = model.bounds
    assert np.all((low <= fit.parameters) & (fit.parameters <= high))
    misfit = WindowProblem(MODELS[name], window(name), known.EXAMPLES[name])
    np.testing.assert_allclose(
        misfit.parameters(misfit.start), known.EXAMPLES[name], rtol=ROUNDING, atol=ROUNDING
    )


def test_a_search_that_ends_at_its_limit_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    model = MODELS["hyperbolic_tangent"]
    monkeypatch.setattr(type(model), "effort", SearchEffort(most_steps=2))
    start = 1.05 * known.EXAMPLES[model.name]
    fit = fit_window(model, window(model.name), start, method="least_squares")
    assert not fit.success
    assert "limit of steps" in fit.message


@MOTIONS
@pytest.mark.parametrize("name", MODELS)
def test_a_part_of_a_window_remembers_the_whole(name: str, sine: bool) -> None:
    here = window(name, sine=sine, noise=0.0)
    settled = MODELS[name].settled(here, known.EXAMPLES[name])
    part = here.part(settled & (np.arange(2000) // 50 % 4 == 3))
    error = MODELS[name].window_force(part, known.EXAMPLES[name]) - part.force
    # Relative to the spread of the force: the other time step costs 2e-3, and the missing samples
    # five times that.
    assert known.rms(error) < 5.0 * 2e-3 * np.std(here.force)


def test_samples_before_which_the_past_is_unknown_have_no_residual() -> None:
    here = window("bouc_wen", sine=False)
    misfit = WindowProblem(MODELS["bouc_wen"], here, known.EXAMPLES["bouc_wen"])
    residual = misfit.residual(misfit.start)
    unsettled = int(np.argmax(misfit.settled))
    # At most this many of 2000 samples are left out for lack of history.
    assert 0 < unsettled < 500
    assert not np.any(residual[:unsettled])
    assert known.rms(residual[unsettled:]) < FITTED * NOISE


@pytest.mark.parametrize("name", MODELS)
def test_the_jacobian_is_that_of_differences(name: str) -> None:
    misfit = WindowProblem(MODELS[name], window(name), known.EXAMPLES[name])
    start = misfit.start
    jacobian = misfit.jacobian(start)
    # Relative to the largest derivative; for zero derivatives: curvature over steps of 1e-4.
    relative, least = (0.01, 1e-6)
    for column in range(start.size):
        step = 1e-4 * (abs(start[column]) or 0.1) * np.eye(start.size)[column]
        expected = (misfit.residual(start + step) - misfit.residual(start - step)) / (
            2.0 * step[column]
        )
        np.testing.assert_allclose(
            jacobian[:, column], expected, atol=relative * np.abs(expected).max() + least
        )
