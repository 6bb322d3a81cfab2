"""Undetermined parameters keep their initial values, whatever the data."""

from functools import cache
from itertools import product

import known
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known import SIGMOID

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.published import LITERATURE, THESIS_28_CELSIUS, THESIS_71_CELSIUS
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES

QUICK = EvolutionSettings(generations=40, population=8)
POINTS = tuple(product((2.5e-3, 5e-3, 10e-3), (1.0, 3.0), (0.0, 0.25, 0.5, 0.75, 1.0, 1.5)))
STARTS = {"literature": LITERATURE, "28 °C": THESIS_28_CELSIUS, "71 °C": THESIS_71_CELSIUS}


@cache
def window(place: int) -> Window:
    amplitude, frequency, current = POINTS[place]
    return known.run(
        amplitude=amplitude,
        frequency=frequency,
        current=current,
        seed=place,
        samples=300,
        period=3e-3,
    ).window


def hidden(fit: GlobalFit) -> list[str]:
    seen = fit.parameter_set.observable
    return [name for name, known_ in zip(PARAMETER_NAMES, seen, strict=True) if not known_]


@known.fixed(12)
@given(
    st.lists(st.integers(0, len(POINTS) - 1), min_size=1, max_size=5, unique=True),
    st.sampled_from(sorted(STARTS)),
)
def test_what_is_not_observable_is_where_the_start_or_the_neutral_shape_has_it(
    places: list[int], name: str
) -> None:
    windows, start = [window(place) for place in places], STARTS[name]
    fit = identify_global(SIGMOID, windows, start, QUICK)
    neutral = SIGMOID.without_dependence(start, max(POINTS[place][2] for place in places))
    for parameter in hidden(fit):
        value = fit.parameter_set.values[known.index(parameter)]
        assert value in (start[known.index(parameter)], neutral[known.index(parameter)]), parameter
    # At several currents the value of a fixed parameter may contradict the windows.
    if len({POINTS[place][2] for place in places}) == 1:
        # Cost, 1 = noise, of a fit with fixed parameters to a few hundred samples.
        assert fit.cost < 1.2


@pytest.mark.parametrize("name", STARTS)
def test_one_run_moves_no_shape(name: str) -> None:
    fit = identify_global(SIGMOID, [window(4)], STARTS[name], QUICK)
    assert set(hidden(fit)) == set(known.SHAPE_PARAMETER_NAMES)
    shape = [known.index(parameter) for parameter in known.SHAPE_PARAMETER_NAMES]
    np.testing.assert_array_equal(fit.parameter_set.values[shape], STARTS[name][shape])
