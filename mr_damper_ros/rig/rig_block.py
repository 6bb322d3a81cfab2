"""Samples of a rig, as a source gives them."""

from __future__ import annotations

from dataclasses import dataclass

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS


@dataclass(frozen=True, eq=False)
class RigBlock:
    """Samples that follow those before: ``displacement`` [m], ``force`` [N], ``current`` [A].

    Arrays have shape (n,), ``period`` [s] apart; ``start_ns`` is the stamp of sample 0,
    ``sequence`` its index since the start. ``temperature`` [°C] has shape (n,) too, NaN where it
    is not known; so is a current that the supply does not report. ``supply_ahead_ns``: how far
    the clock of the supply is ahead of that of the samples.
    """

    start_ns: int
    sequence: int
    period: float
    displacement: Array
    force: Array
    current: Array
    temperature: Array
    supply_ahead_ns: int = 0

    @property
    def sample_count(self) -> int:
        """Number of samples."""
        return self.force.size

    def stamp_ns(self, index: int) -> int:
        """Stamp [ns] of a sample."""
        return self.start_ns + round(index * self.period * NANOSECONDS)
