"""Extends laws for one current to all currents: each coefficient depends on the coil current.

A coefficient that cannot be negative is multiplied: c (1 + c_1 i + c_2 i²). If c decreases, the
coefficient decreases by the same fraction at every current. A coefficient of either sign is
shifted: c + c_1 i + c_2 i². The literature uses linear or quadratic dependence (Spencer, Dyke, Sain
and Carlson, 1997; Kwok, Ha, Nguyen, Li and Samali, 2006). A cubic term describes a force that
saturates. If a parameter file contains only the coefficients at one current, they do not depend on
the current.

The current means the coil current, see :mod:`first_order_lag`.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.motion import Motion, MotionSample
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.first_order_lag import (
    COIL,
    PLAUSIBLE_COIL,
    coil_current,
    coil_parameter,
    solve_recursion,
)
from mr_damper_ros.models.force_model import CurrentResponse, Model, WindowForces
from mr_damper_ros.models.machine_code import as_machine_code
from mr_damper_ros.models.quantities import (
    DIFFERENCE,
    ROWS_AT_ONCE,
    CoefficientTable,
    LawSearch,
    LoopReading,
    Parameter,
    State,
)
from mr_damper_ros.signals.arrays import Array

LARGEST_GROWTH = 100.0
"""Largest plausible ratio of a coefficient's values, or of the forces, over the current range."""


