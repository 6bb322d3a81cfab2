"""Pooled residual of many windows for a model that says no more than its force."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.differences import moved_sets
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.operating_points import window_weights, windows_of_samples
from mr_damper_ros.signals.arrays import Array


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
