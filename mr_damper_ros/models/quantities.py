"""Parameters and coefficients with their units, and what a search of a window starts from."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.signals.arrays import Array

_OUTERMOST = 0.98
"""Quantile of the speed and of the displacement that counts as the largest."""

State = tuple[Array, ...]
"""What a law remembers of the past: arrays of the shape of the sets, none for a law without memory.

None stands for a start: at rest, or settled.
"""


@dataclass(frozen=True)
class Parameter:
    """A parameter: its unit, and the bounds within which it has a meaning.

    It can be told from its fellows only where the data hold so many different ``peak_velocities``
    and ``currents``. A file that does not name it means the ``default``, if there is one.
    """

    name: str
    unit: str
    low: float = -np.inf
    high: float = np.inf
    peak_velocities: int = 1
    currents: int = 1
    default: float | None = None


class Quantity(NamedTuple):
    """A coefficient at one operating point: its name, its unit, what it means."""

    name: str
    unit: str
    meaning: str = ""


class LoopReading(NamedTuple):
    """What can be read off a record: where a search may start.

    Half the span of the ``force`` [N] and its ``middle`` [N], the largest ``speed`` [m/s] and the
    ``amplitude`` [m].
    """

    force: float
    middle: float
    speed: float
    amplitude: float

    @classmethod
    def of(cls, window: Window) -> LoopReading:
        """That of a window."""
        top, bottom = float(window.force.max()), float(window.force.min())
        speed = float(np.quantile(np.abs(window.motion.velocity), _OUTERMOST))
        amplitude = float(np.quantile(np.abs(window.motion.displacement), _OUTERMOST))
        return cls(
            max(0.5 * (top - bottom), 1e-9),
            0.5 * (top + bottom),
            max(speed, 1e-9),
            max(amplitude, 1e-9),
        )

    @property
    def frequency(self) -> float:
        """Frequency [Hz] of a sine of this speed and amplitude."""
        return self.speed / (2.0 * math.pi * self.amplitude)

    def size(self, unit: str) -> float:
        """Typical size of a quantity of this unit."""
        per_ampere = unit.rstrip("²³").removesuffix("/A")
        sizes = {
            "N": self.force,
            "N s/m": self.force / self.speed,
            "N/m": self.force / self.amplitude,
            "s/m": 1.0 / self.speed,
            "m/s": self.speed,
            "m": self.amplitude,
            "m/N": self.amplitude / self.force,
            "s": self.amplitude / self.speed,
        }
        return sizes.get(per_ampere, 1.0)


@dataclass(frozen=True)
class SearchEffort:
    """How far a window of the model is searched.

    ``tolerance``: relative gain of the sum of squares at which a search ends; ``most_steps`` of it.
    Starts read off the record, where the given one is poor: the ``polished_starts`` best are
    polished to ``rough_tolerance`` in ``rough_steps``, and the best of those is taken.
    """

    tolerance: float = 1e-6
    most_steps: int = 40
    polished_starts: int = 4
    rough_tolerance: float = 1e-3
    rough_steps: int = 40


_RELATIVE_ERROR = 0.05
"""No coefficient is trusted more than to this part: the law itself is not exact."""

_OPEN = 1e3
"""The standard error of a coefficient that a window leaves open, in sizes of it."""

_NOTHING = 1e-100
"""A coefficient that is zero at every operating point has still an error: no weight is infinite."""

LawSearch = Callable[[Callable[[Array], Array], Sequence[tuple[float, float]], Array, str], Array]
"""Minimises a function of individuals (u, s) to (s,) within bounds, from a start (u,).

The last argument names the stage of the search; the result (u,) is the best individual.
"""


@dataclass(frozen=True, eq=False)
class CoefficientTable:
    """Coefficients of k operating points; of the sigmoid law those with positive f_t.

    ``peak_velocity`` [m/s] and ``current`` [A] have shape (k,), ``coefficients`` and their
    standard ``errors`` shape (k, c).
    """

    peak_velocity: Array
    current: Array
    coefficients: Array
    errors: Array

    def weights(self, column: int) -> Array:
        """Inverse standard deviations (k,) of one coefficient, model error included.

        A part of a cycle may leave a coefficient open, and its fit then puts it anywhere: the
        usual size is that of those that are known.
        """
        values, errors = self.coefficients[:, column], self.errors[:, column]
        known = errors <= np.abs(values)
        usual = float(np.sqrt(np.mean(values[known if known.any() else slice(None)] ** 2)))
        floor = _RELATIVE_ERROR * max(usual, _NOTHING)
        errors = np.where(np.isnan(errors), _OPEN * np.maximum(floor, np.abs(values)), errors)
        return 1.0 / np.sqrt(errors**2 + floor**2 + (_RELATIVE_ERROR * values) ** 2)
