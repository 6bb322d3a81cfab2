"""The sigmoid laws written down once, for languages other than Python.

A formula is a line of Python's own expressions, of numbers, parameters, inputs and what stands
above, to be turned into C and into M-code. What is computed is that
of :mod:`law`, :mod:`reversal` and :mod:`extension`, to rounding; test/core/test_export.py holds
them against each other.

Functions: ``exp``, ``tanh``, ``abs``, ``clip(x, low, high)``, ``larger(x, y)``,
``where(condition, yes, no)``, ``sat(x)`` (within 1e100) and ``number(x)`` (0 where x is none).
"""

from __future__ import annotations

import numpy as np

from mr_damper_ros.models.sigmoid.coefficient_force import force_from_coefficients
from mr_damper_ros.models.sigmoid.extension import EXTENDED_NAMES, SIGMOID_COUNT
from mr_damper_ros.models.sigmoid.law import operating_point_coefficients
from mr_damper_ros.models.sigmoid.reversal import NARROWEST
from mr_damper_ros.signals.arrays import Array

Formulas = tuple[tuple[str, str], ...]

COEFFICIENTS: Formulas = (
    ("growth", "exp(clip(a1 * v_m, -230.0, 230.0))"),
    ("decay", "exp(clip(-a4 * v_m, -230.0, 230.0))"),
    ("yield_rise", "tanh(0.5 * a2 * sat(i + I0)) - tanh(0.5 * a2 * I0)"),
    ("width_rise", "tanh(0.5 * a3 * sat(i + I1)) - tanh(0.5 * a3 * I1)"),
    ("f_t", "sat(sat(f0 * (1.0 + growth)) * sat(1.0 + 0.5 * k2 * yield_rise))"),
    ("alpha", "sat(number(a0 / (1.0 + k0 * v_m)))"),
    ("k_c", "sat(k1c * decay)"),
    ("k_e", "sat(k1e * decay)"),
    ("v_h", "sat(sat(k4 * v_m) * sat(1.0 + 0.5 * k3 * width_rise))"),
    ("v_d", "sat(k6 * v_m)"),
    ("f_d", "sat(k5 * f_t)"),
)
"""Coefficients at the peak velocity v_m [m/s] and the coil's current i [A]."""

FORCE: Formulas = (
    ("slope", "where(v >= 0.0, k_c, k_e)"),
    ("branch", "clip(s + change / larger(abs(v_h), 1e-9), -1.0, 1.0)"),
    ("half", "0.5 * alpha * (v + branch * v_h + v_d)"),
    ("sigmoid", "tanh(half)"),
    ("force", "(f_t * sigmoid - f_d) * (1.0 + slope * abs(v))"),
    ("damping", "0.5 * f_t * alpha * where(abs(half) < 1e-6, 1.0, sigmoid / half)"),
)
"""Force [N] and damping [N s/m] at the velocity v [m/s], the last branch s and the ``change`` of
the velocity since [m/s]; without a change s is the sign of the acceleration."""

INPUTS = ("v", "v_m", "i", "s", "change")
"""Names of what the formulas are given."""


class SigmoidFormulas:
    """The formulas of the sigmoid laws, and what they must give."""

    coefficients = COEFFICIENTS
    force = FORCE

    @staticmethod
    def constants(parameters: Array) -> dict[str, float]:
        """The twenty parameters of the extended law by name, for (16,) or (20,) of them."""
        missing = [0.0] * (len(EXTENDED_NAMES) - parameters.size)
        return dict(zip(EXTENDED_NAMES, parameters.tolist() + missing, strict=True))

    @staticmethod
    def expected(parameters: Array, inputs: Array) -> tuple[Array, Array]:
        """Coefficients (7, n) and force (n,) of the law itself for inputs (n, 5)."""
        v, v_m, current, last, change = inputs.T
        found = operating_point_coefficients(parameters[:SIGMOID_COUNT], v_m, current)
        step = change / np.maximum(np.abs(found.v_h), NARROWEST)
        shifted = found._replace(v_h=found.v_h * np.clip(last + step, -1.0, 1.0))
        return np.stack(found), force_from_coefficients(shifted, v, np.ones(v.size))
