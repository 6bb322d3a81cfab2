"""Ground motions: one recorded earthquake, and invented ones from a seed.

El Centro is the north-south component of 18 May 1940 (Imperial Valley), recorded by the United
States Coast and Geodetic Survey, in the version of Peknold with 1559 values every 0.02 s that
textbooks use (Chopra, Dynamics of Structures, appendix 6); its peak is 0.319 g. The benchmark also
uses records of Kobe and Maule, which are not in this package; two invented motions replace them.
These are noise with the Kanai-Tajimi spectrum (Tajimi, 2nd World Conference on Earthquake
Engineering, 1960) within an envelope; its low frequencies are removed as Clough and Penzien
propose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import resources

import numpy as np

from mr_damper_ros.signals.arrays import Array

GRAVITY = 9.80665
_EVERY = 0.02
_FINE = 0.005


@dataclass(frozen=True, eq=False)
class GroundMotion:
    """Accelerations (n,) [m/s²] at intervals of ``every`` [s], interpolated linearly."""

    acceleration: Array
    every: float

    @property
    def duration(self) -> float:
        """Time from the first to the last value [s]."""
        return self.every * (self.acceleration.size - 1)

    def at(self, time: Array) -> Array:
        """Acceleration (n,) [m/s²] at these times (n,) [s], the input of the plant."""
        known = self.every * np.arange(self.acceleration.size)
        return np.interp(time, known, self.acceleration, right=0.0)

    def scaled(self, factor: float) -> GroundMotion:
        """The motion multiplied by a factor."""
        return GroundMotion(factor * self.acceleration, self.every)


def el_centro() -> GroundMotion:
    """The record of 1940 at full scale."""
    text = resources.files("studies.control").joinpath("el_centro_1940.csv").read_text("ascii")
    values = np.array([int(value) for line in text.split() for value in line.split(",")])
    return GroundMotion(1e-5 * GRAVITY * values, _EVERY)


@dataclass(frozen=True)
class Shaking:
    """An invented earthquake: peak [g], natural frequency [Hz] and damping ratio of the ground [1].

    It grows for ``rise`` seconds, stays strong for a given time and decays over ``decay`` [s].
    """

    peak: float
    frequency: float
    damping: float
    rise: float
    strong: float
    decay: float
    seed: int

    def motion(self) -> GroundMotion:
        """The motion of this seed."""
        duration = self.rise + self.strong + 3.0 * self.decay
        count = round(duration / _FINE)
        rng = np.random.default_rng(self.seed)
        rates = 2.0 * math.pi * np.fft.rfftfreq(count, _FINE)
        square = (rates / (2.0 * math.pi * self.frequency)) ** 2
        damped = 4.0 * self.damping**2 * square
        power = (1.0 + damped) / ((1.0 - square) ** 2 + damped)
        low = (rates / (2.0 * math.pi * 0.1 * self.frequency)) ** 2
        power *= low**2 / ((1.0 - low) ** 2 + 4.0 * self.damping**2 * low)
        power[rates > 2.0 * math.pi * 25.0] = 0.0
        noise = np.fft.rfft(rng.standard_normal(count))
        time = _FINE * np.arange(count)
        envelope = np.minimum(time / self.rise, 1.0) ** 2
        after = np.maximum(time - self.rise - self.strong, 0.0)
        shaken = (
            np.fft.irfft(noise * np.sqrt(power), count) * envelope * np.exp(-after / self.decay)
        )
        return GroundMotion(self.peak * GRAVITY / float(np.max(np.abs(shaken))) * shaken, _FINE)


NEAR_FAULT = Shaking(0.83, 1.8, 0.35, 3.0, 5.0, 4.0, seed=1995)
"""A motion similar to Kobe: short, strong and slow."""

SUBDUCTION = Shaking(0.55, 3.5, 0.45, 8.0, 12.0, 6.0, seed=2010)
"""A motion similar to Maule: long and faster, shortened to its strong part."""
