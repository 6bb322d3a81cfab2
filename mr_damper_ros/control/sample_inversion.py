"""The current for a wanted force at one sample, in plain numbers: the search of :mod:`inversion`.

A controller asks for one current at a time. The search looks at the same nodes, for the same root,
to the same tolerance.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from typing import NamedTuple

from mr_damper_ros.control.inversion import (
    CLOSE,
    LEAST_GAIN,
    MOST_STEPS,
    ROUNDING,
    TOLERANCE,
    WITHIN,
)
from mr_damper_ros.models.current_response import SampleResponse

_NEAR = 8
"""Cells that are looked at one by one: to look at all takes as long as that."""

_CLOSE_IN_CELL = 1e-8
"""Part of the force over a cell at which a search in it ends: of all of the span it is less."""

_GOLDEN = 0.6180339887498949
_GOLDEN_STEPS = 30
"""They narrow a cell to a millionth: the force at an extremum is flat, or has a kink."""

_STEP = 1e-6
"""Amperes over which is looked whether a force rises."""


class SampleInversion(NamedTuple):
    """What :class:`mr_damper_ros.control.inversion.Inversion` holds, of one sample."""

    current: float
    force: float
    attainable: bool
    least: float
    most: float


class FoundCurrent(NamedTuple):
    """A current [A], the force [N] that it gives, and whether that is what was wanted."""

    current: float
    force: float
    attainable: bool


def find_current(
    response: SampleResponse, nodes: list[float], wanted: float, last: float | None = None
) -> FoundCurrent:
    """The current of :func:`invert_sample`, in less time where it is near the last one.

    The cells of the nodes are looked at as they lie ever further from the last current: the first
    that has the wanted force within is the nearest. Only where none of a few has are all looked at.
    """
    near = nodes[0] if last is None else last
    low = min(max(bisect_left(nodes, near) - 1, 0), len(nodes) - 2)
    high = low + 1
    at_low, at_high = response.force(nodes[low]), response.force(nodes[high])
    ends, forces = nodes[low : high + 1], [at_low, at_high]
    for _ in range(_NEAR):
        if (forces[0] > wanted) != (forces[1] > wanted):
            rounding = ROUNDING * max(abs(forces[0]), abs(forces[1]))
            close = max(_CLOSE_IN_CELL * abs(forces[1] - forces[0]), rounding)
            return FoundCurrent(*_root(response, wanted, ends, forces, close), attainable=True)
        downwards = low > 0 and (high == len(nodes) - 1 or near - nodes[low] <= nodes[high] - near)
        if downwards:
            low, above = low - 1, at_low
            at_low = response.force(nodes[low])
            ends, forces = nodes[low : low + 2], [at_low, above]
        elif high < len(nodes) - 1:
            high, below = high + 1, at_high
            at_high = response.force(nodes[high])
            ends, forces = nodes[high - 1 : high + 1], [below, at_high]
        else:
            break
    found = invert_sample(response, nodes, wanted, last)
    return FoundCurrent(found.current, found.force, found.attainable)


def invert_sample(
    response: SampleResponse, nodes: list[float], wanted: float, last: float | None = None
) -> SampleInversion:
    """The current at which the response gives the ``wanted`` force [N].

    ``nodes`` [A] are those of the response. ``last`` [A]: where there are several currents, the one
    near it is meant; None for the lowest.
    """
    forces = response.at_nodes()
    # A force that only an extremum between two nodes may give.
    if wanted < min(forces) or wanted > max(forces):
        nodes, forces = _with_extremum(response, nodes, forces, wanted)
    least, most = min(forces), max(forces)
    span = most - least
    margin = WITHIN * TOLERANCE * span
    aimed = min(max(wanted, least + margin), most - margin)
    floor = ROUNDING * max(abs(least), abs(most))
    close = max(CLOSE * TOLERANCE * span, floor)
    cell = _cell(nodes, [force > aimed for force in forces], last)
    ends = slice(cell, cell + 2)
    current, force = _root(response, aimed, nodes[ends], forces[ends], close)
    attainable = abs(force - wanted) <= max(TOLERANCE * span, 2.0 * floor)
    return SampleInversion(current, force, attainable, least, most)


def _cell(nodes: list[float], above: list[bool], last: float | None) -> int:
    """The cell of which one end is above: the first, or the nearest to last."""
    best, least, place = 0, math.inf, 0
    while True:
        try:
            place = above.index(not above[place], place) - 1
        except ValueError:
            return best
        away = 0.0
        if last is not None:
            away = max(nodes[place] - last, last - nodes[place + 1], 0.0)
        if away < least:
            best, least = place, away
        if least == 0.0:
            return best
        place += 1


def _root(
    response: SampleResponse, aimed: float, nodes: list[float], forces: list[float], close: float
) -> tuple[float, float]:
    """The current between two that gives the force to within ``close``, and its force."""
    (low, high), (at_low, at_high) = nodes, (force - aimed for force in forces)
    rises = at_low <= 0.0
    run = at_low - at_high
    part = at_low / run if run else 0.5
    current = low + (part if 0.0 <= part <= 1.0 else 0.5) * (high - low)
    other, at_other = (low, at_low) if abs(at_low) < abs(at_high) else (high, at_high)
    before = math.inf
    for _ in range(MOST_STEPS):
        found = current, response.force(current)
        error = found[1] - aimed
        size = abs(error)
        if not (size > close and high - low > ROUNDING * max(abs(high), 1.0)):
            break
        if (error <= 0.0) == rises:
            low = current
        else:
            high = current
        run = error - at_other
        secant = current - error * (current - other) / run if run else math.nan
        other, at_other = current, error
        if low < secant < high and size <= LEAST_GAIN * before:
            current, before = secant, size
        else:
            current, before = 0.5 * (low + high), math.inf
    return found


def _with_extremum(
    response: SampleResponse, nodes: list[float], forces: list[float], wanted: float
) -> tuple[list[float], list[float]]:
    """Nodes and forces, the node at the furthest bend towards a wanted force moved onto it."""
    sign = 1.0 if wanted > max(forces) else -1.0
    heights = [sign * force for force in forces]
    last = len(heights) - 1
    bends = [
        place
        for place in range(1, last)
        if heights[place - 1] < heights[place] >= heights[place + 1]
    ]
    # Beside the first or the last node there is one only where the force rises inwards.
    if heights[0] >= heights[1] and sign * _slope(response, nodes[0]) > 0.0:
        bends.append(0)
    if heights[last] > heights[last - 1] and sign * _slope(response, nodes[last]) < 0.0:
        bends.append(last)
    if not bends:
        return nodes, forces
    best = max(bends, key=heights.__getitem__)
    found = _extremum(response, nodes[max(best - 1, 0)], nodes[min(best + 1, last)], sign)
    force = response.force(found)
    if sign * force <= heights[best]:
        return nodes, forces
    nodes, forces = nodes.copy(), forces.copy()
    nodes[best], forces[best] = found, force
    return nodes, forces


def _slope(response: SampleResponse, current: float) -> float:
    return response.force(current + _STEP) - response.force(current - _STEP)


def _extremum(response: SampleResponse, low: float, high: float, sign: float) -> float:
    """The current of the largest force (or the least, by ``sign``), by golden section."""
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = sign * response.force(left), sign * response.force(right)
    for _ in range(_GOLDEN_STEPS):
        if at_left > at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = sign * response.force(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = sign * response.force(right)
    return 0.5 * (low + high)
