"""First-order lags of sampled signals, among them that of the coil's current behind the supply's.

The time constant may change from sample to sample, as that of the compliance in series with the
damper does. The field, and with it the force, follows the current in the coil:
du/dt = -eta (u - v) in Spencer, Dyke, Sain and Carlson (1997); the time constant is 1/eta. Where
the current is constant the lag of the coil shows nowhere.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.quantities import Parameter
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


COIL = "coil_time_constant"
"""Name of the parameter of the coil's lag [s]."""

PLAUSIBLE_COIL = 0.2
"""Few coils are slower [s]."""

_SLOWEST_COIL = 1.0


def coil_parameter() -> Parameter:
    """The parameter of the lag: the last of a law, 0 where it is left out."""
    return Parameter(COIL, "s", 0.0, _SLOWEST_COIL, currents=2, default=0.0)


def coil_current(
    current: Array, time_constant: Array, period: float, before: tuple[Array, Array] | None
) -> Array:
    """Current [A] of the coil, shape (..., n), for the supply's (n,).

    ``time_constant`` (...) [s]; ``before``: the supply's and the coil's current of the sample
    before, None for a start at which both are the same.
    """
    every = np.broadcast_to(current, (*time_constant.shape, current.size))
    # A constant current, too: what a stream will need is loaded before it begins.
    constants = np.broadcast_to(time_constant[..., np.newaxis], every.shape)
    state = None if before is None else (*before, time_constant)
    return lagged(every, constants, period, state=state)


def few_in_coil(
    current: list[float], time_constant: float, period: float, before: tuple[float, float] | None
) -> tuple[list[float], tuple[float, float]]:
    """The same in plain numbers, and what is remembered: the supply's and the coil's current."""
    supplied, late = (current[0], current[0]) if before is None else before
    found = []
    for value in current:
        late = one_sample_later(value, time_constant, period, supplied, late, time_constant)
        supplied = value
        found.append(late)
    return found, (supplied, late)


def coil_state(remembered: tuple[Array, ...]) -> tuple[Array, Array] | None:
    """What a law remembers of supply and coil; None where its coil has not lagged so far."""
    return (remembered[0], remembered[1]) if remembered else None


def coil_shows(window: Window, time_constant: float) -> bool:
    """Whether a lag of so many seconds changes the current of a window, and its past is known."""
    has_past = (window.whole or window).period > 0.0
    return time_constant > 0.0 and has_past and not window.has_constant_current


def in_coil(window: Window, time_constant: float) -> Window:
    """The window with the current of the coil in place of the supply's."""
    if not coil_shows(window, time_constant):
        return window
    whole = window.whole or window
    late = coil_current(whole.current, np.array(time_constant), whole.period, None)
    if window.whole is None:
        return replace(window, current=late)
    assert window.places is not None
    current = np.interp(window.places, np.arange(late.size), late)
    return replace(window, current=current, whole=replace(whole, current=late))


def coil_unsettled(window: Window, time_constant: float) -> np.ndarray:
    """Mask (n,) of samples whose coil may still remember the current before the window."""
    if not coil_shows(window, time_constant):
        return np.zeros(window.sample_count, dtype=bool)
    return window.history.unsettled(SETTLING * time_constant)
