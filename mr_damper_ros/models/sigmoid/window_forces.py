"""Forces of the sigmoid law and its extension at the samples of windows, with exact derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, cached_property
from typing import Any

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.first_order_lag import FirstOrderLag, in_coil
from mr_damper_ros.models.force_model import Model, WindowForces
from mr_damper_ros.models.formulas import staged
from mr_damper_ros.models.quantities import DIFFERENCE
from mr_damper_ros.models.sigmoid.following import (
    EXTENDED_NAMES,
    SIGMOID_COUNT,
    extension_of,
    is_extended,
)
from mr_damper_ros.models.sigmoid.law import (
    LAW,
    PARAMETER_NAMES,
    SCALE_INDICES,
    SCALE_PARAMETER_NAMES,
    as_columns,
    gradients,
    quiet,
)
from mr_damper_ros.signals.arrays import Array

_SHAPE_INDICES = np.setdiff1d(np.arange(SIGMOID_COUNT), SCALE_INDICES)
_STAGES = (
    [PARAMETER_NAMES[place] for place in _SHAPE_INDICES],
    ("v_m", "i"),
    SCALE_PARAMETER_NAMES,
    ("v", "branch"),
)
_COMPLIANCE, _STIFFNESS, _OFFSET, _COIL = range(SIGMOID_COUNT, len(EXTENDED_NAMES))


@cache
def _compiled(
    results: tuple[str, ...], columns: tuple[int, ...] | None, scalars: int
) -> Callable[..., Any]:
    """The results of the law, or their derivatives by the parameters at these columns."""
    if columns is None:
        return staged(LAW, _STAGES, results, scalars)
    names = [PARAMETER_NAMES[place] for place in columns]
    wanted = [f"{result}_by_{name}" for result in results for name in names]
    return staged((*LAW, *gradients(results, names)), _STAGES, wanted, scalars)


class _Along:
    """The sigmoid law along a motion with a current (n,) [A].

    Terms of the shape parameters are kept, because fits of a window change only the scales.
    """

    def __init__(self, motion: Motion, current: Array) -> None:
        self._steady = bool(np.ptp(motion.peak_velocity) == 0.0 and np.ptp(current) == 0.0)
        self._point = motion.peak_velocity, current
        self._moving = motion.velocity, np.sign(motion.acceleration)
        self._kept: dict[Callable[..., Any], tuple[bytes, Callable[..., Any]]] = {}

    def values(self, parameters: Array, *results: str) -> list[Array]:
        """The results, each (..., n), for parameters (..., 16 or more)."""
        found = self._evaluated(results, None, parameters)
        return list(found) if len(results) > 1 else [found]

    def derivatives(self, parameters: Array, columns: Sequence[int], *results: str) -> Array:
        """Derivatives (results, c, n) of the results by the parameters at c places."""
        block = np.zeros((len(results), len(columns), self._moving[0].size))
        if columns:
            found = self._evaluated(results, tuple(columns), parameters)
            rows = block.reshape(-1, block.shape[-1])
            for row, derivative in zip(rows, found if len(rows) > 1 else [found], strict=True):
                row[:] = derivative
        return block

    @quiet
    def _evaluated(
        self, results: tuple[str, ...], columns: tuple[int, ...] | None, parameters: Array
    ) -> Any:
        single = parameters.ndim == 1
        # A steady motion of one set needs scalar code only, up to the velocity.
        steady = self._steady and single
        law = _compiled(results, columns, 3 if steady else 1 if single else 0)
        shape = parameters[..., _SHAPE_INDICES]
        key, at_point = self._kept.get(law, (b"", None))
        if at_point is None or key != shape.tobytes():
            point = [float(each[0]) for each in self._point] if steady else self._point
            at_point = law(*as_columns(shape))(*point)
            self._kept[law] = shape.tobytes(), at_point
        return at_point(*as_columns(parameters[..., SCALE_INDICES]))(*self._moving)


class _LaggedForces:
    """Lagged force at the samples of a window, for parameters of the extended law."""

    def __init__(self, window: Window, own: _Along) -> None:
        self._window, self._own, self._history = window, own, window.history
        self._along = _Along(self._history.motion, self._history.current)
        self._latest: tuple[bytes, FirstOrderLag, Array, Array, Array] | None = None

    def force(self, parameters: Array) -> Array:
        """Force (n,) [N] for parameters (20,)."""
        _, plain, late, _ = self._lagged(parameters)
        force = self._at_samples(plain, late, lambda: self._own.values(parameters, "force")[0])
        extension = extension_of(parameters)
        return np.asarray(force + extension.gas(self._window.motion.displacement))

    def derivatives(self, parameters: Array, columns: Sequence[int]) -> Array:
        """Derivatives (c, n) for a coil without lag; the row of its time constant is zero."""
        lag, plain, late, damping = self._lagged(parameters)
        block = np.zeros((len(columns), self._window.sample_count))
        rows = {place: row for row, place in enumerate(columns)}
        inner = [place for place in columns if place < SIGMOID_COUNT]
        if inner:
            of_force, of_damping = self._along.derivatives(parameters, inner, "force", "damping")
            # Negative damping gives no lag.
            of_constant = of_damping * np.where(damping > 0.0, parameters[_COMPLIANCE], 0.0)
            of_late = lag.derivative(plain, late, of_force.T, of_constant.T)
            block[[rows[place] for place in inner]] = self._at_samples(
                of_force.T, of_late, lambda: self._own.derivatives(parameters, inner, "force")[0].T
            ).T
        if _COMPLIANCE in rows:
            by_constant = np.maximum(damping, 0.0)[:, np.newaxis]
            of_late = lag.derivative(plain, late, np.zeros_like(by_constant), by_constant)
            block[rows[_COMPLIANCE]] = self._history.at_samples(of_late)[:, 0]
        if _STIFFNESS in rows:
            block[rows[_STIFFNESS]] = self._window.motion.displacement
        if _OFFSET in rows:
            block[rows[_OFFSET]] = 1.0
        return block

    def _lagged(self, parameters: Array) -> tuple[FirstOrderLag, Array, Array, Array]:
        """The lag, and plain force, lagged force and damping along the history."""
        # Cached, because a search asks for the derivatives right after the force.
        if self._latest is None or self._latest[0] != parameters.tobytes():
            plain, damping = self._along.values(parameters, "force", "damping")
            constant = extension_of(parameters).time_constant(damping)
            history = self._history
            lag = FirstOrderLag(constant, history.period, periodic=history.periodic)
            self._latest = parameters.tobytes(), lag, plain, lag(plain), damping
        return self._latest[1:]

    def _at_samples(self, along: Array, late: Array, own: Callable[[], Array]) -> Array:
        """Lagged values at the samples, from the values (m, ...) along the history."""
        if self._history.holds_samples:
            return self._history.at_samples(late)
        # Only the effect of the lag is interpolated, because it is smoother than the force.
        return np.asarray(own() - self._history.at_samples(along - late))


class SigmoidForces(WindowForces):
    """Window forces for parameters of shape (16,) or (20,)."""

    def __init__(self, model: Model, windows: Sequence[Window]) -> None:
        super().__init__(model, windows)
        self._own = [_Along(window.motion, window.current) for window in windows]
        self._in_coil: tuple[float, SigmoidForces] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        # Kept terms hold compiled functions, which cannot be sent to another process.
        return type(self), (self.model, self.windows)

    def forces(self, parameters: Array) -> list[Array]:
        """Force (..., n) [N] of each window, for parameters (..., p)."""
        if not is_extended(parameters):
            return [own.values(parameters, "force")[0] for own in self._own]
        if parameters.ndim > 1:
            each = [self.forces(values) for values in parameters]
            return [np.stack(forces) for forces in zip(*each, strict=True)]
        return [late.force(parameters) for late in self._with_coil(parameters)._late]

    def derivatives(self, parameters: Array, columns: Sequence[int]) -> list[Array]:
        """Derivatives (n, c) of the force of each window, for parameters (p,), at c places."""
        if not is_extended(parameters):
            return [own.derivatives(parameters, columns, "force")[0].T for own in self._own]
        lates = self._with_coil(parameters)._late
        found = [late.derivatives(parameters, columns).T for late in lates]
        if _COIL in columns and self._current_changes:
            place = list(columns).index(_COIL)
            changed = parameters + np.eye(parameters.size)[_COIL] * DIFFERENCE
            pairs = zip(found, self.forces(changed), self.forces(parameters), strict=True)
            for derivatives, later, force in pairs:
                derivatives[:, place] = (later - force) / DIFFERENCE
        return found

    @cached_property
    def _late(self) -> list[_LaggedForces]:
        return [_LaggedForces(*pair) for pair in zip(self.windows, self._own, strict=True)]

    @cached_property
    def _current_changes(self) -> bool:
        return not all(window.has_constant_current for window in self.windows)

    def _with_coil(self, parameters: Array) -> SigmoidForces:
        """The forces with the coil current in place of the supply current."""
        coil = float(parameters[_COIL])
        if not (coil > 0.0 and self._current_changes):
            return self
        if self._in_coil is None or self._in_coil[0] != coil:
            windows = [in_coil(window, coil) for window in self.windows]
            self._in_coil = coil, SigmoidForces(self.model, windows)
        return self._in_coil[1]
