"""Yield and viscous flow in series with a spring, parallel to a softer spring with a yield.

The fluid flows at the velocity w, which differs from the velocity v of the rod because of the
spring between them. The ``compliance`` of the extended law approximates this spring; here it is
integrated sample by sample:

    f tanh(w / w_y) + c w = F = k x,    dx/dt = v - w

When the current changes, and with it the stiffness, the spring keeps its deflection x. The law does
not need the peak velocity. The loop of a small motion is rounder because the travel since the
reversal is shorter, not because of the speed. The law describes this by a part of the yield force
on a softer spring: two parallel elements, each with its own yield, as in Iwan, J. Applied Mechanics
33, 1966.

A step uses the two-stage method of second order with gamma = 1 - 1/sqrt(2) (Alexander, SIAM J.
Numerical Analysis 14, 1977). The method is L-stable: it is stable at any period, and a spring that
is very stiff for the period acts as rigid, without oscillation. Each stage is one monotonic
equation for w. The derivatives with respect to the parameters follow from the linearised steps, by
a recursion that is solved for all of them at once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableSequence, Sequence

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.current_dependence import IntegratedModel, Recursion
from mr_damper_ros.models.machine_code import run_loop, runs_machine_code
from mr_damper_ros.models.quantities import SETTLING, Coefficient, LoopReading, State
from mr_damper_ros.signals.arrays import MOST_ITERATIONS, NEGLIGIBLE, Array

_GAMMA = 1.0 - math.sqrt(0.5)
_REST = 1.0 - _GAMMA
_AHEAD = _REST / _GAMMA
_CLOSE = 4e-3
"""The iteration ends when a step changes the flow by less than this part of the yield width.
Because convergence is cubic, the next step would be smaller than about the cube of this part."""

_LARGEST_CORRECTION = 0.5
"""Limit of Halley's correction; with more curvature within a step, it is not reliable."""


Path = tuple[Array, Array, Array, Array]
"""Strength [N], yield width [m/s], damping [N s/m] and stiffness [N/m] of a path, (n,) or (1,)."""


def _followed(
    path: Path, velocity: Array, period: float, *start: float
) -> tuple[list[Array], tuple[float, float]]:
    """Force [N] and flows of both stages (n,), and the last deflection and flow.

    ``start``: deflection [m], flow [m/s] and velocity [m/s] before; NaN at a start.
    """
    numbers = np.stack(np.broadcast_arrays(*path), axis=-1)
    return run_loop(follow_path, (flow_of,), (velocity, numbers), 3, period, *start)


def _deflection(path: Path, velocity: Array, period: float) -> tuple[Array, Array, list[Array]]:
    """Deflection [m] of the spring of a path, and the terms of its recursion, each (n,).

    The terms are the derivatives of a step by the previous deflection and by the four coefficients.
    """
    (forces, early, flow), _ = _followed(path, velocity, period, math.nan, math.nan, math.nan)
    strength, width, damping, stiffness = path
    deflection = forces / stiffness
    before = np.concatenate((velocity[:1], velocity[:-1]))
    between = before + _GAMMA * (velocity - before)
    near, far = (part * period * stiffness for part in (_GAMMA, _REST))
    slopes, by_both = [], []
    for w in (early, flow):
        tanh = np.tanh(w / width)
        steep = strength / width * (1.0 - tanh**2)
        slopes.append(steep + damping)
        by_both.append((tanh, -steep * w / width, w))
    first, second = (1.0 / (slope + near) for slope in slopes)
    kept = slopes[1] * second * (1.0 - far * first)
    kept[0] = 0.0
    terms = []
    for early_by, by in zip(*by_both, strict=True):
        # The first stage affects the flow, and through it the initial force of the second.
        term = slopes[1] * second * far * first * early_by + near * second * by
        term[0] = by[0]
        terms.append(term / stiffness)
    # The spring keeps its deflection while its stiffness changes, so its force changes.
    slack = between - early
    begin = (far * slack - far * first * near * slack) / stiffness
    term = slopes[1] * second * (begin + near * (velocity - flow) / stiffness)
    term += kept * np.concatenate(([0.0], deflection[:-1]))
    term[0] = 0.0
    return deflection, kept, [*terms, (term - deflection) / stiffness]


