"""The misfit of a law to windows, for its parameters or for the unknowns of one window."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model, WindowForces
from mr_damper_ros.signals.arrays import Array


class Misfit:
    """Weighted residual (n,) of windows, and its Jacobian (n, p), for parameters (p,).

    All windows have the same weight, independent of their length. The residual of a window is
    divided by the RMSE of its separate fit. If the residual is only sensor noise, this is the
    maximum-likelihood weight; with model error, it prevents one run with large forces from
    dominating the others. Samples whose force still depends on the unknown past have no weight.

    ``given``: the arguments of the constructor; ``settled`` (n,): samples with a weight;
    ``sample_weights`` (n,) [1/N]: their weights, 0 for other samples; ``sample_windows`` (n,):
    index of the window of each sample.
    """

    def __init__(
        self,
        model: Model,
        windows: Sequence[Window],
        noise: Sequence[float],
        known: Array | None = None,
        *,
        forces: WindowForces | None = None,
    ) -> None:
        """``noise`` [N]: RMSE of the separate fit of each window.

        ``known`` (p,): a parameter set, by which the samples that depend on the unknown past are
        excluded; None if there is no set yet. ``forces``: the forces of the windows, if they exist
        already.

        Raises ValueError if there are no windows.
        """
        if not windows:
            raise ValueError("there are no windows to identify from")
        self.model = model
        self.windows = tuple(windows)
        self.given = model, self.windows, noise, known
        self.forces = model.window_forces(windows) if forces is None else forces
        self.settled = np.concatenate([model.settled(window, known) for window in windows])
        sizes = np.array([window.sample_count for window in windows])
        self.sample_count = int(np.sum(sizes))
        weights = np.sqrt(self.sample_count / len(windows) / sizes) / np.maximum(noise, 1e-12)
        self.sample_windows = np.repeat(np.arange(len(windows)), sizes)
        self.sample_weights = np.where(self.settled, weights[self.sample_windows], 0.0)
        self._unsettled = np.flatnonzero(~self.settled)
        self._measured = np.concatenate([window.force for window in windows])
        self._latest: tuple[Array, Array] | None = None

    @property
    def row_windows(self) -> np.ndarray:
        """Index of the window of each row (n,) of the residual."""
        return self.sample_windows

    @property
    def prior_variances(self) -> Array:
        """Known variances (m,) [1] of the last rows, which belong to a prior, not to samples."""
        return np.empty(0)

    def residual(self, parameters: Array) -> Array:
        """Weighted model minus measurement [1], shape (..., n), for parameters (..., p)."""
        # Cached, because a search evaluates its start and its end more than once.
        if self._latest is None or not np.array_equal(self._latest[0], parameters):
            forces = self.forces.forces(parameters)
            left = forces[0].copy() if len(forces) == 1 else np.concatenate(forces, axis=-1)
            left -= self._measured
            left *= self.sample_weights
            if self._unsettled.size:
                left[..., self._unsettled] = 0.0
            self._latest = np.array(parameters), left
        return self._latest[1]

    def jacobian(self, parameters: Array, columns: Sequence[int] | None = None) -> Array:
        """Derivatives of the residual, shape (n, p), or only the given columns of it."""
        places = range(parameters.size) if columns is None else columns
        # Each column is contiguous in memory.
        result = np.empty((len(places), self.sample_count))
        first = 0
        for derivatives in self.forces.derivatives(parameters, list(places)):
            last = first + len(derivatives)
            weights = self.sample_weights[first:last]
            np.multiply(weights, derivatives.T, out=result[:, first:last])
            first = last
        if self._unsettled.size:
            result[:, self._unsettled] = 0.0
        return result.T

    def mean_square(self, parameters: Array) -> float:
        """Mean of the squared weighted residual; it is 1 if only noise is left."""
        return float(np.mean(np.square(self.residual(parameters))))

    def population_cost(self, parameters: Array) -> Array:
        """:meth:`mean_square` of many sets, shape (s, p) to (s,)."""
        return np.asarray(np.mean(np.square(self.residual(parameters)), axis=-1))


class ChosenParameters:
    """Residual (n,) of a misfit and its Jacobian (n, f), for the parameters (f,) at ``places``.

    All other parameters keep their ``given`` values (p,). ``bounds`` are the lower and upper bounds
    (f,) of the unknowns, None if all are infinite.
    """

    def __init__(self, misfit: Misfit, values: Array, places: Sequence[int]) -> None:
        self.misfit = misfit
        self.given = np.array(values, dtype=float)
        self.places = list(places)
        self._bounds = low, high = tuple(bound[self.places] for bound in misfit.model.bounds)
        self.bounds = None if np.isinf((low, high)).all() else (low, high)

    @property
    def start(self) -> Array:
        """Unknowns (f,) of the given parameters."""
        return self.unknowns(self.given)

    def unknowns(self, parameters: Array) -> Array:
        """The unknowns (f,) of parameters (p,)."""
        return parameters[self.places]

    def parameters(self, unknowns: Array) -> Array:
        """All parameters (p,) for these unknowns (f,), within their bounds."""
        values = self.given.copy()
        low, high = self._bounds
        values[self.places] = np.minimum(np.maximum(unknowns, low), high)
        return values

    def residual(self, unknowns: Array) -> Array:
        """Weighted model minus measurement; 0 for samples without a weight."""
        return self.misfit.residual(self.parameters(unknowns))

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives of the residual with respect to the unknowns, shape (n, f)."""
        return self.misfit.jacobian(self.parameters(unknowns), self.places)


UNHELD = (0.0, math.inf)
"""The range [m/s] that limits no peak velocity."""


class WindowProblem(ChosenParameters):
    """Residual (n,) [N] of a window and its Jacobian (n, f), for the scale parameters (f,).

    The law is evaluated as its set is used: with the peak velocity limited to the range ``held``
    [m/s]. ``settled`` (n,): mask of the samples with a residual; ``forces``: the forces of the
    window, which a new problem may reuse.
    """

    def __init__(
        self,
        model: Model,
        window: Window,
        parameters: Array,
        *,
        held: tuple[float, float] = UNHELD,
        forces: WindowForces | None = None,
    ) -> None:
        seen = window.held_within(*held)
        misfit = Misfit(model, [seen], [1.0], np.array(parameters, dtype=float), forces=forces)
        super().__init__(misfit, parameters, model.unknown_indices.tolist())
        self.model = model
        self.window = window
        self.held = held
        self.settled, self.forces = misfit.settled, misfit.forces

    @property
    def strength(self) -> np.ndarray:
        """Mask (f,) of the unknowns that are gain parameters."""
        return np.isin(self.places, self.model.strength_indices)

    def coefficients(self, unknowns: Array) -> tuple[Array, Array]:
        """Operating-point coefficients (c,) and their derivatives (c, f)."""
        speed, current = self.window.operating_point
        given = self.parameters(unknowns), float(np.clip(speed, *self.held)), current
        gradient = self.model.coefficient_gradient(*given)[:, self.places]
        return self.model.coefficients_at(*given)[:, 0], gradient
