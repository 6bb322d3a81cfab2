"""The inverse of an identified damper: coil currents for desired forces.

The force is not monotonic in the current. If several currents give the desired force, the inverse
returns the lowest, or the one nearest to the last current, so that the current does not jump. An
unattainable force is replaced by the nearest attainable one. Because the force saturates, the
inverse then returns the lowest current that gives it.

Each sample is searched separately, in floating-point scalars. The forces at 65 nodes of the current
give brackets, in which false position refines the current.
"""

from __future__ import annotations

import math
import warnings
from bisect import bisect_left
from collections.abc import Callable
from itertools import compress
from operator import ne
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.motion import Motion, MotionSample
from mr_damper_ros.models.parameter_set import ParameterSet, check_set
from mr_damper_ros.models.quantities import State
from mr_damper_ros.signals.arrays import Array

NODES = 65
"""Number of currents at which the force is evaluated first. Between two of them the force should
have at most one extremum."""

TOLERANCE = 1e-6
"""Tolerance of the force, relative to the span of attainable forces. A supply resolves only about a
thousandth of its range."""

_END_MARGIN = 0.4
"""Margin at both ends of the span, relative to the tolerance, so that the ends are attainable."""

_SEARCH_PRECISION = 1e-3
"""The search ends at an error of this part of the tolerance."""

_MOST_STEPS = 80
"""Largest number of search steps; bisection would need 55."""

_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_GOLDEN_STEPS = 30
"""Golden-section steps, which narrow a cell to a millionth."""

_STEP = 1e-6
"""Step [A] of the finite difference for the slope."""

_TOGETHER = 32
"""Number of samples whose node forces are computed together."""

_ROUNDING = 4.0 * float(np.finfo(float).eps)

Force = Callable[[float], float]
"""Force [N] of a sample at a current [A]."""


class Inversion(NamedTuple):
    """Currents for desired forces, all of shape (n,), or the current of one sample.

    ``current`` [A] is the coil current and ``force`` [N] its force; ``attainable`` says whether
    this is the desired force. ``least`` and ``most`` [N] are the limits of the attainable forces.
    """

    current: Any
    force: Any
    attainable: Any
    least: Any
    most: Any


