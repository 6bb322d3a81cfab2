"""Motions of an emulated test machine, with their exact velocity and acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.signals.arrays import Array


class ExcitationError(ValueError):
    """A motion that cannot be made; the message says what to change."""


class Kinematics(NamedTuple):
    """Displacement [m], velocity [m/s] and acceleration [m/s²], each of shape (n,)."""

    displacement: Array
    velocity: Array
    acceleration: Array


class Excitation(Protocol):
    """A motion as a function of time; ``centre`` [m] is the displacement it moves about."""

    @property
    def centre(self) -> float:
        """Displacement [m] that the motion is about."""

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0.0):
            raise ExcitationError(f"the {name.replace('_', ' ')} is {value}: it must be positive")


@dataclass(frozen=True)
class SineMotion:
    """offset + A sin(2 pi f t + phase), or, with ``triangularity`` above 0, a rounded triangle.

    ``amplitude`` [m], ``frequency`` [Hz], ``phase`` [rad], ``offset`` [m]. ``triangularity`` lies
    in 0 to below 1: a test machine that cannot follow a sine (above about 3 Hz in the thesis)
    makes a motion of nearly constant speed with short turns.

    Raises ExcitationError where a value is out of range.
    """

    amplitude: float
    frequency: float
    phase: float = 0.0
    offset: float = 0.0
    triangularity: float = 0.0

    def __post_init__(self) -> None:
        _require_positive(amplitude=self.amplitude, frequency=self.frequency)
        if not 0.0 <= self.triangularity < 1.0:
            raise ExcitationError(
                f"the triangularity is {self.triangularity}: it must lie in 0 (sine) to below 1"
            )

    @property
    def centre(self) -> float:
        """Displacement [m] that the motion is about."""
        return self.offset

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        rate = 2.0 * np.pi * self.frequency
        angle = rate * time + self.phase
        sine, cosine = np.sin(angle), np.cos(angle)
        s = self.triangularity
        if s == 0.0:
            scale = self.amplitude
            return Kinematics(
                self.offset + scale * sine, scale * rate * cosine, -scale * rate**2 * sine
            )
        # asin(s sin x) / asin(s) goes from the sine (s = 0) to the triangle (s = 1).
        scale = self.amplitude / math.asin(s)
        root = np.sqrt(1.0 - (s * sine) ** 2)
        return Kinematics(
            self.offset + scale * np.arcsin(s * sine),
            scale * rate * s * cosine / root,
            -scale * rate**2 * s * (1.0 - s * s) * sine / root**3,
        )


@dataclass(frozen=True)
class RepeatedMotion:
    """A motion that repeats, about ``centre`` [m]."""

    motion: PeriodicMotion
    centre: float = 0.0

    @property
    def is_sine(self) -> bool:
        """Whether it is a plain sine."""
        return self.motion.kind is MotionKind.SINE

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        displacement, velocity, acceleration = self.motion.at(time)
        return Kinematics(self.centre + displacement, velocity, acceleration)


class SampledMotion:
    """Any motion given by samples, such as an earthquake; a cubic spline goes through them.

    After the last sample (and before the first) it stands still at the value there, for which the
    spline starts and ends at rest.
    """

    def __init__(self, displacement: Array, period: float) -> None:
        """Samples [m] of shape (n,), n >= 4, ``period`` [s] apart; raises ExcitationError."""
        from scipy.interpolate import CubicSpline  # here: see mr_damper_ros.entry_points

        _require_positive(period=period)
        samples = np.array(displacement, dtype=np.float64)
        if samples.ndim != 1 or samples.size < 4 or not np.isfinite(samples).all():
            raise ExcitationError("the motion needs at least four finite samples of displacement")
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


class _Ramp(NamedTuple):
    """A smooth step, its derivative and its second derivative, each of shape (n,)."""

    value: Array
    rate: Array
    bend: Array


def _ramp(time: Array, begin: float, duration: float) -> _Ramp:
    """From 0 before ``begin`` to 1 ``duration`` [s] later, twice continuously differentiable."""
    x = np.clip((time - begin) / duration, 0.0, 1.0)
    return _Ramp(
        x**3 * (10.0 - 15.0 * x + 6.0 * x**2),
        30.0 * x**2 * (1.0 - x) ** 2 / duration,
        60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / duration**2,
    )


def _ramp_integral(time: Array, begin: float, duration: float) -> Array:
    """Integral of :func:`_ramp` over the time [s]."""
    x = np.clip((time - begin) / duration, 0.0, 1.0)
    within = duration * x**4 * (2.5 - 3.0 * x + x**2)
    return np.asarray(within + np.maximum(time - begin - duration, 0.0))


@dataclass(frozen=True)
class EnvelopedMotion:
    """A motion that is ``factor`` times as large about its centre from ``begin`` to ``end`` [s].

    It changes smoothly within ``duration`` [s], and back again after the end, which may be
    infinite.
    """

    motion: Excitation
    factor: float
    begin: float
    end: float
    duration: float

    @property
    def centre(self) -> float:
        """Displacement [m] that the motion is about."""
        return self.motion.centre

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        up, down = (_ramp(time, start, self.duration) for start in (self.begin, self.end))
        value, rate, bend = (
            (self.factor - 1.0) * (one - other) for one, other in zip(up, down, strict=True)
        )
        value = 1.0 + value
        u, v, a = self.motion.at(time)
        u = u - self.centre
        return Kinematics(
            self.centre + value * u, value * v + rate * u, value * a + 2.0 * rate * v + bend * u
        )


@dataclass(frozen=True)
class WarpedMotion:
    """A motion that goes on ``tempo`` times as fast from ``begin`` to ``end`` [s]; 0: it stands.

    The tempo changes smoothly within ``duration`` [s], and back again after the end, which may be
    infinite.
    """

    motion: Excitation
    tempo: float
    begin: float
    end: float
    duration: float

    @property
    def centre(self) -> float:
        """Displacement [m] that the motion is about."""
        return self.motion.centre

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        up, down = (_ramp(time, start, self.duration) for start in (self.begin, self.end))
        passed = _ramp_integral(time, self.begin, self.duration) - _ramp_integral(
            time, self.end, self.duration
        )
        change = self.tempo - 1.0
        tempo = 1.0 + change * (up.value - down.value)
        bend = change * (up.rate - down.rate)
        u, v, a = self.motion.at(time + change * passed)
        return Kinematics(u, v * tempo, a * tempo**2 + v * bend)
