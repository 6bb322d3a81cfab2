"""A spring in series with a yield and a damper, step by step.

    f tanh(w / w_y) + c w = F = k x,    dx/dt = v - w

A step is the two-stage method of order two with gamma = 1 - 1/sqrt(2) (Alexander, SIAM J.
Numerical Analysis 14, 1977), L-stable: stable at any period, and a spring far too stiff for the
period is rigid, not ringing. Either stage is one rising equation for w. The derivatives by the four
numbers of a path follow the same steps, linearised.
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence, Sequence
from typing import NamedTuple

import numpy as np

from mr_damper_ros.models.machine_code import run_loop
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
