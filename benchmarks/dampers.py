"""Emulated dampers that the identification does not know.

They are invented ones of the package's laws, and others of eleven laws that the package does not
contain. The parameters are of the order of those in the literature; no such damper was measured.
The coil current of each damper lags the command.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array


def damper(model: str, **values: float) -> ParameterSet:
    """A damper of a law of the package; parameters that are not given are 0."""
    names = MODELS[model].parameter_names
    defaults = dict.fromkeys(names, 0.0)
    return ParameterSet(
        np.array([{**defaults, **values}[name] for name in names]), set_id=model, model=model
    )


DAMPERS = {
    # 888 N at 5 mm, 1 Hz, 1.5 A.
    "viscous_tanh": damper(
        "hyperbolic_tangent",
        c=2600.0,
        c_1=800.0,
        k=1500.0,
        alpha=95.0,
        alpha_1=6.2,
        alpha_2=-0.9,
        beta=110.0,
        delta=0.55,
        coil_time_constant=0.01,
    ),
    # A stiff damper of 1.3 kN, whose loop is rounded by the dashpot in series.
    "modified_bouc_wen": damper(
        "modified_bouc_wen",
        c0=2500.0,
        c0_1=1.2,
        k0=800.0,
        c1=120e3,
        c1_1=0.5,
        k1=1200.0,
        f0=25.0,
        alpha=150.0,
        alpha_1=5.0,
        alpha_2=-0.5,
        yield_length=4e-4,
        share=0.5,
        n=1.6,
        coil_time_constant=0.02,
    ),
    # A small damper of 400 N with a high gas pressure: stiffness and offset.
    "bouc_wen": damper(
        "bouc_wen",
        c0=1500.0,
        c0_1=0.8,
        k0=4000.0,
        f0=-40.0,
        alpha=70.0,
        alpha_1=3.0,
        alpha_2=-0.4,
        yield_length=6e-4,
        share=0.45,
        n=1.5,
        coil_time_constant=0.015,
    ),
}
"""Dampers of the package's laws by name."""

SIXTEEN = ParameterSet(
    np.array(
        [
            *(40.0, -0.35, -0.25, 900.0, 2.5, 4.0, 3.0, 2.0),
            *(9.0, 4.0, 6.0, 18.0, -0.45, -0.11, 0.06, 0.012),
        ]
    ),
    set_id="sixteen",
)
"""A damper of the sixteen-parameter law whose coefficients all vary over 0.01 to 0.25 m/s and 0 to
1.5 A."""


# -- laws that the package does not contain --------------------------------------------------------

_COLD = 28.0
"""Temperature [°C] at which the parameters hold."""

_SUBSTEPS = 4
"""Integration steps per sample: 0.25 ms each at 1 kHz."""

_COIL_LAG = 0.008
"""Time constant [s] of the coil."""


@dataclass
class Moment:
    """One step of a law: its inputs, then its internal state, which the law changes.

    Displacement ``u`` [m], velocity ``v`` [m/s], acceleration ``a`` [m/s²], coil current ``i`` [A],
    ``warmth`` [K] above 28 °C and ``step`` [s] since the previous state; ``size`` scales the force.
    """

    size: float
    u: float = 0.0
    v: float = 0.0
    a: float = 0.0
    i: float = 0.0
    warmth: float = 0.0
    step: float = 0.0
    late: float = 0.0
    inner: float = 0.0
    rod: float = math.nan
    is_open: bool = False
    sense: float = 1.0
    crack: float = 1.2
    past: deque[float] = field(default_factory=deque)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def lagged(self, force: float, time_constant: float) -> float:
        """A force [N] behind a first-order lag [s]."""
        self.late += (force - self.late) * min(self.step / time_constant, 1.0)
        return self.late

    def cooled(self, share: float) -> float:
        """Part of the force that is left when each kelvin takes a ``share`` of it."""
        return 1.0 - share * self.warmth


def _yield_force(i: float, off: float, on: float, knee: float) -> float:
    """Friction [N] at a current [A]: ``off`` at zero, and ``on`` more at magnetic saturation."""
    return off + on * math.tanh(abs(i) / knee)


def _stribeck(now: Moment) -> float:
    """Friction as tanh of the velocity, with the Stribeck effect, a preload and an end stop."""
    friction = now.size * _yield_force(now.i, 60.0, 720.0, 0.7) * now.cooled(0.004)
    stribeck = 1.0 + 0.35 * math.exp(-((now.v / 0.02) ** 2))
    beyond = now.u - min(max(now.u, -0.009), 0.009)
    return (
        friction * stribeck * math.tanh(now.v / 0.006)
        + now.size * (900.0 * now.v + 70.0)
        + now.size * 4e5 * beyond * (1.0 + 2.0 * now.v * math.copysign(1.0, beyond))
    )


