"""The sigmoid law, written once: all that computes it is compiled or translated from these lines.

What a formula may hold is said in :mod:`mr_damper_ros.models.formulas`. Inputs: the sixteen
parameters, the velocity ``v`` [m/s], the peak velocity ``v_m`` [m/s] of the present cycle and the
current ``i`` [A] in the coil. The hysteresis is on a branch from -1 to 1: it was on ``s`` before
the velocity changed by ``change`` [m/s]. Without a change s is the sign of the acceleration;
how it follows a motion is told in :mod:`following`.
"""

from __future__ import annotations

from mr_damper_ros.models.formulas import Formulas

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
"""A play [m/s] that is narrower is none."""

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
difference of two logistic functions of the current is written with tanh, which does not overflow;
0/0, the only way to NaN, is a sigmoid of no steepness."""

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
"""Force [N], and the damping [N s/m] that the sigmoid amounts to: its force over its velocity."""

LAW: Formulas = (*COEFFICIENTS, *FORCE)
