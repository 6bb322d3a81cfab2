"""Sound records of emulated dampers, whose channels can be sampled as an instrument would.

The dampers are of laws of the package and of laws that it does not contain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from benchmarks.dampers import DAMPERS, LAWS, SIXTEEN, ForeignDamper
from benchmarks.following import STATE_DAMPER
from benchmarks.motions import MOTIONS, chirp, random_motion, scheduled
from mr_damper_ros.emulation.motions import Excitation, SampledMotion, SineMotion
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.peak_velocity import peak_velocity_of_period
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.recording import DEFAULT_START_NS, Recording

BEFORE = 0.6
"""Time [s] before and after a record for which its force is known."""

_FINE = 1e-3
"""Longest step [s] of the computed force; between its steps, the force is linear."""

_CELSIUS = 28.0

_LAGS = -0.05, 0.12
"""Range of lags of a force behind the motion [s]."""

OF_THE_PACKAGE: dict[str, ParameterSet] = {
    "sigmoid": replace(SIXTEEN, peak_velocity_range=(0.01, 0.25)),
    "springs": STATE_DAMPER,
    **DAMPERS,
}
"""Dampers of laws of the package, besides the foreign ones."""


def _triangle(amplitude: float, frequency: float, duration: float) -> SampledMotion:
    """A triangle with reversals that are rounded over 2 % of a period."""
    grid = 2e-3
    time = np.arange(round(duration / grid) + 1) * grid
    angle = 2.0 * np.pi * frequency * time
    sharp = 0.998  # rounds the reversals
    wave = np.arcsin(sharp * np.sin(angle)) / np.arcsin(sharp)
    return SampledMotion(amplitude * wave, grid)


def _rest_sine_rest(amplitude: float, frequency: float, duration: float) -> SampledMotion:
    """A sine that grows from rest and fades to rest, each within a second after a second."""
    grid = 2e-3
    time = np.arange(round(duration / grid) + 1) * grid
    edge = np.clip(np.minimum(time, time[-1] - time) - 1.0, 0.0, 1.0)
    envelope = np.sin(0.5 * np.pi * edge) ** 2
    wave = amplitude * envelope * np.sin(2.0 * np.pi * frequency * time)
    return SampledMotion(wave, grid)


_LONG = 30.0

SLOW_TRIANGLE = "slow triangle"

MOTION_KINDS: dict[str, Callable[[int], Excitation]] = {
    "5 mm 1 Hz": lambda _: SineMotion(5e-3, 1.0),
    "18 mm 0.5 Hz": lambda _: SineMotion(18e-3, 0.5),
    "10 mm 0.1 Hz": lambda _: SineMotion(10e-3, 0.1),
    "2 mm 5 Hz": lambda _: SineMotion(2e-3, 5.0),
    "random 0.2-3 Hz": lambda seed: random_motion(4e-3, 0.2, 3.0, _LONG, seed),
    "random 0.5-8 Hz": lambda seed: random_motion(2e-3, 0.5, 8.0, _LONG, seed),
    "sweep": lambda _: chirp(0.12, 9e-3, 0.3, 8.0, 12.0),
    "triangle": lambda _: _triangle(8e-3, 0.4, _LONG),
    SLOW_TRIANGLE: lambda _: _triangle(5e-3, 0.02, 130.0),
    "rest, sine, rest": lambda _: _rest_sine_rest(6e-3, 1.5, 8.0),
    "amplitudes": MOTIONS["amplitudes 4, 1, 8 mm"],
    "earthquakes": MOTIONS["earthquakes"],
    "quarter car": MOTIONS["quarter car"],
}
"""Motions by name, made from a seed."""

STEPS = "steps"
"""Name of a current that changes at random times."""

_HELD = (0.08, 0.5)
"""Shortest and longest time [s] between these changes."""


@dataclass(frozen=True)
class Plan:
    """How a record is made.

    ``current`` [A] is constant, or changes at random times for None; ``size`` scales the force [1];
    ``force_noise`` is relative to the largest force; ``jitter`` is in periods; ``offset`` [N] and
    ``stiffness`` [N/m] are of a gas, ``mass`` [kg] is between damper and load cell; the force
    falls by ``fades`` [1] as the damper heats up; ``bits`` of the converters, 0 for exact ones.
    """

    damper: str
    motion: str
    current: float | None = 1.0
    rate: float = 1000.0
    duration: float = 6.0
    size: float = 1.0
    force_noise: float = 0.008
    displacement_noise: float = 2e-6
    jitter: float = 0.05
    offset: float = 0.0
    stiffness: float = 0.0
    mass: float = 0.0
    fades: float = 0.0
    bits: int = 0
    begins: float = 0.0
    seed: int = 0

    @property
    def name(self) -> str:
        """The plan in words."""
        current = STEPS if self.current is None else f"{self.current:g} A"
        size = "" if self.size == 1.0 else f" x{self.size:g}"
        return f"{self.damper}{size}, {self.motion}, {current}, {self.rate:g} Hz"


@dataclass(frozen=True, eq=False)
class Channels:
    """Samples (n,) of the channels: the true ``time`` of each [s], and the values in SI units."""

    time: Array
    displacement: Array
    force: Array
    current: Array

    def recording(self, period: float, name: str = "record") -> Recording:
        """The samples as a recording with this period [s]."""
        start = DEFAULT_START_NS + round(1e9 * float(self.time[0]))
        rows = self.displacement, self.force, self.current
        return Recording(name, start, period, *rows)


@dataclass(frozen=True, eq=False)
class SoundRecord:
    """The truth of a plan, from which samples are taken."""

    plan: Plan

    @cached_property
    def motion(self) -> Excitation:
        """The motion of the rod."""
        return MOTION_KINDS[self.plan.motion](self.plan.seed)

    @cached_property
    def _fine(self) -> Array:
        period = min(_FINE, 1.0 / self.plan.rate)
        count = round((self.plan.duration + 2.0 * BEFORE) / period)
        return np.asarray(self.plan.begins - BEFORE + period * np.arange(count))

    def current_at(self, time: Array) -> Array:
        """True current [A] at the times [s], shape (n,)."""
        if self.plan.current is not None:
            return np.full(time.size, self.plan.current)
        rng = np.random.default_rng(100 + self.plan.seed)
        times = np.concatenate([[-10.0], np.cumsum(rng.uniform(*_HELD, 400))])
        return scheduled(times, rng.uniform(0.0, 1.4, times.size)).at(time - self.plan.begins)

    def _computed(self, current: Array) -> Array:
        """True force [N] on the fine grid for this current (n,)."""
        plan, time = self.plan, self._fine
        period = float(time[1] - time[0])
        u, v, a = self.motion.at(time)
        motion = Motion(u, v, a, peak_velocity_of_period(v, a, period), sine=None)
        if plan.damper in LAWS:
            force = ForeignDamper(plan.damper).force(motion, current, _CELSIUS, period)
        else:
            known = OF_THE_PACKAGE[plan.damper]
            force, _ = known.follow(motion, current, period, None, gradual=True)
        force = plan.size * (1.0 - plan.fades * (time - time[0]) / plan.duration) * force
        return np.asarray(force + plan.offset + plan.stiffness * u + plan.mass * a)

    @cached_property
    def _force(self) -> Array:
        return self._computed(self.current_at(self._fine))

    @property
    def peak(self) -> float:
        """Largest magnitude of the true force within the record [N]."""
        within = (self._fine >= self.plan.begins) & (
            self._fine <= self.plan.begins + self.plan.duration
        )
        return float(np.max(np.abs(self._force[within])))

    @cached_property
    def lag(self) -> float:
        """Lag [s] of the true force behind the motion.

        With it, the direction and the velocity explain the most of the force, beside a spring, a
        mass and a preload.
        """
        step = float(self._fine[1] - self._fine[0])
        u, v, a = self.motion.at(self._fine)
        low, high = (round(edge / step) for edge in _LAGS)
        inner = np.arange(high, self._fine.size - high, 3)
        shifts = np.arange(low, high + 1)
        moving = np.stack((np.sign(v), v), axis=1)
        fixed = np.stack((u, a, np.ones(u.size)), axis=1)[inner]
        left = []
        for shift in shifts.tolist():
            columns = np.hstack((moving[inner - shift], fixed))
            columns /= np.linalg.norm(columns, axis=0)
            factors = np.linalg.lstsq(columns, self._force[inner], rcond=None)[0]
            rest = float(np.linalg.norm(self._force[inner] - columns @ factors))
            # Half a cycle later, the damper would drive the motion.
            left.append(rest if factors[0] + factors[1] > 0.0 else np.inf)
        return step * float(shifts[int(np.argmin(left))])

    @property
    def period(self) -> float:
        """Nominal sample period [s]."""
        return 1.0 / self.plan.rate

    @property
    def grid(self) -> Array:
        """Nominal sample times [s], shape (n,)."""
        plan = self.plan
        return np.asarray(plan.begins + self.period * np.arange(round(plan.duration * plan.rate)))

    def sampled(
        self,
        time: Array | None = None,
        *,
        displacement_late: float = 0.0,
        force_late: float = 0.0,
        current_late: float = 0.0,
        at_currents: Array | None = None,
    ) -> Channels:
        """The channels at the nominal times or at ``time`` [s], shape (n,), with noise.

        A channel may be late by some time [s]. ``at_currents`` [A], shape (n,), is the true
        current, while the samples hold that of the plan.
        """
        plan = self.plan
        rng = np.random.default_rng(1 + plan.seed)
        time = self.grid if time is None else time
        size = time.size
        taken = time + plan.jitter * self.period * rng.uniform(-1.0, 1.0, size)
        u = self.motion.at(taken - displacement_late).displacement
        u = u + plan.displacement_noise * rng.standard_normal(size)
        force = self._force
        if at_currents is not None:
            force = self._computed(np.interp(self._fine, time, at_currents))
        f = np.interp(taken - force_late, self._fine, force)
        f = f + plan.force_noise * self.peak * rng.standard_normal(size)
        if plan.bits:
            u, f = (_converted(each, plan.bits) for each in (u, f))
        return Channels(time, u, f, self.current_at(taken - current_late))

    def recording(self) -> Recording:
        """The sound record."""
        return self.sampled().recording(self.period)


def _converted(values: Array, bits: int) -> Array:
    """The values (n,) behind a converter whose range is four times their largest magnitude."""
    step = 8.0 * float(np.max(np.abs(values))) / 2.0**bits
    return np.asarray(step * np.round(values / step))


@lru_cache(maxsize=64)
def sound_record(plan: Plan) -> SoundRecord:
    """The record of a plan, computed once."""
    return SoundRecord(plan)
