"""Whether a machine moves as it was told: measured displacement against a motion that repeats."""

from __future__ import annotations

import numpy as np

from mr_damper_ros.kinematics.periodic_motion import PeriodicMotion
from mr_damper_ros.signals.arrays import Array


class RepeatedMatch:
    """Compares samples ``period`` [s] apart with a motion, wherever in it they begin."""

    def __init__(self, motion: PeriodicMotion, period: float) -> None:
        self.count = max(round(motion.length / period), 2)
        self._wanted, _, _ = motion.at(
            np.arange(self.count, dtype=np.float64) * (motion.length / self.count)
        )

    def left_of(self, displacement: Array) -> float:
        """What is left of the motion wanted (root mean square, relative), where it fits best.

        The samples (n,) are about any centre, and last at least as long as the motion.
        """
        size = displacement.size
        centred = displacement - 0.5 * (displacement.max() + displacement.min())
        wanted = self._wanted - 0.5 * (self._wanted.max() + self._wanted.min())
        repeated = np.resize(wanted, self.count + size)
        length = 1 << (repeated.size + size).bit_length()
        spectrum = np.fft.rfft(repeated, length) * np.conj(np.fft.rfft(centred, length))
        common = np.fft.irfft(spectrum, length)[: self.count]
        squares = np.concatenate([[0.0], np.cumsum(repeated**2)])
        power = squares[size : size + self.count] - squares[: self.count]
        left = float(np.min(power - 2.0 * common)) + float(centred @ centred)
        typical = size * float(np.mean(wanted**2))
        return float(np.sqrt(max(left, 0.0) / typical))
