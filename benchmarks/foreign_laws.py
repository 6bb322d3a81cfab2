"""Emulated dampers of eleven laws that the package does not contain.

Each law is a small object with a state that is integrated in steps shorter than a sample. The
parameters are invented, of the order of those in the literature; ``size`` scales all forces. The
last three laws were made for this benchmark: fluid inertia, shim valves, and a coil with remanence.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.signals.arrays import Array

_COLD = 28.0
"""Temperature [°C] at which the parameters hold."""

_SUBSTEPS = 4
"""Integration steps per sample: 0.25 ms each at 1 kHz."""


@dataclass
class Moment:
    """Displacement [m], velocity [m/s], acceleration [m/s²], coil current [A], temperature [K].

    ``warmth`` [K] is the temperature above :data:`_COLD`, and ``step`` [s] the time since the
    previous state.
    """

    u: float
    v: float
    a: float
    i: float
    warmth: float
    step: float


@dataclass
class ForeignLaw:
    """A law with its internal state."""

    size: float = 1.0
    late: float = 0.0
    """State of a first-order lag of the force [N]."""

    def force(self, now: Moment) -> float:
        """Force [N] at the next time step."""
        return self._force(now)

    def _force(self, now: Moment) -> float:
        raise NotImplementedError

    def lagged(self, force: float, now: Moment, time_constant: float) -> float:
        """A force [N] behind a first-order lag [s]."""
        self.late += (force - self.late) * min(now.step / time_constant, 1.0)
        return self.late


def _yield_force(i: float, off: float, on: float, knee: float) -> float:
    """Friction [N] at a current [A]: ``off`` at zero, and ``on`` more at magnetic saturation."""
    return off + on * math.tanh(abs(i) / knee)


@dataclass
class StribeckEndStop(ForeignLaw):
    """Friction as tanh of the velocity, with the Stribeck effect, a preload and an end stop."""

    stop: float = 0.009

    def _force(self, now: Moment) -> float:
        friction = self.size * _yield_force(now.i, 60.0, 720.0, 0.7) * (1.0 - 0.004 * now.warmth)
        stribeck = 1.0 + 0.35 * math.exp(-((now.v / 0.02) ** 2))
        beyond = now.u - min(max(now.u, -self.stop), self.stop)
        return (
            friction * stribeck * math.tanh(now.v / 0.006)
            + self.size * (900.0 * now.v + 70.0)
            + self.size * 4e5 * beyond * (1.0 + 2.0 * now.v * math.copysign(1.0, beyond))
        )


@dataclass
class GasBoucWen(ForeignLaw):
    """Asymmetric Bouc-Wen law with a parallel gas spring; the fluid softens as it warms."""

    z: float = 0.0

    def _force(self, now: Moment) -> float:
        soft = math.exp(-0.008 * now.warmth)
        # dz/dt = A v - beta |v| |z|^(n-1) z - gamma v |z|^n, with n = 2.
        rate = 1400.0 * now.v - 800.0 * abs(now.v * self.z) * self.z - 600.0 * now.v * self.z**2
        self.z += now.step * rate
        volume = 0.06 + now.u  # of the gas: extension [m] makes room
        gas = 90.0 * (1.0 + now.warmth / 300.0) * ((0.06 / volume) ** 1.4)
        viscous = (700.0 if now.v > 0.0 else 1150.0) * soft
        hysteretic = _yield_force(now.i, 45.0, 620.0, 0.8) * soft
        return self.size * (hysteretic * self.z + viscous * now.v - gas)


@dataclass
class StickingValve(ForeignLaw):
    """A valve that sticks at each reversal and needs more than its normal force to open."""

    seed: int = 0
    held: float = 0.0
    is_open: bool = False
    sense: float = 1.0
    crack: float = 1.2
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def _force(self, now: Moment) -> float:
        usual = self.size * _yield_force(now.i, 50.0, 650.0, 0.6) * (1.0 - 0.004 * now.warmth)
        if now.v * self.sense < 0.0:
            self.sense = -self.sense
            self.is_open = False
            self.crack = 1.05 + 0.35 * self.rng.random()
        if self.is_open:
            flowing = usual * self.sense * math.tanh(abs(now.v) / 0.002)
            self.held += (flowing - self.held) * min(now.step / 0.004, 1.0)
        else:
            self.held += self.size * 1.5e6 * now.v * now.step
            if abs(self.held) > self.crack * usual:
                self.held = math.copysign(self.crack * usual, self.held)
                self.is_open = True
        return self.held + self.size * 1100.0 * now.v


@dataclass
class Leakage(ForeignLaw):
    """A leak past the piston that takes an increasing share of the flow at high speed."""

    def _force(self, now: Moment) -> float:
        friction = _yield_force(now.i, 55.0, 800.0, 0.9) * (1.0 - 0.005 * now.warmth)
        kept = 1.0 / (1.0 + (now.v / 0.12) ** 2)
        ideal = friction * kept * math.tanh(now.v / 0.008) + 1500.0 * now.v * math.sqrt(kept)
        return self.size * self.lagged(ideal, now, 0.002)


@dataclass
class Electrorheological(ForeignLaw):
    """Electrorheological law: the force lags behind the voltage and grows with its square."""

    dead_time: float = 0.012
    past: deque[float] = field(default_factory=deque)
    strength: float = 0.0
    deflection: float = 0.0

    def _force(self, now: Moment) -> float:
        self.past.append(now.i)
        delayed = self.past.popleft() if len(self.past) > self.dead_time / now.step else 0.0
        wanted = 40.0 + 620.0 * min(abs(delayed) / 1.5, 1.3) ** 2
        self.strength += (wanted - self.strength) * min(now.step / 0.006, 1.0)
        # Stiff before it flows: an elastic strain that yields.
        self.deflection += now.step * (now.v - abs(now.v) * self.deflection / 4e-4)
        elastic = self.strength * self.deflection / 4e-4
        return self.size * (1.0 - 0.006 * now.warmth) * (elastic + 1400.0 * now.v)


@dataclass
class Backlash(ForeignLaw):
    """A clevis with 0.3 mm of play, and contact that closes within some milliseconds."""

    play: float = 0.3e-3
    rod: float = math.nan

    def _force(self, now: Moment) -> float:
        before = now.u if math.isnan(self.rod) else self.rod
        half = 0.5 * self.play
        self.rod = min(max(before, now.u - half), now.u + half)
        speed = (self.rod - before) / now.step
        friction = _yield_force(now.i, 50.0, 700.0, 0.7) * (1.0 - 0.004 * now.warmth)
        there = friction * math.tanh(speed / 0.005) + 1300.0 * speed
        return self.size * self.lagged(there, now, 0.002)


@dataclass
class AirPocket(ForeignLaw):
    """A bubble of air is compressed before the fluid flows, in one direction only."""

    pocket: float = 0.0

    def _force(self, now: Moment) -> float:
        friction = _yield_force(now.i, 60.0, 700.0, 0.8) * (1.0 - 0.004 * now.warmth)
        # Stretched: the fluid's own stiffness. Compressed: that of the bubble until it is closed.
        shut = min(self.pocket + 8e-4, 0.0)
        force = 1.2e6 * self.pocket if self.pocket > 0.0 else 6e4 * self.pocket + 1.2e6 * shut
        flow = math.copysign(max(abs(force) - friction, 0.0), force) / 1500.0 + force / 4e5
        self.pocket += now.step * (now.v - flow)
        return self.size * force


@dataclass
class HerschelBulkley(ForeignLaw):
    """Shear thinning behind a yield force: F = f_y + K |v|^n, regularised (Papanastasiou)."""

    def _force(self, now: Moment) -> float:
        speed = abs(now.v)
        consistency = (450.0 + 350.0 * min(abs(now.i), 2.0)) * math.exp(-0.007 * now.warmth)
        friction = _yield_force(now.i, 40.0, 600.0, 0.9)
        grown = -math.expm1(-speed / 0.004)
        return math.copysign(
            self.size * (friction * grown + consistency * speed**0.6 * grown), now.v
        )


@dataclass
class FluidInertia(ForeignLaw):
    """Dahl friction plus the inertia of the fluid in a long duct and of parts on the load cell."""

    mass: float = 1.8
    friction: float = 0.0

    def _force(self, now: Moment) -> float:
        most = self.size * _yield_force(now.i, 50.0, 680.0, 0.8) * (1.0 - 0.005 * now.warmth)
        stiffness = most / 5e-4
        self.friction += (
            stiffness * now.step * now.v * (1.0 - self.friction / most * math.copysign(1.0, now.v))
        )
        self.friction = min(max(self.friction, -most), most)
        return self.friction + self.size * 1000.0 * now.v + self.mass * now.a


@dataclass
class ShimValves(ForeignLaw):
    """Shim valves that open at different speeds, with different rebound and compression forces."""

    def _force(self, now: Moment) -> float:
        viscous, knee, beyond = (5200.0, 0.05, 900.0) if now.v > 0.0 else (2600.0, 0.08, 500.0)
        speed = abs(now.v)
        flowing = viscous * min(speed, knee) + beyond * max(speed - knee, 0.0)
        friction = _yield_force(now.i, 35.0, 560.0 if now.v > 0.0 else 380.0, 0.7)
        there = math.copysign(
            (flowing + friction * math.tanh(speed / 0.007)) * math.exp(-0.005 * now.warmth), now.v
        )
        return self.size * self.lagged(there, now, 0.003)


@dataclass
class Remanence(ForeignLaw):
    """Iron with remanence: the field lags behind the current by 0.15 A in both directions."""

    field_current: float = 0.0
    deflection: float = 0.0

    def _force(self, now: Moment) -> float:
        half = 0.15
        self.field_current = min(max(self.field_current, now.i - half), now.i + half)
        friction = _yield_force(self.field_current, 60.0, 780.0, 0.8) * (1.0 - 0.004 * now.warmth)
        self.deflection += now.step * (now.v - abs(now.v) * self.deflection / 5e-4)
        sliding = friction * self.deflection / 5e-4
        return self.size * (sliding + 1000.0 * now.v + 2500.0 * now.u)


LAWS: dict[str, Callable[[float], ForeignLaw]] = {
    "stribeck": StribeckEndStop,
    "gas_bouc_wen": GasBoucWen,
    "sticking_valve": StickingValve,
    "leakage": Leakage,
    "electrorheological": Electrorheological,
    "backlash": Backlash,
    "air_pocket": AirPocket,
    "herschel_bulkley": HerschelBulkley,
    "fluid_inertia": FluidInertia,
    "shim_valves": ShimValves,
    "remanence": Remanence,
}
"""Functions by name that create a law from its size; size 1 gives about 0.8 to 1.2 kN at 1.2 A."""


class ForeignDamper:
    """A damper of a law whose coil current lags the command."""

    COIL_LAG: ClassVar[float] = 0.008
    """Time constant [s]."""

    def __init__(self, law: ForeignLaw) -> None:
        self._law = law
        self._before: tuple[float, float, float, float] | None = None
        self._coil = 0.0

    def force(self, motion: Motion, current: Array, celsius: float, period: float) -> Array:
        """Force [N], shape (n,); motion and current are linear between two samples."""
        step = period / _SUBSTEPS
        now = Moment(0.0, 0.0, 0.0, 0.0, celsius - _COLD, step)
        law, follows = self._law, min(step / self.COIL_LAG, 1.0)
        rows = np.stack([motion.displacement, motion.velocity, motion.acceleration, current]).T
        force = np.empty(current.size)
        for place, sample in enumerate(rows.tolist()):
            if self._before is None:
                self._coil = sample[3]
            u, v, a, i = self._before or sample
            du, dv, da, di = (
                (new - old) / _SUBSTEPS for new, old in zip(sample, (u, v, a, i), strict=True)
            )
            for part in range(1, _SUBSTEPS + 1):
                now.u, now.v, now.a = u + part * du, v + part * dv, a + part * da
                self._coil += follows * (i + part * di - self._coil)
                now.i = self._coil
                force[place] = law.force(now)
            self._before = tuple(sample)
        return force
