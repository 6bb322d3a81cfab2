"""Force of the sigmoid laws over the current.

Of all that the law computes only two factors depend on the current, those of f_t and of v_h, and
they do not depend on the motion: :func:`current_gains`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.current_response import CurrentResponse
from mr_damper_ros.models.first_order_lag import LagState, next_lagged
from mr_damper_ros.models.force_model import State
from mr_damper_ros.models.sigmoid.coefficient_force import (
    Coefficients,
    secant_damping,
)
from mr_damper_ros.models.sigmoid.extension import SIGMOID_COUNT, Extension, extension_of
from mr_damper_ros.models.sigmoid.law import (
    PARAMETER_NAMES,
    GainTerms,
    motion_factors,
)
from mr_damper_ros.models.sigmoid.reversal import NARROWEST
from mr_damper_ros.signals.arrays import Array

_OFFSET = PARAMETER_NAMES.index("k5")

Column = Array | float
"""Of n samples (n, 1), so that it goes with m currents; of one sample a plain number."""


class Branch(NamedTuple):
    """Where on the hysteresis the samples are: ``position``, -1 to 1, of the sample before.

    ``change`` [m/s] is that of the velocity since, or None where the branch stays.
    """

    position: Column
    change: Column | None = None


class SigmoidFactors(NamedTuple):
    """What the motion makes of the law, whatever the current.

    Yield force [N] at no current, half the steepness [s/m], velocity with its offset [m/s], half
    the width of the hysteresis [m/s] at no current, and the viscous factor.
    """

    scale: Column
    half_steepness: Column
    velocity: Column
    width: Column
    viscous: Column


class SetTerms(NamedTuple):
    """What a set makes of the law, whatever the motion: of the gains, and the offset [1]."""

    gains: GainTerms
    offset: float

    @classmethod
    def of(cls, parameters: Array) -> SetTerms:
        """Those of parameters (16,)."""
        return cls(GainTerms.of(parameters), float(parameters[_OFFSET]))


class SigmoidResponse(CurrentResponse):
    """The force of a set at samples with these factors."""

    def __init__(self, terms: SetTerms, factors: SigmoidFactors, branch: Branch) -> None:
        self._terms, self._offset = terms
        self._factors = factors
        self._branch = branch

    @classmethod
    def along(cls, parameters: Array, motion: Motion, branch: Branch) -> SigmoidResponse:
        """That of parameters (16,) at the samples (n,) of a motion."""
        found = motion_factors(parameters, motion.peak_velocity)
        v = motion.velocity
        slope = np.where(v >= 0.0, found.k_c, found.k_e)
        factors = SigmoidFactors(
            *(
                part[:, np.newaxis]
                for part in (
                    found.scale,
                    0.5 * found.alpha,
                    v + found.v_d,
                    found.width,
                    1.0 + slope * np.abs(v),
                )
            )
        )
        return cls(SetTerms.of(parameters), factors, branch)

    def force(self, current: Array) -> Array:
        """Force (n, m) [N]."""
        return self.force_of(self.gains(current))

    def gains(self, current: Array) -> Array:
        """What the current makes of yield force and width, (2, ...), whatever the motion."""
        return self._terms.gains(current.reshape(-1)).reshape(2, *current.shape)

    def force_of(self, gains: Array) -> Array:
        """Force [N] of currents with these :meth:`gains`."""
        yielding, width = self._coefficients(gains)
        sigmoid = np.tanh(self._argument(self._shift(width)))
        return np.asarray(yielding * (sigmoid - self._offset) * self._factors.viscous)

    def slope(self, current: Array) -> Array:
        """Derivative (n, m) [N/A]."""
        yielding, width = self._coefficients(self.gains(current))
        gain_slopes = self._terms.slopes(current.reshape(-1))
        by_yield, by_width = gain_slopes.reshape(2, *current.shape)
        sigmoid = np.tanh(self._argument(self._shift(width)))
        shifts = self._factors.width * by_width * self._shift_slope(width)
        bend = (1.0 - sigmoid * sigmoid) * self._factors.half_steepness * shifts
        by_current = self._factors.scale * by_yield * (sigmoid - self._offset) + yielding * bend
        return np.asarray(by_current * self._factors.viscous)

    def damping_of(self, gains: Array) -> Array:
        """Damping [N s/m] that the sigmoid amounts to at currents with these :meth:`gains`."""
        yielding, width = self._coefficients(gains)
        steepness, none = np.asarray(2.0 * self._factors.half_steepness), np.zeros(1)
        shifted = Coefficients(yielding, steepness, none, none, self._shift(width), none, none)
        return secant_damping(shifted, self._factors.velocity, 1.0)

    def _coefficients(self, gains: Array) -> tuple[Array, Array]:
        """Yield force [N] and half the width of the hysteresis [m/s]."""
        return self._factors.scale * gains[0], self._factors.width * gains[1]

    def _argument(self, shift: Array) -> Array:
        return np.asarray(self._factors.half_steepness * (self._factors.velocity + shift))

    def _shift(self, width: Array) -> Array:
        """What the hysteresis adds to the velocity [m/s]."""
        if self._branch.change is None:
            return np.asarray(self._branch.position * width)
        return np.asarray(width * self._moved(width).clip(-1.0, 1.0))

    def _shift_slope(self, width: Array) -> Column:
        """Derivative of the shift by the width: within its play the change is common."""
        if self._branch.change is None:
            return self._branch.position
        moved = self._moved(width)
        return np.where(np.abs(moved) < 1.0, self._branch.position, np.sign(moved))

    def _moved(self, width: Array) -> Array:
        """The branch, if it had no ends."""
        assert self._branch.change is not None
        play = np.maximum(np.abs(width), NARROWEST)
        return np.asarray(self._branch.position + self._branch.change / play)


class LateResponse(CurrentResponse):
    """The force of the extended law at the next sample, which is late.

    ``state`` holds the sigmoid force, its lagged value and the time constant of the sample before;
    None at a start, where nothing is late.
    """

    def __init__(
        self,
        plain: SigmoidResponse,
        extension: Extension,
        displacement: Column,
        period: float,
        state: LagState | None,
    ) -> None:
        self._plain = plain
        self._extension = extension
        self._gas = extension.gas(displacement)
        self._period = period
        self._state = state

    def force(self, current: Array) -> Array:
        """Force (n, m) [N]; n is 1 where there was a sample before."""
        return self.force_of(self._plain.gains(current))

    def force_of(self, gains: Array) -> Array:
        """Force [N] of currents with these :meth:`SigmoidResponse.gains`."""
        force = self._plain.force_of(gains)
        if self._state is not None:
            constant = self._extension.time_constant(self._plain.damping_of(gains))
            force = next_lagged(force, constant, self._period, self._state)
        return np.asarray(force + self._gas)


def late_response(
    parameters: Array, motion: Motion, branch: Branch, period: float, state: State | None
) -> LateResponse:
    """That of parameters (20,); the ``state`` begins with what the lag remembers."""
    plain = SigmoidResponse.along(parameters[:SIGMOID_COUNT], motion, branch)
    displacement = motion.displacement[:, np.newaxis]
    return LateResponse(plain, extension_of(parameters), displacement, period, lag_state(state))


def lag_state(state: State | None) -> LagState | None:
    """What of the state the lag remembers, in the order of the state."""
    return None if state is None else (state[0], state[1], state[2])
