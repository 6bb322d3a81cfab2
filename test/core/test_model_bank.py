"""A set that takes over has the state that it would have had if used from the start."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.tracking.model_bank import ModelBank

# -- sets from the user ----------------------------------------------------------------------------


GIVEN = ParameterSet(
    THESIS_28_CELSIUS, set_id="given", peak_velocity_range=(0.0, 1.0), current_range=(0.0, 2.0)
)


def identified(set_id: str, current_range: tuple[float, float], **changes: Any) -> ParameterSet:
    return replace(
        GIVEN, set_id=set_id, source="nelder_mead", current_range=current_range, **changes
    )


def sets_of(*added: tuple[ParameterSet, int | None]) -> ModelBank:
    """Stamped sets in the model bank after these were added."""
    sets = ModelBank(0.25, gradual=True)
    for parameters, stamp_ns in added:
        sets.add(parameters, stamp_ns)
    return sets


def in_use(sets: ModelBank) -> str:
    assert sets.present is not None
    return sets.present.parameters.set_id


@pytest.mark.parametrize("model", ["sigmoid", "bingham"])
def test_a_mere_start_does_not_displace_a_given_set(model: str) -> None:
    assert in_use(sets_of((GIVEN, None), (start_set(model), None))) == "given"


def test_a_mere_start_is_used_where_nothing_was_given() -> None:
    assert in_use(sets_of((start_set("sigmoid"), None))) == "literature"


def test_after_a_reset_to_a_mere_start_the_given_set_is_in_use_again() -> None:
    window = identified("window", (0.0, 2.0))
    assert in_use(sets_of((GIVEN, None), (window, 1), (start_set("sigmoid"), None))) == "given"


def test_a_set_for_fewer_currents_does_not_displace_a_given_one() -> None:
    window = identified("window", (0.0, 0.0))
    assert in_use(sets_of((GIVEN, None), (window, 1), (replace(window, set_id="b"), 2))) == "given"


def test_a_set_for_all_the_currents_displaces_a_given_one() -> None:
    assert in_use(sets_of((GIVEN, None), (identified("window", (0.0, 2.0)), 1))) == "window"


def test_a_given_set_that_states_no_range_is_displaced_by_any() -> None:
    stated = replace(GIVEN, current_range=(-np.inf, np.inf))
    assert in_use(sets_of((stated, None), (identified("window", (0.5, 0.5)), 1))) == "window"
