"""How the operating-point coefficients change with peak velocity and current: six decoupled laws.

The sixteen parameters fall into groups that share no unknown:

    f_t = f0 (1 + e^(a1 v)) (1 + k2 S(i; a2, I0))     f0 a1 k2 a2 I0
    alpha = a0 / (1 + k0 v)                           a0 k0
    k_c, k_e = (k1c, k1e) e^(-a4 v)                   k1c k1e a4
    v_h = k4 v (1 + k3 S(i; a3, I1))                  k4 k3 a3 I1
    v_d = k6 v                                        k6
    f_d = k5 f_t                                      k5

with S(i; a, I) = sigma(a (i + I)) - sigma(a I). In each group the scales (and k2, k3) enter
linearly and are solved for; differential evolution searches the rest, at most three unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from mr_damper_ros.models.formulas import gradient, staged
from mr_damper_ros.models.quantities import CoefficientTable, LawSearch
from mr_damper_ros.models.sigmoid.law import (
    COEFFICIENT_NAMES,
    COEFFICIENTS,
    PARAMETER_NAMES,
    SCALE_PARAMETER_NAMES,
)
from mr_damper_ros.signals.arrays import Array

_EXPONENT_SPAN = 8.0
"""Growth or decay over the range of peak velocity is searched up to e^8, 1 to 3000."""


Values = Mapping[str, Array | float]


class _Law(NamedTuple):
    """One group of parameters: which coefficients they make, and how.

    Each coefficient is scale (constant + gain step): ``constant`` and ``step`` are the derivatives
    of the first by its scale at no gain, and by the gain at a scale of 1. ``gain`` is k2, k3 or
    empty.
    """

    stage: str
    scales: tuple[tuple[int, str], ...]
    gain: str
    unknowns: tuple[str, ...]
    constant: Callable[..., Array]
    step: Callable[..., Array] | None

    @classmethod
    def of(
        cls, stage: str, coefficients: Sequence[str], gain: str, unknowns: tuple[str, ...]
    ) -> _Law:
        """That of these coefficients."""
        places = [COEFFICIENT_NAMES.index(name) for name in coefficients]
        scales = tuple((place, SCALE_PARAMETER_NAMES[place]) for place in places)
        by = (scales[0][1], *([gain] if gain else []))
        lines = gradient(COEFFICIENTS, coefficients[0], by)
        parts = [
            staged(lines, _INPUTS, [f"{coefficients[0]}_by_{name}"], arrays=True) for name in by
        ]
        return cls(stage, scales, gain, unknowns, parts[0], parts[1] if gain else None)

    def basis(self, v: Array, i: Array, values: Values) -> tuple[Array, Array]:
        """The two parts, for unknowns of shape (s, 1) and operating points of shape (k,)."""
        unit = {**values, **{name: 1.0 for _, name in self.scales}}
        step = 0.0 if self.step is None else self.step(*_in_order(unit), v, i)
        if self.gain:
            unit[self.gain] = 0.0
        constant, step = np.broadcast_arrays(self.constant(*_in_order(unit), v, i), step)
        return np.atleast_2d(constant), np.atleast_2d(step)


_INPUTS = [(*PARAMETER_NAMES, "v_m", "i")]


def _in_order(values: Values) -> list[Array | float]:
    return [values[name] for name in PARAMETER_NAMES]


def fit_laws(
    table: CoefficientTable,
    start: Array,
    free: frozenset[str],
    search: LawSearch,
) -> Array:
    """Parameters (16,) whose laws come nearest to the table.

    Parameters not in ``free`` keep the value they have in ``start`` (16,); ``search`` finds what is
    not linear.
    """
    values = dict(zip(PARAMETER_NAMES, np.asarray(start, dtype=float).tolist(), strict=True))
    bounds = shape_bounds(float(table.peak_velocity.max()), float(np.abs(table.current).max()))
    for law in _LAWS:
        names = [name for name in law.unknowns if name in free]
        problem = _LawProblem(law, table, values, free)
        if names:
            best = search(
                partial(problem.misfit, names),
                [bounds[name] for name in names],
                np.array([values[name] for name in names]),
                law.stage,
            )
            values.update(zip(names, best.tolist(), strict=True))
        values.update(problem.solve({name: np.array([[values[name]]]) for name in names})[1])
    if "k5" in free:
        weights = table.weights(6)
        yield_force, offset = (weights * table.coefficients[:, place] for place in (0, 6))
        values["k5"] = float(_least_squares(yield_force[np.newaxis, np.newaxis], offset)[0, 0])
    return np.array([values[name] for name in PARAMETER_NAMES])


def searched_laws(free: frozenset[str]) -> int:
    """How many of the laws need a search for these free parameters."""
    return sum(any(name in free for name in law.unknowns) for law in _LAWS)


def shape_bounds(top_velocity: float, top_current: float) -> dict[str, tuple[float, float]]:
    """Search bounds of the shape parameters that enter nonlinearly.

    They follow from what the data span (peak velocity [m/s], current [A]), so that they suit any
    damper. The slopes a2, a3 are positive: the mirror image is the same law with k2, k3 negative.
    """
    v, i = max(top_velocity, 1e-12), max(top_current, 1e-12)
    exponent = (-_EXPONENT_SPAN / v, _EXPONENT_SPAN / v)
    slope, shift = (0.2 / i, 30.0 / i), (-1.5 * i, 1.5 * i)
    return {
        **dict.fromkeys(("a1", "a4"), exponent),
        **dict.fromkeys(("a2", "a3"), slope),
        **dict.fromkeys(("I0", "I1"), shift),
        "k0": (-0.9 / v, 1e3 / v),
    }


class _LawProblem:
    """Weighted misfit of one law to the table, its linear unknowns solved for."""

    def __init__(
        self, law: _Law, table: CoefficientTable, values: Values, free: frozenset[str]
    ) -> None:
        self._law = law
        self._table = table
        self._values = values
        self._free = free
        self._weights = {column: table.weights(column) for column, _ in law.scales}

    def misfit(self, names: list[str], individuals: Array) -> Array:
        """Misfit (s,) of individuals of shape (len(names), s)."""
        return self.solve(dict(zip(names, individuals[:, :, np.newaxis], strict=True)))[0]

    def solve(self, trial: Values) -> tuple[Array, dict[str, float]]:
        """Misfit (s,) for trial unknowns of shape (s, 1), and the scales of the last trial."""
        values = {**self._values, **trial}
        constant, step = self._law.basis(self._table.peak_velocity, self._table.current, values)
        gain_is_free = self._law.gain in self._free
        if self._law.gain and not gain_is_free:
            constant = constant + self._values[self._law.gain] * step
        misfit = np.zeros(constant.shape[0])
        found: dict[str, float] = {}
        for column, name in self._law.scales:
            weights = self._weights[column]
            target = weights * self._table.coefficients[:, column]
            parts = [constant, step] if gain_is_free else [constant]
            basis = weights * np.stack(parts, axis=1)
            if name in self._free:
                factors = _least_squares(basis, target)
                found[name] = scale = float(factors[-1, 0])
                if gain_is_free:
                    found[self._law.gain] = float(factors[-1, 1]) / scale if scale else 0.0
            else:
                given = float(self._values[name])
                factors = given * np.array([[1.0, self._values[self._law.gain]][: len(parts)]])
            misfit += np.sum((np.einsum("sc,sck->sk", factors, basis) - target) ** 2, axis=-1)
        return misfit, found


def _least_squares(basis: Array, target: Array) -> Array:
    """Factors (s, c) of the columns of a basis (s, c, k) that come nearest to a target (k,)."""
    gram = basis @ basis.swapaxes(1, 2)
    # A trace of damping keeps the solution finite where two columns look alike, or one is zero.
    places = np.arange(basis.shape[1])
    gram[:, places, places] = gram[:, places, places] * (1.0 + 1e-9) + 1e-300
    return np.asarray(np.linalg.solve(gram, (basis @ target)[..., np.newaxis])[..., 0])


_LAWS = (
    _Law.of("yield force", ("f_t",), "k2", ("a1", "a2", "I0")),
    _Law.of("steepness", ("alpha",), "", ("k0",)),
    _Law.of("viscous slopes", ("k_c", "k_e"), "", ("a4",)),
    _Law.of("hysteresis", ("v_h",), "k3", ("a3", "I1")),
    _Law.of("velocity offset", ("v_d",), "", ()),
)
