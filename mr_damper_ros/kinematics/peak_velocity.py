"""Peak velocity of any motion, sample by sample, from the past alone.

The thesis takes v_m = sqrt(v² - a u), the peak velocity of the present cycle. In a steady sine that
is 2 pi f A at every sample. In any other motion it is no peak of anything: it depends on where the
displacement is counted from, it is not real wherever the motion turns on the far side of that
centre, and it holds the noise of the acceleration. Here v_m is what it is called: the largest speed
of the latest half-cycles. It

- equals 2 pi f A in a steady sine;
- needs no centre of the motion and no acceleration;
- changes with the motion, not with the clock: the same motion played twice as fast has twice the
  peak velocity, as the law expects;
- rises with the motion at once, and falls within some cycles.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.damper.sigmoid import Array
from mr_damper_ros.kinematics.causal import CausalDifferentiator, possible_bandwidths

HALF_CYCLES = 8
"""The peak is taken over the present half-cycle and so many before it.

Of a random motion the highest speed of one half-cycle scatters by half of itself (Rayleigh's
distribution); that of eight by a quarter, so that they stay about one operating point.
"""

MEMORY = 10.0
"""What lies longer ago [s] is forgotten in any case, so that a rest comes to an end."""

_TURNED = 0.25
"""A half-cycle ends where the speed the other way comes to this part of the peak velocity."""

_STRETCHES = 64

_BANDWIDTH = 40.0
"""Corner [Hz] of the observer of the velocity, where it is not observed anyway."""


@dataclass(frozen=True)
class _Stretch:
    """Largest speed [m/s], index of the last sample and number of the half-cycle."""

    peak: float
    last: int
    half_cycle: int


class PeakVelocity:
    """Follows the velocity of a stream of samples ``period`` [s] apart.

    ``memory`` [s] must hold half a cycle of the motion. What it returns does not depend on how
    the stream is cut into blocks.
    """

    def __init__(self, period: float, memory: float = MEMORY) -> None:
        self._memory = max(round(memory / period), 1)
        self._length = max(self._memory // _STRETCHES, 1)
        # Only what may yet be the peak is kept: each is higher than all that come after it.
        self._kept: deque[_Stretch] = deque()
        self._count = 0
        self._peak = 0.0
        self._stretch_end = self._length
        self._sense = 0.0
        self._half_cycle = 0

    def follow(self, velocity: Array) -> Array:
        """Peak velocity [m/s] at the next samples of the velocity [m/s], shape (n,)."""
        found = np.empty(velocity.size)
        place = 0
        while place < velocity.size:
            room = self._stretch_end - self._count
            place += self._follow_stretch(velocity[place : place + room], found[place:])
        return found

    def _follow_stretch(self, velocity: Array, found: Array) -> int:
        """Follow up to the end of the stretch or of the half-cycle; returns the samples used."""
        before = max(self._peak, self._kept[0].peak if self._kept else 0.0)
        highest = np.maximum.accumulate(np.maximum(np.abs(velocity), before))
        if self._sense == 0.0:
            self._sense = float(np.sign(velocity[0]))
        turned = self._sense * velocity < -_TURNED * highest
        used = int(np.argmax(turned)) if turned.any() else velocity.size
        if used > 0:
            found[:used] = highest[:used]
            self._peak = max(self._peak, float(np.max(np.abs(velocity[:used]))))
            self._count += used
        if used < velocity.size:
            self._end_stretch()
            self._half_cycle += 1
            self._sense = -self._sense
            self._forget()
        elif self._count == self._stretch_end:
            self._end_stretch()
            self._forget()
        return used

    def _end_stretch(self) -> None:
        while self._kept and self._kept[-1].peak <= self._peak:
            self._kept.pop()
        self._kept.append(_Stretch(self._peak, self._count - 1, self._half_cycle))
        self._peak = 0.0
        self._stretch_end = self._count + self._length

    def _forget(self) -> None:
        oldest_half_cycle = self._half_cycle - HALF_CYCLES
        oldest = self._count - self._memory
        while self._kept and (
            self._kept[0].half_cycle < oldest_half_cycle or self._kept[0].last < oldest
        ):
            self._kept.popleft()


class StreamPeakVelocity:
    """Follows the displacement of a stream of samples ``period`` [s] apart."""

    def __init__(self, period: float) -> None:
        bandwidth = float(np.clip(_BANDWIDTH, *possible_bandwidths(period)))
        self._differentiator = CausalDifferentiator(period, bandwidth)
        self._peak = PeakVelocity(period)

    def follow(self, displacement: Array) -> Array:
        """Peak velocity [m/s] at the next samples of the displacement [m], shape (n,)."""
        _, velocity, _ = self._differentiator.follow(displacement)
        if not self._differentiator.settled:
            # What overshoots while the observer settles must not be remembered as a peak.
            return np.abs(velocity)
        return self._peak.follow(velocity)


def peak_velocity_of_window(velocity: Array, period: float) -> Array:
    """Peak velocity [m/s] at the samples of a velocity of shape (n,) [m/s], ``period`` [s] apart.

    As of a stream that went on before the window as in its first half-cycle.
    """
    found = PeakVelocity(period).follow(velocity)
    first = _turn_after(velocity, 0)
    second = _turn_after(velocity, first)
    # The end of a half-cycle of which the window holds no more says nothing of its peak.
    remnant = _top_speed(velocity[:first]) < _TURNED * _top_speed(velocity[first:second])
    known = second if remnant else first
    found[:known] = found[min(known, velocity.size - 1)]
    return found


def _turn_after(velocity: Array, first: int) -> int:
    """Where the half-cycle of sample ``first`` ends, the end of the window at the latest."""
    rest = velocity[first:]
    sense = np.sign(rest[np.argmax(rest != 0.0)]) if rest.size else 0.0
    turned = sense * rest < -_TURNED * np.maximum.accumulate(np.abs(rest))
    return first + (int(np.argmax(turned)) if turned.any() else rest.size)


def _top_speed(velocity: Array) -> float:
    return float(np.max(np.abs(velocity), initial=0.0))
