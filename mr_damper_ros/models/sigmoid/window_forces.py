"""Forces of the sigmoid law and its extension at the samples of windows, with exact derivatives."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from itertools import pairwise

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import MotionHistory, Window
from mr_damper_ros.models.first_order_lag import FirstOrderLag, in_coil
from mr_damper_ros.models.force_model import Model, WindowForces
from mr_damper_ros.models.quantities import DIFFERENCE
from mr_damper_ros.models.sigmoid.following import (
    EXTENDED_NAMES,
    SIGMOID_COUNT,
    Extension,
    extension_of,
    is_extended,
)
from mr_damper_ros.models.sigmoid.law import (
    COEFFICIENT_NAMES,
    DEPENDENCES,
    PARAMETER_NAMES,
    SCALE_INDICES,
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
"""Pairs of indices: a coefficient and a parameter that it depends on."""

_DAMPING_BY = tuple(
    (coefficient, parameter)
    for coefficient, parameter in _FORCE_BY
    if COEFFICIENT_NAMES[coefficient] in ("f_t", "alpha", "v_h", "v_d")
)
"""The pairs whose coefficient affects the damping."""

_SHAPE_INDICES = np.setdiff1d(np.arange(SIGMOID_COUNT), SCALE_INDICES)
_F0, _K5 = (PARAMETER_NAMES.index(name) for name in ("f0", "k5"))
_SCALED = {place: coefficient for coefficient, place in enumerate(SCALE_INDICES.tolist())}
"""Index of the coefficient that is proportional to a parameter, by the index of the parameter."""

_COMPLIANCE, _STIFFNESS, _OFFSET, _COIL = range(SIGMOID_COUNT, len(EXTENDED_NAMES))


class SigmoidForces(WindowForces):
    """Window forces for parameters of shape (16,) or (20,)."""

    def __init__(self, model: Model, windows: Sequence[Window]) -> None:
        super().__init__(model, windows)
        self._latest: tuple[bytes, list[LateForce]] | None = None
        self._in_coil: tuple[float, SigmoidForces] | None = None

    def forces(self, parameters: Array) -> list[Array]:
        """Force (..., n) [N] of each window, for parameters (..., p)."""
        if not is_extended(parameters):
            return self._own.forces(parameters)
        if parameters.ndim > 1:
            each = [self.forces(values) for values in parameters]
            return [np.stack(forces) for forces in zip(*each, strict=True)]
        if self._current_changes and parameters[_COIL] > 0.0:
            return self._with_coil(float(parameters[_COIL])).forces(_without_coil(parameters))
        plain = iter(self._between.forces(parameters[:SIGMOID_COUNT]))
        return [
            late.force(window.motion.displacement, partial(next, plain))
            for window, late in zip(self.windows, self._late_forces(parameters), strict=True)
        ]

    def derivatives(self, parameters: Array, columns: Sequence[int]) -> list[Array]:
        """Derivatives (n, c) of the force of each window, for parameters (p,), at c places."""
        if not is_extended(parameters):
            return [block.T for block in self._own.jacobians(parameters, columns)]
        coil = float(parameters[_COIL])
        if not self._current_changes:
            return self._without_lag_of_coil(parameters, columns)
        settled = self._with_coil(coil) if coil > 0.0 else self
        found = settled._without_lag_of_coil(_without_coil(parameters), columns)
        if _COIL in columns:
            place = list(columns).index(_COIL)
            changed = parameters + np.eye(parameters.size)[_COIL] * DIFFERENCE
            pairs = zip(found, self.forces(changed), self.forces(parameters), strict=True)
            for derivatives, later, force in pairs:
                derivatives[:, place] = (later - force) / DIFFERENCE
        return found

    def _without_lag_of_coil(self, parameters: Array, columns: Sequence[int]) -> list[Array]:
        """Derivatives without the lag of the coil; the column of its time constant is zero."""
        sixteen = parameters[:SIGMOID_COUNT]
        lates = self._late_forces(parameters)
        of_sixteen = [place for place in columns if place < SIGMOID_COUNT]
        rows = {place: row for row, place in enumerate(columns)}
        own = (block.T for block in self._between.jacobians(sixteen, of_sixteen))
        past = self._histories.jacobians_along(sixteen, of_sixteen)
        found = []
        for late, along, window in zip(lates, past, self.windows, strict=True):
            block = np.zeros((len(rows), window.sample_count))
            if of_sixteen:
                late_ones = late.jacobian(along, partial(next, own))
                block[[rows[each] for each in of_sixteen]] = late_ones.T
            if _COMPLIANCE in rows:
                block[rows[_COMPLIANCE]] = late.by_compliance()
            if _STIFFNESS in rows:
                block[rows[_STIFFNESS]] = window.motion.displacement
            if _OFFSET in rows:
                block[rows[_OFFSET]] = 1.0
            found.append(block.T)
        return found

    def _late_forces(self, parameters: Array) -> list[LateForce]:
        """Lagged force of each window, for parameters (20,)."""
        # Cached, because a search evaluates the Jacobian right after the residual.
        if self._latest is None or self._latest[0] != parameters.tobytes():
            past = self._histories.along(parameters[:SIGMOID_COUNT])
            extension = extension_of(parameters)
            lates = [
                LateForce(window.history, along, extension)
                for window, along in zip(self.windows, past, strict=True)
            ]
            self._latest = parameters.tobytes(), lates
        return self._latest[1]

    @cached_property
    def _current_changes(self) -> bool:
        return not all(window.has_constant_current for window in self.windows)

    def _with_coil(self, time_constant: float) -> SigmoidForces:
        """The forces of the windows with their current replaced by the coil current."""
        if self._in_coil is None or self._in_coil[0] != time_constant:
            windows = [in_coil(window, time_constant) for window in self.windows]
            self._in_coil = time_constant, SigmoidForces(self.model, windows)
        return self._in_coil[1]

    @cached_property
    def _own(self) -> _Motions:
        return _Motions([(window.motion, window.current) for window in self.windows])

    @cached_property
    def _between(self) -> _Motions:
        """Motions of the windows whose samples lie between the samples of their history."""
        few = [window for window in self.windows if not window.history.holds_samples]
        return _Motions([(window.motion, window.current) for window in few])

    @cached_property
    def _histories(self) -> _Motions:
        histories = (window.history for window in self.windows)
        return _Motions([(history.motion, history.current) for history in histories])


class _Motions:
    """Sigmoid forces along several motions, by one evaluation of the laws.

    Evaluating them separately would make a search a third slower. Terms that depend only on the
    shape parameters are cached, because fits of a window change only the scales.
    """

    def __init__(self, motions: Sequence[tuple[Motion, Array]]) -> None:
        """Motion and current (n,) [A] of each motion; constant ones are stored as one value."""
        self._velocities = [motion.velocity for motion, _ in motions]
        self._branches = [np.sign(motion.acceleration) for motion, _ in motions]
        speeds, currents = [], []
        for motion, current in motions:
            steady = np.ptp(motion.peak_velocity) == 0.0 and np.ptp(current) == 0.0
            chosen = slice(0, 1) if steady else slice(None)
            speeds.append(motion.peak_velocity[chosen])
            currents.append(current[chosen])
        edges = np.cumsum([0, *(speed.size for speed in speeds)]).tolist()
        self._places = [slice(*pair) for pair in pairwise(edges)]
        self._peak_velocity = np.concatenate([np.empty(0), *speeds])
        current = np.concatenate([np.empty(0), *currents])
        # If all values are equal, one of them suffices.
        self._current = current[:1] if np.all(current == current[:1]) else current
        self._kept: tuple[bytes, Array] | None = None

    def forces(self, parameters: Array) -> list[Array]:
        """Force [N] along each motion, shape (..., n), for parameters of shape (..., 16)."""
        return [force_from_coefficients(*motion) for motion in self._each(parameters)]

    def along(self, parameters: Array) -> list[ForceAndDamping]:
        """Force and equivalent damping along each motion, for parameters (16,)."""
        return [force_and_damping(*motion) for motion in self._each(parameters)]

    def jacobians(self, parameters: Array, columns: Sequence[int]) -> list[Array]:
        """Derivatives (c, n) of each motion's force with respect to the parameters at c places."""
        inner = self._inner(parameters, columns)
        return [
            _chain(coefficient_jacobian(*motion), inner, place, _FORCE_BY, columns)
            for motion, place in zip(self._each(parameters), self._places, strict=True)
        ]

    def jacobians_along(self, parameters: Array, columns: Sequence[int]) -> list[ForceAndDamping]:
        """Derivatives (n, c) of the results of :meth:`along`, by the parameters at c places."""
        inner = self._inner(parameters, columns)
        found = []
        for motion, place in zip(self._each(parameters), self._places, strict=True):
            force, damping = force_and_damping_jacobian(*motion)
            by_force = _chain(force, inner, place, _FORCE_BY, columns)
            by_damping = _chain(damping, inner, place, _DAMPING_BY, columns)
            found.append(ForceAndDamping(by_force.T, by_damping.T))
        return found

    def _each(self, parameters: Array) -> Iterator[tuple[Coefficients, Array, Array]]:
        """Coefficients for parameters (..., 16), velocity and branch of each motion."""
        if parameters.ndim > 1:
            together = operating_point_coefficients(parameters, self._peak_velocity, self._current)
        else:
            scales = parameters[SCALE_INDICES]
            scales[-1] *= parameters[_F0]
            with np.errstate(over="ignore"):
                together = Coefficients(*(scales[:, np.newaxis] * self._base(parameters)))
        for place, velocity, branch in zip(
            self._places, self._velocities, self._branches, strict=True
        ):
            yield Coefficients(*(c[..., place] for c in together)), velocity, branch

    def _base(self, parameters: Array) -> Array:
        """Coefficients (7, m) for scales of 1 and the shape of these parameters (16,)."""
        shape = parameters[_SHAPE_INDICES]
        if self._kept is None or self._kept[0] != shape.tobytes():
            unit = parameters.copy()
            unit[SCALE_INDICES] = 1.0
            base = operating_point_coefficients(unit, self._peak_velocity, self._current)
            self._kept = shape.tobytes(), np.stack(np.broadcast_arrays(*base))
        return self._kept[1]

    def _inner(self, parameters: Array, columns: Sequence[int]) -> _Inner:
        """Derivatives (m,) of the coefficients with respect to the parameters at ``columns``."""
        if not set(columns) <= _SCALED.keys():
            by = coefficient_parameter_jacobian(parameters, self._peak_velocity, self._current)
            return {(c, p): by[:, c, p] for c, p in _FORCE_BY if p in columns}
        base = self._base(parameters)
        inner = {(_SCALED[place], place): base[_SCALED[place]] for place in columns}
        if _F0 in columns:
            inner[_SCALED[_K5], _F0] = parameters[_K5] * base[-1]
        if _K5 in columns:
            inner[_SCALED[_K5], _K5] = parameters[_F0] * base[-1]
        return inner


