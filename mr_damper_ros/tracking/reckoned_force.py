"""The force of a block before it is judged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.validity import Doubt


class ForceDoubt(NamedTuple):
    """Whether the parameters hold for a ``current``, a ``size`` of the force and a ``speed``."""

    current: Doubt
    size: Doubt
    speed: Doubt


@dataclass(frozen=True, eq=False)
class Reckoned:
    """Force [N] of a motion, whether it is finite, why to doubt it, and the current [A]."""

    force: Array
    finite: bool
    doubt: ForceDoubt
    current: Array | float


class Unlearned(NamedTuple):
    """What is yet to be learnt from a block, of samples ``period`` [s] apart.

    Predicted and measured force [N], motion, the current [A], and whether the force could be
    ``known``. That of the first ``bridged`` samples was not measured.
    """

    forces: tuple[Array, Array]
    motion: Motion
    current: Array | float
    known: bool
    period: float
    bridged: int

    @property
    def measured(self) -> tuple[tuple[Array, Array], Array, Array | float]:
        """Forces [N], velocity [m/s] and current of the samples whose force was measured."""
        part, current = slice(self.bridged, None), self.current
        if not isinstance(current, float):
            current = current[part]
        return (self.forces[0][part], self.forces[1][part]), self.motion.velocity[part], current
