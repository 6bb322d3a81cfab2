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
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import State
from mr_damper_ros.signals.arrays import Array, span_of
from mr_damper_ros.tracking.validity import DoubtKind, Objection
from mr_damper_ros.tracking.window_assembler import WindowSettings

FADE_TIME = 0.05
"""Seconds in which the difference fades to zero. The force of a damper does not change faster, and
half-cycles are not shorter than this in practice."""

_MEMORY = 10.0 * FADE_TIME
"""Seconds of motion over which a state is recomputed: 280 time constants of the lags identified in
recordings. The memory of a hysteresis fades with the distance travelled, so its law may need more.
"""

_LONGEST_MEMORY = WindowSettings.longest_window
"""Largest number of seconds over which a state is recomputed, even if the damper hardly moves."""


class _Block(NamedTuple):
    """Motion and current [A] of a block, and the state before it."""

    motion: Motion
    current: Array
    before: State | None


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
        # The recent blocks and their number of samples, and the number of blocks since the force
        # was last unknown.
        self._past: deque[_Block] = deque()
        self._count = self._known = 0
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
        if restart:
            # The states before these blocks may belong to another law or branch rule.
            known = [*self._past][len(self._past) - self._known :]
            self._past = deque(block._replace(before=None) for block in known)
            self._count = sum(block.current.size for block in known)
            self._recompute()
        elif before is None or before.model != parameters.model:
            self._restart()
        elif self.state:
            self._recompute()

    def forget_known(self) -> None:
        """Note that the force of the samples so far was unknown."""
        self._known = 0

    def forget(self) -> None:
        """Discard the samples and the state; the law restarts without a past."""
        self._left, self._fading = None, 0
        self._restart()

    def _restart(self) -> None:
        self.state = None
        self._past.clear()
        self._count = self._known = 0

    def _recompute(self) -> None:
        """Recompute the state with the present set from as many past blocks as it needs."""
        parameters, past, self.state = self.parameters, [*self._past], None
        if parameters is None or not past:
            return
        law, length = parameters.law, 0.0
        if law.remembers:
            currents = span_of(np.concatenate([block.current for block in past]))
            length = max(law.memory_length(parameters.values, current) for current in currents)
        first, count, way = len(past), 0, 0.0
        while first and (count * self._period < _MEMORY or way < length):
            first -= 1
            motion, current, before = past[first]
            count += current.size
            way += float(np.abs(motion.velocity).sum()) * self._period
        motion = Motion.joined([block.motion for block in past[first:]])
        current = np.concatenate([block.current for block in past[first:]])
        _, self.state = parameters.follow(
            motion, current, self._period, before, gradual=self._gradual
        )

    def follow(self, motion: Motion, current: Array, largest: float) -> Array:
        """The force (n,) [N] of the set alone at the next samples.

        ``current`` [A] has shape (n,). ``largest`` [N] is the largest known force of the damper,
        NaN if unknown; nothing fades from a larger force. :meth:`blended` adds the fading
        difference.
        """
        parameters = self.parameters
        assert parameters is not None
        self._past.append(_Block(motion, current, self.state))
        force, self.state = parameters.follow(
            motion, current, self._period, self.state, gradual=self._gradual
        )
        self._count += current.size
        memory = _LONGEST_MEMORY if parameters.law.remembers else _MEMORY
        while (self._count - self._past[0].current.size) * self._period >= memory:
            self._count -= self._past.popleft().current.size
        self._known = min(self._known + 1, len(self._past))
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

    @property
    def fading(self) -> bool:
        """Whether part of a difference remained in the last samples."""
        return self._part.size > 0

    def objections(self, allowed: float, force: Array, measured: Array) -> Iterator[Objection]:
        """Whether the error of the blended ``force`` (m,) [N] exceeds ``allowed`` [N].

        The error of the set and the remaining difference count together.
        """
        if (wrong := np.abs(force - measured) > allowed).any():
            yield Objection(
                DoubtKind.WRONG,
                f"bumpless transfer from other parameters: {abs(self._part[0]):.3g} N of the "
                "difference remain",
                wrong,
            )
