"""Pooled residual of many windows for the sigmoid law and its extension, with exact derivatives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.coil import coil_unsettled, in_coil
from mr_damper_ros.models.first_order_lag import SETTLING
from mr_damper_ros.models.operating_points import window_weights, windows_of_samples
from mr_damper_ros.models.sigmoid.extension import (
    SIGMOID_COUNT,
    Extension,
    ForceAndDamping,
    extension_of,
    force_and_damping,
    force_and_damping_jacobian,
    is_extended,
    late_force,
    late_force_jacobian,
)
from mr_damper_ros.models.sigmoid.law import (
    COEFFICIENT_NAMES,
    DEPENDENCES,
    PARAMETER_NAMES,
    Coefficients,
    coefficient_jacobian,
    coefficient_parameter_jacobian,
    force_from_coefficients,
    operating_point_coefficients,
)
from mr_damper_ros.signals.arrays import Array

_DEPENDENCES = tuple(
    (COEFFICIENT_NAMES.index(coefficient), PARAMETER_NAMES.index(parameter))
    for coefficient, parameters in DEPENDENCES.items()
    for parameter in parameters
)

_ALL = slice(None)

_STEP_OF_COIL = 1e-6
"""Step [s] of the difference that tells how the force changes with the time constant."""


class PooledMisfit:
    """Weighted residual of windows and its Jacobian for parameters of shape (16,) or (20,)."""

    def __init__(
        self, windows: Sequence[Window], noise: Sequence[float], slowest_lag: float = 0.0
    ) -> None:
        """``noise`` [N]: what each window's own best fit leaves (RMSE). ``slowest_lag`` [s]:
        samples so early that a lag this slow may not have settled count for nothing, in the
        extended law.

        Raises ValueError where there are no windows.
        """  # noqa: D205
        self.windows = tuple(windows)
        self._weights = window_weights(windows, noise)
        self._own = _Motions([(w.motion, w.current, w.steady) for w in self.windows])
        self._slowest_lag = slowest_lag
        self._in_coil: tuple[float, PooledMisfit] | None = None
        self.sample_count = sum(window.sample_count for window in windows)

    @property
    def sample_weights(self) -> Array:
        """Weights (n,) [1/N] of the samples, 0 where the past is not known."""
        counted: list[Array] = [np.ones(window.sample_count) for window in self.windows]
        if self._slowest_lag > 0.0:
            counted = [1.0 - unsettled for unsettled in self._unsettled]
        return np.concatenate([w * c for w, c in zip(self._weights, counted, strict=True)])

    @property
    def row_windows(self) -> np.ndarray:
        """The place of the window that each row (n,) of the residual belongs to."""
        return windows_of_samples(self.windows)

    def residual(self, parameters: Array) -> Array:
        """Weighted model minus measurement [1] of all windows, shape (n,)."""
        forces = self._forces(parameters)
        return np.concatenate(
            [
                weight * (force - window.force)
                for weight, force, window in zip(self._weights, forces, self.windows, strict=True)
            ]
        )

    def mean_square(self, parameters: Array) -> float:
        """Mean of the squared weighted residual: 1 where nothing but the noise is left."""
        return float(np.mean(np.square(self.residual(parameters))))

    def population_cost(self, parameters: Array) -> Array:
        """:meth:`mean_square` of many sets, shape (s, 16) or (s, 20) to (s,)."""
        total = np.zeros(parameters.shape[0])
        forces = self._forces(parameters)
        for weight, force, window in zip(self._weights, forces, self.windows, strict=True):
            total += weight**2 * np.sum(np.square(force - window.force), axis=-1)
        return total / self.sample_count

    def jacobian(self, parameters: Array, columns: Sequence[int] | None = None) -> Array:
        """Derivatives of :meth:`residual`, shape (n, p), or only the given columns of it."""
        if not is_extended(parameters):
            return np.concatenate(self._own.jacobians(parameters, columns, self._weights))
        everything = self._extended_jacobian(parameters)
        return everything if columns is None else everything[:, columns]

    def _forces(self, parameters: Array) -> list[Array]:
        """Force [N] of each window, shape (..., n)."""
        if not is_extended(parameters):
            return self._own.forces(parameters)
        sixteen = parameters[..., :SIGMOID_COUNT]
        if self._current_changes and np.any(parameters[..., -1] > 0.0):
            if parameters.ndim == 1:
                return self._with_coil(float(parameters[-1]))._forces(_without_coil(parameters))
            each = [self._forces(values) for values in parameters]
            return [np.stack(forces) for forces in zip(*each, strict=True)]
        own = self._own.along(sixteen)
        past = self._past(own, self._histories.along(sixteen))
        if parameters.ndim == 1:
            return self._extended(own, past, extension_of(parameters))
        sets = [
            self._extended(_of_set(own, k), _of_set(past, k), extension_of(values))
            for k, values in enumerate(parameters)
        ]
        return [np.stack(forces) for forces in zip(*sets, strict=True)]

    @cached_property
    def _current_changes(self) -> bool:
        return not all(window.has_constant_current for window in self.windows)

    def _with_coil(self, time_constant: float) -> PooledMisfit:
        """The same for the currents of the coil, which then lags no more."""
        if self._in_coil is None or self._in_coil[0] != time_constant:
            noise = [1.0] * len(self.windows)
            windows = [in_coil(window, time_constant) for window in self.windows]
            made = PooledMisfit(windows, noise, self._slowest_lag)
            made._weights, made._unsettled = self._weights, self._unsettled
            self._in_coil = time_constant, made
        return self._in_coil[1]

    @cached_property
    def _histories(self) -> _Motions:
        """Of the windows that are not their own history."""
        histories = (window.history for window in self.windows)
        return _Motions([(h.motion, h.current, h.periodic) for h in histories if not h.is_window])

    def _past(
        self, own: list[ForceAndDamping], histories: list[ForceAndDamping]
    ) -> list[ForceAndDamping]:
        """Of each window what belongs to its history, which may be the window itself."""
        rest = iter(histories)
        return [
            values if window.history.is_window else next(rest)
            for window, values in zip(self.windows, own, strict=True)
        ]

    @cached_property
    def _unsettled(self) -> list[np.ndarray]:
        return [
            window.history.unsettled(SETTLING * self._slowest_lag)
            | coil_unsettled(window, self._slowest_lag)
            for window in self.windows
        ]

    def _extended(
        self, own: list[ForceAndDamping], past: list[ForceAndDamping], extension: Extension
    ) -> list[Array]:
        forces = []
        for place, window in enumerate(self.windows):
            displacement, unsettled = window.motion.displacement, self._unsettled[place]
            force = late_force(
                window.history, own[place].force, past[place], displacement, extension
            )
            force[unsettled] = window.force[unsettled]
            forces.append(force)
        return forces

    def _extended_jacobian(self, parameters: Array) -> Array:
        """All twenty columns."""
        coil = float(parameters[-1])
        if not self._current_changes:
            return np.pad(self._without_lag_of_coil(parameters), ((0, 0), (0, 1)))
        settled = self._with_coil(coil) if coil > 0.0 else self
        changed = parameters + np.eye(parameters.size)[-1] * _STEP_OF_COIL
        by_coil = (self.residual(changed) - self.residual(parameters)) / _STEP_OF_COIL
        return np.column_stack((settled._without_lag_of_coil(parameters), by_coil))

    def _without_lag_of_coil(self, parameters: Array) -> Array:
        """Derivatives by the other nineteen, for a coil without lag."""
        sixteen, extension = parameters[:SIGMOID_COUNT], extension_of(parameters)
        past = self._past(self._own.along(sixteen), self._histories.along(sixteen))
        own_by_sixteen = self._own.jacobians_along(sixteen)
        by_sixteen = self._past(own_by_sixteen, self._histories.jacobians_along(sixteen))
        blocks = []
        for place, window in enumerate(self.windows):
            of_sixteen, of_compliance = late_force_jacobian(
                window.history,
                own_by_sixteen[place].force,
                past[place],
                by_sixteen[place],
                extension,
            )
            displacement = window.motion.displacement
            block = np.column_stack(
                (of_sixteen, of_compliance, displacement, np.ones(displacement.size))
            )
            block[self._unsettled[place]] = 0.0
            blocks.append(self._weights[place] * block)
        return np.concatenate(blocks)


class _Motions:
    """Sigmoid forces along several motions, by one evaluation of the laws.

    With one at a time, a third of the time of a search would go into calls.
    """

    def __init__(self, motions: Sequence[tuple[Motion, Array, bool]]) -> None:
        """Motion, current (n,) [A], and whether both are steady: one value then stands for all."""
        self._velocities = [motion.velocity for motion, _, _ in motions]
        self._branches = [np.sign(motion.acceleration) for motion, _, _ in motions]
        chosen = [slice(0, 1) if steady else slice(None) for _, _, steady in motions]
        speeds = [m.peak_velocity[part] for (m, _, _), part in zip(motions, chosen, strict=True)]
        currents = [i[part] for (_, i, _), part in zip(motions, chosen, strict=True)]
        edges = np.cumsum([0, *(speed.size for speed in speeds)]).tolist()
        self._places = [slice(*pair) for pair in pairwise(edges)]
        self._peak_velocity = np.concatenate([np.empty(0), *speeds])
        self._current = np.concatenate([np.empty(0), *currents])

    def _each(self, parameters: Array) -> Iterator[tuple[Coefficients, Array, Array]]:
        """Of each motion the coefficients for parameters (..., 16), the velocity, the branch."""
        together = operating_point_coefficients(parameters, self._peak_velocity, self._current)
        for place, velocity, branch in zip(
            self._places, self._velocities, self._branches, strict=True
        ):
            yield Coefficients(*(c[..., place] for c in together)), velocity, branch

    def forces(self, parameters: Array) -> list[Array]:
        """Force [N] along each motion, shape (..., n), for parameters of shape (..., 16)."""
        return [force_from_coefficients(*motion) for motion in self._each(parameters)]

    def along(self, parameters: Array) -> list[ForceAndDamping]:
        """The same with the damping of the sigmoid."""
        return [force_and_damping(*motion) for motion in self._each(parameters)]

    def jacobians(
        self, parameters: Array, columns: Sequence[int] | None, weights: Sequence[float]
    ) -> list[Array]:
        """Derivatives (n, p) of each motion's force by all or some parameters, times a weight."""
        inner = self._inner_jacobian(parameters)
        chosen = _ALL if columns is None else np.array(columns)
        return [
            _chain(coefficient_jacobian(*motion), inner[place], weight, chosen)
            for motion, place, weight in zip(
                self._each(parameters), self._places, weights, strict=True
            )
        ]

    def jacobians_along(self, parameters: Array) -> list[ForceAndDamping]:
        """Derivatives (n, 16) of what :meth:`along` gives by all parameters."""
        inner = self._inner_jacobian(parameters)
        return [
            ForceAndDamping(
                *(_chain(outer, inner[place]) for outer in force_and_damping_jacobian(*motion))
            )
            for motion, place in zip(self._each(parameters), self._places, strict=True)
        ]

    def _inner_jacobian(self, parameters: Array) -> Array:
        return coefficient_parameter_jacobian(parameters, self._peak_velocity, self._current)


def _without_coil(parameters: Array) -> Array:
    return np.append(parameters[:-1], 0.0)


def _of_set(motions: list[ForceAndDamping], number: int) -> list[ForceAndDamping]:
    """One of the sets of parameters (s, ...) that the values of all motions are given for."""
    return [ForceAndDamping(force[number], damping[number]) for force, damping in motions]


def _chain(
    outer: Array, inner: Array, weight: float = 1.0, columns: slice | np.ndarray = _ALL
) -> Array:
    """Derivatives (n, p) by parameters from those (n, 7) by coefficients and (n or 1, 7, 16)."""
    if inner.shape[0] == 1:
        # Row by row in memory: the product is then twice as fast.
        return np.asarray(outer @ np.ascontiguousarray(weight * inner[0][:, columns]))
    result = np.zeros((inner.shape[2], inner.shape[0])).T
    for coefficient, parameter in _DEPENDENCES:
        result[:, parameter] += outer[:, coefficient] * inner[:, coefficient, parameter]
    return np.asarray(weight * result[:, columns])
