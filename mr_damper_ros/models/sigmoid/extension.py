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

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion_history import MotionHistory
from mr_damper_ros.models.first_order_lag import COIL, FirstOrderLag, next_lagged, one_sample_later
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES, ForceAndDamping
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


def coil_time_constant_of(parameters: Array) -> float:
    """Time constant [s] of the coil of parameters (16,) or (20,): of the former 0."""
    return float(parameters[-1]) if is_extended(parameters) else 0.0


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


class LateForce:
    """What the compliance makes of the sigmoid force along a history, for one set of parameters.

    ``plain``, where it is an argument, gives what belongs to the sigmoid law at the samples of the
    window; it is asked only where these lie between those of the history.
    ``longest_time_constant`` [s]: that of the lag along the history.
    """

    def __init__(self, history: MotionHistory, past: ForceAndDamping, extension: Extension) -> None:
        """``past``, each of shape (m,), belongs to the sigmoid law along the history."""
        self._history, self._past, self._extension = history, past, extension
        constant = extension.time_constant(past.damping)
        self.longest_time_constant = float(np.max(constant))
        self._lag = FirstOrderLag(constant, history.period, periodic=history.periodic)
        self._late = self._lag(past.force)

    def force(self, displacement: Array, plain: Callable[[], Array]) -> Array:
        """Force [N] of the extended law at samples with this displacement (n,) [m]."""
        late = self._at_samples(self._past.force, self._late, plain)
        return np.asarray(late + self._extension.gas(displacement))

    def jacobian(self, by_sigmoid: ForceAndDamping, plain: Callable[[], Array]) -> Array:
        """Derivatives (n, p) of the force by p parameters of the sigmoid law.

        ``by_sigmoid``, each of shape (m, p), are those along the history.
        """
        by_constant = by_sigmoid.damping * self._by_damping[:, np.newaxis]
        late = self._lag.derivative(self._past.force, self._late, by_sigmoid.force, by_constant)
        return self._at_samples(by_sigmoid.force, late, plain)

    def by_compliance(self) -> Array:
        """Derivative (n,) of the force."""
        nothing = np.zeros((self._late.size, 1))
        damping = np.maximum(self._past.damping, 0.0)[:, np.newaxis]
        late = self._lag.derivative(self._past.force, self._late, nothing, damping)
        return self._history.at_samples(late)[:, 0]

    @property
    def _by_damping(self) -> Array:
        """Derivative (m,) of the time constant by the damping: one below zero makes no lag."""
        return np.where(self._past.damping > 0.0, self._extension.compliance, 0.0)

    def _at_samples(self, along: Array, late: Array, plain: Callable[[], Array]) -> Array:
        """At the samples of the window what is late (m, ...) along the history."""
        if self._history.holds_samples:
            return self._history.at_samples(late)
        # Only what the lag changes is interpolated: it is smoother than the force.
        return np.asarray(plain() - self._history.at_samples(along - late))
