"""First-order lag of a sampled signal, with a time constant that may change from sample to sample.

Used for the compliance in series with the damper, which makes the force late, and for the coil,
whose current follows the supply's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array

SETTLING = 7.0
"""Time constants after which a lag has forgotten its start to a thousandth."""

_SHORTEST, _LONGEST = 1e-9, 1e9
"""A time constant of fewer sample periods than the first is none; none counts as more than the
other."""


class _Weights(NamedTuple):
    """Of a step: time constant [s], period over it, and weights.

    These are of the lagged value before, and of the earlier and the later end of the line between
    the two samples.
    """

    tau: Array
    ratio: Array
    decay: Array
    before: Array
    now: Array

    @classmethod
    def of(cls, before: Array, now: Array, period: float) -> _Weights:
        """Those between two samples with these time constants [s]."""
        tau = (0.5 * (before + now)).clip(_SHORTEST * period, _LONGEST * period)
        ratio = period / tau
        decay = np.exp(-ratio)
        mean = -np.expm1(-ratio) / ratio
        return cls(tau, ratio, decay, mean - decay, 1.0 - mean)


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
        weights = _Weights.of(before, time_constant, period)
        self._periodic, self._state = periodic, state
        self._tau, self._ratio, self._decay, self._before, self._now = weights
        self._bands = np.ones((2, self._decay.size), order="F")
        self._bands[1, :-1] = -self._decay[1:]

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
        half = 0.5 * by_time_constant
        # By columns, which lie together in memory. A step has to do with the sample before it.
        driven = (of_values.T * self._now + of_time_constant.T * half).T
        driven[1:] += (of_values[:-1].T * self._before[1:] + of_time_constant[:-1].T * half[1:]).T
        driven[0] += self._before[0] * of_values[-1] + half[0] * of_time_constant[-1]
        if not self._periodic:
            driven[0] = of_values[0]
        return self._recursion(driven)

    def _recursion(self, driven: Array) -> Array:
        """Solve y[k] = decay[k] y[k-1] + driven[k] by forward substitution."""
        from scipy.linalg.lapack import dtbtrs  # here: see mr_damper_ros.entry_points

        solved = dtbtrs(self._bands, driven, uplo="L", diag="U", overwrite_b=True)[0]
        result = solved.reshape(driven.shape)
        if self._periodic:
            passed = np.cumsum(self._ratio)
            before = result[-1] / -np.expm1(-passed[-1])
            result += np.multiply.outer(np.exp(-passed), before)
        return np.asarray(result)


def one_sample_later(
    value: float, time_constant: float, period: float, before: float, late: float, constant: float
) -> float:
    """The lagged signal at one sample, in plain numbers; see :class:`FirstOrderLag`.

    ``before``, ``late`` and ``constant`` [s]: signal, lagged signal and time constant of the sample
    before.
    """
    tau = min(max(0.5 * (constant + time_constant), _SHORTEST * period), _LONGEST * period)
    ratio = period / tau
    decay, mean = math.exp(-ratio), -math.expm1(-ratio) / ratio
    return (mean - decay) * before + (1.0 - mean) * value + decay * late


def next_lagged(values: Array, time_constant: Array, period: float, state: LagState) -> Array:
    """Lagged values of the one sample after the ``state``, each with its own time constant [s].

    All of them broadcast: they are alternatives, and none follows another.
    """
    value, late, constant = state
    weights = _Weights.of(constant, time_constant, period)
    return np.asarray(weights.before * value + weights.now * values + weights.decay * late)


def _one_earlier(values: Array) -> Array:
    earlier = np.empty_like(values)
    earlier[:1], earlier[1:] = values[-1:], values[:-1]
    return earlier


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
