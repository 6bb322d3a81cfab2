"""A window of samples to identify from, and its misfit as a function of seven scales.

With the nine shape parameters frozen, each operating-point coefficient is one scale times a
known base that follows the motion and the current. The seven scales are well posed in every
window in which the damper moves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mr_damper_ros.kinematics.motion import Motion, window_motion
from mr_damper_ros.models.sigmoid.extension import (
    SIGMOID_COUNT,
    ForceAndDamping,
    extension_of,
    force_and_damping,
    force_and_damping_jacobian,
    is_extended,
)
from mr_damper_ros.models.sigmoid.lag_history import History, following_stride
from mr_damper_ros.models.sigmoid.law import (
    PARAMETER_NAMES,
    SCALE_INDICES,
    Coefficients,
    coefficient_jacobian,
    force_from_coefficients,
    operating_point_coefficients,
    secant_damping,
)
from mr_damper_ros.signals.arrays import Array

_K5 = PARAMETER_NAMES.index("k5")

_STEADY = 1e-9
"""Relative spread of the base coefficients below which they are taken as constant."""


@dataclass(frozen=True)
class Window:
    """Motion, force [N] and coil current [A] of a window; arrays of shape (n,).

    Only a law with a lag needs the rest: the sample ``period`` [s], and for a part of a window
    the ``whole`` with the ``places`` (n,) of the samples, counted in samples of the whole (of a
    steady sine the places suffice).

    Raises ValueError where lengths differ or values are not finite.
    """

    motion: Motion
    force: Array
    current: Array
    period: float = math.nan
    places: Array | None = None
    whole: Window | None = None

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
        cls,
        displacement: Array,
        force: Array,
        current: Array | float,
        period: float,
        peak_velocity: Array | None = None,
    ) -> Window:
        """Window of samples taken every ``period`` [s]; see :func:`window_motion` for errors.

        ``peak_velocity`` (n,) [m/s], where it is known from what went before the window, takes the
        place of the window's own unless the motion is a sine.
        """
        motion = window_motion(displacement, period)
        if peak_velocity is not None and motion.sine is None:
            motion = replace(motion, peak_velocity=peak_velocity)
        amperes = np.broadcast_to(np.asarray(current, float), np.shape(force))
        return cls(motion, force, amperes, period)

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
        places = self._places
        alone = self.steady or not self.period > 0.0
        whole = None if alone else self.whole or self
        return Window(
            motion, self.force[chosen], self.current[chosen], self.period, places[chosen], whole
        )

    def held_within(self, low: float, high: float) -> Window:
        """The same window, the peak velocity of its motion held; see :meth:`Motion.held_within`."""
        whole = None if self.whole is None else self.whole.held_within(low, high)
        return replace(self, motion=self.motion.held_within(low, high), whole=whole)

    def thinned(self, most: int) -> Window:
        """Every so many samples of the window, ``most`` or less than twice as many of them."""
        stride = max(self.sample_count // most, 1)
        if stride == 1:
            return self
        few = self.part(slice(None, None, stride))
        if few.whole is None or few.places is None:
            return few
        whole = few.whole
        coarser = following_stride(whole.motion, whole.period)
        motion = whole.part(slice(None, None, coarser))
        coarse = Window(motion.motion, motion.force, motion.current, coarser * whole.period)
        places = np.minimum(few.places / coarser, coarse.sample_count - 1.0)
        return replace(few, places=places, whole=coarse)

    @property
    def _places(self) -> Array:
        if self.places is not None:
            return self.places
        return np.arange(self.sample_count, dtype=float)

    @cached_property
    def steady(self) -> bool:
        """Whether the motion is a sine and the current constant."""
        return self.motion.sine is not None and float(np.ptp(self.current)) == 0.0

    @cached_property
    def history(self) -> History:
        """The motion behind the samples; raises ValueError where the sample period is unknown."""
        whole = self.whole or self
        if not whole.period > 0.0:
            raise ValueError("the sample period of the window is not known: a lag needs it")
        places = self._places
        if self.steady and self.motion.sine is not None:
            peak_velocity, current = float(self.motion.peak_velocity[0]), float(self.current[0])
            time = places * self.period
            return History.of_sine(self.motion.sine, peak_velocity, current, time)
        branch = np.sign(self.motion.acceleration)
        return History(whole.motion, whole.current, whole.period, places, branch, periodic=False)

    def predicted_force(self, parameters: Array) -> Array:
        """Force [N] of parameters (16,) or (19,) over the window, shape (n,)."""
        sixteen = parameters[:SIGMOID_COUNT]
        plain = force_from_coefficients(*_sigmoid(sixteen, self.motion, self.current))
        if not is_extended(parameters):
            return plain
        history = self.history
        past = force_and_damping(*_sigmoid(sixteen, history.motion, history.current))
        return history.force(plain, past, self.motion.displacement, extension_of(parameters))

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


def longest_lag(windows: Sequence[Window], parameters: Array) -> float:
    """Longest time constant [s] of the lag in any of the windows; 0 for parameters (16,)."""
    if not is_extended(parameters):
        return 0.0
    extension, sixteen = extension_of(parameters), parameters[:SIGMOID_COUNT]
    dampings = (secant_damping(*_sigmoid(sixteen, w.motion, w.current)) for w in windows)
    return max(float(np.max(extension.time_constant(damping))) for damping in dampings)


def _sigmoid(sixteen: Array, motion: Motion, current: Array) -> tuple[Coefficients, Array, Array]:
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
        self.window = window
        self._start = np.asarray(parameters, dtype=float)
        motion = window.motion
        base = operating_point_coefficients(self._unit, motion.peak_velocity, window.current)
        self._base = _one_if_steady(np.stack(np.broadcast_arrays(*base)))
        self._velocity = motion.velocity
        self._branch = np.sign(motion.acceleration)
        self._late = _Late(self, self._start) if is_extended(self._start) else None

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

    def coefficients(self, scales: Array) -> Coefficients:
        """Operating-point coefficients for scales of shape (7,)."""
        count, *others = scales.shape
        base = self._base.reshape(count, *(1,) * (len(others) - 1), -1)
        return Coefficients(*(scales.reshape(count, *(others or (1,))) * base))

    def residual(self, scales: Array) -> Array:
        """Model minus measurement [N], shape (n,)."""
        predicted = self.plain_force(scales) if self._late is None else self._late.force(scales)
        return np.asarray(predicted - self.window.force)

    def sum_of_squares(self, scales: Array) -> float:
        """Sum of the squared residual [N²]."""
        residual = self.residual(scales)
        return float(residual @ residual)

    def jacobian(self, scales: Array) -> Array:
        """Derivatives of the residual with respect to the scales, shape (n, 7)."""
        return self.plain_jacobian(scales) if self._late is None else self._late.jacobian(scales)

    def plain_force(self, scales: Array) -> Array:
        """Sigmoid force [N], shape (n,), whatever the law adds to it."""
        return force_from_coefficients(self.coefficients(scales), self._velocity, self._branch)

    def plain_jacobian(self, scales: Array) -> Array:
        """Derivatives of :meth:`plain_force` with respect to the scales, shape (n, 7)."""
        derivatives = coefficient_jacobian(self.coefficients(scales), self._velocity, self._branch)
        derivatives *= self._base.T
        return derivatives

    def along(self, scales: Array) -> ForceAndDamping:
        """Sigmoid force and damping of the window, each of shape (n,)."""
        return force_and_damping(self.coefficients(scales), self._velocity, self._branch)

    def jacobian_along(self, scales: Array) -> ForceAndDamping:
        """Derivatives of :meth:`along` with respect to the scales, each of shape (n, 7)."""
        coefficients = self.coefficients(scales)
        both = force_and_damping_jacobian(coefficients, self._velocity, self._branch)
        for derivatives in both:
            derivatives *= self._base.T
        return both

    def parameters(self, scales: Array) -> Array:
        """The parameters (16,) or (19,) with these scales and all else as it was."""
        values = self._start.copy()
        values[SCALE_INDICES] = scales
        values[_K5] = scales[6] / scales[0] if scales[0] != 0.0 else 0.0
        return values


class _Late:
    """The extension of the law over a window: what it makes of the force and its derivatives."""

    def __init__(self, own: ScaleMisfit, parameters: Array) -> None:
        self._own, self._window, self._history = own, own.window, own.window.history
        self._extension = extension_of(parameters)
        self._past = own
        if not self._history.is_window:
            motion, current = self._history.motion, self._history.current
            past = Window(motion, np.zeros(current.size), current)
            self._past = ScaleMisfit(past, parameters[:SIGMOID_COUNT])
        damping = self._past.along(own.start).damping
        slowest = float(np.max(self._extension.time_constant(damping)))
        self._unsettled = self._history.unsettled(slowest)

    def force(self, scales: Array) -> Array:
        past, displacement = self._past.along(scales), self._window.motion.displacement
        plain = past.force if self._past is self._own else self._own.plain_force(scales)
        force = self._history.force(plain, past, displacement, self._extension)
        force[..., self._unsettled] = self._window.force[self._unsettled]
        return force

    def jacobian(self, scales: Array) -> Array:
        past, by_scales = self._past.along(scales), self._past.jacobian_along(scales)
        own = self._past is self._own
        plain = by_scales.force if own else self._own.plain_jacobian(scales)
        derivatives, _ = self._history.jacobian(plain, past, by_scales, self._extension)
        derivatives[self._unsettled] = 0.0
        return derivatives


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
