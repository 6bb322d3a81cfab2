"""Plausibility of parameter sets: the same from every source; published sets pass."""

import math
from dataclasses import replace

import known
import numpy as np
import pytest

from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.models.plausibility import LARGEST_NRMSE, check_plausible
from mr_damper_ros.models.published import (
    CONDITIONS,
    PUBLISHED_METHODS,
    THESIS_28_CELSIUS,
    parameters,
)
from studies.thesis.facts import ROW_ERRATA

GOOD = ParameterSet(
    THESIS_28_CELSIUS, peak_velocity_range=(0.03, 0.1), current_range=(0.0, 1.5), nrmse=0.1
)
DRIVES = "a force that is not dissipative"
TOO_LARGE = "more than the limit of 1e\\+06 N"


def test_the_published_sets_pass_but_those_whose_rows_are_wrong() -> None:
    refused = set()
    for condition in CONDITIONS:
        for method in PUBLISHED_METHODS:
            speed = 2.0 * math.pi * condition.frequency * condition.amplitude
            published = ParameterSet(
                parameters(condition, method),
                peak_velocity_range=(speed, speed),
                current_range=(condition.current, condition.current),
            )
            try:
                check_plausible(published)
            except ParameterError:
                refused.add((condition, method))
    assert refused
    assert refused <= ROW_ERRATA.keys()


@pytest.mark.parametrize("frequency_free", [True, False])
def test_a_reversed_sign_is_refused(frequency_free: bool) -> None:
    values = THESIS_28_CELSIUS.copy()
    values[known.index("f0")] *= -1.0
    reversed_set = replace(GOOD, values=values)
    if frequency_free:
        reversed_set = replace(
            reversed_set, peak_velocity_range=(0.0, math.inf), current_range=(-math.inf, math.inf)
        )
    with pytest.raises(ParameterError, match=DRIVES):
        check_plausible(reversed_set)


def test_a_force_far_beyond_the_largest_measured_one_is_refused() -> None:
    for largest, plausible in ((1000.0, True), (100.0, False), (math.nan, True)):
        stated = replace(GOOD, largest_force=largest)
        if plausible:
            check_plausible(stated)
        else:
            with pytest.raises(ParameterError, match="more than the limit of 300 N"):
                check_plausible(stated)


@pytest.mark.parametrize("nrmse", [5.0, -0.1, math.inf, np.nextafter(LARGEST_NRMSE, 2.0)])
def test_a_set_that_owns_up_to_explaining_nothing_is_refused(nrmse: float) -> None:
    with pytest.raises(
        ParameterError, match=r"state an nrmse of .*, but it must be between 0 and 1"
    ):
        check_plausible(replace(GOOD, nrmse=nrmse))


def test_a_law_is_judged_where_it_says_that_it_holds() -> None:
    # At twice the speed of its data, the law of this set gives 1e8 N.
    condition = next(c for c in CONDITIONS if c.name == "7.5mm_1Hz_0.5A")
    values = parameters(condition)
    check_plausible(
        ParameterSet(values, peak_velocity_range=(0.04, 0.047), current_range=(0.5, 0.5))
    )
    with pytest.raises(ParameterError, match=TOO_LARGE):
        check_plausible(
            ParameterSet(values, peak_velocity_range=(0.04, 0.3), current_range=(0.5, 0.5))
        )
