"""The sigmoid force law of an MR damper.

The law is that of Wang et al. (2004) in the form of the MATLAB routine ``mrf_sigmoid`` in
D. M. D. da Silva, "Comparative study of optimization algorithms for parameter identification of
the sigmoid model in MR dampers", University of Brasília, 2023 (eq. 7-11 and appendix D); where
the typeset equations and the routine differ, the routine is followed.

At one operating point, that is one peak velocity and one coil current, the force depends on
seven *operating-point coefficients* only (:class:`.Coefficients`). Each of them is proportional to
exactly one of the sixteen parameters, its *scale parameter*; the other nine, the *shape
parameters*, say how the coefficients change with peak velocity and current.

All functions take and return SI units: displacement in m about the centre of the motion,
velocity in m/s, acceleration in m/s², current in A, force in N (tension positive).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.peak_velocity import peak_velocity
from mr_damper_ros.models.sigmoid.coefficient_force import Coefficients, force_from_coefficients
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

DEPENDENCES = {
    "f_t": ("f0", "a1", "k2", "a2", "I0"),
    "alpha": ("a0", "k0"),
    "k_c": ("k1c", "a4"),
    "k_e": ("k1e", "a4"),
    "v_h": ("k4", "k3", "a3", "I1"),
    "v_d": ("k6",),
    "f_d": ("f0", "a1", "k2", "a2", "I0", "k5"),
}
"""The parameters that each coefficient depends on."""

_INDEX = {name: position for position, name in enumerate(PARAMETER_NAMES)}

_PAIRS = (
    *(slice(_INDEX["I0"], _INDEX["I1"] + 1), slice(_INDEX["a2"], _INDEX["a3"] + 1)),
    *(slice(_INDEX["k2"], _INDEX["k3"] + 1), slice(_INDEX["a1"], _INDEX["a4"] + 1, 3)),
    *(slice(_INDEX["k1c"], _INDEX["k1e"] + 1), slice(_INDEX["k4"], _INDEX["k6"] + 1, 2)),
)
"""(I0, I1), (a2, a3), (k2, k3), (a1, a4), (k1c, k1e), (k4, k6)."""

_GROWTH_AND_DECAY = np.array([[1.0], [-1.0]])
"""Signs of the exponents of a1 and a4."""

SCALE_INDICES = np.array([_INDEX[name] for name in SCALE_PARAMETER_NAMES])

COEFFICIENT_LIMIT = 1e100
"""Coefficients and inputs saturate here, so that no product of them overflows to infinity."""

EXPONENT_LIMIT = 230.0
"""exp(230) is about 1e100: beyond it every coefficient has reached its limit anyway."""


def _exp(exponent: Array) -> Array:
    return np.exp(exponent.clip(-EXPONENT_LIMIT, EXPONENT_LIMIT))


def _sigma(x: Array) -> Array:
    # The tanh form of the logistic function does not overflow.
    return 0.5 * (1.0 + np.tanh(0.5 * x))


def _sigma_derivative(x: Array) -> Array:
    return 0.25 * (1.0 - np.tanh(0.5 * x) ** 2)


def _saturated(x: Array) -> Array:
    # The method: np.clip takes twice the time, which counts for blocks of a few samples.
    return x.clip(-COEFFICIENT_LIMIT, COEFFICIENT_LIMIT)


def _checked(parameters: ArrayLike) -> Array:
    p = np.asarray(parameters, dtype=float)
    if p.shape[-1:] != (len(PARAMETER_NAMES),):
        raise ValueError(
            f"parameters must have a last axis of length {len(PARAMETER_NAMES)} "
            f"(got shape {p.shape}); the order is {', '.join(PARAMETER_NAMES)}"
        )
    return p


def operating_point_coefficients(
    parameters: ArrayLike, peak_velocity: ArrayLike, current: ArrayLike
) -> Coefficients:
    """Coefficients of the law at the operating points (peak velocity, current).

    ``parameters`` has shape (..., 16), ``peak_velocity`` [m/s] and ``current`` [A] broadcast to
    shape (n,) or are scalars; each coefficient has shape (..., n) (n = 1 for scalars). Finite
    inputs give finite coefficients: what would overflow saturates at 1e100.

    Raises ValueError where the last axis of ``parameters`` is not sixteen long.
    """
    p = _checked(parameters)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        gains = current_gains(p, current)
        factors = motion_factors(p, peak_velocity)
        f_t = _saturated(factors.scale * gains[..., 0, :])
        return Coefficients(
            f_t=f_t,
            alpha=factors.alpha,
            k_c=factors.k_c,
            k_e=factors.k_e,
            v_h=_saturated(factors.width * gains[..., 1, :]),
            v_d=factors.v_d,
            f_d=_saturated(p[..., _INDEX["k5"], np.newaxis] * f_t),
        )


class MotionFactors(NamedTuple):
    """What of the coefficients depends on the peak velocity alone; each of shape (..., n).

    f_t is ``scale`` [N], and v_h ``width`` [m/s], times its factor of :func:`current_gains`.
    """

    scale: Array
    alpha: Array
    k_c: Array
    k_e: Array
    width: Array
    v_d: Array


def motion_factors(parameters: Array, peak_velocity: ArrayLike) -> MotionFactors:
    """Factors of parameters (..., 16) at peak velocities (n,) [m/s]; finite, up to 1e100."""
    p = parameters
    v_m = np.asarray(peak_velocity, dtype=float)
    # What has the same form is done in one go, along an axis of two before the last: with a few
    # samples the number of operations counts, not their size.
    rates, slopes, widths = (p[..., pair, np.newaxis] for pair in _PAIRS[3:])
    f0, a0, k0 = (p[..., _INDEX[name], np.newaxis] for name in ("f0", "a0", "k0"))
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        growth_and_decay = _exp(_GROWTH_AND_DECAY * rates * v_m)
        alpha = a0 / (1.0 + k0 * v_m)
        # 0/0, the only way to a NaN here, is a sigmoid of no steepness: zero.
        alpha = np.where(np.isnan(alpha), 0.0, alpha)
        k = _saturated(slopes * growth_and_decay[..., 1:, :])
        v = _saturated(widths * v_m)
        return MotionFactors(
            scale=_saturated(f0 * (1.0 + growth_and_decay[..., 0, :])),
            alpha=_saturated(alpha),
            k_c=k[..., 0, :],
            k_e=k[..., 1, :],
            width=v[..., 0, :],
            v_d=v[..., 1, :],
        )


class GainTerms(NamedTuple):
    """What :func:`current_gains` makes of parameters (..., 16), each (..., 2, 1)."""

    thresholds: Array
    half_steepnesses: Array
    half_steps: Array
    at_none: Array

    @classmethod
    def of(cls, parameters: Array) -> GainTerms:
        """Those of I0 and I1, a2 and a3, k2 and k3."""
        thresholds, steepnesses, steps = (parameters[..., pair, np.newaxis] for pair in _PAIRS[:3])
        half = 0.5 * steepnesses
        with np.errstate(over="ignore", invalid="ignore"):
            return cls(thresholds, half, 0.5 * steps, np.tanh(half * thresholds))

    def gains(self, current: Array) -> Array:
        """As :func:`current_gains`."""
        # The difference of two logistic functions, by tanh, which does not overflow.
        with np.errstate(over="ignore", invalid="ignore"):
            on = np.tanh(self.half_steepnesses * _saturated(current + self.thresholds))
            return _saturated(1.0 + self.half_steps * (on - self.at_none))

    def slopes(self, current: Array) -> Array:
        """Derivatives [1/A] of the gains, of the same shape."""
        with np.errstate(over="ignore", invalid="ignore"):
            on = np.tanh(self.half_steepnesses * _saturated(current + self.thresholds))
            return self.half_steps * self.half_steepnesses * (1.0 - on * on)


def current_gains(parameters: Array, current: ArrayLike) -> Array:
    """Factors of f_t and of v_h at currents (n,) [A], of shape (..., 2, n); 1 at no current."""
    return GainTerms.of(parameters).gains(np.asarray(current, dtype=float))


def sign_of_pair(f_t: ArrayLike) -> Array:
    """Sign by which yield force and steepness are multiplied so that the former is positive.

    They may change sign together without a change of the force: the positive pair is meant.
    """
    return np.where(np.asarray(f_t) < 0.0, -1.0, 1.0)


def sine_force(
    parameters: ArrayLike,
    displacement: ArrayLike,
    velocity: ArrayLike,
    acceleration: ArrayLike,
    current: ArrayLike,
) -> Array:
    """Force [N] of the sixteen-parameter sigmoid law, for a sine, as the thesis has it.

    The peak velocity v_m = sqrt(v² - a u) is that of a sine about its centre. Of any other motion
    the package takes the one of :mod:`mr_damper_ros.kinematics.peak_velocity`: use
    :meth:`Model.force`.

    ``parameters`` has shape (..., 16); displacement [m], velocity [m/s], acceleration [m/s²] and
    current [A] broadcast to shape (n,). The result has shape (..., n). Finite inputs give a
    finite force.

    Raises ValueError where the last axis of ``parameters`` is not sixteen long.
    """
    v = _saturated(np.asarray(velocity, dtype=float))
    v_m = peak_velocity(displacement, v, acceleration)
    coefficients = operating_point_coefficients(parameters, v_m, current)
    return force_from_coefficients(coefficients, v, acceleration)


def coefficient_parameter_jacobian(
    parameters: ArrayLike, peak_velocity: ArrayLike, current: ArrayLike
) -> Array:
    """Derivatives of the seven coefficients with respect to the sixteen parameters.

    ``parameters`` has shape (16,), ``peak_velocity`` and ``current`` broadcast to (n,); the
    result has shape (n, 7, 16).
    """
    p = dict(zip(PARAMETER_NAMES, _checked(parameters), strict=True))
    v_m = np.atleast_1d(np.asarray(peak_velocity, dtype=float))
    i = np.asarray(current, dtype=float)
    shape = np.broadcast_shapes(v_m.shape, i.shape)
    # What depends on one another lies together: most of the array is zero and never touched.
    jacobian = np.zeros((len(COEFFICIENT_NAMES), len(PARAMETER_NAMES), *shape))

    def put(coefficient: int, parameter: str, derivative: Array) -> None:
        jacobian[coefficient, _INDEX[parameter]] = derivative

    growth = _exp(p["a1"] * v_m)
    on, off = p["a2"] * (i + p["I0"]), p["a2"] * p["I0"]
    yield_step = _sigma(on) - _sigma(off)
    yield_gain = 1.0 + p["k2"] * yield_step
    scale = p["f0"] * (1.0 + growth)
    put(0, "f0", (1.0 + growth) * yield_gain)
    put(0, "a1", p["f0"] * v_m * growth * yield_gain)
    put(0, "k2", scale * yield_step)
    slope_on, slope_off = _sigma_derivative(on), _sigma_derivative(off)
    put(0, "a2", scale * p["k2"] * (slope_on * (i + p["I0"]) - slope_off * p["I0"]))
    put(0, "I0", scale * p["k2"] * p["a2"] * (slope_on - slope_off))

    softening = 1.0 + p["k0"] * v_m
    put(1, "a0", 1.0 / softening)
    put(1, "k0", -p["a0"] * v_m / softening**2)

    decay = _exp(-p["a4"] * v_m)
    for coefficient, parameter in ((2, "k1c"), (3, "k1e")):
        put(coefficient, parameter, decay)
        put(coefficient, "a4", -p[parameter] * v_m * decay)

    on, off = p["a3"] * (i + p["I1"]), p["a3"] * p["I1"]
    width_step = _sigma(on) - _sigma(off)
    slope_on, slope_off = _sigma_derivative(on), _sigma_derivative(off)
    scale_h = p["k4"] * v_m
    put(4, "k4", v_m * (1.0 + p["k3"] * width_step))
    put(4, "k3", scale_h * width_step)
    put(4, "a3", scale_h * p["k3"] * (slope_on * (i + p["I1"]) - slope_off * p["I1"]))
    put(4, "I1", scale_h * p["k3"] * p["a3"] * (slope_on - slope_off))

    put(5, "k6", v_m)

    # f_d = k5 f_t
    for parameter in DEPENDENCES["f_t"]:
        put(6, parameter, p["k5"] * jacobian[0, _INDEX[parameter]])
    put(6, "k5", scale * yield_gain)
    return np.moveaxis(jacobian, -1, 0)
