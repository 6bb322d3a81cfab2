"""The interface of all force models of MR dampers.

A model is one class in one file of this package. It states its parameters with units and bounds,
its force and state, and the starts of a search. If necessary, it replaces the defaults for the fit
of a window and for the laws of the coefficients over operating points. No code outside this package
depends on the specific model. A stream computes the force of a continuing motion block by block.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from itertools import compress
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.motion import Motion, MotionSample
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.first_order_lag import COIL, coil_current, coil_shows, in_coil
from mr_damper_ros.models.formulas import WrittenLaw
from mr_damper_ros.models.machine_code import as_machine_code
from mr_damper_ros.models.quantities import (
    DIFFERENCE,
    NOTICED,
    SETTLING,
    Coefficient,
    CoefficientTable,
    LawSearch,
    LoopReading,
    Parameter,
    SearchEffort,
    State,
)
from mr_damper_ros.signals.arrays import NEGLIGIBLE, Array

AT_ONCE = 1 << 16
"""Number of samples of a motion whose terms are in memory together. Of two million samples, the
terms of the sigmoid law need 350 MB."""

_USUAL_RUN = LoopReading(1000.0, 0.0, 2.0 * np.pi * 1.0 * 5e-3, 5e-3)
"""A typical run: 1 kN, 5 mm, 1 Hz."""


class Model(ABC):
    """A force law.

    ``parameters`` are in the order of every parameter array (p,). ``free_in_one_run`` names the
    parameters that one run at one current determines; the others keep the values of a start.
    ``common_names`` are those of them that all runs share, such as a compliance. ``remembers``:
    whether the force depends on earlier samples. ``memory``: number of arrays in the state of the
    law itself, of which the first ``turning`` only matter near a reversal of the motion; the state
    of the coil follows them. A law whose last parameter is the time constant of the coil depends on
    the coil current. ``strength`` names the gain parameters, which scale with the strength of the
    damper. ``effort``: search effort for a window. ``at_one_current``:
    the coefficients of the force at one operating point. ``linear`` names the parameters that enter
    the laws over operating points linearly; ``shape_groups`` lists the shape parameters of each
    law. ``formulas`` are the law for other languages, None if there are none.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    source: ClassVar[str]
    equation: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    free_in_one_run: ClassVar[tuple[str, ...]]
    common_names: ClassVar[tuple[str, ...]] = ()
    remembers: ClassVar[bool] = False
    memory: int = 0
    turning: int = 0
    strength: ClassVar[tuple[str, ...]]
    effort: ClassVar[SearchEffort] = SearchEffort()
    at_one_current: ClassVar[tuple[Coefficient, ...]] = ()
    linear: ClassVar[tuple[str, ...]]
    shape_groups: ClassVar[tuple[tuple[str, ...], ...]]
    formulas: ClassVar[WrittenLaw | None] = None

    # Abstract interface of a law

    @abstractmethod
    def follow_in_coil(
        self, parameters: Array, motion: Motion, current: Array, period: float, state: State | None
    ) -> tuple[Array, State]:
        """As :meth:`follow`, for a coil current (..., n) [A]; the state excludes the coil."""

    @abstractmethod
    def starts(self, reading: LoopReading) -> Array:
        """Starts (k, p) of a search, derived from a loop reading."""

    @abstractmethod
    def current_response(self, parameters: Array) -> CurrentResponse:
        """Force of a set (p,) over the coil current."""

    # Parameters

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names in the order of every parameter array."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def units(self) -> dict[str, str]:
        """Unit by parameter name."""
        return {parameter.name: parameter.unit for parameter in self.parameters}

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds, each of shape (p,)."""
        low = np.array([parameter.low for parameter in self.parameters])
        high = np.array([parameter.high for parameter in self.parameters])
        return low, high

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Names of the coefficients at one operating point."""
        return tuple(each.name for each in self.at_one_current)

    def places(self, names: Sequence[str]) -> np.ndarray:
        """Indices of the named parameters in a parameter array."""
        every = self.parameter_names
        return np.array([every.index(name) for name in names], dtype=int)

    def marked(self, names: Iterable[str]) -> np.ndarray:
        """Flags (p,) that mark the named parameters."""
        return np.isin(self.parameter_names, list(names))

    def completed(self, values: Array) -> Array:
        """The values (p,) with defaults appended for omitted parameters at the end."""
        left_out = [parameter.default for parameter in self.parameters[values.shape[0] :]]
        known = [default for default in left_out if default is not None]
        return values if len(known) < len(left_out) else np.append(values, known)

    @property
    def scale_names(self) -> tuple[str, ...]:
        """The scale parameters: each multiplies a coefficient and has no plausible range."""
        return tuple(name for name in self.free_in_one_run if name not in self.common_names)

    @property
    def shape_names(self) -> tuple[str, ...]:
        """The parameters that only several operating points can determine."""
        return tuple(name for name in self.parameter_names if name not in self.free_in_one_run)

    def knows_speeds(self, observable: np.ndarray) -> bool:
        """Whether the flags (p,) mark a parameter that needs several peak velocities."""
        return any(p.peak_velocities > 1 for p in compress(self.parameters, observable))

    def knows_currents(self, observable: np.ndarray) -> bool:
        """Whether the flags (p,) mark a parameter that needs several currents."""
        return any(p.currents > 1 for p in compress(self.parameters, observable))

    @property
    def strength_indices(self) -> np.ndarray:
        """Indices of the gain parameters."""
        return np.sort(self.places(self.strength))

    def initial_values(self) -> tuple[Array, str, float]:
        """Default values (p,) for an unknown damper, their name and their peak velocity [m/s].

        Unless the model has a better set, the force of this set is zero and never valid.
        """
        values = self.starts(_USUAL_RUN)[0]
        values[self.strength_indices] = 0.0
        return np.clip(values, *self.bounds), "start", 0.0

    # Force

    def follow(
        self, parameters: Array, motion: Motion, current: Array, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force (..., n) [N], and the state after the last sample.

        For parameters (..., p), a motion and currents (n,) [A], the ``period`` [s] between samples
        and the state after the previous sample.
        """
        size = motion.velocity.size
        if size > AT_ONCE:
            forces = np.empty((*parameters.shape[:-1], size))
            for part in (slice(k, k + AT_ONCE) for k in range(0, size, AT_ONCE)):
                along = motion.part(part), current[part], period
                forces[..., part], state = self.follow(parameters, *along, state)
            assert state is not None
            return forces, state
        # Without np.any for one set, because it takes as long as the lag itself.
        lags = parameters[-1] > 0.0 if parameters.ndim == 1 else np.any(parameters[..., -1] > 0.0)
        if not (self.has_coil and lags):
            own = state if state is None else state[: self.memory]
            return self.follow_in_coil(parameters, motion, current, period, own)
        own, coil = (None, ()) if state is None else (state[: self.memory], state[self.memory :])
        current, coil = coil_current(current, parameters[..., -1], period, coil)
        force, own = self.follow_in_coil(parameters, motion, current, period, own)
        return force, (*own, *coil)

    @cached_property
    def has_coil(self) -> bool:
        """Whether the coil current lags behind the supply current."""
        return self.parameters[-1].name == COIL

    @property
    def continuous(self) -> Model:
        """The law without jumps of the force at reversals; the law itself if it has none."""
        return self

    def force(
        self, parameters: ArrayLike, motion: Motion, current: ArrayLike, period: float
    ) -> Array:
        """Force [N], shape (..., n), for parameters of shape (..., p), without a previous state.

        ``current`` [A] is a number or has shape (n,). Raises ValueError if the number of parameters
        is wrong or the period is not positive.
        """
        values = np.asarray(parameters, dtype=float)
        if values.shape[-1:] != (len(self.parameters),):
            raise ValueError(
                f"model '{self.name}' has {len(self.parameters)} parameters "
                f"({', '.join(self.parameter_names)}): got shape {values.shape}"
            )
        if not period > 0.0:
            raise ValueError(f"the sample period is {period} s: it must be positive")
        amperes = np.broadcast_to(np.asarray(current, dtype=float), motion.velocity.shape)
        with np.errstate(over="ignore", invalid="ignore"):
            return self.follow(values, motion, amperes, period, None)[0]

    # A set may hold any finite values. An overflow, here and below, gives a large misfit.
    @as_machine_code()
    @np.errstate(over="ignore", invalid="ignore")
    def window_force(self, window: Window, parameters: Array) -> Array:
        """Force [N] at the samples of a window, shape (..., n), for parameters (..., p)."""
        if not (self.remembers or self.turning):
            coil = parameters[..., -1] if self.has_coil else np.zeros(())
            if coil.ndim and coil_shows(window, float(np.max(coil))):
                return np.stack([self.window_force(window, values) for values in parameters])
            seen = in_coil(window, float(np.max(coil)))
            return self.follow_in_coil(parameters, seen.motion, seen.current, 1.0, None)[0]
        # The branch changes as fast as the law itself, so it needs the full sample rate.
        history = window.history if self.turning else window.history.coarse
        along = parameters, history.motion, history.current, history.period
        force, state = self.follow(*along, None)
        if history.periodic:
            force, _ = self.follow(*along, state)
        return np.moveaxis(history.at_samples(np.moveaxis(force, -1, 0)), 0, -1)

    @as_machine_code()
    @np.errstate(over="ignore", invalid="ignore")
    def settled(self, window: Window, parameters: Array | None) -> np.ndarray:
        """Mask (n,) of samples whose force does not depend on the time before the window.

        ``parameters`` (p,) are None if no set is known yet.
        """
        unsettled = self.unsettled(window, parameters)
        coil = 0.0 if parameters is None or not self.has_coil else float(parameters[-1])
        if coil_shows(window, coil):
            unsettled = unsettled | window.history.unsettled(SETTLING * coil)
        return ~unsettled

    def unsettled(self, window: Window, parameters: Array | None) -> np.ndarray:
        """Mask (n,) of samples at which the law alone depends on the time before the window."""
        if parameters is None or not (self.remembers or self.turning) or window.history.periodic:
            return np.zeros(window.sample_count, dtype=bool)
        history = window.history.coarse
        along = parameters, history.motion, history.current, history.period
        first, state = self.follow(*along, None)
        second, _ = self.follow(*along, state)
        differs = np.abs(first - second) > NEGLIGIBLE * float(np.ptp(first))
        # The true past may differ from these two starts.
        count = 2 * int(np.max(np.flatnonzero(differs), initial=-1) + 1)
        return history.unsettled(count * history.period)

    def memory_length(self, parameters: Array, current: float) -> float:
        """Travel [m] after which the past has no effect; 0 if the memory depends on time only.

        ``parameters`` have shape (p,); ``current`` is in A.
        """
        return 0.0

    def needs_past(self, window: Window) -> bool:
        """Whether the force at the samples depends on motion or current between them."""
        return self.remembers or (self.has_coil and not window.has_constant_current)

    def lasting_force(self, window: Window, parameters: Array) -> Array:
        """The force (n,) [N] with all gain parameters set to zero."""
        weakest = parameters.copy()
        weakest[self.strength_indices] = 0.0
        return self.window_force(window, np.clip(weakest, *self.bounds))

    def window_forces(self, windows: Sequence[Window]) -> WindowForces:
        """Force at the samples of windows, and its derivatives with respect to the parameters."""
        return WindowForces(self, windows)

    @cached_property
    def unknown_indices(self) -> np.ndarray:
        """Indices (f,) of the parameters that are fitted to a window."""
        return self.places(self.scale_names)

    def cold_starts(self, window: Window, parameters: Array) -> list[Array]:
        """Start parameters (p,) with unknowns derived from the loop of a window."""
        places = self.unknown_indices
        found = np.clip(self.starts(LoopReading.of(window)), *self.bounds)
        starts = np.tile(parameters, (len(found), 1))
        starts[:, places] = found[:, places]
        return list(starts)

    # Laws over operating points

    @abstractmethod
    def coefficients_at(
        self, parameters: Array, peak_velocity: ArrayLike, current: ArrayLike
    ) -> Array:
        """Operating-point coefficients (c, n) of parameters (p,) at n peak velocities and currents.

        Peak velocities are in m/s, currents in A. The rows follow ``coefficient_names``.
        """

    @abstractmethod
    def coefficient_gradient(
        self, parameters: Array, peak_velocity: float, current: float
    ) -> Array:
        """Derivatives (c, p) of the coefficients at one operating point by the parameters."""

    def without_dependence(self, parameters: Array, top_current: float) -> Array:
        """The set (p,) whose coefficients depend on neither peak velocity nor current.

        A search can add a smooth dependence on currents up to ``top_current`` [A].
        """
        values = np.array(parameters, dtype=float)
        values[self.places(self.shape_names)] = 0.0
        return values

    @abstractmethod
    def plausible_ranges(
        self, windows: Sequence[Window], top_velocity: float, top_current: float
    ) -> dict[str, tuple[float, float]]:
        """Plausible ranges of the shape parameters, by name.

        The data reach up to ``top_velocity`` [m/s] and ``top_current`` [A].
        """

    def typical_sizes(self, windows: Sequence[Window]) -> Array:
        """Typical sizes (p,) of the parameters for these windows, by their units."""
        readings = [LoopReading.of(window) for window in windows]
        return np.array(
            [
                np.median([reading.size(parameter.unit) for reading in readings])
                for parameter in self.parameters
            ]
        )

    def searched_laws(self, free: frozenset[str]) -> int:
        """Number of laws that need a nonlinear search for these free parameters."""
        return 0

    @abstractmethod
    def fit_laws(
        self, table: CoefficientTable, start: Array, free: frozenset[str], search: LawSearch
    ) -> Array:
        """Parameters (p,) whose laws fit the table best; only ``free`` ones differ from the start.

        ``search`` minimises over the nonlinear parameters.
        """

    @abstractmethod
    def draw_shape(
        self, rng: np.random.Generator, top_velocity: float, top_current: float
    ) -> dict[str, float]:
        """Random plausible shape parameters for a damper used up to these limits [m/s], [A]."""


class WindowForces:
    """Force of a law at the samples of windows, and its derivatives, for repeated evaluation.

    ``exact`` gives the derivatives (n, c) of the force of a window by the parameters at columns.
    Without it they are forward differences; ``differences`` counts the evaluations for them.
    """

    def __init__(
        self,
        model: Model,
        windows: Sequence[Window],
        exact: Callable[[Window, Array, Sequence[int]], Array] | None = None,
    ) -> None:
        self.model = model
        self.windows = tuple(windows)
        self._exact = exact
        self.differences = 0

    def forces(self, parameters: Array) -> list[Array]:
        """Force (..., n) [N] of each window, for parameters (..., p)."""
        return [self.model.window_force(window, parameters) for window in self.windows]

    def derivatives(self, parameters: Array, columns: Sequence[int]) -> list[Array]:
        """Derivatives (n, c) of the force of each window by the parameters at c ``columns``."""
        if self._exact is not None:
            return [self._exact(window, parameters, columns) for window in self.windows]
        values, places = parameters[columns], np.arange(len(columns))
        steps = DIFFERENCE * np.maximum(np.abs(values), NOTICED * self._sizes[columns])
        steps = np.where(values + steps > self.model.bounds[1][columns], -steps, steps)
        moved = np.tile(parameters, (len(columns) + 1, 1))
        moved[1 + places, columns] += steps
        found = []
        # Windows are processed one by one, because all at once would need several times the memory.
        for window in self.windows:
            forces = self.model.window_force(window, moved)
            self.differences += len(moved)
            found.append((forces[1:] - forces[0]).T / steps)
        return found

    @cached_property
    def _sizes(self) -> Array:
        return self.model.typical_sizes(self.windows)


class CurrentResponse(ABC):
    """The force of one parameter set as a function of the coil current [A], for an inverse.

    It does not include the lag of the coil: the inverse gives the coil current, and the supply
    current is computed separately. Each sample comes ``period`` [s] after the same ``state``.
    """

    @abstractmethod
    def forces(
        self, samples: Sequence[MotionSample], current: Array, period: float, state: State | None
    ) -> Array:
        """Force (n, m) [N] of n samples at currents (n, m) or (m,) [A]."""

    def at(
        self, sample: MotionSample, period: float, state: State | None
    ) -> Callable[[float], float]:
        """A function that gives the force [N] of one sample at a current [A], in scalar code."""
        return lambda current: float(
            self.forces([sample], np.array([current]), period, state)[0, 0]
        )
