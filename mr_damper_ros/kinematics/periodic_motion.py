"""Periodic motions for a test machine: a sine, a swept sine, and random motion with a spectrum.

Each motion is an exact function of time, so its limits can be checked before a machine runs it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array

_GROWTH_CYCLES = 2.0
"""Number of cycles over which a sine grows; its speed then never exceeds the full sine's."""

_FEWEST = 4
"""Smallest number of harmonics of a random motion."""

MOST_CYCLES = 10_000
"""Largest number of cycles of the highest frequency in a period, and number of seeds. More cycles
indicate a mistake in the options, and the motion would take long to compute. The third power of a
cycle plus a seed, in the phase, is still exact."""

_MOST_HARMONICS = 1000
"""Largest number of harmonics of a random motion."""

PHASES = 64
"""Number of samples that represent a cycle."""

_BETWEEN = 1.0 / (1.0 - (math.pi / PHASES) ** 2 / 2.0)
"""Upper bound of the ratio of the true maximum to the largest sample (Bernstein)."""

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""The phase of harmonic k is the fractional part of (k + seed)³ times this, in turns."""


class Kinematics(NamedTuple):
    """Displacement [m], velocity [m/s] and acceleration [m/s²], each of shape (n,)."""

    displacement: Array
    velocity: Array
    acceleration: Array


def ramp(time: Array, begin: float, duration: float) -> Array:
    """A step from 0 to 1 within ``duration`` [s] after ``begin`` [s], twice differentiable.

    Rows (3, n): the step, its derivative (largest in the middle) and its second derivative.
    """
    x = np.clip((time - begin) / duration, 0.0, 1.0)
    return np.stack(
        (
            x**3 * (10.0 - 15.0 * x + 6.0 * x**2),
            30.0 * x**2 * (1.0 - x) ** 2 / duration,
            60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / duration**2,
        )
    )


class MotionKind(str, Enum):
    """Kind of a periodic motion."""

    SINE = "sine"
    SWEEP = "sweep"
    RANDOM = "random"

    @property
    def description(self) -> str:
        """The kind in words."""
        return {"sine": "a sine", "sweep": "a swept sine", "random": "random motion"}[self.value]


@dataclass(frozen=True)
class PeriodicMotion:
    """A motion about zero that repeats, as a function of time.

    ``amplitude`` [m] is the largest displacement. The motion is one of these:

    - A sine of ``frequency`` [Hz].
    - A swept sine. Its frequency changes as a cosine of time from ``frequency`` to
      ``highest_frequency`` and back within ``period`` [s]. The highest frequency is lowered
      slightly if necessary, so that the period holds whole cycles.
    - Random motion: a sum of sines at all multiples of 1/``period`` from ``frequency`` to
      ``highest_frequency``, with equal velocity amplitudes. ``seed`` chooses the phases. The
      motion repeats after the period ("random-phase multisine", Pintelon and Schoukens, "System
      identification", 2012).

    Raises ValueError if a value is out of range, or if too few multiples lie within the band.
    """

    centre = 0.0

    kind: MotionKind
    amplitude: float
    frequency: float
    highest_frequency: float = 0.0
    period: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        is_sine = self.kind is MotionKind.SINE
        needed = ["amplitude", "frequency", "highest_frequency", "period"][: 2 if is_sine else 4]
        for name in needed:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"the {name.replace('_', ' ')} is {value}: it must be positive")
        if is_sine:
            return
        if not self.highest_frequency > self.frequency:
            raise ValueError(
                f"the motion goes from {self.frequency:g} to {self.highest_frequency:g} Hz: the "
                "second frequency must be higher"
            )
        is_random = self.kind is MotionKind.RANDOM
        harmonics = (self.highest_frequency - self.frequency) * self.period
        if self.highest_frequency * self.period > MOST_CYCLES or (
            is_random and harmonics > _MOST_HARMONICS
        ):
            raise ValueError(
                f"a motion of up to {self.highest_frequency:g} Hz that repeats after "
                f"{self.period:g} s has too many cycles: give a shorter period"
            )
        if not 0 <= self.seed < MOST_CYCLES:
            raise ValueError(f"the seed is {self.seed}: give 0 to {MOST_CYCLES - 1}")
        if self._harmonics.size < _FEWEST if is_random else self._mean_frequency <= self.frequency:
            raise ValueError(
                f"{self.period:g} s are too short for a motion from {self.frequency:g} to "
                f"{self.highest_frequency:g} Hz: allow more time, or a wider band"
            )

    @property
    def sentence(self) -> str:
        """Description of the motion in words."""
        band = f"{self.frequency:.3g} to {self.highest_frequency:.3g} Hz"
        how = {
            MotionKind.SINE: f"at {self.frequency:.3g} Hz",
            MotionKind.SWEEP: f"swept from {band} and back within {self.period:.3g} s",
            MotionKind.RANDOM: f"at most, random from {band} (number {self.seed}),",
        }[self.kind]
        return f"{1e3 * self.amplitude:.3g} mm {how}"

    @property
    def length(self) -> float:
        """Time [s] after which the motion repeats."""
        return 1.0 / self.frequency if self.kind is MotionKind.SINE else self.period

    @property
    def growth(self) -> float:
        """Time [s] in which the motion grows from rest, or fades to rest."""
        is_sine = self.kind is MotionKind.SINE
        return _GROWTH_CYCLES / self.frequency if is_sine else self.period

    @property
    def peak_velocity(self) -> float:
        """Upper bound of the speed [m/s]."""
        if self.kind is MotionKind.RANDOM:
            return self._random[1]
        top_frequency = 2.0 * self._mean_frequency - self.frequency
        return 2.0 * math.pi * self.amplitude * top_frequency

    @property
    def growing_velocity(self) -> float:
        """Upper bound of the speed [m/s], including growth and fading."""
        if self.kind is MotionKind.SINE:
            return self.peak_velocity
        steepest = float(ramp(np.array(0.5), 0.0, 1.0)[1])
        return self.peak_velocity + steepest * self.amplitude / self.growth

    @property
    def span(self) -> float:
        """Half the distance [m] between the lowest and the highest displacement."""
        return self._random[2] if self.kind is MotionKind.RANDOM else self.amplitude

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        if self.kind is MotionKind.RANDOM:
            return self._sum(time, self._random[0])
        mean = 2.0 * math.pi * self._mean_frequency
        half = mean - 2.0 * math.pi * self.frequency
        turn = 2.0 * math.pi / self.length
        # Removing whole periods does not change the sine and keeps the angle small.
        within = np.mod(time, self.length)
        angle = mean * within - half / turn * np.sin(turn * within)
        rate = mean - half * np.cos(turn * within)
        bend = half * turn * np.sin(turn * within)
        sine, cosine = self.amplitude * np.sin(angle), self.amplitude * np.cos(angle)
        return Kinematics(sine, rate * cosine, bend * cosine - rate**2 * sine)

    @property
    def _mean_frequency(self) -> float:
        """Mean frequency [Hz] of a sine, or of a swept sine adjusted to whole cycles."""
        if self.kind is MotionKind.SINE:
            return self.frequency
        cycles = math.floor(0.5 * (self.frequency + self.highest_frequency) * self.period + 1e-9)
        return cycles / self.period

    @cached_property
    def _harmonics(self) -> Array:
        first = math.ceil(self.frequency * self.period - 1e-9)
        last = math.floor(self.highest_frequency * self.period + 1e-9)
        return np.arange(max(first, 1), last + 1, dtype=np.float64)

    @cached_property
    def _random(self) -> tuple[Array, float, float]:
        """Amplitudes [m] of the harmonics, bound of the speed [m/s], and half the span [m]."""
        count = PHASES * int(self._harmonics[-1])
        time = np.arange(count, dtype=np.float64) * (self.period / count)
        displacement, velocity, _ = self._sum(time, 1.0 / self._harmonics)
        scale = self.amplitude / (_BETWEEN * float(np.abs(displacement).max()))
        speed = _BETWEEN * scale * float(np.abs(velocity).max())
        return scale / self._harmonics, speed, 0.5 * scale * float(np.ptp(displacement))

    def _sum(self, time: Array, sizes: Array) -> Kinematics:
        """Sum of the harmonics of these amplitudes [m], and its derivatives."""
        rates = 2.0 * math.pi / self.period * self._harmonics
        turns = np.mod(_GOLDEN * (self._harmonics + self.seed) ** 3, 1.0)
        angles = np.multiply.outer(np.mod(time, self.period), rates) + 2.0 * math.pi * turns
        sines, cosines = np.sin(angles), np.cos(angles)
        return Kinematics(sines @ sizes, cosines @ (sizes * rates), -sines @ (sizes * rates**2))


class RepeatedMatch:
    """Compares samples ``period`` [s] apart with a motion of unknown starting phase."""

    def __init__(self, motion: PeriodicMotion, period: float) -> None:
        self.count = max(round(motion.length / period), 2)
        self._wanted, _, _ = motion.at(
            np.arange(self.count, dtype=np.float64) * (motion.length / self.count)
        )

    def left_of(self, displacement: Array) -> float:
        """Root mean square error relative to the motion, at the best starting phase.

        The samples (n,) may have any offset and must last at least one period of the motion.
        """
        size = displacement.size
        centred = displacement - 0.5 * (displacement.max() + displacement.min())
        wanted = self._wanted - 0.5 * (self._wanted.max() + self._wanted.min())
        repeated = np.resize(wanted, self.count + size)
        length = 1 << (repeated.size + size).bit_length()
        spectrum = np.fft.rfft(repeated, length) * np.conj(np.fft.rfft(centred, length))
        common = np.fft.irfft(spectrum, length)[: self.count]
        squares = np.concatenate([[0.0], np.cumsum(repeated**2)])
        power = squares[size : size + self.count] - squares[: self.count]
        left = float(np.min(power - 2.0 * common)) + float(centred @ centred)
        typical = size * float(np.mean(wanted**2))
        return float(np.sqrt(max(left, 0.0) / typical))
