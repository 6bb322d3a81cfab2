"""Force of the sigmoid laws over the current: of samples together in arrays, of a few in scalars.

Of all that the law computes only the gains of yield force and width depend on the current, and
they do not depend on the motion: what the currents of the nodes make of the law is computed once
for a set, what the motion makes of it once for a sample.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.motion_sample import MotionSample
from mr_damper_ros.models.current_response import (
    CurrentResponse,
    SampleResponse,
    SampleResponses,
    SeveralSamples,
)
from mr_damper_ros.models.formulas import staged
from mr_damper_ros.models.quantities import State
from mr_damper_ros.models.sigmoid.extension import (
    SIGMOID_COUNT,
    Extension,
    LagMemory,
    alternatives_after,
    extension_of,
    is_extended,
    late_after,
)
from mr_damper_ros.models.sigmoid.following import branch_before, lag_before, own_state
from mr_damper_ros.models.sigmoid.law import LAW, PARAMETER_NAMES
from mr_damper_ros.signals.arrays import Array

_MOTION = ("scale", "alpha", "viscous", "centred", "width")
"""Formulas that the motion alone decides on."""

_motion_in_scalars = staged(LAW, [PARAMETER_NAMES, ("v", "v_m")], _MOTION, arrays=False)
_motion_in_arrays = staged(LAW, [PARAMETER_NAMES, ("v", "v_m")], _MOTION, arrays=True)


def _inputs(seen: int) -> tuple[str, ...]:
    """The names of so many inputs: a branch that stays need not be computed anew."""
    return (*_MOTION, *(("branch",) if seen == len(_MOTION) + 1 else ("s", "change")))


@cache
def _of_current(seen: int, extended: bool) -> Callable[..., Any]:
    """A sample over the current, in scalars: of a set, of the sample, of the current."""
    results = ("force", "damping") if extended else ("force",)
    return staged(LAW, [PARAMETER_NAMES, _inputs(seen), ("i",)], results, arrays=False)


@cache
def _of_samples(seen: int, extended: bool) -> Callable[..., Any]:
    """Samples at currents, in arrays: of a set, of the currents, of the samples."""
    results = ("force", "damping") if extended else ("force",)
    return staged(LAW, [PARAMETER_NAMES, ("i",), _inputs(seen)], results, arrays=True)


class _Late(NamedTuple):
    """What the extension makes of the next sample's force; ``gas`` [N] is that of the gas."""

    extension: Extension
    gas: Any
    period: float
    before: LagMemory | None

    def scalar(self, force: float, damping: float) -> float:
        late = late_after(force, damping, self.extension, self.period, self.before)
        return float(late.force + self.gas)

    def array(self, force: Array, damping: Array) -> Array:
        late = alternatives_after(force, damping, self.extension, self.period, self.before)
        return np.asarray(late + self.gas)


class SigmoidResponse(CurrentResponse):
    """The force of a set (16,) or (20,) at the samples (n,) of a motion that follow a state.

    Of the extended law n is 1 where there was a sample before: its force is late.
    """

    def __init__(
        self, parameters: Array, motion: Motion, period: float, state: State | None, *, jumps: bool
    ) -> None:
        numbers = parameters[:SIGMOID_COUNT].tolist()
        columns = (motion.velocity, motion.peak_velocity, motion.displacement)
        v, v_m, u = (column[:, np.newaxis] for column in columns)
        branch: tuple[Array, ...] = (np.sign(motion.acceleration)[:, np.newaxis],)
        if state and not jumps:
            branch = (np.asarray(state[1]), v - state[0])
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            self._seen = (*_motion_in_arrays(*numbers)(v, v_m), *branch)
        self._late: _Late | None = None
        if is_extended(parameters):
            extension, before = extension_of(parameters), lag_before(own_state(state, jumps=jumps))
            self._late = _Late(extension, extension.gas(u), period, before)
        self._at = _of_samples(len(self._seen), self._late is not None)(*numbers)

    @np.errstate(over="ignore", divide="ignore", invalid="ignore")
    def force(self, current: Array) -> Array:
        """Force (n, m) [N]."""
        found = self._at(current)(*self._seen)
        return np.asarray(found if self._late is None else self._late.array(*found))


class SigmoidSampleResponses(SampleResponses):
    """Those of a set (16,) or (20,), sample by sample."""

    def __init__(self, parameters: Array, nodes: Array, *, jumps: bool) -> None:
        self._jumps = jumps
        numbers, extended = parameters[:SIGMOID_COUNT].tolist(), is_extended(parameters)
        self._extension = extension_of(parameters) if extended else None
        self._motion = _motion_in_scalars(*numbers)
        sizes = (len(_MOTION) + 1, len(_MOTION) + 2)
        self.over_current = {n: _of_current(n, extended)(*numbers) for n in sizes}
        with np.errstate(over="ignore", invalid="ignore"):
            self._at_nodes = {n: _of_samples(n, extended)(*numbers)(nodes) for n in sizes}

    def of(self, sample: MotionSample, period: float, state: State | None) -> SigmoidSample:
        """That of the sample ``period`` [s] after the state."""
        turning = None if self._jumps else state
        position, before = branch_before(turning, sample.acceleration)
        change = 0.0 if before is None else sample.velocity - before
        branch = (position, change) if change else (position,)
        seen = (*self._motion(sample.velocity, sample.peak_velocity), *branch)
        return SigmoidSample(self, seen, self._late(sample.displacement, period, state))

    def several(self, motion: Motion, period: float, state: State | None) -> SeveralSamples:
        """Those of the samples (n,) of a motion, each after the state."""
        samples = [self.of(sample, period, state) for sample in MotionSample.each(motion)]
        rows = [(*sample.seen, 0.0)[: len(_MOTION) + 2] for sample in samples]
        *parts, change = np.array(rows).T[:, :, np.newaxis]
        late = self._late(motion.displacement[:, np.newaxis], period, state)
        forces = self.at_nodes(parts + [change] * bool(change.any()), late)
        return SeveralSamples([sample.force for sample in samples], forces)

    def _late(
        self, displacement: Array | float, period: float, state: State | None
    ) -> _Late | None:
        if self._extension is None:
            return None
        before = lag_before(own_state(state, jumps=self._jumps))
        return _Late(self._extension, self._extension.gas(displacement), period, before)

    @np.errstate(over="ignore", divide="ignore", invalid="ignore")
    def at_nodes(self, seen: Sequence[Any], late: _Late | None) -> Array:
        """Force (m,) or (n, m) [N] at the nodes."""
        found = self._at_nodes[len(seen)](*seen)
        return np.asarray(found if late is None else late.array(*found))


class SigmoidSample(SampleResponse):
    """That of one sample."""

    def __init__(
        self, of: SigmoidSampleResponses, seen: tuple[float, ...], late: _Late | None
    ) -> None:
        self.seen, self.late = seen, late
        self._of = of
        self._force = of.over_current[len(seen)](*seen)

    def at_nodes(self) -> list[float]:
        """Force [N] at the nodes."""
        found: list[float] = self._of.at_nodes(self.seen, self.late).tolist()
        return found

    def force(self, current: float) -> float:
        """Force [N] at a current [A]."""
        found = self._force(current)
        force: float = found if self.late is None else self.late.scalar(*found)
        return force
