"""Force and damping of the sigmoid law for given coefficients, and their derivatives by these."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.signals.arrays import Array

SMALL_ARGUMENT = 1e-6
"""Below it tanh(x)/x is 1 to twelve digits, and what is computed of its slope is rounding."""


class Coefficients(NamedTuple):
    """The seven operating-point coefficients; the fields broadcast against each other.

    ``f_t`` yield force [N], ``alpha`` steepness [s/m], ``k_c`` and ``k_e`` viscous slopes for
    velocity >= 0 and < 0 [s/m], ``v_h`` hysteresis velocity [m/s], ``v_d`` velocity offset [m/s],
    ``f_d`` force offset [N].
    """

    f_t: Array
    alpha: Array
    k_c: Array
    k_e: Array
    v_h: Array
    v_d: Array
    f_d: Array


def force_from_coefficients(
    coefficients: Coefficients, velocity: ArrayLike, acceleration: ArrayLike
) -> Array:
    """Force [N] of the law with the given coefficients.

    ``velocity`` and ``acceleration`` have shape (n,); coefficients broadcast against them. Only
    the sign of the acceleration is used: it tells the branch of the hysteresis loop.
    """
    return SigmoidTerms.of(coefficients, velocity, acceleration).force()


def secant_damping(
    coefficients: Coefficients, velocity: ArrayLike, acceleration: ArrayLike
) -> Array:
    """Damping [N s/m] that the sigmoid amounts to: its force over its velocity.

    f_t tanh(alpha x / 2) / x with x = v + sgn(a) v_h + v_d; shapes as for
    :func:`force_from_coefficients`.
    """
    return SigmoidTerms.of(coefficients, velocity, acceleration).damping()


def coefficient_jacobian(
    coefficients: Coefficients, velocity: ArrayLike, acceleration: ArrayLike
) -> Array:
    """Derivatives of the force with respect to the seven coefficients, shape (..., n, 7)."""
    return SigmoidTerms.of(coefficients, velocity, acceleration).force_jacobian()


class SigmoidTerms(NamedTuple):
    """What force, damping and their derivatives have in common, for coefficients along a motion.

    Velocity v (n,), ``branch`` (n,): the sign of the acceleration, ``shifted``: the sigmoid's
    velocity x = v + sgn(a) v_h + v_d, ``half`` of its argument alpha x, and ``sigmoid``: its tanh.
    """

    coefficients: Coefficients
    velocity: Array
    branch: Array
    shifted: Array
    half: Array
    sigmoid: Array

    @classmethod
    def of(
        cls, coefficients: Coefficients, velocity: ArrayLike, acceleration: ArrayLike
    ) -> SigmoidTerms:
        """Those that :func:`force_from_coefficients` is computed from."""
        c = coefficients
        v = np.asarray(velocity, dtype=float)
        branch = np.sign(acceleration)
        shifted = v + branch * c.v_h + c.v_d
        half = 0.5 * c.alpha * shifted
        return cls(c, v, branch, shifted, half, np.tanh(half))

    def force(self) -> Array:
        """As :func:`force_from_coefficients`."""
        c, v = self.coefficients, self.velocity
        slope = np.where(v >= 0.0, c.k_c, c.k_e)
        return np.asarray((c.f_t * self.sigmoid - c.f_d) * (1.0 + slope * np.abs(v)))

    def damping(self) -> Array:
        """As :func:`secant_damping`."""
        c = self.coefficients
        return np.asarray(c.f_t * 0.5 * c.alpha * self._ratio(*self._divisor()))

    def force_jacobian(self) -> Array:
        """As :func:`coefficient_jacobian`."""
        c, v, sigmoid = self.coefficients, self.velocity, self.sigmoid
        speed, forward = np.abs(v), v >= 0.0
        viscous = 1.0 + np.where(forward, c.k_c, c.k_e) * speed
        yield_part = c.f_t * sigmoid - c.f_d
        gradient = 0.5 * c.f_t * (1.0 - sigmoid * sigmoid) * viscous
        shift = gradient * c.alpha
        by_slope = yield_part * speed
        return _columns(
            sigmoid * viscous,
            gradient * self.shifted,
            np.where(forward, by_slope, 0.0),
            np.where(forward, 0.0, by_slope),
            shift * self.branch,
            shift,
            -viscous,
        )

    def damping_jacobian(self) -> Array:
        """Derivatives of :func:`secant_damping` by the seven coefficients, shape (..., n, 7)."""
        c = self.coefficients
        small, divisor = self._divisor()
        ratio = self._ratio(small, divisor)
        slope = 1.0 - self.sigmoid * self.sigmoid
        curvature = np.where(small, 0.0, (slope - ratio) / divisor)
        by_velocity = c.f_t * (0.5 * c.alpha) ** 2 * curvature
        return _columns(
            0.5 * c.alpha * ratio,
            0.5 * c.f_t * slope,
            *(0.0, 0.0),
            by_velocity * self.branch,
            by_velocity,
            0.0,
        )

    def _divisor(self) -> tuple[np.ndarray, Array]:
        """Where half the argument is next to zero, and what is divided by: there 1."""
        small = np.abs(self.half) < SMALL_ARGUMENT
        return small, np.where(small, 1.0, self.half)

    def _ratio(self, small: np.ndarray, divisor: Array) -> Array:
        """tanh(x)/x, 1 at 0."""
        return np.where(small, 1.0, self.sigmoid / divisor)


def _columns(*columns: Array | float) -> Array:
    """Columns of shape (..., n), or that broadcast to it, as (..., n, columns).

    Each of them lies together in memory: what is done to them then takes half the time.
    """
    shape = np.broadcast_shapes(*(np.shape(column) for column in columns))
    result = np.empty((len(columns), *shape))
    for place, column in enumerate(columns):
        result[place] = column
    return np.moveaxis(result, 0, -1)
