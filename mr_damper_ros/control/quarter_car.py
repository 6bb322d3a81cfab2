"""A quarter of a car on a road: the plant of a suspension's damper.

States: how far body and wheel are apart [m], the body's velocity [m/s], the tyre's travel [m], the
wheel's velocity [m/s], about where it rests; upwards positive. The parameters are those of a usual
car in Savaresi, Poussot-Vassal, Spelta, Sename and Dugard, Semi-Active Suspension Control Design
for Vehicles, 2010.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.signals.arrays import Array

ROUGHNESS = {"A": 16e-6, "B": 64e-6, "C": 256e-6, "D": 1024e-6, "E": 4096e-6}
"""Density [m³] of the road's height at 0.1 cycles/m, by the class of ISO 8608: geometric means."""

_REFERENCE = 0.1
_LONGEST, _SHORTEST = 0.01, 4.0
"""Waves [cycles/m] that a road has here."""


@dataclass(frozen=True)
class QuarterCar:
    """Masses of ``body`` and ``wheel`` [kg], stiffnesses of ``spring`` and ``tyre`` [N/m]."""

    body: float = 400.0
    wheel: float = 50.0
    spring: float = 20e3
    tyre: float = 250e3

    @property
    def dynamics(self) -> Array:
        """Matrix (4, 4) of the states' derivatives."""
        return np.array(
            [
                [0.0, 1.0, 0.0, -1.0],
                [-self.spring / self.body, 0.0, 0.0, 0.0],
                [0.0, 0.0, 0.0, 1.0],
                [self.spring / self.wheel, 0.0, -self.tyre / self.wheel, 0.0],
            ]
        )

    @property
    def by_force(self) -> Array:
        """What the damper's force, tension positive, adds to them (4,)."""
        return np.array([0.0, -1.0 / self.body, 0.0, 1.0 / self.wheel])

    @property
    def by_road(self) -> Array:
        """What the velocity of the road adds to them (4,)."""
        return np.array([0.0, 0.0, -1.0, 0.0])


class MovingCar:
    """A quarter car step by step, exactly for a force and a road's velocity that hold."""

    def __init__(self, car: QuarterCar, period: float) -> None:
        from scipy.linalg import expm  # here: see mr_damper_ros.entry_points

        whole = np.zeros((6, 6))
        whole[:4, :4] = car.dynamics
        whole[:4, 4], whole[:4, 5] = car.by_force, car.by_road
        step = expm(period * whole)
        self._advance, self._by_force, self._by_road = step[:4, :4], step[:4, 4], step[:4, 5]
        self.state = np.zeros(4)

    def step(self, force: float, road_velocity: float) -> Array:
        """The states (4,) a period later, for a force [N] and a velocity of the road [m/s]."""
        self.state = (
            self._advance @ self.state + force * self._by_force + road_velocity * self._by_road
        )
        return self.state


def iso_road(roughness: str, speed: float, period: float, count: int, seed: int = 0) -> Array:
    """Velocity (n,) [m/s] with which a road of an ISO 8608 class lifts a wheel at a speed [m/s].

    A sum of sines of random phases, whose height has the density G(n) = G(n0) (n / n0)^-2; no wave
    is faster than a fifth of the sample rate. Raises ValueError for a class that there is not.
    """
    if roughness not in ROUGHNESS:
        raise ValueError(f"there is no road {roughness}: the classes are {', '.join(ROUGHNESS)}")
    rng = np.random.default_rng(seed)
    most = min(_SHORTEST, 0.2 / (period * speed))
    edges = np.geomspace(_LONGEST, most, 401)
    waves, widths = np.sqrt(edges[1:] * edges[:-1]), np.diff(edges)
    density = ROUGHNESS[roughness] * (waves / _REFERENCE) ** -2
    amplitudes = np.sqrt(2.0 * density * widths)
    rates = 2.0 * math.pi * waves * speed
    phases = rng.uniform(0.0, 2.0 * math.pi, waves.size)
    time = np.arange(count) * period
    velocity = np.zeros(count)
    for amplitude, rate, phase in zip(amplitudes, rates, phases, strict=True):
        velocity += amplitude * rate * np.cos(rate * time + phase)
    return velocity


def bump(height: float, length: float, speed: float, period: float, count: int) -> Array:
    """Velocity (n,) [m/s] of a bump of a cosine's shape [m], driven over at a speed [m/s]."""
    time = np.arange(count) * period
    rate = 2.0 * math.pi * speed / length
    within = time < length / speed
    return np.where(within, 0.5 * height * rate * np.sin(rate * time), 0.0)
