"""Force of the sigmoid laws without jumps over the current, sample by sample, in plain numbers.

The force at the nodes is that of the arrays, for the factors of the sample; what the currents of
the nodes make of it is computed once for a set. Where a number goes beyond all measure the arrays
must do altogether.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

import numpy as np

from mr_damper_ros.kinematics.motion_sample import MotionSample
from mr_damper_ros.models.current_response import SampleResponse, SampleResponses
from mr_damper_ros.models.force_model import Model, State
from mr_damper_ros.models.sigmoid.extension import SIGMOID_COUNT, Extension, extension_of
from mr_damper_ros.models.sigmoid.law import COEFFICIENT_LIMIT, current_gains
from mr_damper_ros.models.sigmoid.one_sample import (
    SampleFactors,
    SampleForce,
    SigmoidNumbers,
    branch_before,
    lag_before,
    late_after,
)
from mr_damper_ros.models.sigmoid.reversal import REVERSAL_MEMORY
from mr_damper_ros.models.sigmoid.sigmoid_response import (
    Branch,
    LateResponse,
    SigmoidFactors,
    SigmoidResponse,
    lag_state,
)
from mr_damper_ros.signals.arrays import Array

_REMEMBERED = 16
"""Currents whose gains are remembered."""


class SigmoidSampleResponses(SampleResponses):
    """Those of the sixteen parameters, the first ones of a set."""

    def __init__(self, law: Model, parameters: Array, nodes: Array) -> None:
        super().__init__(law, parameters, nodes)
        self.sixteen = parameters[:SIGMOID_COUNT]
        self.numbers = SigmoidNumbers(self.sixteen)
        self.gains = current_gains(self.sixteen, nodes)
        # The same few currents are looked at one sample after the other.
        self.gains_at = lru_cache(maxsize=_REMEMBERED)(self.numbers.gains)

    def of(self, sample: MotionSample, period: float, state: State | None) -> SampleResponse:
        """That of the sample ``period`` [s] after the state."""
        factors = self.numbers.factors(sample.velocity, sample.peak_velocity)
        if factors is None:
            return super().of(sample, period, state)
        position, before = branch_before(state, sample.acceleration)
        change = 0.0 if before is None else sample.velocity - before
        arrays = partial(super().of, sample, period, state)
        return SigmoidSampleResponse(self, factors, position, change, arrays)


class SigmoidSampleResponse(SampleResponse):
    """That of the sixteen parameters; ``arrays`` gives it where numbers are beyond all measure.

    The sample was on the branch ``position`` before the velocity changed by ``change`` [m/s].
    """

    def __init__(
        self,
        of: SigmoidSampleResponses,
        factors: SampleFactors,
        position: float,
        change: float,
        arrays: Callable[[], SampleResponse],
    ) -> None:
        self.gains = of.gains
        self.in_arrays = arrays
        self._of = of
        self._factors = factors
        self._position = position
        self._change = change

    def at_nodes(self) -> list[float]:
        """Force [N] at the nodes."""
        return self.checked(self.arrays.force_of(self.gains))

    def force(self, current: float) -> float:
        """Force [N] at a current [A]."""
        found = self.at(current)
        return self.in_arrays().force(current) if found is None else found.force

    def at(self, current: float) -> SampleForce | None:
        """The sigmoid at a current [A]; None: beyond all measure."""
        return self._of.numbers.at(
            self._factors, self._of.gains_at(current), self._position, self._change
        )

    @property
    def arrays(self) -> SigmoidResponse:
        """The same for many currents at once."""
        branch = Branch(self._position, self._change)
        return SigmoidResponse(self._of.sixteen, SigmoidFactors(*self._factors), branch)

    def checked(self, forces: Array) -> list[float]:
        """These forces at the nodes [N], unless one of them is beyond all measure."""
        if not np.abs(forces).max() < COEFFICIENT_LIMIT:
            return self.in_arrays().at_nodes()
        found: list[float] = forces.tolist()
        return found


class LateSampleResponses(SigmoidSampleResponses):
    """Those of the extended law."""

    def __init__(self, law: Model, parameters: Array, nodes: Array) -> None:
        super().__init__(law, parameters, nodes)
        self._extension = extension_of(parameters)

    def of(self, sample: MotionSample, period: float, state: State | None) -> SampleResponse:
        """That of the sample ``period`` [s] after the state."""
        plain = super().of(sample, period, state)
        if not isinstance(plain, SigmoidSampleResponse):
            return plain
        own = None if state is None else state[REVERSAL_MEMORY:]
        return LateSampleResponse(plain, self._extension, sample.displacement, period, own)


class LateSampleResponse(SampleResponse):
    """That of the extended law; ``state`` begins with what the lag remembers."""

    def __init__(
        self,
        plain: SigmoidSampleResponse,
        extension: Extension,
        displacement: float,
        period: float,
        state: State | None,
    ) -> None:
        self._plain = plain
        self._extension = extension
        self._displacement = displacement
        self._period = period
        self._state = lag_state(state)
        self._before = lag_before(state)

    def at_nodes(self) -> list[float]:
        """Force [N] at the nodes."""
        arrays = LateResponse(
            self._plain.arrays, self._extension, self._displacement, self._period, self._state
        )
        return self._plain.checked(arrays.force_of(self._plain.gains))

    def force(self, current: float) -> float:
        """Force [N] at a current [A]."""
        found = self._plain.at(current)
        if found is None:
            return self._plain.in_arrays().force(current)
        late = late_after(found, self._extension, self._period, self._before)
        return float(late.force + self._extension.gas(self._displacement))
