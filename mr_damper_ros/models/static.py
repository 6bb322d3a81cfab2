"""Models without memory: Bingham, hyperbolic tangent, nonlinear hysteretic biviscous.

All have a constant force ``f0``, the gas pressure's. They describe one current; ``current``,
``period`` and ``state`` are not used.
"""

from __future__ import annotations

import numpy as np

from mr_damper_ros.models.force_model import Model, MotionLike, Parameter, State
from mr_damper_ros.signals.arrays import Array


def _columns(parameters: Array) -> tuple[Array, ...]:
    return tuple(parameters[..., place, np.newaxis] for place in range(parameters.shape[-1]))


def _bingham(
    parameters: Array, motion: MotionLike, current: Array, period: float, state: State | None
) -> tuple[Array, State]:
    f_y, c0, f0 = _columns(parameters)
    v = motion.velocity
    return np.asarray(f_y * np.sign(v) + c0 * v + f0), ()


def _bingham_starts(force: float, middle: float, speed: float, amplitude: float) -> Array:
    return np.array([[0.8 * force, 0.2 * force / speed, middle]])


def _tangent(
    parameters: Array, motion: MotionLike, current: Array, period: float, state: State | None
) -> tuple[Array, State]:
    c, k, alpha, beta, delta, f0 = _columns(parameters)
    v, u = motion.velocity, motion.displacement
    return np.asarray(c * v + k * u + alpha * np.tanh(beta * v + delta * np.sign(u)) + f0), ()


def _tangent_starts(force: float, middle: float, speed: float, amplitude: float) -> Array:
    return np.array(
        [
            [0.2 * force / speed, 0.0, 0.8 * force, steepness / speed, hysteresis, middle]
            for steepness in (2.0, 8.0)
            for hysteresis in (0.3, 1.0)
        ]
    )


def _biviscous(
    parameters: Array, motion: MotionLike, current: Array, period: float, state: State | None
) -> tuple[Array, State]:
    c_post, c_pre, f_y, v0, f0 = _columns(parameters)
    v = motion.velocity
    # Between the two post-yield lines the force follows the pre-yield line of its branch.
    pre = c_pre * (v - np.sign(motion.acceleration) * v0)
    return np.asarray(np.minimum(np.maximum(pre, c_post * v - f_y), c_post * v + f_y) + f0), ()


def _biviscous_starts(force: float, middle: float, speed: float, amplitude: float) -> Array:
    return np.array(
        [
            [0.2 * force / speed, steepness * force / speed, 0.8 * force, shift * speed, middle]
            for steepness in (3.0, 10.0)
            for shift in (0.1, 0.3)
        ]
    )


BINGHAM = Model(
    "bingham",
    "Bingham",
    (Parameter("f_y", "N", 0.0), Parameter("c0", "N s/m", 0.0), Parameter("f0", "N")),
    _bingham,
    "Stanway, Sproston and Stevens, J. Electrostatics 20, 1987",
    _bingham_starts,
)

HYPERBOLIC_TANGENT = Model(
    "hyperbolic_tangent",
    "hyperbolic tangent",
    (
        Parameter("c", "N s/m"),
        Parameter("k", "N/m"),
        Parameter("alpha", "N", 0.0),
        Parameter("beta", "s/m", 0.0),
        Parameter("delta", "1"),
        Parameter("f0", "N"),
    ),
    _tangent,
    "Kwok, Ha, Nguyen, Li and Samali, Sensors and Actuators A 132, 2006",
    _tangent_starts,
)

NONLINEAR_BIVISCOUS = Model(
    "nonlinear_biviscous",
    "nonlinear biviscous",
    (
        Parameter("c_post", "N s/m", 0.0),
        Parameter("c_pre", "N s/m", 0.0),
        Parameter("f_y", "N", 0.0),
        Parameter("v0", "m/s"),
        Parameter("f0", "N"),
    ),
    _biviscous,
    "Wereley, Pang and Kamath, J. Intelligent Material Systems and Structures 9, 1998",
    _biviscous_starts,
)
