"""Yield and viscous flow in series with a spring, and beside it a softer path that yields too.

The fluid flows at the velocity w, which is not that of the rod: the spring between them is what
``compliance`` of the extended law stands for, here solved as it is, sample by sample:

    f tanh(w / w_y) + c w = F = k x,    dx/dt = v - w

The spring keeps its deflection x where the current, and its stiffness with it, changes. This needs
no peak velocity. What rounds a small motion more than a large one is the way since the reversal,
not the speed: a part of the yield force is carried by a softer spring (two elements of the kind
that Iwan, J. Applied Mechanics 33, 1966, puts side by side), each with a yield of its own.

A step is the two-stage method of order two with gamma = 1 - 1/sqrt(2) (Alexander, SIAM J.
Numerical Analysis 14, 1977), L-stable: stable at any period, and a spring far too stiff for the
period is rigid, not ringing. Either stage is one rising equation for w. The derivatives by the
parameters follow the same steps, linearised: a recursion, solved for all of them at once.
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence, Sequence
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.current_dependence import (
    Coefficient,
    DifferentiatedModel,
    accumulated,
    along,
    at_samples,
    driven,
    integrated,
)
from mr_damper_ros.models.first_order_lag import coil_unsettled, few_in_coil
from mr_damper_ros.models.machine_code import as_machine_code, run_loop, runs_machine_code
from mr_damper_ros.models.quantities import LoopReading, State
from mr_damper_ros.signals.arrays import Array

_GAMMA = 1.0 - math.sqrt(0.5)
_REST = 1.0 - _GAMMA
_AHEAD = _REST / _GAMMA
_CLOSE = 4e-3
"""A flow is found once a step changes it by less than this part of the width of the yield: the next
would change it by a part of the order of this one's cube."""

_MOST_BENT = 0.5
"""Where the curve bends more within a step, it says nothing of where the flow is."""

_MOST_STEPS = 60


class PathState(NamedTuple):
    """Deflection of the spring [m], flow w [m/s] and velocity v [m/s]; NaN before a start."""

    deflection: float
    flow: float
    velocity: float


class SpringPath(NamedTuple):
    """Strength [N], width [m/s], damping [N s/m] and stiffness [N/m]; each (n,) or (1,)."""

    strength: Array
    width: Array
    damping: Array
    stiffness: Array

    def follow(
        self, velocity: Array, period: float, state: PathState
    ) -> tuple[PathState, list[Array]]:
        """State after velocities (n,) [m/s], and force [N] and flows of both stages, each (n,)."""
        numbers = np.stack(np.broadcast_arrays(*self), axis=-1)
        results, (deflection, flow) = run_loop(
            follow_path, (flow_of,), (velocity, numbers), 3, period, *state
        )
        return PathState(deflection, flow, float(velocity[-1])), results

    def derivatives(self, velocity: Array, period: float) -> tuple[dict[str, Array], Array, Array]:
        """What each step adds (n,) by each of the four, and the part (n,) of the force it keeps.

        Last: how much (n,) [N] is left of the force that a step begins with.
        """
        start = PathState(math.nan, math.nan, math.nan)
        _, (forces, early, flow) = self.follow(velocity, period, start)
        strength, width, damping, stiffness = (np.broadcast_to(c, flow.shape) for c in self)
        before = np.concatenate((velocity[:1], velocity[:-1]))
        between = before + _GAMMA * (velocity - before)
        near, far = (part * period * stiffness for part in (_GAMMA, _REST))
        slopes, by_both = [], []
        for w in (early, flow):
            tanh = np.tanh(w / width)
            steep = strength / width * (1.0 - tanh**2)
            slopes.append(steep + damping)
            by_both.append({"strength": tanh, "width": -steep * w / width, "damping": w})
        first, second = (1.0 / (slope + near) for slope in slopes)
        kept = slopes[1] * second * (1.0 - far * first)
        kept[0] = 0.0
        added = {}
        for name in ("strength", "width", "damping"):
            # Of the first stage: the flow, and through it the force that the second begins with.
            begin = far * first * by_both[0][name]
            added[name] = slopes[1] * second * begin + near * second * by_both[1][name]
            added[name][0] = by_both[1][name][0]
        of_near, of_far = near / stiffness, far / stiffness
        begin = of_far * (between - early) - far * first * of_near * (between - early)
        added["stiffness"] = slopes[1] * second * (begin + of_near * (velocity - flow))
        added["stiffness"][0] = 0.0
        kept[1:] *= stiffness[1:] / stiffness[:-1]
        carried = kept * np.concatenate(([0.0], forces[:-1]))
        return added, kept, carried


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
    """Deflection and flow after n samples; fills the force and the flows of both stages, each (n,).

    ``numbers`` are those of a :class:`SpringPath` at each sample, or once for all.
    """
    constant = len(numbers) == 1
    for k in range(len(velocity)):
        v = velocity[k]
        if k == 0 or not constant:
            strength, width = numbers[k][0], numbers[k][1]
            damping, stiffness = numbers[k][2], numbers[k][3]
            near, far = _GAMMA * period * stiffness, _REST * period * stiffness
            held = damping + near
        if deflection != deflection:  # NaN: a start, settled; three times as fast as math.isnan
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
    """Flow w [m/s] with strength tanh(w / width) + held w = load."""
    # The left side is odd in w, and bends down where w > 0: from below Newton's steps rise.
    sign = 1.0
    if load < 0.0:
        sign, load, guess = -1.0, -load, -guess
    steepest, close = strength / width, _CLOSE * width
    least = load / (steepest + held)
    beyond = (load - strength) / held
    if beyond > least:
        least = beyond
    flow = guess if guess > least else least
    for _ in range(_MOST_STEPS):
        tanh = math.tanh(flow / width)
        steep = steepest * (1.0 - tanh * tanh)
        step = (load - strength * tanh - held * flow) / (steep + held)
        # Halley's step: it knows how the curve bends.
        bent = step * steep * tanh / (width * (steep + held))
        if -_MOST_BENT < bent < _MOST_BENT:
            step /= 1.0 - bent
        flow += step
        if flow < least:
            flow = least
        elif -close < step < close:
            break
    return sign * flow


