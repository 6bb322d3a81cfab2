"""The Bouc-Wen and the modified Bouc-Wen model, integrated stably at any sample period.

Spencer, Dyke, Sain and Carlson, J. Engineering Mechanics 123, 1997; thesis eq. 1-6. One of the
published parameters A, beta, gamma and alpha is redundant, because z and alpha can be scaled
against each other (Ma, Zhang, Bockstedte, Foliente and Paevere, J. Applied Mechanics 71, 2004).
Here z is scaled so that |z| tends to 1, with the driving velocity w:

    dz/dt = (w - |z|^n (share w + (1 - share) |w| sgn z)) / yield_length

This gives A = 1/yield_length, beta = share A, gamma = (1 - share) A, and alpha is the force at full
yield.

The integration uses exponential Rosenbrock-Euler steps. They are of second order and exact for an
equation linear in z. They keep |z| at most 1, so they are stable for any period.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableSequence, Sequence

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.current_dependence import IntegratedModel, Recursion
from mr_damper_ros.models.machine_code import run_loop
from mr_damper_ros.models.quantities import SETTLING, Coefficient, LoopReading
from mr_damper_ros.signals.arrays import Array

HYSTERESIS = (
    Coefficient("alpha", "N", 0.0, degree=2, meaning="force at full yield"),
    Coefficient("yield_length", "m", 1e-6, 1.0, degree=1, meaning="displacement to the yield"),
    Coefficient("share", "1", 0.0, 1.0, meaning="share of the loop that unloads elastically"),
    Coefficient("n", "1", 1.0, 6.0, meaning="sharpness of the yield"),
)
"""Coefficients of the hysteresis; force and yield length depend on the current."""

_SMALL_RATE = 1e-4


def hysteresis_step(
    z: float, w: float, back: float, length: float, share: float, power: float, period: float
) -> float:
    """State z after one step at the velocity w; ``back`` is -dw/dz.

    A run has thousands of steps, so the function uses comparisons instead of calls where possible.
    """
    size, sign = (z, 1.0) if z > 0.0 else (-z, -1.0) if z < 0.0 else (0.0, 0.0)
    along = sign if w > 0.0 else -sign if w < 0.0 else 0.0
    towards = share + (1.0 - share) * along
    gain = (1.0 - size**power * towards) / length
    bend = power * size ** (power - 1.0) * sign * towards / length
    x = -period * (bend * w + gain * back)
    if x > 1.0:
        x = 1.0
    moved = z + period * gain * w * (math.expm1(x) / x if x != 0.0 else 1.0)
    # The exact solution stays in this range; a step much longer than the yield length could leave
    # it.
    return 1.0 if moved > 1.0 else -1.0 if moved < -1.0 else moved


def follow_yield(
    velocity: Sequence[float],
    lengths: Sequence[float],
    states: MutableSequence[float],
    period: float,
    share: float,
    power: float,
    z: float,
    last: float,
) -> tuple[float, float]:
    """Follow a hysteresis driven by the rod; fills z (n,) and returns the last z and velocity."""
    for k in range(len(velocity)):
        v = velocity[k]
        if z != z:  # NaN marks a start
            z = 0.0
        else:
            z = hysteresis_step(z, 0.5 * (v + last), 0.0, lengths[k], share, power, period)
        last = v
        states[k] = z
    return z, last


def follow_inner_point(
    velocity: Sequence[float],
    numbers: Sequence[Sequence[float]],
    inner: MutableSequence[float],
    states: MutableSequence[float],
    springs: MutableSequence[float],
    period: float,
    k0: float,
    share: float,
    power: float,
    z: float,
    s: float,
    last: float,
) -> tuple[float, float, float]:
    """Follow a hysteresis and a damper in series with another damper.

    Fills the velocity (n,) [m/s] of the point between the two, z and s (n,), and returns the last
    z, s and velocity, where s is the displacement of the rod relative to this point. ``numbers``
    (n, 4): damping parallel to the hysteresis and sum of both dampings [N s/m], force at full yield
    [N], yield length [m].
    """
    easing = eased = 0.0
    for k in range(len(velocity)):
        v = velocity[k]
        c0, both, alpha, length = numbers[k][0], numbers[k][1], numbers[k][2], numbers[k][3]
        if both != eased:
            # Ratio of a half step of s to its rate, exact for an equation linear in s.
            x = -0.5 * period * k0 / both
            easing = 0.5 * period * (math.expm1(x) / x if x < 0.0 else 1.0)
            eased = both
        if z != z:  # NaN marks a start
            z = s = 0.0
        else:
            # Strang splitting: half a step of s, a step of z, half a step of s.
            w = 0.5 * (v + last)
            s += easing * (w - (alpha * z + c0 * w + k0 * s) / both)
            slip = w - (alpha * z + c0 * w + k0 * s) / both
            z = hysteresis_step(z, slip, alpha / both, length, share, power, period)
            s += easing * (w - (alpha * z + c0 * w + k0 * s) / both)
        last = v
        inner[k], states[k], springs[k] = (alpha * z + c0 * v + k0 * s) / both, z, s
    return z, s, last


def _eased(x: Array) -> tuple[Array, Array]:
    """(e^x - 1)/x and its derivative, for x of any shape."""
    small = np.abs(x) < _SMALL_RATE
    safe = np.where(small, 1.0, x)
    eased = np.where(small, 1.0 + 0.5 * x, np.expm1(x) / safe)
    return eased, np.where(small, 0.5 + x / 3.0, (np.exp(x) - eased) / safe)


def step_derivatives(
    before: Array,
    after: Array,
    w: Array,
    back: Array | float,
    length: Array,
    share: Array,
    power: Array,
    period: float,
) -> list[Array]:
    """Derivatives (n,) of :func:`hysteresis_step` at the states ``before`` and ``after`` a step.

    They are by the previous state, w, ``back``, the yield length, the share and the power.
    """
    size, sign = np.abs(before), np.sign(before)
    along = sign * np.sign(w)
    towards = share + (1.0 - share) * along
    # At z = 0 the power and its logarithm have no effect; 1 avoids an infinite logarithm.
    some = np.where(size > 0.0, size, 1.0)
    here = np.where(size > 0.0, 1.0, 0.0)
    raised, less, log = size**power, here * some ** (power - 1.0), here * np.log(some)
    gain = (1.0 - raised * towards) / length
    slope = power * less * sign / length
    x = -period * (slope * towards * w + gain * back)
    inside = x < 1.0
    x = np.minimum(x, 1.0)
    eased, bends = _eased(x)
    bends *= inside

    def change(of_gain: Array, of_bend: Array) -> Array:
        of_x = -period * (of_bend * w + of_gain * back)
        return np.asarray(period * w * (of_gain * eased + gain * bends * of_x))

    bent = power * (power - 1.0) * here * some ** (power - 2.0) * towards / length
    other = 1.0 - along
    bent_by_power = less * (1.0 + power * log) * sign * towards / length
    derivatives = [
        1.0 + change(-slope * towards, bent),
        period * gain * (eased - period * w * bends * slope * towards),
        -((period * gain) ** 2) * w * bends,
        change(-gain / length, -slope * towards / length),
        change(-raised * other / length, slope * other),
        change(-raised * log * towards / length, bent_by_power),
    ]
    # A step limited to full yield has no derivative, nor has the start at rest.
    moves = np.abs(after) < 1.0
    moves[0] = False
    return [moves * part for part in derivatives]


def _steps(states: Array) -> Array:
    """States (n,) before each step; the first is the start at rest."""
    return np.concatenate(([0.0], states[:-1]))


def _driving(velocity: Array) -> Array:
    """The mean velocity (n,) in each step, zero for the start at rest."""
    return np.concatenate(([0.0], 0.5 * (velocity[1:] + velocity[:-1])))


class _Hysteretic(IntegratedModel):
    """A law with a hysteresis."""

    def memory_length(self, parameters: Array, current: float) -> float:
        """A multiple of the yield length: a hysteresis forgets its past with travel, not time."""
        place = self.coefficient_names.index("yield_length")
        return SETTLING * float(self.coefficients_at(parameters, 0.0, current)[place, 0])


class BoucWen(_Hysteretic):
    """A damper, a spring and a hysteresis in parallel."""

    name = "bouc_wen"
    title = "Bouc–Wen"
    source = "Spencer, Dyke, Sain and Carlson, J. Engineering Mechanics 123, 1997; thesis eq. 1-2"
    equation = (
        r"F = c_0 v + k_0 u + f_0 + \alpha z,\quad"
        r" \dot z = \left(v - |z|^n (s v + (1 - s) |v| \operatorname{sgn} z)\right) / u_y"
    )
    at_one_current = (
        Coefficient("c0", "N s/m", 0.0, degree=1, meaning="viscous damping"),
        Coefficient("k0", "N/m", meaning="stiffness"),
        Coefficient("f0", "N", meaning="constant force"),
        *HYSTERESIS,
    )
    memory = 2

    def integrate(
        self, coefficients: list[Array], motion: Motion, period: float, memory: list[float]
    ) -> Array:
        """State z at the samples; the memory holds the last z and the last velocity."""
        share, power = (float(c[0]) for c in coefficients[5:])
        given = motion.velocity, np.broadcast_to(coefficients[4], motion.velocity.shape)
        (states,), memory[:] = run_loop(
            follow_yield, (hysteresis_step,), given, 1, period, share, power, *memory
        )
        return states

    def force_from(self, coefficients: Sequence[Array], motion: Motion, integrated: Array) -> Array:
        """Force [N]."""
        damping, stiffness, offset, strength, *_ = coefficients
        viscous = damping * motion.velocity + stiffness * motion.displacement
        return np.asarray(viscous + offset + strength * integrated)

    def sensitivities(
        self, coefficients: list[Array], motion: Motion, period: float
    ) -> tuple[Mapping[int, Array], list[Recursion]]:
        """The derivatives of the force, and the recursion of z."""
        z = self.integrate(coefficients, motion, period, [math.nan] * self.memory)
        length, share, power = coefficients[4:]
        driving = _driving(motion.velocity)
        kept, _, _, *by = step_derivatives(_steps(z), z, driving, 0.0, length, share, power, period)
        direct = {0: motion.velocity, 1: motion.displacement, 2: np.ones(z.size), 3: z}
        kept_by = dict(enumerate(by, start=4))
        return direct, [Recursion((coefficients[3],), ((kept,),), (kept_by,))]

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """Starts dominated by the yield force; its yield length is 5 % or 20 % of the amplitude."""
        force, middle, speed, amplitude = reading
        return np.array(
            [
                [0.2 * force / speed, 0.0, middle, 0.8 * force, part * amplitude, 0.5, 1.5]
                for part in (0.05, 0.2)
            ]
        )


class ModifiedBoucWen(_Hysteretic):
    """A Bouc-Wen model in series with a damper, both in parallel with a spring."""

    name = "modified_bouc_wen"
    title = "modified Bouc–Wen"
    source = "Spencer, Dyke, Sain and Carlson, J. Engineering Mechanics 123, 1997; thesis eq. 3-6"
    equation = (
        r"F = c_1 \dot y + k_1 u + f_0,\quad"
        r" \dot y = \frac{\alpha z + c_0 v + k_0 (u - y)}{c_0 + c_1},\quad"
        r" \dot z = \left(w - |z|^n (s w + (1 - s) |w| \operatorname{sgn} z)\right) / u_y,"
        r"\quad w = v - \dot y"
    )
    at_one_current = (
        Coefficient("c0", "N s/m", 0.0, degree=1, meaning="damping at high velocity"),
        Coefficient("k0", "N/m", 0.0, meaning="inner stiffness"),
        Coefficient("c1", "N s/m", 1e-3, degree=1, meaning="damping in series"),
        Coefficient("k1", "N/m", meaning="stiffness of the gas"),
        Coefficient("f0", "N", meaning="constant force"),
        *HYSTERESIS,
    )
    memory = 3

    def integrate(
        self, coefficients: list[Array], motion: Motion, period: float, memory: list[float]
    ) -> Array:
        """Velocity [m/s] of the inner point.

        The memory holds z, the displacement s of the rod relative to the inner point, and the last
        velocity. Only s enters the equations, so the centre of the motion may move.
        """
        (inner, _, _), memory[:] = self._followed(coefficients, motion, period, memory)
        return inner

    @staticmethod
    def _followed(
        coefficients: Sequence[Array], motion: Motion, period: float, memory: Sequence[float]
    ) -> tuple[list[Array], Sequence[float]]:
        """Velocity of the inner point, z and s (n,), and the memory after them."""
        # The dampings, the force at full yield and the yield length may depend on the current.
        c0s, c1s, alphas, lengths = (coefficients[place] for place in (0, 2, 5, 6))
        k0, share, power = (float(coefficients[place][0]) for place in (1, 7, 8))
        each = motion.velocity, c0s, c0s + c1s, alphas, lengths
        velocity, *numbers = np.broadcast_arrays(*each)
        given = velocity, np.stack(numbers, axis=-1)
        return run_loop(
            follow_inner_point, (hysteresis_step,), given, 3, period, k0, share, power, *memory
        )

    def force_from(self, coefficients: Sequence[Array], motion: Motion, integrated: Array) -> Array:
        """Force [N]."""
        outer_damping, stiffness, offset = coefficients[2:5]
        return np.asarray(outer_damping * integrated + stiffness * motion.displacement + offset)

    def sensitivities(
        self, coefficients: list[Array], motion: Motion, period: float
    ) -> tuple[Mapping[int, Array], list[Recursion]]:
        """The derivatives of the force, and the joint recursion of z and s."""
        c0, k0, c1, _, _, alpha, length, share, power = coefficients
        start = [math.nan] * self.memory
        (inner, z, s), _ = self._followed(coefficients, motion, period, start)
        before, w, half = _steps(z), _driving(motion.velocity), 0.5 * period
        by_z, by_s, per = alpha / (c0 + c1), k0 / (c0 + c1), 1.0 / (c0 + c1)  # of the inner point

        def inner_point(z: Array, s: Array, v: Array) -> tuple[Array, dict[int, Array]]:
            """Velocity of the inner point, and its derivatives by the coefficients."""
            y = by_z * z + c0 * per * v + by_s * s
            return y, {0: per * (v - y), 1: per * s, 2: -per * y, 5: per * z}

        easing, bends = _eased(-half * by_s)
        easing *= half
        softer = -half * half * bends * per
        eased_by = {0: -by_s * softer, 1: softer, 2: -by_s * softer}
        back_by = {0: -by_z * per, 2: -by_z * per, 5: per}
        # The three parts of a step: s, then z, then s.
        first, first_by = inner_point(before, _steps(s), w)
        between = _steps(s) + easing * (w - first)
        second, second_by = inner_point(before, between, w)
        third, third_by = inner_point(z, between, w)
        of_z, of_slip, of_back, *of_yield = step_derivatives(
            before, z, w - second, by_z, length, share, power, period
        )
        kept = 1.0 - easing * by_s
        z_by_z, z_by_s = of_z - of_slip * by_z * kept, -of_slip * by_s * kept
        s_by_z = -easing * by_z * (kept + z_by_z)
        s_by_s = kept * kept - easing * by_z * z_by_s
        z_by = dict(enumerate(of_yield, start=6))
        s_by = {place: -easing * by_z * by for place, by in z_by.items()}
        for place in (0, 1, 2, 5):
            eased = eased_by.get(place, 0.0)
            moved = eased * (w - first) - easing * first_by[place]
            z_by[place] = of_back * back_by.get(place, 0.0)
            z_by[place] -= of_slip * (second_by[place] + by_s * moved)
            s_by[place] = kept * moved + eased * (w - third)
            s_by[place] -= easing * (third_by[place] + by_z * z_by[place])
        for by in (s_by_z, s_by_s, *s_by.values()):
            by[0] = 0.0
        _, direct = inner_point(z, s, motion.velocity)
        direct = {place: c1 * by for place, by in direct.items()}
        direct[2] = direct[2] + inner
        direct |= {3: motion.displacement, 4: np.ones(z.size)}
        both = (z_by_z, z_by_s), (s_by_z, s_by_s)
        return direct, [Recursion((c1 * by_z, c1 * by_s), both, (z_by, s_by))]

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """Starts dominated by yield force, with short or long yield, low or high series damping."""
        force, middle, speed, amplitude = reading
        viscous = force / speed
        return np.array(
            [
                [0.2 * viscous, 0.0, stiff * viscous, 0.0]
                + [middle, 0.8 * force, part * amplitude, 0.5, 1.5]
                for stiff in (2.0, 8.0)
                for part in (0.01, 0.1)
            ]
        )
