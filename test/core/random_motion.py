"""Motions with their exact velocity and acceleration: random, and a rounded triangle."""

import math

import numpy as np

from mr_damper_ros.kinematics.periodic_motion import Kinematics
from mr_damper_ros.signals.arrays import Array

TONES = 200


class BandLimitedRandom:
    """Gaussian random motion with a flat spectrum from ``low`` to ``high`` [Hz].

    ``rms`` [m] is its standard deviation over a long time; the sum of :data:`TONES` sines with
    random amplitudes, frequencies and phases repeats only after a very long time.
    """

    centre = 0.0

    def __init__(self, rms: float, low: float, high: float, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        steps = (np.arange(TONES) + rng.random(TONES)) / TONES
        scale = rms / math.sqrt(TONES)
        self._rates = 2.0 * np.pi * (low + (high - low) * steps)
        self._sines = scale * rng.standard_normal(TONES)
        self._cosines = scale * rng.standard_normal(TONES)

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        angles = np.outer(time, self._rates)
        sine, cosine = np.sin(angles), np.cos(angles)
        motion = sine @ self._sines + cosine @ self._cosines
        velocity = cosine @ (self._rates * self._sines) - sine @ (self._rates * self._cosines)
        acceleration = -(sine @ (self._rates**2 * self._sines)) - (
            cosine @ (self._rates**2 * self._cosines)
        )
        return Kinematics(motion, velocity, acceleration)


class RoundedTriangle:
    """asin(s sin x) / asin(s), 5 mm at 3 Hz: a sine for s = 0, a triangle for s = 1."""

    centre = 0.0

    def __init__(self, s: float) -> None:
        self._s = s

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        s, rate = self._s, 6.0 * np.pi
        scale = 5e-3 / math.asin(s)
        sine, cosine = np.sin(rate * time), np.cos(rate * time)
        root = np.sqrt(1.0 - (s * sine) ** 2)
        return Kinematics(
            scale * np.arcsin(s * sine),
            scale * rate * s * cosine / root,
            -scale * rate**2 * s * (1.0 - s * s) * sine / root**3,
        )


ROUNDED_TRIANGLE = RoundedTriangle(0.95)
