"""Force of a law over the current in the coil, at samples of a motion: what an inverse needs.

The coil's lag is no part of it: what is wanted is the current of the coil, and how the supply
brings it there is another matter. For samples that come together there are arrays, for one after
the other plain numbers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.motion_sample import MotionSample
from mr_damper_ros.models.quantities import State
from mr_damper_ros.signals.arrays import Array

NODES = 65
"""Currents at which a force is looked at first: between two of them it should bend once at most."""

_FINE = 257
"""Currents at which is looked where a force changes."""

_STEP = 1e-6
"""Amperes over which a derivative is taken where a law has none of its own."""


class CurrentResponse(ABC):
    """The force of n samples as a function of the current in the coil [A]."""

    @abstractmethod
    def force(self, current: Array) -> Array:
        """Force (n, m) [N] at currents (n, m) or (m,) [A]."""

    def slope(self, current: Array) -> Array:
        """Derivative (n, m) [N/A] of the force at currents (n, m) or (m,) [A]."""
        above, below = self.force(current + _STEP), self.force(current - _STEP)
        return np.asarray((above - below) / (2.0 * _STEP))


class SampleResponse(ABC):
    """The force of one sample as a function of the current in the coil [A]."""

    @abstractmethod
    def at_nodes(self) -> list[float]:
        """Force [N] at the currents that are looked at first."""

    @abstractmethod
    def force(self, current: float) -> float:
        """Force [N] at a current [A]."""


class SampleResponses:
    """Responses of a law with one set, sample by sample; ``nodes`` (m,) [A] rise.

    ``respond`` gives that of a motion so many seconds after a state.
    """

    def __init__(
        self, respond: Callable[[Motion, float, State | None], CurrentResponse], nodes: Array
    ) -> None:
        self._respond = respond
        self._nodes = nodes

    def of(self, sample: MotionSample, period: float, state: State | None) -> SampleResponse:
        """That of the sample ``period`` [s] after the state."""
        return ArraySampleResponse(lambda: self._respond(sample.motion, period, state), self._nodes)

    def several(self, motion: Motion, period: float, state: State | None) -> SeveralSamples:
        """Those of the samples (n,) of a motion, each after the state."""
        each = [self.of(sample, period, state).force for sample in MotionSample.each(motion)]
        return SeveralSamples(each, self._respond(motion, period, state).force(self._nodes))


class SeveralSamples(NamedTuple):
    """Forces [N] of a few samples: of each at a current [A], and of all (n, m) at the nodes."""

    each: Sequence[Callable[[float], float]]
    at_nodes: Array


class ArraySampleResponse(SampleResponse):
    """That of a law's arrays, which are made where they are asked for."""

    def __init__(self, made: Callable[[], CurrentResponse], nodes: Array) -> None:
        self._made = made
        self._nodes = nodes

    @cached_property
    def _response(self) -> CurrentResponse:
        return self._made()

    def at_nodes(self) -> list[float]:
        """Force [N] at the nodes."""
        found: list[float] = self._response.force(self._nodes)[0].tolist()
        return found

    def force(self, current: float) -> float:
        """Force [N] at a current [A]."""
        return float(self._response.force(np.array([[current]]))[0, 0])


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
