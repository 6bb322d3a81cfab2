"""Velocity and acceleration of a stream of displacement samples, from the past alone.

An observer of a motion with piecewise constant jerk (the steady state of a Kalman filter with
white snap) with four equal poles. It is linear and time-invariant, so it runs over a block as
three recursive filters that keep their state between blocks. For a polynomial motion up to third
order it has no delay and no error. For a sinusoid of frequency f the relative error falls with f
over the bandwidth: displacement with the fourth power, velocity with the third, acceleration with
the second.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import lfilter

from mr_damper_ros.damper.sigmoid import Array

_ORDER = 4
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
        lowest, highest = possible_bandwidths(period)
        if not lowest <= bandwidth <= highest:
            raise ValueError(
                f"the bandwidth is {bandwidth:g} Hz: samples {period:g} s apart allow "
                f"{lowest:g} to {highest:g} Hz"
            )
        pole = math.exp(-2.0 * math.pi * bandwidth * period)
        self._denominator = np.asarray(np.poly(np.full(_ORDER, pole)), dtype=float)
        self._numerators = _numerators(self._denominator, period)
        self._states = [np.zeros(_ORDER) for _ in self._numerators]
        self._settling = math.ceil(_SETTLING / (2.0 * math.pi * bandwidth * period))
        self.reset()

    def reset(self) -> None:
        """Forget the past: the next sample is the first."""
        self._seen = 0
        self._origin = 0.0
        for state in self._states:
            state[:] = 0.0

    @property
    def settled(self) -> bool:
        """Whether the transient of the start has died away."""
        return self._seen >= self._settling

    def follow(self, displacement: Array) -> tuple[Array, Array, Array]:
        """Displacement [m], velocity [m/s] and acceleration [m/s²] at the samples, shape (n,)."""
        if self._seen == 0:
            # The motion is counted from its first sample: no step at the start.
            self._origin = float(displacement[0])
        centred = np.asarray(displacement, dtype=float) - self._origin
        outputs = []
        for index, numerator in enumerate(self._numerators):
            output, self._states[index] = lfilter(
                numerator, self._denominator, centred, zi=self._states[index]
            )
            outputs.append(output)
        self._seen += centred.size
        return outputs[0] + self._origin, outputs[1], outputs[2]


def _numerators(denominator: Array, period: float) -> list[Array]:
    """Transfer functions from the measured to the estimated displacement and derivatives.

    They follow from x+ = (1 - L C) F x + L y, where F integrates a constant jerk and L places
    all poles; each numerator is read off the first samples of the impulse response.
    """
    powers = [period**k / math.factorial(k) for k in range(_ORDER)]
    advance = np.zeros((_ORDER, _ORDER))
    for row in range(_ORDER):
        advance[row, row:] = powers[: _ORDER - row]
    output = np.eye(_ORDER)[0]
    # Ackermann's formula for the predictor gain F L, from the wanted characteristic polynomial.
    polynomial = sum(
        weight * np.linalg.matrix_power(advance, _ORDER - k) for k, weight in enumerate(denominator)
    )
    observability = np.vstack([output @ np.linalg.matrix_power(advance, k) for k in range(_ORDER)])
    predictor_gain = polynomial @ np.linalg.solve(observability, np.eye(_ORDER)[-1])
    gain = np.linalg.solve(advance, predictor_gain)
    closed = (np.eye(_ORDER) - np.outer(gain, output)) @ advance
    responses = np.empty((_ORDER + 1, _ORDER))
    state = gain.copy()
    for k in range(_ORDER + 1):
        responses[k] = state
        state = closed @ state
    return [
        np.convolve(denominator, responses[:, derivative])[: _ORDER + 1] for derivative in range(3)
    ]