def _gas_bouc_wen(now: Moment) -> float:
    """Asymmetric Bouc-Wen law with a parallel gas spring; the fluid softens as it warms."""
    soft, z = math.exp(-0.008 * now.warmth), now.inner
    # dz/dt = A v - beta |v| |z|^(n-1) z - gamma v |z|^n, with n = 2.
    rate = 1400.0 * now.v - 800.0 * abs(now.v * z) * z - 600.0 * now.v * z**2
    now.inner += now.step * rate
    volume = 0.06 + now.u  # of the gas: extension [m] makes room
    gas = 90.0 * (1.0 + now.warmth / 300.0) * ((0.06 / volume) ** 1.4)
    viscous = (700.0 if now.v > 0.0 else 1150.0) * soft
    hysteretic = _yield_force(now.i, 45.0, 620.0, 0.8) * soft
    return now.size * (hysteretic * now.inner + viscous * now.v - gas)


def _sticking_valve(now: Moment) -> float:
    """A valve that sticks at each reversal and needs more than its normal force to open."""
    usual = now.size * _yield_force(now.i, 50.0, 650.0, 0.6) * now.cooled(0.004)
    if now.v * now.sense < 0.0:
        now.sense, now.is_open = -now.sense, False
        now.crack = 1.05 + 0.35 * now.rng.random()
    if now.is_open:
        now.lagged(usual * now.sense * math.tanh(abs(now.v) / 0.002), 0.004)
    else:
        now.late += now.size * 1.5e6 * now.v * now.step
        if abs(now.late) > now.crack * usual:
            now.late = math.copysign(now.crack * usual, now.late)
            now.is_open = True
    return now.late + now.size * 1100.0 * now.v


def _leakage(now: Moment) -> float:
    """A leak past the piston that takes an increasing share of the flow at high speed."""
    friction = _yield_force(now.i, 55.0, 800.0, 0.9) * now.cooled(0.005)
    kept = 1.0 / (1.0 + (now.v / 0.12) ** 2)
    ideal = friction * kept * math.tanh(now.v / 0.008) + 1500.0 * now.v * math.sqrt(kept)
    return now.size * now.lagged(ideal, 0.002)


def _elastic(now: Moment, friction: float, deflection: float) -> float:
    """Force [N] of an elastic strain that yields at the ``deflection`` [m]."""
    now.inner += now.step * (now.v - abs(now.v) * now.inner / deflection)
    return friction * now.inner / deflection


def _electrorheological(now: Moment) -> float:
    """The force lags 12 ms behind the voltage and grows with its square."""
    now.past.append(now.i)
    delayed = now.past.popleft() if len(now.past) > 0.012 / now.step else 0.0
    strength = now.lagged(40.0 + 620.0 * min(abs(delayed) / 1.5, 1.3) ** 2, 0.006)
    return now.size * now.cooled(0.006) * (_elastic(now, strength, 4e-4) + 1400.0 * now.v)


def _backlash(now: Moment) -> float:
    """A clevis with 0.3 mm of play, and contact that closes within some milliseconds."""
    before = now.u if math.isnan(now.rod) else now.rod
    half = 0.5 * 0.3e-3
    now.rod = min(max(before, now.u - half), now.u + half)
    speed = (now.rod - before) / now.step
    friction = _yield_force(now.i, 50.0, 700.0, 0.7) * now.cooled(0.004)
    return now.size * now.lagged(friction * math.tanh(speed / 0.005) + 1300.0 * speed, 0.002)


def _air_pocket(now: Moment) -> float:
    """A bubble of air is compressed before the fluid flows, in one direction only."""
    friction, pocket = _yield_force(now.i, 60.0, 700.0, 0.8) * now.cooled(0.004), now.inner
    # Stretched: the fluid's own stiffness. Compressed: that of the bubble until it is closed.
    shut = min(pocket + 8e-4, 0.0)
    force = 1.2e6 * pocket if pocket > 0.0 else 6e4 * pocket + 1.2e6 * shut
    flow = math.copysign(max(abs(force) - friction, 0.0), force) / 1500.0 + force / 4e5
    now.inner += now.step * (now.v - flow)
    return now.size * force


