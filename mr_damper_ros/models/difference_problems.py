"""The problems of a window and of many, for a model that says no more than its force.

Of one window the unknowns are the parameters that one run determines, within their bounds; the
others stay as they are given. Derivatives are by differences. Samples whose force still depends on
the unknown past have no residual.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.differences import moved_sets
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.operating_points import WindowProblem, window_weights, windows_of_samples
from mr_damper_ros.models.quantities import LoopReading, SearchEffort
from mr_damper_ros.signals.arrays import Array


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


class PooledDifferences:
    """Weighted residual of windows; derivatives are by differences. See :class:`PooledProblem`."""

    def __init__(
        self,
        model: Model,
        windows: Sequence[Window],
        noise: Sequence[float],
        known: Array | None = None,
    ) -> None:
        self.windows = tuple(windows)
        self.sample_count = sum(window.sample_count for window in windows)
        self._model = model
        self._weights = window_weights(windows, noise)
        self._sizes = model.typical_sizes(windows)
        self._settled = [
            np.ones(window.sample_count, dtype=bool)
            if known is None
            else model.settled(window, known)
            for window in windows
        ]

    @property
    def sample_weights(self) -> Array:
        """Weights (n,) [1/N] of the samples, 0 where the past is not known."""
        return np.concatenate(
            [w * settled for w, settled in zip(self._weights, self._settled, strict=True)]
        )

    @property
    def row_windows(self) -> np.ndarray:
        """The place of the window that each row (n,) of the residual belongs to."""
        return windows_of_samples(self.windows)

    @property
    def prior(self) -> None:
        """Every row is a sample."""

    def residual(self, parameters: Array) -> Array:
        """Weighted model minus measurement [1] of all windows, shape (n,)."""
        return np.concatenate([part for _, part in self._residuals(parameters)])

    def mean_square(self, parameters: Array) -> float:
        """Mean of the squared weighted residual: 1 where nothing but the noise is left."""
        return float(np.mean(np.square(self.residual(parameters))))

    def population_cost(self, parameters: Array) -> Array:
        """The mean square of many sets, shape (s, p) to (s,)."""
        total = np.zeros(parameters.shape[0])
        for _, part in self._residuals(parameters):
            total += np.sum(np.square(part), axis=-1)
        return total / self.sample_count

    def jacobian(self, parameters: Array, columns: Sequence[int] | None = None) -> Array:
        """Derivatives of the residual, shape (n, p), or only the given columns of it."""
        places = np.arange(parameters.size) if columns is None else np.asarray(columns, dtype=int)
        high = self._model.bounds[1][places]
        moved, steps = moved_sets(parameters, places, self._sizes[places], high)
        # Cut by cut: all at once would take as much memory as there are parameters.
        return np.concatenate(
            [(part[1:] - part[0]).T / steps for _, part in self._residuals(moved)]
        )

    def _residuals(self, parameters: Array) -> list[tuple[Window, Array]]:
        """Weighted residual (..., n) of each window, for parameters (..., p)."""
        return [
            (
                window,
                weight
                * np.where(
                    settled, self._model.window_force(window, parameters) - window.force, 0.0
                ),
            )
            for window, weight, settled in zip(
                self.windows, self._weights, self._settled, strict=True
            )
        ]
