"""What every force model of an MR damper has: a name, parameters with units and bounds, a force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.damper.sigmoid import Array


class MotionLike(Protocol):
    """Displacement [m] about the centre, velocity [m/s], acceleration [m/s²], peak velocity [m/s].

    Each has shape (n,).
    """

    @property
    def displacement(self) -> Array:
        """Shape (n,) [m]."""

    @property
    def velocity(self) -> Array:
        """Shape (n,) [m/s]."""

    @property
    def acceleration(self) -> Array:
        """Shape (n,) [m/s²]."""

    @property
    def peak_velocity(self) -> Array:
        """Shape (n,) [m/s]."""


Force = Callable[[Array, MotionLike, Array, float], Array]


@dataclass(frozen=True)
class Parameter:
    """A parameter: its unit, and the bounds within which it has a meaning."""

    name: str
    unit: str
    low: float = -np.inf
    high: float = np.inf


@dataclass(frozen=True)
class Model:
    """A force model.

    ``law`` takes parameters (..., p), a motion and currents (n,) [A], and the period [s] between
    samples, and returns the force (..., n) [N]; ``source`` is where it is published.
    ``free_in_one_run`` names the parameters that one run at one current determines; the others
    keep the values of a start. ``scale_starts`` gives starts (k, p) from what can be read off a
    run: half the span of the force [N] and its middle [N], the peak velocity [m/s] and the
    amplitude [m].
    """

    name: str
    title: str
    parameters: tuple[Parameter, ...]
    law: Force
    source: str
    scale_starts: Callable[[float, float, float, float], Array]
    free_in_one_run: tuple[str, ...] = field(default=())

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names in the order of every parameter array."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def units(self) -> dict[str, str]:
        """Unit by parameter name."""
        return {parameter.name: parameter.unit for parameter in self.parameters}

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds, each of shape (p,)."""
        low = np.array([parameter.low for parameter in self.parameters])
        high = np.array([parameter.high for parameter in self.parameters])
        return low, high

    @property
    def free_indices(self) -> Array:
        """Places (f,) of the parameters that one run determines."""
        free = self.free_in_one_run or self.parameter_names
        return np.array([self.parameter_names.index(name) for name in free])

    def force(
        self, parameters: ArrayLike, motion: MotionLike, current: ArrayLike, period: float
    ) -> Array:
        """Force [N], shape (..., n), for parameters of shape (..., p).

        ``current`` [A] is a number or has shape (n,). Raises ValueError where the number of
        parameters is wrong or the period is not positive.
        """
        values = np.asarray(parameters, dtype=float)
        if values.shape[-1:] != (len(self.parameters),):
            raise ValueError(
                f"model '{self.name}' has {len(self.parameters)} parameters "
                f"({', '.join(self.parameter_names)}): got shape {values.shape}"
            )
        if not period > 0.0:
            raise ValueError(f"the sample period is {period} s: it must be positive")
        amperes = np.broadcast_to(np.asarray(current, dtype=float), motion.velocity.shape)
        return self.law(values, motion, amperes, period)
