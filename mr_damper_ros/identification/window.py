"""A window of samples to identify from, and its misfit as a function of seven scales.

With the nine shape parameters frozen, each operating-point coefficient is one scale times a
known base that follows the motion and the current. The seven scales are well posed in every
window in which the damper moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mr_damper_ros.damper.sigmoid import (
    PARAMETER_NAMES,
    SCALE_INDICES,
    Array,
    Coefficients,
    coefficient_jacobian,
    force_from_coefficients,
    operating_point_coefficients,
)
from mr_damper_ros.kinematics.motion import Motion, window_motion

_K5 = PARAMETER_NAMES.index("k5")

_STEADY = 1e-9
"""Relative spread of the base coefficients below which they are taken as constant."""


@dataclass(frozen=True)
class Window:
    """Motion, force [N] and coil current [A] of a window; arrays of shape (n,).

    Raises ValueError where lengths differ or values are not finite.
    """

    motion: Motion
    force: Array
    current: Array

    def __post_init__(self) -> None:
        n = self.motion.velocity.size
        for name in ("force", "current"):
            array = np.asarray(getattr(self, name), dtype=float)
            if array.shape != (n,):
                raise ValueError(f"{name} has shape {array.shape}, the motion {n} samples")
            if not np.all(np.isfinite(array)):
                raise ValueError(f"the {name} holds NaN or infinite values")
            object.__setattr__(self, name, array)

    @classmethod
    def from_samples(
        cls, displacement: Array, force: Array, current: Array | float, period: float
    ) -> Window:
        """Window of samples taken every ``period`` [s]; see :func:`window_motion` for errors."""
        motion = window_motion(displacement, period)
        return cls(motion, force, np.broadcast_to(np.asarray(current, float), np.shape(force)))

    def part(self, chosen: slice | Array) -> Window:
        """The chosen samples: a slice, or a mask of shape (n,)."""
        m = self.motion
        motion = Motion(
            displacement=m.displacement[chosen],
            velocity=m.velocity[chosen],
            acceleration=m.acceleration[chosen],
            peak_velocity=m.peak_velocity[chosen],
            sine=m.sine,
        )
        return Window(motion, self.force[chosen], self.current[chosen])

    def predicted_force(self, parameters: Array) -> Array:
        """Force [N] of parameters (16,) over the window, shape (n,)."""
        m = self.motion
        coefficients = operating_point_coefficients(parameters, m.peak_velocity, self.current)
        return force_from_coefficients(coefficients, m.velocity, m.acceleration)

    @property
    def sample_count(self) -> int:
        """Number of samples."""
        return int(self.force.size)

    @cached_property
    def operating_point(self) -> tuple[float, float]:
        """Peak velocity [m/s] and current [A] that stand for the window.

        Where the motion is no sine the peak velocity is the root mean square over the samples,
        weighted by speed, so that rests and reversals do not count.
        """
        weights = np.abs(self.motion.velocity)
        if not np.any(weights):
            return 0.0, float(np.mean(self.current))
        v_m = np.sqrt(np.average(self.motion.peak_velocity**2, weights=weights))
        return float(v_m), float(np.mean(self.current))


class ScaleMisfit:
    """Residual of a window as a function of the seven scales, shape parameters frozen.

    The scales, in the order of ``COEFFICIENT_NAMES``, are f0, a0, k1c, k1e, k4, k6 and f0 k5:
    the last is a product, so that the force offset stays linear and may be zero.
    """

    def __init__(self, window: Window, parameters: Array) -> None:
        self.window = window
        self._start = np.asarray(parameters, dtype=float)
        unit = self._start.copy()
        unit[SCALE_INDICES] = 1.0
        base = operating_point_coefficients(unit, window.motion.peak_velocity, window.current)
        self._base = tuple(_constant_if_steady(values) for values in base)
        self._velocity = window.motion.velocity
        self._branch = np.sign(window.motion.acceleration)

    @property
    def start(self) -> Array:
        """Scales of the parameters given, shape (7,)."""
        scales = np.array(self._start[SCALE_INDICES])
        scales[6] *= scales[0]
        return scales

    def base_at(self, operating_point: tuple[float, float]) -> Array:
        """Coefficients for unit scales at (peak velocity [m/s], current [A]), shape (7,)."""
        unit = self._start.copy()
        unit[SCALE_INDICES] = 1.0
        return np.concatenate(operating_point_coefficients(unit, *operating_point))

    def coefficients(self, scales: Array) -> Coefficients:
        """Operating-point coefficients for scales of shape (7,)."""
        return Coefficients(*(scale * base for scale, base in zip(scales, self._base, strict=True)))

    def residual(self, scales: Array) -> Array:
        """Model minus measurement [N], shape (n,)."""
        predicted = force_from_coefficients(self.coefficients(scales), self._velocity, self._branch)
        return np.asarray(predicted - self.window.force)

    def sum_of_squares(self, scales: Array) -> float:
        """Sum of the squared residual [N²]."""
        residual = self.residual(scales)
        return float(residual @ residual)

    def jacobian(self, scales: Array) -> Array:
        """Derivatives of the residual with respect to the scales, shape (n, 7)."""
        derivatives = coefficient_jacobian(self.coefficients(scales), self._velocity, self._branch)
        for column, base in enumerate(self._base):
            derivatives[:, column] *= base
        return derivatives

    def parameters(self, scales: Array) -> Array:
        """The sixteen parameters with these scales and the frozen shape, shape (16,)."""
        values = self._start.copy()
        values[SCALE_INDICES] = scales
        values[_K5] = scales[6] / scales[0] if scales[0] != 0.0 else 0.0
        return values


def _constant_if_steady(values: Array) -> Array:
    spread = float(np.ptp(values))
    if spread <= _STEADY * float(np.max(np.abs(values))):
        return np.asarray(values[:1].mean())
    return values


def scale_parameter_errors(scales: Array, covariance: Array) -> Array:
    """Standard errors (7,) of f0, a0, k1c, k1e, k4, k6, k5, the shape parameters being given.

    ``scales`` and their ``covariance`` are those of :class:`ScaleMisfit`, whose last is f0 k5;
    the error of k5 follows to first order. NaN where the data do not determine a scale.
    """
    errors = np.sqrt(np.diag(covariance))
    f0 = scales[0]
    if f0 == 0.0:
        errors[6] = np.nan
    else:
        gradient = np.array([-scales[6] / f0**2, 1.0 / f0])
        errors[6] = np.sqrt(gradient @ covariance[np.ix_([0, 6], [0, 6])] @ gradient)
    return errors
