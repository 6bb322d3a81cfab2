"""Noise that remembers: its autocovariance, and what it does to sums of many samples.

The noise of a fit is what its residual holds. It is described by an autoregression, whose order is
chosen by Schwarz' criterion and whose coefficients are Burg's ("Maximum entropy spectral
analysis", 1967): white noise has order 0, the noise of an amplifier order 1, what a law leaves of a
force a few more. Few samples determine it far better than they determine the sum of their own
autocovariances, and no spectrum becomes negative.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.signals.arrays import Array

_HIGHEST_ORDER = 24

_PATIENCE = 8
"""So many higher orders are tried in vain before the search ends."""

_SAMPLES_PER_ORDER = 10
"""An autoregression of n samples has at most the n-th part of this as its order."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Stationary noise x of an autoregression, x[t] + sum_k ``coefficients``[k-1] x[t-k] = e[t].

    e is white and has the variance ``innovation``; ``variance`` is that of x. ``coefficients`` has
    shape (order,).
    """

    coefficients: Array
    innovation: float
    variance: float

    @classmethod
    def of(cls, series: Array, highest_order: int = _HIGHEST_ORDER) -> NoiseModel:
        """The noise of samples (n,) of mean zero, equally spaced."""
        count = series.size
        variance = float(series @ series) / max(count, 1)
        coefficients = best = np.empty(0)
        innovation = least = variance
        chosen = math.inf
        forward = backward = np.asarray(series, dtype=float)
        for order in range(min(highest_order, count // _SAMPLES_PER_ORDER) + 1):
            if order > 0:
                ahead, behind = forward[1:], backward[:-1]
                power = float(ahead @ ahead + behind @ behind)
                if not power > 0.0:
                    break
                reflection = -2.0 * float(ahead @ behind) / power
                padded = np.append(coefficients, 0.0)
                coefficients = padded + reflection * np.append(coefficients[::-1], 1.0)
                forward = ahead + reflection * behind
                backward = behind + reflection * ahead
                innovation *= max(1.0 - reflection**2, 0.0)
            if not innovation > 0.0:
                break
            criterion = count * math.log(innovation) + order * math.log(max(count, 2))
            if criterion < chosen:
                chosen, best, least = criterion, coefficients, innovation
            elif order > best.size + _PATIENCE:
                break
        return cls(best, least, variance)

    @property
    def white(self) -> bool:
        """Whether no sample tells anything of the next."""
        return self.coefficients.size == 0

    @property
    def integrated_time(self) -> float:
        """Integrated autocorrelation time [samples]: 1 of white noise.

        The mean of n samples has the variance of n / this many independent ones.
        """
        if self.white or self.variance == 0.0:
            return 1.0
        level = self.innovation / (1.0 + float(np.sum(self.coefficients))) ** 2
        return level / self.variance

    def score_covariance(self, columns: Array) -> Array:
        """Covariance (p, p) of columnsᵀ x for columns of shape (n, p)."""
        if self.white:
            return np.asarray(self.variance * (columns.T @ columns))
        count = columns.shape[0]
        size = 1 << (2 * count - 1).bit_length()
        polynomial = np.fft.rfft(np.append(1.0, self.coefficients), size)
        spectrum = self.innovation / np.abs(polynomial) ** 2
        # Of the two halves of the spectrum only one is computed.
        twice = np.full(spectrum.size, 2.0 / size)
        twice[[0, -1]] = 1.0 / size
        transformed = np.fft.rfft(columns, size, axis=0)
        weighted = transformed * (spectrum * twice)[:, np.newaxis]
        return np.asarray((transformed.conj().T @ weighted).real)
