"""The sigmoid laws for streams: without the jump where the motion turns, see :mod:`reversal`."""

from __future__ import annotations

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.force_model import State
from mr_damper_ros.models.sigmoid.coefficient_force import Coefficients
from mr_damper_ros.models.sigmoid.extended_model import ExtendedSigmoidModel
from mr_damper_ros.models.sigmoid.one_sample import FEW, follow_few, follow_few_extended
from mr_damper_ros.models.sigmoid.reversal import REVERSAL_MEMORY, branch_along
from mr_damper_ros.models.sigmoid.sigmoid_model import SigmoidModel
from mr_damper_ros.models.sigmoid.sigmoid_response import Branch
from mr_damper_ros.signals.arrays import Array


class ContinuousSigmoidModel(SigmoidModel):
    """The sixteen-parameter law without its jumps."""

    turning = REVERSAL_MEMORY

    def follow(
        self, parameters: Array, motion: Motion, current: Array, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N] of the law; remembered is the branch."""
        if parameters.ndim == 1 and motion.velocity.size <= FEW:
            found = follow_few(parameters, motion, current, state)
            if found is not None:
                return found
        return super().follow(parameters, motion, current, period, state)

    def _turned(
        self, coefficients: Coefficients, motion: Motion, state: State | None
    ) -> tuple[Coefficients, Array, State]:
        return _without_jump(coefficients, motion, state)

    def _branch(self, motion: Motion, state: State | None) -> Branch:
        return _present_branch(motion, state)


class ContinuousExtendedModel(ExtendedSigmoidModel):
    """The extended law without its jumps."""

    turning = REVERSAL_MEMORY

    def follow(
        self, parameters: Array, motion: Motion, current: Array, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; remembered are the branch and what the lags remember."""
        if parameters.ndim == 1 and motion.velocity.size <= FEW:
            found = follow_few_extended(parameters, motion, current, period, state)
            if found is not None:
                return found
        return super().follow(parameters, motion, current, period, state)

    def _turned(
        self, coefficients: Coefficients, motion: Motion, state: State | None
    ) -> tuple[Coefficients, Array, State]:
        return _without_jump(coefficients, motion, state)

    def _branch(self, motion: Motion, state: State | None) -> Branch:
        return _present_branch(motion, state)


CONTINUOUS = {model.name: model for model in (ContinuousSigmoidModel(), ContinuousExtendedModel())}
"""By the name of the law."""


def _without_jump(
    coefficients: Coefficients, motion: Motion, state: State | None
) -> tuple[Coefficients, Array, State]:
    before = None if state is None else state[:REVERSAL_MEMORY]
    branch, after = branch_along(motion.velocity, motion.acceleration, coefficients.v_h, before)
    # The branch is in the shift: no sign of the acceleration is left to count.
    shifted = coefficients._replace(v_h=coefficients.v_h * branch)
    return shifted, np.ones(motion.velocity.size), after


def _present_branch(motion: Motion, state: State | None) -> Branch:
    if state is None:
        return Branch(np.sign(motion.acceleration)[:, np.newaxis])
    return Branch(np.asarray(state[1]), (motion.velocity - state[0])[:, np.newaxis])
