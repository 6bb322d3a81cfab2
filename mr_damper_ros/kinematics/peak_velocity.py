"""Causal estimate of the peak velocity of any motion at each sample.

The thesis defines v_m = sqrt(v² - a u), which equals 2 pi f A at every sample of a steady sine. In
any other motion, it depends on the origin of the displacement u, and it is imaginary where the
motion reverses before it reaches that origin. In a sine with the angular frequency w, u = -a / w².
This module substitutes that expression for u, and estimates w from the latest half-cycles of the
motion as w² = <a²> / <v²>, the mean frequency of the reversals of a random motion (Rice, Bell
System Technical Journal 24, 1945). The result

    v_m = sqrt(v² + (a / w)²)

is the peak velocity of the sine with this frequency that has the present velocity and acceleration
(doc/kinematics.md). At a reversal, where the force changes its sign, it depends on the acceleration
alone. It tolerates noise of the acceleration, because w contains the same noise: the mean square of
v_m is twice the mean square of v at any noise level.
"""

from __future__ import annotations

import math
import sys
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.observer import AdaptiveObserver
from mr_damper_ros.signals.arrays import FEW, Array

HALF_CYCLES = 8
"""Number of whole half-cycles before the present one that determine the angular frequency."""

MEMORY = 10.0
"""Longest half-cycle [s]; a longer rest is divided into half-cycles of this duration."""

_AT_ONCE = 1024
"""Number of samples that are processed one by one before a faster way is tried again."""

REVERSAL = 0.25
"""A half-cycle ends when the opposite speed reaches this part of the highest speed, and a stroke
when the motion has returned by this part of its span."""


def peak_velocity(displacement: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike) -> Array:
    """Peak velocity of the present cycle, sqrt(max(v² - a u, 0)) [m/s].

    This is the formula of the thesis. In sinusoidal motion it is constant and equal to 2 pi f A;
    for any other motion see :class:`PeakVelocity`. Inputs broadcast. The displacement is measured
    from the centre of the motion.
    """
    # The sum of two products of these magnitudes does not overflow.
    largest = math.sqrt(0.5 * sys.float_info.max)
    u, v, a = (
        np.asarray(x, dtype=float).clip(-largest, largest)
        for x in (displacement, velocity, acceleration)
    )
    return np.asarray(np.sqrt(np.maximum(v * v - a * u, 0.0)))


@dataclass
class _HalfCycle:
    """Highest speed [m/s], sample count, and sums of squared velocity and acceleration."""

    highest: float = 0.0
    count: int = 0
    squared_velocity: float = 0.0
    squared_acceleration: float = 0.0


