"""Force of the sigmoid laws over the current.

Of all that the law computes only two factors depend on the current, those of f_t and of v_h, and
they do not depend on the motion: :func:`current_gains`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.current_response import CurrentResponse
from mr_damper_ros.models.first_order_lag import LagState, next_lagged
from mr_damper_ros.models.force_model import State
from mr_damper_ros.models.sigmoid.extension import SIGMOID_COUNT, Extension, extension_of
from mr_damper_ros.models.sigmoid.law import (
    PARAMETER_NAMES,
    Coefficients,
    current_gain_slopes,
    current_gains,
    motion_factors,
    secant_damping,
)
from mr_damper_ros.models.sigmoid.reversal import NARROWEST
from mr_damper_ros.signals.arrays import Array

_OFFSET = PARAMETER_NAMES.index("k5")


@dataclass(frozen=True, eq=False)
class Branch:
    """Where on the hysteresis the samples are: ``position`` (n,), -1 to 1, of the sample before.

    ``change`` (n,) [m/s] is that of the velocity since, or 0 where the branch stays.
    """

    position: Array
    change: Array | float = 0.0


class SigmoidResponse(CurrentResponse):
    """The force of parameters (16,) at the samples of a motion (n,)."""

    def __init__(self, parameters: Array, motion: Motion, branch: Branch) -> None:
        self._parameters = parameters
        self._branch = branch
        self._offset = float(parameters[_OFFSET])
        factors = motion_factors(parameters, motion.peak_velocity)
        v = motion.velocity
        self._half_steepness = 0.5 * factors.alpha
        self._velocity = v + factors.v_d
        self._width = factors.width
        slope = np.where(v >= 0.0, factors.k_c, factors.k_e)
        self._viscous = 1.0 + slope * np.abs(v)
        self._scale = factors.scale

    def force(self, current: Array) -> Array:
        """Force (n, m) [N]."""
        yielding, width = self._coefficients(current)
        argument = self._argument(self._shift(width))
        return np.asarray(yielding * (np.tanh(argument) - self._offset) * _column(self._viscous))

    def slope(self, current: Array) -> Array:
        """Derivative (n, m) [N/A]."""
        yielding, width = self._coefficients(current)
        gain_slopes = current_gain_slopes(self._parameters, current.reshape(-1))
        by_yield, by_width = gain_slopes.reshape(2, *current.shape)
        sigmoid = np.tanh(self._argument(self._shift(width)))
        shifts = _column(self._width) * by_width * self._shift_slope(width)
        bend = (1.0 - sigmoid * sigmoid) * _column(self._half_steepness) * shifts
        by_current = _column(self._scale) * by_yield * (sigmoid - self._offset) + yielding * bend
        return np.asarray(by_current * _column(self._viscous))

    def damping(self, current: Array) -> Array:
        """Damping (n, m) [N s/m] that the sigmoid amounts to."""
        yielding, width = self._coefficients(current)
        steepness, none = 2.0 * _column(self._half_steepness), np.zeros(1)
        shifted = Coefficients(yielding, steepness, none, none, self._shift(width), none, none)
        return secant_damping(shifted, _column(self._velocity), 1.0)

    def _coefficients(self, current: Array) -> tuple[Array, Array]:
        """Yield force [N] and half the width of the hysteresis [m/s], each (n, m)."""
        gains = current_gains(self._parameters, current.reshape(-1))
        of_yield, of_width = gains.reshape(2, *current.shape)
        return _column(self._scale) * of_yield, _column(self._width) * of_width

    def _argument(self, shift: Array) -> Array:
        return np.asarray(_column(self._half_steepness) * (_column(self._velocity) + shift))

    def _shift(self, width: Array) -> Array:
        """What the hysteresis adds to the velocity [m/s], (n, m)."""
        position = _column(self._branch.position)
        if isinstance(self._branch.change, float):
            return np.asarray(position * width)
        step = _column(self._branch.change) / np.maximum(np.abs(width), NARROWEST)
        return np.asarray(width * np.clip(position + step, -1.0, 1.0))

    def _shift_slope(self, width: Array) -> Array:
        """Derivative (n, m) of the shift by the width: within its play the change is common."""
        position = _column(self._branch.position)
        if isinstance(self._branch.change, float):
            return position
        moved = position + _column(self._branch.change) / np.maximum(np.abs(width), NARROWEST)
        return np.where(np.abs(moved) < 1.0, position, np.sign(moved))


class LateResponse(CurrentResponse):
    """The force of the extended law at the next sample, which is late.

    ``state`` holds the sigmoid force, its lagged value and the time constant of the sample before;
    None at a start, where nothing is late.
    """

    def __init__(
        self,
        plain: SigmoidResponse,
        extension: Extension,
        displacement: Array,
        period: float,
        state: LagState | None,
    ) -> None:
        self._plain = plain
        self._extension = extension
        self._displacement = displacement
        self._period = period
        self._state = state

    def force(self, current: Array) -> Array:
        """Force (n, m) [N]; n is 1 where there was a sample before."""
        force = self._plain.force(current)
        if self._state is not None:
            constant = self._extension.time_constant(self._plain.damping(current))
            force = next_lagged(force, constant, self._period, self._state)
        gas = self._extension.stiffness * self._displacement + self._extension.offset
        return np.asarray(force + _column(gas))


def late_response(
    parameters: Array, motion: Motion, branch: Branch, period: float, state: State | None
) -> LateResponse:
    """That of parameters (20,); the ``state`` begins with what the lag remembers."""
    plain = SigmoidResponse(parameters[:SIGMOID_COUNT], motion, branch)
    before = None if state is None else (state[0], state[1], state[2])
    return LateResponse(plain, extension_of(parameters), motion.displacement, period, before)


def _column(values: Array) -> Array:
    return values[..., np.newaxis]
