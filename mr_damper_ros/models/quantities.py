"""Parameters and coefficients with their units, and the starts of a search in a window."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.formulas import LIMIT
from mr_damper_ros.signals.arrays import Array

NOTICED = 0.1
"""Relative change of a force or an error that counts as noticeable. Only a noticeably smaller error
replaces the running set (benchmark figure ``foreign_worse_sets``); a noticeable change of the force
sets the size of parameters near 0."""

GOOD_NRMSE = 0.3
"""Up to this NRMSE a set predicts well, and replacing it in a stream is a risk."""

MODEL_ERROR = 0.05
"""Smallest relative error of a coefficient or a force to which a law has not been fitted, because
every law has model error; for the records of a commercial damper the median of the force is 0.08.
"""

SETTLING = 7.0
"""Number of time constants, or of yield lengths, after which a transient has decayed to 0.1 %."""

SAME_CURRENT = 0.05
"""Largest difference [A] of currents that count as one current."""

CURRENT_READING = 0.02
"""Variation [A] of a supply's reading while its current is constant."""

DIFFERENCE = 1e-6
"""Step of a finite difference, relative to the size of a parameter, or in seconds."""

ROWS_AT_ONCE = 4096
"""Number of rows of a matrix that are processed at once, so that they fit into the cache."""

_QUANTILE = 0.98
"""Quantile of speed and displacement that is used as the maximum."""

State = tuple[Array, ...]
"""State of a law: arrays of the shape of the sets, empty for a law without memory.

None is the state at a start: at rest, or settled.
"""


@dataclass(frozen=True)
class Parameter:
    """A parameter: its unit and its physical bounds.

    The data must contain at least ``peak_velocities`` different peak velocities and ``currents``
    different currents to determine it. ``default`` is its value if a file does not contain it;
    None: it is required.
    """

    name: str
    unit: str
    low: float = -np.inf
    high: float = np.inf
    peak_velocities: int = 1
    currents: int = 1
    default: float | None = None


_ORDER = (("", ""), ("_1", "/A"), ("_2", "/A²"), ("_3", "/A³"))


@dataclass(frozen=True)
class Coefficient:
    """A coefficient of a law at one current: its unit, bounds and meaning.

    ``degree`` is the degree of the polynomial of its current dependence.
    """

    name: str
    unit: str
    low: float = -np.inf
    high: float = np.inf
    degree: int = 0
    meaning: str = ""

    @property
    def grows(self) -> bool:
        """Whether the current multiplies the coefficient; if not, the current shifts it."""
        return self.low >= 0.0

    @property
    def dependence(self) -> tuple[Parameter, ...]:
        """The parameters of its current dependence."""
        return tuple(
            Parameter(
                f"{self.name}{suffix}",
                ("1" if self.grows else self.unit) + per,
                currents=order,
                default=0.0,
            )
            for order, (suffix, per) in enumerate(_ORDER[1 : self.degree + 1], start=2)
        )


class LoopReading(NamedTuple):
    """Size of the force-displacement loop of a window, from which starts of a search are derived.

    ``force`` [N] is half the span of the force and ``middle`` [N] its middle; ``speed`` [m/s] is
    the largest speed, ``amplitude`` [m] the amplitude of the motion.
    """

    force: float
    middle: float
    speed: float
    amplitude: float

    @classmethod
    def of(cls, window: Window) -> LoopReading:
        """The reading of a window."""
        top, bottom = float(window.force.max()), float(window.force.min())
        speed = float(np.quantile(np.abs(window.motion.velocity), _QUANTILE))
        amplitude = float(np.quantile(np.abs(window.motion.displacement), _QUANTILE))
        return cls(
            max(0.5 * (top - bottom), 1e-9),
            0.5 * (top + bottom),
            max(speed, 1e-9),
            max(amplitude, 1e-9),
        )

    @property
    def frequency(self) -> float:
        """Frequency [Hz] of a sine with this speed and amplitude."""
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
    """Effort of the search in a window.

    ``tolerance``: relative decrease of the sum of squares at which a search ends; ``most_steps``:
    its largest number of steps. If the given start is poor, starts are derived from the window. The
    best ``polished_starts`` of them are refined to ``rough_tolerance`` in at most ``rough_steps``,
    and the best result is used.
    """

    tolerance: float = 1e-6
    most_steps: int = 40
    polished_starts: int = 4
    rough_tolerance: float = 1e-3
    rough_steps: int = 40


_UNKNOWN = 1e3
"""Standard error of an undetermined coefficient, relative to its size."""

LawSearch = Callable[[Callable[[Array], Array], Sequence[tuple[float, float]], Array, str], Array]
"""Minimises a function that maps individuals (u, s) to (s,) within bounds, from a start (u,).

The last argument is the name of the stage; the result (u,) is the best individual.
"""


@dataclass(frozen=True, eq=False)
class CoefficientTable:
    """Coefficients of k operating points; in the sigmoid law, f_t is positive.

    ``peak_velocity`` [m/s] and ``current`` [A] have shape (k,), ``coefficients`` and their standard
    ``errors`` shape (k, c).
    """

    peak_velocity: Array
    current: Array
    coefficients: Array
    errors: Array

    def weights(self, column: int) -> Array:
        """Inverse standard deviations (k,) of one coefficient, model error included.

        In a window of less than a cycle, a coefficient may be undetermined and have an arbitrary
        value. The typical size is therefore taken from the determined coefficients.
        """
        values, errors = self.coefficients[:, column], self.errors[:, column]
        known = errors <= np.abs(values)
        usual = float(np.sqrt(np.mean(values[known if known.any() else slice(None)] ** 2)))
        # The weight of a coefficient that is always zero must be finite, and so must its square.
        floor = MODEL_ERROR * max(usual, 1.0 / LIMIT)
        errors = np.where(np.isnan(errors), _UNKNOWN * np.maximum(floor, np.abs(values)), errors)
        return 1.0 / np.sqrt(errors**2 + floor**2 + (MODEL_ERROR * values) ** 2)
