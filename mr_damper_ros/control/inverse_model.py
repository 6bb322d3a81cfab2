"""The inverse of an identified damper: wanted forces of a motion to currents of its coil."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.control.inversion import Inversion, invert
from mr_damper_ros.control.sample_inversion import (
    FoundCurrent,
    SampleInversion,
    find_current,
    invert_sample,
    invert_samples,
)
from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.motion_sample import MotionSample
from mr_damper_ros.models.current_response import CurrentResponse, SampleResponse
from mr_damper_ros.models.first_order_lag import COIL
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import State
from mr_damper_ros.signals.arrays import Array


class InverseModel:
    """The inverse of a parameter set between two currents [A] of the coil.

    ``gradual_reversal``: of the law without its jumps, as the force is predicted. Raises ValueError
    where the highest current is not above the lowest; warns where the set was identified at one
    current.
    """

    def __init__(
        self,
        parameters: ParameterSet,
        lowest_current: float,
        highest_current: float,
        *,
        gradual_reversal: bool = False,
    ) -> None:
        if not lowest_current < highest_current:
            raise ValueError(
                f"the highest current, {highest_current:g} A, is not above the lowest, "
                f"{lowest_current:g} A"
            )
        if parameters.doubt_over_current:
            warnings.warn(parameters.doubt_over_current, stacklevel=2)
        self.law = parameters.law.continuous if gradual_reversal else parameters.law
        self.values = in_coil(parameters)
        self._range = parameters.peak_velocity_range
        self._nodes = self.law.current_nodes(self.values, lowest_current, highest_current)
        self._node_list: list[float] = self._nodes.tolist()
        self._responses = self.law.sample_responses(self.values, self._nodes)

    def currents(
        self,
        motion: Motion,
        wanted: ArrayLike,
        *,
        last: ArrayLike | None = None,
        period: float = 1e-3,
        state: State | None = None,
    ) -> Inversion:
        """Currents for the forces ``wanted`` (n,) [N] at the samples of a motion.

        ``last`` [A]: of several currents the nearest to it is meant, without it the lowest. The
        samples each follow the ``state``, ``period`` [s] after it: of a law that remembers, give
        one.
        """
        forces = np.broadcast_to(np.asarray(wanted, dtype=float), motion.velocity.shape)
        near = None if last is None else np.asarray(last, dtype=float)
        several = self._responses.several(motion.held_within(*self._range), period, state)
        if several is None:
            return invert(self._response(motion, period, state), self._nodes, forces, near)
        return invert_samples(several, self._node_list, forces, near)

    def slope(
        self,
        motion: Motion,
        current: ArrayLike,
        *,
        period: float = 1e-3,
        state: State | None = None,
    ) -> Array:
        """Derivative dF/di (n,) [N/A] at the samples of a motion and these currents (n,) [A]."""
        return self._response(motion, period, state).slope(_each(current, motion))[:, 0]

    def force(
        self,
        motion: Motion,
        current: ArrayLike,
        *,
        period: float = 1e-3,
        state: State | None = None,
    ) -> Array:
        """Force (n,) [N] at the samples of a motion and these currents (n,) [A] of the coil."""
        return self._response(motion, period, state).force(_each(current, motion))[:, 0]

    def at(
        self, sample: MotionSample, *, period: float = 1e-3, state: State | None = None
    ) -> SampleResponse:
        """Force of one sample over the current, ``period`` [s] after the state."""
        return self._responses.of(sample.held_within(*self._range), period, state)

    def current(
        self, response: SampleResponse, wanted: float, last: float | None = None
    ) -> FoundCurrent:
        """The current for a force [N], as :meth:`currents`, of the response :meth:`at` a sample."""
        return find_current(response, self._node_list, wanted, last)

    def follow(
        self, motion: Motion, wanted: ArrayLike, period: float, state: State | None = None
    ) -> tuple[Inversion, State | None]:
        """Currents sample by sample, each with what the law remembers of those before.

        Shapes as for :meth:`currents`; also the state after the last sample. Each current is the
        one nearest to that before.
        """
        forces = np.broadcast_to(np.asarray(wanted, dtype=float), motion.velocity.shape)
        found: list[SampleInversion] = []
        last: float | None = None
        for place, force in enumerate(forces.tolist()):
            response = self.at(MotionSample.of(motion, place), period=period, state=state)
            found.append(invert_sample(response, self._node_list, force, last))
            last = found[-1].current
            sample = motion.part(slice(place, place + 1)).held_within(*self._range)
            _, state = self.law.follow(self.values, sample, np.array([last]), period, state)
        return Inversion(*(np.array(part) for part in zip(*found, strict=True))), state

    def _response(self, motion: Motion, period: float, state: State | None) -> CurrentResponse:
        held = motion.held_within(*self._range)
        return self.law.response(self.values, held, period, state)


def _each(current: ArrayLike, motion: Motion) -> Array:
    """A current for every sample, (n, 1)."""
    every = np.broadcast_to(np.asarray(current, dtype=float), motion.velocity.shape)
    return every[:, np.newaxis]


def in_coil(parameters: ParameterSet) -> Array:
    """Values (p,) of a set for a law that is given the current of the coil: it lags no more."""
    values = parameters.values.copy()
    names = parameters.law.parameter_names
    if COIL in names:
        values[names.index(COIL)] = 0.0
    return values


def coil_time_constant(parameters: ParameterSet) -> float:
    """Time constant [s] of the coil that a set knows; 0 where it knows of none."""
    return parameters.as_dict().get(COIL, 0.0)
