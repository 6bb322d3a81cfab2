"""Derivatives of samples by a local polynomial (Savitzky and Golay, 1964).

SciPy has the same filter, in a module that takes as long to load as all the rest that a fit needs:
the identifier's worker would be back the later after its end.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import polynomial

from mr_damper_ros.signals.arrays import Array


class SavitzkyGolay:
    """Least-squares polynomial of an ``order`` through ``length`` samples around each one.

    Raises ValueError where the length is even, or not above the order.
    """

    def __init__(self, length: int, order: int) -> None:
        if length % 2 == 0 or length <= order:
            raise ValueError(f"the length is {length}: it must be odd and above {order}, the order")
        self._half = length // 2
        # In units of half the length the powers are of one size.
        self._offsets = np.arange(-self._half, self._half + 1) / self._half
        self._fit = np.linalg.pinv(np.vander(self._offsets, order + 1, increasing=True))

    @property
    def kept(self) -> float:
        """Weight [1] of a sample in its own smoothed value."""
        return float(self._fit[0, self._half])

    def derivative(self, values: Array, order: int = 0, period: float = 1.0) -> Array:
        """Derivative (n,) of values (n,) that follow every ``period`` [s]; order 0 smooths them.

        Near the ends the polynomial of the first or last samples is taken.

        Raises ValueError where there are less values than the length.
        """
        length, half = self._offsets.size, self._half
        if values.size < length:
            raise ValueError(f"there are {values.size} values: at least {length} are needed")
        middle = math.factorial(order) * np.correlate(values, self._fit[order], "valid")
        begin, end = (
            polynomial.polyval(self._offsets, polynomial.polyder(self._fit @ part, order))
            for part in (values[:length], values[-length:])
        )
        result = np.concatenate((begin[:half], middle, end[half + 1 :]))
        return np.asarray(result / (half * period) ** order)
