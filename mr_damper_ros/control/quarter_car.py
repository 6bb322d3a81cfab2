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

from mr_damper_ros.control.linear_plant import LinearPlant
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
    def plant(self) -> LinearPlant:
        """The car, moved by the velocity of the road [m/s]."""
        return LinearPlant(
            self.dynamics,
            self.by_force,
            by_input=np.array([0.0, 0.0, -1.0, 0.0]),
            displacement=np.array([1.0, 0.0, 0.0, 0.0]),
            velocity=np.array([0.0, 1.0, 0.0, -1.0]),
        )


@dataclass(frozen=True)
class IsoRoad:
    """A road of an ISO 8608 class under a wheel at a ``speed`` [m/s], for ever.

    A sum of sines of random phases, whose height has the density G(n) = G(n0) (n / n0)^-2; no wave
    is faster than ``highest`` [Hz]. Raises ValueError for a class that there is not.
    """

    roughness: str
    speed: float
    seed: int = 0
    highest: float = 100.0

    def __post_init__(self) -> None:
        if self.roughness not in ROUGHNESS:
            raise ValueError(
                f"there is no road {self.roughness}: the classes are {', '.join(ROUGHNESS)}"
            )

    def at(self, time: Array) -> Array:
        """Velocity (n,) [m/s] with which it lifts the wheel at these times (n,) [s]."""
        rng = np.random.default_rng(self.seed)
        edges = np.geomspace(_LONGEST, min(_SHORTEST, self.highest / self.speed), 401)
        waves, widths = np.sqrt(edges[1:] * edges[:-1]), np.diff(edges)
        density = ROUGHNESS[self.roughness] * (waves / _REFERENCE) ** -2
        amplitudes = np.sqrt(2.0 * density * widths)
        rates = 2.0 * math.pi * waves * self.speed
        phases = rng.uniform(0.0, 2.0 * math.pi, waves.size)
        velocity = np.zeros(time.size)
        for amplitude, rate, phase in zip(amplitudes, rates, phases, strict=True):
            velocity += amplitude * rate * np.cos(rate * time + phase)
        return velocity


@dataclass(frozen=True)
class Bump:
    """A bump of a cosine's shape, ``height`` [m] by ``length`` [m], at a ``speed`` [m/s].

    It begins ``start`` seconds after the start, on an even road or on this ``road``.
    """

    height: float
    length: float
    speed: float
    start: float = 0.0
    road: IsoRoad | None = None

    def at(self, time: Array) -> Array:
        """Velocity (n,) [m/s] with which it lifts the wheel at these times (n,) [s]."""
        since = time - self.start
        rate = 2.0 * math.pi * self.speed / self.length
        within = (since >= 0.0) & (since < self.length / self.speed)
        velocity = np.where(within, 0.5 * self.height * rate * np.sin(rate * since), 0.0)
        return velocity if self.road is None else velocity + self.road.at(time)
