"""Emulated rigs: a damper with known parameters in a test machine or in a plant, heat and noise.

A rig produces samples on request and uses no wall clock. The samples depend on the settings and
the seed, but not on the block size.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from mr_damper_ros.control.inverse_model import in_coil
from mr_damper_ros.control.linear_plant import LinearPlant, MovingPlant
from mr_damper_ros.emulation.faults import Fault, Samples, changed, moved
from mr_damper_ros.emulation.motions import Excitation, is_sine
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import MEMORY, PeakVelocity, peak_velocity
from mr_damper_ros.models.first_order_lag import coil_current
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import State
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock
from mr_damper_ros.signals.recording import DEFAULT_START_NS, Recording

THESIS_FORCE_NOISE = 5.53
"""Standard deviation [N] of the force residual after the fit in the thesis (section 4.6)."""

_COLD, _HOT = 28.0, 71.0
"""Temperatures [°C] at which the thesis identified its damper."""

CHUNK = 100
"""Number of samples that have the same temperature and are computed with one draw of noise.

This number is fixed, so that the samples do not depend on the block size.
"""


def scaled(parameters: Array, factor: float) -> Array:
    """Parameters (16,) of a damper with ``factor`` times the force of ``parameters``."""
    values = np.array(parameters, dtype=np.float64)
    values[PARAMETER_NAMES.index("f0")] *= factor
    return values


class Damper(Protocol):
    """The damper in the test machine."""

    def force(self, motion: Motion, current: Array, celsius: float, period: float) -> Array:
        """Force [N], shape (n,), of the next samples, ``period`` [s] apart.

        The displacement is relative to the centre of the motion.
        """


class EmulatedDamper:
    """A damper of any law whose force changes linearly from 28 °C to 71 °C.

    ``cold`` is its set at 28 °C, or the values (16,) of the sigmoid law. ``hot`` is a factor on the
    gain parameters at 71 °C, or the set at 71 °C. With two sets, *forces* are interpolated, not
    parameters, because the sets may belong to different local minima. The damper keeps the state of
    its law. ``built_in``: whether the damper is part of a plant. Its force then does not jump at
    reversals, it has no lag of the coil, which the plant adds, and its peak velocity is limited to
    the range of its set.
    """

    def __init__(
        self,
        cold: ParameterSet | Array,
        hot: ParameterSet | Array | float = 1.0,
        *,
        built_in: bool = False,
    ) -> None:
        first = cold if isinstance(cold, ParameterSet) else ParameterSet(cold)
        self._law = first.law.continuous if built_in else first.law
        self._range = first.held_range if built_in else None
        self._values = [in_coil(first) if built_in else first.values]
        self._factor = hot if isinstance(hot, (int, float)) else 1.0
        if not isinstance(hot, (int, float)):
            self._values.append(hot.values if isinstance(hot, ParameterSet) else hot)
        self._states: list[State | None] = [None] * len(self._values)
        self._celsius, self._weight, self._now = math.nan, 0.0, self._values

    def force(self, motion: Motion, current: Array, celsius: float, period: float) -> Array:
        """Force [N], shape (n,), of the next samples, ``period`` [s] apart."""
        if celsius != self._celsius:
            self._celsius = celsius
            self._weight = min(max((celsius - _COLD) / (_HOT - _COLD), 0.0), 1.0)
            if self._factor != 1.0:
                values = self._values[0].copy()
                gains = self._law.strength_indices
                values[gains] *= 1.0 + self._weight * (self._factor - 1.0)
                self._now = [np.clip(values, *self._law.bounds)]
        held = motion if self._range is None else motion.held_within(*self._range)
        forces = []
        for place, values in enumerate(self._now):
            force, self._states[place] = self._law.follow(
                values, held, current, period, self._states[place]
            )
            forces.append(force)
        return forces[0] + self._weight * (forces[-1] - forces[0])


@dataclass(frozen=True)
class ThermalModel(CheckedSettings):
    """A lumped heat capacity, heated by the dissipated power and cooled by the ambient air.

    The defaults are assumed: about one kilogram of steel that settles some 50 K above the ambient
    air at 25 W, with a time constant of 14 minutes.
    """

    ambient_temperature: float = option(
        22.0,
        "Ambient temperature [°C]. It can be changed while the rig runs.",
        within=(-50.0, 200.0),
        read_only=False,
    )
    initial_temperature: float = option(
        28.0, "Temperature of the damper at the start [°C].", within=(-50.0, 200.0)
    )
    heat_capacity: float = option(
        430.0,
        "Heat capacity of the damper [J/K], which absorbs the dissipated power. With a smaller "
        "value, the damper heats up faster.",
        within=(0.1, 1e9),
    )
    conductance: float = option(0.5, "Heat loss to the air [W/K]; 0.0: none.", within=(0.0, 1e4))

    def after(self, celsius: float, power: float, duration: float) -> float:
        """Temperature [°C] after constant ``power`` [W] for ``duration`` [s]; exact."""
        if self.conductance == 0.0:
            return celsius + power * duration / self.heat_capacity
        settled = self.ambient_temperature + power / self.conductance
        return settled + (celsius - settled) * math.exp(
            -self.conductance * duration / self.heat_capacity
        )


class CurrentSchedule:
    """Current [A] in steps: each value holds from its time [s] until the next time.

    The first value also holds before its time.

    Raises ValueError if the schedule is empty, the times do not increase, or a value is not
    finite.
    """

    def __init__(self, times: Sequence[float], currents: Sequence[float]) -> None:
        self.times, self.currents = times, currents
        if len(self.times) == 0 or len(self.times) != len(self.currents):
            raise ValueError(
                f"the current's schedule has {len(self.times)} times and {len(self.currents)} "
                "currents: give equal numbers of both, and at least one"
            )
        if not np.isfinite([*self.times, *self.currents]).all():
            raise ValueError("the current's schedule holds a value that is not finite")
        if not (np.diff(self.times) > 0.0).all():
            raise ValueError("the times of the current's schedule must increase")

    @classmethod
    def constant(cls, current: float) -> CurrentSchedule:
        """A schedule of constant current [A]."""
        return CurrentSchedule((0.0,), (current,))

    def at(self, time: Array) -> Array:
        """Current [A] at the times [s], shape (n,)."""
        # With the margin, a sample at a step has the new current in spite of rounding errors.
        index = np.searchsorted(self.times, time + 1e-9, side="right") - 1
        return np.asarray(self.currents, dtype=np.float64)[np.maximum(index, 0)]


class SupplySetpoint(CurrentSchedule):
    """The setpoint of a supply: a current schedule that grows while the rig runs."""

    times: list[float]
    currents: list[float]

    def __init__(self, current: float = 0.0) -> None:
        super().__init__([0.0], [current])

    def set(self, time: float, current: float) -> None:
        """Supply this current [A] from ``time`` [s] on, but not before the previous change."""
        if current != self.currents[-1]:
            # Only the latest setpoint of the past is needed.
            del self.times[:-1], self.currents[:-1]
            self.times.append(max(time, math.nextafter(self.times[-1], math.inf)))
            self.currents.append(current)


@dataclass(frozen=True)
class RigSettings(CheckedSettings):
    """Sampling and white Gaussian noise of an emulated rig.

    ``seed`` is one integer or several; ``start_ns`` is the stamp of the first sample [ns].
    """

    sample_rate: float = option(1000.0, "Samples per second [Hz].", within=(1.0, 100_000.0))
    force_noise: float = option(
        THESIS_FORCE_NOISE,
        f"Standard deviation of the force noise [N]; {THESIS_FORCE_NOISE} is the residual error "
        "reported in the thesis.",
        within=(0.0, 1e6),
    )
    displacement_noise: float = option(
        0.0, "Standard deviation [m] of the displacement noise.", within=(0.0, 0.1)
    )
    seed: int | Sequence[int] = 0
    start_ns: int = DEFAULT_START_NS

    @property
    def period(self) -> float:
        """Time between two samples [s]."""
        return 1.0 / self.sample_rate


@dataclass(frozen=True, eq=False)
class PlantMotion:
    """True, unmeasured quantities at the samples of a block.

    ``states`` of the plant and their derivatives ``rates`` have shape (n, states). The others have
    shape (n,): the ``force`` of one damper [N], the ``velocity`` of its extension [m/s] and the
    current in its ``coil`` [A].
    """

    states: Array
    rates: Array
    force: Array
    velocity: Array
    coil: Array


class MeasuredRig(ABC):
    """Base class of emulated rigs, which produce blocks of samples.

    ``current`` is a schedule or one value [A]. Without a ``thermal`` model, the temperature stays
    at 28 °C, the temperature of the cold damper in the thesis.
    """

    live = True
    """Whether samples are computed only when they are requested.

    Commands then take effect at once, at the expense of computing time. If not, the rig computes
    whole chunks in advance.
    """

    def __init__(
        self,
        damper: Damper,
        current: CurrentSchedule | float,
        settings: RigSettings | None,
        thermal: ThermalModel | None,
    ) -> None:
        # A damper may have a state, so each rig has its own copy.
        self._damper = deepcopy(damper)
        self._current = (
            current
            if isinstance(current, CurrentSchedule)
            else CurrentSchedule.constant(float(current))
        )
        self.settings = settings or RigSettings()
        """Sampling and noise."""
        self._thermal = thermal
        self._celsius = thermal.initial_temperature if thermal else _COLD
        self._rng = np.random.default_rng(self.settings.seed)
        self._noise, self._power = np.empty((2, CHUNK)), np.empty(CHUNK)
        self._made = self._taken = 0
        self._ready = np.empty((4, 0))
        self.motion: PlantMotion | None = None
        """True quantities of the last block of a plant."""

    def next_block(self, count: int) -> RigBlock:
        """The next ``count`` samples; raises ValueError if ``count`` is less than one."""
        if count < 1:
            raise ValueError(f"{count} samples were requested: request at least one")
        parts, first = [self._ready], self._taken
        self._taken += count
        while self._made < self._taken:
            left = CHUNK - self._made % CHUNK
            parts.append(self._next(min(left, self._taken - self._made) if self.live else left))
        rows = np.concatenate(parts, axis=1)
        self._ready = rows[:, count:]
        period = self.settings.period
        start_ns = self.settings.start_ns + round(first * period * NANOSECONDS)
        return RigBlock(start_ns, first, period, *rows[:, :count])

    def _next(self, count: int) -> Array:
        """The next rows of a :class:`RigBlock`, shape (4, count), within one chunk."""
        period, begin = self.settings.period, self._made % CHUNK
        part = slice(begin, begin + count)
        if begin == 0:
            self._noise = self._rng.standard_normal((2, CHUNK))
        time = np.arange(self._made, self._made + count, dtype=np.float64) * period
        current, celsius = self._current.at(time), np.full(count, self._celsius)
        displacement, force, self._power[part] = self._true(time, current)
        self._made += count
        if self._thermal is not None and self._made % CHUNK == 0:
            power = float(np.mean(self._power))
            self._celsius = self._thermal.after(self._celsius, power, CHUNK * period)
        force_noise, displacement_noise = self._noise[:, part]
        displacement = displacement + self.settings.displacement_noise * displacement_noise
        force = force + self.settings.force_noise * force_noise
        return np.stack([displacement, force, current, celsius])

    @abstractmethod
    def _true(self, time: Array, current: Array) -> tuple[Array, Array, Array]:
        """Displacement [m], force [N] and dissipated power [W], each (n,), at the next samples.

        ``time`` [s] and the supply ``current`` [A] have shape (n,); the samples lie in one chunk.
        """


class EmulatedRig(MeasuredRig):
    """A damper in a test machine with prescribed motion.

    The rig measures the current of the supply. The current in the coil follows it with a lag of
    ``coil_time_constant`` [s]. The rig applies the ``faults`` of the machine and the damper;
    :class:`Instruments` applies the faults of instruments and transmission.
    """

    def __init__(
        self,
        damper: Damper,
        excitation: Excitation,
        current: CurrentSchedule | float,
        *,
        settings: RigSettings | None = None,
        thermal: ThermalModel | None = None,
        faults: Sequence[Fault] = (),
        coil_time_constant: float = 0.0,
    ) -> None:
        super().__init__(damper, current, settings, thermal)
        self._excitation = excitation
        self._coil = np.array(coil_time_constant)
        self._coil_state: State = ()
        self._faults: list[Fault] = []
        self._peak: PeakVelocity | None = None
        self.live = False
        self.add_faults(faults)

    def add_faults(self, faults: Sequence[Fault]) -> None:
        """Add faults; each must begin after the samples produced so far."""
        own = deepcopy(list(faults))
        self._change_motion(self._excitation, own)
        self._faults += own

    def move(self, excitation: Excitation) -> None:
        """Change the motion from the next samples on; it must smoothly continue the present one."""
        self._change_motion(excitation, self._faults)

    def _change_motion(self, excitation: Excitation, faults: Sequence[Fault]) -> None:
        before = self._excitation
        excitation = moved(faults, excitation)
        if is_sine(excitation):
            self._peak = None
        elif self._peak is None:
            # The peak velocity is that of a motion that has been running for a long time.
            period = self.settings.period
            past = np.arange(-round(MEMORY / period), 0, dtype=np.float64) + self._made
            _, velocity, acceleration = before.at(past * period)
            self._peak = PeakVelocity(period)
            self._peak.follow(velocity, acceleration)
        self._excitation = excitation

    def supply(self, current: CurrentSchedule) -> None:
        """Follow this schedule from the next samples on; the past must be unchanged."""
        self._current = current

    def set_ambient(self, ambient: float) -> None:
        """Set the ambient temperature [°C]; without a thermal model, this has no effect."""
        if self._thermal is not None:
            self._thermal = replace(self._thermal, ambient_temperature=ambient)

    def record(
        self, duration: float, *, name: str = "emulated", details: dict[str, str] | None = None
    ) -> Recording:
        """The next ``duration`` [s] as a recording.

        Raises ValueError if the duration holds no sample.
        """
        block = self.next_block(round(duration * self.settings.sample_rate))
        temperature = block.temperature if self._thermal else None
        rows = block.displacement, block.force, block.current, temperature
        return Recording(name, block.start_ns, block.period, *rows, details or {})

    def _true(self, time: Array, current: Array) -> tuple[Array, Array, Array]:
        period = self.settings.period
        if is_sine(self._excitation) != (self._peak is None):
            # A command has changed the kind of motion.
            self._change_motion(self._excitation, ())
        kinematics = self._excitation.at(time)
        displacement, velocity, acceleration = kinematics
        centred = displacement - self._excitation.centre
        v_m = (
            peak_velocity(centred, velocity, acceleration)
            if self._peak is None
            else self._peak.follow(velocity, acceleration)
        )
        motion = Motion(centred, velocity, acceleration, v_m, sine=None)
        fed = changed(self._faults, "coil", Samples(time, current, period, kinematics))
        coil, self._coil_state = coil_current(fed, self._coil, period, self._coil_state)
        force = self._damper.force(motion, coil, self._celsius, period)
        true_force = changed(self._faults, "force", Samples(time, force, period, kinematics))
        return displacement, true_force, true_force * velocity


_ACCELERATION_MEMORY = 0.008
"""Time constant [s] of the low-pass filter of the acceleration for the peak velocity.

