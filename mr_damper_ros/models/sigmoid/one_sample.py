"""The sigmoid laws without jumps for a single sample, in plain numbers: a block of one comes often.

NumPy takes a microsecond for each of a hundred operations, however few the numbers. What is
computed here is that of :mod:`law`, :mod:`reversal`, :mod:`extension` and of the coil; where a
number goes beyond all measure nothing is, and the arrays, which saturate, must do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.first_order_lag import one_sample_later
from mr_damper_ros.models.force_model import State
from mr_damper_ros.models.sigmoid.extension import SIGMOID_COUNT
from mr_damper_ros.models.sigmoid.law import COEFFICIENT_LIMIT, EXPONENT_LIMIT, SMALL_ARGUMENT
from mr_damper_ros.models.sigmoid.reversal import NARROWEST, REVERSAL_MEMORY
from mr_damper_ros.signals.arrays import Array

_LARGEST_INPUT = 1e30
"""Inputs beyond are left to the arrays."""


class _Sample(NamedTuple):
    """Force [N] and damping [N s/m] of the sigmoid, and the branch."""

    force: float
    damping: float
    branch: float


def follow_one(
    parameters: Array, motion: Motion, current: Array, state: State | None
) -> tuple[Array, State] | None:
    """Force (1,) [N] of the sixteen parameters (16,), and the state; None: beyond all measure."""
    velocity = float(motion.velocity[0])
    sample = _sample(parameters.tolist(), motion, float(current[0]), state)
    if sample is None:
        return None
    return np.array([sample.force]), (np.array(velocity), np.array(sample.branch))


def follow_one_extended(
    parameters: Array, motion: Motion, current: Array, period: float, state: State | None
) -> tuple[Array, State] | None:
    """The same of the extended law, for parameters (20,) and samples ``period`` [s] apart."""
    values = parameters.tolist()
    compliance, stiffness, offset, coil = values[SIGMOID_COUNT:]
    own = None if state is None else [float(part) for part in state[REVERSAL_MEMORY:]]
    supplied = amperes = float(current[0])
    if coil > 0.0 and own is not None and len(own) > 3:
        amperes = one_sample_later(supplied, coil, period, own[3], own[4], coil)
    sample = _sample(values[:SIGMOID_COUNT], motion, amperes, state)
    if sample is None:
        return None
    constant = max(compliance * sample.damping, 0.0)
    late = sample.force
    if own is not None:
        late = one_sample_later(sample.force, constant, period, *own[:3])
    force = late + stiffness * float(motion.displacement[0]) + offset
    if not abs(force) < COEFFICIENT_LIMIT:
        return None
    remembered = [float(motion.velocity[0]), sample.branch, sample.force, late, constant]
    if coil > 0.0:
        remembered += [supplied, amperes]
    return np.array([force]), tuple(np.array(value) for value in remembered)


def _sample(
    values: list[float], motion: Motion, current: float, state: State | None
) -> _Sample | None:
    v, v_m = float(motion.velocity[0]), float(motion.peak_velocity[0])
    f0, i0, i1, a0, a1, a2, a3, a4, k0, k1c, k1e, k2, k3, k4, k5, k6 = values
    growth, decay, softening = a1 * v_m, -a4 * v_m, 1.0 + k0 * v_m
    if not max(abs(growth), abs(decay)) < EXPONENT_LIMIT or softening == 0.0:
        return None
    if not max(abs(v), v_m, abs(current)) < _LARGEST_INPUT:
        return None
    rise = math.tanh(0.5 * a2 * (current + i0)) - math.tanh(0.5 * a2 * i0)
    f_t = f0 * (1.0 + math.exp(growth)) * (1.0 + 0.5 * k2 * rise)
    rise = math.tanh(0.5 * a3 * (current + i1)) - math.tanh(0.5 * a3 * i1)
    v_h = k4 * v_m * (1.0 + 0.5 * k3 * rise)
    alpha = a0 / softening
    slope = (k1c if v >= 0.0 else k1e) * math.exp(decay)
    branch = _branch(v, float(motion.acceleration[0]), v_h, state)
    half = 0.5 * alpha * (v + v_h * branch + k6 * v_m)
    sigmoid = math.tanh(half)
    force = (f_t * sigmoid - k5 * f_t) * (1.0 + slope * abs(v))
    ratio = 1.0 if abs(half) < SMALL_ARGUMENT else sigmoid / half
    damping = f_t * 0.5 * alpha * ratio
    # A sum with what is not finite, or cannot be compared, is neither.
    largest = abs(f_t) + abs(alpha) + abs(slope) + abs(v_h) + abs(force) + abs(damping)
    return _Sample(force, damping, branch) if largest < COEFFICIENT_LIMIT else None


def _branch(v: float, acceleration: float, half_width: float, state: State | None) -> float:
    """See :func:`reversal.branch_along`."""
    if state is None:
        return float(np.sign(acceleration))
    change = v - float(state[0])
    branch = float(state[1]) + change / max(abs(half_width), NARROWEST)
    return min(branch, 1.0) if change >= 0.0 else max(branch, -1.0)
