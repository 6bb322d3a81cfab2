"""The sigmoid law as a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import product
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.current_response import CurrentResponse
from mr_damper_ros.models.first_order_lag import (
    COIL,
    PLAUSIBLE_COIL,
    SETTLING,
    coil_parameter,
    coil_unsettled,
)
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.formulas import WrittenLaw
from mr_damper_ros.models.published import LITERATURE
from mr_damper_ros.models.quantities import (
    CoefficientTable,
    LawSearch,
    LoopReading,
    Parameter,
    Quantity,
    SearchEffort,
    State,
)
from mr_damper_ros.models.sigmoid.coefficient_laws import fit_laws, searched_laws, shape_bounds
from mr_damper_ros.models.sigmoid.following import (
    BRANCH_MEMORY,
    COMPLIANCE,
    EXTENDED_MODEL,
    EXTENDED_NAMES,
    EXTENSION_NAMES,
    SIGMOID_COUNT,
    SigmoidCurrentResponse,
    extension_of,
    follow,
    without_extension,
)
from mr_damper_ros.models.sigmoid.law import (
    COEFFICIENT_NAMES,
    COEFFICIENTS,
    FORCE,
    PARAMETER_NAMES,
    SCALE_INDICES,
    SCALE_PARAMETER_NAMES,
    coefficient_parameter_jacobian,
    operating_point_coefficients,
    secant_damping,
    sign_of_pair,
)
from mr_damper_ros.models.sigmoid.window_forces import SigmoidForces
from mr_damper_ros.signals.arrays import Array

_UNITS = {
    **dict.fromkeys(("a0", "a1", "a4", "k0", "k1c", "k1e"), "s/m"),
    **dict.fromkeys(("k2", "k3", "k4", "k5", "k6"), "1"),
    # The thesis prints (m/s)^-1 for a3, which multiplies a current.
    **dict.fromkeys(("a2", "a3"), "1/A"),
    **dict.fromkeys(("I0", "I1"), "A"),
    "f0": "N",
}

_PEAK_VELOCITIES = dict.fromkeys(("a1", "k0", "a4"), 2)
_CURRENTS = {
    **dict.fromkeys(("k2", "k3"), 2),
    **dict.fromkeys(("a2", "a3"), 3),
    **dict.fromkeys(("I0", "I1"), 4),
}

_SIXTEEN = tuple(
    Parameter(
        name,
        _UNITS[name],
        peak_velocities=_PEAK_VELOCITIES.get(name, 1),
        currents=_CURRENTS.get(name, 1),
    )
    for name in PARAMETER_NAMES
)

_LITERATURE_PEAK_VELOCITY = 2.0 * math.pi * 1.0 * 2.5e-3
"""Peak velocity [m/s] of the test that the literature's set is for: 1 Hz, 2.5 mm, at 0 A."""

_GAIN_RANGE = 100.0
"""Plausible range of k2 and k3: the current multiplies a coefficient by up to this."""

_SOFT = 2.0
"""A step over current that is this part of the largest current wide, inverted."""

_STEEPNESS = (2.0, 6.0, 20.0, 60.0)
_HYSTERESIS = (0.0, -0.2, -0.4)
"""Steepness and hysteresis velocity, times and over the largest velocity, to start a search."""

_K5 = PARAMETER_NAMES.index("k5")
_LAST = SCALE_PARAMETER_NAMES.index("k5")

_USUAL_LAG = 0.02
"""Time constant [s] that a lag of coil and fluid hardly exceeds. Until it is known, what it may
hide at the begin of a window is left out."""


