"""Which of the sets from a user, a start and the windows the model bank uses."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.domain import Origin
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.tracking.model_bank import ModelBank
from mr_damper_ros.tracking.validity import DoubtKind

GIVEN = ParameterSet(
    THESIS_28_CELSIUS, set_id="given", peak_velocity_range=(0.0, 1.0), current_range=(0.0, 2.0)
)


def identified(set_id: str, current_range: tuple[float, float], **changes: Any) -> ParameterSet:
    return replace(
        GIVEN, set_id=set_id, origin=Origin.WINDOW, current_range=current_range, **changes
    )


def sets_of(*added: tuple[ParameterSet, int | None]) -> ModelBank:
    """Stamped sets in the model bank after these were added."""
    sets = ModelBank(0.25, gradual=True)
    for parameters, stamp_ns in added:
        sets.add(replace(parameters, stamp_ns=stamp_ns or 0))
    return sets


START = (start_set("sigmoid"), None)
AT_ZERO, EVERYWHERE = identified("window", (0.0, 0.0)), identified("window", (0.0, 2.0))
UNLIMITED = replace(GIVEN, current_range=(-np.inf, np.inf))


@pytest.mark.parametrize(
    ("added", "used"),
    [
        pytest.param([(GIVEN, None), START], "given", id="a start displaces no given set"),
        pytest.param([(GIVEN, None), (start_set("bingham"), None)], "given", id="of another law"),
        pytest.param([START], "literature", id="a start is used where nothing was given"),
        pytest.param([(GIVEN, None), (EVERYWHERE, 1), START], "given", id="after a reset"),
        pytest.param(
            [(GIVEN, None), (AT_ZERO, 1), (replace(AT_ZERO, set_id="b"), 2)],
            "given",
            id="a set for fewer currents displaces no given one",
        ),
        pytest.param([(GIVEN, None), (EVERYWHERE, 1)], "window", id="one for all currents does"),
        pytest.param([(UNLIMITED, None), (AT_ZERO, 1)], "window", id="where no range was given"),
    ],
)
def test_a_given_set_is_displaced_only_by_one_that_holds_where_it_holds(
    added: list[tuple[ParameterSet, int | None]], used: str
) -> None:
    assert sets_of(*added).present.parameters.set_id == used


def test_at_a_slow_sample_rate_the_bank_judges_by_a_single_sample() -> None:
    sets, one = sets_of((GIVEN, None)), np.ones(1)
    sets.follow(Motion(one, one, one, one, sine=None), one, (9.0 * one, one), 0.5, math.nan)
    assert sets.choice(DoubtKind.WRONG, 1.0) is None


def test_a_set_fits_at_the_currents_of_the_windows_that_confirm_it() -> None:
    sets = sets_of((identified("window", (0.0, 2.0)), 1))
    for stamp_ns, currents in enumerate(((1.0, 1.0), (0.4, 0.5), (0.6, 0.7)), start=2):
        sets.confirm("window", stamp_ns, currents)
    assert sets.present.currents == (0.4, 1.0)
    assert [sets.present.fits_at(current) for current in (0.3, 0.7, 1.2)] == [False, True, False]
    # The windows of one set say nothing of the next.
    sets.add(identified("next", (0.0, 2.0), stamp_ns=9))
    assert (sets.present.parameters.set_id, sets.present.currents) == ("next", None)
