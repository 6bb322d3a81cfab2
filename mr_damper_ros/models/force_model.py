"""What every force model of an MR damper has: a name, parameters with units and bounds, a force."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.signals.arrays import Array


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


State = tuple[Array, ...]
"""What a law remembers of the past: arrays of the shape of the sets, none for a law without memory.

None stands for a start: at rest, or settled.
"""

Law = Callable[[Array, MotionLike, Array, float, State | None], tuple[Array, State]]


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

    ``law`` takes parameters (..., p), a motion and currents (n,) [A], the period [s] between
    samples and the state after the sample before, and returns the force (..., n) [N] and the state
    after the last sample; ``source`` is where it is published.
    ``free_in_one_run`` names the parameters that one run at one current determines; the others
    keep the values of a start. ``scale_starts`` gives starts (k, p) from what can be read off a
    run: half the span of the force [N] and its middle [N], the peak velocity [m/s] and the
    amplitude [m]. ``remembers``: whether the force depends on the samples before.
    ``strength`` names the parameters that rise and fall with the strength of the damper; where
    none are named, all that have a force in their unit.
    """

    name: str
    title: str
    parameters: tuple[Parameter, ...]
    law: Law
    source: str
    scale_starts: Callable[[float, float, float, float], Array]
    free_in_one_run: tuple[str, ...] = field(default=())
    remembers: bool = False
    strength: tuple[str, ...] = field(default=())

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

    @property
    def strength_indices(self) -> Array:
        """Places of the parameters that rise and fall with the strength of the damper."""
        return np.array(
            [
                place
                for place, parameter in enumerate(self.parameters)
                if (parameter.name in self.strength or not self.strength)
                and parameter.unit.startswith("N")
            ]
        )

    def force(
        self, parameters: ArrayLike, motion: MotionLike, current: ArrayLike, period: float
    ) -> Array:
        """Force [N], shape (..., n), for parameters of shape (..., p), from a start.

        ``current`` [A] is a number or has shape (n,). Raises ValueError where the number of
        parameters is wrong or the period is not positive.
        """
        return self.stream(period).follow(parameters, motion, current)

    def stream(self, period: float) -> ForceStream:
        """Force of samples ``period`` [s] apart, block by block; ValueError as for the force."""
        return ForceStream(self, period)


_KEPT = 0.5
"""Seconds of motion from which a state is found anew: lag and hysteresis forget sooner."""


class ForceStream:
    """Force of a motion that goes on: the same as in one piece, however it is cut into blocks.

    The state goes on where the parameters change, unless :meth:`retrace` finds it anew.
    """

    def __init__(self, model: Model, period: float) -> None:
        if not period > 0.0:
            raise ValueError(f"the sample period is {period} s: it must be positive")
        self.model = model
        self._period = period
        self._state: State | None = None
        # Blocks of the last while, each with the state before it, and the samples in them.
        self._past: deque[tuple[State | None, MotionLike, Array]] = deque()
        self._past_count = 0

    @property
    def remembers(self) -> bool:
        """Whether the force so far depends on the samples before."""
        return self.model.remembers

    def follow(self, parameters: ArrayLike, motion: MotionLike, current: ArrayLike) -> Array:
        """Force [N] of the next samples, shape (..., n), for parameters of shape (..., p).

        ``current`` [A] is a number or has shape (n,). Raises ValueError where the number of
        parameters is wrong.
        """
        values = np.asarray(parameters, dtype=float)
        count = len(self.model.parameters)
        if values.shape[-1:] != (count,):
            raise ValueError(
                f"model '{self.model.name}' has {count} parameters "
                f"({', '.join(self.model.parameter_names)}): got shape {values.shape}"
            )
        amperes = np.broadcast_to(np.asarray(current, dtype=float), motion.velocity.shape)
        if self.model.remembers:
            self._keep(motion, amperes)
        with np.errstate(over="ignore", invalid="ignore"):
            force, self._state = self.model.law(values, motion, amperes, self._period, self._state)
        return force

    def _keep(self, motion: MotionLike, amperes: Array) -> None:
        self._past.append((self._state, motion, amperes))
        self._past_count += amperes.size
        while (self._past_count - self._past[0][2].size) * self._period >= _KEPT:
            self._past_count -= self._past.popleft()[2].size

    def retrace(self, parameters: ArrayLike) -> None:
        """Follow the last half second once more, with other parameters.

        What the model remembers is then what it would be had these been in use; a lagging force,
        for one, would else be that of the old parameters for a while.
        """
        past, self._past, self._past_count = self._past, deque(), 0
        if past:
            self._state = past[0][0]
        for _, motion, amperes in past:
            self.follow(parameters, motion, amperes)
