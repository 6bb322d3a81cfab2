"""Force of a motion that goes on, block by block."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.force_model import Model, State
from mr_damper_ros.signals.arrays import Array, span_of

_KEPT = 0.5
"""Seconds of motion from which a state is found anew: a lag forgets sooner. A hysteresis forgets
with the way: so much more is kept as its model asks for."""

_LONGEST_KEPT = 30.0
"""Seconds; a damper that hardly moves would else be remembered for ever."""

_TOGETHER = 500
"""Samples that are followed at once where the past is: sample by sample half a minute takes ten
seconds, which no stream waits for."""


@dataclass(frozen=True, eq=False)
class Ahead:
    """Force [N] of samples with this motion and current [A], and the state after them.

    ``parameters`` (..., p) are those of the force.
    """

    parameters: Array
    force: Array
    motion: Motion
    current: Array
    state: State


class ForceStream:
    """Force of a motion that goes on: the same as in one piece, however it is cut into blocks.

    The state goes on where the parameters change, unless :meth:`retrace` finds it anew.
    """

    def __init__(self, model: Model, period: float) -> None:
        if not period > 0.0:
            raise ValueError(f"the sample period is {period} s: it must be positive")
        self.model = model
        self._period = period
        self._state: State | None = None
        # Blocks of the last while, each with the state before it and its way [m], and the samples
        # and the way in them.
        self._past: deque[tuple[State | None, Motion, Array, float]] = deque()
        self._past_count = 0
        self._past_way = 0.0
        # The way [m] to be kept, and the parameters and the range of currents that it is for.
        self._way_kept = 0.0
        self._way_of: tuple[Array | None, float, float] = (None, math.inf, -math.inf)

    @property
    def state(self) -> State | None:
        """What the law remembers after the last sample; None before the first."""
        return self._state

    @property
    def remembers(self) -> bool:
        """Whether the force so far depends on the samples before."""
        return self.model.remembers or len(self._state or ()) > self.model.turning

    def follow(self, parameters: ArrayLike, motion: Motion, current: ArrayLike) -> Array:
        """Force [N] of the next samples, shape (..., n), for parameters of shape (..., p).

        ``current`` [A] is a number or has shape (n,). Raises ValueError where the number of
        parameters is wrong.
        """
        ahead = self.ahead(parameters, motion, current)
        self.take(ahead)
        return ahead.force

    def ahead(self, parameters: ArrayLike, motion: Motion, current: ArrayLike) -> Ahead:
        """What :meth:`follow` would give; the stream stays where it is."""
        values = np.asarray(parameters, dtype=float)
        count = len(self.model.parameters)
        if values.shape[-1:] != (count,):
            raise ValueError(
                f"model '{self.model.name}' has {count} parameters "
                f"({', '.join(self.model.parameter_names)}): got shape {values.shape}"
            )
        amperes = np.asarray(current, dtype=float)
        if amperes.shape != motion.velocity.shape:
            amperes = np.broadcast_to(amperes, motion.velocity.shape)
        with np.errstate(over="ignore", invalid="ignore"):
            force, state = self.model.follow(values, motion, amperes, self._period, self._state)
        return Ahead(values, force, motion, amperes, state)

    def state_after(
        self, parameters: Array, motion: Motion, current: float, state: State | None
    ) -> State:
        """What the law remembers after samples at a current [A] that follow such a state."""
        amperes = np.full(motion.velocity.size, current)
        with np.errstate(over="ignore", invalid="ignore"):
            return self.model.follow(parameters, motion, amperes, self._period, state)[1]

    def take(self, ahead: Ahead) -> None:
        """Go on to where :meth:`ahead` has looked."""
        if self.model.remembers:
            self._measure_memory(ahead)
            self._keep(ahead)
        self._state = ahead.state

    def _measure_memory(self, ahead: Ahead) -> None:
        """Find the way to be kept: at any of the currents so far, as the next may be like them."""
        known, low, high = self._way_of
        lowest, highest = span_of(ahead.current)
        if ahead.parameters is not known:
            low, high, self._way_kept = math.inf, -math.inf, 0.0
        one = ahead.parameters.reshape(-1, ahead.parameters.shape[-1])[0]
        for current in {lowest, highest}:
            if not low <= current <= high:
                way = self.model.memory_length(one, current)
                self._way_kept = max(self._way_kept, way)
        self._way_of = ahead.parameters, min(low, lowest), max(high, highest)

    def _keep(self, ahead: Ahead) -> None:
        way = float(np.abs(ahead.motion.velocity).sum()) * self._period
        self._past.append((self._state, ahead.motion, ahead.current, way))
        self._past_count += ahead.current.size
        self._past_way += way
        while self._is_spare(self._past[0][2].size, self._past[0][3]):
            _, _, current, way = self._past.popleft()
            self._past_count -= current.size
            self._past_way -= way

    def _is_spare(self, count: int, way: float) -> bool:
        """Whether the rest is enough without so many samples and so much of the way [m]."""
        duration = (self._past_count - count) * self._period
        moved_enough = self._past_way - way >= self._way_kept
        return duration >= _LONGEST_KEPT or (duration >= _KEPT and moved_enough)

    def retrace(self, parameters: ArrayLike) -> None:
        """Follow the motion of the last while once more, with other parameters.

        What the model remembers is then what it would be had these been in use; a lagging force,
        for one, would else be that of the old parameters for a while.
        """
        past, self._past, self._past_count, self._past_way = self._past, deque(), 0, 0.0
        if past:
            self._state = past[0][0]
        while past:
            motions, currents, count = [], [], 0
            while past and count < _TOGETHER:
                _, motion, amperes, _ = past.popleft()
                motions.append(motion)
                currents.append(amperes)
                count += amperes.size
            self.follow(parameters, Motion.joined(motions), np.concatenate(currents))
