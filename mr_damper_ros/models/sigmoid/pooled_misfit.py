"""Pooled residual of many windows for the sigmoid law and its extension, with exact derivatives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from itertools import pairwise

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.first_order_lag import SETTLING, coil_unsettled, in_coil
from mr_damper_ros.models.operating_points import window_weights, windows_of_samples
from mr_damper_ros.models.sigmoid.extension import (
    EXTENDED_NAMES,
    SIGMOID_COUNT,
    LateForce,
    extension_of,
    is_extended,
)
from mr_damper_ros.models.sigmoid.law import (
    COEFFICIENT_NAMES,
    DEPENDENCES,
    PARAMETER_NAMES,
    Coefficients,
    ForceAndDamping,
    coefficient_jacobian,
    coefficient_parameter_jacobian,
    force_and_damping,
    force_and_damping_jacobian,
    force_from_coefficients,
    operating_point_coefficients,
)
from mr_damper_ros.signals.arrays import Array

_FORCE_BY = tuple(
    (COEFFICIENT_NAMES.index(coefficient), PARAMETER_NAMES.index(parameter))
    for coefficient, parameters in DEPENDENCES.items()
    for parameter in parameters
)
"""Places of the coefficients and of the parameters that they depend on."""

_DAMPING_BY = tuple(
    (coefficient, parameter)
    for coefficient, parameter in _FORCE_BY
    if COEFFICIENT_NAMES[coefficient] in ("f_t", "alpha", "v_h", "v_d")
)
"""The same of those coefficients that the damping depends on."""

_COMPLIANCE, _STIFFNESS, _OFFSET, _COIL = range(SIGMOID_COUNT, len(EXTENDED_NAMES))

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
        self._slowest_lag = slowest_lag
        self._latest: tuple[Array, list[LateForce]] | None = None
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

    @property
    def prior(self) -> None:
        """Every row is a sample."""

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
        places = range(parameters.size) if columns is None else columns
        if not is_extended(parameters):
            return self._weighted(self._own.jacobians(parameters, places))
        return self._extended_jacobian(parameters, places)

    def _weighted(self, blocks: Sequence[Array]) -> Array:
        """Derivatives (p, n) of the windows' forces together and weighted, as (n, p)."""
        result = np.empty((blocks[0].shape[0], self.sample_count))
        first = 0
        for weight, block in zip(self._weights, blocks, strict=True):
            last = first + block.shape[1]
            np.multiply(weight, block, out=result[:, first:last])
            first = last
        return result.T

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
        plain = self._between.forces(sixteen)
        if parameters.ndim == 1:
            return self._extended(self._late_forces(parameters), plain)
        past = self._histories.along(sixteen)
        sets = []
        for k, values in enumerate(parameters):
            of_set = [ForceAndDamping(force[k], damping[k]) for force, damping in past]
            lates = self._late_of(of_set, values)
            sets.append(self._extended(lates, [force[k] for force in plain]))
        return [np.stack(forces) for forces in zip(*sets, strict=True)]

    def _late_forces(self, parameters: Array) -> list[LateForce]:
        """What the compliance makes of the force of each window, for parameters (20,)."""
        # A search asks for the Jacobian where it has just asked for the residual.
        if self._latest is None or not np.array_equal(self._latest[0], parameters):
            past = self._histories.along(parameters[:SIGMOID_COUNT])
            self._latest = parameters.copy(), self._late_of(past, parameters)
        return self._latest[1]

    def _late_of(self, past: Sequence[ForceAndDamping], parameters: Array) -> list[LateForce]:
        extension = extension_of(parameters)
        return [
            LateForce(window.history, along, extension)
            for window, along in zip(self.windows, past, strict=True)
        ]

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
    def _own(self) -> _Motions:
        return _Motions([(w.motion, w.current, w.steady) for w in self.windows])

    @cached_property
    def _between(self) -> _Motions:
        """Of the windows some of whose samples lie between those of their history."""
        few = [window for window in self.windows if not window.history.holds_samples]
        return _Motions([(w.motion, w.current, w.steady) for w in few])

    @cached_property
    def _histories(self) -> _Motions:
        histories = (window.history for window in self.windows)
        return _Motions([(h.motion, h.current, h.periodic) for h in histories])

    @cached_property
    def _unsettled(self) -> list[np.ndarray]:
        return [
            window.history.unsettled(SETTLING * self._slowest_lag)
            | coil_unsettled(window, self._slowest_lag)
            for window in self.windows
        ]

    def _extended(self, lates: Sequence[LateForce], plain: Sequence[Array]) -> list[Array]:
        """Forces for one set; ``plain`` are those of the sigmoid law at samples in between."""
        rest = iter(plain)
        forces = []
        for window, late, unsettled in zip(self.windows, lates, self._unsettled, strict=True):
            force = late.force(window.motion.displacement, partial(next, rest))
            force[unsettled] = window.force[unsettled]
            forces.append(force)
        return forces

    def _extended_jacobian(self, parameters: Array, columns: Sequence[int]) -> Array:
        """Of the twenty columns those wanted."""
        coil = float(parameters[_COIL])
        if not self._current_changes:
            return self._without_lag_of_coil(parameters, columns)
        settled = self._with_coil(coil) if coil > 0.0 else self
        jacobian = settled._without_lag_of_coil(_without_coil(parameters), columns)
        if _COIL in columns:
            changed = parameters + np.eye(parameters.size)[_COIL] * _STEP_OF_COIL
            residual = self.residual(parameters)
            by_coil = (self.residual(changed) - residual) / _STEP_OF_COIL
            jacobian[:, list(columns).index(_COIL)] = by_coil
        return jacobian

    def _without_lag_of_coil(self, parameters: Array, columns: Sequence[int]) -> Array:
        """Derivatives for a coil without lag, by which the derivative is left at zero."""
        sixteen = parameters[:SIGMOID_COUNT]
        lates = self._late_forces(parameters)
        of_sixteen = [place for place in columns if place < SIGMOID_COUNT]
        rows = {place: row for row, place in enumerate(columns)}
        own = (block.T for block in self._between.jacobians(sixteen, of_sixteen))
        past = self._histories.jacobians_along(sixteen, of_sixteen)
        blocks = []
        for place, window in enumerate(self.windows):
            late, displacement = lates[place], window.motion.displacement
            block = np.zeros((len(rows), displacement.size))
            if of_sixteen:
                found = late.jacobian(past[place], partial(next, own))
                block[[rows[each] for each in of_sixteen]] = found.T
            if _COMPLIANCE in rows:
                block[rows[_COMPLIANCE]] = late.by_compliance()
            if _STIFFNESS in rows:
                block[rows[_STIFFNESS]] = displacement
            if _OFFSET in rows:
                block[rows[_OFFSET]] = 1.0
            block[:, self._unsettled[place]] = 0.0
            blocks.append(block)
        return self._weighted(blocks)


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
        current = np.concatenate([np.empty(0), *currents])
        # One value stands for all where none differs.
        self._current = current[:1] if np.all(current == current[:1]) else current

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

    def jacobians(self, parameters: Array, columns: Sequence[int]) -> list[Array]:
        """Derivatives (p, n) of each motion's force by some of the parameters."""
        inner = self._inner_jacobian(parameters)
        return [
            _chain(coefficient_jacobian(*motion), inner[place], _FORCE_BY, columns)
            for motion, place in zip(self._each(parameters), self._places, strict=True)
        ]

    def jacobians_along(self, parameters: Array, columns: Sequence[int]) -> list[ForceAndDamping]:
        """Derivatives (n, p) of what :meth:`along` gives by some of the parameters."""
        inner = self._inner_jacobian(parameters)
        found = []
        for motion, place in zip(self._each(parameters), self._places, strict=True):
            by_force, by_damping = force_and_damping_jacobian(*motion)
            by_force = _chain(by_force, inner[place], _FORCE_BY, columns).T
            by_damping = _chain(by_damping, inner[place], _DAMPING_BY, columns).T
            found.append(ForceAndDamping(by_force, by_damping))
        return found

    def _inner_jacobian(self, parameters: Array) -> Array:
        return coefficient_parameter_jacobian(parameters, self._peak_velocity, self._current)


def _without_coil(parameters: Array) -> Array:
    return np.append(parameters[:-1], 0.0)


def _chain(
    outer: Array, inner: Array, dependences: Sequence[tuple[int, int]], columns: Sequence[int]
) -> Array:
    """Derivatives (p, n) by the parameters of some ``columns``.

    From those (n, 7) by the coefficients and those of the latter (n or 1, 7, 16).
    """
    if inner.shape[0] == 1:
        return np.asarray(inner[0][:, columns].T @ outer.T)
    rows = {parameter: row for row, parameter in enumerate(columns)}
    result = np.zeros((len(rows), outer.shape[0]))
    for coefficient, parameter in dependences:
        if parameter in rows:
            row = result[rows[parameter]]
            row += outer[:, coefficient] * inner[:, coefficient, parameter]
    return result
