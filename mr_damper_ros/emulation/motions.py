"""Motions of an emulated test machine, with their exact velocity and acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from mr_damper_ros.kinematics.motion import Sine
from mr_damper_ros.kinematics.periodic_motion import Kinematics, MotionKind, PeriodicMotion, ramp
from mr_damper_ros.signals.arrays import Array


class Excitation(Protocol):
    """A motion as a function of time about ``centre`` [m]."""

    @property
    def centre(self) -> float:
        """Centre of the motion [m]."""

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""


class SineMotion(Sine):
    """A sine about zero."""

    centre = 0.0


class SampledMotion:
    """A motion given by samples, such as an earthquake, interpolated by a cubic spline.

    Before the first sample and after the last one, the motion rests at the value of that sample, so
    the spline has zero velocity at both ends.
    """

    def __init__(self, displacement: Array, period: float) -> None:
        """Samples [m] of shape (n,), n >= 4, ``period`` [s] apart; raises ValueError."""
        from scipy.interpolate import CubicSpline  # imported late: see entry_points

        samples = np.array(displacement, dtype=np.float64)
        if samples.ndim != 1 or samples.size < 4 or not np.isfinite(samples).all():
            raise ValueError("the motion needs at least four finite samples of displacement")
        self.centre = float(np.mean(samples))
        self._end = (samples.size - 1) * period
        self._spline = CubicSpline(np.arange(samples.size) * period, samples, bc_type="clamped")

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        moving = (time >= 0.0) & (time <= self._end)
        within = np.clip(time, 0.0, self._end)
        return Kinematics(
            np.asarray(self._spline(within)),
            np.where(moving, self._spline(within, 1), 0.0),
            np.where(moving, self._spline(within, 2), 0.0),
        )


def _ramp_integral(time: Array, begin: float, duration: float) -> Array:
    """Integral of :func:`ramp` over time [s]."""
    x = np.clip((time - begin) / duration, 0.0, 1.0)
    within = duration * x**4 * (2.5 - 3.0 * x + x**2)
    return np.asarray(within + np.maximum(time - begin - duration, 0.0))


@dataclass(frozen=True)
class ChangedMotion:
    """A motion whose amplitude and speed differ from ``begin`` to ``end`` [s].

    The amplitude is multiplied by ``factor``, at other times by ``outside``, and the speed by
    ``tempo``; a tempo of 0 stops the motion. Both change smoothly within ``duration`` [s] after
    ``begin``, and back again after ``end``, which may be infinite.
    """

    motion: Excitation
    begin: float
    end: float
    duration: float
    factor: float = 1.0
    tempo: float = 1.0
    outside: float = 1.0

    @property
    def centre(self) -> float:
        """Centre of the motion [m]."""
        return self.motion.centre

    @property
    def over(self) -> float:
        """Time [s] at which the last change is complete."""
        return self.end + self.duration

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        up, down = (ramp(time, start, self.duration) for start in (self.begin, self.end))
        if self.tempo == 1.0:
            moved = self.motion.at(time)
        else:
            more = self.tempo - 1.0
            tempo, bend, _ = more * (up - down)
            passed, left = (
                _ramp_integral(time, start, self.duration) for start in (self.begin, self.end)
            )
            u, v, a = self.motion.at(time + more * (passed - left))
            tempo = 1.0 + tempo
            moved = Kinematics(u, v * tempo, a * tempo**2 + v * bend)
        value, rate, bend = (self.factor - self.outside) * (up - down)
        value = value + self.outside
        u, v, a = moved
        u = u - self.centre
        return Kinematics(
            self.centre + value * u, value * v + rate * u, value * a + 2.0 * rate * v + bend * u
        )


_TURN = 0.1
"""Fraction of a step in which the frequency changes to the next one."""


class SteppedSine:
    """A repeated sine at four frequencies from ``low`` to ``high`` [Hz] within ``duration`` [s]."""

    centre = 0.0

    def __init__(self, amplitude: float, low: float, high: float, duration: float) -> None:
        from scipy.interpolate import make_interp_spline  # imported late: see entry_points

        begins = np.arange(4.0) * (duration / 4.0)
        times = np.stack([begins, begins + (1.0 - _TURN) * duration / 4.0], axis=1).ravel()
        frequencies = np.repeat(np.geomspace(low, high, 4), 2)
        self._amplitude, self._duration = amplitude, duration
        self._frequency = make_interp_spline([*times, duration], [*frequencies, low], k=1)
        self._slope, self._cycles = self._frequency.derivative(), self._frequency.antiderivative()

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        turns, within = np.divmod(time, self._duration)
        # Whole cycles are removed to keep the phase small and thus accurate.
        before = np.mod(turns * self._cycles(self._duration), 1.0)
        angle = 2.0 * np.pi * (self._cycles(within) + before)
        rate, bend = (2.0 * np.pi * part(within) for part in (self._frequency, self._slope))
        sine, cosine = self._amplitude * np.sin(angle), self._amplitude * np.cos(angle)
        return Kinematics(sine, rate * cosine, bend * cosine - rate**2 * sine)


_FADE_TIME = 2.0
"""Time [s] in which a motion other than a sine fades after the first command."""


class CommandedMotion:
    """A motion that follows commands.

    The motion is ``before`` until the first command at ``time`` [s]. After each command, the
    present motion fades, and the new motion then grows about the same centre. A motion that is
    still growing completes its growth before it fades.
    """

    def __init__(self, before: Excitation, time: float) -> None:
        self.centre = before.centre
        duration = _FADE_TIME
        if isinstance(before, SineMotion):
            duration = PeriodicMotion(MotionKind.SINE, before.amplitude, before.frequency).growth
        self._stretches = [ChangedMotion(before, -math.inf, time, duration, outside=0.0)]
        self._wanted: PeriodicMotion | None = None

    @property
    def is_sine(self) -> bool:
        """Whether all present and pending motions are sines."""
        return all(is_sine(stretch.motion) for stretch in self._stretches)

    def command(self, motion: PeriodicMotion | None, time: float) -> None:
        """Command a motion from ``time`` [s] on; None commands rest.

        The times of commands must increase, and no later sample may have been requested.
        """
        stretches = [stretch for stretch in self._stretches if stretch.over > time]
        if motion != self._wanted:
            self._wanted = motion
            stretches = [stretch for stretch in stretches if stretch.begin <= time]
            if stretches and math.isinf(stretches[-1].end):
                now = stretches[-1]
                stretches[-1] = replace(now, end=max(time, now.begin + now.duration))
            if motion is not None:
                free = max([time, *(stretch.over for stretch in stretches)])
                stretches.append(ChangedMotion(motion, free, math.inf, motion.growth, outside=0.0))
        self._stretches = stretches

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        total = np.zeros((3, time.size))
        total[0] = self.centre
        for stretch in self._stretches:
            u, v, a = stretch.at(time)
            total += (u - stretch.centre, v, a)
        return Kinematics(*total)


def is_sine(excitation: Excitation) -> bool:
    """Whether the motion is a sine, so that each sample determines the peak velocity."""
    if isinstance(excitation, CommandedMotion):
        return excitation.is_sine
    if isinstance(excitation, PeriodicMotion):
        return excitation.kind is MotionKind.SINE
    return isinstance(excitation, SineMotion)
