"""Unscented Kalman filter on the seven scales: the recursive peer of the window fit.

The scales are a random walk; a block of samples is one measurement. The sigma points are those of
Julier and Uhlmann, "A new extension of the Kalman filter to nonlinear systems", 1997, used for
parameters as in Wan and van der Merwe, "The unscented Kalman filter for nonlinear estimation",
2000. The filter carries what earlier samples said, so it uses every sample once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mr_damper_ros.estimation.covariance import least_squares_covariance, normal_inverse
from mr_damper_ros.estimation.window_fit import WindowFit, fit_of
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.signals.arrays import Array

METHOD = "unscented"

_SPREAD = 1.0
"""Julier and Uhlmann's kappa. Positive, so that no sigma point has a negative weight."""

_BLOCK = 50
"""Samples of one measurement: within them the scales must be nearly linear, and they are."""

_SURPRISE = 24.3
"""A window whose squared innovation exceeds this has a chance of 1 in 1000 (chi-square, 7)."""

_HUBER = 1.345
"""Huber's constant: 95 % efficiency where the noise is normal after all."""


@dataclass(frozen=True, eq=False)
class FilterState:
    """Mean (7,) and covariance (7, 7) of the scales after the sample stamped ``stamp_ns``.

    The scales are the unknowns of the model's window problem; ``operating_point`` (peak velocity
    [m/s],
    current [A]) is where they were last seen.
    """

    scales: Array
    covariance: Array
    stamp_ns: int
    operating_point: tuple[float, float]


@dataclass(frozen=True, eq=False)
class _Noise:
    """Standard deviation [N] of each sample's noise (n,) and of the scales' walk (7,) in 1 s."""

    force: Array
    walk: Array


