"""The problem of a window, and of many, for a law that knows the derivatives of its force.

A law that is integrated sample by sample takes as long for each set as for the first: differences
would take as many times as long as there are parameters.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.current_dependence import CurrentDependentModel
from mr_damper_ros.models.difference_problems import DifferenceProblem, PooledDifferences
from mr_damper_ros.models.first_order_lag import coil_current
from mr_damper_ros.signals.arrays import Array

_STEP_OF_COIL = 1e-6
"""[s], of a difference by the coil's time constant."""


class Along(NamedTuple):
    """What a law is differentiated along: the motion, coefficients (n,) each, and their chain.

    ``chain`` (c, n, p): derivatives of the coefficients by the parameters; (c, 1, p) where the
    current is constant.
    """

    motion: Motion
    period: float
    coefficients: list[Array]
    chain: Array


def along(
    model: CurrentDependentModel, window: Window, parameters: Array, columns: Sequence[int]
) -> Along:
    """The history of a window at its own pace; of a cycle that has always gone on, two.

    The ``chain`` is that of the p parameters of some ``columns``.
    """
    history = window.history.coarse
    motion, current, count = history.motion, history.current, history.current.size
    if history.periodic:
        twice = np.concatenate((np.arange(count), np.arange(count)))
        motion, current = motion.part(twice), current[twice]
    tau, late = float(parameters[-1]), current
    if float(np.ptp(current)) > 0.0:
        constants = np.array([tau, tau + _STEP_OF_COIL])
        late, later = coil_current(current, constants, history.period, None)
        chain = model.dependences(parameters, late, (later - late) / _STEP_OF_COIL)
    else:
        chain = model.dependences(parameters, current[:1], np.zeros(1))
    values = model.coefficients_along(parameters, late)
    return Along(motion, history.period, values, chain[..., list(columns)])


def at_samples(window: Window, derivatives: Array) -> Array:
    """Derivatives (m, p) along the history of a window at its samples (n, p)."""
    history = window.history.coarse
    return history.at_samples(derivatives[-history.current.size :])


def driven(by: Mapping[int, Array], chain: Array) -> Array:
    """What steps add by the parameters (n, p), from what they add (n,) by coefficients."""
    places = list(by)
    if chain.shape[1] == 1:
        # By columns, which lie together in memory: each is then solved for as it is.
        return np.asarray(chain[places, 0].T @ np.stack(list(by.values()))).T
    return sum((by[place][:, np.newaxis] * chain[place] for place in places), np.zeros(()))


def accumulated(kept: Array, added: Array) -> Array:
    """Solve y[k] = kept[k] y[k-1] + added[k] for columns (n, p), which may be overwritten."""
    from scipy.linalg.lapack import dtbtrs  # here: see mr_damper_ros.entry_points

    bands = np.ones((2, kept.size), order="F")
    bands[1, :-1] = -kept[1:]
    solved = dtbtrs(bands, added, uplo="L", diag="U", overwrite_b=True)[0]
    return np.asarray(solved.reshape(added.shape))


class DifferentiatedModel(CurrentDependentModel):
    """A law that knows the derivatives of its force."""

    @abstractmethod
    def window_derivatives(
        self, window: Window, parameters: Array, columns: Sequence[int]
    ) -> Array:
        """Derivatives (n, p) of the force at the samples of a window by those of some columns."""

    def window_problem(self, window: Window, parameters: Array) -> KnownDerivatives:
        """What one current determines, with its derivatives."""
        return KnownDerivatives(self, window, parameters)

    def pooled_problem(
        self, windows: Sequence[Window], noise: Sequence[float], known: Array | None = None
    ) -> PooledDerivatives:
        """All windows, with their derivatives."""
        return PooledDerivatives(self, windows, noise, known)


class KnownDerivatives(DifferenceProblem):
    """The problem of one window."""

    def __init__(self, model: DifferentiatedModel, window: Window, parameters: Array) -> None:
        super().__init__(model, window, parameters)
        self._law = model

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual by the unknowns, shape (n, f)."""
        derivatives = self._law.window_derivatives(
            self.window, self.parameters(unknowns), self._free.tolist()
        )
        return np.where(self.settled[:, np.newaxis], derivatives, 0.0)


class PooledDerivatives(PooledDifferences):
    """The pooled residual of many windows."""

    def __init__(
        self,
        model: DifferentiatedModel,
        windows: Sequence[Window],
        noise: Sequence[float],
        known: Array | None,
    ) -> None:
        super().__init__(model, windows, noise, known)
        self._law = model

    def jacobian(self, parameters: Array, columns: Sequence[int] | None = None) -> Array:
        """Derivatives of the residual, shape (n, p), or only the given columns of it."""
        weights = np.split(self.sample_weights, np.cumsum(self._counts)[:-1])
        chosen = range(parameters.size) if columns is None else columns
        return np.concatenate(
            [
                weight[:, np.newaxis] * self._law.window_derivatives(window, parameters, chosen)
                for window, weight in zip(self.windows, weights, strict=True)
            ]
        )

    @property
    def _counts(self) -> list[int]:
        return [window.sample_count for window in self.windows]
