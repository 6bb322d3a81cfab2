"""Peak velocity of any motion, sample by sample, from the past alone.

The thesis takes v_m = sqrt(v² - a u), which in a steady sine is 2 pi f A at every sample. In any
other motion it depends on where the displacement u is counted from, and it is not real wherever
the motion turns on the far side of that centre. There u stands for -a / w², w the angular
frequency. Here w is that of the motion's latest half-cycles, w² = <a²> / <v²> (Rice, Bell System
Technical Journal 24, 1945: the mean frequency of the turns of a random motion), so that

    v_m = sqrt(v² + (a / w)²)

is the peak velocity of the sine of that frequency which goes through the present velocity and
acceleration. It

- equals 2 pi f A in a steady sine;
- needs no centre of the motion;
- at a reversal, where the damper's force changes its sign, tells how hard the motion turns;
- changes with the motion, not with the clock: the same motion played twice as fast has twice the
  peak velocity, as the law expects;
- bears noise of the acceleration: w is that of the same noisy acceleration, so that the mean
  square of v_m is twice that of v whatever the noise.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.observer import AdaptiveObserver
from mr_damper_ros.signals.arrays import Array

HALF_CYCLES = 8
"""The angular frequency is that of so many whole half-cycles before the present one."""

MEMORY = 10.0
"""A half-cycle ends after so long [s] in any case, so that a rest comes to an end."""

_TURNED = 0.25
"""A half-cycle ends where the speed the other way comes to this part of the highest speed."""

_AT_ONCE, _FEW = 512, 32
"""Samples looked through at once for the end of a half-cycle: a long recording has many. But only a
few where the last half-cycle had no more."""

_LARGEST = 1e100
"""Inputs saturate here, so that no product of them overflows to infinity."""


def peak_velocity(displacement: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike) -> Array:
    """Peak velocity of the present cycle, sqrt(max(v² - a u, 0)) [m/s].

    In sinusoidal motion it is constant and equal to 2 pi f A. Inputs broadcast; displacement is
    measured from the centre of the motion. This is the thesis' formula; for any other motion than a
    sine see :class:`PeakVelocity`.
    """
    u, v, a = (
        np.asarray(x, dtype=float).clip(-_LARGEST, _LARGEST)
        for x in (displacement, velocity, acceleration)
    )
    return np.asarray(np.sqrt(np.maximum(v * v - a * u, 0.0)))


@dataclass
class _HalfCycle:
    """Highest speed [m/s], number of samples, and sums of the squared velocity [m²/s²] and
    acceleration [m²/s⁴]; not whole where the stream began within it.
    """  # noqa: D205

    whole: bool
    highest: float = 0.0
    count: int = 0
    squared_velocity: float = 0.0
    squared_acceleration: float = 0.0

    def add(self, highest: float, velocity: Array, acceleration: Array) -> None:
        """Add samples of which the ``highest`` speed [m/s] is known."""
        self.highest = max(self.highest, highest)
        self.count += velocity.size
        self.squared_velocity += float(velocity.dot(velocity))
        self.squared_acceleration += float(acceleration.dot(acceleration))


class PeakVelocity:
    """Follows the velocity and the acceleration of a stream of samples ``period`` [s] apart.

    ``memory`` [s] must hold half a cycle of the motion. What it returns does not depend on how
    the stream is cut into blocks. ``known_from`` is the number of the sample from which on the
    angular frequency is that of eight whole half-cycles, None before.
    """

    def __init__(self, period: float, memory: float = MEMORY) -> None:
        self._longest = max(round(memory / period), 1)
        self._finished: deque[_HalfCycle] = deque(maxlen=HALF_CYCLES)
        self._present = _HalfCycle(whole=False)
        # Highest speed of those.
        self._highest = 0.0
        self._sense = 0.0
        self._count = 0
        # Of the whole half-cycles; it changes with them, not with every block.
        self._whole_time_scale: float | None = None
        self._whole_root_mean_square: float | None = None
        self.known_from: int | None = None

    @property
    def half_cycles(self) -> int:
        """Of how many whole half-cycles the angular frequency is; eight at most."""
        return sum(part.whole for part in self._finished)

    @property
    def root_mean_square(self) -> float:
        """Of the peak velocity [m/s] over the latest half-cycles."""
        if self._whole_root_mean_square is not None:
            return self._whole_root_mean_square
        parts = self._known
        squares = 2.0 * sum(part.squared_velocity for part in parts)
        return math.sqrt(squares / max(sum(part.count for part in parts), 1))

    @property
    def _known(self) -> list[_HalfCycle]:
        """The latest whole half-cycles; before the first of them, all there is."""
        whole = [part for part in self._finished if part.whole]
        return whole or [*self._finished, self._present]

    def follow(self, velocity: Array, acceleration: Array) -> Array:
        """Peak velocity [m/s] at the next samples of the velocity [m/s] and of the acceleration
        [m/s²], shape (n,).
        """  # noqa: D205
        if velocity.size == 1 and self._whole_time_scale is not None:
            return np.hypot(velocity, acceleration * self._follow_one(velocity, acceleration))
        return np.hypot(velocity, acceleration * self.follow_time_scale(velocity, acceleration))

    def _follow_one(self, velocity: Array, acceleration: Array) -> float:
        """As :meth:`follow_time_scale`, of one sample once whole half-cycles are known."""
        assert self._whole_time_scale is not None
        v = float(velocity[0])
        speed = abs(v)
        self._sense = self._sense or float(np.sign(v))
        before = max(self._highest, self._present.highest, speed)
        if self._sense * v < -_TURNED * before:
            self._sense = -self._sense
            self._finish()
        time_scale = self._whole_time_scale
        self._present.add(speed, velocity, acceleration)
        self._count += 1
        if self._present.count == self._longest:
            self._finish()
        return time_scale

    def follow_time_scale(self, velocity: Array, acceleration: Array) -> Array:
        """Inverse angular frequency [s] at the next samples, shape (n,), as :meth:`follow`."""
        found = np.empty(velocity.size)
        place = 0
        at_once = _AT_ONCE
        with np.errstate(over="ignore"):
            while place < velocity.size:
                part = slice(place, place + at_once)
                used = self._follow_half_cycle(velocity[part], acceleration[part], found[part])
                place += used
                # A motion of nothing but reversals must not cost much more than another.
                at_once = _FEW if used < _FEW else _AT_ONCE
        return found

    def _follow_half_cycle(self, velocity: Array, acceleration: Array, found: Array) -> int:
        """Follow up to the end of the half-cycle at the latest; returns the samples used."""
        present = self._present
        speed = np.abs(velocity[: self._longest - present.count])
        highest = np.maximum.accumulate(speed)
        if self._sense == 0.0:
            self._sense = float(np.sign(velocity[speed.nonzero()[0][:1]].sum()))
        before = max(self._highest, present.highest)
        turned = self._sense * velocity[: speed.size] < -_TURNED * np.maximum(highest, before)
        used = int(turned.argmax())
        ends = bool(turned[used])
        if not ends:
            used = speed.size
        if used > 0:
            found[:used] = self._time_scale(velocity[:used], acceleration[:used])
            present.add(float(highest[used - 1]), velocity[:used], acceleration[:used])
            self._count += used
        if ends:
            self._sense = -self._sense
        if ends or present.count == self._longest:
            self._finish()
        return used

    def _time_scale(self, velocity: Array, acceleration: Array) -> Array | float:
        if self._whole_time_scale is not None:
            return self._whole_time_scale
        sums = np.cumsum(velocity**2), np.cumsum(acceleration**2)
        return _root_of_ratio(*(s + more for s, more in zip(self._sums(), sums, strict=True)))

    def _sums(self) -> tuple[float, float]:
        parts = self._known
        return (
            sum(part.squared_velocity for part in parts),
            sum(part.squared_acceleration for part in parts),
        )

    def _finish(self) -> None:
        if self._finished and not self._finished[0].whole:
            self._finished.clear()
        self._finished.append(self._present)
        self._highest = max([part.highest for part in self._finished])
        self._present = _HalfCycle(whole=True)
        if self._finished[-1].whole:
            velocity, acceleration = self._sums()
            # As _root_of_ratio, of two numbers.
            usable = acceleration > 0.0 and math.isfinite(velocity) and math.isfinite(acceleration)
            self._whole_time_scale = math.sqrt(velocity / acceleration) if usable else 0.0
            self._whole_root_mean_square = None
            self._whole_root_mean_square = self.root_mean_square
        if self.known_from is None and len(self._finished) == HALF_CYCLES:
            self.known_from = self._count


def _root_of_ratio(velocity: Array, acceleration: Array) -> Array:
    """Times (n,) [s] of sums of squares; 0 where the motion was not seen to turn, or where the
    sums are beyond what a number can hold.
    """  # noqa: D205
    usable = (acceleration > 0.0) & np.isfinite(velocity) & np.isfinite(acceleration)
    return np.sqrt(np.divide(velocity, acceleration, out=np.zeros(usable.size), where=usable))


class StreamPeakVelocity:
    """Follows the displacement of a stream of samples ``period`` [s] apart.

    ``memory`` [s] as in :class:`PeakVelocity`.
    """

    def __init__(self, period: float, memory: float = MEMORY) -> None:
        self._differentiator = AdaptiveObserver(period)
        self._peak = PeakVelocity(period, memory)

    def follow(self, displacement: Array) -> Array:
        """Peak velocity [m/s] at the next samples of the displacement [m], shape (n,)."""
        _, velocity, acceleration = self._differentiator.follow(displacement)
        if not self._differentiator.settled:
            # What overshoots while the observer settles must not be remembered.
            return np.abs(velocity)
        return self._peak.follow(velocity, acceleration)


def peak_velocity_of_window(velocity: Array, acceleration: Array, period: float) -> Array:
    """Peak velocity [m/s] at samples ``period`` [s] apart of a velocity [m/s] and an acceleration
    [m/s²], shape (n,).

    Before it has seen enough half-cycles, the angular frequency is that of the first ones of the
    window.
    """  # noqa: D205
    follower = PeakVelocity(period)
    time_scale = follower.follow_time_scale(velocity, acceleration)
    known = velocity.size - 1 if follower.known_from is None else follower.known_from
    time_scale[:known] = time_scale[min(known, velocity.size - 1)]
    return np.hypot(velocity, acceleration * time_scale)


def peak_velocity_of_period(velocity: Array, acceleration: Array, period: float) -> Array:
    """As :func:`peak_velocity_of_window`, of one period of a motion that had gone on before."""
    follower = PeakVelocity(period)
    follower.follow_time_scale(velocity, acceleration)
    return np.hypot(velocity, acceleration * follower.follow_time_scale(velocity, acceleration))