def _herschel_bulkley(now: Moment) -> float:
    """Shear thinning behind a yield force: F = f_y + K |v|^n, regularised (Papanastasiou)."""
    speed = abs(now.v)
    consistency = (450.0 + 350.0 * min(abs(now.i), 2.0)) * math.exp(-0.007 * now.warmth)
    friction = _yield_force(now.i, 40.0, 600.0, 0.9)
    grown = -math.expm1(-speed / 0.004)
    return math.copysign(now.size * (friction * grown + consistency * speed**0.6 * grown), now.v)


def _fluid_inertia(now: Moment) -> float:
    """Dahl friction, the inertia of the fluid in a long duct and 1.8 kg on the load cell."""
    most = now.size * _yield_force(now.i, 50.0, 680.0, 0.8) * now.cooled(0.005)
    left = 1.0 - now.inner / most * math.copysign(1.0, now.v)
    now.inner += most / 5e-4 * now.step * now.v * left
    now.inner = min(max(now.inner, -most), most)
    return now.inner + now.size * 1000.0 * now.v + 1.8 * now.a


def _shim_valves(now: Moment) -> float:
    """Shim valves that open at different speeds, with different rebound and compression forces."""
    viscous, knee, beyond = (5200.0, 0.05, 900.0) if now.v > 0.0 else (2600.0, 0.08, 500.0)
    speed = abs(now.v)
    flowing = viscous * min(speed, knee) + beyond * max(speed - knee, 0.0)
    friction = _yield_force(now.i, 35.0, 560.0 if now.v > 0.0 else 380.0, 0.7)
    force = (flowing + friction * math.tanh(speed / 0.007)) * math.exp(-0.005 * now.warmth)
    return now.size * now.lagged(math.copysign(force, now.v), 0.003)


def _remanence(now: Moment) -> float:
    """Iron with remanence: the field lags behind the current by 0.15 A in both directions."""
    now.late = min(max(now.late, now.i - 0.15), now.i + 0.15)
    friction = _yield_force(now.late, 60.0, 780.0, 0.8) * now.cooled(0.004)
    return now.size * (_elastic(now, friction, 5e-4) + 1000.0 * now.v + 2500.0 * now.u)


LAWS: dict[str, Callable[[Moment], float]] = {
    "stribeck": _stribeck,
    "gas_bouc_wen": _gas_bouc_wen,
    "sticking_valve": _sticking_valve,
    "leakage": _leakage,
    "electrorheological": _electrorheological,
    "backlash": _backlash,
    "air_pocket": _air_pocket,
    "herschel_bulkley": _herschel_bulkley,
    "fluid_inertia": _fluid_inertia,
    "shim_valves": _shim_valves,
    "remanence": _remanence,
}
"""Foreign laws by name: the force [N] at the next step. Size 1 gives about 0.8 to 1.2 kN at
1.2 A. The last three were made for these benchmarks."""


class ForeignDamper:
    """A damper of one of the :data:`LAWS`, ``size`` times as strong as the usual one."""

    def __init__(self, law: str, size: float = 1.0) -> None:
        self._law, self._now = LAWS[law], Moment(size)
        self._before: list[float] = []
        self._coil = 0.0

    def force(self, motion: Motion, current: Array, celsius: float, period: float) -> Array:
        """Force [N], shape (n,); motion and current are linear between two samples."""
        now, step = self._now, period / _SUBSTEPS
        now.warmth, now.step = celsius - _COLD, step
        follows = min(step / _COIL_LAG, 1.0)
        rows = np.stack([motion.displacement, motion.velocity, motion.acceleration, current]).T
        force = np.empty(current.size)
        for place, sample in enumerate(rows.tolist()):
            if not self._before:
                self._coil = sample[3]
            u, v, a, i = self._before or sample
            du, dv, da, di = (
                (new - old) / _SUBSTEPS for new, old in zip(sample, (u, v, a, i), strict=True)
            )
            for part in range(1, _SUBSTEPS + 1):
                now.u, now.v, now.a = u + part * du, v + part * dv, a + part * da
                self._coil += follows * (i + part * di - self._coil)
                now.i = self._coil
                force[place] = self._law(now)
            self._before = sample
        return force


def foreign_force(
    law: str, moved: Sequence[Array], current: Array | float, period: float, size: float = 1.0
) -> Array:
    """Force [N] (n,) of a cold foreign damper in a motion (u, v, a), without noise."""
    u, v, a = moved
    motion = Motion(u, v, a, np.abs(v), sine=None)
    return ForeignDamper(law, size).force(motion, np.full(u.size, current), _COLD, period)
