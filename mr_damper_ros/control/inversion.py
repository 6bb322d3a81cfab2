"""The current for a wanted force: the inverse of any law.

The force is not monotone in the current: of several currents the lowest is taken, or the one
nearest to the last, so that a current does not jump where the force moves on. Outside of what the
limits of the current allow, the nearest force is, and the lowest current that gives it: above one
ampere a damper may have nearly all of its force.

Every sample is looked at by itself: the law's force over the current at some sixty nodes, then
the secant within the bracket that they show, with bisection where it does not get on. Of a few
samples :mod:`sample_inversion` does the same in less time, for laws that have plain numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.models.current_response import CurrentResponse
from mr_damper_ros.signals.arrays import Array

TOLERANCE = 1e-6
"""Part of the span, the forces that the currents can give, by which the force may be missed."""

WITHIN = 0.4
"""Part of that by which the ends of the span are drawn in, so that they are had too."""

CLOSE = 1e-3
"""Part of that at which a search ends."""

MOST_STEPS = 80

LEAST_GAIN = 0.5
"""A step of the secant that leaves more than this part of the error is followed by a bisection."""

_PARTS = np.linspace(0.0, 1.0, 17)
_ROUNDS = 7
"""They narrow a cell to a millionth: the force at an extremum is flat, or has a kink."""

ROUNDING = 4.0 * float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False)
class Inversion:
    """Currents for wanted forces; all of shape (n,).

    ``current`` [A] of the coil, the ``force`` [N] that it gives, and whether that is what was
    wanted (``attainable``); ``least`` and ``most`` [N]: the forces that could be had.
    """

    current: Array
    force: Array
    attainable: np.ndarray
    least: Array
    most: Array


def invert(
    response: CurrentResponse, nodes: Array, wanted: Array, last: Array | float | None = None
) -> Inversion:
    """The currents at which the response gives the ``wanted`` forces (n,) [N].

    ``nodes`` (m,) [A] rise from the lowest to the highest current that may be used; see
    :meth:`mr_damper_ros.models.Model.current_nodes`. ``last`` [A]: where there are several
    currents, the one near it is meant; None for the lowest.
    """
    forces = response.force(nodes)
    least, most = forces.min(axis=-1), forces.max(axis=-1)
    places = np.broadcast_to(nodes, forces.shape)
    # A force that only an extremum between two nodes may give.
    beyond = (wanted < least) | (wanted > most)
    if beyond.any():
        places, forces = _with_extrema(response, places, forces, wanted, beyond)
        least, most = forces.min(axis=-1), forces.max(axis=-1)
    span = most - least
    margin = WITHIN * TOLERANCE * span
    aimed = np.minimum(np.maximum(wanted, least + margin), most - margin)
    bracket = _bracket(places, forces - aimed[:, np.newaxis], last)
    floor = ROUNDING * np.maximum(np.abs(least), np.abs(most))
    close = np.maximum(CLOSE * TOLERANCE * span, floor)
    current, force = _root(response, aimed, bracket, close)
    allowed = np.maximum(TOLERANCE * span, 2.0 * floor)
    return Inversion(current, force, np.abs(force - wanted) <= allowed, least, most)


class _Bracket(NamedTuple):
    """Currents (n,) between which a force is met, and how far it is off there [N]."""

    low: Array
    high: Array
    at_low: Array
    at_high: Array


def _bracket(places: Array, errors: Array, last: Array | float | None) -> _Bracket:
    """The cell of the nodes (n, m) whose errors [N] change sign: the first, or nearest to last."""
    above = errors > 0.0
    crossed = above[:, 1:] != above[:, :-1]
    if last is None:
        cell = crossed.argmax(axis=-1)
    else:
        behind = places[:, 1:] - np.reshape(last, (-1, 1))
        ahead = np.reshape(last, (-1, 1)) - places[:, :-1]
        away = np.maximum(np.maximum(-behind, -ahead), 0.0)
        cell = np.where(crossed, away, np.inf).argmin(axis=-1)
    rows = np.arange(cell.size)
    return _Bracket(
        places[rows, cell],
        places[rows, cell + 1],
        errors[rows, cell],
        errors[rows, cell + 1],
    )


def _root(
    response: CurrentResponse, aimed: Array, bracket: _Bracket, close: Array
) -> tuple[Array, Array]:
    """Currents (n,) within the bracket that give the forces to within ``close``, and the forces."""
    low, high, at_low, at_high = bracket
    rises = at_low <= 0.0
    nearer = np.abs(at_low) < np.abs(at_high)
    other, at_other = np.where(nearer, low, high), np.where(nearer, at_low, at_high)
    with np.errstate(divide="ignore", invalid="ignore"):
        part = at_low / (at_low - at_high)
        part = np.where((part >= 0.0) & (part <= 1.0), part, 0.5)
        current = low + part * (high - low)
        before = np.full(current.shape, np.inf)
        for _ in range(MOST_STEPS):
            force = response.force(current[:, np.newaxis])[:, 0]
            error = force - aimed
            size = np.abs(error)
            open_ = (size > close) & (high - low > ROUNDING * np.maximum(np.abs(high), 1.0))
            if not open_.any():
                break
            below = (error <= 0.0) == rises
            low, high = np.where(below, current, low), np.where(below, high, current)
            secant = current - error * (current - other) / (error - at_other)
            useful = (secant > low) & (secant < high) & (size <= LEAST_GAIN * before)
            other, at_other = current, error
            step = np.where(useful, secant, 0.5 * (low + high))
            current = np.where(open_, step, current)
            before = np.where(useful, size, np.inf)
    return current, force


def _with_extrema(
    response: CurrentResponse, places: Array, forces: Array, wanted: Array, beyond: np.ndarray
) -> tuple[Array, Array]:
    """Nodes and forces (n, m), the node at the furthest bend towards a wanted force moved onto it.

    Only where the wanted force is ``beyond`` those of the nodes. An end may be further still.
    """
    rows = np.arange(wanted.size)
    sign = np.where(wanted > forces.max(axis=-1), 1.0, -1.0)
    heights = sign[:, np.newaxis] * forces
    rises = np.diff(heights, axis=-1) > 0.0
    bends = np.empty(forces.shape, dtype=bool)
    bends[:, 1:-1] = rises[:, :-1] & ~rises[:, 1:]
    # Beside the first or the last node there is one only where the force rises inwards.
    slopes = sign[:, np.newaxis] * response.slope(places[:, [0, -1]])
    bends[:, 0] = (slopes[:, 0] > 0.0) & ~rises[:, 0]
    bends[:, -1] = (slopes[:, 1] < 0.0) & rises[:, -1]
    bends &= beyond[:, np.newaxis]
    inner = bends.any(axis=-1)
    if not inner.any():
        return places, forces
    best = np.where(bends, heights, -np.inf).argmax(axis=-1)
    found, at = _extremum(
        response,
        places[rows, np.maximum(best - 1, 0)],
        places[rows, np.minimum(best + 1, places.shape[1] - 1)],
        sign,
    )
    better = inner & (sign * at > heights[rows, best])
    places, forces = places.copy(), forces.copy()
    places[rows[better], best[better]] = found[better]
    forces[rows[better], best[better]] = at[better]
    return places, forces


def _extremum(
    response: CurrentResponse, low: Array, high: Array, sign: Array
) -> tuple[Array, Array]:
    """The currents (n,) of the largest force (or the least, by ``sign``), and the forces [N]."""
    rows = np.arange(sign.size)
    for _ in range(_ROUNDS):
        places = low[:, np.newaxis] + (high - low)[:, np.newaxis] * _PARTS
        sizes = sign[:, np.newaxis] * response.force(places)
        best = sizes.argmax(axis=-1)
        low = places[rows, np.maximum(best - 1, 0)]
        high = places[rows, np.minimum(best + 1, _PARTS.size - 1)]
    return places[rows, best], sign * sizes[rows, best]
