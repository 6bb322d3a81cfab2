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
from collections.abc import Callable, MutableSequence, Sequence
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.current_dependence import Coefficient
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.quantities import State
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
_SMALL_RATE = 1e-4


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
    """The last z and the last velocity of a hysteresis that the rod drives; fills z (n,)."""
    for k in range(len(velocity)):
        v = velocity[k]
        if z != z:  # NaN: a start
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
    period: float,
    k0: float,
    share: float,
    power: float,
    z: float,
    s: float,
    last: float,
) -> tuple[float, float, float]:
    """The last z, s and velocity where a hysteresis and a damper are in series with another.

    Fills the velocity (n,) [m/s] of the point between. ``numbers`` (n, 5): damping beside the
    hysteresis and both dampings [N s/m], force of full yield [N], what half a step of s is to its
    rate [s], way to the yield [m].
    """
    for k in range(len(velocity)):
        v = velocity[k]
        c0, both, alpha = numbers[k][0], numbers[k][1], numbers[k][2]
        easing, length = numbers[k][3], numbers[k][4]
        if z != z:  # NaN: a start
            z = s = 0.0
        else:
            # Strang's splitting: half a step of s, a step of z, half a step of s.
            w = 0.5 * (v + last)
            s += easing * (w - (alpha * z + c0 * w + k0 * s) / both)
            slip = w - (alpha * z + c0 * w + k0 * s) / both
            z = hysteresis_step(z, slip, alpha / both, length, share, power, period)
            s += easing * (w - (alpha * z + c0 * w + k0 * s) / both)
        last = v
        inner[k] = (alpha * z + c0 * v + k0 * s) / both
    return z, s, last


class StepDerivatives(NamedTuple):
    """What a step keeps of z, and what it adds by the way to the yield, the share and the power.

    Each of shape (n,); the first belongs to the start, which is at rest.
    """

    kept: Array
    by_length: Array
    by_share: Array
    by_power: Array


def step_derivatives(
    z: Array, velocity: Array, length: Array, share: Array, power: Array, period: float
) -> StepDerivatives:
    """Derivatives of :func:`hysteresis_step` along the states z (n,), each after its step.

    The driving velocity is the mean of two samples, and does not depend on z.
    """
    before = np.concatenate(([0.0], z[:-1]))
    w = np.concatenate(([0.0], 0.5 * (velocity[1:] + velocity[:-1])))
    size, sign = np.abs(before), np.sign(before)
    along = sign * np.sign(w)
    towards = share + (1.0 - share) * along
    # At z = 0 nothing bends; its logarithm would be none.
    some = np.where(size > 0.0, size, 1.0)
    here = np.where(size > 0.0, 1.0, 0.0)
    raised, less, log = size**power, here * some ** (power - 1.0), here * np.log(some)
    gain = (1.0 - raised * towards) / length
    slope = power * less * sign / length
    x = -period * slope * towards * w
    inside = (x > -_STEEPEST) & (x < 1.0)
    x = np.clip(x, -_STEEPEST, 1.0)
    small = np.abs(x) < _SMALL_RATE
    safe = np.where(small, 1.0, x)
    eased = np.where(small, 1.0 + 0.5 * x, np.expm1(x) / safe)
    bends = np.where(small, 0.5 + x / 3.0, (np.exp(x) - eased) / safe) * inside

    def change(of_gain: Array, of_x: Array) -> Array:
        return np.asarray(period * w * (of_gain * eased + gain * bends * of_x))

    bent = power * (power - 1.0) * here * some ** (power - 2.0) * towards / length
    kept = 1.0 + change(-slope * towards, -period * w * bent)
    by_length = change(-gain / length, -x / length)
    other = 1.0 - along
    by_share = change(-raised * other / length, -period * w * slope * other)
    by_power = change(
        -raised * log * towards / length,
        -period * w * less * (1.0 + power * log) * sign * towards / length,
    )
    # Where the step was held at full yield nothing moves it.
    moves = np.abs(z) < 1.0
    moves[0] = False
    return StepDerivatives(*(moves * part for part in (kept, by_length, by_share, by_power)))


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
