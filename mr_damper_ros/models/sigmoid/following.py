"""The force of the sigmoid laws along a motion, and at one sample as a function of the current.

*Without the jump at a reversal.* The law shifts the velocity by sgn(a) v_h. The force therefore
jumps from one branch to the other within a sample when the acceleration changes sign, and back and
forth when noise dominates the acceleration. Measured forces do not jump. With a negative v_h, the
velocity v + sgn(a) v_h of the law is the velocity of a body that follows v with a play of -v_h.
Without the jump this also holds at a reversal: the shift follows the velocity (a play operator;
Visintin, Differential Models of Hysteresis, 1994),

    s[k] = clip(s[k-1] + (v[k] - v[k-1]) / |v_h|, -1, 1)    instead of sgn(a).

The branch s depends on the path of the velocity, not on its rate. The branch agrees with the law
once the velocity has changed by 2 |v_h| after a reversal. This rule needs no additional parameter.

*The extended law* adds a compliance, a stiffness and an offset. The fluid, the rod and the mounts
are elastic; such a spring in series with the damper (a Maxwell element) delays the force. With the
sigmoid force F_s,

    tau dF_l/dt + F_l = F_s,  tau = compliance * f_t tanh(alpha x / 2) / x,
    x = v + sgn(a) v_h + v_d,

where the fraction is the equivalent damping of the sigmoid at the velocity x. The lag is therefore
long near a reversal, where the force is steep, and short while the fluid flows. The lag increases
with the yield force, that is with the current. The force is F_l + stiffness u + offset, where
stiffness and offset describe the gas (thesis 3.2; the thesis adds 100 N to its records by hand).
doc/extended_law.md describes the alternatives that were tried. The parameters of the extended law
are the sixteen of the sigmoid law, the three of :data:`EXTENSION_NAMES` and the time constant of
the coil.

The state contains the branch (without the jump), then the memory of the lag.

*Over the current.* Only the gains of yield force and width depend on the current, and they do not
depend on the motion. The terms of the current are computed once for a set, and the terms of the
motion once for a sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from itertools import repeat
from typing import Any

import numpy as np

from mr_damper_ros.kinematics.motion import Motion, MotionSample
from mr_damper_ros.models.first_order_lag import COIL, LAG, lagged
from mr_damper_ros.models.force_model import CurrentResponse
from mr_damper_ros.models.formulas import Formulas, staged
from mr_damper_ros.models.quantities import State
from mr_damper_ros.models.sigmoid.law import (
    LAW,
    NARROWEST,
    PARAMETER_NAMES,
    force_and_damping,
    operating_point_coefficients,
    quiet,
)
from mr_damper_ros.signals.arrays import FEW, Array

EXTENDED_MODEL = "sigmoid_lag"
"""Name of the extended law in ``MODELS``."""

COMPLIANCE = "compliance"
"""The parameter that causes the lag; it must not be negative."""

EXTENSION_NAMES = (COMPLIANCE, "stiffness", "offset")
"""The three parameters of the extension: [m/N], [N/m], [N]."""

EXTENDED_NAMES = (*PARAMETER_NAMES, *EXTENSION_NAMES, COIL)
"""The twenty parameters of the extended law, in the order of its parameter arrays."""

SIGMOID_COUNT = len(PARAMETER_NAMES)


_COMPLIANCE, _STIFFNESS, _OFFSET = range(SIGMOID_COUNT, SIGMOID_COUNT + len(EXTENSION_NAMES))


def time_constant(parameters: Array, damping: Array) -> Array:
    """Time constant [s] of the lag at this damping (..., n) [N s/m] of the sigmoid; at least 0."""
    return np.maximum(parameters[..., _COMPLIANCE, np.newaxis] * damping, 0.0)


def gas_force(parameters: Array, displacement: Array) -> Array:
    """Force [N] of stiffness and offset at a displacement (n,) [m]."""
    stiffness, offset = (
        parameters[..., _STIFFNESS, np.newaxis],
        parameters[..., _OFFSET, np.newaxis],
    )
    return np.asarray(stiffness * displacement + offset)


EXTENDED_LAW: Formulas = (
    *LAW,
    ("value", "force"),
    ("tau", f"larger({COMPLIANCE} * damping, 0.0)"),
    *LAG,
    ("late", "where(started, lagged, force)"),
    ("total", "late + (stiffness * u + offset)"),
)
"""The extended law; ``started`` is 0 at the first sample, which has no lag, and 1 later."""

_LAG = ("started", "value_before", "lagged_before", "tau_before")

LAG_MEMORY = len(_LAG[1:])
"""Number of arrays in the state of the lag: force, lagged force [N] and time constant [s]."""


# -- along a motion

BRANCH_MEMORY = 2
"""Number of arrays in the state without the jump: the last velocity [m/s] and the last branch."""

_SAMPLE_LAWS = [
    staged(
        EXTENDED_LAW,
        [names, ("i", "period"), ("v_m",), ("v", "s", "change", "u", *_LAG)],
        results,
        scalars=4,
    )
    for names, results in (
        (PARAMETER_NAMES, ("force", "branch")),
        (EXTENDED_NAMES, ("total", "branch", "force", "late", "tau")),
    )
]
"""Laws of one sample, without and with the extension: force, branch, and state of the lag."""


def follow(
    parameters: Array,
    motion: Motion,
    current: Array,
    period: float,
    state: State | None,
    *,
    jumps: bool,
) -> tuple[Array, State]:
    """As :meth:`Model.follow_in_coil`, for parameters (..., 16) or (..., 20)."""
    few = parameters.ndim == 1 and motion.velocity.size <= FEW
    along = _follow_few if few else _follow_many
    return along(parameters, motion, current, period, state, jumps)


@quiet
def _follow_many(
    parameters: Array,
    motion: Motion,
    current: Array,
    period: float,
    state: State | None,
    jumps: bool,
) -> tuple[Array, State]:
    """:func:`follow` in array code."""
    turning: State = ()
    coefficients = operating_point_coefficients(
        parameters[..., :SIGMOID_COUNT], motion.peak_velocity, current
    )
    acceleration = motion.acceleration
    if not jumps:
        branch, turning = branch_along(motion.velocity, acceleration, coefficients.v_h, state)
        # The branch is already a factor of v_h, so the sign of the acceleration is set to 1.
        coefficients = coefficients._replace(v_h=coefficients.v_h * branch)
        acceleration = np.ones(motion.velocity.size)
    plain, damping = force_and_damping(coefficients, motion.velocity, acceleration)
    if parameters.shape[-1] == SIGMOID_COUNT:
        return plain, turning
    constant = time_constant(parameters, damping)
    late = lagged(plain, constant, period, None if state is None else state[-LAG_MEMORY:])
    force = late + gas_force(parameters, motion.displacement)
    return force, (*turning, plain[..., -1], late[..., -1], constant[..., -1])


def _follow_few(
    parameters: Array,
    motion: Motion,
    current: Array,
    period: float,
    state: State | None,
    jumps: bool,
) -> tuple[Array, State]:
    """:func:`follow` for one set, sample by sample."""
    at_current = _SAMPLE_LAWS[parameters.size > SIGMOID_COUNT](*parameters.tolist())
    branch, last, lag = _before(state, float(motion.acceleration[0]), jumps=jumps)
    columns = (current, motion.velocity, motion.peak_velocity, motion.displacement)
    signs = np.sign(motion.acceleration).tolist() if jumps else repeat(branch)
    known, known_peak, forces, change = math.nan, math.nan, [], 0.0
    for sign, amperes, v, v_m, u in zip(signs, *map(np.ndarray.tolist, columns), strict=False):
        if amperes != known:
            known, known_peak, at_peak = amperes, math.nan, at_current(amperes, period)
        if v_m != known_peak:
            known_peak, sample = v_m, at_peak(v_m)
        if jumps:
            branch = sign
        elif last is not None:
            change = v - last
        force, branch, *late = sample(v, branch, change, u, *lag)
        if late:
            lag = (1.0, *late)
        last = v
        forces.append(force)
    return np.array(forces), tuple(map(np.array, (*(() if jumps else (last, branch)), *late)))


def _before(
    state: State | None, acceleration: float, *, jumps: bool
) -> tuple[float, float | None, tuple[float, ...]]:
    """Branch, velocity [m/s] and the inputs ``_LAG`` before a sample.

    At a start, or with the jump, the branch is the sign of the acceleration and the velocity None.
    The state may end with the coil's state.
    """
    numbers = [float(part) for part in state or ()]
    turning, lag = ([], numbers) if jumps else (numbers[:BRANCH_MEMORY], numbers[BRANCH_MEMORY:])
    last, branch = turning or (None, (acceleration > 0.0) - (acceleration < 0.0))
    return branch, last, (1.0, *lag[:LAG_MEMORY]) if lag else (0.0,) * len(_LAG)


def branch_along(
    velocity: Array, acceleration: Array, half_width: Array, before: State | None
) -> tuple[Array, State]:
    """The branch s (..., n), from -1 to 1, along a velocity (n,), and the state after it.

    ``half_width`` (..., n) [m/s] is v_h, of either sign. ``before`` is the previous state; values
    after the branch are ignored. None starts with the sign of the acceleration (n,).
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
    # Between two extremes of the velocity the branch is monotonic.
    ends = [*(np.flatnonzero(rising[1:] != rising[:-1]) + 1).tolist(), velocity.size]
    first = 0
    for end in ends:
        stretch = branch[..., np.newaxis] + np.cumsum(steps[..., first:end], axis=-1)
        found[..., first:end] = (
            np.minimum(stretch, 1.0) if rising[first] else np.maximum(stretch, -1.0)
        )
        branch, first = found[..., end - 1], end
    return found, (np.full(shape[:-1], velocity[-1]), branch)