class UnscentedFilter:
    """Takes in the samples of one window, in parts.

    ``drift_rate`` [1/sqrt(s)]: the random walk of each scale changes the force by this part of
    its root mean square in one second. The noise of the force comes from what no scales could
    explain of the window, with its autocorrelation; ``robust`` widens it for outliers.
    """

    def __init__(
        self,
        state: FilterState,
        model: Model,
        window: Window,
        parameters: Array,
        stamp_ns: int,
        *,
        drift_rate: float,
        robust: bool = False,
    ) -> None:
        """``window`` holds the new samples, the last one at ``stamp_ns``; ``parameters`` (p,)
        of the model have the shape that the scales go with.
        """  # noqa: D205
        self._window = window
        self._model = model
        self._parameters = parameters
        self._misfit = model.window_problem(window, parameters)
        self.evaluations = 0
        self._noise = self._measure_noise(state.scales, drift_rate, robust)
        elapsed = max(stamp_ns - state.stamp_ns, 0) * 1e-9
        walked = state.covariance + np.diag(self._noise.walk**2 * elapsed)
        self.state = FilterState(
            state.scales,
            walked * self._fading(state.scales, walked),
            stamp_ns,
            window.operating_point,
        )

    def take_in(self, chosen: np.ndarray) -> None:
        """Update the state with the chosen samples, a mask of shape (n,)."""
        for block in _blocks(chosen):
            self._update(block)

    def as_fit(self, window: Window) -> WindowFit:
        """The state as the fit of a window, for all that reports and judges fits."""
        return fit_of(
            self._model.window_problem(window, self._parameters),
            self.state.scales,
            self.state.covariance,
            method=METHOD,
            evaluations=self.evaluations,
        )

    @property
    def noise_level(self) -> float:
        """Root mean square of the noise [N] that the filter reckons with."""
        return math.sqrt(float(np.mean(self._noise.force**2)))

    def _measure_noise(self, scales: Array, drift_rate: float, robust: bool) -> _Noise:
        jacobian = self._misfit.jacobian(scales)
        residual = self._misfit.residual(scales)
        self.evaluations += 1
        count, unknowns = jacobian.shape
        basis = np.linalg.qr(jacobian / _lengths(jacobian))[0]
        unexplained = residual - basis @ (basis.T @ residual)
        variance = float(unexplained @ unexplained) / max(count - unknowns, 1)
        # Correlated noise averages out more slowly: count it as more noise.
        honest = np.diag(least_squares_covariance(jacobian, unexplained))
        white = variance * np.diag(normal_inverse(jacobian))
        known = np.isfinite(honest) & (white > 0.0)
        excess = float(np.median(honest[known] / white[known])) if np.any(known) else 1.0
        level = math.sqrt(variance * max(excess, 1.0))
        deviations = np.full(count, level)
        if robust:
            usual = 1.4826 * float(np.median(np.abs(unexplained)))
            shrunk = min(usual, math.sqrt(variance)) * level / max(math.sqrt(variance), 1e-300)
            outlying = np.abs(unexplained) / max(_HUBER * usual, 1e-300)
            deviations = shrunk * np.sqrt(np.maximum(outlying, 1.0))
        power = float(np.mean(np.square(residual + self._window.force)))
        effect = np.sqrt(np.mean(jacobian**2, axis=0))
        walk = drift_rate * math.sqrt(power) / np.where(effect > 0.0, effect, np.inf)
        # A simulated force has no noise at all.
        floor = 1e-9 * math.sqrt(power)
        return _Noise(np.maximum(deviations, max(floor, 1e-300)), walk)

    def _fading(self, scales: Array, covariance: Array) -> float:
        """Factor on the covariance where the window contradicts the state: a sudden change.

        The squared innovation of the whole window, in the linearised scales, is a chi-square of
        seven degrees of freedom as long as the state is right.
        """
        jacobian = self._misfit.jacobian(scales) / self._noise.force[:, np.newaxis]
        lengths = _lengths(jacobian)
        jacobian = jacobian / lengths
        score = jacobian.T @ (self._misfit.residual(scales) / self._noise.force)
        self.evaluations += 1
        information = jacobian.T @ jacobian
        # Of the score rather than of the step: the information may be ill-conditioned.
        expected = information @ (covariance * np.outer(lengths, lengths)) @ information
        weighted = np.linalg.lstsq(expected + information, score, rcond=None)[0]
        size = scales.size
        surprise = float(score @ weighted)
        return 1.0 if surprise <= _SURPRISE else surprise / size

    def _update(self, chosen: np.ndarray) -> None:
        state = self.state
        size = state.scales.size
        root = _root(state.covariance) * math.sqrt(size + _SPREAD)
        points = state.scales + np.vstack((np.zeros(size), root.T, -root.T))
        weights = np.full(2 * size + 1, 0.5 / (size + _SPREAD))
        weights[0] = _SPREAD / (size + _SPREAD)
        part = self._model.window_problem(self._window.part(chosen), self._parameters)
        deviation = self._noise.force[chosen]
        residuals = part.residual(points.T[:, :, np.newaxis]) / deviation
        self.evaluations += len(points)
        mean = weights @ residuals
        spread = (residuals - mean).T * np.sqrt(weights)
        offsets = (points - state.scales).T * np.sqrt(weights)
        # Fifteen points span the innovation whatever the length of the block: the inverse of
        # (1 + spread spread') is taken in their space.
        inner = np.linalg.inv(np.eye(len(points)) + spread.T @ spread)
        gain = offsets @ inner @ spread.T
        covariance = offsets @ inner @ offsets.T
        self.state = replace(
            state,
            scales=state.scales - gain @ mean,
            covariance=0.5 * (covariance + covariance.T),
        )


def state_of(fit: WindowFit, stamp_ns: int) -> FilterState | None:
    """State to start the filter from; None where the fit does not determine all scales."""
    if not np.all(np.isfinite(fit.whole_covariance)):
        return None
    return FilterState(fit.scales, fit.whole_covariance, stamp_ns, fit.operating_point)


def _blocks(chosen: np.ndarray) -> Iterator[np.ndarray]:
    """Indices of the chosen samples, in blocks."""
    places = np.flatnonzero(chosen)
    for first in range(0, places.size, _BLOCK):
        yield places[first : first + _BLOCK]


def _lengths(columns: Array) -> Array:
    lengths = np.linalg.norm(columns, axis=0)
    return np.asarray(np.where(lengths > 0.0, lengths, 1.0))


def _root(covariance: Array) -> Array:
    """A square root (p, p) of a covariance that may have lost definiteness to rounding.

    Scales differ by many orders of magnitude: the correlation matrix is factored.
    """
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(deviations > 0.0, deviations, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(safe[:, np.newaxis] * vectors * np.sqrt(np.maximum(values, 0.0)))
