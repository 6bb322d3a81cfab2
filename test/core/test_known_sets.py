"""A set that takes over goes on from where it would be, had it been in use all the time."""

from __future__ import annotations

import numpy as np
import pytest

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.sine import Sine
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.models.sigmoid.extension import without_extension
from mr_damper_ros.tracking.known_sets import KnownSets

CURRENT = 1.0
CLOSE = 1e-3
"""Of the force's span: what is left of a lag after the time that it is given to settle."""


@pytest.mark.parametrize("rate", [500, 20_000])
def test_a_set_that_takes_over_has_settled_at_any_rate(rate: int) -> None:
    late = without_extension(THESIS_28_CELSIUS)
    late[16] = 2e-6  # compliance [m/N]: a lag of some ten milliseconds
    found = ParameterSet(late, set_id="late", model="sigmoid_lag")
    sine = Sine(8e-3, 2.0, 0.0, 0.0, 0.0)
    motion = Motion.of_sine(sine, np.arange(2 * rate) / rate, 0.1)
    nothing = np.zeros(rate)
    sets = KnownSets(0.25, gradual=True)
    sets.add(found, None, 0.25)
    assert sets.present is not None
    past, following = motion.part(slice(rate)), motion.part(slice(rate, None))
    for first in range(0, rate, 10):
        part = past.part(slice(first, first + 10))
        sets.follow(part, CURRENT, (nothing[:10], nothing[:10]), 1.0 / rate, 0.25)
    all_along = found.law.continuous.stream(1.0 / rate)
    all_along.follow(late, past, CURRENT)
    expected = all_along.follow(late, following, CURRENT)
    force = sets.settled_stream(sets.present).follow(late, following, CURRENT)
    assert np.max(np.abs(force - expected)) < CLOSE * np.ptp(expected)