class CurrentDependentModel(Model):
    """A law with coefficients at one current, and the current dependence of these coefficients."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Derive the parameters from the coefficients."""
        super().__init_subclass__(**options)
        plain = tuple(Parameter(c.name, c.unit, c.low, c.high) for c in cls.at_one_current)
        groups = tuple(c.dependence for c in cls.at_one_current)
        every = tuple(parameter for group in groups for parameter in group)
        cls.parameters = (*plain, *every, coil_parameter())
        cls.free_in_one_run = tuple(c.name for c in cls.at_one_current)
        cls.linear = tuple(parameter.name for parameter in (*plain, *every))
        cls.shape_groups = tuple(tuple(p.name for p in group) for group in groups if group)
        cls.strength = tuple(
            name
            for c, group in zip(cls.at_one_current, groups, strict=True)
            if c.unit.startswith("N")
            for name in (c.name, *(() if c.grows else (p.name for p in group)))
        )
        indices = {parameter.name: place for place, parameter in enumerate(cls.parameters)}
        cls._orders = tuple(tuple(indices[p.name] for p in group) for group in groups)

    _orders: ClassVar[tuple[tuple[int, ...], ...]]
    """Indices of the parameters of each coefficient's current dependence, linear term first."""

    @abstractmethod
    def force_at(
        self, coefficients: Sequence[Array], motion: Motion, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force (..., n) [N] and the state after it; each coefficient has shape (..., 1 or n)."""

    @abstractmethod
    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """Start values (k, c) of the coefficients, derived from a loop reading."""

    def starts(self, reading: LoopReading) -> Array:
        """The start values at one current, without current dependence."""
        plain = self.starts_at_one_current(reading)
        return np.hstack([plain, np.zeros((len(plain), len(self.parameters) - plain.shape[1]))])

    @np.errstate(over="ignore", invalid="ignore")
    def follow_in_coil(
        self, parameters: Array, motion: Motion, current: Array, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N] of the coefficients at the current of the coil."""
        return self.force_at(self.all_at(parameters, current), motion, period, state)

    def current_response(self, parameters: Array) -> CurrentResponse:
        """Force over the current; the coefficients are computed at all currents at once."""
        return _CurrentResponse(self, parameters)

    def numbers_at(self, values: Sequence[float], current: float) -> list[float]:
        """The coefficients of a set (p,) at one current [A], in floating-point scalars."""
        found = []
        for coefficient, value, columns in zip(
            self.at_one_current, values, self._orders, strict=False
        ):
            change = 0.0
            for column in columns[::-1]:
                change = (change + values[column]) * current
            low = coefficient.low
            value = value * (1.0 + change) if low >= 0.0 else value + change
            found.append(low if value < low else min(value, coefficient.high))
        return found

    def all_at(self, parameters: Array, current: Array) -> list[Array]:
        """The coefficients, each (..., n or 1), at currents (n,) or (..., n)."""
        if np.all(current == current[..., :1]):
            current = current[..., :1]
        if parameters.ndim == 1 and current.size == 1:  # scalar code for a frequent case
            found = self.numbers_at(parameters.tolist(), float(current.item()))
            return [np.full(current.shape, value) for value in found]
        return [self._at(parameters, place, current) for place in range(len(self.at_one_current))]

    def _at(self, parameters: Array, place: int, current: Array) -> Array:
        """One coefficient (..., n) at currents (..., n)."""
        coefficient = self.at_one_current[place]
        change: Array | float = 0.0
        for order, column in enumerate(self._orders[place], start=1):
            change = change + parameters[..., column, np.newaxis] * current**order
        value = parameters[..., place, np.newaxis]
        value = value * (1.0 + change) if coefficient.grows else value + change
        return np.clip(value, coefficient.low, coefficient.high)

    def dependences(
        self, parameters: Array, current: Array, by_coil: Array
    ) -> list[dict[int, Array]]:
        """Derivatives (n or 1,) of each coefficient at currents (n,) [A], by index of parameter.

        ``by_coil`` (n,): derivative of the current with respect to the coil's time constant [A/s].
        The derivative of a coefficient at its bound is zero.
        """
        found = []
        for place, coefficient in enumerate(self.at_one_current):
            value, columns = float(parameters[place]), self._orders[place]
            size = value if coefficient.grows else 1.0
            growth, slope, by = np.ones(1), np.zeros(1), {}
            for order, column in enumerate(columns, start=1):
                by[column] = size * current**order
                growth = growth + parameters[column] * current**order
                slope = slope + size * parameters[column] * order * current ** (order - 1)
            by[place] = growth if coefficient.grows else np.ones(1)
            if columns:
                by[parameters.size - 1] = slope * by_coil
            at = value * growth if coefficient.grows else value + growth - 1.0
            outside = (at < coefficient.low) | (at > coefficient.high)
            if np.any(outside):
                by = {column: np.where(outside, 0.0, values) for column, values in by.items()}
            found.append(by)
        return found

    def coefficients_at(
        self, parameters: Array, peak_velocity: ArrayLike, current: ArrayLike
    ) -> Array:
        """The coefficients (c, n) at n currents [A]; they do not depend on the peak velocity."""
        amperes = np.broadcast_arrays(
            np.atleast_1d(np.asarray(current, dtype=float)), np.atleast_1d(peak_velocity)
        )[0]
        values = self.all_at(parameters, amperes)
        return np.stack([np.broadcast_to(value, amperes.shape) for value in values])

    def coefficient_gradient(
        self, parameters: Array, peak_velocity: float, current: float
    ) -> Array:
        """Derivatives (c, p) of the coefficients at one current with respect to the parameters."""
        result = np.zeros((len(self.at_one_current), parameters.size))
        chain = self.dependences(parameters, np.array([current]), np.zeros(1))
        for row, by in zip(result, chain, strict=True):
            row[list(by)] = [value.item() for value in by.values()]
        return result

    def plausible_ranges(
        self, windows: Sequence[Window], top_velocity: float, top_current: float
    ) -> dict[str, tuple[float, float]]:
        """Plausible ranges of the current dependences and of the coil's time constant."""
        readings = [LoopReading.of(window) for window in windows]
        ranges = {COIL: (0.0, PLAUSIBLE_COIL)}
        for coefficient in self.at_one_current:
            size = LARGEST_GROWTH
            if not coefficient.grows:
                size *= max(reading.size(coefficient.unit) for reading in readings)
            for order, parameter in enumerate(coefficient.dependence, start=1):
                reach = size / max(top_current, 1e-12) ** order
                ranges[parameter.name] = (-reach, reach)
        return ranges

    def fit_laws(
        self, table: CoefficientTable, start: Array, free: frozenset[str], search: LawSearch
    ) -> Array:
        """Weighted linear least squares over the current for each coefficient."""
        values = np.array(start, dtype=float)
        for place, coefficient in enumerate(self.at_one_current):
            if coefficient.name not in free:
                continue
            weights = table.weights(place)
            target = table.coefficients[:, place]
            fixed = np.ones(table.current.size)
            columns, powers = [], []
            for order, column in enumerate(self._orders[place], start=1):
                power = table.current**order
                if self.parameters[column].name in free:
                    columns.append(column)
                    powers.append(power)
                elif coefficient.grows:
                    fixed = fixed + values[column] * power
                else:
                    target = target - values[column] * power
            basis = np.stack([fixed, *powers], axis=-1) * weights[:, np.newaxis]
            found = np.linalg.lstsq(basis, weights * target, rcond=None)[0]
            if coefficient.grows:
                # A coefficient that is zero at 0 A could not grow with the current.
                mean = float(np.mean(np.abs(target)))
                least = max(coefficient.low, mean / LARGEST_GROWTH, 1e-12)
                found[0] = max(found[0], least)
                found[1:] /= found[0]
            values[place], values[columns] = found[0], found[1:]
        return np.clip(values, *self.bounds)

    def draw_shape(
        self, rng: np.random.Generator, top_velocity: float, top_current: float
    ) -> dict[str, float]:
        """Current dependences that are monotonic in the range, with a small ratio of end values."""
        drawn = {}
        for coefficient in self.at_one_current:
            if not coefficient.grows:
                continue
            growth = float(np.exp(rng.uniform(0.0, 2.5))) - 1.0
            for order, parameter in enumerate(coefficient.dependence, start=1):
                bend = 1.0 if order == 1 else -rng.uniform(0.0, 0.5) if order == 2 else 0.0
                drawn[parameter.name] = growth * bend / max(top_current, 1e-12) ** order
        return drawn


@dataclass(frozen=True, eq=False)
class _CurrentResponse(CurrentResponse):
    model: CurrentDependentModel
    parameters: Array

    def forces(
        self, samples: Sequence[MotionSample], current: Array, period: float, state: State | None
    ) -> Array:
        """Force (n, m) [N]; the currents are treated like different parameter sets."""
        every = np.broadcast_to(current, (len(samples), current.shape[-1])).T
        if self.model.remembers and len(samples) > 1:
            pairs = zip(samples, every.T, strict=True)
            return np.concatenate([self.forces([one], row, period, state) for one, row in pairs])
        own = None if state is None else state[: self.model.memory]
        before = None if own is None else tuple(np.broadcast_to(s, len(every)) for s in own)
        u, v, a, v_m = np.array(samples).T
        motion = Motion(u, v, a, v_m, sine=None)
        coefficients = self.model.all_at(self.parameters, every)
        forces = self.model.force_at(coefficients, motion, period, before)[0]
        return np.broadcast_to(forces, every.shape).T


class Recursion(NamedTuple):
    """Sensitivity of m states: x[k] = kept[k] x[k-1] + the sum of ``by`` times the coefficients.

    ``force_by``: derivative (n,) [N] of the force by each state; ``kept``: derivatives (n,) of each
    state (rows) by the previous states (columns); ``by``: derivatives (n,) of each state by the
    coefficients, by their index.
    """

    force_by: Sequence[Array]
    kept: Sequence[Sequence[Array]]
    by: Sequence[Mapping[int, Array]]


class IntegratedModel(CurrentDependentModel):
    """A law whose state is integrated sample by sample, with exact derivatives of its force.

    Differences would multiply the computation time by the number of parameters.
    """

    remembers = True

    @abstractmethod
    def integrate(
        self, coefficients: list[Array], motion: Motion, period: float, memory: list[float]
    ) -> Array:
        """The integrated quantity (n,) of one set with coefficients (1 or n,).

        ``memory`` is the state before the first sample, NaN at a start; it becomes the state after
        the last one.
        """

    @abstractmethod
    def force_from(self, coefficients: Sequence[Array], motion: Motion, integrated: Array) -> Array:
        """Force (..., n) [N] from the integrated quantity (..., n)."""

    def force_at(
        self, coefficients: Sequence[Array], motion: Motion, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N], set by set; array code is faster for more than thirty sets."""
        if all(c.ndim == 1 for c in coefficients):  # one set, which streams ask for often
            memory = [math.nan] * self.memory if state is None else [float(s) for s in state]
            found = self.integrate(list(coefficients), motion, period, memory)
            return self.force_from(coefficients, motion, found), tuple(map(np.array, memory))
        shape = np.broadcast_shapes(*(c.shape[:-1] for c in coefficients))
        every = [np.broadcast_to(c, (*shape, c.shape[-1])) for c in coefficients]
        result = np.empty((*shape, motion.velocity.size))
        kept = np.full((self.memory, *shape), math.nan) if state is None else np.array(state)
        for place in np.ndindex(shape):
            memory = kept[(slice(None), *place)].tolist()
            result[place] = self.integrate([c[place] for c in every], motion, period, memory)
            kept[(slice(None), *place)] = memory
        return self.force_from(coefficients, motion, result), tuple(kept)

    @abstractmethod
    def sensitivities(
        self, coefficients: list[Array], motion: Motion, period: float
    ) -> tuple[Mapping[int, Array], list[Recursion]]:
        """Derivatives (n,) of the force by coefficients (n,) at constant state, and of the states.

        The state starts settled. The coefficients are given by their indices.
        """

    @as_machine_code()
    @np.errstate(over="ignore", invalid="ignore")
    def window_derivatives(
        self, window: Window, parameters: Array, columns: Sequence[int]
    ) -> Array:
        """Derivatives (n, p) of :meth:`window_force` with respect to parameters ``columns``."""
        history = window.history.coarse
        motion, current, count = history.motion, history.current, history.current.size
        if history.periodic:  # the second period of a steady cycle counts
            twice = np.concatenate((np.arange(count), np.arange(count)))
            motion, current = motion.part(twice), current[twice]
        tau, late = float(parameters[-1]), current
        if float(np.ptp(current)) > 0.0:
            constants = np.array([tau, tau + DIFFERENCE])
            late, later = coil_current(current, constants, history.period, ())[0]
            chain = self.dependences(parameters, late, (later - late) / DIFFERENCE)
        else:
            chain = self.dependences(parameters, current[:1], np.zeros(1))
        values = [np.broadcast_to(c, current.shape) for c in self.all_at(parameters, late)]
        direct, recursions = self.sensitivities(values, motion, history.period)
        # Columns are contiguous in memory. All steps at once would leave the processor's cache.
        result = np.empty((len(columns), current.size)).T
        states = [np.zeros((len(recursion.by), len(columns))) for recursion in recursions]
        for begin in range(0, current.size, ROWS_AT_ONCE):
            part = slice(begin, begin + ROWS_AT_ONCE)
            rows = result[part]
            rows[...] = _excitation([direct], chain, columns, part)
            for recursion, state in zip(recursions, states, strict=True):
                kept = np.array([[values[part] for values in row] for row in recursion.kept])
                added = _excitation(recursion.by, chain, columns, part)
                added[: len(state)] += kept[..., 0] @ state
                found = solve_recursion(kept, added)
                state[...] = found[-len(state) :]
                for place, force_by in enumerate(recursion.force_by):
                    rows += force_by[part, np.newaxis] * found[place :: len(state)]
        return history.at_samples(result[-count:])

    def window_forces(self, windows: Sequence[Window]) -> WindowForces:
        """Forces with exact derivatives."""
        return WindowForces(self, windows, self.window_derivatives)


def _excitation(
    by: Sequence[Mapping[int, Array]],
    chain: Sequence[Mapping[int, Array]],
    columns: Sequence[int],
    part: slice,
) -> Array:
    """Derivatives (n m, p) of m interleaved states by the parameters at p ``columns``.

    ``by``: those by the coefficients, of which the ``part`` with n steps counts; ``chain``: those
    of the coefficients.
    """
    rows = {column: row for row, column in enumerate(columns)}
    count = next(iter(by[0].values()))[part].size
    result = np.zeros((len(rows), len(by) * count))
    for state, derivatives in enumerate(by):
        for place, values in derivatives.items():
            for column, effect in chain[place].items():
                if column in rows:
                    many = effect[part] if effect.size > 1 else effect
                    result[rows[column], state :: len(by)] += values[part] * many
    return result.T
