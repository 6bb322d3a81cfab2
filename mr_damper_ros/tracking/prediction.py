"""What is predicted for a block of samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.signals.arrays import Array, Mask
from mr_damper_ros.signals.blocks import SampleBlock
from mr_damper_ros.signals.uniform_grid import Placed
from mr_damper_ros.tracking.validity import NO_DOUBT, Codes, Doubt


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted force [N], shape (n,), of the block's samples.

    ``doubts`` (n,): the :class:`DoubtKind` of each, and ``doubt`` that of the newest sample that is
    not valid.
    ``velocity`` [m/s], shape (n,), is what was estimated of the motion; NaN where nothing was.
    ``motion`` and ``current`` [A], a number where it is constant, are what the newest samples were
    predicted from; None where there was nothing to predict from.
    """

    start_ns: int
    sequence: int
    period: float
    force: Array
    velocity: Array
    set_id: str
    doubts: Codes
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
            doubts=np.full(block.sample_count, doubt.kind, dtype=np.uint8),
            doubt=doubt,
            continuity=continuity,
        )

    @classmethod
    def joined(cls, parts: Sequence[Prediction]) -> Prediction:
        """That of a block, from its parts in their order."""
        newest = parts[-1]
        if len(parts) == 1:
            return newest
        doubt = next((part.doubt for part in reversed(parts) if part.doubt), NO_DOUBT)
        return replace(
            newest,
            start_ns=parts[0].start_ns,
            sequence=parts[0].sequence,
            force=np.concatenate([part.force for part in parts]),
            velocity=np.concatenate([part.velocity for part in parts]),
            doubts=np.concatenate([part.doubts for part in parts]),
            doubt=doubt,
            continuity=parts[0].continuity,
        )

    @property
    def valid(self) -> bool:
        """Whether the force of all samples is valid."""
        return not self.doubt

    @property
    def valid_samples(self) -> Mask:
        """Whether the force of each sample is valid, shape (n,)."""
        return self.doubts == 0

    @property
    def newest_doubt(self) -> Doubt:
        """Why the force of the newest sample is not valid."""
        return self.doubt if self.doubts[-1] else NO_DOUBT

    @property
    def reason(self) -> str:
        """The doubt in words; empty where all samples are valid."""
        return self.doubt.sentence

    def at_its_samples(self, values: Array) -> Array:
        """Those of the values (m,) of a block that are at the predicted samples: its last n."""
        return values[-self.force.size :]

    def of_arrived(self, placed: Placed) -> Prediction:
        """The part for the samples that came, without those that were bridged."""
        doubts = self.doubts[placed.bridged :]
        return replace(
            self,
            start_ns=placed.stamp_ns,
            sequence=placed.arrived.sequence,
            force=self.force[placed.bridged :],
            velocity=self.velocity[placed.bridged :],
            doubts=doubts,
            doubt=self.doubt if doubts.any() else NO_DOUBT,
        )
