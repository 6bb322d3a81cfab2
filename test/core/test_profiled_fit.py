"""A fit that its own profile contradicts starts again from the lower minimum."""

from __future__ import annotations

from dataclasses import replace

import known
import numpy as np
import pytest
from known import SIGMOID

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.estimation.profile_likelihood import profiled, profiles_of
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.processes.process_pool import ProcessPool

QUICK = EvolutionSettings(generations=20, population=6)


@pytest.fixture(scope="module")
def windows() -> list[Window]:
    return [
        known.run(amplitude=a, frequency=2.0, seed=seed, samples=250, period=4e-3).window
        for seed, a in enumerate((2.5e-3, 10e-3))
    ]


@pytest.fixture(scope="module")
def good(windows: list[Window]) -> GlobalFit:
    return identify_global(SIGMOID, windows, LITERATURE, QUICK)


def off(fit: GlobalFit) -> GlobalFit:
    """The fit as if it had ended beside its minimum."""
    values = fit.parameter_set.values.copy()
    values[known.index("a0")] *= 1.2
    return replace(fit, parameter_set=replace(fit.parameter_set, values=values))


def test_a_fit_at_its_minimum_stays(windows: list[Window], good: GlobalFit) -> None:
    with ProcessPool() as processes:
        fit, (profile,) = profiled(good, windows, ["a0"], QUICK, processes)
    assert fit is good
    assert profile.contains(good.parameter_set.as_dict()["a0"])


def test_a_profile_that_finds_a_lower_minimum_starts_the_fit_again(
    windows: list[Window], good: GlobalFit
) -> None:
    with ProcessPool() as processes:
        (before,) = profiles_of(off(good), windows, ["a0"], processes)
        fit, (profile,) = profiled(off(good), windows, ["a0"], QUICK, processes)
    assert not before.contains(off(good).parameter_set.as_dict()["a0"])
    # Relative difference of costs at one minimum, searched with a tolerance.
    assert fit.cost == pytest.approx(good.cost, rel=1e-3)
    assert profile.contains(fit.parameter_set.as_dict()["a0"])
    assert np.isfinite(profile.lowest).all()
