"""The sigmoid law as a model, and the dependence of its coefficients on peak velocity and current.

The sixteen parameters form groups that share no unknown:

    f_t = f0 (1 + e^(a1 v)) (1 + k2 S(i; a2, I0))     f0 a1 k2 a2 I0
    alpha = a0 / (1 + k0 v)                           a0 k0
    k_c, k_e = (k1c, k1e) e^(-a4 v)                   k1c k1e a4
    v_h = k4 v (1 + k3 S(i; a3, I1))                  k4 k3 a3 I1
    v_d = k6 v                                        k6
    f_d = k5 f_t                                      k5

with S(i; a, I) = sigma(a (i + I)) - sigma(a I). In each group the scales (and k2, k3) are linear
and are solved for. Differential evolution searches the other unknowns of a group, at most three.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import product
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.current_dependence import LARGEST_GROWTH
from mr_damper_ros.models.first_order_lag import COIL, PLAUSIBLE_COIL, coil_parameter
from mr_damper_ros.models.force_model import CurrentResponse, Model
from mr_damper_ros.models.formulas import WrittenLaw, gradient, staged
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.quantities import (
    SETTLING,
    Coefficient,
    CoefficientTable,
    LawSearch,
    LoopReading,
    Parameter,
    SearchEffort,
    State,
)
from mr_damper_ros.models.sigmoid.following import (
    BRANCH_MEMORY,
    COMPLIANCE,
    EXTENDED_MODEL,
    EXTENDED_NAMES,
    EXTENSION_NAMES,
    LAG_MEMORY,
    SIGMOID_COUNT,
    SigmoidCurrentResponse,
    follow,
    time_constant,
)
from mr_damper_ros.models.sigmoid.law import (
    COEFFICIENT_NAMES,
    COEFFICIENTS,
    FORCE,
    PARAMETER_NAMES,
    SCALE_INDICES,
    SCALE_PARAMETER_NAMES,
    coefficient_derivatives,
    force_and_damping,
    operating_point_coefficients,
    quiet,
    sign_of_pair,
)
from mr_damper_ros.models.sigmoid.window_forces import SigmoidForces
from mr_damper_ros.signals.arrays import Array

_PARAMETERS = {
    "f0": Parameter("f0", "N"),
    **{name: Parameter(name, "A", currents=4) for name in ("I0", "I1")},
    "a0": Parameter("a0", "s/m"),
    **{name: Parameter(name, "s/m", peak_velocities=2) for name in ("a1", "a4", "k0")},
    # The thesis prints (m/s)^-1 for a3, although it multiplies a current.
    **{name: Parameter(name, "1/A", currents=3) for name in ("a2", "a3")},
    **{name: Parameter(name, "s/m") for name in ("k1c", "k1e")},
    **{name: Parameter(name, "1", currents=2) for name in ("k2", "k3")},
    **{name: Parameter(name, "1") for name in ("k4", "k5", "k6")},
}
_SIXTEEN = tuple(_PARAMETERS[name] for name in PARAMETER_NAMES)

_LITERATURE_PEAK_VELOCITY = 2.0 * math.pi * 1.0 * 2.5e-3
"""Peak velocity [m/s] of the test for the set from the literature: 1 Hz, 2.5 mm, at 0 A."""

_SMOOTH_SLOPE = 2.0
"""Slope [1/A] of a smooth step over the current, multiplied by the largest current."""

_STEEPNESS = (2.0, 6.0, 20.0, 60.0)
_HYSTERESIS = (0.0, -0.2, -0.4)
"""Starts of a search: steepness times largest velocity, hysteresis velocity over largest velocity.
"""

_K5 = PARAMETER_NAMES.index("k5")
_K5_SCALE = SCALE_PARAMETER_NAMES.index("k5")

_USUAL_LAG = 0.02
"""Usual upper limit [s] of the time constants of coil and fluid. While they are unknown, samples in
a transient with this time constant at the start of a window are excluded."""

_EXPONENT_SPAN = 8.0
"""Largest exponent of growth or decay over the velocity range; e^8 is a ratio of 3000."""


class _Law(NamedTuple):
    """One group of parameters: the coefficients that they determine, the gain, and the unknowns.

    Each coefficient is its scale times (constant + gain step). ``gain`` is k2, k3 or empty.
    """

    stage: str
    coefficients: tuple[str, ...]
    gain: str = ""
    unknowns: tuple[str, ...] = ()

    def basis(self, point: Sequence[Array], values: Mapping[str, Array | float]) -> list[Array]:
        """Constant and step (s, k) at k operating points, for values that are numbers or (s, 1)."""
        at_unit = dict(values) | dict.fromkeys(SCALE_PARAMETER_NAMES, 1.0) | {self.gain: 0.0}
        found = _BASES[self](*(at_unit[name] for name in PARAMETER_NAMES), *point)
        return list(np.broadcast_arrays(*(np.atleast_2d(each) for each in found)))

    def solve(
        self, table: CoefficientTable, values: Mapping[str, Array | float], free: frozenset[str]
    ) -> tuple[Array, dict[str, float]]:
        """Weighted misfit (s,) of s trials to the table, with the free linear parameters fitted.

        ``values`` are numbers, or have shape (s, 1). Also returns the fitted linear parameters (of
        the last trial).
        """
        constant, step = self.basis((table.peak_velocity, table.current), values)
        parts = [constant, step] if self.gain in free else [constant + values[self.gain] * step]
        misfit = np.zeros(parts[0].shape[0])
        found: dict[str, float] = {}
        for name in self.coefficients:
            column = COEFFICIENT_NAMES.index(name)
            scale, weights = SCALE_PARAMETER_NAMES[column], table.weights(column)
            target = weights * table.coefficients[:, column]
            basis = weights * np.stack(parts, axis=1)
            if scale in free:
                factors = _least_squares(basis, target)
                found[scale], *of_step = factors[-1].tolist()
                if of_step:
                    found[self.gain] = of_step[0] / found[scale] if found[scale] else 0.0
            else:
                factors = values[scale] * np.array([[1.0, values[self.gain]][: len(parts)]])
            misfit += np.sum((np.einsum("sc,sck->sk", factors, basis) - target) ** 2, axis=-1)
        return misfit, found


_LAWS = (
    _Law("yield force", ("f_t",), "k2", ("a1", "a2", "I0")),
    _Law("steepness", ("alpha",), unknowns=("k0",)),
    _Law("viscous slopes", ("k_c", "k_e"), unknowns=("a4",)),
    _Law("hysteresis", ("v_h",), "k3", ("a3", "I1")),
    _Law("velocity offset", ("v_d",)),
)


def _basis_of(law: _Law) -> Callable[..., Any]:
    """Compiled constant and step: derivatives of the first coefficient by its scale and gain."""
    name = law.coefficients[0]
    scale = SCALE_PARAMETER_NAMES[COEFFICIENT_NAMES.index(name)]
    by = (scale, law.gain or scale)  # a law without a gain has no use for the step
    lines = gradient(COEFFICIENTS, name, by)
    return staged(lines, [(*PARAMETER_NAMES, "v_m", "i")], [f"{name}_by_{each}" for each in by])


_BASES = {law: _basis_of(law) for law in _LAWS}


def shape_bounds(top_velocity: float, top_current: float) -> dict[str, tuple[float, float]]:
    """Search bounds of the nonlinear shape parameters.

    They follow from the range of the data (peak velocity [m/s], current [A]), so they hold for any
    damper. The slopes a2 and a3 are positive, because a negative slope is the same as a negative k2
    or k3.
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


