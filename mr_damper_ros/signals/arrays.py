"""The type of every array of numbers in this package, two measures, and the newest of a stream."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of doubles; its shape is told where it is used."""


Mask = NDArray[np.bool_]
"""One truth value for each sample."""


def span_of(values: Array) -> tuple[float, float]:
    """Lowest and highest of some numbers (n,); of a single one in a tenth of NumPy's time."""
    if values.size == 1:
        only = float(values[0])
        return only, only
    return float(values.min()), float(values.max())


NOISE_SPAN = 8.0
"""Standard deviations that the white noise of a long signal spans."""

NORMAL_MEDIAN = 0.6745
"""Median size of a normal number over its standard deviation."""


def white_noise(values: Array) -> float:
    """Standard deviation of the white part of a signal (n,), in its unit; 0 for n < 5.

    From fourth differences, which a smooth signal leaves almost nothing of; the median makes it
    robust against kinks and jumps.
    """
    if values.size < 5:
        return 0.0
    # The sum of the squared binomial coefficients of the fourth difference is 70.
    return float(np.median(np.abs(np.diff(values, 4))) / NORMAL_MEDIAN / math.sqrt(70.0))


_LEAST_ROOM = 1024


class RollingRows:
    """The newest columns of a table of so many rows: adding and dropping cost what they hold."""

    def __init__(self, rows: int) -> None:
        self._table = np.empty((rows, _LEAST_ROOM))
        self._begin = self._end = 0

    @property
    def newest(self) -> Array:
        """All that is kept, of shape (rows, n), oldest first; to be read at once."""
        return self._table[:, self._begin : self._end]

    @property
    def count(self) -> int:
        """Number of columns that are kept."""
        return self._end - self._begin

    def add(self, rows: Sequence[Array | float], count: int) -> None:
        """Add so many columns: of each row an array (count,), or a number for all."""
        if self._end + count > self._table.shape[1]:
            kept = self.newest
            # Twice what is needed: then a column is moved once on average, however few are added.
            self._table = np.empty((len(kept), max(2 * (self.count + count), _LEAST_ROOM)))
            self._begin, self._end = 0, kept.shape[1]
            self.newest[:] = kept
        for row, values in zip(self._table, rows, strict=True):
            row[self._end : self._end + count] = values
        self._end += count

    def keep(self, most: int) -> None:
        """Drop all but the newest so many columns."""
        self._begin = max(self._begin, self._end - most)
