"""Faults of machine and damper: the force is another one, or the motion, or the coil's current."""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.rig.excitation import EnvelopedMotion, Excitation, Kinematics, WarpedMotion
from mr_damper_ros.rig.faults.fault import Fault
from mr_damper_ros.signals.arrays import Array

_CHANGE = 0.1
"""Time [s] that the machine takes to change its motion."""


class ForceLoss(Fault):
    """The damper has lost oil, or its seal leaks."""

    name = "force_loss"
    meaning = "the damper's force is so many times what it was (a leak)"
    unit = "1"
    usual = 0.5

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        return np.where(self.active(time), self.amount, 1.0) * force


class Wear(Fault):
    """The damper gets weaker, evenly from the beginning to the end, and stays so."""

    name = "wear"
    meaning = "the damper's force changes evenly to so many times what it was, and stays there"
    unit = "1"
    usual = 0.7

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        if math.isinf(self.end):
            return force
        return np.interp(time, (self.begin, self.end), (1.0, self.amount)) * force


class Friction(Fault):
    """Something rubs."""

    name = "friction"
    meaning = "so much dry friction besides the damper"
    unit = "N"
    usual = 200.0
    _SLOW = 1e-3

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        rubbing = self.amount * np.tanh(motion.velocity / self._SLOW)
        return force + np.where(self.active(time), rubbing, 0.0)


class Spring(Fault):
    """Something elastic got in between."""

    name = "spring"
    meaning = "a spring of so much stiffness beside the damper"
    unit = "N/m"
    usual = 1e5

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        return force + np.where(self.active(time), self.amount * motion.displacement, 0.0)


class EndStop(Fault):
    """The piston hits the end of its stroke."""

    name = "end_stop"
    meaning = "beyond this displacement to either side a stop of 1 kN/mm"
    unit = "m"
    usual = 0.004
    least = 0.0
    _STIFFNESS = 1e6

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        u = motion.displacement
        beyond = u - np.clip(u, -self.amount, self.amount)
        return force + np.where(self.active(time), self._STIFFNESS * beyond, 0.0)


class Backlash(Fault):
    """The clevis has play: after each reversal the rod follows only when that is used up."""

    name = "backlash"
    meaning = "so much play between machine and rod: no force until it is used up"
    unit = "m"
    usual = 0.5e-3
    least = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._rod = math.nan

    def resisted(self, time: Array, motion: Kinematics, force: Array) -> Array:
        """Force [N]."""
        there = self.active(time)
        if not there.any():
            return force
        result = force.copy()
        half = 0.5 * self.amount
        for place in np.flatnonzero(there):
            u = float(motion.displacement[place])
            rod = u if math.isnan(self._rod) else min(max(self._rod, u - half), u + half)
            if rod == self._rod:
                result[place] = 0.0
            self._rod = rod
        return result


class CoilFactor(Fault):
    """The coil gets another current than the supply reports: a short, a broken wire."""

    name = "coil_factor"
    meaning = "the coil gets so many times the current that the supply reports (0: a broken wire)"
    unit = "1"
    usual = 0.0

    def energised(self, time: Array, current: Array) -> Array:
        """Current [A] in the coil."""
        return np.where(self.active(time), self.amount, 1.0) * current


class CoilOffset(Fault):
    """The coil gets more than the supply reports."""

    name = "coil_offset"
    meaning = "the coil gets so much more current than the supply reports"
    unit = "A"
    usual = 0.1

    def energised(self, time: Array, current: Array) -> Array:
        """Current [A] in the coil."""
        return current + np.where(self.active(time), self.amount, 0.0)


class Amplitude(Fault):
    """The machine moves by another amplitude."""

    name = "amplitude"
    meaning = "the motion is so many times what it was"
    unit = "1"
    usual = 0.1

    def moved(self, excitation: Excitation) -> Excitation:
        """The motion made larger or smaller, smoothly within a tenth of a second."""
        return EnvelopedMotion(excitation, self.amount, self.begin, self.end, _CHANGE)


class Tempo(Fault):
    """The machine moves faster or slower, or stands still where it is."""

    name = "tempo"
    meaning = "the motion goes on so many times as fast; 0: the machine stands still"
    unit = "1"
    usual = 0.0
    least = 0.0

    def moved(self, excitation: Excitation) -> Excitation:
        """The motion faster or slower, smoothly within a tenth of a second."""
        return WarpedMotion(excitation, self.amount, self.begin, self.end, _CHANGE)