class InverseModel:
    """The inverse of a parameter set between two currents [A] of the coil.

    ``gradual_reversal``: use the law without jumps at reversals, as in the prediction. Raises
    ValueError if the currents are not finite or the highest is not above the lowest. Warns if the
    set was identified at a single current.
    """

    def __init__(
        self,
        parameters: ParameterSet,
        lowest_current: float,
        highest_current: float,
        *,
        gradual_reversal: bool = False,
    ) -> None:
        if not -math.inf < lowest_current < highest_current < math.inf:
            raise ValueError(
                f"the highest current, {highest_current:g} A, is not above the lowest, "
                f"{lowest_current:g} A: give two finite currents"
            )
        check_set(parameters)
        if parameters.doubt_over_current:
            warnings.warn(parameters.doubt_over_current, stacklevel=2)
        self.law = parameters.law.continuous if gradual_reversal else parameters.law
        self.values = in_coil(parameters)
        self._range = parameters.held_range
        self._nodes = np.linspace(lowest_current, highest_current, NODES)
        self._node_list: list[float] = self._nodes.tolist()
        self._response = self.law.current_response(self.values)

    def currents(
        self,
        motion: Motion,
        wanted: ArrayLike,
        *,
        last: ArrayLike | None = None,
        period: float = 1e-3,
        state: State | None = None,
    ) -> Inversion:
        """Currents for the desired forces ``wanted`` (n,) [N] at the samples of a motion.

        If several currents give the desired force, the one nearest to ``last`` [A] is returned,
        without ``last``, or where it is NaN, the lowest. Each sample comes ``period`` [s] after the
        ``state``, which a law with memory needs. A force that is NaN is not attainable.
        """
        forces = np.broadcast_to(np.asarray(wanted, dtype=float), motion.velocity.shape)
        near = np.broadcast_to(math.nan if last is None else np.asarray(last, float), forces.shape)
        found: list[Inversion] = []
        for first in range(0, forces.size, _TOGETHER):
            part = slice(first, first + _TOGETHER)
            samples = MotionSample.each(motion.part(part).held_within(*self._range))
            rows = zip(
                [self._response.at(sample, period, state) for sample in samples],
                self._response.forces(samples, self._nodes, period, state).tolist(),
                forces[part].tolist(),
                near[part].tolist(),
                strict=True,
            )
            found += [
                _search(force_at, self._node_list, at_nodes, force, before)
                for force_at, at_nodes, force, before in rows
            ]
        return _together(found)

    def slope(
        self,
        motion: Motion,
        current: ArrayLike,
        *,
        period: float = 1e-3,
        state: State | None = None,
    ) -> Array:
        """Derivative dF/di (n,) [N/A] at the samples of a motion and these currents (n,) [A]."""
        amperes = np.asarray(current, dtype=float)
        above, below = (
            self.force(motion, amperes + step, period=period, state=state)
            for step in (_STEP, -_STEP)
        )
        return np.asarray((above - below) / (2.0 * _STEP))

    def force(
        self,
        motion: Motion,
        current: ArrayLike,
        *,
        period: float = 1e-3,
        state: State | None = None,
    ) -> Array:
        """Force (n,) [N] at the samples of a motion and these currents (n,) [A] of the coil."""
        if motion.velocity.size == 0:
            return np.empty(0)
        samples = MotionSample.each(motion.held_within(*self._range))
        each = np.broadcast_to(np.asarray(current, dtype=float), len(samples))[:, np.newaxis]
        return self._response.forces(samples, each, period, state)[:, 0]

    def at(
        self, sample: MotionSample, *, period: float = 1e-3, state: State | None = None
    ) -> Force:
        """Force of one sample as a function of the current, ``period`` [s] after the state."""
        return self._response.at(sample.held_within(*self._range), period, state)

    def current(
        self,
        sample: MotionSample,
        wanted: float,
        last: float | None = None,
        *,
        period: float = 1e-3,
        state: State | None = None,
    ) -> Inversion:
        """The current for a force [N] at one sample, as in :meth:`currents`.

        If the force lies between those at the two nodes beside the ``last`` current, as is usual,
        no other nodes are tried; ``least`` and ``most`` are then the forces at these two.
        """
        held, nodes = sample.held_within(*self._range), self._node_list
        force_at = self._response.at(held, period, state)
        if not (last is None or math.isnan(last)):
            cell = min(max(bisect_left(nodes, last) - 1, 0), NODES - 2)
            beside = nodes[cell : cell + 2]
            forces = [force_at(current) for current in beside]
            if min(forces) <= wanted <= max(forces):
                return _search(force_at, beside, forces, wanted, last)
        forces = self._response.forces([held], self._nodes, period, state)[0].tolist()
        return _search(force_at, nodes, forces, wanted, last)

    def follow(
        self, motion: Motion, wanted: ArrayLike, period: float, state: State | None = None
    ) -> tuple[Inversion, State | None]:
        """Currents sample by sample, each from the state after the previous sample.

        Shapes are as in :meth:`currents`; also returns the state after the last sample. Of several
        currents, the one nearest to the previous current is used.
        """
        forces = np.broadcast_to(np.asarray(wanted, dtype=float), motion.velocity.shape)
        found: list[Inversion] = []
        last: float | None = None
        for place, force in enumerate(forces.tolist()):
            sample = MotionSample.of(motion, place)
            found.append(self.current(sample, force, last, period=period, state=state))
            last = found[-1].current
            held = motion.part(slice(place, place + 1)).held_within(*self._range)
            _, state = self.law.follow(self.values, held, np.array([last]), period, state)
        return _together(found), state


def _together(found: list[Inversion]) -> Inversion:
    columns = zip(*found, strict=True) if found else [[]] * len(Inversion._fields)
    together = Inversion(*(np.array(part) for part in columns))
    return together._replace(attainable=together.attainable.astype(bool))


def in_coil(parameters: ParameterSet) -> Array:
    """Values (p,) of a set with the coil lag removed, for use with the coil current."""
    values = parameters.values.copy()
    if parameters.law.has_coil:
        values[-1] = 0.0
    return values


