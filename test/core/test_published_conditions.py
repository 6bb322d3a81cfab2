"""The thesis' table of parameter sets: its conditions, and the rows that must not be used."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.models.published import (
    CONDITIONS,
    ERRATA,
    PUBLISHED_METHODS,
    ROW_ERRATA,
    Condition,
    ConditionError,
    find,
    is_clean,
    parameters,
)
from mr_damper_ros.models.sigmoid.law import sine_force


def steady_force(condition: Condition, method: str) -> np.ndarray:
    time = np.arange(1000) / 1000.0 / condition.frequency
    motion = SineMotion(condition.amplitude, condition.frequency, phase=1.0).at(time)
    return sine_force(parameters(condition, method), *motion, condition.current)


def difference(condition: Condition) -> float:
    """Relative norm of the difference between the loops of the two methods."""
    one, two = (steady_force(condition, method) for method in PUBLISHED_METHODS)
    return float(np.linalg.norm(one - two) / np.linalg.norm(one))


def test_there_are_34_conditions_of_which_30_are_clean() -> None:
    assert len(CONDITIONS) == 34
    assert sum(map(is_clean, CONDITIONS)) == 30
    assert {condition.name for condition in ERRATA} == {
        "5.0mm_1Hz_1.0A",
        "5.0mm_3Hz_1.0A",
        "5.0mm_5Hz_1.0A",
        "7.5mm_3Hz_1.5A",
    }


def test_the_two_methods_agree_where_neither_row_is_an_erratum() -> None:
    marked = {condition for condition, _ in ROW_ERRATA}
    differences = [difference(condition) for condition in CONDITIONS if condition not in marked]
    assert len(differences) == 27
    assert max(differences) <= 0.075
    assert np.median(differences) == pytest.approx(0.012, abs=0.002)


@pytest.mark.parametrize(
    "call", [lambda: find("2.5mm_2Hz_0.0A"), lambda: parameters(Condition(0.0, 0.0025, 2.0))]
)
def test_unknown_conditions_are_refused(call: Any) -> None:
    with pytest.raises(ConditionError, match=r"2.5mm_2Hz_0.0A"):
        call()
