"""Samples by which a set is judged: their motion, current and forces, piece by piece."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.signals.arrays import Array

_ALL = slice(None)


@dataclass(frozen=True, eq=False)
class JudgedSamples:
    """Motion, current [A], predicted and measured force [N], each (n,); every ``stride``-th one.

    The measured force is NaN at samples that were bridged.
    """

    motion: Motion
    current: Array
    predicted: Array
    measured: Array
    stride: int = 1

    @classmethod
    def of(
        cls, motion: Motion, current: Array | float, forces: tuple[Array, Array], bridged: int
    ) -> JudgedSamples:
        """Samples of which the first were ``bridged``; predicted and measured ``forces`` [N]."""
        predicted, measured = forces
        if bridged:
            measured = np.concatenate([np.full(bridged, np.nan), measured[bridged:]])
        return cls(motion, np.broadcast_to(current, measured.shape), predicted, measured)

    @classmethod
    def joined(cls, parts: Sequence[JudgedSamples], stride: int = 1) -> JudgedSamples:
        """Samples that follow each other, every so many of them."""

        def row(arrays: list[Array]) -> Array:
            return np.concatenate(arrays)[::stride]

        return cls(
            Motion.joined([part.motion for part in parts]).part(slice(None, None, stride)),
            row([part.current for part in parts]),
            row([part.predicted for part in parts]),
            row([part.measured for part in parts]),
            stride,
        )

    def left_by(self, force: Array, part: slice = _ALL) -> Array:
        """What a force (n,) [N] leaves of the measured one, at the measured samples of a part."""
        measured = self.measured[part]
        return np.asarray((force[part] - measured)[~np.isnan(measured)])
