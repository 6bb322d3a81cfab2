"""Random motion with its exact velocity and acceleration."""

from __future__ import annotations

import math

import numpy as np

from mr_damper_ros.emulation.motions import Kinematics
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
