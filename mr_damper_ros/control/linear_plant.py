"""What a damper is built into: a linear plant, moved by the damper's force and from outside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array


class DamperMotion(NamedTuple):
    """Extension of the damper [m], its velocity [m/s] and its acceleration [m/s²]."""

    displacement: float
    velocity: float
    acceleration: float


@dataclass(frozen=True, eq=False)
class LinearPlant:
    """x' = ``dynamics`` x + ``by_force`` F + ``by_input`` w.

    F is the damper's force [N], tension positive, and w what moves the plant from outside, such as
    the velocity of a road. Shapes (n, n), (n,), (n,). ``displacement`` and ``velocity`` (n,) give
    the damper's extension [m] and its velocity [m/s] from the states.
    """

    dynamics: Array
    by_force: Array
    by_input: Array
    displacement: Array
    velocity: Array


class MovingPlant:
    """A linear plant step by step, exactly for a force and an input that hold."""

    def __init__(self, plant: LinearPlant, period: float) -> None:
        from scipy.linalg import expm  # here: see mr_damper_ros.entry_points

        count = plant.by_force.size
        whole = np.zeros((count + 2, count + 2))
        whole[:count, :count] = plant.dynamics
        whole[:count, count], whole[:count, count + 1] = plant.by_force, plant.by_input
        step = expm(period * whole)[:count]
        self._plant, self._step = plant, step
        self._force = self._input = 0.0
        self.state = np.zeros(count)

    def step(self, force: float, moved: float) -> Array:
        """The states (n,) a period later, for a force [N] and an input."""
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
        """How the damper moves."""
        plant, state = self._plant, self.state
        return DamperMotion(
            float(plant.displacement @ state),
            float(plant.velocity @ state),
            float(plant.velocity @ self.rates),
        )
