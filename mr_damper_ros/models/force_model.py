"""What every force model of an MR damper says of itself, and what follows from it for all alike.

A model is one class in one file of this room: its parameters with units and bounds, its force with
what that remembers, starts read off a record, and, where it has more to say than what this class
derives, the problem of a window and its laws over operating points. Nothing outside of this room
asks which model it is. A stream is the force of a motion that goes on, block by block.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.motion import Motion, MotionSample
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.formulas import WrittenLaw
from mr_damper_ros.models.machine_code import as_machine_code
from mr_damper_ros.models.quantities import (
    CoefficientTable,
    LawSearch,
    LoopReading,
    Parameter,
    Quantity,
    SearchEffort,
    State,
)
from mr_damper_ros.signals.arrays import Array

_FORGOTTEN = 0.01
"""A start is forgotten where it changes the force by less than this part of its span."""

_STEP = 1e-6
"""Step of a difference, relative to the size of the parameter."""

_SMALLEST = 0.1
"""A parameter counts as no smaller than this part of its typical size, for a difference."""

_KEPT = 0.5
"""Seconds of motion from which a state is found anew: a lag forgets sooner. A hysteresis forgets
with the way: so much more is kept as its model asks for."""

_LONGEST_KEPT = 30.0
"""Seconds; a damper that hardly moves would else be remembered for ever."""

_TOGETHER = 500
"""Samples that are followed at once where the past is: sample by sample half a minute takes ten
seconds, which no stream waits for."""

_USUAL_RUN = LoopReading(1000.0, 0.0, 2.0 * np.pi * 1.0 * 5e-3, 5e-3)
"""A usual run: 1 kN, 5 mm, 1 Hz."""


class Model(ABC):
    """A force law.

    ``parameters`` stand in the order of every parameter array (p,). ``free_in_one_run`` names those
    that one run at one current determines (all where it is empty); the others keep the values of a
    start. ``remembers``: whether the force depends on the samples before. ``turning``: arrays of
    the state, the first ones, that only matter where the motion turns. ``strength`` names the
    parameters that rise and fall with the strength of the damper; where none are named, all that
    have a force in their unit. ``effort``: how far a window is searched.
    ``coefficient_quantities``: what the force depends on at one operating point; ``linear`` names
    what enters the laws over operating points linearly, ``shape_groups`` the shape parameters, law
    by law.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    source: ClassVar[str]
    equation: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    free_in_one_run: ClassVar[tuple[str, ...]] = ()
    remembers: ClassVar[bool] = False
    turning: int = 0
    strength: ClassVar[tuple[str, ...]] = ()
    effort: ClassVar[SearchEffort] = SearchEffort()
    coefficient_quantities: ClassVar[tuple[Quantity, ...]] = ()
    linear: ClassVar[tuple[str, ...]] = ()
    shape_groups: ClassVar[tuple[tuple[str, ...], ...]] = ()

    # What a law must say

    @abstractmethod
    def follow(
        self, parameters: Array, motion: Motion, current: Array, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force (..., n) [N], and the state after the last sample.

        For parameters (..., p), a motion and currents (n,) [A], the ``period`` [s] between samples
        and the state after the sample before.
        """

    @abstractmethod
    def starts(self, reading: LoopReading) -> Array:
        """Starts (k, p) of a search, from what can be read off a record."""

    @abstractmethod
    def current_response(self, parameters: Array) -> CurrentResponse:
        """Force of a set (p,) over the current in the coil."""

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
        """What the force depends on at one operating point; none for a model that does not say."""
        return tuple(quantity.name for quantity in self.coefficient_quantities)

    def places(self, names: Sequence[str]) -> np.ndarray:
        """Places of the named parameters in a parameter array."""
        every = self.parameter_names
        return np.array([every.index(name) for name in names], dtype=int)

    @property
    def simpler(self) -> Model | None:
        """The law that this one contains as a special case; None where it contains none."""
        return None

    def to_simpler(self, values: Array) -> Array:
        """The parameters of the simpler law that come nearest to these (p,)."""
        return values

    def from_simpler(self, simple: Array) -> Array:
        """The set (p,) with the force of parameters of the simpler law."""
        return simple

    def completed(self, values: Array) -> Array:
        """The values (p,), where those at the end are left out that have a default."""
        left_out = [parameter.default for parameter in self.parameters[values.shape[0] :]]
        known = [default for default in left_out if default is not None]
        return values if len(known) < len(left_out) else np.append(values, known)

    @property
    def free_indices(self) -> np.ndarray:
        """Places (f,) of the parameters that one run determines."""
        return self.places(self.free_in_one_run or self.parameter_names)

    @property
    def scale_names(self) -> tuple[str, ...]:
        """The parameters that a coefficient is proportional to: they have no range of their own."""
        return self.free_in_one_run or self.parameter_names

    @property
    def common_names(self) -> tuple[str, ...]:
        """What one run determines besides the scales, such as a compliance: common to all runs."""
        return tuple(name for name in self.free_in_one_run if name not in self.scale_names)

    @property
    def shape_names(self) -> tuple[str, ...]:
        """The parameters that only several operating points determine."""
        free = self.free_in_one_run or self.parameter_names
        return tuple(name for name in self.parameter_names if name not in free)

    def knows_speeds(self, observable: np.ndarray) -> bool:
        """Whether the flags (p,) hold a parameter that only several peak velocities determine."""
        pairs = zip(self.parameters, observable, strict=True)
        return any(parameter.peak_velocities > 1 and seen for parameter, seen in pairs)

    def knows_currents(self, observable: np.ndarray) -> bool:
        """Whether the flags (p,) hold a parameter that only several currents determine."""
        pairs = zip(self.parameters, observable, strict=True)
        return any(parameter.currents > 1 and seen for parameter, seen in pairs)

    @property
    def strength_indices(self) -> np.ndarray:
        """Places of the parameters that rise and fall with the strength of the damper."""
        names = self.strength or self.parameter_names
        forces = [p.name in names and p.unit.startswith("N") for p in self.parameters]
        return np.flatnonzero(forces)

    def initial_values(self) -> tuple[Array, str, float]:
        """Values (p,) where nothing is known of the damper, their name, their peak velocity [m/s].

        A mere form without any force, valid nowhere, unless the model has a better one.
        """
        values = self.starts(_USUAL_RUN)[0]
        values[self.strength_indices] = 0.0
        return np.clip(values, *self.bounds), "start", 0.0

    # Force

    @property
    def continuous(self) -> Model:
        """The law without the jumps that it has and no damper; itself where it has none."""
        return self

    def force(
        self, parameters: ArrayLike, motion: Motion, current: ArrayLike, period: float
    ) -> Array:
        """Force [N], shape (..., n), for parameters of shape (..., p), from a start.

        ``current`` [A] is a number or has shape (n,). Raises ValueError where the number of
        parameters is wrong or the period is not positive.
        """
        return self.stream(period).follow(parameters, motion, current)

    def stream(self, period: float) -> ForceStream:
        """Force of samples ``period`` [s] apart, block by block; ValueError as for the force."""
        return ForceStream(self, period)

    # A set may hold any finite numbers: what overflows, here and below, is judged by its misfit.
    @as_machine_code()
    @np.errstate(over="ignore", invalid="ignore")
    def window_force(self, window: Window, parameters: Array) -> Array:
        """Force [N] at the samples of a window, shape (..., n), for parameters (..., p)."""
        if not (self.remembers or self.turning):
            return self.force(parameters, window.motion, window.current, 1.0)
        # The branch changes as steeply as the law itself.
        history = window.history if self.turning else window.history.coarse
        along = parameters, history.motion, history.current, history.period
        force, state = self.follow(*along, None)
        if history.periodic:
            force, _ = self.follow(*along, state)
        return np.moveaxis(history.at_samples(np.moveaxis(force, -1, 0)), 0, -1)

    @as_machine_code()
    @np.errstate(over="ignore", invalid="ignore")
    def settled(self, window: Window, parameters: Array | None) -> np.ndarray:
        """Mask (n,) of samples whose force does not depend on what came before the window.

        For parameters (p,), or None where no set is known yet.
        """
        if parameters is None or not (self.remembers or self.turning) or window.history.periodic:
            return np.ones(window.sample_count, dtype=bool)
        history = window.history.coarse
        along = parameters, history.motion, history.current, history.period
        first, state = self.follow(*along, None)
        second, _ = self.follow(*along, state)
        differs = np.abs(first - second) > _FORGOTTEN * float(np.ptp(first))
        # The true past may be further off than either of the two.
        count = 2 * int(np.max(np.flatnonzero(differs), initial=-1) + 1)
        return ~history.unsettled(count * history.period)

    def memory_length(self, parameters: Array, current: float) -> float:
        """Way [m] after which the past is forgotten; 0 for a law that forgets it with time alone.

        For parameters (p,) at a current [A].
        """
        return 0.0

    def needs_past(self, window: Window) -> bool:
        """Whether the force at the samples of a window depends on what went on between them."""
        return self.remembers

    def lasting_force(self, window: Window, parameters: Array) -> Array:
        """The part (n,) [N] of the force that stays where the damper loses all its strength."""
        weakest = parameters.copy()
        weakest[self.strength_indices] = 0.0
        return self.window_force(window, np.clip(weakest, *self.bounds))

    @property
    def formulas(self) -> WrittenLaw | None:
        """The law for other languages; None where it was not written down for them."""
        return None

    def window_forces(self, windows: Sequence[Window]) -> WindowForces:
        """Force at the samples of some windows, and its derivatives by the parameters."""
        return WindowForces(self, windows)

    # The unknowns of one window: as they are, the parameters that it determines

    @cached_property
    def unknown_indices(self) -> np.ndarray:
        """Places (f,) of the parameters that a window is fitted with."""
        return self.places(self.scale_names)

    @cached_property
    def _unknown_bounds(self) -> tuple[Array, Array]:
        low, high = self.bounds
        return low[self.unknown_indices], high[self.unknown_indices]

    @property
    def strong_unknowns(self) -> np.ndarray:
        """Mask (f,) of the unknowns that rise and fall with the strength of the damper."""
        return np.isin(self.unknown_indices, self.strength_indices)

    def unknowns(self, parameters: Array) -> Array:
        """Those (f,) of parameters (p,), within their bounds."""
        return np.clip(parameters[self.unknown_indices], *self._unknown_bounds)

    def with_unknowns(self, parameters: Array, unknowns: Array) -> Array:
        """Parameters (..., p) with these unknowns (..., f), all else as in ``parameters`` (p,)."""
        values = np.empty((*unknowns.shape[:-1], parameters.size))
        values[...] = parameters
        values[..., self.unknown_indices] = np.clip(unknowns, *self._unknown_bounds)
        return values

    def by_unknowns(self, unknowns: Array, derivatives: Array) -> Array:
        """Derivatives (n, f) by the unknowns (f,), from those (n, f) by the parameters."""
        return derivatives

    def fitted_errors(self, unknowns: Array, covariance: Array) -> tuple[np.ndarray, Array]:
        """Places of the parameters that a window was fitted with, and their standard errors.

        For unknowns (f,) with this ``covariance`` (f, f). NaN where the window does not determine
        one.
        """
        return self.unknown_indices, np.sqrt(np.diag(covariance))

    def cold_starts(self, window: Window, parameters: Array) -> list[Array]:
        """Parameters (p,) with unknowns that are read off a window, to start a search from."""
        starts = np.clip(self.starts(LoopReading.of(window)), *self.bounds)
        places = self.unknown_indices
        return [self.with_unknowns(parameters, read[places]) for read in starts]

    # Laws over operating points

    @abstractmethod
    def coefficients_at(
        self, parameters: Array, peak_velocity: ArrayLike, current: ArrayLike
    ) -> Array:
        """Operating-point coefficients (c, n) of parameters (p,) at n peak velocities and currents.

        [m/s] and [A]; those of ``coefficient_names``, none for a model without.
        """

    @abstractmethod
    def coefficient_gradient(
        self, parameters: Array, peak_velocity: float, current: float
    ) -> Array:
        """Derivatives (c, p) of the coefficients at one operating point by the parameters."""

    def without_dependence(self, parameters: Array, top_current: float) -> Array:
        """The set (p,) with coefficients that depend on neither peak velocity nor current.

        Where a dependence is freed it starts smoothly over currents up to ``top_current`` [A].
        """
        values = np.array(parameters, dtype=float)
        values[self.places(self.shape_names)] = 0.0
        return values

    @abstractmethod
    def plausible_ranges(
        self, windows: Sequence[Window], top_velocity: float, top_current: float
    ) -> dict[str, tuple[float, float]]:
        """Plausible ranges of the parameters that are no scales, for data that reach so far.

        ``top_velocity`` [m/s], ``top_current`` [A].
        """

    def typical_sizes(self, windows: Sequence[Window]) -> Array:
        """Typical sizes (p,) of the parameters, by their units, for these windows."""
        readings = [LoopReading.of(window) for window in windows]
        return np.array(
            [
                np.median([reading.size(parameter.unit) for reading in readings])
                for parameter in self.parameters
            ]
        )

    def searched_laws(self, free: frozenset[str]) -> int:
        """How many laws need a search for these free parameters: the others are linear."""
        return 0

    @abstractmethod
    def fit_laws(
        self,
        table: CoefficientTable,
        start: Array,
        free: frozenset[str],
        search: LawSearch,
    ) -> Array:
        """Parameters (p,) whose laws come nearest to the table; those not free stay as they are.

        ``search`` minimises over what is not linear.
        """

    def softened(self, parameters: Array, held: np.ndarray, top_current: float) -> Array:
        """The set (p,) with dependences that are not too steep to be moved; ``held`` (p,) stay."""
        return parameters

    @abstractmethod
    def draw_shape(
        self, rng: np.random.Generator, top_velocity: float, top_current: float
    ) -> dict[str, float]:
        """Shape parameters as they might be for a damper run up to [m/s] and [A]."""


class WindowForces:
    """Force of a law at the samples of windows, and its derivatives: made once, evaluated often.

    The derivatives are forward differences, for a law that says no more than its force;
    ``differences`` counts the evaluations that they took.
    """

    def __init__(self, model: Model, windows: Sequence[Window]) -> None:
        self.model = model
        self.windows = tuple(windows)
        self.differences = 0

    def forces(self, parameters: Array) -> list[Array]:
        """Force (..., n) [N] of each window, for parameters (..., p)."""
        return [self.model.window_force(window, parameters) for window in self.windows]

    def derivatives(self, parameters: Array, columns: Sequence[int]) -> list[Array]:
        """Derivatives (n, c) of the force of each window by the parameters (p,) at c places."""
        values, places = parameters[columns], np.arange(len(columns))
        steps = _STEP * np.maximum(np.abs(values), _SMALLEST * self._sizes[columns])
        steps = np.where(values + steps > self.model.bounds[1][columns], -steps, steps)
        moved = np.tile(parameters, (len(columns) + 1, 1))
        moved[1 + places, columns] += steps
        found = []
        # Window by window: all at once would take as much memory as there are parameters.
        for window in self.windows:
            forces = self.model.window_force(window, moved)
            self.differences += len(moved)
            found.append((forces[1:] - forces[0]).T / steps)
        return found

    @cached_property
    def _sizes(self) -> Array:
        return self.model.typical_sizes(self.windows)


class CurrentResponse(ABC):
    """The force of one parameter set as a function of the current in the coil [A], for an inverse.

    The coil's lag is no part of it: an inverse finds the current of the coil, and how the supply
    brings it there is another matter. Samples each follow the same ``state``, ``period`` [s] after
    it: of a law that remembers, ask for one.
    """

    @abstractmethod
    def forces(
        self, samples: Sequence[MotionSample], current: Array, period: float, state: State | None
    ) -> Array:
        """Force (n, m) [N] of n samples at currents (n, m) or (m,) [A]."""

    def at(
        self, sample: MotionSample, period: float, state: State | None
    ) -> Callable[[float], float]:
        """Force [N] of one sample at a current [A], in scalars."""
        return lambda current: float(
            self.forces([sample], np.array([current]), period, state)[0, 0]
        )


class ForceStream:
    """Force of a motion that continues: as in one piece, however it is cut into blocks."""

    def __init__(self, model: Model, period: float) -> None:
        if not period > 0.0:
            raise ValueError(f"the sample period is {period} s: it must be positive")
        self._model = model
        self._period = period
        self._state: State | None = None

    def follow(self, parameters: ArrayLike, motion: Motion, current: ArrayLike) -> Array:
        """Force [N] of the next samples, shape (..., n), for parameters of shape (..., p).

        ``current`` [A] is a number or has shape (n,). The state continues where the parameters
        change. Raises ValueError where the number of parameters is wrong.
        """
        values = np.asarray(parameters, dtype=float)
        count = len(self._model.parameters)
        if values.shape[-1:] != (count,):
            raise ValueError(
                f"model '{self._model.name}' has {count} parameters "
                f"({', '.join(self._model.parameter_names)}): got shape {values.shape}"
            )
        amperes = np.broadcast_to(np.asarray(current, dtype=float), motion.velocity.shape)
        with np.errstate(over="ignore", invalid="ignore"):
            force, self._state = self._model.follow(
                values, motion, amperes, self._period, self._state
            )
        return force
