"""Misfit of many windows as a function of all sixteen parameters.

Every window counts the same, whatever its length: its samples are weighted by what the window's
own best seven coefficients leave of the force. Where only sensor noise is left this is the
maximum-likelihood weight; where the law itself is not exact it keeps one strong run from
drowning all others.
"""

from __future__ import annotations

from collections.abc import Sequence

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
        self.sample_count = total

    def residual(self, parameters: Array) -> Array:
        """Weighted model minus measurement [1] of all windows, shape (n,)."""
        return np.concatenate(
            [
                weight * part.residual(parameters)
                for weight, part in zip(self._weights, self._parts, strict=True)
            ]
        )

    def mean_square(self, parameters: Array) -> float:
        """Mean of the squared weighted residual: 1 where nothing but the noise is left."""
        return float(np.mean(np.square(self.residual(parameters))))

    def jacobian(self, parameters: Array) -> Array:
        """Derivatives of :meth:`residual`, shape (n, 16)."""
        return np.concatenate(
            [
                weight * part.jacobian(parameters)
                for weight, part in zip(self._weights, self._parts, strict=True)
            ]
        )

    def population_cost(self, parameters: Array) -> Array:
        """:meth:`mean_square` of many sets, shape (s, 16) to (s,)."""
        total = np.zeros(parameters.shape[0])
        for weight, part in zip(self._weights, self._parts, strict=True):
            total += weight**2 * np.sum(np.square(part.residual(parameters)), axis=-1)
        return total / self.sample_count


class _Part:
    """One window; its coefficients are computed once where motion and current are steady."""

    def __init__(self, window: Window) -> None:
        motion = window.motion
        steady = motion.sine is not None and float(np.ptp(window.current)) == 0.0
        chosen = slice(0, 1) if steady else slice(None)
        self._peak_velocity = motion.peak_velocity[chosen]
        self._current = window.current[chosen]
        self._velocity = motion.velocity
        self._branch = np.sign(motion.acceleration)
        self._force = window.force

    def _coefficients(self, parameters: Array) -> Coefficients:
        return operating_point_coefficients(parameters, self._peak_velocity, self._current)

    def residual(self, parameters: Array) -> Array:
        coefficients = self._coefficients(parameters)
        return force_from_coefficients(coefficients, self._velocity, self._branch) - self._force

    def jacobian(self, parameters: Array) -> Array:
        coefficients = self._coefficients(parameters)
        by_coefficient = coefficient_jacobian(coefficients, self._velocity, self._branch)
        inner = coefficient_parameter_jacobian(parameters, self._peak_velocity, self._current)
        if inner.shape[0] == 1:
            return np.asarray(by_coefficient @ inner[0])
        # Row by row, seven times sixteen: as a batched product of vectors and matrices.
        return np.asarray((by_coefficient[:, np.newaxis, :] @ inner)[:, 0, :])
