"""The current for a wanted force at one sample, in plain numbers: the search of :mod:`inversion`.

A controller asks for one current at a time, others for those of a block. The search looks at the
same nodes, for the same root, to the same tolerance.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mr_damper_ros.control.inversion import (
    CLOSE,
    LEAST_GAIN,
    MOST_STEPS,
    ROUNDING,
    TOLERANCE,
    WITHIN,
    Inversion,
)
from mr_damper_ros.models.current_response import SampleResponse, SeveralSamples
from mr_damper_ros.signals.arrays import Array

_NEAR = 8
"""Cells that are looked at one by one: to look at all takes as long as that."""

_CLOSE_IN_CELL = 1e-8
"""Part of the force over a cell at which a search in it ends: of all of the span it is less."""

_GOLDEN = 0.6180339887498949
_GOLDEN_STEPS = 30
"""They narrow a cell to a millionth: the force at an extremum is flat, or has a kink."""

_STEP = 1e-6
"""Amperes over which is looked whether a force rises."""


Force = Callable[[float], float]
"""Force [N] of a sample at a current [A]."""


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
            return FoundCurrent(
                *_root(response.force, wanted, ends, forces, close), attainable=True
            )
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
    return _search(response.force, nodes, response.at_nodes(), wanted, last)


def invert_samples(
    several: SeveralSamples, nodes: list[float], wanted: Array, last: Array | None = None
) -> Inversion:
    """As :func:`mr_damper_ros.control.inversion.invert`, of a few samples each by itself.

    Arrays would go on with all until the last one is found.
    """
    near = [None] * wanted.size if last is None else np.broadcast_to(last, wanted.shape).tolist()
    rows = zip(several.each, several.at_nodes.tolist(), wanted.tolist(), near, strict=True)
    found = [
        _search(force_at, nodes, forces, force, before) for force_at, forces, force, before in rows
    ]
    return Inversion(*(np.array(part) for part in zip(*found, strict=True)))


def _search(
    force_at: Force,
    nodes: list[float],
    forces: list[float],
    wanted: float,
    last: float | None,
) -> SampleInversion:
    """That of a sample with these forces [N] at the nodes."""
    rising = sorted(forces)
    least, most = rising[0], rising[-1]
    falling = rising[::-1]
    winding = forces not in (rising, falling)
    # A force that only an extremum between two nodes may give.
    if wanted < least or wanted > most:
        bend = _furthest_bend(force_at, nodes, forces, 1.0 if wanted > most else -1.0, winding)
        if bend is not None:
            nodes, forces, winding = *bend, True
            least, most = min(forces), max(forces)
    span = most - least
    margin = WITHIN * TOLERANCE * span
    aimed = min(max(wanted, least + margin), most - margin)
    floor = ROUNDING * max(abs(least), abs(most))
    close = max(CLOSE * TOLERANCE * span, floor)
    if winding:
        cell = _cell(nodes, [force > aimed for force in forces], last)
    else:
        below = bisect_right(rising, aimed)
        cell = (below if forces == rising else len(nodes) - below) - 1
        if not 0 < below < len(nodes):
            cell = 0
    beside = slice(cell, cell + 2)
    current, force = _root(force_at, aimed, nodes[beside], forces[beside], close)
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
    force_at: Force, aimed: float, nodes: list[float], forces: list[float], close: float
) -> tuple[float, float]:
    """The current between two that gives the force to within ``close``, and its force."""
    (low, high), (at_low, at_high) = nodes, (force - aimed for force in forces)
    rises = at_low <= 0.0
    run = at_low - at_high
    part = at_low / run if run else 0.5
    current = low + (part if 0.0 <= part <= 1.0 else 0.5) * (high - low)
    other, at_other = (low, at_low) if abs(at_low) < abs(at_high) else (high, at_high)
    narrowest = ROUNDING * max(abs(high), 1.0)
    before = math.inf
    for _ in range(MOST_STEPS):
        found = current, force_at(current)
        error = found[1] - aimed
        size = abs(error)
        if not (size > close and high - low > narrowest):
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


def _furthest_bend(
    force_at: Force, nodes: list[float], forces: list[float], sign: float, winding: bool
) -> tuple[list[float], list[float]] | None:
    """Nodes and forces, the node at the furthest bend up (or down, by ``sign``) moved onto it.

    None where there is none that is further than its node.
    """
    heights = [sign * force for force in forces]
    last = len(heights) - 1
    bends = [
        place
        for place in range(1, last if winding else 0)
        if heights[place - 1] < heights[place] >= heights[place + 1]
    ]
    # Beside the first or the last node there is one only where the force rises inwards.
    if heights[0] >= heights[1] and sign * _slope(force_at, nodes[0]) > 0.0:
        bends.append(0)
    if heights[last] > heights[last - 1] and sign * _slope(force_at, nodes[last]) < 0.0:
        bends.append(last)
    if not bends:
        return None
    best = max(bends, key=heights.__getitem__)
    low, high = nodes[max(best - 1, 0)], nodes[min(best + 1, last)]
    close = CLOSE * TOLERANCE * (max(forces) - min(forces))
    found = _extremum(force_at, low, high, sign, close)
    force = force_at(found)
    if sign * force <= heights[best]:
        return None
    nodes, forces = nodes.copy(), forces.copy()
    nodes[best], forces[best] = found, force
    return nodes, forces


def _slope(force_at: Force, current: float) -> float:
    return force_at(current + _STEP) - force_at(current - _STEP)


def _extremum(force_at: Force, low: float, high: float, sign: float, close: float) -> float:
    """The current of the largest force (or the least, by ``sign``), by golden section.

    Two equal forces may lie on both sides of it; two pairs in a row differ by less than ``close``
    [N] only on top of it.
    """
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = sign * force_at(left), sign * force_at(right)
    before = math.inf
    for _ in range(_GOLDEN_STEPS):
        difference = abs(at_left - at_right)
        if difference <= close and before <= close:
            break
        before = difference
        if at_left > at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = sign * force_at(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = sign * force_at(right)
    return 0.5 * (low + high)
