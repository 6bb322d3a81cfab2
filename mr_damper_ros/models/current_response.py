"""Force of a law over the current in the coil, at samples of a motion: what an inverse needs.

The coil's lag is no part of it: an inverse finds the current of the coil, and how the supply
brings it there is another matter.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np

from mr_damper_ros.kinematics.motion import MotionSample
from mr_damper_ros.models.quantities import State
from mr_damper_ros.signals.arrays import Array


class CurrentResponse(ABC):
    """The force of one parameter set as a function of the current in the coil [A].

    Samples each follow the same ``state``, ``period`` [s] after it: of a law that remembers, ask
    for one.
    """

    @abstractmethod
    def forces(
        self, samples: Sequence[MotionSample], current: Array, period: float, state: State | None
    ) -> Array:
        """Force (n, m) [N] of n samples at currents (n, m) or (m,) [A]."""

    def at(
        self, sample: MotionSample, period: float, state: State | None
    ) -> Callable[[float], float]:
        """Force [N] of one sample at a current [A], in scalars."""
        return lambda current: float(
            self.forces([sample], np.array([current]), period, state)[0, 0]
        )