class PeakVelocity:
    """Peak velocity from a stream of velocity and acceleration samples ``period`` [s] apart.

    ``memory`` [s] must hold half a cycle of the motion. The result does not depend on how the
    stream is divided into blocks. ``known_from`` is the index of the first sample whose angular
    frequency rests on eight half-cycles; it is None before that sample.
    """

    def __init__(self, period: float, memory: float = MEMORY) -> None:
        self._longest = max(round(memory / period), 1)
        # The half-cycle in which the stream began is not whole; the first whole one replaces it.
        self._finished: deque[_HalfCycle] = deque(maxlen=HALF_CYCLES)
        self._present = _HalfCycle()
        self._highest = 0.0
        self._sense = 0.0
        self._count = 0
        # Computed when a whole half-cycle ends; None before the first.
        self._known_time_scale: float | None = None
        self.root_mean_square = 0.0
        """Root mean square of the peak velocity [m/s] over the latest half-cycles."""
        self.half_cycles = 0
        """Number of whole half-cycles that determine the angular frequency, at most eight."""
        self.known_from: int | None = None

    def follow(self, velocity: Array, acceleration: Array, settled: int | None = None) -> Array:
        """Peak velocity [m/s] of the next samples, from velocity and acceleration, shape (n,).

        Samples before the last ``settled`` ones may contain an overshoot of the observer, which
        must not be stored; their peak velocity is their speed.
        """
        first = 0 if settled is None else max(velocity.size - settled, 0)
        scales = np.zeros(velocity.size)
        scales[first:] = self.time_scales(velocity[first:], acceleration[first:])
        return np.hypot(velocity, acceleration * scales)

    def time_scales(self, velocity: Array, acceleration: Array) -> Array:
        """Inverse angular frequency [s] at the next samples, shape (n,); see :meth:`follow`."""
        scales: list[Array] = []
        done = 0
        while done < velocity.size:
            # The next half-cycle is probably not much longer than the last one.
            likely = min(
                velocity.size - done, 2 * self._finished[-1].count if self._finished else 0
            )
            if self._known_time_scale is None or self._sense == 0.0 or likely <= FEW:
                part, scales_of = slice(done, done + _AT_ONCE), self._scales_of_each
            else:
                part, scales_of = slice(done, done + likely), self._scales_of_half_cycle
            scales.append(scales_of(velocity[part], acceleration[part]))
            done += scales[-1].size
        return np.concatenate(scales) if scales else np.empty(0)

    def _scales_of_half_cycle(self, velocity: Array, acceleration: Array) -> Array:
        """The time scales up to the end of the half-cycle, at most n, as by each sample."""
        present = self._present
        count = min(velocity.size, self._longest - present.count)
        speed = np.abs(velocity[:count])
        highest = np.maximum.accumulate(np.append(present.highest, speed))
        limits = REVERSAL * np.maximum(highest[1:], self._highest)
        reversals = self._sense * velocity[:count] < -limits
        reverses = bool(reversals.any())
        if reverses:
            count = int(np.argmax(reversals))
        scales = np.full(count, self._known_time_scale)
        if count:
            present.highest = float(highest[count])
            present.count += count
            # A running sum is rounded like a loop over the samples.
            for name, values in (("velocity", velocity), ("acceleration", acceleration)):
                key = f"squared_{name}"
                steps = np.append(getattr(present, key), values[:count] ** 2)
                setattr(present, key, float(np.cumsum(steps)[-1]))
            self._count += count
        if reverses:
            self._sense = -self._sense
            self._finish()
        elif present.count == self._longest:
            self._finish()
        return scales

    def _scales_of_each(self, velocity: Array, acceleration: Array) -> Array:
        """The time scales of all n samples, one by one."""
        scales = []
        for v, a in zip(velocity.tolist(), acceleration.tolist(), strict=True):
            speed = abs(v)
            if self._sense == 0.0 and v != 0.0:
                self._sense = math.copysign(1.0, v)
            present = self._present
            if self._sense * v < -REVERSAL * max(self._highest, present.highest, speed):
                self._sense = -self._sense
                self._finish()
                present = self._present
            present.highest = max(present.highest, speed)
            present.count += 1
            present.squared_velocity += v * v
            present.squared_acceleration += a * a
            self._count += 1
            scale = self._known_time_scale
            scales.append(self._estimate() if scale is None else scale)
            if present.count == self._longest:
                self._finish()
        return np.array(scales)

    def _estimate(self) -> float:
        """Time scale [s] of all half-cycles; 0 without acceleration or after an overflow."""
        parts = self._finished if self.half_cycles else [*self._finished, self._present]
        velocity = sum(part.squared_velocity for part in parts)
        acceleration = sum(part.squared_acceleration for part in parts)
        self.root_mean_square = math.sqrt(2.0 * velocity / sum(part.count for part in parts))
        usable = acceleration > 0.0 and math.isfinite(velocity) and math.isfinite(acceleration)
        return math.sqrt(velocity / acceleration) if usable else 0.0

    def _finish(self) -> None:
        is_whole = bool(self._finished)
        if is_whole and not self.half_cycles:
            self._finished.clear()
        self._finished.append(self._present)
        self._highest = max(part.highest for part in self._finished)
        self._present = _HalfCycle()
        if is_whole:
            self.half_cycles = len(self._finished)
            self._known_time_scale = self._estimate()
            if self.known_from is None and self.half_cycles == HALF_CYCLES:
                self.known_from = self._count


class StreamPeakVelocity:
    """Peak velocity from a stream of displacement samples ``period`` [s] apart.

    ``memory`` [s] is as in :class:`PeakVelocity`.
    """

    def __init__(self, period: float, memory: float = MEMORY) -> None:
        self._differentiator = AdaptiveObserver(period)
        self._peak = PeakVelocity(period, memory)

    def follow(self, displacement: Array) -> Array:
        """Peak velocity [m/s] at the next samples of the displacement [m], shape (n,)."""
        _, velocity, acceleration = self._differentiator.follow(displacement)
        return self._peak.follow(velocity, acceleration, self._differentiator.settled_count)


def peak_velocity_of_window(velocity: Array, acceleration: Array, period: float) -> Array:
    """Peak velocity [m/s] at samples (n,) of velocity and acceleration, ``period`` [s] apart.

    Samples within the first eight half-cycles use the angular frequency of these half-cycles, or of
    the whole window if it holds fewer.
    """
    follower = PeakVelocity(period)
    time_scale = follower.time_scales(velocity, acceleration)
    known = velocity.size - 1 if follower.known_from is None else follower.known_from
    time_scale[:known] = time_scale[min(known, velocity.size - 1)]
    return np.hypot(velocity, acceleration * time_scale)


def peak_velocity_of_period(velocity: Array, acceleration: Array, period: float) -> Array:
    """As :func:`peak_velocity_of_window`, for one period of a motion that repeats."""
    follower = PeakVelocity(period)
    follower.time_scales(velocity, acceleration)
    return follower.follow(velocity, acceleration)
