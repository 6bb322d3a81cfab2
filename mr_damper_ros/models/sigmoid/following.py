"""The sigmoid laws along a motion, block by block, with or without the jump where it turns.

The law shifts the velocity by sgn(a) v_h: the force jumps from one branch to the other within a
sample where the acceleration changes its sign, and back and forth where that is lost in noise.
Recorded forces do not. Along a branch of negative v_h the law's velocity v + sgn(a) v_h is that of
a body with a play of -v_h behind v; without the jump it is so also where the motion turns: the
shift follows the velocity (a play operator; Visintin, Differential Models of Hysteresis, 1994),

    s[k] = clip(s[k-1] + (v[k] - v[k-1]) / |v_h|, -1, 1)    in the place of sgn(a).

It depends on the path of the velocity, not on its rate, and is the law once the velocity has come
back by 2 |v_h|. It needs no parameter.

Of the state, the branch comes first (without the jump), then what the lag remembers, then the
supply's and the coil's current, where the coil lags.
"""

from __future__ import annotations

import math
from itertools import repeat

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.first_order_lag import coil_current, coil_state, few_in_coil, lagged
from mr_damper_ros.models.formulas import staged
from mr_damper_ros.models.quantities import State
from mr_damper_ros.models.sigmoid.extension import (
    SIGMOID_COUNT,
    Extension,
    LagMemory,
    extension_of,
    is_extended,
    late_after,
)
from mr_damper_ros.models.sigmoid.law import (
    LAW,
    NARROWEST,
    PARAMETER_NAMES,
    force_and_damping,
    force_from_coefficients,
    operating_point_coefficients,
)
from mr_damper_ros.signals.arrays import Array

BRANCH_MEMORY = 2
"""Arrays of the state without the jump: the last velocity [m/s] and the last branch."""

FEW = 64
"""Samples up to which scalars take less time than arrays: NumPy takes a microsecond for each of a
hundred operations, however few the numbers."""

_sample = staged(
    LAW,
    [PARAMETER_NAMES, ("i",), ("v", "v_m", "s", "change")],
    ("force", "damping", "branch"),
    arrays=False,
)


def follow(
    parameters: Array,
    motion: Motion,
    current: Array,
    period: float,
    state: State | None,
    *,
    jumps: bool,
) -> tuple[Array, State]:
    """As :meth:`Model.follow`, for parameters (..., 16) or (..., 20)."""
    if parameters.ndim == 1 and motion.velocity.size <= FEW:
        return _follow_few(parameters, motion, current, period, state, jumps)
    own = own_state(state, jumps=jumps)
    extended = is_extended(parameters)
    supply: State = ()
    turning: State = ()
    if extended and np.any(parameters[..., -1] > 0.0):
        before = None if own is None else coil_state(own[3:])
        in_coil = coil_current(current, parameters[..., -1], period, before)
        supply = (np.full(in_coil.shape[:-1], current[-1]), in_coil[..., -1])
        current = in_coil
    coefficients = operating_point_coefficients(
        parameters[..., :SIGMOID_COUNT], motion.peak_velocity, current
    )
    acceleration = motion.acceleration
    if not jumps:
        branch, turning = branch_along(motion.velocity, acceleration, coefficients.v_h, state)
        # The branch is in the shift: no sign of the acceleration is left to count.
        coefficients = coefficients._replace(v_h=coefficients.v_h * branch)
        acceleration = np.ones(motion.velocity.size)
    if not extended:
        return force_from_coefficients(coefficients, motion.velocity, acceleration), turning
    plain, damping = force_and_damping(coefficients, motion.velocity, acceleration)
    extension = Extension(*np.moveaxis(parameters[..., SIGMOID_COUNT:-1, np.newaxis], -2, 0))
    constant = extension.time_constant(damping)
    late = lagged(plain, constant, period, state=None if own is None else own[:3])
    force = np.asarray(late + extension.gas(motion.displacement))
    return force, (*turning, plain[..., -1], late[..., -1], constant[..., -1], *supply)


