"""Parameters that the data do not determine stay where they were, whatever the data."""

from __future__ import annotations

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
from mr_damper_ros.signals.arrays import Array

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
    # At several currents the value at which a parameter is held may rule the windows out.
    if len({POINTS[place][2] for place in places}) == 1:
        # Cost, 1 = noise, that a fit of a few hundred samples with a prior value may have.
        assert fit.cost < 1.2


def shape_of(start: Array, **values: float) -> Array:
    changed = start.copy()
    for name, value in values.items():
        changed[known.index(name)] = value
    return changed


@known.fixed(12)
@given(
    st.lists(st.integers(0, len(POINTS) - 1), min_size=1, max_size=4, unique=True),
    st.floats(-0.6, 0.2),
    st.floats(2.0, 8.0),
)
def test_prior_values_that_are_possible_are_kept(
    places: list[int], shift: float, slope: float
) -> None:
    """From a start with the shape of such a damper, nothing that is hidden moves.

    But for what rises with the current: at several currents another steepness rules its size out.
    """
    start = shape_of(known.PLAUSIBLE, I0=shift, I1=shift, a2=slope, a3=slope)
    fit = identify_global(SIGMOID, [window(place) for place in places], start, QUICK)
    several_currents = len({POINTS[place][2] for place in places}) > 1
    ruled_out = {"k2", "k3"} if several_currents else set()
    for parameter in set(hidden(fit)) - ruled_out:
        place = known.index(parameter)
        assert fit.parameter_set.values[place] == start[place], parameter


@pytest.mark.parametrize("name", STARTS)
def test_one_run_moves_no_shape(name: str) -> None:
    fit = identify_global(SIGMOID, [window(4)], STARTS[name], QUICK)
    assert set(hidden(fit)) == set(known.SHAPE_PARAMETER_NAMES)
    shape = [known.index(parameter) for parameter in known.SHAPE_PARAMETER_NAMES]
    np.testing.assert_array_equal(fit.parameter_set.values[shape], STARTS[name][shape])
