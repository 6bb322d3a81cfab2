"""The sigmoid laws without jumps for single samples, in plain numbers: a few of them come often.

NumPy takes a microsecond for each of a hundred operations, however few the numbers. What is
computed here is that of :mod:`law`, :mod:`reversal`, :mod:`extension` and of the coil; where a
number goes beyond all measure nothing is, and the arrays, which saturate, must do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.coil import few_in_coil
from mr_damper_ros.models.first_order_lag import one_sample_later
from mr_damper_ros.models.force_model import State
from mr_damper_ros.models.sigmoid.coefficient_force import SMALL_ARGUMENT
from mr_damper_ros.models.sigmoid.extension import SIGMOID_COUNT, Extension, extension_of
from mr_damper_ros.models.sigmoid.law import COEFFICIENT_LIMIT, EXPONENT_LIMIT
from mr_damper_ros.models.sigmoid.reversal import NARROWEST, REVERSAL_MEMORY
from mr_damper_ros.signals.arrays import Array

FEW = 64
"""Samples up to which plain numbers take less time than arrays."""

_LARGEST_INPUT = 1e30
"""Inputs beyond are left to the arrays."""


class SampleFactors(NamedTuple):
    """The :class:`sigmoid_response.SigmoidFactors` of one sample, in plain numbers."""

    scale: float
    half_steepness: float
    velocity: float
    width: float
    viscous: float


class SampleForce(NamedTuple):
    """Force [N] and damping [N s/m] of the sigmoid, and the branch."""

    force: float
    damping: float
    branch: float


class SigmoidNumbers:
    """The sixteen parameters (16,) in plain numbers."""

    def __init__(self, parameters: Array) -> None:
        f0, i0, i1, a0, a1, a2, a3, a4, k0, k1c, k1e, k2, k3, k4, k5, k6 = parameters.tolist()
        self._of_motion = f0, a0, a1, a4, k0, k1c, k1e, k4, k6
        self._of_yield = 0.5 * a2, i0, math.tanh(0.5 * a2 * i0), 0.5 * k2
        self._of_width = 0.5 * a3, i1, math.tanh(0.5 * a3 * i1), 0.5 * k3
        self._offset = k5
        # No current multiplies yield force or width by more, no sigmoid the former.
        self._largest = 1.0 + abs(k2), 1.0 + abs(k3), 1.0 + abs(k5)

    def factors(self, velocity: float, peak_velocity: float) -> SampleFactors | None:
        """Those of a motion [m/s]; None: beyond all measure."""
        v, v_m = velocity, peak_velocity
        f0, a0, a1, a4, k0, k1c, k1e, k4, k6 = self._of_motion
        growth, decay, softening = a1 * v_m, -a4 * v_m, 1.0 + k0 * v_m
        if not (abs(growth) < EXPONENT_LIMIT and abs(decay) < EXPONENT_LIMIT) or softening == 0.0:
            return None
        if not (abs(v) < _LARGEST_INPUT and v_m < _LARGEST_INPUT):
            return None
        scale, alpha = f0 * (1.0 + math.exp(growth)), a0 / softening
        offset, width = k6 * v_m, k4 * v_m
        viscous = 1.0 + (k1c if v >= 0.0 else k1e) * math.exp(decay) * abs(v)
        of_yield, of_width, of_sigmoid = self._largest
        f_t, steepness, v_h = abs(scale) * of_yield, abs(alpha), abs(width) * of_width
        # A sum with what is not finite, or cannot be compared, is neither.
        largest = f_t * (of_sigmoid * abs(viscous) + steepness) + steepness + abs(offset) + v_h
        if not largest < COEFFICIENT_LIMIT:
            return None
        return SampleFactors(scale, 0.5 * alpha, v + offset, width, viscous)

    def gains(self, current: float) -> tuple[float, float]:
        """What a current [A] makes of the yield force and of the width."""
        steepness, threshold, at_none, step = self._of_yield
        of_yield = 1.0 + step * (math.tanh(steepness * (current + threshold)) - at_none)
        steepness, threshold, at_none, step = self._of_width
        of_width = 1.0 + step * (math.tanh(steepness * (current + threshold)) - at_none)
        return of_yield, of_width

    def at(
        self, factors: SampleFactors, gains: tuple[float, float], position: float, change: float
    ) -> SampleForce:
        """The sample at a current with these gains.

        It was on the branch ``position`` before the velocity changed by ``change`` [m/s].
        """
        scale, half_steepness, velocity, width, viscous = factors
        f_t, v_h = scale * gains[0], width * gains[1]
        branch = position + change / max(abs(v_h), NARROWEST)
        branch = 1.0 if branch > 1.0 else max(branch, -1.0)
        half = half_steepness * (velocity + v_h * branch)
        sigmoid = math.tanh(half)
        force = f_t * (sigmoid - self._offset) * viscous
        ratio = 1.0 if abs(half) < SMALL_ARGUMENT else sigmoid / half
        return SampleForce(force, f_t * half_steepness * ratio, branch)

    def force_over_current(
        self, factors: SampleFactors, position: float, change: float
    ) -> Callable[[float], float]:
        """The force [N] of :meth:`at` as a function of the current [A], for a search."""
        scale, half_steepness, velocity, width, viscous = factors
        y_steepness, y_threshold, y_at_none, y_step = self._of_yield
        w_steepness, w_threshold, w_at_none, w_step = self._of_width
        offset, tanh = self._offset, math.tanh

        def force(current: float) -> float:
            on = tanh(y_steepness * (current + y_threshold))
            f_t = scale * (1.0 + y_step * (on - y_at_none))
            on = tanh(w_steepness * (current + w_threshold))
            v_h = width * (1.0 + w_step * (on - w_at_none))
            branch = position
            if change:
                branch += change / max(abs(v_h), NARROWEST)
                branch = 1.0 if branch > 1.0 else max(branch, -1.0)
            return f_t * (tanh(half_steepness * (velocity + v_h * branch)) - offset) * viscous

        return force


def branch_before(state: State | None, acceleration: float) -> tuple[float, float | None]:
    """The branch before a sample, and the velocity [m/s]; see :func:`reversal.branch_along`.

    Without one in the state it is the branch of the acceleration, and no velocity.
    """
    if not state:
        return acceleration / abs(acceleration) if acceleration else 0.0, None
    return float(state[1]), float(state[0])


class _Following:
    """Samples of a motion one after the other, each with its current [A]."""

    def __init__(self, parameters: Array, motion: Motion, state: State | None) -> None:
        self._numbers = SigmoidNumbers(parameters)
        self._velocity = motion.velocity.tolist()
        self._peak_velocity = motion.peak_velocity.tolist()
        self._branch, self._before = branch_before(state, float(motion.acceleration[0]))
        self._current = math.nan
        self._gains = (math.nan, math.nan)

    def next(self, place: int, current: float) -> SampleForce | None:
        if current != self._current:
            if not abs(current) < _LARGEST_INPUT:
                return None
            self._current, self._gains = current, self._numbers.gains(current)
        v = self._velocity[place]
        factors = self._numbers.factors(v, self._peak_velocity[place])
        if factors is None:
            return None
        change = 0.0 if self._before is None else v - self._before
        found = self._numbers.at(factors, self._gains, self._branch, change)
        self._before, self._branch = v, found.branch
        return found

    @property
    def turning(self) -> State:
        """What is remembered of the branch."""
        return np.array(self._before), np.array(self._branch)


def follow_few(
    parameters: Array, motion: Motion, current: Array, state: State | None
) -> tuple[Array, State] | None:
    """Force (n,) [N] of the sixteen parameters (16,), and the state; None: beyond all measure."""
    following = _Following(parameters, motion, state)
    forces = []
    for place, amperes in enumerate(current.tolist()):
        sample = following.next(place, amperes)
        if sample is None:
            return None
        forces.append(sample.force)
    return np.array(forces), following.turning


class LagMemory(NamedTuple):
    """What the lag remembers: force and lagged force of the sigmoid [N] and time constant [s]."""

    plain: float
    force: float
    constant: float


def lag_before(state: State | None) -> LagMemory | None:
    """What a state says of the lag, which comes first in it; None at a start."""
    return None if state is None else LagMemory(float(state[0]), float(state[1]), float(state[2]))


def late_after(
    sample: SampleForce, extension: Extension, period: float, before: LagMemory | None
) -> LagMemory:
    """The lag at a sample ``period`` [s] after another; without one nothing is late."""
    constant = max(float(extension.compliance) * sample.damping, 0.0)
    late = sample.force
    if before is not None:
        late = one_sample_later(sample.force, constant, period, *before)
    return LagMemory(sample.force, late, constant)


def follow_few_extended(
    parameters: Array, motion: Motion, current: Array, period: float, state: State | None
) -> tuple[Array, State] | None:
    """The same of the extended law, for parameters (20,) and samples ``period`` [s] apart."""
    coil = float(parameters[-1])
    extension = extension_of(parameters)
    following = _Following(parameters[:SIGMOID_COUNT], motion, state)
    own = None if state is None else state[REVERSAL_MEMORY:]
    late = lag_before(own)
    in_coil: list[float] = current.tolist()
    supply: tuple[float, ...] = ()
    if coil > 0.0:
        before = None if own is None or len(own) == 3 else (float(own[3]), float(own[4]))
        in_coil, supply = few_in_coil(in_coil, coil, period, before)
    forces = []
    for place, (amperes, u) in enumerate(zip(in_coil, motion.displacement.tolist(), strict=True)):
        sample = following.next(place, amperes)
        if sample is None:
            return None
        late = late_after(sample, extension, period, late)
        force = float(late.force + extension.gas(u))
        if not abs(force) < COEFFICIENT_LIMIT:
            return None
        forces.append(force)
    assert late is not None
    remembered = (*late, *supply)
    return np.array(forces), (*following.turning, *(np.array(value) for value in remembered))