def _follow_few(
    parameters: Array,
    motion: Motion,
    current: Array,
    period: float,
    state: State | None,
    jumps: bool,
) -> tuple[Array, State]:
    """The same for one set, sample by sample."""
    at_current = _sample(*parameters[:SIGMOID_COUNT].tolist())
    own = own_state(state, jumps=jumps)
    currents: list[float] = current.tolist()
    extension, late = None, None
    supply: tuple[float, ...] = ()
    if is_extended(parameters):
        extension, late = extension_of(parameters), lag_before(own)
        coil = float(parameters[-1])
        if coil > 0.0:
            before = None if own is None or len(own) == 3 else (float(own[3]), float(own[4]))
            currents, supply = few_in_coil(currents, coil, period, before)
    branch, last = branch_before(None if jumps else state, float(motion.acceleration[0]))
    branches = np.sign(motion.acceleration).tolist() if jumps else repeat(branch)
    columns = (motion.velocity, motion.peak_velocity, motion.displacement)
    rows = zip(branches, currents, *(column.tolist() for column in columns), strict=False)
    known, forces, change = math.nan, [], 0.0
    for sign, amperes, v, v_m, u in rows:
        if amperes != known:
            known, sample = amperes, at_current(amperes)
        if jumps:
            branch = sign
        elif last is not None:
            change = v - last
        force, damping, branch = sample(v, v_m, branch, change)
        last = v
        if extension is not None:
            late = late_after(force, damping, extension, period, late)
            force = late.force + extension.gas(u)
        forces.append(force)
    remembered = (*(() if jumps else (last, branch)), *(late or ()), *supply)
    return np.array(forces), tuple(map(np.array, remembered))


def own_state(state: State | None, *, jumps: bool) -> State | None:
    """What of a state is not the branch; None at a start."""
    return None if state is None else state[0 if jumps else BRANCH_MEMORY :]


def lag_before(own: State | None) -> LagMemory | None:
    """What :func:`own_state` says of the lag; None at a start."""
    return None if own is None else LagMemory(*map(float, own[:3]))


def branch_before(state: State | None, acceleration: float) -> tuple[float, float | None]:
    """The branch before a sample, and the velocity [m/s], which a state without the jump begins
    with.

    Without a state it is the branch of the acceleration, and no velocity.
    """  # noqa: D205
    if not state:
        return (acceleration > 0.0) - (acceleration < 0.0), None
    return float(state[1]), float(state[0])


def branch_along(
    velocity: Array, acceleration: Array, half_width: Array, before: State | None
) -> tuple[Array, State]:
    """The branch s (..., n), -1 to 1, along a velocity (n,), and the state after it.

    ``half_width`` (..., n) [m/s] is v_h, of either sign; ``before`` the state after the sample
    before, which may hold more. It starts on the branch of the acceleration (n,).
    """
    shape = np.broadcast_shapes(half_width.shape, velocity.shape)
    if before is None:
        last = velocity[0]
        branch = np.broadcast_to(np.sign(acceleration[0]), shape[:-1])
    else:
        last, branch = before[0].flat[0], before[1]
    changes = np.diff(velocity, prepend=last)
    steps = np.broadcast_to(changes / np.maximum(np.abs(half_width), NARROWEST), shape)
    rising = changes >= 0.0
    found = np.empty(shape)
    # Up to where the velocity turns it goes one way only.
    ends = [*(np.flatnonzero(rising[1:] != rising[:-1]) + 1).tolist(), velocity.size]
    first = 0
    for end in ends:
        stretch = branch[..., np.newaxis] + np.cumsum(steps[..., first:end], axis=-1)
        found[..., first:end] = (
            np.minimum(stretch, 1.0) if rising[first] else np.maximum(stretch, -1.0)
        )
        branch, first = found[..., end - 1], end
    return found, (np.full(shape[:-1], velocity[-1]), branch)
