"""What the extended law adds to the sigmoid force: a compliance, a stiffness and an offset.

What carries the force of the fluid gives way: the fluid itself, the rod, the mounts. Such a spring
in series with the damper (a Maxwell element) makes the force late. With F_s the sigmoid force,

    tau dF_l/dt + F_l = F_s,  tau = compliance * f_t tanh(alpha x / 2) / x,
    x = v + sgn(a) v_h + v_d,

the fraction being the damping that the sigmoid amounts to at its velocity x. So the lag is long
where the force is steep, around a reversal, short where the fluid flows, and rises with the yield
force, that is with the current. The force is F_l + stiffness u + offset: those of the gas (thesis
3.2; the thesis adds 100 N to its records by hand). doc/extended_law.md tells what else was tried.

The current that counts is that of the coil, see :mod:`first_order_lag`. A parameter array of the
extended law holds the sixteen of the sigmoid law first, then the three of :data:`EXTENSION_NAMES`,
last the time constant of the coil.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mr_damper_ros.models.first_order_lag import COIL, next_lagged, one_sample_later
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
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


def is_extended(parameters: Array) -> bool:
    """Whether an array (..., 16) or (..., 20) is of the extended law.

    Raises ValueError for any other length.
    """
    count = parameters.shape[-1]
    if count not in (SIGMOID_COUNT, len(EXTENDED_NAMES)):
        raise ValueError(
            f"there are {count} parameters: the sigmoid law has {SIGMOID_COUNT}, the extended one "
            f"{len(EXTENDED_NAMES)}"
        )
    return bool(count != SIGMOID_COUNT)


def extension_of(parameters: Array) -> Extension:
    """The three after the sixteen of parameters (20,)."""
    return Extension(*parameters[SIGMOID_COUNT:-1].tolist())


def without_extension(sixteen: Array) -> Array:
    """Parameters (20,) of the extended law that give the force of these (16,)."""
    return np.concatenate((sixteen, np.zeros(len(EXTENDED_NAMES) - SIGMOID_COUNT)))


class LagMemory(NamedTuple):
    """What the lag remembers: force and lagged force of the sigmoid [N] and time constant [s]."""

    plain: float
    force: float
    constant: float


def late_after(
    force: float, damping: float, extension: Extension, period: float, before: LagMemory | None
) -> LagMemory:
    """The lag at a sample ``period`` [s] after another; without one nothing is late."""
    constant = max(float(extension.compliance) * damping, 0.0)
    late = force
    if before is not None:
        late = one_sample_later(force, constant, period, *before)
    return LagMemory(force, late, constant)


def alternatives_after(
    force: Array, damping: Array, extension: Extension, period: float, before: LagMemory | None
) -> Array:
    """Lagged forces [N] of alternatives for the one sample after another; they broadcast."""
    if before is None:
        return force
    state = np.array(before.plain), np.array(before.force), np.array(before.constant)
    return next_lagged(force, extension.time_constant(damping), period, state)
