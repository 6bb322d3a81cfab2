"""Misfit of many windows as a function of all sixteen parameters.

Every window counts the same, whatever its length: its samples are weighted by what the window's
own best seven coefficients leave of the force. Where only sensor noise is left this is the
maximum-likelihood weight; where the law itself is not exact it keeps one strong run from
drowning all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from mr_damper_ros.damper.sigmoid import (
    Array,
    Coefficients,
    coefficient_jacobian,
    coefficient_parameter_jacobian,
    force_from_coefficients,
    operating_point_coefficients,
)
from mr_damper_ros.identification.window import Window


class PooledMisfit:
    """Weighted residual of windows and its Jacobian for parameters of shape (16,)."""

    def __init__(self, windows: Sequence[Window], noise: Sequence[float]) -> None:
        """``noise`` [N]: what each window's own best fit leaves (RMSE).

        Raises ValueError where there are no windows.
        """
        if not windows:
            raise ValueError("there are no windows to identify from")
        self.windows = tuple(windows)
        total = sum(window.sample_count for window in windows)
        share = total / len(self.windows)
        self._weights = [
            float(np.sqrt(share / window.sample_count)) / max(sigma, 1e-12)
            for window, sigma in zip(self.windows, noise, strict=True)
        ]
        self._parts = [_Part(window) for window in self.windows]
        # All windows in one evaluation of the laws: with one at a time, a third of the time of a
        # search goes into calls.
        edges = np.cumsum([0, *(part.peak_velocity.size for part in self._parts)]).tolist()
        self._places = [slice(*pair) for pair in pairwise(edges)]
        self._peak_velocity = np.concatenate([part.peak_velocity for part in self._parts])
        self._current = np.concatenate([part.current for part in self._parts])
        self.sample_count = total

    def _coefficients(self, parameters: Array) -> list[Coefficients]:
        """Coefficients of each window, for parameters of shape (..., 16)."""
        together = operating_point_coefficients(parameters, self._peak_velocity, self._current)
        return [Coefficients(*(c[..., place] for c in together)) for place in self._places]

    def residual(self, parameters: Array) -> Array:
        """Weighted model minus measurement [1] of all windows, shape (n,)."""
        coefficients = self._coefficients(parameters)
        return np.concatenate(
            [
                weight * part.residual(c)
                for weight, part, c in zip(self._weights, self._parts, coefficients, strict=True)
            ]
        )

    def mean_square(self, parameters: Array) -> float:
        """Mean of the squared weighted residual: 1 where nothing but the noise is left."""
        return float(np.mean(np.square(self.residual(parameters))))

    def jacobian(self, parameters: Array, columns: Sequence[int] | None = None) -> Array:
        """Derivatives of :meth:`residual`, shape (n, 16), or only the given columns of it."""
        coefficients = self._coefficients(parameters)
        inner = coefficient_parameter_jacobian(parameters, self._peak_velocity, self._current)
        if columns is not None:
            inner = inner[..., columns]
        return np.concatenate(
            [
                part.jacobian(c, weight * inner[place])
                for weight, part, c, place in zip(
                    self._weights, self._parts, coefficients, self._places, strict=True
                )
            ]
        )

    def population_cost(self, parameters: Array) -> Array:
        """:meth:`mean_square` of many sets, shape (s, 16) to (s,)."""
        total = np.zeros(parameters.shape[0])
        coefficients = self._coefficients(parameters)
        for weight, part, c in zip(self._weights, self._parts, coefficients, strict=True):
            total += weight**2 * np.sum(np.square(part.residual(c)), axis=-1)
        return total / self.sample_count


class _Part:
    """One window; its coefficients are needed once where motion and current are steady."""

    def __init__(self, window: Window) -> None:
        motion = window.motion
        steady = motion.sine is not None and float(np.ptp(window.current)) == 0.0
        chosen = slice(0, 1) if steady else slice(None)
        self.peak_velocity = motion.peak_velocity[chosen]
        self.current = window.current[chosen]
        self._velocity = motion.velocity
        self._branch = np.sign(motion.acceleration)
        self._force = window.force

    def residual(self, coefficients: Coefficients) -> Array:
        return force_from_coefficients(coefficients, self._velocity, self._branch) - self._force

    def jacobian(self, coefficients: Coefficients, inner: Array) -> Array:
        """Derivatives (n, p); ``inner`` (1 or n, 7, p) are those of the coefficients."""
        by_coefficient = coefficient_jacobian(coefficients, self._velocity, self._branch)
        if inner.shape[0] == 1:
            return np.asarray(by_coefficient @ inner[0])
        # Row by row: as a batched product of vectors and matrices.
        return np.asarray((by_coefficient[:, np.newaxis, :] @ inner)[:, 0, :])
