"""The sigmoid laws of a set: along a motion, block by block, and over the current at a sample.

*Without the jump where the motion turns.* The law shifts the velocity by sgn(a) v_h: the force
jumps from one branch to the other within a sample where the acceleration changes its sign, and back
and forth where that is lost in noise. Recorded forces do not. Along a branch of negative v_h the
law's velocity v + sgn(a) v_h is that of a body with a play of -v_h behind v; without the jump it is
so also where the motion turns: the shift follows the velocity (a play operator; Visintin,
Differential Models of Hysteresis, 1994),

    s[k] = clip(s[k-1] + (v[k] - v[k-1]) / |v_h|, -1, 1)    in the place of sgn(a).

It depends on the path of the velocity, not on its rate, and is the law once the velocity has come
back by 2 |v_h|. It needs no parameter.

*The extended law* adds a compliance, a stiffness and an offset. What carries the force of the fluid
gives way: the fluid itself, the rod, the mounts. Such a spring in series with the damper (a Maxwell
element) makes the force late. With F_s the sigmoid force,

    tau dF_l/dt + F_l = F_s,  tau = compliance * f_t tanh(alpha x / 2) / x,
    x = v + sgn(a) v_h + v_d,

the fraction being the damping that the sigmoid amounts to at its velocity x. So the lag is long
where the force is steep, around a reversal, short where the fluid flows, and rises with the yield
force, that is with the current. The force is F_l + stiffness u + offset: those of the gas (thesis
3.2; the thesis adds 100 N to its records by hand). doc/extended_law.md tells what else was tried.
The current that counts is that of the coil, see :mod:`first_order_lag`. A parameter array of the
extended law holds the sixteen of the sigmoid law first, then the three of :data:`EXTENSION_NAMES`,
last the time constant of the coil.

Of the state, the branch comes first (without the jump), then what the lag remembers, then the
supply's and the coil's current, where the coil lags.

*Over the current.* Of all that the law computes only the gains of yield force and width depend on
the current, and they do not depend on the motion: what the currents of the nodes make of the law is
computed once for a set, what the motion makes of it once for a sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion, MotionSample
from mr_damper_ros.models.first_order_lag import (
    COIL,
    coil_current,
    coil_state,
    few_in_coil,
    lagged,
    next_lagged,
    one_sample_later,
)
from mr_damper_ros.models.force_model import CurrentResponse
from mr_damper_ros.models.formulas import staged
from mr_damper_ros.models.quantities import State
from mr_damper_ros.models.sigmoid.law import (
    LAW,
    NARROWEST,
    PARAMETER_NAMES,
    force_and_damping,
    force_from_coefficients,
    operating_point_coefficients,
)
from mr_damper_ros.signals.arrays import Array

EXTENDED_MODEL = "sigmoid_lag"
"""Name of the extended law in ``MODELS``."""

COMPLIANCE = "compliance"
"""The parameter that makes the lag; it must not be negative."""

EXTENSION_NAMES = (COMPLIANCE, "stiffness", "offset")
"""The three parameters of the extension: [m/N], [N/m], [N]."""

EXTENDED_NAMES = (*PARAMETER_NAMES, *EXTENSION_NAMES, COIL)
"""The twenty parameters of the extended law, in the order of its parameter arrays."""

SIGMOID_COUNT = len(PARAMETER_NAMES)


class Extension(NamedTuple):
    """The three parameters, each a number or an array that broadcasts."""

    compliance: Array | float
    stiffness: Array | float
    offset: Array | float

    def time_constant(self, damping: Array) -> Array:
        """Time constant [s] of the lag where the sigmoid has this damping [N s/m]; not negative."""
        return np.maximum(self.compliance * damping, 0.0)

    def gas(self, displacement: Array | float) -> Array | float:
        """Force [N] of the gas at a displacement [m]."""
        return self.stiffness * displacement + self.offset


def is_extended(parameters: Array) -> bool:
    """Whether an array (..., 16) or (..., 20) is of the extended law.

    Raises ValueError for any other length.
    """
    count = parameters.shape[-1]
    if count not in (SIGMOID_COUNT, len(EXTENDED_NAMES)):
        raise ValueError(
            f"there are {count} parameters: the sigmoid law has {SIGMOID_COUNT}, the extended one "
            f"{len(EXTENDED_NAMES)}"
        )
    return bool(count != SIGMOID_COUNT)


def extension_of(parameters: Array) -> Extension:
    """The three after the sixteen of parameters (20,)."""
    return Extension(*parameters[SIGMOID_COUNT:-1].tolist())


def without_extension(sixteen: Array) -> Array:
    """Parameters (20,) of the extended law that give the force of these (16,)."""
    return np.concatenate((sixteen, np.zeros(len(EXTENDED_NAMES) - SIGMOID_COUNT)))


class LagMemory(NamedTuple):
    """What the lag remembers: force and lagged force of the sigmoid [N] and time constant [s]."""

    plain: float
    force: float
    constant: float


def late_after(
    force: float, damping: float, extension: Extension, period: float, before: LagMemory | None
) -> LagMemory:
    """The lag at a sample ``period`` [s] after another; without one nothing is late."""
    constant = max(float(extension.compliance) * damping, 0.0)
    late = force
    if before is not None:
        late = one_sample_later(force, constant, period, *before)
    return LagMemory(force, late, constant)


def alternatives_after(
    force: Array, damping: Array, extension: Extension, period: float, before: LagMemory | None
) -> Array:
    """Lagged forces [N] of alternatives for the one sample after another; they broadcast."""
    if before is None:
        return force
    state = np.array(before.plain), np.array(before.force), np.array(before.constant)
    return next_lagged(force, extension.time_constant(damping), period, state)


# -- along a motion

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


# -- over the current

_MOTION = ("scale", "alpha", "viscous", "centred", "width")
"""Formulas that the motion alone decides on."""

_of_motion = staged(LAW, [PARAMETER_NAMES, ("v", "v_m")], _MOTION, arrays=False)
_SEEN = (*_MOTION, "s", "change")


@cache
def _over_current(extended: bool) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """A sample over currents in scalars, and samples at given currents in arrays."""
    results = ("force", "damping") if extended else ("force",)
    return (
        staged(LAW, [PARAMETER_NAMES, _SEEN, ("i",)], results, arrays=False),
        staged(LAW, [PARAMETER_NAMES, ("i",), _SEEN], results, arrays=True),
    )


class SigmoidCurrentResponse(CurrentResponse):
    """That of a set (16,) or (20,), whose motion is seen in scalars, sample by sample."""

    def __init__(self, parameters: Array, *, jumps: bool) -> None:
        self._jumps = jumps
        numbers, extended = parameters[:SIGMOID_COUNT].tolist(), is_extended(parameters)
        self._extension = extension_of(parameters) if extended else None
        self._motion = _of_motion(*numbers)
        self._scalar, self._arrays = (each(*numbers) for each in _over_current(extended))
        self._latest: tuple[Array, Callable[..., Any]] | None = None

    def at(
        self, sample: MotionSample, period: float, state: State | None
    ) -> Callable[[float], float]:
        """Force [N] of one sample at a current [A]."""
        force_at: Callable[[float], Any] = self._scalar(*self._seen(sample, state))
        if self._extension is None:
            return force_at
        extension, gas = self._extension, self._extension.gas(sample.displacement)
        before = lag_before(own_state(state, jumps=self._jumps))

        def late_force(current: float) -> float:
            force, damping = force_at(current)
            return float(late_after(force, damping, extension, period, before).force + gas)

        return late_force

    @np.errstate(over="ignore", divide="ignore", invalid="ignore")
    def forces(
        self, samples: Sequence[MotionSample], current: Array, period: float, state: State | None
    ) -> Array:
        """Force (n, m) [N]; what the currents make of the law is kept for the next samples."""
        if self._latest is None or self._latest[0] is not current:
            self._latest = current, self._arrays(current)
        rows = [self._seen(sample, state) for sample in samples]
        # Of one sample in scalars: arrays of one element take longer.
        seen = rows[0] if len(rows) == 1 else np.array(rows).T[:, :, np.newaxis]
        found = self._latest[1](*seen)
        if self._extension is None:
            return np.reshape(found, (len(rows), -1))
        displacement = np.array([[sample.displacement] for sample in samples])
        before = lag_before(own_state(state, jumps=self._jumps))
        force, damping = found
        late = alternatives_after(force, damping, self._extension, period, before)
        return np.asarray(late + self._extension.gas(displacement))

    def _seen(self, sample: MotionSample, state: State | None) -> tuple[float, ...]:
        turning = None if self._jumps else state
        branch, before = branch_before(turning, sample.acceleration)
        change = 0.0 if before is None else sample.velocity - before
        return (*self._motion(sample.velocity, sample.peak_velocity), branch, change)
