"""The evolving variable of Bouc and Wen, integrated stably at the samples' own period.

Spencer, Dyke, Sain and Carlson, J. Engineering Mechanics 123, 1997; thesis eq. 1-6. The published
parameters A, beta, gamma and alpha hold one too many: z and alpha can be scaled against each other
(Ma, Zhang, Bockstedte, Foliente and Paevere, J. Applied Mechanics 71, 2004). Here |z| tends to 1:

    dz/dt = (w - |z|^n (share w + (1 - share) |w| sgn z)) / yield_length,    w the driving velocity

so A = 1/yield_length, beta = share A, gamma = (1 - share) A, and alpha is the force of full yield.

A step is an exponential Rosenbrock-Euler step: exact for an equation linear in z, of second order;
that |z| never exceeds 1 is kept, so it is stable for any period.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.current_dependence import Coefficient
from mr_damper_ros.models.force_model import Model, State
from mr_damper_ros.signals.arrays import Array

HYSTERESIS = (
    Coefficient("alpha", "N", 0.0, degree=2, meaning="force of full yield"),
    Coefficient("yield_length", "m", 1e-6, 1.0, degree=1, meaning="way to the yield"),
    Coefficient("share", "1", 0.0, 1.0, meaning="share of the loop that unloads elastically"),
    Coefficient("n", "1", 1.0, 6.0, meaning="sharpness of the yield"),
)
"""The coefficients of the hysteresis; force and width follow the current."""

_YIELDS = 10.0
"""So many times the way to the yield, and a hysteresis has forgotten where it began."""

_STEEPEST = 60.0


def memory_length(model: Model, parameters: Array, current: float) -> float:
    """Way [m] after which a law with a hysteresis has forgotten the past: it knows no time."""
    place = model.coefficient_names.index("yield_length")
    return _YIELDS * float(model.coefficients_at(parameters, 0.0, current)[place, 0])


Integrate = Callable[[list[Array], Motion, float, list[float]], Array]
"""Takes coefficients of one set, each (1 or n), and leaves its last state in the list given."""


def relaxation(rate: float) -> float:
    """(e^x - 1)/x, 1 at x = 0; growth within a step is bounded."""
    x = min(max(rate, -_STEEPEST), 1.0)
    return math.expm1(x) / x if x != 0.0 else 1.0


def hysteresis_step(
    z: float,
    w: float,
    back: float,
    length: float,
    share: float,
    power: float,
    period: float,
) -> float:
    """State z after one step at the velocity w; ``back`` is minus the derivative of w by z.

    A run has thousands of steps, so nothing is called here that plain comparisons can do.
    """
    size, sign = (z, 1.0) if z > 0.0 else (-z, -1.0) if z < 0.0 else (0.0, 0.0)
    along = sign if w > 0.0 else -sign if w < 0.0 else 0.0
    towards = share + (1.0 - share) * along
    gain = (1.0 - size**power * towards) / length
    bend = power * size ** (power - 1.0) * sign * towards / length
    x = -period * (bend * w + gain * back)
    if x < -_STEEPEST:
        x = -_STEEPEST
    elif x > 1.0:
        x = 1.0
    moved = z + period * gain * w * (math.expm1(x) / x if x != 0.0 else 1.0)
    # The exact solution never leaves this range, which a step much longer than the yield could.
    return 1.0 if moved > 1.0 else -1.0 if moved < -1.0 else moved


def integrated(
    integrate: Integrate,
    coefficients: Sequence[Array],
    motion: Motion,
    period: float,
    state: State | None,
    size: int,
) -> tuple[Array, State]:
    """Integrate the sets one after the other, which beats arrays up to some thirty of them.

    The coefficients have shape (..., 1 or n); the integrated quantity (..., n) and the state after
    it are returned. At a start all ``size`` numbers of the state are NaN.
    """
    shape = np.broadcast_shapes(*(c.shape[:-1] for c in coefficients))
    every = [np.broadcast_to(c, (*shape, c.shape[-1])) for c in coefficients]
    result = np.empty((*shape, motion.velocity.size))
    kept = np.full((size, *shape), math.nan) if state is None else np.array(state)
    for place in np.ndindex(shape):
        memory = kept[(slice(None), *place)].tolist()
        result[place] = integrate([c[place] for c in every], motion, period, memory)
        kept[(slice(None), *place)] = memory
    return result, tuple(kept)


def each_sample(coefficient: Array, count: int) -> list[float]:
    """A coefficient (1,) or (n,) as the numbers of n samples."""
    return coefficient.tolist() * (count // coefficient.size)