# -- over the current

_MOTION = ("scale", "alpha", "viscous", "centred", "width")
"""Formulas that depend only on the motion."""

_of_motion = staged(LAW, [PARAMETER_NAMES, ("v", "v_m")], _MOTION, scalars=2)


@cache
def _over_current(extended: bool) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compiled law over the current: scalar for one sample, arrays for many samples."""
    names, result = (EXTENDED_NAMES, "total") if extended else (PARAMETER_NAMES, "force")
    seen = (*_MOTION, "s", "change", "u", "period", *_LAG)
    return (
        staged(EXTENDED_LAW, [names, seen, ("i",)], (result,), scalars=3),
        staged(EXTENDED_LAW, [names, ("i",), seen], (result,), scalars=1),
    )


class SigmoidCurrentResponse(CurrentResponse):
    """Response of a set (16,) or (20,); motion terms are computed in scalar code."""

    def __init__(self, parameters: Array, *, jumps: bool) -> None:
        self._jumps = jumps
        numbers = parameters.tolist()
        self._motion = _of_motion(*numbers[:SIGMOID_COUNT])
        laws = _over_current(len(numbers) > SIGMOID_COUNT)
        self._scalar, self._arrays = (law(*numbers) for law in laws)
        self._latest: tuple[Array, Callable[..., Any]] | None = None

    def at(
        self, sample: MotionSample, period: float, state: State | None
    ) -> Callable[[float], float]:
        """Force [N] of one sample at a current [A]."""
        force_at: Callable[[float], float] = self._scalar(*self._seen(sample, period, state))
        return force_at

    @quiet
    def forces(
        self, samples: Sequence[MotionSample], current: Array, period: float, state: State | None
    ) -> Array:
        """Force (n, m) [N]; the terms of the current are kept for the next samples."""
        if self._latest is None or self._latest[0] is not current:
            self._latest = current, self._arrays(current)
        rows = [self._seen(sample, period, state) for sample in samples]
        # Scalars for one sample: arrays of one element are slower.
        seen = rows[0] if len(rows) == 1 else np.array(rows).T[:, :, np.newaxis]
        return np.reshape(self._latest[1](*seen), (len(rows), -1))

    def _seen(self, sample: MotionSample, period: float, state: State | None) -> tuple[float, ...]:
        branch, last, lag = _before(state, sample.acceleration, jumps=self._jumps)
        change = 0.0 if last is None else sample.velocity - last
        of_motion = self._motion(sample.velocity, sample.peak_velocity)
        return (*of_motion, branch, change, sample.displacement, period, *lag)
