"""The sigmoid force law of an MR damper as formulas, and the functions compiled from them.

The law of Wang et al. (2004) is used in the form of the MATLAB routine ``mrf_sigmoid`` in D. M. D.
da Silva, "Comparative study of optimization algorithms for parameter identification of the sigmoid
model in MR dampers", University of Brasília, 2023 (eq. 7-11 and appendix D). Where the typeset
equations and the routine differ, the formulas follow the routine.
:mod:`mr_damper_ros.models.formulas` describes the syntax of the formulas. The inputs are the
sixteen parameters, the velocity ``v`` [m/s], the peak velocity ``v_m`` [m/s] of the present cycle
and the coil current ``i`` [A]. The branch of the hysteresis is a number from -1 to 1: ``s`` is the
branch before the velocity changed by ``change`` [m/s]. For the original law, s is the sign of the
acceleration and change is zero; :mod:`following` describes how s follows a motion.

At one operating point, that is one peak velocity and one coil current, the force depends on only
seven *operating-point coefficients* (:class:`.Coefficients`). Each of them is proportional to
exactly one of the sixteen parameters, its *scale parameter*. The other nine, the *shape
parameters*, describe how the coefficients depend on peak velocity and current.

All functions use SI units: displacement in m about the centre of the motion, velocity in m/s,
acceleration in m/s², current in A, force in N (tension positive).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.peak_velocity import peak_velocity
from mr_damper_ros.models.formulas import LIMIT, Formulas, gradient, staged
from mr_damper_ros.signals.arrays import Array

PARAMETER_NAMES = (
    *("f0", "I0", "I1", "a0", "a1", "a2", "a3", "a4"),
    *("k0", "k1c", "k1e", "k2", "k3", "k4", "k5", "k6"),
)
"""The sixteen parameters, in the order of the thesis' routine and of every parameter array."""

COEFFICIENT_NAMES = ("f_t", "alpha", "k_c", "k_e", "v_h", "v_d", "f_d")
"""The seven operating-point coefficients, in the order of every coefficient array."""

SCALE_PARAMETER_NAMES = ("f0", "a0", "k1c", "k1e", "k4", "k6", "k5")
"""The scale parameter of each coefficient, in the order of :data:`COEFFICIENT_NAMES`."""

NARROWEST = 1e-9
"""Smallest width of the play [m/s]; a narrower play counts as zero."""

COEFFICIENTS: Formulas = (
    ("growth", "exp(clip(a1 * v_m, -230.0, 230.0))"),
    ("decay", "exp(clip(-a4 * v_m, -230.0, 230.0))"),
    ("yield_on", "tanh(0.5 * a2 * sat(i + I0))"),
    ("yield_off", "tanh(0.5 * a2 * I0)"),
    ("width_on", "tanh(0.5 * a3 * sat(i + I1))"),
    ("width_off", "tanh(0.5 * a3 * I1)"),
    ("yield_rise", "yield_on - yield_off"),
    ("width_rise", "width_on - width_off"),
    ("yield_gain", "sat(1.0 + 0.5 * k2 * yield_rise)"),
    ("width_gain", "sat(1.0 + 0.5 * k3 * width_rise)"),
    ("scale", "sat(f0 * (1.0 + growth))"),
    ("width", "sat(k4 * v_m)"),
    ("f_t", "sat(scale * yield_gain)"),
    ("alpha", "sat(number(a0 / (1.0 + k0 * v_m)))"),
    ("k_c", "sat(k1c * decay)"),
    ("k_e", "sat(k1e * decay)"),
    ("v_h", "sat(width * width_gain)"),
    ("v_d", "sat(k6 * v_m)"),
    ("f_d", "sat(k5 * f_t)"),
)
"""Yield force f_t [N], steepness alpha [s/m], viscous slopes k_c and k_e for velocity >= 0 and < 0
[s/m], hysteresis velocity v_h [m/s], velocity offset v_d [m/s], force offset f_d [N]. The
difference of two logistic functions of the current is written with tanh, which does not overflow. A
steepness of 0/0 counts as zero."""

FORCE: Formulas = (
    ("viscous", "1.0 + where(v >= 0.0, k_c, k_e) * abs(v)"),
    ("branch", f"clip(s + change / larger(abs(v_h), {NARROWEST!r}), -1.0, 1.0)"),
    ("centred", "v + v_d"),
    ("half", "0.5 * alpha * (centred + branch * v_h)"),
    ("sigmoid", "tanh(half)"),
    ("yielding", "f_t * sigmoid - f_d"),
    ("force", "yielding * viscous"),
    ("ratio", "where(abs(half) < 1e-6, 1.0, sigmoid / half)"),
    ("damping", "0.5 * f_t * alpha * ratio"),
)
"""Force [N], and the equivalent damping [N s/m] of the sigmoid: its force over its velocity."""

LAW: Formulas = (*COEFFICIENTS, *FORCE)


_INDEX = {name: position for position, name in enumerate(PARAMETER_NAMES)}

SCALE_INDICES = np.array([_INDEX[name] for name in SCALE_PARAMETER_NAMES])


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


