"""Causal estimate of the peak velocity of any motion at each sample.

The thesis defines v_m = sqrt(v² - a u), which equals 2 pi f A at every sample of a steady sine. In
any other motion, it depends on the origin of the displacement u, and it is not real where the
motion reverses on the far side of that origin. In a sine u = -a / w², with the angular frequency w.
This module substitutes that expression for u. It estimates w from the latest half-cycles of the
motion as w² = <a²> / <v²>, the mean frequency of the reversals of a random motion (Rice, Bell
System Technical Journal 24, 1945). The result

    v_m = sqrt(v² + (a / w)²)

is the peak velocity of the sine that has this frequency and passes through the present velocity and
acceleration. It

- equals 2 pi f A in a steady sine;
- needs no centre of the motion;
- measures the acceleration at a reversal, where the force of the damper changes its sign;
- scales with the motion: the same motion at twice the speed has twice the peak velocity, as the
  law requires;
- tolerates noise of the acceleration: the noise enters w as well, so the mean square of v_m is
  twice that of v at any noise level.
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
"""Number of whole half-cycles before the present one that determine the angular frequency."""

MEMORY = 10.0
"""Longest half-cycle [s]: a rest is divided into half-cycles of this duration."""

_TURNED = 0.25
"""A half-cycle ends when the speed in the other direction reaches this fraction of the highest."""

_AT_ONCE, _FEW = 512, 32
"""Samples searched at once for the end of a half-cycle. The larger number is fast for long
recordings; the smaller one applies after a step that ended within few samples."""

_LARGEST = 1e100
"""Inputs are clipped to this magnitude, so that their products do not overflow."""


def peak_velocity(displacement: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike) -> Array:
    """Peak velocity of the present cycle, sqrt(max(v² - a u, 0)) [m/s].

    In sinusoidal motion it is constant and equal to 2 pi f A. Inputs broadcast. The displacement is
    measured from the centre of the motion. This is the formula of the thesis; see
    :class:`PeakVelocity` for a motion that is not a sine.
    """
    u, v, a = (
        np.asarray(x, dtype=float).clip(-_LARGEST, _LARGEST)
        for x in (displacement, velocity, acceleration)
    )
    return np.asarray(np.sqrt(np.maximum(v * v - a * u, 0.0)))


@dataclass
class _HalfCycle:
    """Highest speed [m/s], number of samples, and sums of the squared velocity [m²/s²] and
    acceleration [m²/s⁴]. A half-cycle in which the stream began is not whole.
    """  # noqa: D205

    whole: bool
    highest: float = 0.0
    count: int = 0
    squared_velocity: float = 0.0
    squared_acceleration: float = 0.0

    def add(self, highest: float, velocity: Array, acceleration: Array) -> None:
        """Add samples whose ``highest`` speed [m/s] is given."""
        self.highest = max(self.highest, highest)
        self.count += velocity.size
        self.squared_velocity += float(velocity.dot(velocity))
        self.squared_acceleration += float(acceleration.dot(acceleration))


class PeakVelocity:
    """Peak velocity from a stream of velocity and acceleration samples ``period`` [s] apart.

    ``memory`` [s] must hold half a cycle of the motion. The result does not depend on how the
    stream is divided into blocks. ``known_from`` is the index of the first sample whose angular
    frequency rests on eight half-cycles; it is None before that sample.
    """

    def __init__(self, period: float, memory: float = MEMORY) -> None:
        self._longest = max(round(memory / period), 1)
        self._finished: deque[_HalfCycle] = deque(maxlen=HALF_CYCLES)
        self._present = _HalfCycle(whole=False)
        # Highest speed of the finished half-cycles.
        self._highest = 0.0
        self._sense = 0.0
        self._count = 0
        # Computed from the whole half-cycles, and only when one of them ends.
        self._whole_time_scale: float | None = None
        self._whole_root_mean_square: float | None = None
        self.known_from: int | None = None

    @property
    def half_cycles(self) -> int:
        """Number of whole half-cycles behind the angular frequency, at most eight."""
        return sum(part.whole for part in self._finished)

    @property
    def root_mean_square(self) -> float:
        """Root mean square of the peak velocity [m/s] over the latest half-cycles."""
        if self._whole_root_mean_square is not None:
            return self._whole_root_mean_square
        parts = self._known
        squares = 2.0 * sum(part.squared_velocity for part in parts)
        return math.sqrt(squares / max(sum(part.count for part in parts), 1))

    @property
    def _known(self) -> list[_HalfCycle]:
        """The latest whole half-cycles, or all parts of the stream if none is whole."""
        whole = [part for part in self._finished if part.whole]
        return whole or [*self._finished, self._present]

    def follow(self, velocity: Array, acceleration: Array) -> Array:
        """Peak velocity [m/s] at the next samples of the velocity [m/s] and of the acceleration
        [m/s²], shape (n,).
        """  # noqa: D205
        if velocity.size == 1 and self._whole_time_scale is not None:
            return np.hypot(velocity, acceleration * self._follow_one(velocity, acceleration))
        return np.hypot(velocity, acceleration * self.follow_time_scale(velocity, acceleration))

    def follow_settled(self, velocity: Array, acceleration: Array, settled: int) -> Array:
        """As :meth:`follow`; the observer had settled for the last ``settled`` of the samples.

        An overshoot of the settling observer must not be stored, so the result is the speed there.
        """
        if settled >= velocity.size:
            return self.follow(velocity, acceleration)
        found = np.abs(velocity)
        if settled > 0:
            found[-settled:] = self.follow(velocity[-settled:], acceleration[-settled:])
        return found

    def _follow_one(self, velocity: Array, acceleration: Array) -> float:
        """As :meth:`follow_time_scale`, for a single sample when whole half-cycles are known."""
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
        """Inverse angular frequency [s] at the next samples, shape (n,); see :meth:`follow`."""
        found = np.empty(velocity.size)
        place = 0
        at_once = _AT_ONCE
        with np.errstate(over="ignore"):
            while place < velocity.size:
                part = slice(place, place + at_once)
                used = self._follow_half_cycle(velocity[part], acceleration[part], found[part])
                place += used
                # Short searches limit the cost of a motion that reverses all the time.
                at_once = _FEW if used < _FEW else _AT_ONCE
        return found

    def _follow_half_cycle(self, velocity: Array, acceleration: Array, found: Array) -> int:
        """Process samples up to the end of the half-cycle; returns the number of samples used."""
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
            # Scalar version of _root_of_ratio.
            usable = acceleration > 0.0 and math.isfinite(velocity) and math.isfinite(acceleration)
            self._whole_time_scale = math.sqrt(velocity / acceleration) if usable else 0.0
            self._whole_root_mean_square = None
            self._whole_root_mean_square = self.root_mean_square
        if self.known_from is None and len(self._finished) == HALF_CYCLES:
            self.known_from = self._count


def _root_of_ratio(velocity: Array, acceleration: Array) -> Array:
    """Time scales (n,) [s] from sums of squares; 0 where the sum of squared acceleration is zero
    or a sum overflows.
    """  # noqa: D205
    usable = (acceleration > 0.0) & np.isfinite(velocity) & np.isfinite(acceleration)
    return np.sqrt(np.divide(velocity, acceleration, out=np.zeros(usable.size), where=usable))


class StreamPeakVelocity:
    """Peak velocity from a stream of displacement samples ``period`` [s] apart.

    ``memory`` [s] as in :class:`PeakVelocity`.
    """

    def __init__(self, period: float, memory: float = MEMORY) -> None:
        self._differentiator = AdaptiveObserver(period)
        self._peak = PeakVelocity(period, memory)

    def follow(self, displacement: Array) -> Array:
        """Peak velocity [m/s] at the next samples of the displacement [m], shape (n,)."""
        observer = self._differentiator
        _, velocity, acceleration = observer.follow(displacement)
        return self._peak.follow_settled(velocity, acceleration, observer.settled_count)


def peak_velocity_of_window(velocity: Array, acceleration: Array, period: float) -> Array:
    """Peak velocity [m/s] at samples ``period`` [s] apart of a velocity [m/s] and an acceleration
    [m/s²], shape (n,).

    Samples within the first eight half-cycles use the angular frequency at the end of these, or at
    the end of the window if it holds fewer.
    """  # noqa: D205
    follower = PeakVelocity(period)
    time_scale = follower.follow_time_scale(velocity, acceleration)
    known = velocity.size - 1 if follower.known_from is None else follower.known_from
    time_scale[:known] = time_scale[min(known, velocity.size - 1)]
    return np.hypot(velocity, acceleration * time_scale)


def peak_velocity_of_period(velocity: Array, acceleration: Array, period: float) -> Array:
    """As :func:`peak_velocity_of_window`, for one period of a motion that repeats."""
    follower = PeakVelocity(period)
    follower.follow_time_scale(velocity, acceleration)
    return np.hypot(velocity, acceleration * follower.follow_time_scale(velocity, acceleration))
