"""Force of the sigmoid laws over the current, sample by sample, in plain numbers.

The force at the nodes is that of the arrays, for the factors of the sample; what the currents of
the nodes make of it is computed once for a set. Where a number goes beyond all measure the arrays
must do altogether.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.motion_sample import MotionSample
from mr_damper_ros.models.current_response import (
    SampleResponse,
    SampleResponses,
    SeveralSamples,
)
from mr_damper_ros.models.force_model import Model, State
from mr_damper_ros.models.sigmoid.extension import SIGMOID_COUNT, extension_of
from mr_damper_ros.models.sigmoid.law import current_gains
from mr_damper_ros.models.sigmoid.one_sample import (
    SampleFactors,
    SigmoidNumbers,
    branch_before,
    lag_before,
    late_after,
)
from mr_damper_ros.models.sigmoid.sigmoid_response import (
    Branch,
    LateResponse,
    SetTerms,
    SigmoidFactors,
    SigmoidResponse,
    lag_state,
)
from mr_damper_ros.signals.arrays import Array

_FEW = 32
"""Samples up to which a search in plain numbers takes less time than one in arrays."""


class _Seen(NamedTuple):
    """What the law sees of a sample.

    It was on the branch ``position`` before the velocity changed by ``change`` [m/s].
    """

    factors: SampleFactors
    position: float
    change: float


class _InPlainNumbers(SampleResponses):
    """What the responses of both laws have in common."""

    def __init__(self, law: Model, parameters: Array, nodes: Array) -> None:
        super().__init__(law, parameters, nodes)
        sixteen = parameters[:SIGMOID_COUNT]
        self.numbers = SigmoidNumbers(sixteen)
        self.gains = current_gains(sixteen, nodes)
        self._terms = SetTerms.of(sixteen)

    def _seen(self, sample: MotionSample, state: State | None) -> _Seen | None:
        """None: beyond all measure."""
        factors = self.numbers.factors(sample.velocity, sample.peak_velocity)
        if factors is None:
            return None
        turning = None if state is None else state[: self._law.turning]
        position, before = branch_before(turning, sample.acceleration)
        return _Seen(factors, position, 0.0 if before is None else sample.velocity - before)

    def _few(self, motion: Motion, state: State | None) -> list[_Seen] | None:
        """Of a few samples; None: of many, or beyond all measure."""
        if motion.velocity.size > _FEW:
            return None
        samples = [self._seen(sample, state) for sample in MotionSample.each(motion)]
        known = [seen for seen in samples if seen is not None]
        return known if len(known) == len(samples) else None

    def together(self, samples: Sequence[_Seen]) -> SigmoidResponse:
        """Of samples (n,) for many currents at once."""
        rows = [(*seen.factors, seen.position, seen.change) for seen in samples]
        *factors, position, change = np.array(rows).T[:, :, np.newaxis]
        branch = Branch(position, change if change.any() else None)
        return SigmoidResponse(self._terms, SigmoidFactors(*factors), branch)


class SigmoidSampleResponses(_InPlainNumbers):
    """Those of the sixteen parameters."""

    def of(self, sample: MotionSample, period: float, state: State | None) -> SampleResponse:
        """That of the sample ``period`` [s] after the state."""
        seen = self._seen(sample, state)
        return super().of(sample, period, state) if seen is None else SigmoidSample(self, seen)

    def several(self, motion: Motion, period: float, state: State | None) -> SeveralSamples | None:
        """Those of a few samples (n,)."""
        few = self._few(motion, state)
        if few is None:
            return None
        each = [self.numbers.force_over_current(*seen) for seen in few]
        return SeveralSamples(each, self.together(few).force_of(self.gains))


class SigmoidSample(SampleResponse):
    """That of the sixteen parameters."""

    def __init__(self, of: _InPlainNumbers, seen: _Seen) -> None:
        self._of = of
        self._seen = seen
        self._force = of.numbers.force_over_current(*seen)

    def at_nodes(self) -> list[float]:
        """Force [N] at the nodes."""
        found: list[float] = self._of.together([self._seen]).force_of(self._of.gains)[0].tolist()
        return found

    def force(self, current: float) -> float:
        """Force [N] at a current [A]."""
        return self._force(current)


class LateSampleResponses(_InPlainNumbers):
    """Those of the extended law."""

    def __init__(self, law: Model, parameters: Array, nodes: Array) -> None:
        super().__init__(law, parameters, nodes)
        self.extension = extension_of(parameters)

    def of(self, sample: MotionSample, period: float, state: State | None) -> SampleResponse:
        """That of the sample ``period`` [s] after the state."""
        seen = self._seen(sample, state)
        if seen is None:
            return super().of(sample, period, state)
        return LateSample(self, seen, sample.displacement, period, self._own(state))

    def several(self, motion: Motion, period: float, state: State | None) -> SeveralSamples | None:
        """Those of a few samples (n,)."""
        few, own = self._few(motion, state), self._own(state)
        if few is None:
            return None
        u = motion.displacement
        each = [
            LateSample(self, seen, displacement, period, own).force
            for seen, displacement in zip(few, u.tolist(), strict=True)
        ]
        return SeveralSamples(each, self.late(few, u[:, np.newaxis], period, own))

    def late(
        self,
        samples: Sequence[_Seen],
        displacement: Array | float,
        period: float,
        own: State | None,
    ) -> Array:
        """Force (n, m) [N] of samples at the nodes."""
        response = LateResponse(
            self.together(samples), self.extension, displacement, period, lag_state(own)
        )
        return response.force_of(self.gains)

    def _own(self, state: State | None) -> State | None:
        """What of the state the lags remember."""
        return None if state is None else state[self._law.turning :]


class LateSample(SampleResponse):
    """That of the extended law; ``own`` begins with what the lag remembers."""

    def __init__(
        self,
        of: LateSampleResponses,
        seen: _Seen,
        displacement: float,
        period: float,
        own: State | None,
    ) -> None:
        self._of = of
        self._seen = seen
        self._displacement = displacement
        self._gas = float(of.extension.gas(displacement))
        self._period = period
        self._own = own
        self._before = lag_before(own)

    def at_nodes(self) -> list[float]:
        """Force [N] at the nodes."""
        found = self._of.late([self._seen], self._displacement, self._period, self._own)
        forces: list[float] = found[0].tolist()
        return forces

    def force(self, current: float) -> float:
        """Force [N] at a current [A]."""
        numbers = self._of.numbers
        factors, position, change = self._seen
        plain = numbers.at(factors, numbers.gains(current), position, change)
        late = late_after(plain, self._of.extension, self._period, self._before)
        return float(late.force + self._gas)
