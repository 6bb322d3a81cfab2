"""Bumpless transfer: force of the set in use, without a step when another set takes over.

Two sets never give exactly the same force, and neither does a set whose law restarts from a
different state. The force of the damper has no step, and a controller would react to one. The new
force therefore starts at the force of the previous set, and the difference fades to zero. The state
of the law (a lag, a hysteresis) is recomputed with the new set over the recent motion. The state is
then as if the new set had been in use all the time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import State
from mr_damper_ros.signals.arrays import Array, span_of
from mr_damper_ros.tracking.validity import DoubtKind, Rule
from mr_damper_ros.tracking.window_assembler import WindowSettings

FADE_TIME = 0.05
"""Seconds in which the difference fades to zero. The force of a damper does not change faster, and
half-cycles are not shorter than this in practice."""

_KEPT_TIME = 10.0 * FADE_TIME
"""Seconds of motion over which a state is recomputed: 280 time constants of the lags identified in
recordings. The memory of a hysteresis fades with the distance travelled, so its law may need more.
"""

_LONGEST_KEPT_TIME = WindowSettings.longest_window
"""Largest number of seconds over which a state is recomputed, even if the damper hardly moves."""

_BATCH = 500
"""Number of samples recomputed at once. One at a time, half a minute of motion would take 10 s."""


class _Block(NamedTuple):
    """Motion and current [A] of a block, the state before it, and the distance travelled [m]."""

    before: State | None
    motion: Motion
    current: Array
    way: float


class ForceInUse:
    """Force of the set in use, for samples ``period`` [s] apart; :meth:`use` changes the set.

    ``state`` is the state of the law after the last sample; None before the first.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self.parameters: ParameterSet | None = None
        """The set in use; None before the first."""
        self._gradual = False
        self.state: State | None = None
        # The recent blocks, their number of samples and distance travelled [m], and the number of
        # blocks since the force was last unknown.
        self._past: deque[_Block] = deque()
        self._count, self._way, self._known = 0, 0.0, 0
        # The distance [m] to keep, and the range of currents [A] for which it was computed.
        self._way_kept, self._way_of = 0.0, (math.inf, -math.inf)
        # The previous set, its branch rule and the state of its law; its force is the starting
        # value of the next samples.
        self._left: tuple[ParameterSet, bool, State] | None = None
        # The initial difference [N], the samples until it is zero, and its contribution [N] to the
        # last samples.
        self._difference, self._fading = 0.0, 0
        self._part: Array = np.zeros(0)

    @property
    def remembers(self) -> bool:
        """Whether the force depends on samples before the last reversal of the motion."""
        if self.parameters is None:
            return False
        law = self.parameters.law_turning(gradual=self._gradual)
        return law.remembers or len(self.state or ()) > law.turning

    def use(
        self, parameters: ParameterSet, *, gradual: bool, fade: bool, restart: bool = False
    ) -> None:
        """Use this set from the next sample on.

        With ``fade`` the force starts at the force of the previous set; otherwise the force steps.
        With ``restart`` the state of the law is discarded and recomputed from the samples whose
        force was known.
        """
        before = self.parameters
        if not fade:
            self._left, self._fading = None, 0
        elif self._left is None and before is not None and self.state is not None:
            self._left = before, self._gradual, self.state
        self.parameters, self._gradual = parameters, gradual
        self._way_kept, self._way_of = 0.0, (math.inf, -math.inf)
        if restart:
            self._recompute(None, [*self._past][len(self._past) - self._known :])
        elif before is None or before.model != parameters.model:
            self._recompute(None, ())
        elif self._past and parameters.law.remembers:
            self._recompute(self._past[0].before, self._past)

    def forget_known(self) -> None:
        """Note that the force of the samples so far was unknown."""
        self._known = 0

    def forget(self) -> None:
        """Discard the samples and the state; the law restarts without a past."""
        self._left, self._fading = None, 0
        self._recompute(None, ())

    def _recompute(self, state: State | None, past: Iterable[_Block]) -> None:
        """Recompute the state with the present set, from the state before these blocks."""
        blocks = deque(past)
        self._past, self._count, self._way, self._known = deque(), 0, 0.0, 0
        self.state = state
        while blocks:
            several = [blocks.popleft()]
            while blocks and sum(block.current.size for block in several) < _BATCH:
                several.append(blocks.popleft())
            motion = Motion.joined([block.motion for block in several])
            self._of_set(motion, np.concatenate([block.current for block in several]))

    def follow(self, motion: Motion, current: Array, largest: float) -> Array:
        """The force (n,) [N] of the set alone at the next samples.

        ``current`` [A] has shape (n,). ``largest`` [N] is the largest known force of the damper,
        NaN if unknown; nothing fades from a larger force. :meth:`blended` adds the fading
        difference.
        """
        force = self._of_set(motion, current)
        left, self._left = self._left, None
        if left is not None:
            before, gradual, state = left
            first = motion.part(slice(0, 1)), current[:1], self._period
            went_on = float(before.follow(*first, state, gradual=gradual)[0][0])
            still = self._difference * self._fading * self._period / FADE_TIME
            self._difference = went_on + still - float(force[0])
            usable = math.isfinite(went_on) and not abs(went_on) > largest
            self._fading = round(FADE_TIME / self._period) if usable else 0
        return force

    def blended(self, force: Array) -> Array:
        """Add the remaining difference to the ``force`` (n,) [N] from :meth:`follow`."""
        if self._fading == 0:
            self._part = np.zeros(0)
            return force
        left = np.maximum(self._fading - np.arange(force.size), 0) * (self._period / FADE_TIME)
        self._fading = max(self._fading - force.size, 0)
        self._part = self._difference * left
        return np.asarray(force + self._part)

    def rule(self, allowed: float, force: Array, measured: Array) -> Rule:
        """Whether the error of the blended ``force`` (m,) [N] exceeds ``allowed`` [N].

        The error of the set and the remaining difference count together.
        """
        return Rule(
            DoubtKind.WRONG,
            self._part.size > 0 and np.abs(force - measured) > allowed,
            lambda: (
                f"bumpless transfer from other parameters: {abs(self._part[0]):.3g} N of the "
                "difference remain"
            ),
        )

    def _of_set(self, motion: Motion, current: Array) -> Array:
        """Force of the set at the next samples. Stores the samples and drops those not needed."""
        parameters, before, way = self.parameters, self.state, 0.0
        assert parameters is not None
        force, self.state = parameters.follow(
            motion, current, self._period, before, gradual=self._gradual
        )
        if parameters.law.remembers:
            way = float(np.abs(motion.velocity).sum()) * self._period
            # The longest memory at any current so far, because each of these currents may return.
            low, high = self._way_of
            lowest, highest = span_of(current)
            for amperes in {lowest, highest}:
                if not low <= amperes <= high:
                    length = parameters.law.memory_length(parameters.values, amperes)
                    self._way_kept = max(self._way_kept, length)
            self._way_of = min(low, lowest), max(high, highest)
        self._past.append(_Block(before, motion, current, way))
        self._count += current.size
        self._way += way
        while self._is_spare(self._past[0]):
            oldest = self._past.popleft()
            self._count -= oldest.current.size
            self._way -= oldest.way
        self._known = min(self._known + 1, len(self._past))
        return force

    def _is_spare(self, oldest: _Block) -> bool:
        """Whether the blocks after the oldest suffice to recompute the state."""
        duration = (self._count - oldest.current.size) * self._period
        moved_enough = self._way - oldest.way >= self._way_kept
        return duration >= _LONGEST_KEPT_TIME or (duration >= _KEPT_TIME and moved_enough)
