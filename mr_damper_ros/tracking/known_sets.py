"""The sets known of a damper, each for its motions, and which of them gives the measured force.

A set that a window was fitted with holds at its peak velocity, and often nowhere else. So those
before are remembered: where the motion comes back to what one of them is for, the force is that
set's at once, without waiting for the identification. The measured force decides; it also tells
whether the force of this damper jumps where the motion turns.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.force_stream import ForceStream
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array

_MOST = 8
"""Sets that are remembered; each is tried out."""

_SAME_SPEED = 1.1
_SAME_CURRENT = 0.05
_SAME_TIME = 1.5
"""A set whose range begins and ends as that of another takes its place, if it came in a motion
about as fast."""

_SETTLES = 0.2
"""Seconds of motion in which a set settles before it is judged ..."""

_JUDGED = 0.1
"""... in the last so many, or ..."""

_PART = 0.1
"""... this part of a half-cycle, if that is more."""

_MOST_KEPT = 40_000
_MOST_TRIED = 2000
"""Samples of the last cycle that are kept, and that are tried out."""

_TOGETHER = 64
"""Samples that are kept in one piece."""

_EVERY = 0.05
"""Seconds between two searches: each costs as much as some blocks of prediction."""

_BETTER = 0.6
"""What takes over from a force that is wrong leaves less than this part of its error."""


@dataclass(frozen=True, eq=False)
class KnownSet:
    """A set, and the stamp up to which it fits the samples (None: it does not age).

    ``half_cycle`` [s] of the motion in which it came, NaN where that was not known.
    """

    parameters: ParameterSet
    confirmed_ns: int | None
    half_cycle: float = math.nan

    def replaces(self, other: KnownSet) -> bool:
        """Whether the set is for the motions and currents of another."""
        times = self.half_cycle, other.half_cycle
        mine, its = self.parameters, other.parameters
        speeds = zip(mine.peak_velocity_range, its.peak_velocity_range, strict=True)
        currents = zip(mine.current_range, its.current_range, strict=True)
        return (
            not max(times) > _SAME_TIME * min(times)
            and all(max(pair) <= _SAME_SPEED * min(pair) for pair in speeds)
            and all(a == b or abs(a - b) <= _SAME_CURRENT for a, b in currents)
        )

    def is_for(self, speed: float, current: float, margin: float) -> bool:
        """Whether the set was identified at a peak velocity [m/s] and a current [A]."""
        slow, fast = self.parameters.peak_velocity_range
        low, high = self.parameters.current_range
        return bool(
            slow * (1.0 - margin) <= speed <= fast * (1.0 + margin)
            and low - _SAME_CURRENT <= current <= high + _SAME_CURRENT
        )


class Choice(NamedTuple):
    """A set to go on with, and what it leaves of the newest forces [N]; NaN where none came."""

    chosen: KnownSet
    error: float


class KnownSets:
    """Remembers the sets that were in use, and the newest samples.

    ``margin``: part by which the peak velocity may leave the range of a set. ``gradual``: whether
    the branch of the hysteresis follows the velocity where the motion turns.
    """

    def __init__(self, margin: float, *, gradual: bool) -> None:
        self._margin = margin
        self.gradual = gradual
        # The one in use, then those before.
        self._sets: list[KnownSet] = []
        self._newest_ns: int | None = None
        self._samples: deque[_Samples] = deque()
        self._newest_samples: list[_Samples] = []
        self._newest_count = 0
        self._count = 0
        self._period = math.nan
        self._half_cycle = 0.0
        self._since_search = math.inf

    @property
    def present(self) -> KnownSet | None:
        """The set in use; None before one has come."""
        return self._sets[0] if self._sets else None

    def confirm(self, set_id: str, stamp_ns: int) -> None:
        """Take note that the set of this name fits the samples up to the stamp."""
        self._sets = [
            replace(each, confirmed_ns=stamp_ns) if each.parameters.set_id == set_id else each
            for each in self._sets
        ]

    def add(self, found: KnownSet) -> None:
        """Remember a set that has come and is in use now.

        One of no age, or no younger than those known, was chosen by somebody: they are forgotten.
        """
        stamp_ns, model = found.confirmed_ns, found.parameters.model
        aged = stamp_ns is not None and self._newest_ns is not None and stamp_ns > self._newest_ns
        if not aged or any(each.parameters.model != model for each in self._sets):
            self._sets.clear()
        self._newest_ns = stamp_ns
        self.use(found)

    def use(self, chosen: KnownSet) -> None:
        """Take note that this set is in use now."""
        others = [each for each in self._sets if not chosen.replaces(each)]
        self._sets = [chosen, *others][:_MOST]

    def forget_samples(self) -> None:
        """Others do not go on from them."""
        self._samples.clear()
        self._newest_samples.clear()
        self._count = self._newest_count = 0

    def follow(
        self,
        motion: Motion,
        current: Array | float,
        forces: tuple[Array, Array],
        period: float,
        half_cycle: float,
    ) -> None:
        """Keep the newest samples: motion, current [A], predicted and measured ``forces`` [N].

        Each has shape (n,). They are ``period`` [s] apart; ``half_cycle`` [s] is that of the
        motion, NaN where it is not known.
        """
        predicted, measured = forces
        self._since_search += measured.size * period
        self._period = period
        self._half_cycle = 0.0 if math.isnan(half_cycle) else half_cycle
        amperes = np.broadcast_to(current, measured.shape)
        self._newest_samples.append(_Samples(motion, amperes, predicted, measured))
        self._newest_count += measured.size
        if self._newest_count < _TOGETHER:
            return
        self._samples.append(_Samples.joined(self._newest_samples))
        self._newest_samples.clear()
        self._count += self._newest_count
        self._newest_count = 0
        span = max(2.0 * self._half_cycle, self._judged + _SETTLES)
        most = min(span / period, _MOST_KEPT)
        while self._count - self._samples[0].measured.size >= most:
            self._count -= self._samples.popleft().measured.size

    def search_is_due(self) -> bool:
        """Whether it is time to look for another set: not every time that the force is wrong."""
        if not self._count or self._since_search < _EVERY:
            return False
        self._since_search = 0.0
        return True

    def another(self, allowed: float, *, wrong: bool) -> Choice | None:
        """The set that gives the newest forces, within an ``allowed`` error [N]; None for none.

        ``wrong``: the present one does not; else it is for other motions only. An infinite error
        is allowed where no force is measured: the set last used for the motion is then taken. Where
        the present force goes on from a wrong past, it is the present set that starts again.
        """
        present, newest = self._sets[0], self._newest(self._judged + _SETTLES)
        judged = slice(-max(round(self._judged / self._period / newest.stride), 1), None)
        speed = float(np.median(newest.motion.peak_velocity[judged]))
        candidates = [
            each
            for each in self._sets
            if each is not present and each.is_for(speed, float(newest.current[-1]), self._margin)
        ]
        if math.isinf(allowed):
            return Choice(candidates[0], math.nan) if candidates else None
        left = newest.predicted - newest.measured
        limit = _root_mean_square(left[judged]) * (_BETTER if wrong else 1.0)
        best = None
        for each in (present, *candidates) if wrong else candidates:
            left = (self._force(each, newest, self.gradual) - newest.measured)[judged]
            error = _root_mean_square(left)
            if error < limit and float(np.max(np.abs(left))) <= allowed:
                best, limit = Choice(each, error), error
        return best

    def turning_otherwise(self) -> Choice | None:
        """The present set, where over a cycle the force turns otherwise than it was taken to.

        None where it does not, or not enough is known.
        """
        present = self._sets[0]
        law = present.parameters.law
        if law.continuous is law or self._count * self._period < self._half_cycle:
            return None
        newest = self._newest(math.inf)
        usual, other = (
            _root_mean_square(self._force(present, newest, gradual) - newest.measured)
            for gradual in (self.gradual, not self.gradual)
        )
        return Choice(present, other) if other < _BETTER * usual else None

    def settled_stream(self, chosen: KnownSet) -> ForceStream:
        """A stream of the set's force that has followed the newest samples."""
        newest = self._newest(self._judged + _SETTLES)
        stream = self._stream(chosen, self._period, self.gradual)
        held = newest.motion.held_within(*chosen.parameters.peak_velocity_range)
        stream.follow(chosen.parameters.values, held, newest.current)
        return stream

    @property
    def _judged(self) -> float:
        return max(_JUDGED, _PART * self._half_cycle)

    def _stream(self, chosen: KnownSet, period: float, gradual: bool) -> ForceStream:
        law = chosen.parameters.law
        return (law.continuous if gradual else law).stream(period)

    def _force(self, chosen: KnownSet, newest: _Samples, gradual: bool) -> Array:
        held = newest.motion.held_within(*chosen.parameters.peak_velocity_range)
        stream = self._stream(chosen, self._period * newest.stride, gradual)
        return stream.follow(chosen.parameters.values, held, newest.current)

    def _newest(self, span: float) -> _Samples:
        """The samples of the last so many seconds, as far as they are kept."""
        parts: list[_Samples] = []
        count = 0
        for part in reversed([*self._samples, *self._newest_samples]):
            if count * self._period >= span:
                break
            parts.append(part)
            count += part.measured.size
        return _Samples.joined(parts[::-1], count // _MOST_TRIED + 1)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Motion, current [A], predicted and measured force [N], each (n,); every ``stride``-th one."""

    motion: Motion
    current: Array
    predicted: Array
    measured: Array
    stride: int = 1

    @classmethod
    def joined(cls, parts: Sequence[_Samples], stride: int = 1) -> _Samples:
        """Samples that follow each other, every so many of them."""
        motions = [part.motion for part in parts]

        def row(arrays: list[Array]) -> Array:
            return np.concatenate(arrays)[::stride]

        return cls(
            Motion(
                row([motion.displacement for motion in motions]),
                row([motion.velocity for motion in motions]),
                row([motion.acceleration for motion in motions]),
                row([motion.peak_velocity for motion in motions]),
                sine=None,
            ),
            row([part.current for part in parts]),
            row([part.predicted for part in parts]),
            row([part.measured for part in parts]),
            stride,
        )


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
