"""The force of a block before it is judged, and that of the blocks that are foreseen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.force_model import Ahead, ForceStream
from mr_damper_ros.models.quantities import State
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


@dataclass(eq=False)
class Foreseen:
    """What was reckoned for the next samples if the sine goes on and the current [A] stays.

    ``motion`` is that of the follower, of which ``first`` samples had come before; ``held`` is what
    the force was reckoned for, by the ``stream`` that is where it was then. ``count`` samples have
    been used since.
    """

    motion: Motion
    first: int
    held: Motion
    current: float
    ahead: Ahead
    doubt: ForceDoubt
    stream: ForceStream
    parameters: Array
    count: int = 0
    _memories: dict[int, State | None] = field(default_factory=dict)

    def use(self, came: int) -> Reckoned:
        """What was reckoned for the samples up to that one of the motion."""
        part = slice(self.count, came - self.first)
        self.count = came - self.first
        doubt = self.doubt._replace(size=self.doubt.size.part(part))
        return Reckoned(self.ahead.force[part], True, doubt, self.current)

    def memory_after(self, count: int) -> State | None:
        """What the law remembers after so many of the samples; of more than there are, after all.

        It goes on from where it was asked for before.
        """
        if not self._memories:
            self._memories = {0: self.stream.state, self.ahead.force.size: self.ahead.state}
        count = min(count, self.ahead.force.size)
        if count not in self._memories:
            first = max(known for known in self._memories if known < count)
            part = self.held.part(slice(first, count))
            self._memories[count] = self.stream.state_after(
                self.parameters, part, self.current, self._memories[first]
            )
        return self._memories[count]
