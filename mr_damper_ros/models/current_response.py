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

NODES = 65
"""Currents at which a force is looked at first: between two of them it should bend once at most."""

_FINE = 257
"""Currents at which is looked where a force changes."""


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


def even_nodes(lowest: float, highest: float) -> Array:
    """Currents (m,) [A] in equal steps."""
    return np.linspace(lowest, highest, NODES)


def nodes_along(bends: Callable[[Array], Array], lowest: float, highest: float) -> Array:
    """Currents (m,) [A] that lie the closer, the more there is of the ``bends``.

    These give quantities (..., k) at currents (k,). A part of the nodes is left to the current
    itself.
    """
    currents = np.linspace(lowest, highest, _FINE)
    changes = np.abs(np.diff(bends(currents), axis=-1)).reshape(-1, _FINE - 1)
    totals = changes.sum(axis=-1, keepdims=True)
    parts = np.divide(changes, totals, out=np.zeros_like(changes), where=totals > 0.0)
    density = parts.sum(axis=0) + max(len(parts), 1) / (_FINE - 1)
    way = np.concatenate(([0.0], np.cumsum(density)))
    return np.interp(np.linspace(0.0, way[-1], NODES), way, currents)
