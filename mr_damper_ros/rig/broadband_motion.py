"""Motions that are no single sine: a sine whose frequency changes, and random motion."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mr_damper_ros.rig.excitation import ExcitationError, Kinematics
from mr_damper_ros.signals.arrays import Array

_SINES = 48
"""Sines that a random motion is made of."""

_CREST = 3.0
"""Amplitude of a random motion over its standard deviation."""

_TURN = 0.1
"""Part of a step in which the frequency goes over to the next one."""


class SweptSine:
    """A sin(2 pi phi(t)) with a frequency that goes on straight lines between ``times`` [s].

    ``frequencies`` [Hz] has as many values; the last time begins again with the first. Raises
    ExcitationError where times do not rise from 0, or a frequency is not positive.
    """

    centre = 0.0

    def __init__(
        self, amplitude: float, times: Sequence[float], frequencies: Sequence[float]
    ) -> None:
        self._amplitude = amplitude
        self._times = np.asarray(times, dtype=np.float64)
        self._frequencies = np.asarray(frequencies, dtype=np.float64)
        if not (
            self._times.size == self._frequencies.size >= 2
            and self._times[0] == 0.0
            and (np.diff(self._times) > 0.0).all()
        ):
            raise ExcitationError("the times of a swept sine must rise from 0, one a frequency")
        if not (np.isfinite(self._frequencies).all() and (self._frequencies > 0.0).all()):
            raise ExcitationError("the frequencies of a swept sine must be positive")
        lengths = np.diff(self._times)
        self._slopes = np.diff(self._frequencies) / lengths
        means = 0.5 * (self._frequencies[1:] + self._frequencies[:-1])
        self._cycles = np.concatenate([[0.0], np.cumsum(means * lengths)])

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        turns, within = np.divmod(time, self._times[-1])
        place = np.searchsorted(self._times, within, side="right") - 1
        place = np.clip(place, 0, self._slopes.size - 1)
        since = within - self._times[place]
        slope = self._slopes[place]
        frequency = self._frequencies[place] + slope * since
        cycles = self._cycles[place] + (self._frequencies[place] + 0.5 * slope * since) * since
        # Whole cycles leave the sine as it is: the phase of the turns stays small.
        angle = 2.0 * np.pi * (cycles + np.mod(turns * self._cycles[-1], 1.0))
        rate, bend = 2.0 * np.pi * frequency, 2.0 * np.pi * slope
        sine, cosine = np.sin(angle), np.cos(angle)
        a = self._amplitude
        return Kinematics(a * sine, a * rate * cosine, a * (bend * cosine - rate**2 * sine))


def chirp(amplitude: float, low: float, high: float, duration: float) -> SweptSine:
    """A sine that goes from ``low`` to ``high`` [Hz] and back within ``duration`` [s]."""
    return SweptSine(amplitude, (0.0, 0.5 * duration, duration), (low, high, low))


def stepped(amplitude: float, low: float, high: float, duration: float) -> SweptSine:
    """A sine at four frequencies from ``low`` to ``high`` [Hz], each for a part of ``duration``."""
    length = duration / 4.0
    times, frequencies = [], []
    for step, frequency in enumerate(np.geomspace(low, high, 4).tolist()):
        times += [step * length, (step + 1.0 - _TURN) * length]
        frequencies += [frequency, frequency]
    return SweptSine(amplitude, [*times, duration], [*frequencies, low])


class BandLimitedMotion:
    """Random motion from ``low`` to ``high`` [Hz], seldom beyond ``amplitude`` [m]: many sines.

    Raises ExcitationError where the band is empty.
    """

    centre = 0.0

    def __init__(self, amplitude: float, low: float, high: float, seed: int) -> None:
        if not 0.0 < low < high < math.inf:
            raise ExcitationError(
                f"random motion from {low:g} to {high:g} Hz: the highest frequency must be above "
                "the lowest"
            )
        rng = np.random.default_rng(seed)
        edges = np.geomspace(low, high, _SINES + 1)
        self._rates = 2.0 * np.pi * rng.uniform(edges[:-1], edges[1:])
        self._phases = rng.uniform(0.0, 2.0 * np.pi, _SINES)
        # As much speed from each part of the band.
        sizes = 1.0 / self._rates
        spread = float(np.sqrt(0.5 * np.sum(sizes**2)))
        self._sizes = sizes * amplitude / (_CREST * spread)

    def at(self, time: Array) -> Kinematics:
        """Kinematics at the times [s], shape (n,)."""
        angles = np.multiply.outer(time, self._rates) + self._phases
        sines, cosines = np.sin(angles), np.cos(angles)
        return Kinematics(
            sines @ self._sizes,
            cosines @ (self._sizes * self._rates),
            -sines @ (self._sizes * self._rates**2),
        )
