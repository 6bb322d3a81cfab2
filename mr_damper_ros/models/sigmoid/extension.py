"""What the extended law adds to the sigmoid force: a compliance, a stiffness and an offset.

What carries the force of the fluid gives way: the fluid itself, the rod, the mounts. Such a spring
in series with the damper (a Maxwell element) makes the force late. With F_s the sigmoid force,

    tau dF_l/dt + F_l = F_s,  tau = compliance * f_t tanh(alpha x / 2) / x,
    x = v + sgn(a) v_h + v_d,

the fraction being the damping that the sigmoid amounts to at its velocity x. So the lag is long
where the force is steep, around a reversal, short where the fluid flows, and rises with the yield
force, that is with the current. The force is F_l + stiffness u + offset: those of the gas (thesis
3.2; the thesis adds 100 N to its records by hand). doc/extended_law.md tells what else was tried.

The current that counts is that of the coil, see :mod:`coil`. A parameter array of the extended law
holds the sixteen of the sigmoid law first, then the three of :data:`EXTENSION_NAMES`, last the time
constant of the coil.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion_history import MotionHistory
from mr_damper_ros.models.coil import COIL
from mr_damper_ros.models.first_order_lag import FirstOrderLag, lagged
from mr_damper_ros.models.sigmoid.law import (
    PARAMETER_NAMES,
    Coefficients,
    coefficient_jacobian,
    force_from_coefficients,
    secant_damping,
    secant_damping_jacobian,
)
from mr_damper_ros.signals.arrays import Array

EXTENDED_MODEL = "sigmoid_lag"
"""Name of the extended law in ``MODELS``."""

COMPLIANCE = "compliance"
"""The parameter that makes the lag; it must not be negative."""

EXTENSION_NAMES = (COMPLIANCE, "stiffness", "offset")
"""The three parameters of the extension: [m/N], [N/m], [N]."""

EXTENDED_NAMES = (*PARAMETER_NAMES, *EXTENSION_NAMES, COIL)
"""The twenty parameters of the extended law, in the order of its parameter arrays."""

SIGMOID_COUNT = len(PARAMETER_NAMES)


class Extension(NamedTuple):
    """The three parameters, each a number or an array that broadcasts."""

    compliance: Array | float
    stiffness: Array | float
    offset: Array | float

    def time_constant(self, damping: Array) -> Array:
        """Time constant [s] of the lag where the sigmoid has this damping [N s/m]; not negative."""
        return np.maximum(self.compliance * damping, 0.0)

    def gas(self, displacement: Array | float) -> Array | float:
        """Force [N] of the gas at a displacement [m]."""
        return self.stiffness * displacement + self.offset


class ForceAndDamping(NamedTuple):
    """Force [N] of the sigmoid law and the damping [N s/m] of its sigmoid, or derivatives."""

    force: Array
    damping: Array


def force_and_damping(
    coefficients: Coefficients, velocity: Array, acceleration: Array
) -> ForceAndDamping:
    """Both of shape (..., n), for coefficients that broadcast against velocity (n,) [m/s]."""
    return ForceAndDamping(
        force_from_coefficients(coefficients, velocity, acceleration),
        secant_damping(coefficients, velocity, acceleration),
    )


def force_and_damping_jacobian(
    coefficients: Coefficients, velocity: Array, acceleration: Array
) -> ForceAndDamping:
    """Derivatives of both by the seven coefficients, of shape (..., n, 7)."""
    return ForceAndDamping(
        coefficient_jacobian(coefficients, velocity, acceleration),
        secant_damping_jacobian(coefficients, velocity, acceleration),
    )


def is_extended(parameters: Array) -> bool:
    """Whether an array (..., 16) or (..., 20) is of the extended law.

    Raises ValueError for any other length.
    """
    count = np.shape(parameters)[-1]
    if count not in (SIGMOID_COUNT, len(EXTENDED_NAMES)):
        raise ValueError(
            f"there are {count} parameters: the sigmoid law has {SIGMOID_COUNT}, the extended one "
            f"{len(EXTENDED_NAMES)}"
        )
    return bool(count != SIGMOID_COUNT)


def extension_of(parameters: Array) -> Extension:
    """The three after the sixteen of parameters (20,)."""
    return Extension(*parameters[SIGMOID_COUNT:-1].tolist())


def coil_time_constant_of(parameters: Array) -> float:
    """Time constant [s] of the coil of parameters (16,) or (20,): of the former 0."""
    return float(parameters[-1]) if is_extended(parameters) else 0.0


def without_extension(sixteen: Array) -> Array:
    """Parameters (20,) of the extended law that give the force of these (16,)."""
    return np.concatenate((sixteen, np.zeros(len(EXTENDED_NAMES) - SIGMOID_COUNT)))


def late_force(
    history: MotionHistory,
    plain: Array,
    past: ForceAndDamping,
    displacement: Array,
    extension: Extension,
) -> Array:
    """Force [N] of the extended law, shape (..., n), from that of the sigmoid law.

    ``plain`` (..., n) is the latter at the samples, ``past`` along the history.
    """
    constant = extension.time_constant(past.damping)
    missing = past.force - lagged(past.force, constant, history.period, periodic=history.periodic)
    # Only what the lag changes is interpolated: it is smoother than the force.
    late = plain - np.moveaxis(history.at_samples(np.moveaxis(missing, -1, 0)), 0, -1)
    return np.asarray(late + extension.stiffness * displacement + extension.offset)


def late_force_jacobian(
    history: MotionHistory,
    plain: Array,
    past: ForceAndDamping,
    by_sigmoid: ForceAndDamping,
    extension: Extension,
) -> tuple[Array, Array]:
    """Derivatives (n, p) of :func:`late_force` by p parameters, and (n,) by the compliance.

    ``plain`` (n, p) are those of the sigmoid force at the samples, ``by_sigmoid`` (m, p) those of
    ``past`` along the history.
    """
    constant = extension.time_constant(past.damping)
    lag = FirstOrderLag(constant, history.period, periodic=history.periodic)
    # A damping below zero makes no lag.
    damping = np.maximum(past.damping, 0.0)
    lagging = (past.damping > 0.0)[:, np.newaxis]
    of_force = np.column_stack((by_sigmoid.force, np.zeros(damping.size)))
    of_constant = np.column_stack((extension.compliance * by_sigmoid.damping * lagging, damping))
    late = lag.derivative(past.force, lag(past.force), of_force, of_constant)
    missing = history.at_samples(of_force - late)
    return plain - missing[:, :-1], -missing[:, -1]