_Inner = dict[tuple[int, int], Array]
"""Derivatives by the indices of coefficient and parameter."""


def _chain(
    outer: Array,
    inner: _Inner,
    place: slice,
    dependences: Sequence[tuple[int, int]],
    columns: Sequence[int],
) -> Array:
    """Derivatives (c, n) along one motion with respect to the parameters at c places.

    They follow by the chain rule from ``outer`` (n, 7), the derivatives by the coefficients, and
    ``inner``, the derivatives of the coefficients, of which ``place`` belongs to the motion.
    """
    rows = {parameter: row for row, parameter in enumerate(columns)}
    chosen = [(c, rows[p], inner[c, p][place]) for c, p in dependences if p in rows]
    if all(by.size == 1 for _, _, by in chosen):
        matrix = np.zeros((len(rows), outer.shape[1]))
        for coefficient, row, by in chosen:
            matrix[row, coefficient] = by[0]
        return matrix @ outer.T
    result = np.zeros((len(rows), outer.shape[0]))
    for coefficient, row, by in chosen:
        result[row] += outer[:, coefficient] * by
    return result


def _without_coil(parameters: Array) -> Array:
    return np.append(parameters[:-1], 0.0)


class LateForce:
    """Lagged sigmoid force along a history, for one set of parameters.

    The argument ``plain`` of a method returns the force of the sigmoid law, or its derivatives, at
    the samples of the window. It is called only if these lie between samples of the history.
    """

    def __init__(self, history: MotionHistory, past: ForceAndDamping, extension: Extension) -> None:
        """``past``: force and damping (m,) of the sigmoid law along the history."""
        self._history, self._past, self._extension = history, past, extension
        constant = extension.time_constant(past.damping)
        self._lag = FirstOrderLag(constant, history.period, periodic=history.periodic)
        self._late = self._lag(past.force)

    def force(self, displacement: Array, plain: Callable[[], Array]) -> Array:
        """Force [N] of the extended law at samples with this displacement (n,) [m]."""
        late = self._at_samples(self._past.force, self._late, plain)
        return np.asarray(late + self._extension.gas(displacement))

    def jacobian(self, by_sigmoid: ForceAndDamping, plain: Callable[[], Array]) -> Array:
        """Derivatives (n, p) of the force with respect to p parameters of the sigmoid law.

        ``by_sigmoid``: derivatives (m, p) of force and damping along the history.
        """
        by_constant = by_sigmoid.damping * self._by_damping[:, np.newaxis]
        late = self._lag.derivative(self._past.force, self._late, by_sigmoid.force, by_constant)
        return self._at_samples(by_sigmoid.force, late, plain)

    def by_compliance(self) -> Array:
        """Derivative (n,) of the force with respect to the compliance."""
        nothing = np.zeros((self._late.size, 1))
        damping = np.maximum(self._past.damping, 0.0)[:, np.newaxis]
        late = self._lag.derivative(self._past.force, self._late, nothing, damping)
        return self._history.at_samples(late)[:, 0]

    @property
    def _by_damping(self) -> Array:
        """Derivative (m,) of the time constant by the damping; negative damping gives no lag."""
        return np.where(self._past.damping > 0.0, self._extension.compliance, 0.0)

    def _at_samples(self, along: Array, late: Array, plain: Callable[[], Array]) -> Array:
        """Values at the samples of the window, from lagged values (m, ...) along the history."""
        if self._history.holds_samples:
            return self._history.at_samples(late)
        # Only the effect of the lag is interpolated, because it is smoother than the force.
        return np.asarray(plain() - self._history.at_samples(along - late))