class SigmoidModel(Model):
    """The sixteen-parameter law of Wang et al. (2004).

    ``jumps``: whether the force jumps where the motion turns, as that of the law does.
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
    coefficient_quantities = (
        Quantity("f_t", "N", "yield force"),
        Quantity("alpha", "s/m", "steepness"),
        Quantity("k_c", "s/m", "viscous slope, extension"),
        Quantity("k_e", "s/m", "viscous slope, compression"),
        Quantity("v_h", "m/s", "hysteresis velocity"),
        Quantity("v_d", "m/s", "velocity offset"),
        Quantity("f_d", "N", "force offset, subtracted"),
    )
    linear = (*SCALE_PARAMETER_NAMES, "k2", "k3")
    shape_groups = (("a1", "k2", "a2", "I0"), ("k0",), ("a4",), ("k3", "a3", "I1"))

    effort = SearchEffort(
        tolerance=1.5e-8,
        most_steps=300,
        polished_starts=1,
        rough_tolerance=0.01,
        rough_steps=20,
    )
    """Seven scales are well posed: the cheapest of the starts leads where the others do."""

    def __init__(self, *, jumps: bool = True) -> None:
        self._jumps = jumps
        self.turning = 0 if jumps else BRANCH_MEMORY

    def follow(
        self, parameters: Array, motion: Motion, current: Array, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; see :mod:`following` for what is remembered."""
        return follow(parameters, motion, current, period, state, jumps=self._jumps)

    @cached_property
    def continuous(self) -> Model:
        """The law whose branch follows the velocity where the motion turns."""
        return type(self)(jumps=False) if self._jumps else self

    def current_response(self, parameters: Array) -> CurrentResponse:
        """Force over the current, of which only two factors depend on it."""
        return SigmoidCurrentResponse(parameters, jumps=self._jumps)

    @property
    def formulas(self) -> WrittenLaw:
        """The law for other languages."""
        return WrittenLaw(EXTENDED_NAMES, COEFFICIENTS, FORCE, COEFFICIENT_NAMES)

    def starts(self, reading: LoopReading) -> Array:
        """Some steepness, some hysteresis, no dependence on velocity or current."""
        starts = []
        for steepness, hysteresis in product(_STEEPNESS, _HYSTERESIS):
            # f0 counts twice where a1 is zero.
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
        """Scales with the coefficients of :meth:`starts`, for the shape of these parameters."""
        speed = float(np.max(np.abs(window.motion.velocity)))
        reading = LoopReading.of(window)._replace(speed=speed)
        unit = parameters[:SIGMOID_COUNT].copy()
        unit[SCALE_INDICES] = 1.0
        base = np.concatenate(operating_point_coefficients(unit, *window.operating_point))
        base = np.where(base == 0.0, 1.0, base)
        return [
            self.with_unknowns(parameters, self.coefficients_at(read, speed, 0.0)[:, 0] / base)
            for read in SigmoidModel.starts(self, reading)
        ]

    def initial_values(self) -> tuple[Array, str, float]:
        """The set from the literature."""
        return LITERATURE.copy(), "literature", _LITERATURE_PEAK_VELOCITY

    def window_forces(self, windows: Sequence[Window]) -> SigmoidForces:
        """All windows by one evaluation of the laws."""
        return SigmoidForces(self, windows)

    def window_force(self, window: Window, parameters: Array) -> Array:
        """Force [N] at the samples of a window, shape (..., n), for parameters (..., p)."""
        if self.turning:
            return super().window_force(window, parameters)
        (force,) = self.window_forces([window]).forces(parameters)
        return force

    # Unknowns of a window are the scales, but f0 k5 for k5: the force offset stays linear, and may
    # be zero.

    @property
    def strong_unknowns(self) -> np.ndarray:
        """Mask (7,)."""
        return np.isin(SCALE_PARAMETER_NAMES, ("f0", "k5"))

    def unknowns(self, parameters: Array) -> Array:
        """Those (7,) of parameters (p,)."""
        scales = parameters[SCALE_INDICES]
        scales[_LAST] *= scales[0]
        return scales

    def with_unknowns(self, parameters: Array, unknowns: Array) -> Array:
        """Parameters (..., p) with these unknowns (..., 7), all else as in ``parameters`` (p,)."""
        values = np.empty((*unknowns.shape[:-1], parameters.size))
        values[...] = parameters
        values[..., SCALE_INDICES] = unknowns
        values[..., _K5] = _over(unknowns[..., _LAST], unknowns[..., 0])
        return values

    def by_unknowns(self, unknowns: Array, derivatives: Array) -> Array:
        """Derivatives (n, 7) by the unknowns (7,), from those (n, 7) by the scales."""
        found = derivatives.copy(order="K")
        found[:, _LAST] *= _over(np.ones(()), unknowns[0])
        found[:, 0] -= found[:, _LAST] * _over(unknowns[_LAST], unknowns[0])
        return found

    def fitted_errors(self, unknowns: Array, covariance: Array) -> tuple[np.ndarray, Array]:
        """Places and standard errors (7,) of the scale parameters; of k5 to first order."""
        errors = np.sqrt(np.diag(covariance))
        f0, offset = unknowns[0], unknowns[_LAST]
        if f0 == 0.0:
            errors[_LAST] = np.nan
        else:
            gradient = np.array([-offset / f0**2, 1.0 / f0])
            variance = gradient @ covariance[np.ix_([0, _LAST], [0, _LAST])] @ gradient
            errors[_LAST] = np.sqrt(np.maximum(variance, 0.0))  # rounding may leave less
        return SCALE_INDICES, errors

    def coefficients_at(
        self, parameters: Array, peak_velocity: ArrayLike, current: ArrayLike
    ) -> Array:
        """The seven coefficients (7, n), with positive f_t."""
        v_m, i = np.broadcast_arrays(np.atleast_1d(peak_velocity), np.atleast_1d(current))
        values = np.stack(operating_point_coefficients(parameters[:SIGMOID_COUNT], v_m, i))
        values[:2] *= sign_of_pair(values[0])
        return values

    def coefficient_gradient(
        self, parameters: Array, peak_velocity: float, current: float
    ) -> Array:
        """Derivatives (7, p), with positive f_t."""
        sixteen = parameters[:SIGMOID_COUNT]
        gradient = coefficient_parameter_jacobian(sixteen, peak_velocity, current)[0]
        f_t = operating_point_coefficients(sixteen, peak_velocity, current).f_t
        gradient[:2] *= sign_of_pair(f_t)
        return np.pad(gradient, ((0, 0), (0, parameters.size - SIGMOID_COUNT)))

    def without_dependence(self, parameters: Array, top_current: float) -> Array:
        """The same scales; v_h and v_d stay proportional to the peak velocity.

        Where k2 or k3 is freed, the coefficient rises smoothly up to the top current and saturates
        beyond.
        """
        values = np.array(parameters, dtype=float)
        values[self.places(("a1", "k0", "a4", "k2", "k3", "I0", "I1"))] = 0.0
        values[self.places(("a2", "a3"))] = 2.0 / max(top_current, 1e-12)
        return values

    def plausible_ranges(
        self, windows: Sequence[Window], top_velocity: float, top_current: float
    ) -> dict[str, tuple[float, float]]:
        """Ranges of the nine shape parameters."""
        gains = dict.fromkeys(("k2", "k3"), (-_GAIN_RANGE, _GAIN_RANGE))
        return {**shape_bounds(top_velocity, top_current), **gains}

    def typical_sizes(self, windows: Sequence[Window]) -> Array:
        """One of each unit: the scales of a damper are larger, or hardly matter."""
        return np.ones(len(self.parameters))

    def searched_laws(self, free: frozenset[str]) -> int:
        """How many of the laws need a search for these free parameters."""
        return searched_laws(free)

    def fit_laws(
        self,
        table: CoefficientTable,
        start: Array,
        free: frozenset[str],
        search: LawSearch,
    ) -> Array:
        """The six decoupled laws, see :mod:`coefficient_laws`."""
        sixteen, rest = np.split(start, [SIGMOID_COUNT])
        return np.concatenate((fit_laws(table, sixteen, free, search), rest))

    def softened(self, parameters: Array, held: np.ndarray, top_current: float) -> Array:
        """The set with steps over current that are not too steep to be moved."""
        steps = self.places(("a2", "a3"))
        values = np.array(parameters)
        values[steps[~held[steps]]] = _SOFT / max(top_current, 1e-12)
        return values

    def draw_shape(
        self, rng: np.random.Generator, top_velocity: float, top_current: float
    ) -> dict[str, float]:
        """Coefficients that change by a few times over the range."""
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
    """The sixteen parameters with a compliance in series, stiffness, offset and a lagging coil."""

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
    remembers = True

    @property
    def scale_names(self) -> tuple[str, ...]:
        """Those of the sigmoid law: the extension is common to all runs."""
        return SCALE_PARAMETER_NAMES

    @property
    def simpler(self) -> Model:
        """The sixteen-parameter law."""
        return SigmoidModel()

    def to_simpler(self, values: Array) -> Array:
        """The sixteen parameters (16,)."""
        return values[:SIGMOID_COUNT]

    def from_simpler(self, simple: Array) -> Array:
        """Without lag, stiffness and offset."""
        return without_extension(simple)

    def starts(self, reading: LoopReading) -> Array:
        """Those of the sigmoid law with a small compliance."""
        starts = super().starts(reading)
        starts[:, self.places([COMPLIANCE])] = 0.02 * reading.amplitude / reading.force
        return starts

    def initial_values(self) -> tuple[Array, str, float]:
        """The set from the literature, without lag, stiffness and offset."""
        values, name, speed = super().initial_values()
        return without_extension(values), name, speed

    def settled(self, window: Window, parameters: Array | None) -> np.ndarray:
        """Mask (n,) of samples at which lag and coil have forgotten the past before the window."""
        lag = coil = _USUAL_LAG
        history = window.history
        if parameters is not None:
            sixteen, motion = parameters[:SIGMOID_COUNT], history.motion
            along = operating_point_coefficients(sixteen, motion.peak_velocity, history.current)
            damping = secant_damping(along, motion.velocity, motion.acceleration)
            lag = float(np.max(extension_of(parameters).time_constant(damping)))
            coil = float(parameters[-1])
        return ~(history.unsettled(SETTLING * lag) | coil_unsettled(window, coil))

    def plausible_ranges(
        self, windows: Sequence[Window], top_velocity: float, top_current: float
    ) -> dict[str, tuple[float, float]]:
        """Those of the sigmoid law, and of the extension from what the data span.

        The compliance gives way to the force by no more than the amplitude of any window; the
        stiffness and the offset make no more than all of the force in it.
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


def _over(part: Array, whole: Array) -> Array:
    """The quotient, 0 where the divisor is."""
    if whole.ndim == 0:  # asked for at every step of a search
        return np.asarray(part / whole if whole else 0.0 * part)
    return np.asarray(part / np.where(whole != 0.0, whole, np.inf))