def follow_path(
    velocity: Sequence[float],
    numbers: Sequence[Sequence[float]],
    forces: MutableSequence[float],
    early: MutableSequence[float],
    flows: MutableSequence[float],
    period: float,
    deflection: float,
    flow: float,
    last: float,
) -> tuple[float, float]:
    """Follow a path; fills the force and the flows of both stages, each (n,).

    Returns the last deflection and flow. ``numbers`` are the values of a ``Path`` at each
    sample, or one row for all samples.
    """
    constant = len(numbers) == 1
    for k in range(len(velocity)):
        v = velocity[k]
        if k == 0 or not constant:
            strength, width = numbers[k][0], numbers[k][1]
            damping, stiffness = numbers[k][2], numbers[k][3]
            near, far = _GAMMA * period * stiffness, _REST * period * stiffness
            held = damping + near
        if deflection != deflection:  # NaN marks a settled start; three times as fast as math.isnan
            flow = stage = v
            force = strength * math.tanh(v / width) + damping * v
        else:
            between = last + _GAMMA * (v - last)
            force = deflection * stiffness
            stage = flow_of(strength, width, held, force + near * between, flow)
            load = force + far * (between - stage) + near * v
            flow = flow_of(strength, width, held, load, stage + _AHEAD * (stage - flow))
            force = load - near * flow
        last = v
        deflection = force / stiffness
        forces[k], early[k], flows[k] = force, stage, flow
    return deflection, flow


def flow_of(strength: float, width: float, held: float, load: float, guess: float) -> float:
    """Flow w [m/s] that solves strength tanh(w / width) + held w = load."""
    # The left side is odd in w and concave for w > 0, so Newton steps from below stay below.
    sign = 1.0
    if load < 0.0:
        sign, load, guess = -1.0, -load, -guess
    steepest, close = strength / width, _CLOSE * width
    least = load / (steepest + held)
    beyond = (load - strength) / held
    if beyond > least:
        least = beyond
    flow = guess if guess > least else least
    for _ in range(MOST_ITERATIONS):
        tanh = math.tanh(flow / width)
        steep = steepest * (1.0 - tanh * tanh)
        step = (load - strength * tanh - held * flow) / (steep + held)
        # Halley's step includes the curvature.
        bent = step * steep * tanh / (width * (steep + held))
        if -_LARGEST_CORRECTION < bent < _LARGEST_CORRECTION:
            step /= 1.0 - bent
        flow += step
        if flow < least:
            flow = least
        elif -close < step < close:
            break
    return sign * flow