The force depends on the peak velocity, and the acceleration depends on the force. The filter breaks
    this algebraic loop. Observers of recorded motion also smooth the acceleration.
"""


class Surroundings(Protocol):
    """The external input of a plant as a function of time, such as a road or the ground."""

    def at(self, time: Array) -> Array:
        """The input (n,) at the times (n,) [s]; for a road, its vertical velocity [m/s]."""


class PlantRig(MeasuredRig):
    """A damper in a plant.

    Each sample period has ``substeps`` steps. The force of the damper is computed at every step and
    held during it; for this held force, the solution of the plant is exact. The current in the coil
    follows the supply with a lag of ``coil_time_constant`` [s].
    """

    def __init__(
        self,
        damper: Damper,
        plant: LinearPlant,
        surroundings: Surroundings,
        current: CurrentSchedule | float,
        *,
        settings: RigSettings | None = None,
        thermal: ThermalModel | None = None,
        coil_time_constant: float = 0.0,
        substeps: int = 4,
    ) -> None:
        super().__init__(damper, current, settings, thermal)
        self._surroundings = surroundings
        self._substeps = substeps
        self._step = self.settings.period / substeps
        self.plant = MovingPlant(plant, self._step)
        """The plant in its present state."""
        self._peak = PeakVelocity(self._step)
        decay = math.exp(-self._step / coil_time_constant) if coil_time_constant > 0.0 else 0.0
        self._coil_decay, self._coil = decay, float(self._current.at(np.zeros(1))[0])
        self._force = self._acceleration = 0.0
        self._share = -math.expm1(-self._step / _ACCELERATION_MEMORY)
        self._inputs: list[list[float]] = []
        self._moved: list[tuple[Array, Array, float, float, float]] = []

    def next_block(self, count: int) -> RigBlock:
        """The next ``count`` samples."""
        self._moved = []
        block = super().next_block(count)
        self.motion = PlantMotion(*map(np.array, zip(*self._moved, strict=True)))
        return block

    def _true(self, time: Array, current: Array) -> tuple[Array, Array, Array]:
        begin = self._made % CHUNK
        if begin == 0:
            steps = np.arange(CHUNK * self._substeps, dtype=np.float64)
            inputs = self._surroundings.at((steps + self._made * self._substeps) * self._step)
            self._inputs = inputs.reshape(CHUNK, self._substeps).tolist()
        rows = np.empty((3, time.size))
        for place, supplied in enumerate(current.tolist()):
            heat = sum([self._step_on(supplied, moved) for moved in self._inputs[begin + place]])
            now = self.plant.damper
            rows[:, place] = now.displacement, self._force, heat / self.settings.period
            self._moved.append(
                (self.plant.state, self.plant.rates, self._force, now.velocity, self._coil)
            )
        displacement, force, power = rows
        return displacement, force, power

    def _step_on(self, supplied: float, moved: float) -> float:
        """Advance by one step with a supply current [A] and an input; returns the heat [J]."""
        now = self.plant.damper
        self._coil = supplied + (self._coil - supplied) * self._coil_decay
        self._acceleration += self._share * (now.acceleration - self._acceleration)
        velocity, acceleration = np.array([now.velocity]), np.array([self._acceleration])
        peak = self._peak.follow(velocity, acceleration)
        motion = Motion(np.array([now.displacement]), velocity, acceleration, peak, sine=None)
        coil = np.array([self._coil])
        self._force = float(self._damper.force(motion, coil, self._celsius, self._step)[0])
        self.plant.step(self._force, moved)
        return self._force * now.velocity * self._step


HOT_FORCE = 989.0 / 1332.0
"""Force of the damper in the thesis at 71 °C, relative to its force at 28 °C.

Tables 8 and 9, at 5 mm, 1 Hz and 1.5 A.
"""

HIGHEST_CURRENT = 1.6

_VALUES = (
    *(40.0, -0.35, -0.25, 900.0, 2.5, 4.0, 3.0, 2.0),
    *(9.0, 4.0, 6.0, 18.0, -0.45, -0.11, 0.06, 0.012),
    *(3e-08, 2000.0, -40.0),
)
"""Values of the law ``sigmoid_lag``, without the time constant of the coil."""


def invented_damper(coil_time_constant: float) -> ParameterSet:
    """Parameter set of an invented damper at 28 °C, with the given coil time constant [s]."""
    return ParameterSet(
        np.array([*_VALUES, coil_time_constant]),
        set_id="invented",
        peak_velocity_range=(0.0, 2.0),
        current_range=(0.0, HIGHEST_CURRENT),
        model="sigmoid_lag",
    )
