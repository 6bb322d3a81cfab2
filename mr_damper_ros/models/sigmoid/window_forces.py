"""Forces of the sigmoid law and its extension at the samples of windows, with exact derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.first_order_lag import FirstOrderLag, coil_shows, in_coil
from mr_damper_ros.models.force_model import AT_ONCE, Model, WindowForces
from mr_damper_ros.models.formulas import staged
from mr_damper_ros.models.quantities import DIFFERENCE
from mr_damper_ros.models.sigmoid.following import (
    EXTENDED_NAMES,
    SIGMOID_COUNT,
    gas_force,
    time_constant,
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
def _compiled(results: tuple[str, ...], scalars: int) -> Callable[..., Any]:
    """Compiled results of the law; ``force_by_k4`` is the derivative of the force by k4."""
    by: dict[str, list[str]] = {}
    for result, _, name in (each.partition("_by_") for each in results):
        if name:
            by.setdefault(result, []).append(name)
    derivatives = [line for result, names in by.items() for line in gradients([result], names)]
    return staged((*LAW, *derivatives), _STAGES, results, scalars)


class _Along:
    """The sigmoid law along a motion with a current (n,) [A].

    Terms of the shape parameters are kept, because fits of a window change only the scales.
    """

    def __init__(self, motion: Motion, current: Array) -> None:
        self._motion, self._current = motion, current
        self._steady = bool(np.ptp(motion.peak_velocity) == 0.0 and np.ptp(current) == 0.0)
        self._point = motion.peak_velocity, current
        self._moving = motion.velocity, np.sign(motion.acceleration)
        self._kept: dict[Callable[..., Any], tuple[bytes, Callable[..., Any]]] = {}

    @quiet
    def values(self, parameters: Array, *results: str) -> list[Array]:
        """The results, each (..., n), for parameters (..., 16 or more)."""
        size = self._moving[0].size
        if size > AT_ONCE:
            whole = [np.empty((*parameters.shape[:-1], size)) for _ in results]
            for part in (slice(k, k + AT_ONCE) for k in range(0, size, AT_ONCE)):
                along = _Along(self._motion.part(part), self._current[part])
                for row, values in zip(whole, along.values(parameters, *results), strict=True):
                    row[..., part] = values
            return whole
        single = parameters.ndim == 1
        # A steady motion of one set needs scalar code only, up to the velocity.
        steady = self._steady and single
        law = _compiled(results, 3 if steady else 1 if single else 0)
        shape = parameters[..., _SHAPE_INDICES]
        key, at_point = self._kept.get(law, (b"", None))
        if at_point is None or key != shape.tobytes():
            point = [float(each[0]) for each in self._point] if steady else self._point
            at_point = law(*as_columns(shape))(*point)
            self._kept[law] = shape.tobytes(), at_point
        found = at_point(*as_columns(parameters[..., SCALE_INDICES]))(*self._moving)
        return list(found) if len(results) > 1 else [found]

    def derivatives(self, parameters: Array, columns: Sequence[int], *results: str) -> Array:
        """Derivatives (results, c, n) of the results by the parameters at c places."""
        names = [f"{result}_by_{PARAMETER_NAMES[c]}" for result in results for c in columns]
        block = np.zeros((len(names), self._moving[0].size))
        if names:
            for row, derivative in zip(block, self.values(parameters, *names), strict=True):
                row[:] = derivative
        return block.reshape(len(results), len(columns), -1)


class _LaggedForces:
    """Lagged force at the samples of a window with the current of the coil."""

    def __init__(self, window: Window) -> None:
        self._window, self._history = window, window.history
        self._own = _Along(window.motion, window.current)
        self._along = _Along(self._history.motion, self._history.current)
        self._latest: tuple[bytes, FirstOrderLag, Array, Array, Array] | None = None

    def force(self, parameters: Array) -> Array:
        """Force (n,) [N] for parameters (20,)."""
        _, plain, late, _ = self._lagged(parameters)
        force = self._at_samples(plain, late, lambda: self._own.values(parameters, "force")[0])
        return np.asarray(force + gas_force(parameters, self._window.motion.displacement))

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
            constant, history = time_constant(parameters, damping), self._history
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
        self._plain = [_Along(window.motion, window.current) for window in windows]
        # Lagged forces of each window, with the time constant of the coil for which they hold.
        self._kept: list[tuple[float, _LaggedForces] | None] = [None] * len(windows)

    def __reduce__(self) -> tuple[Any, ...]:
        # Kept terms hold compiled functions, which cannot be sent to another process.
        return type(self), (self.model, self.windows)

    def forces(self, parameters: Array) -> list[Array]:
        """Force (..., n) [N] of each window, for parameters (..., p)."""
        if parameters.shape[-1] == SIGMOID_COUNT:
            return [plain.values(parameters, "force")[0] for plain in self._plain]
        if parameters.ndim > 1:
            each = [self.forces(values) for values in parameters]
            return [np.stack(forces) for forces in zip(*each, strict=True)]
        return [late.force(parameters) for late in self._late(parameters)]

    def derivatives(self, parameters: Array, columns: Sequence[int]) -> list[Array]:
        """Derivatives (n, c) of the force of each window, for parameters (p,), at c places."""
        if parameters.size == SIGMOID_COUNT:
            return [plain.derivatives(parameters, columns, "force")[0].T for plain in self._plain]
        lates = self._late(parameters)
        found = [late.derivatives(parameters, columns).T for late in lates]
        later = float(parameters[_COIL]) + DIFFERENCE
        for window, late, derivatives in zip(self.windows, lates, found, strict=True):
            if _COIL in columns and coil_shows(window, later):
                change = _LaggedForces(in_coil(window, later)).force(parameters)
                change -= late.force(parameters)
                derivatives[:, list(columns).index(_COIL)] = change / DIFFERENCE
        return found

    def _late(self, parameters: Array) -> list[_LaggedForces]:
        """The lagged forces of the windows at the current of the coil."""
        lates = []
        for place, window in enumerate(self.windows):
            coil = float(parameters[_COIL])
            coil = coil if coil_shows(window, coil) else 0.0
            kept = self._kept[place]
            if kept is None or kept[0] != coil:
                self._kept[place] = kept = coil, _LaggedForces(in_coil(window, coil))
            lates.append(kept[1])
        return lates
