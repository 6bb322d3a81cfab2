"""What one window determines, as a least-squares problem: for every model alike.

The unknowns are the parameters that one run determines, within their bounds; the others stay as
they are given. Derivatives are by differences. Samples whose force still depends on the unknown
past have no residual.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.differences import moved_sets
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.quantities import LoopReading
from mr_damper_ros.models.search_effort import SearchEffort
from mr_damper_ros.signals.arrays import Array


class WindowProblem(Protocol):
    """Residual (n,) of a window and its Jacobian (n, f) for unknowns (f,).

    ``start`` (f,): those of the parameters given; ``bounds`` of the unknowns, None for none;
    ``settled`` (n,): samples that have a residual; ``strength`` (f,): which of the unknowns rise
    and fall with the strength of the damper; ``differences``: evaluations of the force that went
    into derivatives.
    """

    window: Window
    differences: int

    @property
    def settled(self) -> np.ndarray:
        """Mask (n,)."""

    @property
    def effort(self) -> SearchEffort:
        """How far to search."""

    @property
    def start(self) -> Array:
        """Unknowns (f,) of the parameters given."""

    @property
    def bounds(self) -> tuple[Array, Array] | None:
        """Lower and upper bounds (f,) of the unknowns."""

    @property
    def strength(self) -> np.ndarray:
        """Mask (f,)."""

    def residual(self, unknowns: Array) -> Array:
        """Model minus measurement [N], shape (n,); zero where the past is not known."""

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual by the unknowns, shape (n, f)."""

    def parameters(self, unknowns: Array) -> Array:
        """All parameters (p,)."""

    def restarted(self, parameters: Array) -> WindowProblem:
        """The problem for parameters (p,) of which only the unknowns are others."""

    def cold_starts(self) -> list[Array]:
        """Parameters (p,) to start from, read off the window."""

    def coefficients(self, unknowns: Array, covariance: Array) -> tuple[Array, Array]:
        """Operating-point coefficients (c,) and their covariance (c, c); empty where none are."""

    def usual_change(self, part: float, fastest: float) -> Array:
        """Change (f,) of each unknown that changes the force by this part of it.

        Seen in the window, and in a sine of peak velocity ``fastest`` [m/s] where that is finite;
        infinite where there is no force to compare with.
        """


class DifferenceProblem:
    """The problem of a window for a model that says no more than its force."""

    def __init__(self, model: Model, window: Window, parameters: Array) -> None:
        self.model = model
        self.window = window
        self.differences = 0
        self._latest: tuple[Array, Array] | None = None
        self._given = np.array(parameters, dtype=float)
        self._free = model.free_indices
        reading = LoopReading.of(window)
        self._reading = reading
        units = [model.parameters[place].unit for place in self._free]
        self._sizes = np.array([reading.size(unit) for unit in units])
        self._low, self._high = (bound[self._free] for bound in model.bounds)
        self.settled = model.settled(window, self._given)

    @property
    def effort(self) -> SearchEffort:
        """How far to search."""
        return self.model.effort

    @property
    def start(self) -> Array:
        """Unknowns (f,) of the parameters given, within their bounds."""
        return np.clip(self._given[self._free], self._low, self._high)

    @property
    def bounds(self) -> tuple[Array, Array] | None:
        """Lower and upper bounds (f,) of the unknowns."""
        return self._low, self._high

    @property
    def strength(self) -> np.ndarray:
        """Mask (f,)."""
        return np.isin(self._free, self.model.strength_indices)

    def parameters(self, unknowns: Array) -> Array:
        """All parameters (p,)."""
        values = self._given.copy()
        values[self._free] = np.clip(unknowns, self._low, self._high)
        return values

    def residual(self, unknowns: Array) -> Array:
        """Model minus measurement [N], shape (n,); zero where the past is not known."""
        # A search asks for its start and its end more than once.
        if self._latest is None or not np.array_equal(self._latest[0], unknowns):
            force = self.model.window_force(self.window, self.parameters(unknowns))
            left = np.where(self.settled, force - self.window.force, 0.0)
            self._latest = np.array(unknowns), left
        return self._latest[1]

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual by the unknowns, shape (n, f)."""
        parameters = self.parameters(unknowns)
        moved, steps = moved_sets(parameters, self._free, self._sizes, self._high)
        forces = self.model.window_force(self.window, moved)
        self.differences += len(moved)
        derivatives = (forces[1:] - forces[0]).T / steps
        return np.where(self.settled[:, np.newaxis], derivatives, 0.0)

    def restarted(self, parameters: Array) -> WindowProblem:
        """The problem for other parameters (p,)."""
        return self.model.window_problem(self.window, parameters)

    def cold_starts(self) -> list[Array]:
        """Parameters (p,) to start from, read off the window; the rest stays as it is given."""
        starts = []
        for read in np.clip(self.model.starts(self._reading), *self.model.bounds):
            values = self._given.copy()
            values[self._free] = read[self._free]
            starts.append(values)
        return starts

    def coefficients(self, unknowns: Array, covariance: Array) -> tuple[Array, Array]:
        """Operating-point coefficients (c,) and their covariance (c, c)."""
        model, parameters = self.model, self.parameters(unknowns)
        values = model.coefficients_at(parameters, *self.window.operating_point)[:, 0]
        gradient = model.coefficient_gradient(parameters, *self.window.operating_point)
        gradient = gradient[:, self._free]
        return values, gradient @ covariance @ gradient.T

    def usual_change(self, part: float, fastest: float) -> Array:
        """Change (f,) of each unknown that changes the force by this part, see the protocol."""
        change = relative_change(self, part)
        if not math.isfinite(fastest):
            return change
        rate = self._reading.speed / (2.0 * math.pi * self._reading.amplitude)
        model, sine = self.model, Window.of_sine(fastest, rate, self.window.operating_point[1])
        sine = replace(sine, force=model.window_force(sine, self._given))
        return np.minimum(change, relative_change(model.window_problem(sine, self._given), part))


def relative_change(problem: WindowProblem, part: float) -> Array:
    """Change (f,) of each unknown that changes the force of a window by this part of it."""
    jacobian = problem.jacobian(problem.start)
    effect = np.sqrt(np.mean(jacobian**2, axis=0))
    force = problem.residual(problem.start) + problem.window.force
    strength = float(np.sqrt(np.mean(force**2)))
    if strength == 0.0:
        return np.full(effect.size, np.inf)
    return np.asarray(part * strength / np.maximum(effect, 1e-12 * strength))
