"""Linear plants with a damper, and a quarter car on a road.

The quarter car has the parameters of a typical car in Savaresi, Poussot-Vassal, Spelta, Sename and
Dugard, Semi-Active Suspension Control Design for Vehicles, 2010.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array


class DamperMotion(NamedTuple):
    """Extension of the damper [m], its velocity [m/s] and its acceleration [m/s²]."""

    displacement: float
    velocity: float
    acceleration: float


@dataclass(frozen=True, eq=False)
class LinearPlant:
    """x' = ``dynamics`` x + ``by_force`` F + ``by_input`` w, for n states x.

    F is the damper force [N], tension positive, and w the external input, such as the velocity of a
    road. The shapes are (n, n), (n,), (n,). ``displacement`` and ``velocity`` (n,) are the output
    vectors for the extension of the damper [m] and its velocity [m/s].
    """

    dynamics: Array
    by_force: Array
    by_input: Array
    displacement: Array
    velocity: Array


class MovingPlant:
    """A linear plant, solved exactly step by step for constant force and input."""

    def __init__(self, plant: LinearPlant, period: float) -> None:
        from scipy.linalg import expm  # imported late: see entry_points

        count = plant.by_force.size
        whole = np.zeros((count + 2, count + 2))
        whole[:count, :count] = plant.dynamics
        whole[:count, count], whole[:count, count + 1] = plant.by_force, plant.by_input
        step = expm(period * whole)[:count]
        self._plant, self._step = plant, step
        self._force = self._input = 0.0
        self.state = np.zeros(count)

    def step(self, force: float, moved: float) -> Array:
        """The states (n,) after one period with constant force [N] and input ``moved``."""
        self.state = self._step @ np.concatenate([self.state, (force, moved)])
        self._force, self._input = force, moved
        return self.state

    @property
    def rates(self) -> Array:
        """Derivatives (n,) of the states, with the force and the input of the last step."""
        plant = self._plant
        return (
            plant.dynamics @ self.state
            + plant.by_force * self._force
            + plant.by_input * self._input
        )

    @property
    def damper(self) -> DamperMotion:
        """Motion of the damper."""
        plant, state = self._plant, self.state
        return DamperMotion(
            float(plant.displacement @ state),
            float(plant.velocity @ state),
            float(plant.velocity @ self.rates),
        )


ROUGHNESS = {"A": 16e-6, "B": 64e-6, "C": 256e-6, "D": 1024e-6, "E": 4096e-6}
"""Spectral density [m³] of road heights at 0.1 cycles/m: geometric mean of each ISO 8608 class."""

_REFERENCE = 0.1
_LONGEST, _SHORTEST = 0.01, 4.0
"""Range of spatial frequencies [cycles/m] of a road."""


@dataclass(frozen=True)
class QuarterCar(CheckedSettings):
    """A body on a wheel on a road."""

    body: float = option(400.0, "Mass [kg] above the spring.", within=(1e-3, 1e6))
    wheel: float = option(50.0, "Mass [kg] of the wheel.", within=(1e-3, 1e6))
    spring: float = option(20e3, "Stiffness [N/m] of the spring.", within=(1.0, 1e9))
    tyre: float = option(250e3, "Stiffness [N/m] of the tyre.", within=(1.0, 1e9))

    @property
    def plant(self) -> LinearPlant:
        """The car with the velocity of the road [m/s] as its input."""
        body, wheel, spring, tyre = self.body, self.wheel, self.spring, self.tyre
        return LinearPlant(
            dynamics=np.array(
                [
                    [0.0, 1.0, 0.0, -1.0],
                    [-spring / body, 0.0, 0.0, 0.0],
                    [0.0, 0.0, 0.0, 1.0],
                    [spring / wheel, 0.0, -tyre / wheel, 0.0],
                ]
            ),
            by_force=np.array([0.0, -1.0 / body, 0.0, 1.0 / wheel]),
            by_input=np.array([0.0, 0.0, -1.0, 0.0]),
            displacement=np.array([1.0, 0.0, 0.0, 0.0]),
            velocity=np.array([0.0, 1.0, 0.0, -1.0]),
        )


@dataclass(frozen=True)
class IsoRoad:
    """An endless road of an ISO 8608 class under a wheel at a ``speed`` [m/s].

    A sum of sines with random phases and the spectral density G(n) = G(n0) (n / n0)^-2, up to the
    frequency ``highest`` [Hz]. Raises ValueError for an unknown class.
    """

    roughness: str
    speed: float
    seed: int = 0
    highest: float = 100.0

    def __post_init__(self) -> None:
        if self.roughness not in ROUGHNESS:
            raise ValueError(
                f"there is no road class {self.roughness}: the classes are {', '.join(ROUGHNESS)}"
            )

    def at(self, time: Array) -> Array:
        """Vertical velocity (n,) [m/s] of the wheel contact at these times (n,) [s]."""
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
    """A cosine-shaped bump of ``height`` [m] by ``length`` [m], passed at a ``speed`` [m/s].

    It begins ``start`` seconds after the start, on a flat road or on this ``road``.
    """

    height: float
    length: float
    speed: float
    start: float = 0.0
    road: IsoRoad | None = None

    def at(self, time: Array) -> Array:
        """Vertical velocity (n,) [m/s] of the wheel contact at these times (n,) [s]."""
        since = time - self.start
        rate = 2.0 * math.pi * self.speed / self.length
        within = (since >= 0.0) & (since < self.length / self.speed)
        velocity = np.where(within, 0.5 * self.height * rate * np.sin(rate * since), 0.0)
        return velocity if self.road is None else velocity + self.road.at(time)
