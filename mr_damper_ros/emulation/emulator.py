"""An emulated test rig: a damper of known parameters, moved, heated, measured with noise.

It knows no wall clock: samples are asked for, and the stream is the same whatever the size of the
blocks. With the same settings and seed it gives the same samples.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from mr_damper_ros.emulation.faults import Fault, at_load_cell, in_coil
from mr_damper_ros.emulation.motions import Excitation, is_sine
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import MEMORY, PeakVelocity, peak_velocity
from mr_damper_ros.models.first_order_lag import coil_current
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.sigmoid.law import (
    PARAMETER_NAMES,
    force_from_coefficients,
    operating_point_coefficients,
)
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS, RigBlock
from mr_damper_ros.signals.recording import DEFAULT_START_NS, Recording

THESIS_FORCE_NOISE = 5.53
"""Standard deviation [N] of the force error after the fit in the thesis (section 4.6)."""

_COLD, _HOT = 28.0, 71.0
"""Temperatures [°C] at which the thesis identified its damper."""

CHUNK = 100
"""Samples of one temperature and one draw of noise; fixed, so that blocks do not matter."""


class EmulatorError(ValueError):
    """Settings of the emulated rig that cannot be used; the message says what to change."""


def scaled(parameters: Array, factor: float) -> Array:
    """Parameters (16,) of a damper whose force is ``factor`` times that of ``parameters``."""
    values = np.array(parameters, dtype=np.float64)
    values[PARAMETER_NAMES.index("f0")] *= factor
    return values


class Damper(Protocol):
    """What is in the machine."""

    def force(self, motion: Motion, current: Array, celsius: float) -> Array:
        """Force [N], shape (n,); the displacement is measured from the centre of the motion."""


@dataclass(frozen=True, eq=False)
class ConstantDamper:
    """A damper that does not mind its temperature; ``parameters`` has shape (16,)."""

    parameters: Array

    def force(self, motion: Motion, current: Array, celsius: float) -> Array:
        """Force [N], shape (n,)."""
        return _force(self.parameters, motion, current)


@dataclass(frozen=True, eq=False)
class TemperatureDependentDamper:
    """A damper known at two temperatures; in between, its *forces* are interpolated linearly.

    ``cold`` and ``hot`` have shape (16,). Parameters of the two may lie in different basins, so
    they are never interpolated themselves. Outside the two temperatures the nearer one holds. For
    a uniform loss of force give ``hot=scaled(cold, 0.74)``.
    Raises EmulatorError where the hot temperature is not above the cold one.
    """

    cold: Array
    hot: Array
    cold_celsius: float = _COLD
    hot_celsius: float = _HOT

    def __post_init__(self) -> None:
        if not self.hot_celsius > self.cold_celsius:
            raise EmulatorError(
                f"the hot temperature, {self.hot_celsius} °C, is not above the cold one, "
                f"{self.cold_celsius} °C"
            )

    def force(self, motion: Motion, current: Array, celsius: float) -> Array:
        """Force [N], shape (n,)."""
        weight = (celsius - self.cold_celsius) / (self.hot_celsius - self.cold_celsius)
        weight = min(max(weight, 0.0), 1.0)
        cold = _force(self.cold, motion, current)
        return cold + weight * (_force(self.hot, motion, current) - cold)


def _force(parameters: Array, motion: Motion, current: Array) -> Array:
    coefficients = operating_point_coefficients(parameters, motion.peak_velocity, current)
    return force_from_coefficients(coefficients, motion.velocity, motion.acceleration)


class ModelDamper:
    """A damper of any model, whose strength changes linearly with its temperature.

    ``hot_force`` is the factor on it at 71 °C, relative to 28 °C. It follows samples ``period``
    [s] apart and remembers their motion as its model does.
    """

    def __init__(self, parameters: ParameterSet, period: float, hot_force: float = 1.0) -> None:
        self._parameters = parameters
        self._stream = parameters.law.stream(period)
        self._hot_force = hot_force

    def force(self, motion: Motion, current: Array, celsius: float) -> Array:
        """Force [N], shape (n,)."""
        weight = float(np.interp(celsius, (_COLD, _HOT), (0.0, 1.0)))
        values = self._parameters.values.copy()
        values[self._parameters.law.strength_indices] *= 1.0 + weight * (self._hot_force - 1.0)
        return self._stream.follow(np.clip(values, *self._parameters.law.bounds), motion, current)


@dataclass(frozen=True)
class ThermalModel:
    """One heat capacity [J/K] that takes the dissipated power and loses heat to the ambient air.

    ``conductance`` [W/K] is that of the convection, ``ambient`` and ``initial`` are in °C. The
    defaults are an assumption: about a kilogram of steel that settles some 50 K above the ambient
    air at 25 W, with a time constant of 14 minutes.
    Raises EmulatorError where a value is out of range.
    """

    ambient: float = 22.0
    initial: float = 28.0
    capacity: float = 430.0
    conductance: float = 0.5

    def __post_init__(self) -> None:
        if not (math.isfinite(self.capacity) and self.capacity > 0.0):
            raise EmulatorError(f"the heat capacity is {self.capacity} J/K: it must be positive")
        if not (math.isfinite(self.conductance) and self.conductance >= 0.0):
            raise EmulatorError(
                f"the conductance is {self.conductance} W/K: it must not be negative"
            )

    def after(self, celsius: float, power: float, duration: float) -> float:
        """Temperature [°C] after ``power`` [W] for ``duration`` [s], exactly for constant power."""
        if self.conductance == 0.0:
            return celsius + power * duration / self.capacity
        settled = self.ambient + power / self.conductance
        return settled + (celsius - settled) * math.exp(
            -self.conductance * duration / self.capacity
        )


@dataclass(frozen=True)
class CurrentSchedule:
    """Current [A] in steps: each holds from its time [s] to the next, the first from the start.

    Raises EmulatorError where there are none, times do not rise, or a value is not finite.
    """

    times: Sequence[float]
    currents: Sequence[float]

    def __post_init__(self) -> None:
        if len(self.times) == 0 or len(self.times) != len(self.currents):
            raise EmulatorError(
                f"the current's schedule has {len(self.times)} times and {len(self.currents)} "
                "currents: give at least one, and as many of each"
            )
        if not np.isfinite([*self.times, *self.currents]).all():
            raise EmulatorError("the current's schedule holds a value that is not finite")
        if not (np.diff(self.times) > 0.0).all():
            raise EmulatorError("the times of the current's schedule must rise")

    @classmethod
    def constant(cls, current: float) -> CurrentSchedule:
        """The same current [A] throughout."""
        return cls((0.0,), (current,))

    def at(self, time: Array) -> Array:
        """Current [A] at the times [s], shape (n,)."""
        # A sample that falls on a step already has the new current, whatever the rounding.
        index = np.searchsorted(self.times, time + 1e-9, side="right") - 1
        return np.asarray(self.currents, dtype=np.float64)[np.maximum(index, 0)]


@dataclass(frozen=True)
class RigSettings:
    """How the emulated rig measures: ``sample_rate`` [Hz], noise [N] and [m], seed, start.

    The noises are standard deviations of white Gaussian noise. ``seed`` is a number or several.
    Raises EmulatorError where a value is out of range.
    """

    sample_rate: float = 1000.0
    force_noise: float = THESIS_FORCE_NOISE
    displacement_noise: float = 0.0
    seed: int | Sequence[int] = 0
    start_ns: int = DEFAULT_START_NS

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sample_rate) and self.sample_rate > 0.0):
            raise EmulatorError(f"the sample rate is {self.sample_rate} Hz: it must be positive")
        for name, value in (
            ("force", self.force_noise),
            ("displacement", self.displacement_noise),
        ):
            if not (math.isfinite(value) and value >= 0.0):
                raise EmulatorError(f"the {name} noise is {value}: it must not be negative")

    @property
    def period(self) -> float:
        """Time between two samples [s]."""
        return 1.0 / self.sample_rate


class MeasuredRig(ABC):
    """A rig that gives samples, at a current that may change from block to block.

    ``current`` is a schedule or one value [A]; without a ``thermal`` model the temperature stays
    at 28 °C, that of the thesis' cold damper.
    """

    def __init__(
        self,
        current: CurrentSchedule | float,
        settings: RigSettings | None,
        thermal: ThermalModel | None,
    ) -> None:
        self._current = (
            current
            if isinstance(current, CurrentSchedule)
            else CurrentSchedule.constant(float(current))
        )
        self.settings = settings or RigSettings()
        """How the rig measures."""
        self._thermal = thermal
        self._celsius = thermal.initial if thermal else _COLD
        self._rng = np.random.default_rng(self.settings.seed)
        self._noise = np.empty((2, CHUNK))
        self._made = 0

    @abstractmethod
    def next_block(self, count: int) -> RigBlock:
        """The next ``count`` samples."""

    def _block(self, first: int, rows: Array) -> RigBlock:
        """Displacement, force, current, temperature (4, n) from sample ``first`` on."""
        period = self.settings.period
        start_ns = self.settings.start_ns + round(first * period * NANOSECONDS)
        return RigBlock(start_ns, first, period, *rows)


class EmulatedRig(MeasuredRig):
    """A damper in a test machine, sample by sample.

    The current in the coil follows that of the supply, which is measured, with
    ``coil_time_constant`` [s]. Of the ``faults`` it has those of machine
    and damper; what instruments make of its samples is for :class:`Instruments`.
    Raises EmulatorError where the time constant is negative.
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
        # A damper may remember the motion: each rig has its own.
        self._damper = deepcopy(damper)
        self._excitation = excitation
        super().__init__(current, settings, thermal)
        if not (math.isfinite(coil_time_constant) and coil_time_constant >= 0.0):
            raise EmulatorError(
                f"the time constant of the coil is {coil_time_constant} s: it must not be negative"
            )
        self._coil = np.array(coil_time_constant)
        self._before: tuple[Array, Array] | None = None
        self._faults: list[Fault] = []
        self._peak: PeakVelocity | None = None
        self._taken = 0
        self._ready = np.empty((4, 0))
        self.live = False
        """Whether no sample is made before it is asked for: commands hold at once, at some cost."""
        self._power = np.empty(CHUNK)
        self.break_with(faults)

    def break_with(self, faults: Sequence[Fault]) -> None:
        """Have these faults besides those that it has; they must not have begun."""
        own = deepcopy(list(faults))
        self._go_on(self._excitation, own)
        self._faults += own

    def move(self, excitation: Excitation) -> None:
        """Move so from the next samples on; it must go on from where the motion is."""
        self._go_on(excitation, self._faults)

    def _go_on(self, excitation: Excitation, faults: Sequence[Fault]) -> None:
        before = self._excitation
        for fault in faults:
            excitation = fault.moved(excitation)
        if is_sine(excitation):
            self._peak = None
        elif self._peak is None:
            self._peak = self._peak_so_far(before)
        self._excitation = excitation

    def supply(self, current: CurrentSchedule) -> None:
        """Follow this schedule from the next samples on, which is as before up to now."""
        self._current = current

    def surround(self, ambient: float) -> None:
        """Let the air around the damper be so warm [°C], where it has a thermal model."""
        if self._thermal is not None:
            self._thermal = replace(self._thermal, ambient=ambient)

    def next_block(self, count: int) -> RigBlock:
        """The next ``count`` samples; raises EmulatorError where that is less than one."""
        if count < 1:
            raise EmulatorError(f"{count} samples were requested: request at least one")
        parts = [self._ready]
        while self._made < self._taken + count:
            left = CHUNK - self._made % CHUNK
            parts.append(
                self._next_samples(
                    min(left, self._taken + count - self._made) if self.live else left
                )
            )
        rows = np.concatenate(parts, axis=1)
        block, self._ready = rows[:, :count], rows[:, count:]
        first = self._taken
        self._taken += count
        return self._block(first, block)

    def record(
        self, duration: float, *, name: str = "emulated", details: dict[str, str] | None = None
    ) -> Recording:
        """The next ``duration`` [s] as a recording; raises EmulatorError where it is too short."""
        block = self.next_block(round(duration * self.settings.sample_rate))
        return Recording(
            name=name,
            start_ns=block.start_ns,
            period=block.period,
            displacement=block.displacement,
            force=block.force,
            current=block.current,
            temperature=block.temperature if self._thermal else None,
            details=details or {},
        )

    def _next_samples(self, count: int) -> Array:
        """Rows of a :class:`RigBlock`, shape (4, count), within one chunk."""
        period = self.settings.period
        begin = self._made % CHUNK
        part = slice(begin, begin + count)
        if begin == 0:
            self._noise = self._rng.standard_normal((2, CHUNK))
        time = np.arange(self._made, self._made + count, dtype=np.float64) * period
        if is_sine(self._excitation) != (self._peak is None):
            # It has been commanded to move otherwise.
            self._go_on(self._excitation, ())
        moved = self._excitation.at(time)
        displacement, velocity, acceleration = moved
        current = self._current.at(time)
        centred = displacement - self._excitation.centre
        v_m = (
            peak_velocity(centred, velocity, acceleration)
            if self._peak is None
            else self._peak.follow(velocity, acceleration)
        )
        motion = Motion(centred, velocity, acceleration, v_m, sine=None)
        fed = in_coil(self._faults, time, current)
        coil = coil_current(fed, self._coil, period, self._before)
        self._before = fed[-1], coil[-1]
        force = self._damper.force(motion, coil, self._celsius)
        true_force = at_load_cell(self._faults, time, moved, force)
        celsius = np.full(count, self._celsius)
        self._power[part] = true_force * velocity
        self._made += count
        if self._thermal is not None and self._made % CHUNK == 0:
            power = float(np.mean(self._power))
            self._celsius = self._thermal.after(self._celsius, power, CHUNK * period)
        force_noise, displacement_noise = self._noise[:, part]
        return np.stack(
            [
                displacement + self.settings.displacement_noise * displacement_noise,
                true_force + self.settings.force_noise * force_noise,
                current,
                celsius,
            ]
        )

    def _peak_so_far(self, excitation: Excitation) -> PeakVelocity:
        """The motion has gone on for long, also when the recording begins."""
        period = self.settings.period
        before: Array = np.arange(-round(MEMORY / period), 0, dtype=np.float64) + self._made
        peak = PeakVelocity(period)
        _, velocity, acceleration = excitation.at(before * period)
        peak.follow(velocity, acceleration)
        return peak


class SupplyKnob:
    """The current of a supply, as a schedule that goes on from block to block."""

    def __init__(self, current: float = 0.0) -> None:
        # The schedule reads these lists, which grow while the rig runs.
        self._times, self._currents = [0.0], [current]
        self.schedule = CurrentSchedule(self._times, self._currents)

    def turn(self, time: float, current: float) -> None:
        """Supply this current [A] from a time [s] on, or from right after the last turn."""
        if current != self._currents[-1]:
            # Of what is past only the latest matters.
            del self._times[:-1], self._currents[:-1]
            self._times.append(max(time, math.nextafter(self._times[-1], math.inf)))
            self._currents.append(current)
