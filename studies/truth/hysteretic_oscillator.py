"""The hysteretic benchmark of Noël and Schoukens: a mass on a spring and a Bouc-Wen hysteresis.

J. P. Noël and M. Schoukens, Hysteretic benchmark with a dynamic nonlinearity, Workshop on Nonlinear
System Identification Benchmarks, Brussels, 2016. Equations, parameters, steps and signals follow
its public descriptions. Its files are not needed, because this module simulates everything:

    m y'' + c y' + k y + z = u,    z' = alpha y' - beta (gamma |y'| z + delta y' |z|)

The integration uses Newmark's method with constant average acceleration, and the trapezoidal rule
for z. As in the benchmark, a sample of 1/750 s has 20 steps. Filtering and decimation then keep the
frequencies below half the sample rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array

PERIOD = 1.0 / 750.0
"""Sample period [s]."""

STEPS = 20
"""Simulation steps per sample."""

COUNT = 8192
"""Samples in a period of a multisine."""

BAND = (5.0, 150.0)
"""Band of a multisine [Hz]."""

FORCE_RMS = 50.0
"""Root mean square force of a multisine [N]."""

OUTPUT_NOISE = 8e-6
"""Standard deviation [m] of the displacement noise in the estimation of a model."""

_SWEEP_FORCE, _SWEEP_FROM, _SWEEP_TO, _SWEEP_RATE = 40.0, 20.0, 50.0, 10.0 / 60.0

_THINNING = (2, 2, 5)
"""Decimation factors from the simulation steps to the samples."""

_CLOSE = 1e-12
"""A step has converged if the velocity changes by less than this fraction of its magnitude."""

_MOST_ROUNDS = 20


@dataclass(frozen=True)
class HystereticOscillator:
    """Mass [kg], damping [N s/m], stiffness [N/m] and the hysteresis; the defaults are the truth.

    ``alpha`` [N/m] is the stiffness of the hysteresis at rest. ``with_speed`` is beta gamma and
    ``with_motion`` is beta delta [1/m]: only these products are identifiable.
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
        """Response from rest to a force (n,) [N] given every ``step`` [s]."""
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
    """One period (count * steps,) [N] of a random-phase multisine at the simulation steps."""
    lines = np.fft.rfftfreq(count, PERIOD)
    chosen = np.flatnonzero((lines >= BAND[0]) & (lines <= BAND[1]))
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi, chosen.size)
    spectrum = np.zeros(count * steps // 2 + 1, dtype=complex)
    spectrum[chosen] = np.exp(1j * phases)
    signal = np.fft.irfft(spectrum, count * steps)
    return np.asarray(FORCE_RMS * signal / np.sqrt(np.mean(signal**2)))


def sine_sweep(duration: float = math.inf, steps: int = STEPS) -> Array:
    """A sweep (n,) [N] of 40 N from 20 to 50 Hz at 10 Hz per minute, or the beginning of it."""
    longest = (_SWEEP_TO - _SWEEP_FROM) / _SWEEP_RATE
    time = np.arange(0.0, min(duration, longest), PERIOD / steps)
    return np.asarray(
        _SWEEP_FORCE * np.sin(2.0 * math.pi * (_SWEEP_FROM * time + 0.5 * _SWEEP_RATE * time**2))
    )


def thinned(signal: Array, steps: int = STEPS) -> Array:
    """A simulated signal decimated to the samples, after an anti-aliasing filter."""
    from scipy.signal import decimate  # here: see mr_damper_ros.entry_points

    for factor in _THINNING:
        if steps % factor == 0:
            signal = decimate(signal, factor, ftype="fir")
            steps //= factor
    return np.asarray(signal)


def settled(oscillator: HystereticOscillator, period: Array, steps: int = STEPS) -> Response:
    """Steady-state response at the samples to a periodic force: the second of two periods.

    A third period is simulated after them, so that the decimation filters have no edge effect.
    """
    half = period.size // 2
    force = np.concatenate((period, period, period[:half]))
    answer = oscillator.simulate(force, PERIOD / steps)
    count = period.size // steps
    return Response(*(thinned(part, steps)[count : 2 * count] for part in answer))
