"""What is predicted for a block of samples."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.uniform_grid import Placed
from mr_damper_ros.tracking.validity import Doubt


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted force [N], shape (n,), of the block's samples; ``doubt`` tells why not valid.

    ``velocity`` [m/s], shape (n,), is what was estimated of the motion; NaN where nothing was.
    ``motion`` and ``current`` [A], a number where it is constant, are what it was predicted from,
    those of samples that were bridged before the block included; None where there was nothing to
    predict from.
    """

    start_ns: int
    sequence: int
    period: float
    force: Array
    velocity: Array
    set_id: str
    doubt: Doubt
    continuity: str
    motion: Motion | None = None
    current: Array | float | None = None

    @classmethod
    def without_force(
        cls,
        block: SampleBlock,
        set_id: str,
        doubt: Doubt,
        continuity: str,
        velocity: Array | None = None,
    ) -> Prediction:
        """That of a block for which there is no force: NaN at every sample."""
        unknown = np.full(block.sample_count, np.nan)
        return cls(
            start_ns=block.start_ns,
            sequence=block.sequence,
            period=block.period,
            force=unknown,
            velocity=unknown if velocity is None else velocity,
            set_id=set_id,
            doubt=doubt,
            continuity=continuity,
        )

    @property
    def valid(self) -> bool:
        """Whether there is no doubt."""
        return not self.doubt

    @property
    def reason(self) -> str:
        """The doubt in words; empty where it is valid."""
        return self.doubt.sentence

    def at_its_samples(self, values: Array) -> Array:
        """Those of the values (m,) of a block that are at the predicted samples: its last n."""
        return values[-self.force.size :]

    def of_arrived(self, placed: Placed) -> Prediction:
        """The part for the samples that came, without those that were bridged."""
        return replace(
            self,
            start_ns=placed.stamp_ns,
            sequence=placed.arrived.sequence,
            force=self.force[placed.bridged :],
            velocity=self.velocity[placed.bridged :],
        )
