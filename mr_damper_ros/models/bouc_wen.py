"""Bouc-Wen and modified Bouc-Wen model, integrated stably at the samples' own period.

Spencer, Dyke, Sain and Carlson, J. Engineering Mechanics 123, 1997; thesis eq. 1-6. The published
parameters A, beta, gamma and alpha hold one too many: z and alpha can be scaled against each other
(Ma, Zhang, Bockstedte, Foliente and Paevere, J. Applied Mechanics 71, 2004). Here |z| tends to 1:

    dz/dt = (w - |z|^n (share w + (1 - share) |w| sgn z)) / yield_length,    w the driving velocity

so A = 1/yield_length, beta = share A, gamma = (1 - share) A, and alpha is the force of full yield.

A step is an exponential Rosenbrock-Euler step: exact for an equation linear in z, of second order;
that |z| never exceeds 1 is kept, so it is stable for any period.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mr_damper_ros.models.force_model import Model, MotionLike, Parameter, State
from mr_damper_ros.signals.arrays import Array

_STEEPEST = 60.0


def _relaxation(rate: float) -> float:
    """(e^x - 1)/x, 1 at x = 0; growth within a step is bounded."""
    x = min(max(rate, -_STEEPEST), 1.0)
    return math.expm1(x) / x if x != 0.0 else 1.0


def _sign(x: float) -> float:
    return float((x > 0.0) - (x < 0.0))


def _hysteresis_step(
    z: float,
    w: float,
    back: float,
    length: float,
    share: float,
    power: float,
    period: float,
) -> float:
    """State z after one step at the velocity w; ``back`` is minus the derivative of w by z."""
    sign = _sign(z)
    towards = share + (1.0 - share) * sign * _sign(w)
    gain = (1.0 - abs(z) ** power * towards) / length
    bend = power * abs(z) ** (power - 1.0) * sign * towards / length
    moved = z + period * gain * w * _relaxation(-period * (bend * w + gain * back))
    # The exact solution never leaves this range, which a step much longer than the yield could.
    return min(max(moved, -1.0), 1.0)


def _each_set(
    integrate: Callable[[list[float], MotionLike, float, list[float]], Array],
    parameters: Array,
    motion: MotionLike,
    period: float,
    state: State | None,
    size: int,
) -> tuple[Array, State]:
    """Integrate the sets one after the other, which beats arrays up to some thirty of them.

    ``integrate`` returns the integrated quantity (n,) and leaves its last state in the list given;
    at a start all ``size`` numbers of it are NaN.
    """
    shape = parameters.shape[:-1]
    result = np.empty((*shape, motion.velocity.size))
    kept = np.full((size, *shape), math.nan) if state is None else np.array(state)
    for place in np.ndindex(shape):
        memory = kept[(slice(None), *place)].tolist()
        result[place] = integrate(parameters[place].tolist(), motion, period, memory)
        kept[(slice(None), *place)] = memory
    return result, tuple(kept)


def _yielded(values: list[float], motion: MotionLike, period: float, memory: list[float]) -> Array:
    """State z at the samples, shape (n,); the memory holds the last z and the last velocity."""
    *_, length, share, power = values
    z, last = memory
    states = []
    for v in motion.velocity.tolist():
        if math.isnan(z):
            z = 0.0
        else:
            z = _hysteresis_step(z, 0.5 * (v + last), 0.0, length, share, power, period)
        last = v
        states.append(z)
    memory[:] = z, last
    return np.array(states)


def _bouc_wen(
    parameters: Array, motion: MotionLike, current: Array, period: float, state: State | None
) -> tuple[Array, State]:
    z, state = _each_set(_yielded, parameters, motion, period, state, 2)
    damping, stiffness, offset, strength = (parameters[..., k, np.newaxis] for k in range(4))
    viscous = damping * motion.velocity + stiffness * motion.displacement
    return np.asarray(viscous + offset + strength * z), state


def _inner_velocity(
    values: list[float], motion: MotionLike, period: float, memory: list[float]
) -> Array:
    """Velocity [m/s] of the inner point, shape (n,).

    The memory holds z, the displacement s of the rod against the inner point, and the velocity of
    the last sample. Only s enters the equations, so the centre of the motion may move.
    """
    c0, k0, c1, _, _, alpha, length, share, power = values
    both = c0 + c1
    z, s, last = memory
    easing = 0.5 * period * _relaxation(-0.5 * period * k0 / both)
    inner = []
    for v in motion.velocity.tolist():
        if math.isnan(z):
            z = s = 0.0
        else:
            # Strang's splitting: half a step of s, a step of z, half a step of s.
            w = 0.5 * (v + last)
            s += easing * (w - (alpha * z + c0 * w + k0 * s) / both)
            slip = w - (alpha * z + c0 * w + k0 * s) / both
            z = _hysteresis_step(z, slip, alpha / both, length, share, power, period)
            s += easing * (w - (alpha * z + c0 * w + k0 * s) / both)
        last = v
        inner.append((alpha * z + c0 * v + k0 * s) / both)
    memory[:] = z, s, last
    return np.array(inner)


def _modified(
    parameters: Array, motion: MotionLike, current: Array, period: float, state: State | None
) -> tuple[Array, State]:
    inner, state = _each_set(_inner_velocity, parameters, motion, period, state, 3)
    outer_damping, stiffness, offset = (parameters[..., k, np.newaxis] for k in (2, 3, 4))
    return np.asarray(outer_damping * inner + stiffness * motion.displacement + offset), state


def _starts(force: float, middle: float, speed: float, amplitude: float) -> Array:
    return np.array(
        [
            [0.2 * force / speed, 0.0, middle, 0.8 * force, part * amplitude, 0.5, 1.5]
            for part in (0.05, 0.2)
        ]
    )


def _modified_starts(force: float, middle: float, speed: float, amplitude: float) -> Array:
    viscous = force / speed
    return np.array(
        [
            [0.2 * viscous, 0.0, stiff * viscous, 0.0]
            + [middle, 0.8 * force, part * amplitude, 0.5, 1.5]
            for stiff in (2.0, 8.0)
            for part in (0.01, 0.1)
        ]
    )


_HYSTERESIS = (
    Parameter("alpha", "N", 0.0),
    Parameter("yield_length", "m", 1e-6, 1.0),
    Parameter("share", "1", 0.0, 1.0),
    Parameter("n", "1", 1.0, 6.0),
)

BOUC_WEN = Model(
    "bouc_wen",
    "Bouc–Wen",
    (Parameter("c0", "N s/m", 0.0), Parameter("k0", "N/m"), Parameter("f0", "N"), *_HYSTERESIS),
    _bouc_wen,
    "Spencer, Dyke, Sain and Carlson, J. Engineering Mechanics 123, 1997; thesis eq. 1-2",
    _starts,
    remembers=True,
)

MODIFIED_BOUC_WEN = Model(
    "modified_bouc_wen",
    "modified Bouc–Wen",
    (
        Parameter("c0", "N s/m", 0.0),
        Parameter("k0", "N/m", 0.0),
        Parameter("c1", "N s/m", 1e-3),
        Parameter("k1", "N/m"),
        Parameter("f0", "N"),
        *_HYSTERESIS,
    ),
    _modified,
    "Spencer, Dyke, Sain and Carlson, J. Engineering Mechanics 123, 1997; thesis eq. 3-6",
    _modified_starts,
    remembers=True,
)
