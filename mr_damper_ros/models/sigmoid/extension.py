"""What the extended law adds to the sigmoid force: a compliance, a stiffness and an offset.

What carries the force of the fluid gives way: the fluid itself, the rod, the mounts. Such a spring
in series with the damper (a Maxwell element) makes the force late. With F_s the sigmoid force,

    tau dF_l/dt + F_l = F_s,  tau = compliance * f_t tanh(alpha x / 2) / x,
    x = v + sgn(a) v_h + v_d,

the fraction being the damping that the sigmoid amounts to at its velocity x. So the lag is long
where the force is steep, around a reversal, short where the fluid flows, and rises with the yield
force, that is with the current. The force is F_l + stiffness u + offset: those of the gas (thesis
3.2; the thesis adds 100 N to its records by hand). doc/extended_law.md tells what else was tried.

A parameter array of the extended law holds the sixteen of the sigmoid law first, then the three of
:data:`EXTENSION_NAMES`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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

EXTENDED_NAMES = (*PARAMETER_NAMES, *EXTENSION_NAMES)
"""The nineteen parameters of the extended law, in the order of its parameter arrays."""

SIGMOID_COUNT = len(PARAMETER_NAMES)

SETTLING = 7.0
"""Time constants after which a lag has forgotten its start to a thousandth."""

_SHORTEST, _LONGEST = 1e-9, 1e9
"""A time constant of fewer sample periods than the first is none; none counts as more than the
other."""


class Extension(NamedTuple):
    """The three parameters, each a number or an array that broadcasts."""

    compliance: Array | float
    stiffness: Array | float
    offset: Array | float

    def time_constant(self, damping: Array) -> Array:
        """Time constant [s] of the lag where the sigmoid has this damping [N s/m]; not negative."""
        return np.maximum(self.compliance * damping, 0.0)


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
    """Whether an array (..., 16) or (..., 19) is of the extended law.

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
    """The last three of nineteen parameters (19,)."""
    return Extension(*parameters[SIGMOID_COUNT:].tolist())


def name_of_law(parameters: Array) -> str:
    """Name in ``MODELS`` of the law that parameters (16,) or (19,) belong to."""
    return EXTENDED_MODEL if is_extended(parameters) else "sigmoid"


def without_extension(sixteen: Array) -> Array:
    """Parameters (19,) of the extended law that give the force of these (16,)."""
    return np.concatenate((sixteen, np.zeros(len(EXTENSION_NAMES))))


LagState = tuple[Array, Array, Array]
"""Of the sample before: the signal, the lagged signal and the time constant [s]."""


class FirstOrderLag:
    """First-order lag of signals sampled every ``period`` [s], along their first axis.

    ``time_constant`` (n,) [s] is that at the samples; between two of them their mean holds.
    Exact where it is constant and the signal linear between samples, whatever the period; a time
    constant of 0 changes nothing. The lag starts settled, or goes on from ``state``; with
    ``periodic`` the n samples are one period of the signal.
    """

    def __init__(
        self,
        time_constant: Array,
        period: float,
        *,
        periodic: bool = False,
        state: LagState | None = None,
    ) -> None:
        before = _one_earlier(time_constant)
        if state is not None:
            before[0] = state[2]
        elif not periodic:
            before[0] = time_constant[0]
        tau = np.clip(0.5 * (before + time_constant), _SHORTEST * period, _LONGEST * period)
        ratio = period / tau
        self._periodic, self._state = periodic, state
        self._tau, self._ratio = tau, ratio
        self._decay = np.exp(-ratio)
        # Weights of the earlier and the later end of the line between two samples.
        mean = -np.expm1(-ratio) / ratio
        self._before, self._now = mean - self._decay, 1.0 - mean

    def __call__(self, values: Array) -> Array:
        """The lagged signal, shape (n,), of one of shape (n,)."""
        driven = self._before * _one_earlier(values) + self._now * values
        if self._state is not None:
            value, late = self._state[0], self._state[1]
            driven[0] = self._before[0] * value + self._now[0] * values[0] + self._decay[0] * late
        elif not self._periodic:
            driven[0] = values[0]
        return self._recursion(driven)

    def derivative(
        self, values: Array, lagged: Array, of_values: Array, of_time_constant: Array
    ) -> Array:
        """Derivatives (n, p) of the lagged signal where signal and time constant have these (n, p).

        ``values`` (n,) is the signal, ``lagged`` (n,) what :meth:`__call__` made of it.
        """
        mean_slope = self._before / self._tau
        decay_slope = self._decay * self._ratio / self._tau
        by_time_constant = (
            decay_slope * _one_earlier(lagged)
            + (mean_slope - decay_slope) * _one_earlier(values)
            - mean_slope * values
        )
        driven = (
            self._before[:, np.newaxis] * _one_earlier(of_values)
            + self._now[:, np.newaxis] * of_values
            + by_time_constant[:, np.newaxis]
            * (0.5 * (_one_earlier(of_time_constant) + of_time_constant))
        )
        if not self._periodic:
            driven[0] = of_values[0]
        return self._recursion(driven)

    def _recursion(self, driven: Array) -> Array:
        """Solve y[k] = decay[k] y[k-1] + driven[k] by forward substitution."""
        from scipy.linalg.lapack import dtbtrs  # here: see mr_damper_ros.entry_points

        bands = np.ones((2, self._decay.size))
        bands[1, :-1] = -self._decay[1:]
        result = dtbtrs(bands, driven, uplo="L", diag="U")[0].reshape(driven.shape)
        if self._periodic:
            passed = np.cumsum(self._ratio)
            before = result[-1] / -np.expm1(-passed[-1])
            result += np.multiply.outer(np.exp(-passed), before)
        return np.asarray(result)


def _one_earlier(values: Array) -> Array:
    return np.roll(values, 1, axis=0)


def lagged(
    values: Array,
    time_constant: Array,
    period: float,
    *,
    periodic: bool = False,
    state: tuple[Array, ...] | None = None,
) -> Array:
    """Lag of signals of shape (..., n) along their last axis; see :class:`FirstOrderLag`.

    ``time_constant`` [s] has the same shape. ``state``: the last samples before these, their
    lagged values and their time constants, each of shape (...).
    """
    result = np.empty(values.shape)
    for place in np.ndindex(values.shape[:-1]):
        before = None if state is None else (state[0][place], state[1][place], state[2][place])
        lag = FirstOrderLag(time_constant[place], period, periodic=periodic, state=before)
        result[place] = lag(values[place])
    return result
