"""Samples of a rig, as a source gives them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS


class Moment(NamedTuple):
    """The motion of a suspension, upwards positive.

    Velocities of ``body`` and ``wheel`` [m/s], the body's ``acceleration`` [m/s²], and how far body
    and wheel are ``apart`` from where they rest [m], the wheel from the road (``tyre``) [m].
    """

    body: float
    wheel: float
    acceleration: float = 0.0
    apart: float = 0.0
    tyre: float = 0.0

    @property
    def extension(self) -> float:
        """Velocity [m/s] with which the damper extends."""
        return self.body - self.wheel


@dataclass(frozen=True, eq=False)
class RigBlock:
    """Samples that follow those before: ``displacement`` [m], ``force`` [N], ``current`` [A].

    Arrays have shape (n,), ``period`` [s] apart; ``start_ns`` is the stamp of sample 0,
    ``sequence`` its index since the start. ``temperature`` [°C] has shape (n,) too, NaN where it
    is not known; so is a current that the supply does not report. ``ahead_ns`` is how far
    a wrong clock of the samples is ahead, and ``supply_ahead_ns`` that of the supply beside it.
    ``suspension`` is the motion at the last sample where the damper is in one.
    """

    start_ns: int
    sequence: int
    period: float
    displacement: Array
    force: Array
    current: Array
    temperature: Array
    ahead_ns: int = 0
    supply_ahead_ns: int = 0
    suspension: Moment | None = None

    @property
    def sample_count(self) -> int:
        """Number of samples."""
        return self.force.size

    def stamp_ns(self, index: int) -> int:
        """Stamp [ns] of a sample."""
        return self.start_ns + round(index * self.period * NANOSECONDS)

    @property
    def due_ns(self) -> int:
        """When the last sample was measured, by a right clock [ns]; of no samples, the stamp."""
        return self.stamp_ns(max(self.sample_count - 1, 0)) - self.ahead_ns

    def without_samples(self) -> RigBlock:
        """A block with the stamp of the last sample and no samples: none of them was sent."""
        return replace(
            self,
            start_ns=self.stamp_ns(self.sample_count - 1),
            displacement=_NONE,
            force=_NONE,
            current=_NONE,
            temperature=_NONE,
        )


_NONE: Array = np.empty(0)
