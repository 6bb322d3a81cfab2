"""The recursive tracker: an extended Kalman filter on the window parameters of any force law.

The state holds the unknowns of the window problem and is modelled as a random walk. The new samples
of a window form one measurement. The update is iterated, that is, relinearised about its own result
(Gauss-Newton steps on the posterior; Bell and Cathey, IEEE Transactions on Automatic Control 38,
1993), with the Jacobian of the window fit. A window fit initialises the filter; from then on every
sample is used once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import least_squares_covariance, white_level
from mr_damper_ros.estimation.local_search import HUBER
from mr_damper_ros.estimation.window_fit import WindowFit, contradicting, fit_of
from mr_damper_ros.models.misfit import WindowProblem
from mr_damper_ros.signals.arrays import NORMAL_MEDIAN, Array
from mr_damper_ros.signals.blocks import NANOSECONDS

METHOD = "recursive"

_STEPS = 3
"""Number of Gauss-Newton steps. After a change of the force by a quarter, they reach the minimum to
within 1e-3 standard errors."""


@dataclass(frozen=True, eq=False)
class FilterState:
    """Mean (f,) and covariance (f, f) of the unknowns after the sample stamped ``stamp_ns``.

    The model's window problem defines the unknowns. ``operating_point`` (peak velocity [m/s],
    current [A]) belongs to the last update.
    """

    mean: Array
    covariance: Array
    stamp_ns: int
    operating_point: tuple[float, float]

    @classmethod
    def of(cls, fit: WindowFit, stamp_ns: int) -> FilterState | None:
        """Initial state from a fit; None if the fit does not determine all unknowns."""
        if not np.all(np.isfinite(fit.whole_covariance)):
            return None
        return cls(fit.scales, fit.whole_covariance, stamp_ns, fit.operating_point)


class RecursiveFilter:
    """Updates the state with the samples of one window, which ends at ``stamp_ns``.

    ``problem`` is the window problem of these samples. ``drift_rate`` [1/sqrt(s)]: in one second
    the random walk of each unknown changes the force by this fraction of its root mean square. The
    noise of the force is estimated from the residual that remains after a linear fit of the
    unknowns, with its autocorrelation; ``robust`` increases it at outliers.
    """

    def __init__(
        self,
        state: FilterState,
        problem: WindowProblem,
        stamp_ns: int,
        *,
        drift_rate: float,
        robust: bool = False,
    ) -> None:
        self._problem = problem
        self._stamp_ns = stamp_ns
        self.evaluations = 1
        jacobian, residual = problem.jacobian(state.mean), problem.residual(state.mean)
        power = float(np.mean(np.square(residual + problem.window.force)))
        # A simulated force has no noise, and the deviation must not be zero.
        floor = max(1e-9 * math.sqrt(power), 1e-300)
        settled = problem.settled
        noise = np.zeros(residual.size)
        noise[settled] = _noise(jacobian[settled], residual[settled], robust)
        self._deviation = np.maximum(noise, floor)
        effect = np.sqrt(np.mean(jacobian**2, axis=0))
        walk = drift_rate * math.sqrt(power) / np.where(effect > 0.0, effect, np.inf)
        elapsed = max(stamp_ns - state.stamp_ns, 0) / NANOSECONDS
        self._mean = state.mean
        self._root = _root(state.covariance + np.diag(walk**2 * elapsed))
        whitened = (jacobian / self._deviation[:, np.newaxis])[settled] @ self._root
        innovation = (residual / self._deviation)[settled]
        self._root = self._root * math.sqrt(_fading(whitened, innovation))

    @property
    def noise_level(self) -> float:
        """Root mean square of the noise [N] that the filter expects."""
        return math.sqrt(float(np.mean(self._deviation**2)))

    @property
    def state(self) -> FilterState:
        """The state after all updates."""
        point = self._problem.window.operating_point
        return FilterState(self._mean, self._root @ self._root.T, self._stamp_ns, point)

    def take_in(self, chosen: np.ndarray) -> None:
        """Update the state with the chosen samples, a mask of shape (n,)."""
        problem, root = self._problem, self._root
        place = np.zeros(self._mean.size)  # in prior standard deviations
        for _ in range(_STEPS):
            unknowns = self._mean + root @ place
            rows = chosen & problem.settled
            jacobian = (problem.jacobian(unknowns) / self._deviation[:, np.newaxis])[rows] @ root
            residual = (problem.residual(unknowns) / self._deviation)[rows]
            information = np.eye(place.size) + jacobian.T @ jacobian
            place = np.linalg.solve(information, jacobian.T @ (jacobian @ place - residual))
            self.evaluations += 1
        self._mean = self._mean + root @ place
        self._root = root @ np.linalg.inv(np.linalg.cholesky(information)).T

    def as_fit(self, problem: WindowProblem) -> WindowFit:
        """The state in the form of a window fit, for the acceptance test and the reports."""
        covariance = self._root @ self._root.T
        return fit_of(problem, self._mean, covariance, method=METHOD, evaluations=self.evaluations)


def _noise(jacobian: Array, residual: Array, robust: bool) -> Array:
    """Standard deviation [N] (n,) of the noise, estimated from a residual (n,).

    ``jacobian`` (n, f) holds the derivatives of the force by the unknowns. The part of the residual
    that a change of the unknowns can explain is removed first. ``robust`` increases the noise at
    outliers.
    """
    count, unknowns = jacobian.shape
    lengths = np.linalg.norm(jacobian, axis=0)
    basis = np.linalg.qr(jacobian / np.where(lengths > 0.0, lengths, 1.0))[0]
    unexplained = residual - basis @ (basis.T @ residual)
    variance = float(unexplained @ unexplained) / max(count - unknowns, 1)
    # Correlated noise averages out more slowly; it is replaced by larger white noise.
    honest, least = least_squares_covariance(jacobian, unexplained), math.sqrt(variance)
    level = max(white_level(jacobian, honest, least), least)
    if not robust:
        return np.full(count, level)
    usual = float(np.median(np.abs(unexplained))) / NORMAL_MEDIAN
    shrunk = min(usual, least) * level / max(least, 1e-300)
    outlying = np.abs(unexplained) / max(HUBER * usual, 1e-300)
    return np.asarray(shrunk * np.sqrt(np.maximum(outlying, 1.0)))


def _fading(jacobian: Array, residual: Array) -> float:
    """Factor on the covariance if the window contradicts the state, as after a sudden change.

    ``jacobian`` (n, f) and ``residual`` (n,) are in units of standard deviations. If the state is
    right, the squared innovation follows a chi-squared distribution with f degrees of freedom.
    """
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    seen = values > np.finfo(float).eps * values.size * max(float(values[-1]), 1e-300)
    score = (vectors.T @ (jacobian.T @ residual))[seen]
    surprise = float(np.sum(score**2 / (values[seen] * (1.0 + values[seen]))))
    return 1.0 if surprise <= contradicting(values.size) else surprise / values.size


def _root(covariance: Array) -> Array:
    """A square root (f, f) of a covariance that rounding may have made slightly indefinite.

    The unknowns differ by many orders of magnitude, so the correlation matrix is factored.
    """
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(deviations > 0.0, deviations, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    return np.asarray(safe[:, np.newaxis] * vectors * np.sqrt(np.maximum(values, 0.0)))