def gradients(results: Sequence[str], by: Sequence[str]) -> Formulas:
    """Formulas of the derivatives of these results, on a given branch."""
    return tuple(
        line for result in results for line in gradient(LAW, result, by, ["branch"])[len(LAW) :]
    )


_WITH_COEFFICIENTS = [(*COEFFICIENT_NAMES, "v", "branch")]

_OPERATING_POINT = [PARAMETER_NAMES, ("v_m", "i")]

_coefficients = staged(LAW, _OPERATING_POINT, COEFFICIENT_NAMES)
coefficient_derivatives = staged(
    (*LAW, *gradients(COEFFICIENT_NAMES, PARAMETER_NAMES)),
    _OPERATING_POINT,
    [f"{coefficient}_by_{name}" for coefficient in COEFFICIENT_NAMES for name in PARAMETER_NAMES],
)
"""Derivatives of the seven coefficients, each by the sixteen parameters."""

_force = staged(LAW, _WITH_COEFFICIENTS, ("force",))
_force_and_damping = staged(LAW, _WITH_COEFFICIENTS, ("force", "damping"))

# Finite parameters may have any size; overflow saturates.
quiet = np.errstate(over="ignore", divide="ignore", invalid="ignore")


def as_columns(parameters: Array) -> list[Any]:
    """The parameters (..., p) one by one: numbers, or arrays (..., 1) for several sets."""
    if parameters.ndim == 1:
        return list(parameters.tolist())
    return [parameters[..., place, np.newaxis] for place in range(parameters.shape[-1])]


def _checked(parameters: ArrayLike) -> Array:
    p = np.asarray(parameters, dtype=float)
    if p.shape[-1:] != (len(PARAMETER_NAMES),):
        raise ValueError(
            f"parameters must have a last axis of length {len(PARAMETER_NAMES)} "
            f"(the shape is {p.shape}); the order is {', '.join(PARAMETER_NAMES)}"
        )
    return p


@quiet
def operating_point_coefficients(
    parameters: ArrayLike, peak_velocity: ArrayLike, current: ArrayLike
) -> Coefficients:
    """Coefficients of the law at the operating points (peak velocity, current).

    ``parameters`` has shape (..., 16), ``peak_velocity`` [m/s] and ``current`` [A] broadcast to
    shape (..., n) or are scalars; each coefficient has shape (..., n) (n = 1 for scalars). Finite
    inputs give finite coefficients: values that would overflow saturate at 1e100.

    Raises ValueError if the last axis of ``parameters`` does not have length sixteen.
    """
    at = _coefficients(*as_columns(_checked(parameters)))
    return Coefficients(*at(_array(peak_velocity), _array(current)))


@quiet
def force_from_coefficients(
    coefficients: Coefficients, velocity: ArrayLike, acceleration: ArrayLike
) -> Array:
    """Force [N] of the law with the given coefficients.

    ``velocity`` and ``acceleration`` have shape (n,); coefficients broadcast against them. Only the
    sign of the acceleration is used: it selects the branch of the hysteresis loop.
    """
    return np.asarray(_force(*coefficients, *_moving(velocity, acceleration)))


@quiet
def force_and_damping(
    coefficients: Coefficients, velocity: Array, acceleration: Array
) -> tuple[Array, Array]:
    """Force and damping of shape (..., n), for coefficients that broadcast against velocity (n,).

    The velocity is in m/s. The damping is f_t tanh(alpha x / 2) / x, with x = v + sgn(a) v_h + v_d.
    """
    force, damping = _force_and_damping(*coefficients, *_moving(velocity, acceleration))
    return force, damping


def sign_of_pair(f_t: ArrayLike) -> Array:
    """Sign by which yield force and steepness are multiplied, so that the yield force is positive.

    The force does not change if both change sign; a positive yield force is the convention.
    """
    return np.where(np.asarray(f_t) < 0.0, -1.0, 1.0)


def sine_force(
    parameters: ArrayLike,
    displacement: ArrayLike,
    velocity: ArrayLike,
    acceleration: ArrayLike,
    current: ArrayLike,
) -> Array:
    """Force [N] of the sixteen-parameter sigmoid law for a sine, as defined in the thesis.

    The peak velocity v_m = sqrt(v² - a u) is correct for a sine about its centre. For any other
    motion use :meth:`Model.force`, with the peak velocity of
    :mod:`mr_damper_ros.kinematics.peak_velocity`.

    ``parameters`` has shape (..., 16); displacement [m], velocity [m/s], acceleration [m/s²] and
    current [A] broadcast to shape (n,). The result has shape (..., n). Finite inputs give a finite
    force.

    Raises ValueError if the last axis of ``parameters`` does not have length sixteen.
    """
    v = np.clip(np.asarray(velocity, dtype=float), -LIMIT, LIMIT)
    v_m = peak_velocity(displacement, v, acceleration)
    coefficients = operating_point_coefficients(parameters, v_m, current)
    return force_from_coefficients(coefficients, v, acceleration)


def _moving(velocity: ArrayLike, acceleration: ArrayLike) -> tuple[Array, Array]:
    return np.asarray(velocity, dtype=float), np.sign(acceleration)


def _array(values: ArrayLike) -> Array:
    return np.atleast_1d(np.asarray(values, dtype=float))
