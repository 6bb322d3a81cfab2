"""Error of a prediction over the last seconds of a stream."""

from __future__ import annotations

from collections import deque

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.error_sums import ErrorSums, pooled


class RunningError:
    """NRMSE (RMSE/std of the measurement) over the last ``memory`` seconds of samples."""

    def __init__(self, memory: float) -> None:
        self._memory = memory
        self._blocks: deque[tuple[float, ErrorSums]] = deque()
        self._duration = 0.0

    def add(self, predicted: Array, measured: Array, period: float) -> None:
        """Add a block of samples ``period`` [s] apart; arrays of shape (n,), same unit."""
        duration = measured.size * period
        self._blocks.append((duration, ErrorSums.of(predicted, measured)))
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
        return pooled(sums for _, sums in self._blocks).nrmse
