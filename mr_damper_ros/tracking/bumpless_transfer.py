"""Force of the set in use, block by block, without a step where another set takes over.

Two sets never give quite the same force, nor does one set that starts again from another past. Such
a step is none of the damper's, and a controller would answer it. So the force continues from that
of the set before, and the difference fades. What the law remembers (a lag, a hysteresis) is
computed anew with the new set over the latest motion: it is then what it would be, had the new set
been in use all the time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from itertools import islice
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import State
from mr_damper_ros.signals.arrays import Array, span_of
from mr_damper_ros.tracking.validity import NO_DOUBT, Doubt, DoubtKind

FADES = 0.05
"""Seconds until nothing of the difference is left: no damper's own force changes faster, and no
half-cycle that matters is shorter."""

_KEPT = 0.5
"""Seconds of motion over which a state is computed anew: 280 time constants of the lags identified
so far. A hysteresis forgets with the way: more is kept where its law asks for it ..."""

_LONGEST_KEPT = 30.0
"""... but no more seconds than this, where the damper hardly moves."""

_TOGETHER = 500
"""Samples that are followed at once: sample by sample half a minute would take ten seconds."""


class _Block(NamedTuple):
    """Motion and current [A] of some samples, the state before them, and their way [m]."""

    before: State | None
    motion: Motion
    current: Array
    way: float


class _Left(NamedTuple):
    """A set that was in use, how its force turns, and what its law remembered."""

    parameters: ParameterSet
    gradual: bool
    state: State | None


class ForceInUse:
    """Force of samples ``period`` [s] apart by the set in use, which :meth:`use` changes.

    ``state``: what its law remembers after the last sample; None before the first.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._parameters: ParameterSet | None = None
        self._gradual = False
        self.state: State | None = None
        # The latest blocks, the samples and the way [m] in them, and how many of the blocks came
        # since the force could last not be known.
        self._past: deque[_Block] = deque()
        self._count, self._way = 0, 0.0
        self._known = 0
        # The way [m] to be kept, and the range of currents [A] that it is for.
        self._way_kept = 0.0
        self._way_of = (math.inf, -math.inf)
        # The set from whose force that of the next samples continues.
        self._left: _Left | None = None
        # The difference [N] where it began to fade, samples until it is gone, and its part in the
        # last samples.
        self._difference, self._fading = 0.0, 0
        self._part: Array = np.zeros(0)

    @property
    def parameters(self) -> ParameterSet | None:
        """The set in use; None before the first."""
        return self._parameters

    @property
    def remembers(self) -> bool:
        """Whether the force depends on samples before the last reversal of the motion."""
        if self._parameters is None:
            return False
        law = self._parameters.law_turning(gradual=self._gradual)
        return law.remembers or len(self.state or ()) > law.turning

    def use(
        self, parameters: ParameterSet, *, gradual: bool, fade: bool, restart: bool = False
    ) -> None:
        """Use this set from the next sample on.

        ``fade``: the force continues from that of the set before, else it steps. ``restart``: what
        the law remembers is not trusted, but computed from the samples whose force could be known.
        """
        before = self._parameters
        if not fade:
            self._left, self._fading = None, 0
        elif self._left is None and before is not None and self.state is not None:
            self._left = _Left(before, self._gradual, self.state)
        self._parameters, self._gradual = parameters, gradual
        self._way_kept, self._way_of = 0.0, (math.inf, -math.inf)
        if restart:
            spare = len(self._past) - self._known
            self._recompute(None, islice(self._past, spare, None))
        elif before is None or before.model != parameters.model:
            self._recompute(None, ())
        elif self._past and parameters.law.remembers:
            self._recompute(self._past[0].before, self._past)

    def forget_known(self) -> None:
        """The force of the samples so far could not be known."""
        self._known = 0

    def forget(self) -> None:
        """The samples and their force do not count any more: the law begins without a past."""
        self._left, self._fading = None, 0
        self._recompute(None, ())

    def _recompute(self, state: State | None, past: Iterable[_Block]) -> None:
        """Compute the state anew from that before some blocks, with the present set."""
        blocks = deque(past)
        self._past, self._count, self._way, self._known = deque(), 0, 0.0, 0
        self.state = state
        while blocks:
            several = [blocks.popleft()]
            count = several[0].current.size
            while blocks and count < _TOGETHER:
                several.append(blocks.popleft())
                count += several[-1].current.size
            motion = Motion.joined([block.motion for block in several])
            self._of_set(motion, np.concatenate([block.current for block in several]))

    def follow(self, motion: Motion, current: Array, largest: float) -> Array:
        """The force (n,) [N] of the next samples by the set alone; :meth:`blended` adds the rest.

        ``current`` [A] has shape (n,); ``largest`` [N] is the largest known of the damper, NaN
        where none is: the force does not continue from a larger one.
        """
        force = self._of_set(motion, current)
        left, self._left = self._left, None
        if left is not None:
            went_on = self._first_force(left, motion, current)
            still = self._difference * self._fading * self._period / FADES
            self._difference = went_on + still - float(force[0])
            usable = math.isfinite(went_on) and not abs(went_on) > largest
            self._fading = round(FADES / self._period) if usable else 0
        return force

    def blended(self, force: Array) -> Array:
        """The force (n,) [N] of the samples just followed, with what is left of the difference."""
        if self._fading == 0:
            self._part = np.zeros(0)
            return force
        left = np.maximum(self._fading - np.arange(force.size), 0) * (self._period / FADES)
        self._fading = max(self._fading - force.size, 0)
        self._part = self._difference * left
        return np.asarray(force + self._part)

    def doubt(self, allowed: float, force: Array, measured: Array) -> Doubt:
        """Whether the blended ``force`` (m,) is off by more than ``allowed`` [N].

        The set alone may be right, and the difference small: both count together.
        """
        if not self._part.size:
            return NO_DOUBT
        wrong = np.abs(force - measured) > allowed
        if not wrong.any():
            return NO_DOUBT
        return Doubt(
            DoubtKind.WRONG,
            f"bumpless transfer from other parameters: {abs(self._part[0]):.3g} N of the "
            "difference remain",
            wrong,
        )

    def _first_force(self, left: _Left, motion: Motion, current: Array) -> float:
        """Force [N] of the set before at the first of the samples."""
        force, _ = left.parameters.follow(
            motion.part(slice(0, 1)), current[:1], self._period, left.state, gradual=left.gradual
        )
        return float(force[0])

    def _of_set(self, motion: Motion, current: Array) -> Array:
        assert self._parameters is not None
        force, state = self._parameters.follow(
            motion, current, self._period, self.state, gradual=self._gradual
        )
        self._keep(self._parameters, motion, current)
        self.state = state
        return force

    def _keep(self, parameters: ParameterSet, motion: Motion, current: Array) -> None:
        way = 0.0
        if parameters.law.remembers:
            way = float(np.abs(motion.velocity).sum()) * self._period
            # At any of the currents so far: the next may be like them.
            low, high = self._way_of
            lowest, highest = span_of(current)
            for amperes in {lowest, highest}:
                if not low <= amperes <= high:
                    length = parameters.law.memory_length(parameters.values, amperes)
                    self._way_kept = max(self._way_kept, length)
            self._way_of = min(low, lowest), max(high, highest)
        self._past.append(_Block(self.state, motion, current, way))
        self._count += current.size
        self._way += way
        self._known += 1
        while self._is_spare(self._past[0]):
            oldest = self._past.popleft()
            self._count -= oldest.current.size
            self._way -= oldest.way
        self._known = min(self._known, len(self._past))

    def _is_spare(self, oldest: _Block) -> bool:
        """Whether the other blocks are enough."""
        duration = (self._count - oldest.current.size) * self._period
        moved_enough = self._way - oldest.way >= self._way_kept
        return duration >= _LONGEST_KEPT or (duration >= _KEPT and moved_enough)
