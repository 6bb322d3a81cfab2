"""Velocity and acceleration of a stream of displacement samples, from the past alone.

An observer of a motion with piecewise constant jerk (the steady state of a Kalman filter with
white snap) with four equal poles. It is linear and time-invariant: what it says of a block is one
matrix times the block plus another times its state before. For a polynomial
motion up to third
order it has no delay and no error. For a sinusoid of frequency f the relative error falls with f
over the bandwidth: displacement with the fourth power, velocity with the third, acceleration with
the second.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array

_ORDER = 4
_STRETCH = 64
"""Samples that are followed at once."""

_SETTLING = 12.0
"""Time constants of the poles after which the start is forgotten to a thousandth."""


def possible_bandwidths(period: float) -> tuple[float, float]:
    """Lowest and highest bandwidth [Hz] of the observer for samples ``period`` [s] apart.

    Above a quarter of the sample rate it would not filter; far below, four poles next to 1 need
    more digits than double precision has.
    """
    return 2e-4 / period, 0.25 / period


class CausalDifferentiator:
    """Displacement, velocity and acceleration of a stream, sample by sample, block by block.

    ``period`` [s] is the sample period, ``bandwidth`` [Hz] the corner of the observer.

    Raises ValueError where the bandwidth lies outside of :func:`possible_bandwidths`.
    """

    def __init__(self, period: float, bandwidth: float) -> None:
        self._period = period
        self.tune(bandwidth)
        self._settling = settling_samples(period, bandwidth)
        self.reset()

    def tune(self, bandwidth: float) -> None:
        """Go on from the present state with another bandwidth [Hz]; ValueError as at the start."""
        lowest, highest = possible_bandwidths(self._period)
        if not lowest <= bandwidth <= highest:
            raise ValueError(
                f"the bandwidth is {bandwidth:g} Hz: samples {self._period:g} s apart allow "
                f"{lowest:g} to {highest:g} Hz"
            )
        self._decays, self._responses = _observer(self._period, bandwidth)
        self._closed, self._gain = self._decays[:, 0].copy(), self._responses[:, 0, 0].copy()

    def reset(self) -> None:
        """Forget the past: the next sample is the first."""
        self._seen = 0
        self._origin = 0.0
        self._state = np.zeros(_ORDER)

    @property
    def settled(self) -> bool:
        """Whether the transient of the start has died away."""
        return self._seen >= self._settling

    def follow(self, displacement: Array) -> tuple[Array, Array, Array]:
        """Displacement [m], velocity [m/s] and acceleration [m/s²] at the samples, shape (n,)."""
        if self._seen == 0:
            # The motion is counted from its first sample: no step at the start.
            self._origin = float(displacement[0])
        if displacement.size == 1:
            return self._follow_one(float(displacement[0]))
        centred = np.asarray(displacement, dtype=float) - self._origin
        outputs = np.empty((_ORDER, centred.size))
        for first in range(0, centred.size, _STRETCH):
            part = centred[first : first + _STRETCH]
            states = self._decays[:, : part.size] @ self._state
            states += self._responses[:, : part.size, : part.size] @ part
            outputs[:, first : first + part.size] = states
            self._state = states[:, -1]
        self._seen += centred.size
        return outputs[0] + self._origin, outputs[1], outputs[2]

    def _follow_one(self, displacement: float) -> tuple[Array, Array, Array]:
        self._state = state = self._closed @ self._state + self._gain * (
            displacement - self._origin
        )
        self._seen += 1
        return state[0:1] + self._origin, state[1:2], state[2:3]


class NoiseGains(NamedTuple):
    """What an observer makes of white noise of the displacement of standard deviation 1 m.

    Standard deviations of the ``acceleration`` [m/s²] and of the ``residual`` [m], displacement
    less what the observer makes of it.
    """

    acceleration: float
    residual: float


@lru_cache(maxsize=256)
def noise_gains(period: float, bandwidth: float) -> NoiseGains:
    """Gains of the observer of this sample period [s] and bandwidth [Hz]."""
    closed, gain = closed_loop(period, bandwidth)
    # The power of the states' noise: P = A P A' + g g', by doubling.
    power, step = np.outer(gain, gain), closed
    for _ in range(40):
        power, step = power + step @ power @ step.T, step @ step
    return NoiseGains(
        acceleration=math.sqrt(power[2, 2]),
        residual=math.sqrt(max(1.0 - 2.0 * gain[0] + power[0, 0], 0.0)),
    )


def settling_samples(period: float, bandwidth: float) -> int:
    """Samples after which the start of the observer is forgotten."""
    return math.ceil(_SETTLING / (2.0 * math.pi * bandwidth * period))


def closed_loop(period: float, bandwidth: float) -> tuple[Array, Array]:
    """Matrix (4, 4) and gain (4,) of the states: x+ = A x + g y.

    They follow x+ = (1 - L C) F x + L y, where F integrates a constant jerk and L places all poles.
    """
    powers = [period**k / math.factorial(k) for k in range(_ORDER)]
    advance = np.zeros((_ORDER, _ORDER))
    for row in range(_ORDER):
        advance[row, row:] = powers[: _ORDER - row]
    output = np.eye(_ORDER)[0]
    # Ackermann's formula for the predictor gain F L, from the wanted characteristic polynomial.
    pole = math.exp(-2.0 * math.pi * bandwidth * period)
    polynomial = sum(
        weight * np.linalg.matrix_power(advance, _ORDER - k)
        for k, weight in enumerate(np.poly(np.full(_ORDER, pole)))
    )
    observability = np.vstack([output @ np.linalg.matrix_power(advance, k) for k in range(_ORDER)])
    predictor_gain = polynomial @ np.linalg.solve(observability, np.eye(_ORDER)[-1])
    gain = np.linalg.solve(advance, predictor_gain)
    return (np.eye(_ORDER) - np.outer(gain, output)) @ advance, gain


@lru_cache(maxsize=64)
def _observer(period: float, bandwidth: float) -> tuple[Array, Array]:
    """What each of the next samples' states owes to the state before, and to those samples.

    Shapes (4, m, 4) and (4, m, m), the second lower triangular in the samples.
    """
    closed, gain = closed_loop(period, bandwidth)
    decays = np.empty((_ORDER, _STRETCH, _ORDER))
    impulses = np.empty((_ORDER, _STRETCH))
    impulse, power = gain, closed
    for sample in range(_STRETCH):
        decays[:, sample], impulses[:, sample] = power, impulse
        impulse, power = closed @ impulse, closed @ power
    later = np.subtract.outer(np.arange(_STRETCH), np.arange(_STRETCH))
    return decays, np.where(later >= 0, impulses[:, later], 0.0)
