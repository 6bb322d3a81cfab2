"""The motion of a machine that is told what to do while it runs, and never moves with a jerk."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.rig.excitation import (
    EnvelopedMotion,
    Excitation,
    Kinematics,
    RepeatedMotion,
    SineMotion,
)
from mr_damper_ros.signals.arrays import Array

_SURRENDER = 2.0
"""Seconds within which a motion that is no sine fades when the first command comes."""


@dataclass(frozen=True)
class _Moved:
    """A motion that begins to grow and to fade at these times [s]."""

    motion: PeriodicMotion
    begin: float
    end: float = math.inf

    @property
    def change(self) -> float:
        """Time [s] in which it grows, and fades."""
        return self.motion.growth

    @property
    def over(self) -> float:
        """When it has faded [s]."""
        return self.end + self.change

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,), zero before the beginning."""
        # It has been let fade for ever, and comes back at the beginning.
        whole = RepeatedMotion(self.motion)
        grown = EnvelopedMotion(whole, 0.0, -math.inf, self.begin, self.change)
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
        duration = _SURRENDER
        if isinstance(before, SineMotion):
            duration = PeriodicMotion(MotionKind.SINE, before.amplitude, before.frequency).growth
        self._before: Excitation | None = _faded(before, time, duration)
        self._free = time + duration
        self._stretches: list[_Moved] = []
        self._wanted: PeriodicMotion | None = None

    @property
    def is_sine(self) -> bool:
        """Whether nothing but sines is under way, or to come."""
        return all(one.motion.kind is MotionKind.SINE for one in self._stretches)

    def command(self, motion: PeriodicMotion | None, time: float) -> None:
        """Make a motion from ``time`` [s] on, None for rest.

        The times of commands rise, and no sample after this one has been asked for yet.
        """
        if self._before is not None and time >= self._free:
            self._before = None
        self._stretches = [one for one in self._stretches if one.over > time]
        if motion == self._wanted:
            return
        self._wanted = motion
        self._stretches = [one for one in self._stretches if one.begin <= time]
        free = max(time, self._free)
        if self._stretches:
            moving = self._stretches[-1]
            if math.isinf(moving.end):
                moving = replace(moving, end=max(time, moving.begin + moving.change))
                self._stretches[-1] = moving
            free = max(free, moving.over)
        if motion is not None:
            self._stretches.append(_Moved(motion, free))

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        total = np.zeros((3, time.size))
        if self._before is not None:
            total += np.stack(self._before.at(time))
        else:
            total[0] = self.centre
        for one in self._stretches:
            total += np.stack(one.at(time))
        return Kinematics(*total)


def is_sine(excitation: Excitation) -> bool:
    """Whether the peak velocity is known at every sample, and need not be waited for."""
    if isinstance(excitation, (RepeatedMotion, CommandedMotion)):
        return excitation.is_sine
    return isinstance(excitation, SineMotion) and excitation.triangularity == 0.0