_FORGOTTEN = 0.01
"""A past is forgotten where it changes the force by less than this part of its span."""

_SETTLED = 7.0
"""So many times the way that the softer spring gives, and the reversal before is forgotten."""


class SeriesSprings(DifferentiatedModel):
    """Two springs, each in series with a yield, one of these with a damper; the gas beside them."""

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
        Coefficient("w_y", "m/s", 1e-6, degree=1, meaning="width of the yield"),
        Coefficient("c", "N s/m", 0.0, degree=1, meaning="viscous damping"),
        Coefficient("k1", "N/m", 1.0, 1e12, 1, meaning="stiffness in series with the damper"),
        Coefficient("share", "1", 0.0, 1.0, meaning="share of the yield on the softer spring"),
        Coefficient("k2", "N/m", 1.0, 1e12, 1, meaning="stiffness of the softer spring"),
        Coefficient("k0", "N/m", meaning="stiffness of the gas"),
        Coefficient("f0", "N", meaning="constant force"),
    )
    remembers = True
    memory = 5

    def force_at(
        self, coefficients: Sequence[Array], motion: Motion, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; remembered are deflection and flow of either path, and the last velocity."""
        *paths, stiffness, offset = coefficients
        force, kept = integrated(_both_paths, paths, motion, period, state, self.memory)
        return np.asarray(force + stiffness * motion.displacement + offset), kept

    def follow(
        self, parameters: Array, motion: Motion, current: Array, period: float, state: State | None
    ) -> tuple[Array, State]:
        """Force [N]; of one set in plain numbers, since blocks of few samples come often."""
        if parameters.ndim > 1 or runs_machine_code():
            return super().follow(parameters, motion, current, period, state)
        amperes, supply = self._one_in_coil(parameters, current, period, state)
        paths, (stiffness, offset) = self._numbers_at(parameters, amperes)
        velocity = motion.velocity.tolist()
        memory = [math.nan] * self.memory if state is None else [float(s) for s in state[:5]]
        force: Array = stiffness * motion.displacement + offset
        kept: list[float] = []
        for place, path in zip((0, 2), paths, strict=True):
            forces, early, flows = ([0.0] * len(velocity) for _ in range(3))
            start = memory[place], memory[place + 1], memory[4]
            kept += follow_path(velocity, path, forces, early, flows, period, *start)
            force += forces
        return force, tuple(np.array(value) for value in (*kept, velocity[-1], *supply))

    def _one_in_coil(
        self, parameters: Array, current: Array, period: float, state: State | None
    ) -> tuple[list[float], tuple[float, ...]]:
        """Current of the coil at the samples [A], one where it is constant, and what is remembered.

        That is the supply's and the coil's after them, nothing where the coil does not lag.
        """
        tau, supplied = float(parameters[-1]), current.tolist()
        if not tau > 0.0:
            constant = supplied.count(supplied[0]) == len(supplied)
            return supplied[:1] if constant else supplied, ()
        before = None
        if state is not None and len(state) > self.memory:
            before = float(state[self.memory]), float(state[self.memory + 1])
        in_coil, remembered = few_in_coil(supplied, tau, period, before)
        constant = in_coil.count(in_coil[0]) == len(in_coil)
        return in_coil[:1] if constant else in_coil, remembered

    def _numbers_at(
        self, parameters: Array, amperes: list[float]
    ) -> tuple[tuple[_Numbers, _Numbers], tuple[float, float]]:
        """The two paths at currents [A], one or those of the samples, and k0 and f0."""
        values = parameters.tolist()
        share, gas, offset = (self.number_at(values, place, 0.0) for place in (4, 6, 7))
        first, second = [], []
        for current in amperes:
            f_y, w_y, c, stiffness, softer = (
                self.number_at(values, place, current) for place in (0, 1, 2, 3, 5)
            )
            first.append(((1.0 - share) * f_y, w_y, c, stiffness))
            second.append((share * f_y, w_y, 0.0, softer))
        return (first, second), (gas, offset)

    def memory_length(self, parameters: Array, current: float) -> float:
        """Some times the way that the softer spring gives under its yield force."""
        f_y, *_, share, softer, _, _ = self.coefficients_at(parameters, 0.0, current)[:, 0]
        return float(_SETTLED * share * f_y / softer)

    def starts_at_one_current(self, reading: LoopReading) -> Array:
        """A narrow or a wide yield, the softer path apart from the other or hardly there."""
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

    @as_machine_code()
    def settled(self, window: Window, parameters: Array | None) -> np.ndarray:
        """Mask (n,) of samples at which the two springs and the coil have forgotten the past.

        Whatever it was, the force lies between those from springs under all of the yield force and
        under all of its reverse, where they are softest: the steps keep their order.
        """
        if parameters is None or window.history.periodic:
            return np.ones(window.sample_count, dtype=bool)
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
        apart = np.abs(forces[0] - forces[1]) > _FORGOTTEN * float(np.ptp(forces[0]))
        count = int(np.max(np.flatnonzero(apart), initial=-1) + 1)
        unknown = history.unsettled(count * history.period)
        return ~(unknown | coil_unsettled(window, float(parameters[-1])))

    @as_machine_code()
    @np.errstate(over="ignore", invalid="ignore")
    def window_derivatives(
        self, window: Window, parameters: Array, columns: Sequence[int]
    ) -> Array:
        """Derivatives (n, p) of :meth:`window_force` by the parameters of some columns."""
        motion, period, values, chain = along(self, window, parameters, columns)
        # By columns, which lie together in memory.
        result = (chain[6].T * motion.displacement + chain[7].T).T
        for spring, path, recursion, carried in self._derivatives_along(values, motion, period):
            added = driven(path, chain)
            if chain.shape[1] > 1:
                # A spring keeps its deflection while its stiffness changes: the force changes.
                stiffened = np.diff(chain[spring] / values[spring][:, np.newaxis], axis=0)
                added[1:] += carried[1:, np.newaxis] * stiffened
            result += accumulated(recursion, added)
        return at_samples(window, result)

    def _derivatives_along(
        self, values: Sequence[Array], motion: Motion, period: float
    ) -> list[tuple[int, dict[int, Array], Array, Array]]:
        """Of either path: the place of its stiffness, and what a step does to its force.

        That is what it adds by coefficient, the part that it keeps, and how much of the force [N]
        that it begins with is left.
        """
        f_y, w_y, c, stiffness, share, softer = values[:6]
        nothing = np.zeros(f_y.size)
        first = SpringPath((1.0 - share) * f_y, w_y, c, stiffness)
        second = SpringPath(share * f_y, w_y, nothing, softer)
        ways = []
        for spring, path, part, sign, others in (
            (3, first, 1.0 - share, -1.0, {2: "damping"}),
            (5, second, share, 1.0, {}),
        ):
            by, kept, carried = path.derivatives(motion.velocity, period)
            places = {0: part * by["strength"], 1: by["width"], 4: sign * f_y * by["strength"]}
            places[spring] = by["stiffness"]
            places.update({place: by[name] for place, name in others.items()})
            ways.append((spring, places, kept, carried))
        return ways


def _both_paths(
    coefficients: list[Array], motion: Motion, period: float, memory: list[float]
) -> Array:
    """Force [N] of both paths, shape (n,).

    The memory holds the deflection [m] and the flow w of either, and the velocity.
    """
    f_y, w_y, c, stiffness, share, softer = coefficients
    last, force = memory[4], np.zeros(motion.velocity.size)
    paths = (
        SpringPath((1.0 - share) * f_y, w_y, c, stiffness),
        SpringPath(share * f_y, w_y, np.zeros(1), softer),
    )
    for place, path in zip((0, 2), paths, strict=True):
        state = PathState(memory[place], memory[place + 1], last)
        (*memory[place : place + 2], memory[4]), (forces, *_) = path.follow(
            motion.velocity, period, state
        )
        force += forces
    return force


_Numbers = list[tuple[float, float, float, float]]
"""Strength, width, damping and stiffness of a path, at each sample or once for all."""
