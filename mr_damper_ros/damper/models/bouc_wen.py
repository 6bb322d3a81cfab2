"""Bouc-Wen and modified Bouc-Wen model, integrated stably at the samples' own period.

Spencer, Dyke, Sain and Carlson, J. Engineering Mechanics 123, 1997; thesis eq. 1-6. The published
parameters A, beta, gamma and alpha hold one too many: z and alpha can be scaled against each other
(Ma, Zhang, Bockstedte, Foliente and Paevere, J. Applied Mechanics 71, 2004). Here |z| tends to 1:

    dz/dt = (w - |z|^n (share w + (1 - share) |w| sgn z)) / yield_length,    w the driving velocity

so A = 1/yield_length, beta = share A, gamma = (1 - share) A, and alpha is the force of full yield.

A step is an exponential Rosenbrock-Euler step: exact for an equation linear in z, of second order;
that |z| never exceeds 1 is kept, so it is stable for any period. Sets are integrated side by
side, sample by sample.
"""

from __future__ import annotations

import numpy as np

from mr_damper_ros.damper.models.base import Model, MotionLike, Parameter
from mr_damper_ros.damper.sigmoid import Array

_SMALL = 1e-12
_STEEPEST = 60.0


def _relaxation(rate: Array) -> Array:
    """(e^x - 1)/x, 1 at x = 0; growth within a step is bounded."""
    x = np.clip(rate, -_STEEPEST, 1.0)
    safe = np.where(np.abs(x) < _SMALL, _SMALL, x)
    return np.asarray(np.expm1(safe) / safe)


def _midpoint_steps(velocity: Array) -> Array:
    """Mean velocity within each step between samples, shape (n - 1,)."""
    return 0.5 * (velocity[1:] + velocity[:-1])


def _slope(z: Array, w: Array, length: Array, share: Array, power: Array) -> tuple[Array, Array]:
    """dz/dt, and its derivative by w for the sign that w has."""
    bent = np.abs(z) ** power
    gain = (1.0 - bent * (share + (1.0 - share) * np.sign(z) * np.sign(w))) / length
    return gain * w, gain


def _bouc_wen(parameters: Array, motion: MotionLike, current: Array, period: float) -> Array:
    c0, k0, f0, alpha, length, share, power = (parameters[..., k] for k in range(7))
    v, u = motion.velocity, motion.displacement
    z = np.zeros(parameters.shape[:-1])
    states = np.empty((v.size, *z.shape))
    states[0] = z
    for step, w in enumerate(_midpoint_steps(v), start=1):
        slope, _ = _slope(z, np.asarray(w), length, share, power)
        z = _hysteresis_step(z, slope, np.asarray(w), 0.0, length, share, power, period)
        states[step] = z
    columns = (x[..., np.newaxis] for x in (c0, k0, f0, alpha))
    damping, stiffness, offset, strength = columns
    return np.asarray(damping * v + stiffness * u + offset + strength * np.moveaxis(states, 0, -1))


def _hysteresis_step(
    z: Array,
    slope: Array,
    w: Array,
    back: Array | float,
    length: Array,
    share: Array,
    power: Array,
    period: float,
) -> Array:
    """State z after one step; ``back`` is the derivative of dz/dt by z through the velocity."""
    magnitude = np.maximum(np.abs(z), 1e-9)
    bend = power * magnitude ** (power - 1.0) * np.sign(z)
    rate = -bend * (share + (1.0 - share) * np.sign(z) * np.sign(w)) * w / length
    moved = z + period * slope * _relaxation(period * (rate + back))
    # The exact solution never leaves this range, which a step much longer than the yield could.
    return np.asarray(np.clip(moved, -1.0, 1.0))


def _modified(parameters: Array, motion: MotionLike, current: Array, period: float) -> Array:
    c0, k0, c1, k1, f0, alpha, length, share, power = (parameters[..., k] for k in range(9))
    v, u = motion.velocity, motion.displacement
    both = c0 + c1
    z = np.zeros(parameters.shape[:-1])
    y = np.broadcast_to(u[0], z.shape).astype(float)
    half = -0.5 * period * k0 / both
    inner = np.empty((v.size, *z.shape))

    def inner_velocity(z: Array, y: Array, u: float, v: float) -> Array:
        return np.asarray((alpha * z + c0 * v + k0 * (u - y)) / both)

    def drift(y: Array, z: Array, u: float, v: float) -> Array:
        return np.asarray(y + 0.5 * period * inner_velocity(z, y, u, v) * _relaxation(half))

    inner[0] = inner_velocity(z, y, u[0], v[0])
    middle_u = 0.5 * (u[1:] + u[:-1])
    for step, speed in enumerate(_midpoint_steps(v), start=1):
        place = middle_u[step - 1]
        # Strang's splitting: half a step of y, a step of z, half a step of y.
        y = drift(y, z, place, speed)
        w = speed - inner_velocity(z, y, place, speed)
        slope, gain = _slope(z, w, length, share, power)
        z = _hysteresis_step(z, slope, w, -gain * alpha / both, length, share, power, period)
        y = drift(y, z, place, speed)
        inner[step] = inner_velocity(z, y, u[step], v[step])
    columns = (x[..., np.newaxis] for x in (c1, k1, f0))
    outer_damping, stiffness, offset = columns
    return np.asarray(outer_damping * np.moveaxis(inner, 0, -1) + stiffness * u + offset)


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
)
