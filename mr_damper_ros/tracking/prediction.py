"""What is predicted for a block of samples."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.uniform_grid import Placed
from mr_damper_ros.tracking.validity import Doubt


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted force [N], shape (n,), of the block's samples; ``doubt`` tells why not valid."""

    start_ns: int
    sequence: int
    period: float
    force: Array
    set_id: str
    doubt: Doubt
    continuity: str

    @property
    def valid(self) -> bool:
        """Whether there is no doubt."""
        return not self.doubt

    @property
    def reason(self) -> str:
        """The doubt in words; empty where it is valid."""
        return self.doubt.sentence

    def of_arrived(self, placed: Placed) -> Prediction:
        """The part for the samples that came, without those that were bridged."""
        return replace(
            self,
            start_ns=placed.stamp_ns,
            sequence=placed.arrived.sequence,
            force=self.force[placed.bridged :],
        )
