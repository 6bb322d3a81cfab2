"""The force where another set is taken up: what it differs by from the one before fades away.

Two sets never give quite the same force, nor does one that starts again from another past. Such a
step is none of the damper's, and whoever controls by the force would answer it. So the force goes
on from that of the set before, and what is left of the difference becomes less with every sample.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.force_model import ForceStream, Model
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import State
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.validity import NO_DOUBT, Doubt, DoubtKind

FADES = 0.05
"""Seconds until nothing is left: no damper's own force changes faster, and no half-cycle that
matters is shorter."""


class _Before(NamedTuple):
    """A set that was in use, its law, and what this remembered."""

    parameters: ParameterSet
    law: Model
    state: State | None

    def force(self, motion: Motion, current: Array, period: float) -> float:
        """Its force [N] at the one sample that comes next."""
        held = self.parameters.held(motion)
        with np.errstate(over="ignore", invalid="ignore"):
            force, _ = self.law.follow(self.parameters.values, held, current, period, self.state)
        return float(force[0])


class FadingForce:
    """Follows the force of samples ``period`` [s] apart over changes of the set."""

    def __init__(self, period: float = math.inf) -> None:
        self._period = period
        self._count = round(FADES / period)
        # The part [N] of the difference in the last samples.
        self._part: Array = np.zeros(0)
        self._before: _Before | None = None
        # The difference [N] where it began to fade, and samples until it is gone.
        self._difference, self._left = 0.0, 0

    def leave(self, stream: ForceStream | None, parameters: ParameterSet | None) -> None:
        """A set is in use no more whose force the stream was; the next samples go on from it."""
        if self._before is None and stream is not None and parameters is not None:
            self._before = _Before(parameters, stream.model, stream.state)

    def step(self) -> None:
        """The force of the next samples is that of the set in use at once."""
        self._before, self._left = None, 0

    def follow(self, force: Array, motion: Motion, current: Array | float, largest: float) -> Array:
        """The force (n,) [N] of the next samples, from the one that the set in use gives.

        ``current`` [A] is a number or has shape (n,); ``largest`` [N] is the largest known of the
        damper, NaN where none is: from a larger one nothing goes on.
        """
        if self._before is not None:
            first = motion.part(slice(0, 1)), np.atleast_1d(np.asarray(current, dtype=float))[:1]
            went_on = self._before.force(*first, self._period)
            self._before = None
            self._begin(went_on, float(force[0]), largest)
        if self._left == 0:
            self._part = np.zeros(0)
            return force
        left = np.maximum(self._left - np.arange(force.size), 0) / self._count
        self._left = max(self._left - force.size, 0)
        self._part = self._difference * left
        return np.asarray(force + self._part)

    def doubt(self, allowed: float, force: Array, measured: Array) -> Doubt:
        """Whether the ``force`` (m,) that goes on is off by more than ``allowed`` [N].

        That of the set in use may be right then, and the difference small: both count together.
        """
        if not self._part.size:
            return NO_DOUBT
        wrong = np.abs(force - measured) > allowed
        if not wrong.any():
            return NO_DOUBT
        return Doubt(
            DoubtKind.WRONG,
            f"the force goes on from that of other parameters: {abs(self._part[0]):.3g} N of the "
            "difference are left, which fades away",
            wrong,
        )

    def _begin(self, went_on: float, force: float, largest: float) -> None:
        """Begin with the difference of two forces [N] at the first sample."""
        still = self._difference * self._left / self._count if self._left else 0.0
        self._difference = went_on + still - force
        self._left = self._count if math.isfinite(went_on) and not abs(went_on) > largest else 0
