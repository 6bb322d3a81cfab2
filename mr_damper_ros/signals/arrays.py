"""The array types of this package, basic measures of arrays, and a rolling buffer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
"""Array of doubles; the shape is stated where the type is used."""


Positive = Annotated[float, "positive"]
"""A number above zero, which the reader of a stored state checks."""

Mask = NDArray[np.bool_]
"""Array of booleans, one for each sample."""


FEW = 64
"""Number of samples up to which scalar code is faster. NumPy takes a microsecond for each
operation, even on short arrays."""

_LARGEST = 1e12
"""Largest magnitude of a sample, in SI units: no machine reaches it, and no product overflows."""


def usable(values: Array) -> Mask:
    """Mask (n,) of the values that are finite and at most 1e12 in magnitude.

    Instruments send 9.91e37 for a missing value. LAPACK may never return from an infinity.
    """
    return np.asarray(np.abs(values) <= _LARGEST)


def all_usable(values: Array) -> bool:
    """Whether all values (n,) are usable, with a fast path for a few samples."""
    if values.size <= FEW and sum(map(abs, values.tolist())) <= _LARGEST:
        return True
    return bool(usable(values).all())


def samples_of(values: ArrayLike) -> Array:
    """A copy of values (n,) as doubles; masked values, which were not measured, become NaN.

    Raises ValueError for complex values, of which NumPy would drop the imaginary part.
    """
    given: Any = np.ma.array(values, copy=True)
    if given.dtype.kind == "c":
        raise ValueError("the samples are complex numbers: give real ones")
    return np.asarray(given.astype(np.float64).filled(np.nan))


def span_of(values: Array) -> tuple[float, float]:
    """Minimum and maximum of values (n,), n > 0, that are no NaN; with a fast path for a few."""
    if values.size <= FEW:
        few = values.tolist()
        return min(few), max(few)
    return float(values.min()), float(values.max())


def largest_magnitude(values: Array) -> float:
    """Largest magnitude of values (n,), n > 0, that are no NaN."""
    lowest, highest = span_of(values)
    return max(-lowest, highest)


NOISE_SPAN = 8.0
"""Span of the white noise in a long signal, in standard deviations."""

NORMAL_MEDIAN = NormalDist().inv_cdf(0.75)
"""Median absolute value of a normal variable over its standard deviation."""


SIGMAS = 3.0
"""Deviation, in standard errors, that chance rarely causes."""

NEGLIGIBLE = 0.01
"""A contribution below this part of the whole is negligible. The past counts as forgotten once it
changes the force by less than this part of the span of the force."""

MOST_ITERATIONS = 60
"""Limit of iterations that converge in far fewer steps."""


def noise_power(values: Array, order: int = 4) -> float:
    """Power of the white part of a signal (n,), n > order, from its differences of this order.

    The differences contain almost nothing of a smooth signal. Their mean square includes bursts of
    noise and the steps of a digital sensor, which a median would exclude.
    """
    changes = np.diff(values, order)
    # The power of differences of white noise is the sum of the squared binomial coefficients.
    return float(changes @ changes) / changes.size / math.comb(2 * order, order)


def white_noise(values: Array) -> float:
    """Standard deviation of the white part of a signal (n,), in its unit; 0 for n < 5.

    The median makes this estimate robust against kinks and jumps; see :func:`noise_power`.
    """
    if values.size < 5:
        return 0.0
    return float(np.median(np.abs(np.diff(values, 4))) / NORMAL_MEDIAN / math.sqrt(math.comb(8, 4)))


class RollingRows:
    """Rolling buffer for the newest columns of a table with a fixed number of rows.

    The cost of adding is proportional to the number of added columns, on average.
    """

    def __init__(self, rows: int) -> None:
        self._table = np.empty((rows, 0))
        self._begin = self._end = 0

    @property
    def newest(self) -> Array:
        """All kept columns, shape (rows, n), oldest first: a view, valid until the next call."""
        return self._table[:, self._begin : self._end]

    @property
    def count(self) -> int:
        """Number of kept columns."""
        return self._end - self._begin

    def add(self, rows: Sequence[Array | float], count: int) -> None:
        """Add ``count`` columns, given as an array (count,) or one number for each row."""
        if self._end + count > self._table.shape[1]:
            kept = self.newest
            # With twice the space needed, each column is moved about once.
            self._table = np.empty((len(kept), 2 * (self.count + count)))
            self._begin, self._end = 0, kept.shape[1]
            self.newest[:] = kept
        for row, values in zip(self._table, rows, strict=True):
            row[self._end : self._end + count] = values
        self._end += count

    def keep(self, most: int) -> None:
        """Drop all but the newest ``most`` columns."""
        self._begin = max(self._begin, self._end - most)
