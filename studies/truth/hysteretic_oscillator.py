"""The hysteretic benchmark of Noël and Schoukens: a mass on a spring and a Bouc-Wen hysteresis.

J. P. Noël and M. Schoukens, Hysteretic benchmark with a dynamic nonlinearity, Workshop on Nonlinear
System Identification Benchmarks, Brussels, 2016. Equations, parameters, steps and signals are
those of its public descriptions; its files are not needed, for everything is simulated here:

    m y'' + c y' + k y + z = u,    z' = alpha y' - beta (gamma |y'| z + delta y' |z|)

The steps are Newmark's of constant average acceleration, and the trapezoidal rule for z. Theirs are
20 to a sample of 1/750 s; filtering and thinning afterwards keeps what is below half the rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array

PERIOD = 1.0 / 750.0
"""[s], of the samples."""

STEPS = 20
"""Steps of the simulation to a sample."""

COUNT = 8192
"""Samples of a period of a multisine."""

BAND = (5.0, 150.0)
"""[Hz], of a multisine."""

FORCE_RMS = 50.0
"""[N], of a multisine."""

OUTPUT_NOISE = 8e-6
"""Standard deviation [m] of the noise of the displacement where a model is estimated."""

_SWEEP_FORCE, _SWEEP_FROM, _SWEEP_TO, _SWEEP_RATE = 40.0, 20.0, 50.0, 10.0 / 60.0

_THINNING = (2, 2, 5)
"""Stages in which the simulation is thinned to the samples."""

_CLOSE = 1e-12
"""A step is solved once the velocity changes by less than this part of its size ..."""

_MOST_ROUNDS = 20


@dataclass(frozen=True)
class HystereticOscillator:
    """Mass [kg], damping [N s/m], stiffness [N/m] and the hysteresis; the defaults are the truth.

    ``alpha`` [N/m] is its stiffness at rest, ``with_speed`` beta gamma and ``with_motion`` beta
    delta [1/m]: what of it there is to find, since the three of them are one too many.
    """

    mass: float = 2.0
    damping: float = 10.0
    stiffness: float = 5e4
    alpha: float = 5e4
    with_speed: float = 1e3 * 0.8
    with_motion: float = 1e3 * -1.1

    def rate(self, velocity: float, z: float) -> float:
        """Derivative of z [N/s]."""
        return (
            self.alpha * velocity
            - self.with_speed * abs(velocity) * z
            - self.with_motion * velocity * abs(z)
        )

    def simulate(self, force: Array, step: float) -> Response:
        """Answer to a force (n,) [N] of every ``step`` [s], from rest."""
        m, c, k = self.mass, self.damping, self.stiffness
        half = 0.5 * step
        held = 2.0 * m / step + c + k * half
        y = v = z = rate = 0.0
        a = float(force[0]) / m
        rows = [(y, v, a, z)]
        for u in force[1:].tolist():
            known = u - k * (y + half * v) + m * (2.0 * v / step + a)
            fast, begun = v + step * a, z + half * rate
            late = z
            for _ in range(_MOST_ROUNDS):
                late = begun + half * self.rate(fast, late)
                found = (known - late) / held
                change, fast = found - fast, found
                if abs(change) <= _CLOSE * abs(found):
                    break
            y += half * (v + fast)
            a = 2.0 * (fast - v) / step - a
            v, z = fast, late
            rate = self.rate(v, z)
            rows.append((y, v, a, z))
        return Response(*np.array(rows).T)


class Response(NamedTuple):
    """Displacement [m], velocity [m/s], acceleration [m/s²], hysteretic force [N]; each (n,)."""

    displacement: Array
    velocity: Array
    acceleration: Array
    hysteretic: Array


TRUTH = HystereticOscillator()


def multisine(seed: int, count: int = COUNT, steps: int = STEPS) -> Array:
    """A period (count * steps,) [N] of a random-phase multisine, at the steps of the simulation."""
    lines = np.fft.rfftfreq(count, PERIOD)
    chosen = np.flatnonzero((lines >= BAND[0]) & (lines <= BAND[1]))
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi, chosen.size)
    spectrum = np.zeros(count * steps // 2 + 1, dtype=complex)
    spectrum[chosen] = np.exp(1j * phases)
    signal = np.fft.irfft(spectrum, count * steps)
    return np.asarray(FORCE_RMS * signal / np.sqrt(np.mean(signal**2)))


def sine_sweep(duration: float = math.inf, steps: int = STEPS) -> Array:
    """A sweep (n,) [N] of 40 N from 20 to 50 Hz by 10 Hz a minute, or the beginning of it."""
    longest = (_SWEEP_TO - _SWEEP_FROM) / _SWEEP_RATE
    time = np.arange(0.0, min(duration, longest), PERIOD / steps)
    return np.asarray(
        _SWEEP_FORCE * np.sin(2.0 * math.pi * (_SWEEP_FROM * time + 0.5 * _SWEEP_RATE * time**2))
    )


def thinned(signal: Array, steps: int = STEPS) -> Array:
    """A simulated signal at the samples, what is above half their rate taken out first."""
    from scipy.signal import decimate  # here: see mr_damper_ros.entry_points

    for factor in _THINNING:
        if steps % factor == 0:
            signal = decimate(signal, factor, ftype="fir")
            steps //= factor
    return np.asarray(signal)


def settled(oscillator: HystereticOscillator, period: Array, steps: int = STEPS) -> Response:
    """Answer at the samples to a force that goes on for ever: the second of two periods.

    One more is simulated behind them, so that the filters of the thinning have no edge.
    """
    half = period.size // 2
    force = np.concatenate((period, period, period[:half]))
    answer = oscillator.simulate(force, PERIOD / steps)
    count = period.size // steps
    return Response(*(thinned(part, steps)[count : 2 * count] for part in answer))