class SeriesSprings(IntegratedModel):
    """Two parallel paths of a spring and a yield, one with a damper, and a parallel gas spring."""

    name = "series_springs"
    title = "springs in series, solved"
    source = (
        "this package; Maxwell's element with a yield, as in Iwan, J. Applied Mechanics 33, 1966"
    )
    equation = (
        r"F = F_1 + F_2 + k_0 u + f_0,\quad"
        r" F_1 = (1 - \varphi) f_y \tanh\frac{w_1}{w_y} + c\,w_1,\quad"
        r" F_2 = \varphi f_y \tanh\frac{w_2}{w_y},\quad"
        r" F_j = k_j x_j,\quad \dot x_j = v - w_j"
    )
    at_one_current = (
        Coefficient("f_y", "N", 0.0, degree=3, meaning="yield force"),
        Coefficient("w_y", "m/s", 1e-6, degree=1, meaning="velocity to the yield"),
        Coefficient("c", "N s/m", 0.0, degree=1, meaning="viscous damping"),
        Coefficient("k1", "N/m", 1.0, 1e12, 1, meaning="stiffness in series with the damper"),
        Coefficient("share", "1", 0.0, 1.0, meaning="share of the yield on the softer spring"),
        Coefficient("k2", "N/m", 1.0, 1e12, 1, meaning="stiffness of the softer spring"),
        Coefficient("k0", "N/m", meaning="stiffness of the gas"),
        Coefficient("f0", "N", meaning="constant force"),
    )
    memory = 5

    def integrate(
        self, coefficients: list[Array], motion: Motion, period: float, memory: list[float]
    ) -> Array:
        """Force [N] of both paths.

        The memory holds the deflection [m] and the flow [m/s] of each path, and the velocity.
        """
        force = np.zeros(motion.velocity.size)
        for place, path in zip((0, 2), _paths(coefficients), strict=True):
            start = *memory[place : place + 2], memory[4]
            (forces, *_), memory[place : place + 2] = _followed(
                path, motion.velocity, period, *start
            )
            force += forces
        memory[4] = float(motion.velocity[-1])
        return force

    def force_from(self, coefficients: Sequence[Array], motion: Motion, integrated: Array) -> Array:
        """Force [N]."""
        *_, stiffness, offset = coefficients
        return np.asarray(integrated + stiffness * motion.displacement + offset)

    def sensitivities(
        self, coefficients: list[Array], motion: Motion, period: float
    ) -> tuple[Mapping[int, Array], list[Recursion]]:
        """The derivatives of the force, and the recursion of the deflection of each path."""
        f_y, share = coefficients[0], coefficients[4]
        direct = {6: motion.displacement, 7: np.ones(f_y.size)}
        recursions = []
        for spring, path, part, sign in zip(
            (3, 5), _paths(coefficients), (1.0 - share, share), (-1.0, 1.0), strict=True
        ):
            direct[spring], kept, terms = _deflection(path, motion.velocity, period)
            strength, width, damping, stiffness = terms
            by = {0: part * strength, 1: width, 4: sign * f_y * strength, spring: stiffness}
            if spring == 3:
                by[2] = damping
            recursions.append(Recursion((coefficients[spring],), ((kept,),), (by,)))
        return direct, recursions

    @np.errstate(over="ignore", invalid="ignore")
    def follow_in_coil(
        self, parameters: Array, motion: Motion, current: Array, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; one set uses scalar code, because short blocks are frequent."""
        if parameters.ndim > 1 or runs_machine_code():
            return super().follow_in_coil(parameters, motion, current, period, state)
        amperes = current.tolist()
        constant = amperes.count(amperes[0]) == len(amperes)
        # Strength, width, damping and stiffness of each path, one row if the current is constant.
        paths: tuple[list[tuple[float, ...]], list[tuple[float, ...]]] = [], []
        values = parameters.tolist()
        for ampere in amperes[:1] if constant else amperes:
            f_y, w_y, c, stiffness, share, softer, gas, offset = self.numbers_at(values, ampere)
            paths[0].append(((1.0 - share) * f_y, w_y, c, stiffness))
            paths[1].append((share * f_y, w_y, 0.0, softer))
        velocity = motion.velocity.tolist()
        memory = [math.nan] * self.memory if state is None else [float(s) for s in state]
        force: Array = gas * motion.displacement + offset
        kept: list[float] = []
        for place, path in zip((0, 2), paths, strict=True):
            forces, early, flows = ([0.0] * len(velocity) for _ in range(3))
            start = memory[place], memory[place + 1], memory[4]
            kept += follow_path(velocity, path, forces, early, flows, period, *start)
            force += forces
        return force, tuple(np.array(value) for value in (*kept, velocity[-1]))

    def memory_length(self, parameters: Array, current: float) -> float:
        """A multiple of the deflection of the softer spring at its yield force.

        After this travel, a reversal no longer has an effect.
        """
        f_y, *_, share, softer, _, _ = self.coefficients_at(parameters, 0.0, current)[:, 0]
        return float(SETTLING * share * f_y / softer)

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """Starts with a narrow or wide yield and a small or large share on the softer spring."""
        force, middle, speed, amplitude = reading
        soft = 3.0 * force / amplitude
        return np.array(
            [
                [0.8 * force, width * speed, 0.2 * force / speed, 30.0 * soft, share, soft]
                + [0.0, middle]
                for width in (0.05, 0.3)
                for share in (0.05, 0.3)
            ]
        )

    def unsettled(self, window: Window, parameters: Array | None) -> np.ndarray:
        """Mask (n,) of samples at which the springs depend on the time before the window.

        Two solutions enclose the force for any past: their springs start at the full yield force in
        either direction, with their lowest stiffness. The integration steps preserve the order.
        """
        if parameters is None or window.history.periodic:
            return np.zeros(window.sample_count, dtype=bool)
        history = window.history.coarse
        motion, before = history.motion, float(history.motion.velocity[0])
        ends = np.array([np.min(history.current), np.max(history.current)])
        f_y, _, c, stiffness, share, softer, *_ = self.coefficients_at(parameters, 0.0, ends)
        first = ((1.0 - share[1]) * f_y[1] + c[1] * abs(before)) / stiffness.min()
        second = share[1] * f_y[1] / softer.min()
        forces = []
        for sign in (1.0, -1.0):
            parts = sign * first, 0.0, sign * second, 0.0, before
            state = tuple(np.array(part) for part in parts)
            force, _ = self.follow(parameters, motion, history.current, history.period, state)
            forces.append(force)
        apart = np.abs(forces[0] - forces[1]) > NEGLIGIBLE * float(np.ptp(forces[0]))
        count = int(np.max(np.flatnonzero(apart), initial=-1) + 1)
        return history.unsettled(count * history.period)


def _paths(coefficients: Sequence[Array]) -> tuple[Path, Path]:
    f_y, width, damping, stiffness, share, softer = coefficients[:6]
    first = (1.0 - share) * f_y, width, damping, stiffness
    return first, (share * f_y, width, np.zeros_like(damping), softer)