def _search(
    force_at: Force, nodes: list[float], forces: list[float], wanted: float, last: float | None
) -> Inversion:
    """The inversion of one sample with these node forces [N]."""
    least, most = min(forces), max(forces)
    # This force can be attained only at an extremum between two nodes.
    if wanted < least or wanted > most:
        sign = 1.0 if wanted > most else -1.0
        nodes, forces = _with_extremum(force_at, nodes, forces, sign)
        least, most = min(forces), max(forces)
    span = most - least
    margin = _END_MARGIN * TOLERANCE * span
    aimed = min(max(wanted, least + margin), most - margin)
    floor = _ROUNDING * max(abs(least), abs(most))
    close = max(_SEARCH_PRECISION * TOLERANCE * span, floor)
    cell = _cell(nodes, [force > aimed for force in forces], last)
    beside = slice(cell, cell + 2)
    current, force = _root(force_at, aimed, nodes[beside], forces[beside], close)
    attainable = abs(force - wanted) <= max(TOLERANCE * span, 2.0 * floor)
    return Inversion(current, force, attainable, least, most)


def _cell(nodes: list[float], above: list[bool], last: float | None) -> int:
    """The first bracketing cell, or the one nearest to the last current."""
    cells = [*compress(range(len(above)), map(ne, above, above[1:]))]
    if last is None or math.isnan(last):
        return cells[0] if cells else 0
    return min(cells, key=lambda k: max(nodes[k] - last, last - nodes[k + 1], 0.0), default=0)


def _root(
    force_at: Force, aimed: float, nodes: list[float], forces: list[float], close: float
) -> tuple[float, float]:
    """A current between two nodes with a force within ``close`` [N] of the aim, and its force.

    False position with the Illinois rule: an end that stays a second time counts half.
    """
    (low, high), (at_low, at_high) = nodes, (force - aimed for force in forces)
    narrowest = _ROUNDING * max(abs(high), 1.0)
    moved = 0
    for _ in range(_MOST_STEPS):
        run = at_low - at_high
        part = at_low / run if run else 0.5
        current = low + (part if 0.0 <= part <= 1.0 else 0.5) * (high - low)
        force = force_at(current)
        error = force - aimed
        if not (abs(error) > close and high - low > narrowest):
            break
        if (error <= 0.0) == (at_low <= 0.0):
            low, at_low, at_high = current, error, 0.5 * at_high if moved < 0 else at_high
            moved = -1
        else:
            high, at_high, at_low = current, error, 0.5 * at_low if moved > 0 else at_low
            moved = 1
    return current, force


def _with_extremum(
    force_at: Force, nodes: list[float], forces: list[float], sign: float
) -> tuple[list[float], list[float]]:
    """Nodes and forces with the node of the largest force (lowest, by ``sign``) at its extremum."""
    heights = [sign * force for force in forces]
    best, last = heights.index(max(heights)), len(heights) - 1
    # At an end there is an extremum only if the force increases inwards.
    inwards = {0: _STEP, last: -_STEP}.get(best, 0.0)
    if inwards and sign * force_at(nodes[best] + inwards) <= heights[best]:
        return nodes, forces
    close = _SEARCH_PRECISION * TOLERANCE * (max(forces) - min(forces))
    found = _extremum(
        lambda current: sign * force_at(current),
        nodes[max(best - 1, 0)],
        nodes[min(best + 1, last)],
        close,
    )
    force = force_at(found)
    if sign * force <= heights[best]:
        return nodes, forces
    nodes, forces = nodes.copy(), forces.copy()
    nodes[best], forces[best] = found, force
    return nodes, forces


def _extremum(height: Force, low: float, high: float, close: float) -> float:
    """The current of the largest height between two currents, by golden-section search.

    The search ends when the heights of two successive pairs differ by less than ``close`` [N].
    """
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = height(left), height(right)
    before = math.inf
    for _ in range(_GOLDEN_STEPS):
        difference = abs(at_left - at_right)
        if difference <= close and before <= close:
            break
        before = difference
        if at_left > at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = height(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = height(right)
    return 0.5 * (low + high)
