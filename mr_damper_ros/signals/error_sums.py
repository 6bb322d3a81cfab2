"""Error of a prediction relative to a measurement: RMSE, NRMSE and R², defined in one place.

NRMSE is the RMSE over the standard deviation of the measurement, both over the same samples. The
NRMSE of several records pools all their samples; it is not the mean of their NRMSE.
"""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from mr_damper_ros.signals.arrays import Array


@dataclass(frozen=True)
class ErrorSums:
    """Sums over samples: their ``count``, the measurement, its square and the squared error.

    The sums of two sets of samples can be added.
    """

    count: int = 0
    measured: float = 0.0
    measured_square: float = 0.0
    squared_error: float = 0.0

    @classmethod
    def of(cls, predicted: Array, measured: Array) -> ErrorSums:
        """Sums for a prediction and a measurement, arrays of shape (n,) in the same unit."""
        error = predicted - measured
        return cls(
            measured.size, float(measured.sum()), float(measured @ measured), float(error @ error)
        )

    def __add__(self, other: ErrorSums) -> ErrorSums:
        return ErrorSums(
            self.count + other.count,
            self.measured + other.measured,
            self.measured_square + other.measured_square,
            self.squared_error + other.squared_error,
        )

    @property
    def rmse(self) -> float:
        """Root mean squared error, in the unit of the measurement; NaN without samples."""
        return math.sqrt(self.squared_error / self.count) if self.count else math.nan

    @property
    def spread(self) -> float:
        """Standard deviation of the measurement; NaN without samples, 0 if it is constant."""
        if not self.count:
            return math.nan
        mean_square = self.measured_square / self.count
        variance = mean_square - (self.measured / self.count) ** 2
        # For a constant measurement, the difference of the sums is only their rounding error.
        rounding = self.count * sys.float_info.epsilon * mean_square
        return math.sqrt(variance) if variance > rounding else 0.0

    @property
    def nrmse(self) -> float:
        """RMSE over the standard deviation; NaN without samples or variation."""
        spread = self.spread
        return self.rmse / spread if spread > 0.0 else math.nan

    @property
    def r2(self) -> float:
        """Explained fraction of the variance of the measurement, 1 − NRMSE²."""
        return 1.0 - self.nrmse**2


def pooled(sums: Iterable[ErrorSums]) -> ErrorSums:
    """The sums over all samples of several records."""
    return sum(sums, start=ErrorSums())


class RunningError:
    """NRMSE (RMSE/std of the measurement) over the last ``memory`` seconds of samples."""

    def __init__(self, memory: float) -> None:
        self._memory = memory
        self._blocks: deque[tuple[float, ErrorSums]] = deque()
        self.duration = 0.0
        """Duration of the samples [s], at least ``memory`` once there are enough."""

    def add(self, predicted: Array, measured: Array, period: float) -> None:
        """Add a block of samples ``period`` [s] apart; arrays of shape (n,), same unit."""
        duration = measured.size * period
        self._blocks.append((duration, ErrorSums.of(predicted, measured)))
        self.duration += duration
        # The remaining blocks must still span the memory.
        while self.duration - self._blocks[0][0] > (1.0 - 1e-9) * self._memory:
            self.duration -= self._blocks.popleft()[0]

    @property
    def nrmse(self) -> float:
        """RMSE over the standard deviation; NaN without samples or variation."""
        return pooled(sums for _, sums in self._blocks).nrmse
