"""Whether the force of a damper jumps where the motion turns is told by more than one cycle."""

from __future__ import annotations

import known
import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.model_bank import ModelBank

CYCLE = 1000
"""Samples; one comes a millisecond."""

CURRENT = 1.0
SET = ParameterSet(THESIS_28_CELSIUS, set_id="thesis")
RUN = known.run(current=CURRENT, samples=CYCLE, seed=None)
MOTION = Motion(
    RUN.displacement, RUN.velocity, RUN.acceleration, np.full(CYCLE, RUN.top_speed), sine=None
)

SMEARED = 0.65
"""Part of the way from the force that jumps to the gradual one: nearer to that, but not it."""


def force(*, gradual: bool) -> Array:
    """The force of a cycle of the damper [N], if it turns so."""
    law = SET.law.continuous if gradual else SET.law
    return law.stream(RUN.period).follow(SET.values, MOTION, np.full(CYCLE, CURRENT))


JUMPING, GRADUAL = force(gradual=False), force(gradual=True)
INDISTINCT = JUMPING + SMEARED * (GRADUAL - JUMPING)


def looked_at(*cycles: Array) -> list[bool]:
    """Whether the force is taken to be gradual after each of these cycles of it [N]."""
    sets = ModelBank(0.25, gradual=True)
    sets.add(SET, None)
    found = []
    for measured in cycles:
        sets.follow(MOTION, CURRENT, (measured, measured), RUN.period, 0.5)
        sets.with_other_branch_rule()
        found.append(sets.gradual)
    return found


def test_one_cycle_tells_that_the_force_jumps() -> None:
    assert looked_at(JUMPING) == [False]


def test_an_indistinct_cycle_does_not_overrule_those_that_jumped() -> None:
    assert looked_at(JUMPING, JUMPING, INDISTINCT, JUMPING) == [False] * 4


def test_a_force_that_turns_otherwise_from_now_on_is_followed() -> None:
    assert looked_at(JUMPING, JUMPING, GRADUAL, GRADUAL)[-1]
