"""First-order lags of sampled signals, such as the lag of the coil current behind the supply.

The time constant may change from sample to sample, as for a compliance in series with the damper.
The magnetic field, and with it the force, follows the current in the coil: du/dt = -eta (u - v) in
Spencer, Dyke, Sain and Carlson (1997), with the time constant 1/eta. At constant current the coil
has no lag.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.formulas import Formulas, staged
from mr_damper_ros.models.quantities import Parameter, State
from mr_damper_ros.signals.arrays import FEW, Array

LAG: Formulas = (
    ("mean_tau", "clip(0.5 * (tau_before + tau), 1e-9 * period, 1e9 * period)"),
    ("steps", "period / mean_tau"),
    ("kept", "exp(-steps)"),
    ("mean", "-expm1(-steps) / steps"),
    ("weight_before", "mean - kept"),
    ("weight_now", "1.0 - mean"),
    ("lagged", "weight_before * value_before + weight_now * value + kept * lagged_before"),
)
"""One step of a lag: time constants ``tau`` [s], a signal ``value``, and the ``lagged`` signal."""

_weights = staged(
    LAG,
    [("tau_before", "tau", "period")],
    ("mean_tau", "steps", "kept", "weight_before", "weight_now"),
)

one_sample_later = staged(
    LAG,
    [("value", "tau", "period", "value_before", "lagged_before", "tau_before")],
    ("lagged",),
    scalars=1,
)
"""The lagged signal at one sample in floating-point scalars."""


class FirstOrderLag:
    """First-order lag of signals sampled every ``period`` [s], along their first axis.

    ``time_constant`` (n,) [s] is given at the samples; between two samples their mean is used. The
    result is exact at any period if the time constant is constant and the signal linear between
    samples. With a time constant of 0 there is no lag. The lag starts settled or continues from
    ``state``, the previous sample, its lagged value and its time constant [s]; with ``periodic``
    the n samples are one period of the signal.
    """

    def __init__(
        self,
        time_constant: Array,
        period: float,
        *,
        periodic: bool = False,
        state: State | None = None,
    ) -> None:
        before = _one_earlier(time_constant)
        if state is not None:
            before[0] = state[2]
        elif not periodic:
            before[0] = time_constant[0]
        weights = _weights(before, time_constant, period)
        self._periodic, self._state = periodic, state
        self._tau, self._ratio, self._decay, self._before, self._now = weights

    def __call__(self, values: Array) -> Array:
        """The lagged signal, shape (n,), of a signal of shape (n,)."""
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
        """Derivatives (n, p) of the lagged signal, from derivatives of signal and time constant.

        ``values`` (n,) is the signal; ``lagged`` (n,) is the output of :meth:`__call__`.
        """
        mean_slope = self._before / self._tau
        decay_slope = self._decay * self._ratio / self._tau
        by_time_constant = (
            decay_slope * _one_earlier(lagged)
            + (mean_slope - decay_slope) * _one_earlier(values)
            - mean_slope * values
        )
        half = 0.5 * by_time_constant
        # Columns are contiguous in memory. Each step also depends on the previous sample.
        driven = (of_values.T * self._now + of_time_constant.T * half).T
        driven[1:] += (of_values[:-1].T * self._before[1:] + of_time_constant[:-1].T * half[1:]).T
        driven[0] += self._before[0] * of_values[-1] + half[0] * of_time_constant[-1]
        if not self._periodic:
            driven[0] = of_values[0]
        return self._recursion(driven)

    def _recursion(self, driven: Array) -> Array:
        result = solve_recursion(self._decay[np.newaxis, np.newaxis], driven)
        if self._periodic:
            passed = np.cumsum(self._ratio)
            before = result[-1] / -np.expm1(-passed[-1])
            result += np.multiply.outer(np.exp(-passed), before)
        return result


def solve_recursion(kept: Array, added: Array) -> Array:
    """Solve y[k] = kept[k] y[k-1] + added[k] for columns (n m, ...), which may be overwritten.

    The rows are n samples of m interleaved states; ``kept`` (m, m, n) are the derivatives of each
    state (rows) by the previous ones (columns).
    """
    from scipy.linalg.lapack import dtbtrs  # imported late: see entry_points

    if added.size == 0:
        return added  # without columns, dtbtrs of SciPy 1.17 corrupts the memory of the process
    states = len(kept)
    bands = np.zeros((2 * states, len(added)), order="F")
    bands[0] = 1.0
    for row, column in np.ndindex(states, states):
        bands[states + row - column, column:-states:states] = -kept[row, column, 1:]
    solved = dtbtrs(bands, added, uplo="L", diag="U", overwrite_b=True)[0]
    return np.asarray(solved.reshape(added.shape))


def _one_earlier(values: Array) -> Array:
    earlier = np.empty_like(values)
    earlier[:1], earlier[1:] = values[-1:], values[:-1]
    return earlier


def lagged(values: Array, time_constant: Array, period: float, state: State | None = None) -> Array:
    """Lag of signals of shape (..., n) along their last axis; see :class:`FirstOrderLag`.

    ``time_constant`` [s] has the same shape. ``state``: previous samples, their lagged values and
    their time constants, each of shape (...).
    """
    result = np.empty(values.shape)
    for place in np.ndindex(values.shape[:-1]):
        before = None if state is None else tuple(part[place] for part in state)
        result[place] = FirstOrderLag(time_constant[place], period, state=before)(values[place])
    return result


COIL = "coil_time_constant"
"""Name of the parameter for the coil's time constant [s]."""

PLAUSIBLE_COIL = 0.2
"""Largest plausible time constant of a coil [s]."""


def coil_parameter() -> Parameter:
    """The parameter of the coil's lag, the last one of a law; it is 0 if a file omits it."""
    return Parameter(COIL, "s", 0.0, 1.0, currents=2, default=0.0)


def coil_current(
    current: Array, time_constant: Array, period: float, state: State
) -> tuple[Array, State]:
    """Current [A] of the coil, shape (..., n), for the supply's current (n,), and the state.

    ``time_constant`` (...) [s]. The ``state`` is the current of supply and coil at the previous
    sample; it is empty for a start, at which both are equal.
    """
    if time_constant.ndim == 0 and current.size <= FEW:
        tau, values = float(time_constant), current.tolist()
        supplied, late = (float(part) for part in state) if state else (values[0], values[0])
        found = []
        for value in values:
            late = one_sample_later(value, tau, period, supplied, late, tau)
            supplied = value
            found.append(late)
        return np.array(found), (np.array(supplied), np.array(late))
    every = np.broadcast_to(current, (*time_constant.shape, current.size))
    # Constant currents are not an exception, so that all libraries are loaded before a stream
    # begins.
    constants = np.broadcast_to(time_constant[..., np.newaxis], every.shape)
    in_coil = lagged(every, constants, period, state=(*state, time_constant) if state else None)
    return in_coil, (every[..., -1], in_coil[..., -1])


def coil_shows(window: Window, time_constant: float) -> bool:
    """Whether a coil with this time constant [s] changes the current within a window."""
    has_past = (window.whole or window).period > 0.0
    return time_constant > 0.0 and has_past and not window.has_constant_current


def in_coil(window: Window, time_constant: float) -> Window:
    """The window with the coil current in place of the supply current."""
    if not coil_shows(window, time_constant):
        return window
    whole = window.whole or window
    late, _ = coil_current(whole.current, np.array(time_constant), whole.period, ())
    if window.whole is None:
        return replace(window, current=late)
    assert window.places is not None
    current = np.interp(window.places, np.arange(late.size), late)
    return replace(window, current=current, whole=replace(whole, current=late))
