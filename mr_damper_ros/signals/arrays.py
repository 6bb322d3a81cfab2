"""The type of every array of numbers in this package."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of doubles; its shape is told where it is used."""
