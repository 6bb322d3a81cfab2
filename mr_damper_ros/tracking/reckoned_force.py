"""The force of a block before it is judged, and that of the blocks that are foreseen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.force_stream import Ahead
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.validity import Doubt


class ForceDoubt(NamedTuple):
    """Whether the parameters hold for a ``current`` and for a ``motion`` and its force."""

    current: Doubt
    motion: Doubt


@dataclass(frozen=True, eq=False)
class Reckoned:
    """Force [N] of a motion, whether it is finite, why to doubt it, and the current [A]."""

    force: Array
    finite: bool
    doubt: ForceDoubt
    current: Array | float


@dataclass(eq=False)
class Foreseen:
    """What was reckoned for the next samples if the sine goes on and the current [A] stays.

    ``motion`` is that of the follower, of which ``first`` samples had come before; ``held`` is what
    the force was reckoned for. ``count`` samples have been used since.
    """

    motion: Motion
    first: int
    held: Motion
    current: float
    ahead: Ahead
    doubt: ForceDoubt
    count: int = 0

    def use(self, came: int) -> Array:
        """Force [N] of the samples up to that one of the motion."""
        part = slice(self.count, came - self.first)
        self.count = came - self.first
        return self.ahead.force[part]
