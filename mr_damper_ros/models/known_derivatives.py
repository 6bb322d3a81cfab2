"""The problem of a window, and of many, for a law that knows the derivatives of its force.

A law that is integrated sample by sample takes as long for each set as for the first: differences
would take as many times as long as there are parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.pooled_differences import PooledDifferences
from mr_damper_ros.models.window_problem import DifferenceProblem
from mr_damper_ros.signals.arrays import Array


class DerivativeModel(Protocol):
    """A law that knows the derivatives of its force."""

    def window_derivatives(self, window: Window, parameters: Array) -> Array:
        """Derivatives (n, p) of the force at the samples of a window by all parameters (p,)."""


class KnownDerivatives(DifferenceProblem):
    """The problem of one window."""

    def __init__(
        self, model: Model, window: Window, parameters: Array, law: DerivativeModel
    ) -> None:
        super().__init__(model, window, parameters)
        self._law = law

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual by the unknowns, shape (n, f)."""
        derivatives = self._law.window_derivatives(self.window, self.parameters(unknowns))
        return np.where(self.settled[:, np.newaxis], derivatives[:, self._free], 0.0)


class PooledDerivatives(PooledDifferences):
    """The pooled residual of many windows."""

    def __init__(
        self,
        model: Model,
        windows: Sequence[Window],
        noise: Sequence[float],
        known: Array | None,
        law: DerivativeModel,
    ) -> None:
        super().__init__(model, windows, noise, known)
        self._law = law

    def jacobian(self, parameters: Array, columns: Sequence[int] | None = None) -> Array:
        """Derivatives of the residual, shape (n, p), or only the given columns of it."""
        weights = np.split(self.sample_weights, np.cumsum(self._counts)[:-1])
        chosen = slice(None) if columns is None else np.asarray(columns, dtype=int)
        return np.concatenate(
            [
                weight[:, np.newaxis] * self._law.window_derivatives(window, parameters)[:, chosen]
                for window, weight in zip(self.windows, weights, strict=True)
            ]
        )

    @property
    def _counts(self) -> list[int]:
        return [window.sample_count for window in self.windows]
