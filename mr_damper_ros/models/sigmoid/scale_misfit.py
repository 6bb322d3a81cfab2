"""The problem of a window for the sigmoid law: its misfit as a function of seven scales.

With the nine shape parameters frozen, each operating-point coefficient is one scale times a
known base that follows the motion and the current. The seven scales are well posed in every
window in which the damper moves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from itertools import product

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.difference_problems import relative_change
from mr_damper_ros.models.first_order_lag import SETTLING, coil_unsettled, in_coil
from mr_damper_ros.models.quantities import SearchEffort
from mr_damper_ros.models.sigmoid.extension import (
    SIGMOID_COUNT,
    LateForce,
    coil_time_constant_of,
    extension_of,
    is_extended,
)
from mr_damper_ros.models.sigmoid.law import (
    PARAMETER_NAMES,
    SCALE_INDICES,
    Coefficients,
    ForceAndDamping,
    coefficient_jacobian,
    force_and_damping,
    force_and_damping_jacobian,
    force_from_coefficients,
    operating_point_coefficients,
    secant_damping,
    sign_of_pair,
)
from mr_damper_ros.signals.arrays import Array

_K5 = PARAMETER_NAMES.index("k5")

_STEADY = 1e-9
"""Relative spread of the base coefficients below which they are taken as constant."""

_COLD_STEEPNESS = (2.0, 6.0, 20.0, 60.0)
_COLD_HYSTERESIS = (0.0, -0.2, -0.4)

_STRENGTH = np.array([True, False, False, False, False, False, True])
"""Of the seven scales, those that rise and fall with the strength of the damper."""

_EFFORT = SearchEffort(
    tolerance=1.5e-8,
    most_steps=300,
    polished_starts=1,
    rough_tolerance=0.01,
    rough_steps=20,
)
"""Seven scales are well posed: the cheapest of the starts leads where the others do."""

_ANY_FREQUENCY = 1.0
"""[Hz], of a sine: the sigmoid law knows its velocities alone."""


def longest_lag(windows: Sequence[Window], parameters: Array) -> float:
    """Longest time constant [s] of the lag in any of the windows; 0 for parameters (16,)."""
    if not is_extended(parameters):
        return 0.0
    extension, sixteen = extension_of(parameters), parameters[:SIGMOID_COUNT]
    dampings = (secant_damping(*coefficients_along(sixteen, w.motion, w.current)) for w in windows)
    return max(float(np.max(extension.time_constant(damping))) for damping in dampings)


def coefficients_along(
    sixteen: Array, motion: Motion, current: Array
) -> tuple[Coefficients, Array, Array]:
    """Coefficients along a motion, and the velocity and acceleration that go with them."""
    coefficients = operating_point_coefficients(sixteen, motion.peak_velocity, current)
    return coefficients, motion.velocity, motion.acceleration


class ScaleMisfit:
    """Residual of a window as a function of the seven scales, shape parameters frozen.

    The scales, in the order of ``COEFFICIENT_NAMES``, are f0, a0, k1c, k1e, k4, k6 and f0 k5:
    the last is a product, so that the force offset stays linear and may be zero. Of the extended
    law the compliance, the stiffness and the offset are frozen too; samples at the begin of the
    window, where the lag may not have settled, then have no residual.
    """

    def __init__(self, window: Window, parameters: Array) -> None:
        self._start = np.asarray(parameters, dtype=float)
        coil = coil_time_constant_of(self._start)
        self.window = in_coil(window, coil)
        motion = window.motion
        base = operating_point_coefficients(self._unit, motion.peak_velocity, self.window.current)
        self._base = _one_if_steady(np.stack(np.broadcast_arrays(*base)))
        self._velocity = motion.velocity
        self._branch = np.sign(motion.acceleration)
        self._late = (
            _Late(self, self._start, coil_unsettled(window, coil))
            if is_extended(self._start)
            else None
        )
        self.differences = 0

    def restarted(self, parameters: Array) -> ScaleMisfit:
        """The same with the scales of other parameters, all else of which is the same."""
        other = copy(self)
        other._start = np.asarray(parameters, dtype=float)
        if self._late is not None:
            other._late = self._late.restarted(other.start)
        return other

    @property
    def settled(self) -> np.ndarray:
        """Mask (n,) of the samples that have a residual."""
        if self._late is None:
            return np.ones(self.window.sample_count, dtype=bool)
        return ~self._late.unsettled

    @property
    def effort(self) -> SearchEffort:
        """How far to search."""
        return _EFFORT

    @property
    def bounds(self) -> None:
        """The scales have none."""
        return None

    @property
    def strength(self) -> np.ndarray:
        """Mask (7,)."""
        return _STRENGTH

    @property
    def _unit(self) -> Array:
        """The sixteen parameters with this shape and scales of 1."""
        unit = self._start[:SIGMOID_COUNT].copy()
        unit[SCALE_INDICES] = 1.0
        return unit

    @property
    def start(self) -> Array:
        """Scales of the parameters given, shape (7,)."""
        scales = np.array(self._start[SCALE_INDICES])
        scales[6] *= scales[0]
        return scales

    def base_at(self, operating_point: tuple[float, float]) -> Array:
        """Coefficients for unit scales at (peak velocity [m/s], current [A]), shape (7,)."""
        return np.concatenate(operating_point_coefficients(self._unit, *operating_point))

    def along_window(self, scales: Array) -> Coefficients:
        """Operating-point coefficients at the samples, for scales of shape (7, ...)."""
        count, *others = scales.shape
        base = self._base.reshape(count, *(1,) * (len(others) - 1), -1)
        return Coefficients(*(scales.reshape(count, *(others or (1,))) * base))

    def residual(self, scales: Array) -> Array:
        """Model minus measurement [N], shape (n,)."""
        predicted = self.plain_force(scales) if self._late is None else self._late.force(scales)
        return np.asarray(predicted - self.window.force)

    def jacobian(self, scales: Array) -> Array:
        """Derivatives of the residual with respect to the scales, shape (n, 7)."""
        return self.plain_jacobian(scales) if self._late is None else self._late.jacobian(scales)

    def plain_force(self, scales: Array) -> Array:
        """Sigmoid force [N], shape (n,), whatever the law adds to it."""
        return force_from_coefficients(self.along_window(scales), self._velocity, self._branch)

    def plain_jacobian(self, scales: Array) -> Array:
        """Derivatives of :meth:`plain_force` with respect to the scales, shape (n, 7)."""
        derivatives = coefficient_jacobian(self.along_window(scales), self._velocity, self._branch)
        derivatives *= self._base.T
        return derivatives

    def along(self, scales: Array) -> ForceAndDamping:
        """Sigmoid force and damping of the window, each of shape (n,)."""
        return force_and_damping(self.along_window(scales), self._velocity, self._branch)

    def jacobian_along(self, scales: Array) -> ForceAndDamping:
        """Derivatives of :meth:`along` with respect to the scales, each of shape (n, 7)."""
        coefficients = self.along_window(scales)
        both = force_and_damping_jacobian(coefficients, self._velocity, self._branch)
        for derivatives in both:
            derivatives *= self._base.T
        return both

    def parameters(self, scales: Array) -> Array:
        """The parameters (16,) or (20,) with these scales and all else as it was."""
        values = self._start.copy()
        values[SCALE_INDICES] = scales
        values[_K5] = scales[6] / scales[0] if scales[0] != 0.0 else 0.0
        return values

    def cold_starts(self) -> list[Array]:
        """Scales read off the data: a yield force near the peaks, some steepness and hysteresis."""
        window = self.window
        top, bottom = float(window.force.max()), float(window.force.min())
        top_speed = float(np.max(np.abs(window.motion.velocity)))
        base = self.base_at(window.operating_point)
        base = np.where(base == 0.0, 1.0, base)
        return [
            self.parameters(
                np.array(
                    [
                        *(0.4 * (top - bottom), steepness / top_speed, 0.2 / top_speed),
                        *(0.2 / top_speed, hysteresis * top_speed, 0.0, -0.5 * (top + bottom)),
                    ]
                )
                / base
            )
            for steepness, hysteresis in product(_COLD_STEEPNESS, _COLD_HYSTERESIS)
        ]

    def coefficients(self, scales: Array, covariance: Array) -> tuple[Array, Array]:
        """Operating-point coefficients (7,) and their covariance (7, 7), with positive f_t."""
        base = self.base_at(self.window.operating_point)
        base[:2] *= sign_of_pair(scales[0] * base[0])
        return scales * base, covariance * np.outer(base, base)

    def usual_change(self, part: float, fastest: float) -> Array:
        """Change (7,) of each scale that changes the force by this part, see the protocol."""
        change = relative_change(self, part)
        if not math.isfinite(fastest):
            return change
        sine = Window.of_sine(fastest, _ANY_FREQUENCY, self.window.operating_point[1])
        return np.minimum(
            change, relative_change(ScaleMisfit(sine, self._start[:SIGMOID_COUNT]), part)
        )


class _Late:
    """The extension of the law over a window: what it makes of the force and its derivatives."""

    def __init__(self, own: ScaleMisfit, parameters: Array, unsettled: np.ndarray) -> None:
        self._own, self._window, self._history = own, own.window, own.window.history
        self._extension = extension_of(parameters)
        self._past = own
        if not self._history.is_window:
            motion, current = self._history.motion, self._history.current
            past = Window(motion, np.zeros(current.size), current)
            self._past = ScaleMisfit(past, parameters[:SIGMOID_COUNT])
        self._latest: tuple[Array, LateForce] | None = None
        self._by_coil = unsettled
        self.unsettled = self._unsettled_from(own.start)

    def restarted(self, start: Array) -> _Late:
        """The same for a search that starts from other scales."""
        other = copy(self)
        other.unsettled = other._unsettled_from(start)
        return other

    def _unsettled_from(self, start: Array) -> np.ndarray:
        lag = self._late(start).longest_time_constant
        return self._by_coil | self._history.unsettled(SETTLING * lag)

    def force(self, scales: Array) -> Array:
        if scales.ndim > 1:
            sets = scales.reshape(scales.shape[0], -1).T
            forces = np.array([self.force(one) for one in sets])
            return forces.reshape(*scales.shape[1:-1], -1)
        displacement = self._window.motion.displacement
        force = self._late(scales).force(displacement, lambda: self._own.plain_force(scales))
        force[self.unsettled] = self._window.force[self.unsettled]
        return force

    def jacobian(self, scales: Array) -> Array:
        derivatives = self._late(scales).jacobian(
            self._past.jacobian_along(scales), lambda: self._own.plain_jacobian(scales)
        )
        derivatives[self.unsettled] = 0.0
        return derivatives

    def _late(self, scales: Array) -> LateForce:
        # A search asks for the Jacobian where it has just asked for the residual.
        if self._latest is None or not np.array_equal(self._latest[0], scales):
            late = LateForce(self._history, self._past.along(scales), self._extension)
            self._latest = scales.copy(), late
        return self._latest[1]


def _one_if_steady(base: Array) -> Array:
    """Coefficients (7, n) of unit scales, or (7, 1) where they do not change."""
    spread = np.ptp(base, axis=1)
    if np.all(spread <= _STEADY * np.max(np.abs(base), axis=1)):
        return np.asarray(base.mean(axis=1, keepdims=True))
    return base


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
        variance = gradient @ covariance[np.ix_([0, 6], [0, 6])] @ gradient
        errors[6] = np.sqrt(np.maximum(variance, 0.0))  # rounding may leave less than nothing
    return errors