def _least_squares(basis: Array, target: Array) -> Array:
    """Factors (s, c) for the columns of a basis (s, c, k), fitted to a target (k,)."""
    gram = basis @ basis.swapaxes(1, 2)
    # Slight regularisation keeps the solution finite if columns are equal or zero.
    places = np.arange(basis.shape[1])
    gram[:, places, places] = gram[:, places, places] * (1.0 + 1e-9) + 1e-300
    return np.asarray(np.linalg.solve(gram, (basis @ target)[..., np.newaxis])[..., 0])


class SigmoidModel(Model):
    """The sixteen-parameter law of Wang et al. (2004).

    ``jumps``: whether the force jumps at a reversal of the motion, as in the original law.
    """

    name = "sigmoid"
    title = "sigmoid"
    source = (
        "Wang, Ma, Rakheja and Su, 43rd IEEE Conference on Decision and Control, 2004; "
        "thesis eq. 7-11 and appendix D"
    )
    equation = (
        r"F = \left(f_t \tanh\tfrac{\alpha (v + \operatorname{sgn}(a) v_h + v_d)}{2} - f_d\right)"
        r" (1 + k |v|)"
    )
    parameters = _SIXTEEN
    free_in_one_run: ClassVar[tuple[str, ...]] = SCALE_PARAMETER_NAMES
    strength = ("f0",)
    at_one_current = (
        Coefficient("f_t", "N", meaning="yield force"),
        Coefficient("alpha", "s/m", meaning="steepness"),
        Coefficient("k_c", "s/m", meaning="viscous slope, extension"),
        Coefficient("k_e", "s/m", meaning="viscous slope, compression"),
        Coefficient("v_h", "m/s", meaning="hysteresis velocity"),
        Coefficient("v_d", "m/s", meaning="velocity offset"),
        Coefficient("f_d", "N", meaning="force offset, subtracted"),
    )
    linear = (*SCALE_PARAMETER_NAMES, "k2", "k3")
    shape_groups = (("a1", "k2", "a2", "I0"), ("k0",), ("a4",), ("k3", "a3", "I1"))
    # All formats have the constants of the extended law; without it, they are zero.
    formulas = WrittenLaw(EXTENDED_NAMES, COEFFICIENTS, FORCE, COEFFICIENT_NAMES)

    effort = SearchEffort(
        tolerance=1.5e-8, most_steps=300, polished_starts=1, rough_tolerance=0.01, rough_steps=20
    )
    """The seven scales are well conditioned, so only the start with the lowest cost is refined."""

    def __init__(self, *, jumps: bool = True) -> None:
        self._jumps = jumps
        self.turning = 0 if jumps else BRANCH_MEMORY
        self.memory = self.turning + (LAG_MEMORY if self.remembers else 0)

    def follow_in_coil(
        self, parameters: Array, motion: Motion, current: Array, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; :mod:`following` describes the state."""
        return follow(parameters, motion, current, period, state, jumps=self._jumps)

    @cached_property
    def continuous(self) -> Model:
        """The law whose branch follows the velocity continuously at a reversal."""
        return type(self)(jumps=False) if self._jumps else self

    def current_response(self, parameters: Array) -> CurrentResponse:
        """Force over the current; only two factors in it depend on the current."""
        return SigmoidCurrentResponse(parameters, jumps=self._jumps)

    def starts(self, reading: LoopReading) -> Array:
        """Starts with several steepnesses and widths, without dependence on velocity or current."""
        starts = []
        for steepness, hysteresis in product(_STEEPNESS, _HYSTERESIS):
            # With a1 = 0, f_t is twice f0.
            values = {
                "f0": 0.4 * reading.force,
                "a0": steepness / reading.speed,
                "k1c": 0.2 / reading.speed,
                "k1e": 0.2 / reading.speed,
                "k4": hysteresis,
                "k5": -reading.middle / (0.8 * reading.force),
            }
            starts.append([values.get(name, 0.0) for name in self.parameter_names])
        return np.array(starts)

    def cold_starts(self, window: Window, parameters: Array) -> list[Array]:
        """Starts with the present shape parameters, and the coefficients of :meth:`starts`."""
        speed = float(np.max(np.abs(window.motion.velocity)))
        reading = LoopReading.of(window)._replace(speed=speed)
        unit = parameters[:SIGMOID_COUNT].copy()
        unit[SCALE_INDICES] = 1.0
        base = np.concatenate(operating_point_coefficients(unit, *window.operating_point))
        base = np.where(base == 0.0, 1.0, base)
        found = SigmoidModel.starts(self, reading)
        starts = np.tile(parameters, (len(found), 1))
        for start, read in zip(starts, found, strict=True):
            coefficients = self.coefficients_at(read, speed, 0.0)[:, 0]
            start[SCALE_INDICES] = coefficients / base
            start[_K5] = coefficients[_K5_SCALE] / coefficients[0]
        return list(starts)

    def initial_values(self) -> tuple[Array, str, float]:
        """The set from the literature."""
        return LITERATURE.copy(), "literature", _LITERATURE_PEAK_VELOCITY

    def window_forces(self, windows: Sequence[Window]) -> SigmoidForces:
        """Forces with exact derivatives."""
        return SigmoidForces(self, windows)

    def window_force(self, window: Window, parameters: Array) -> Array:
        """Force [N] at the samples of a window, shape (..., n), for parameters (..., p)."""
        if self.turning:
            return super().window_force(window, parameters)
        (force,) = self.window_forces([window]).forces(parameters)
        return force

    def coefficients_at(
        self, parameters: Array, peak_velocity: ArrayLike, current: ArrayLike
    ) -> Array:
        """The seven coefficients (7, n), with positive f_t."""
        v_m, i = np.broadcast_arrays(np.atleast_1d(peak_velocity), np.atleast_1d(current))
        values = np.stack(operating_point_coefficients(parameters[:SIGMOID_COUNT], v_m, i))
        values[:2] *= sign_of_pair(values[0])
        return values

    @quiet
    def coefficient_gradient(
        self, parameters: Array, peak_velocity: float, current: float
    ) -> Array:
        """Derivatives (7, p) of the coefficients by the parameters, for positive f_t."""
        sixteen = parameters[:SIGMOID_COUNT]
        point = np.array([peak_velocity]), np.array([current])
        found = coefficient_derivatives(*sixteen.tolist())(*point)
        gradient = np.array(np.broadcast_arrays(*found)).reshape(-1, SIGMOID_COUNT)
        f_t = operating_point_coefficients(sixteen, peak_velocity, current).f_t
        gradient[:2] *= sign_of_pair(f_t)
        return np.pad(gradient, ((0, 0), (0, parameters.size - SIGMOID_COUNT)))

    def without_dependence(self, parameters: Array, top_current: float) -> Array:
        """The set with the same scales; v_h and v_d remain proportional to the peak velocity.

        If a search frees k2 or k3, the coefficient increases smoothly up to the top current and
        saturates above it.
        """
        values = np.array(parameters, dtype=float)
        values[self.places(("a1", "k0", "a4", "k2", "k3", "I0", "I1"))] = 0.0
        values[self.places(("a2", "a3"))] = _SMOOTH_SLOPE / max(top_current, 1e-12)
        return values

    def plausible_ranges(
        self, windows: Sequence[Window], top_velocity: float, top_current: float
    ) -> dict[str, tuple[float, float]]:
        """Ranges of the nine shape parameters."""
        gains = dict.fromkeys(("k2", "k3"), (-LARGEST_GROWTH, LARGEST_GROWTH))
        return {**shape_bounds(top_velocity, top_current), **gains}

    def typical_sizes(self, windows: Sequence[Window]) -> Array:
        """1 in each unit, because the scales of a damper are larger or have little effect."""
        return np.ones(len(self.parameters))

    def searched_laws(self, free: frozenset[str]) -> int:
        """Number of laws that need a nonlinear search for these free parameters."""
        return sum(any(name in free for name in law.unknowns) for law in _LAWS)

    def fit_laws(
        self, table: CoefficientTable, start: Array, free: frozenset[str], search: LawSearch
    ) -> Array:
        """Fit the decoupled laws one by one."""
        sixteen, rest = np.split(start, [SIGMOID_COUNT])
        # A law without a gain has the gain "", which is zero.
        values = {"": 0.0, **dict(zip(PARAMETER_NAMES, sixteen.tolist(), strict=True))}
        top_velocity = float(table.peak_velocity.max())
        bounds = shape_bounds(top_velocity, float(np.abs(table.current).max()))
        for law in _LAWS:
            names = [name for name in law.unknowns if name in free]

            def misfit(individuals: Array, law: _Law = law, names: list[str] = names) -> Array:
                trial = dict(zip(names, individuals[:, :, np.newaxis], strict=True))
                return law.solve(table, values | trial, free)[0]

            if names:
                ranges = [bounds[name] for name in names]
                best = search(misfit, ranges, np.array([values[name] for name in names]), law.stage)
                values.update(zip(names, best.tolist(), strict=True))
            values.update(law.solve(table, values, free)[1])
        if "k5" in free:
            weights = table.weights(_K5_SCALE)
            yield_force, offset = (weights * table.coefficients[:, c] for c in (0, _K5_SCALE))
            values["k5"] = float(_least_squares(yield_force[np.newaxis, np.newaxis], offset)[0, 0])
        return np.concatenate(([values[name] for name in PARAMETER_NAMES], rest))

    def draw_shape(
        self, rng: np.random.Generator, top_velocity: float, top_current: float
    ) -> dict[str, float]:
        """Random shape parameters for which coefficients change by a small factor in the range."""
        drawn = {
            "a1": rng.uniform(-1.5, 1.5) / top_velocity,
            "k0": rng.uniform(0.0, 10.0) / top_velocity,
            "a4": rng.uniform(-1.5, 1.5) / top_velocity,
            "k2": math.exp(rng.uniform(0.0, 3.0)),
            "k3": rng.uniform(-1.0, 1.0),
        }
        for slope, shift in (("a2", "I0"), ("a3", "I1")):
            drawn[slope] = math.exp(rng.uniform(0.5, 2.5)) / top_current
            drawn[shift] = rng.uniform(-0.5, 0.5) * top_current
        return drawn


class ExtendedSigmoidModel(SigmoidModel):
    """The sixteen-parameter law with a series compliance, stiffness, offset and coil lag."""

    name = EXTENDED_MODEL
    title = "sigmoid with lag, stiffness, offset"
    source = f"{SigmoidModel.source}; the extension is this package's"
    equation = (
        r"\tau \dot F_l + F_l = F_\mathrm{sigmoid},\quad"
        r" \tau = \mathrm{compliance} \cdot f_t \tanh(\alpha x / 2) / x,\quad"
        r" F = F_l + \mathrm{stiffness} \cdot u + \mathrm{offset}"
    )
    parameters = (
        *_SIXTEEN,
        *(
            Parameter(name, unit, 0.0 if name == COMPLIANCE else -np.inf)
            for name, unit in zip(EXTENSION_NAMES, ("m/N", "N/m", "N"), strict=True)
        ),
        coil_parameter(),
    )
    free_in_one_run = (*SCALE_PARAMETER_NAMES, *EXTENSION_NAMES)
    common_names = EXTENSION_NAMES
    remembers = True

    def starts(self, reading: LoopReading) -> Array:
        """The starts of the sigmoid law with a small compliance."""
        starts = super().starts(reading)
        starts[:, self.places([COMPLIANCE])] = 0.02 * reading.amplitude / reading.force
        return starts

    def initial_values(self) -> tuple[Array, str, float]:
        """The set from the literature, without lag, stiffness and offset."""
        values, name, speed = super().initial_values()
        return np.pad(values, (0, len(self.parameters) - values.size)), name, speed

    def unsettled(self, window: Window, parameters: Array | None) -> np.ndarray:
        """Mask (n,) of samples at which the lag depends on the time before the window."""
        lag = _USUAL_LAG
        history = window.history
        if parameters is not None:
            sixteen, motion = parameters[:SIGMOID_COUNT], history.motion
            along = operating_point_coefficients(sixteen, motion.peak_velocity, history.current)
            _, damping = force_and_damping(along, motion.velocity, motion.acceleration)
            lag = float(np.max(time_constant(parameters, damping)))
        return history.unsettled(SETTLING * lag)

    def plausible_ranges(
        self, windows: Sequence[Window], top_velocity: float, top_current: float
    ) -> dict[str, tuple[float, float]]:
        """Ranges of the parameters of the sigmoid law and of its extension.

        In any window, the compliance deflects by at most the amplitude, and stiffness and offset
        contribute at most the whole force.
        """
        forces = [float(np.max(np.abs(window.force))) for window in windows]
        stiffnesses = [
            force / window.motion.amplitude for force, window in zip(forces, windows, strict=True)
        ]
        return {
            **super().plausible_ranges(windows, top_velocity, top_current),
            COMPLIANCE: (0.0, 1.0 / max(stiffnesses)),
            "stiffness": (-min(stiffnesses), min(stiffnesses)),
            "offset": (-min(forces), min(forces)),
            COIL: (0.0, PLAUSIBLE_COIL),
        }
