"""What the extended law adds to the sigmoid force: a lag, a stiffness and an offset.

F_s is the sigmoid force, and tau dF_l/dt + F_l = F_s with tau = tau0 + tau1 |i|; the force is
F_l + stiffness u + offset. The lag is the coil's and the fluid's, the stiffness and the offset are
those of the gas (thesis 3.2; the thesis adds 100 N to its records by hand).

A parameter array of the extended law holds the sixteen of the sigmoid law first, then the four of
:data:`EXTENSION_NAMES`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mr_damper_ros.damper.sigmoid import PARAMETER_NAMES, Array

EXTENDED_MODEL = "sigmoid_lag"
"""Name of the extended law in ``MODELS``."""

EXTENSION_NAMES = ("tau0", "tau1", "stiffness", "offset")
"""The four parameters of the extension: [s], [s/A], [N/m], [N]."""

EXTENDED_NAMES = (*PARAMETER_NAMES, *EXTENSION_NAMES)
"""The twenty parameters of the extended law, in the order of its parameter arrays."""

LAG_NAMES = ("tau0", "tau1")
"""Those of the lag, which must not be negative."""

SIGMOID_COUNT = len(PARAMETER_NAMES)

SETTLING = 7.0
"""Time constants after which a lag has forgotten its start to a thousandth."""

_SHORTEST = 1e-9
"""A time constant shorter than this part of the sample period is none."""

_STRETCH = 300.0
"""Time constants over which exponentials are summed up at once: e^300 is still a number."""


class Extension(NamedTuple):
    """The four parameters, each a number or an array that broadcasts."""

    tau0: Array | float
    tau1: Array | float
    stiffness: Array | float
    offset: Array | float

    def time_constant(self, current: Array) -> Array:
        """Time constant [s] of the lag at coil currents [A]; never negative."""
        return np.maximum(self.tau0 + self.tau1 * np.abs(current), 0.0)


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
    """The last four of twenty parameters (20,)."""
    return Extension(*parameters[SIGMOID_COUNT:].tolist())


def name_of_law(parameters: Array) -> str:
    """Name in ``MODELS`` of the law that parameters (16,) or (20,) belong to."""
    return EXTENDED_MODEL if is_extended(parameters) else "sigmoid"


def without_extension(sixteen: Array) -> Array:
    """Parameters (20,) of the extended law that give the force of these (16,)."""
    return np.concatenate((sixteen, np.zeros(len(EXTENSION_NAMES))))


class FirstOrderLag:
    """First-order lag of signals sampled every ``period`` [s], along their first axis.

    ``time_constant`` [s] is a number or has shape (n,). Exact where the signal is linear between
    samples, whatever the period; a time constant of 0 changes nothing. The lag starts settled;
    with ``periodic``, for a constant time constant, the n samples are one period of the signal.
    """

    def __init__(
        self, time_constant: Array | float, period: float, *, periodic: bool = False
    ) -> None:
        tau = np.maximum(time_constant, _SHORTEST * period)
        if tau.ndim and np.ptp(tau) == 0.0:
            tau = tau[:1].mean()
        ratio = period / tau
        self._periodic = periodic
        self._decay = np.exp(-ratio)
        # Weights of the earlier and the later end of the line between two samples.
        mean = -np.expm1(-ratio) / ratio
        self._before, self._now = mean - self._decay, 1.0 - mean
        self._mean_slope = (mean - self._decay) / tau
        self._decay_slope = self._decay * ratio / tau
        self._ratio = ratio

    def __call__(self, values: Array, state: tuple[Array, Array] | None = None) -> Array:
        """The lagged signal, for values of shape (n,) or (n, p).

        ``state``: the last sample before these, and its lagged value.
        """
        driven = _times(self._before, _one_earlier(values)) + _times(self._now, values)
        if state is not None:
            first, before, now = (np.ravel(w)[0] for w in (self._decay, self._before, self._now))
            driven[0] = before * state[0] + now * values[0] + first * state[1]
        elif not self._periodic:
            driven[0] = values[0]
        return self._recursion(driven)

    def derivative(self, values: Array, lagged: Array, weight: Array | float = 1.0) -> Array:
        """Derivative (n,) of the lagged signal by a change ``weight`` (n,) of the time constant.

        ``values`` (n,) is the signal, ``lagged`` (n,) what :meth:`__call__` made of it.
        """
        driven = (
            self._decay_slope * _one_earlier(lagged)
            + (self._mean_slope - self._decay_slope) * _one_earlier(values)
            - self._mean_slope * values
        ) * weight
        if not self._periodic:
            driven[0] = 0.0
        return self._recursion(driven)

    def _recursion(self, driven: Array) -> Array:
        """Solve y[k] = decay[k] y[k-1] + driven[k]."""
        if self._decay.ndim:
            return self._changing_recursion(driven)
        from scipy.signal import lfilter  # here: see mr_damper_ros.start

        decay = float(self._decay)
        result = np.asarray(lfilter([1.0], [1.0, -decay], driven, axis=0))
        if self._periodic:
            count = driven.shape[0]
            before = result[-1] / (1.0 - decay**count)
            powers = decay ** np.arange(1.0, count + 1.0)
            result += np.multiply.outer(powers, before)
        return result

    def _changing_recursion(self, driven: Array) -> Array:
        # Written with sums: y[k] e^E[k] = y[0] + sum of driven[j] e^E[j], E the time in time
        # constants, over stretches that are short enough for the exponentials.
        steps = np.minimum(self._ratio, 36.0)
        result = np.array(driven)
        first, count = 1, driven.shape[0]
        ends = np.cumsum(steps)
        while first < count:
            last = int(np.searchsorted(ends, ends[first - 1] + _STRETCH, side="right"))
            grown = np.exp(ends[first:last] - ends[first - 1])
            sums = np.cumsum(_times(grown, driven[first:last]), axis=0)
            result[first:last] = _times(1.0 / grown, result[first - 1] + sums)
            first = last
        return result


def _times(weight: Array, values: Array) -> Array:
    """Product along the first axis."""
    if weight.ndim and values.ndim > 1:
        weight = weight[:, np.newaxis]
    return np.asarray(weight * values)


def _one_earlier(values: Array) -> Array:
    return np.roll(values, 1, axis=0)


def lagged(
    values: Array,
    time_constant: Array,
    period: float,
    state: tuple[Array, ...] | None = None,
) -> Array:
    """Lag of signals of shape (..., n) along their last axis; see :class:`FirstOrderLag`.

    ``time_constant`` [s] has the shape (..., n) or broadcasts to it. ``state``: the last samples
    before these, and their lagged values, each of shape (...).
    """
    tau = np.broadcast_to(time_constant, values.shape)
    result = np.empty(values.shape)
    for place in np.ndindex(values.shape[:-1]):
        before = None if state is None else (state[0][place], state[1][place])
        result[place] = FirstOrderLag(tau[place], period)(values[place], before)
    return result
