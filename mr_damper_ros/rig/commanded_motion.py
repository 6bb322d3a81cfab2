"""The motion of a machine that is told what to do while it runs, and never moves with a jerk."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.rig.excitation import (
    EnvelopedMotion,
    Excitation,
    Kinematics,
    RepeatedMotion,
    SineMotion,
)
from mr_damper_ros.signals.arrays import Array

CYCLES = 2.0
"""A sine grows within so many of its cycles, and fades as it grew: its velocity never exceeds that
of the sine itself."""

_SURRENDER = 2.0
"""Seconds within which a motion that is no sine fades when the first command comes."""


@dataclass(frozen=True)
class _Sine:
    """A sine that begins to grow and to fade at these times [s]."""

    amplitude: float
    frequency: float
    begin: float
    end: float = math.inf

    @property
    def change(self) -> float:
        """Time [s] in which it grows, and fades."""
        return CYCLES / self.frequency

    @property
    def over(self) -> float:
        """When it has faded [s]."""
        return self.end + self.change

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,), zero before the beginning."""
        sine = SineMotion(self.amplitude, self.frequency)
        # It has been let fade for ever, and comes back at the beginning.
        grown = EnvelopedMotion(sine, 0.0, -math.inf, self.begin, self.change)
        return _faded(grown, self.end, self.change).at(time)


def _faded(motion: Excitation, end: float, duration: float) -> Excitation:
    if math.isinf(end):
        return motion
    return EnvelopedMotion(motion, 0.0, end, math.inf, duration)


class CommandedMotion:
    """A motion by itself, ``before``, until the first command at ``time`` [s]; then as commanded.

    A new command lets what moves fade, and the new motion grow after that, about the same centre.
    A motion that grows is let grow first.
    """

    def __init__(self, before: Excitation, time: float) -> None:
        self.centre = before.centre
        duration = CYCLES / before.frequency if isinstance(before, SineMotion) else _SURRENDER
        self._before: Excitation | None = _faded(before, time, duration)
        self._free = time + duration
        self._sines: list[_Sine] = []
        self._wanted = (0.0, 0.0)

    def command(self, amplitude: float, frequency: float, time: float) -> None:
        """Make a sine of ``amplitude`` [m] and ``frequency`` [Hz] from ``time`` [s] on; 0: rest.

        The times of commands rise, and no sample after this one has been asked for yet.
        """
        wanted = (amplitude, frequency if amplitude > 0.0 else 0.0)
        if self._before is not None and time >= self._free:
            self._before = None
        self._sines = [sine for sine in self._sines if sine.over > time]
        if wanted == self._wanted:
            return
        self._wanted = wanted
        self._sines = [sine for sine in self._sines if sine.begin <= time]
        free = max(time, self._free)
        if self._sines:
            moving = self._sines[-1]
            if math.isinf(moving.end):
                moving = replace(moving, end=max(time, moving.begin + moving.change))
                self._sines[-1] = moving
            free = max(free, moving.over)
        if amplitude > 0.0:
            self._sines.append(_Sine(amplitude, frequency, free))

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        total = np.zeros((3, time.size))
        if self._before is not None:
            total += np.stack(self._before.at(time))
        else:
            total[0] = self.centre
        for sine in self._sines:
            total += np.stack(sine.at(time))
        return Kinematics(*total)


def is_sine(excitation: Excitation) -> bool:
    """Whether the peak velocity is known at every sample, and need not be waited for."""
    if isinstance(excitation, RepeatedMotion):
        return excitation.is_sine
    plain = isinstance(excitation, SineMotion) and excitation.triangularity == 0.0
    return plain or isinstance(excitation, CommandedMotion)
