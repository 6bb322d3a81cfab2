"""Laws with memory are judged on records that begin in the middle of a motion."""

from dataclasses import replace

import known
import numpy as np
import pytest
from random_motion import BandLimitedRandom

import mr_damper_ros as mr
from mr_damper_ros.api.comparison import comparison_figure
from mr_damper_ros.estimation.global_fit import error_of_set
from mr_damper_ros.estimation.law_choice import cross_validate
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet

LAWS = [name for name, model in MODELS.items() if model.remembers]

PERIOD, BEGIN, COUNT = 2e-3, 1500, 500
"""Sample period [s], and the part of the motion that is recorded."""

ALLOWED = 1.15
"""RMSE relative to the noise: three standard errors of 500 samples, and the rest of the past."""


def recorded(name: str, seed: int = 0, begin: int = BEGIN, count: int = COUNT) -> Window:
    """A record of a damper that began to move long before."""
    time = PERIOD * np.arange(begin + count)
    u = BandLimitedRandom(4e-3, 0.3, 3.0, seed=seed).at(time).displacement
    whole = Window.from_samples(u, np.zeros(u.size), 1.0, PERIOD)
    clean = MODELS[name].window_force(whole, known.EXAMPLES[name])
    noise = np.random.default_rng(seed).normal(0.0, known.NOISE, u.size)
    part = slice(begin, None)
    # The window does not know the motion before it.
    return Window(whole.motion.part(part), (clean + noise)[part], whole.current[part], PERIOD)


def true_set(name: str) -> ParameterSet:
    return ParameterSet(known.EXAMPLES[name], model=name)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", LAWS)
def test_the_true_set_is_judged_by_its_noise_alone(name: str, seed: int) -> None:
    window = recorded(name, seed)
    assert error_of_set(true_set(name), [window]).rmse < ALLOWED * known.NOISE


@pytest.mark.parametrize("name", LAWS)
def test_validation_does_not_count_the_unknown_past(name: str) -> None:
    window = recorded(name)
    found = mr.validate(
        true_set(name),
        displacement=window.motion.displacement,
        force=window.force,
        current=1.0,
        period=PERIOD,
    )
    compared = found.runs[0].comparison
    unknown = np.isnan(compared.predicted)
    assert unknown.any()
    # The unknown samples come first, and are at most a quarter.
    assert unknown[: np.count_nonzero(unknown)].all()
    assert found.error.count == COUNT - np.count_nonzero(unknown) >= 0.75 * COUNT
    assert np.isfinite(found.nrmse)
    assert comparison_figure(compared).axes


def test_a_law_without_memory_is_validated_at_every_sample() -> None:
    window = recorded("hyperbolic_tangent")
    assert error_of_set(true_set("hyperbolic_tangent"), [window]).count == COUNT


@pytest.mark.parametrize("foreign", ["series_springs", "modified_bouc_wen"])
def test_another_law_is_judged_as_with_a_known_past(foreign: str) -> None:
    window = recorded(foreign, count=2 * COUNT)
    name = "bouc_wen"
    found = mr.identify(
        displacement=window.motion.displacement,
        force=window.force,
        current=1.0,
        period=PERIOD,
        model=name,
        method="least_squares",
    ).parameter_set
    whole = recorded(foreign, begin=0, count=BEGIN + COUNT)
    error = found.window_force(whole) - whole.force
    with_past = known.rms(error[BEGIN:]) / float(np.std(whole.force[BEGIN:]))
    part = slice(BEGIN, None)
    cut = Window(whole.motion.part(part), whole.force[part], whole.current[part], PERIOD)
    # Relative: the samples that are left out have another error.
    assert error_of_set(found, [cut]).nrmse == pytest.approx(with_past, rel=0.1)


def test_laws_are_compared_without_the_unknown_past() -> None:
    name = "bouc_wen"
    runs = [[replace(recorded(name, seed), whole=None)] for seed in range(5)]
    choice = cross_validate(runs, (name,))
    noise = known.NOISE / np.mean([np.std(run[0].force) for run in runs])
    # The fit to few samples of the other motions adds to the noise.
    assert choice.best.nrmse < 1.5 * noise
