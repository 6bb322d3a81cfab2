"""Error of a prediction over the last seconds of a stream."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from mr_damper_ros.signals.arrays import Array


class RunningError:
    """NRMSE (RMSE/std of the measurement) over the last ``memory`` seconds of samples."""

    def __init__(self, memory: float) -> None:
        self._memory = memory
        self._blocks: deque[tuple[float, Array]] = deque()
        self._duration = 0.0

    def add(self, predicted: Array, measured: Array, period: float) -> None:
        """Add a block of samples ``period`` [s] apart; arrays of shape (n,), same unit."""
        error = predicted - measured
        # Number of samples, sums of the measurement, its square and the squared error.
        sums = np.array([measured.size, measured.sum(), measured @ measured, error @ error])
        duration = measured.size * period
        self._blocks.append((duration, sums))
        self._duration += duration
        # What is left must still span the memory, up to rounding.
        while self._duration - self._blocks[0][0] > (1.0 - 1e-9) * self._memory:
            self._duration -= self._blocks.popleft()[0]

    def reset(self) -> None:
        """Forget everything."""
        self._blocks.clear()
        self._duration = 0.0

    @property
    def nrmse(self) -> float:
        """RMSE/std of the measurement; NaN where there is nothing to compare or no variation."""
        if not self._blocks:
            return math.nan
        count, total, squares, errors = np.sum([sums for _, sums in self._blocks], axis=0)
        variance = squares / count - (total / count) ** 2
        # Rounding leaves a trace of variance in a constant.
        if not variance > 1e-12 * squares / count:
            return math.nan
        return math.sqrt(errors / count / variance)
