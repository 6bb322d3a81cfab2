"""What an identification over many operating points works on, whatever the model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.quantities import SearchEffort
from mr_damper_ros.signals.arrays import Array

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


class PriorRows(NamedTuple):
    """Rows of a residual that are no samples: the mask (n,) of them, and the variance of each [1].

    What they scatter by is known, and not told by those few that there are.
    """

    rows: np.ndarray
    variance: float


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


class PooledProblem(Protocol):
    """Weighted residual (n,) of many windows, and its Jacobian (n, p), for parameters (p,).

    Every window counts the same, whatever its length: its samples are weighted by what the
    window's own best fit leaves of the force. Where only sensor noise is left this is the
    maximum-likelihood weight; where the law itself is not exact it keeps one strong run from
    drowning all others.
    """

    windows: tuple[Window, ...]
    sample_count: int

    def residual(self, parameters: Array) -> Array:
        """Weighted model minus measurement [1] of all windows, shape (n,)."""

    def jacobian(self, parameters: Array, columns: Sequence[int] | None = None) -> Array:
        """Derivatives of the residual, shape (n, p), or only the given columns of it."""

    def mean_square(self, parameters: Array) -> float:
        """Mean of the squared weighted residual: 1 where nothing but the noise is left."""

    def population_cost(self, parameters: Array) -> Array:
        """The mean square of many sets, shape (s, p) to (s,)."""

    @property
    def sample_weights(self) -> Array:
        """Weights (n,) [1/N] of the samples of all windows, 0 where one has no residual."""

    @property
    def row_windows(self) -> np.ndarray:
        """The place of the window that each row (n,) of the residual belongs to."""

    @property
    def prior(self) -> PriorRows | None:
        """Rows that are no samples; None where there are none."""


def window_weights(windows: Sequence[Window], noise: Sequence[float]) -> list[float]:
    """Weight [1/N] of the samples of each window; ValueError where there are no windows."""
    if not windows:
        raise ValueError("there are no windows to identify from")
    share = sum(window.sample_count for window in windows) / len(windows)
    return [
        float(np.sqrt(share / window.sample_count)) / max(sigma, 1e-12)
        for window, sigma in zip(windows, noise, strict=True)
    ]


def windows_of_samples(windows: Sequence[Window]) -> np.ndarray:
    """The place of the window that each sample belongs to, of all windows in turn: shape (n,)."""
    return np.repeat(np.arange(len(windows)), [window.sample_count for window in windows])
