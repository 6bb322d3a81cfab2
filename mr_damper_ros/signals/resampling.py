"""Samples that are not on the grid brought onto it: lost ones, and such as were taken unevenly."""

from __future__ import annotations

import numpy as np

from mr_damper_ros.signals.arrays import Array

_FEWEST, _MOST = 3, 12
"""Samples on either side of a gap that its slope is taken from."""

_AROUND = 13
"""Samples that the way of one of them in the middle is taken from; at the end, those before."""

_RIDGE = 1e-9

_DECIDED = 3.0
"""Standard errors by which the share must lie above or below one half to be believed."""

_TOGETHER, _ENOUGH = 32, 30
"""Samples that are looked at together where none is lost, and at least before anything is said."""

_FORGETTING = 0.9997
"""Part of what was seen before that still counts with each further sample."""


def on_a_line(before: Array, after: Array, count: int) -> Array:
    """``count`` values on the straight line from the last of ``before`` to the first of ``after``.

    For the force, which turns too sharply for more to be gained.
    """
    place = np.arange(1.0, count + 1.0) / (count + 1.0)
    return np.asarray(before[-1] + (after[0] - before[-1]) * place)


def on_a_cubic(before: Array, after: Array, count: int) -> Array:
    """``count`` values between the last of ``before`` (n,) and the first of ``after`` (m,).

    A cubic (Hermite's) with the values and slopes at both ends; where after holds a value or two, a
    parabola. Each slope is that of a parabola through the nearest samples. Of fewer than three
    values before, a straight line. For the displacement: over a twentieth of a cycle its error is a
    tenth of the line's.
    """
    width = count + 1.0
    place = np.arange(1.0, width) / width
    low, high = float(before[-1]), float(after[0])
    line = on_a_line(before, after, count)
    if before.size < _FEWEST:
        return line
    points = min(max(count + 2, _FEWEST), _MOST)
    # Slopes less that of the line, times the width of the gap.
    start = width * _end_slope(before[-points:]) - (high - low)
    if after.size < _FEWEST:
        return line + start * place * (1.0 - place)
    end = -width * _end_slope(after[points - 1 :: -1] if after.size >= points else after[::-1])
    end -= high - low
    return np.asarray(line + place * (1.0 - place) * (start * (1.0 - place) - end * place))


def at_even_times(wanted: Array, places: Array, values: Array) -> Array:
    """The last n of the ``values`` (m,), taken at ``places`` (m,), brought to ``wanted`` (n,).

    Each goes the little way to its time along the cubic that fits those around it best. So its
    noise stays its own: on a line between two samples it would be the smaller the further from
    them, and a filter that knows noise by its being white would take what is left of it for motion.
    """
    width = min(_AROUND, places.size)
    powers = np.arange(min(3, width - 1) + 1)
    own = np.arange(places.size - wanted.size, places.size)
    first = np.clip(own - width // 2, 0, places.size - width)
    around = first[:, np.newaxis] + np.arange(width)
    unit = 0.5 * width
    time = (places[around] - places[own, np.newaxis]) / unit
    columns = time[:, :, np.newaxis] ** powers
    rows = columns.transpose(0, 2, 1)
    # Many samples may have come with one stamp.
    square = rows @ columns + _RIDGE * np.eye(powers.size)
    away = values[around] - values[own, np.newaxis]
    cubic = np.linalg.solve(square, rows @ away[:, :, np.newaxis])[:, :, 0]
    way = ((wanted - places[own]) / unit)[:, np.newaxis] ** powers
    return np.asarray(values[own] + (cubic * way)[:, 1:].sum(axis=1))


def _end_slope(values: Array) -> float:
    """Slope per sample at the last of some values, of the parabola that fits them best."""
    time = np.arange(1.0 - values.size, 1.0)
    columns = np.stack([np.ones(values.size), time, time * time], axis=1)
    weights, *_ = np.linalg.lstsq(columns, values, rcond=None)
    return float(weights[1])


class UnevenSampling:
    """Tells whether stamps that jitter do so because the samples were taken unevenly.

    Where they were, a sample lies off the mean of its neighbours by the speed times how far its
    stamp lies off theirs; where only the reading of the time jitters, it does not. The share of it
    is found by least squares, 1 for the one and 0 for the other.
    """

    def __init__(self) -> None:
        self._late: list[Array] = []
        self._values: list[Array] = []
        self._waiting = 0
        self._next = 0
        self._product, self._square, self._rest, self._count = 0.0, 0.0, 0.0, 0.0
        self.found = False

    def learn(self, index: int, late: float, displacement: Array) -> None:
        """Take in a block that was stamped so late [sample periods], negative for early.

        ``index`` is that of its first sample; where it does not go on, none is a neighbour.
        """
        if index != self._next:
            self._look()
            self._late, self._values, self._waiting = [], [], 0
        self._next = index + displacement.size
        self._late.append(np.full(displacement.size, late))
        self._values.append(displacement)
        self._waiting += displacement.size
        if self._waiting >= _TOGETHER:
            self._look()

    def _look(self) -> None:
        if self._waiting == 0:
            return
        late, values = np.concatenate(self._late), np.concatenate(self._values)
        # The last two are the neighbours of the next ones.
        self._late, self._values, self._waiting = [late[-2:]], [values[-2:]], 0
        off = values[1:-1] - 0.5 * (values[:-2] + values[2:])
        expected = 0.5 * (values[2:] - values[:-2]) * (late[1:-1] - 0.5 * (late[:-2] + late[2:]))
        moved = expected != 0.0
        off, expected = off[moved], expected[moved]
        known = _FORGETTING**off.size
        self._product = known * self._product + float(off @ expected)
        self._square = known * self._square + float(expected @ expected)
        self._rest = known * self._rest + float(off @ off)
        self._count = known * self._count + off.size
        if self._count < _ENOUGH or self._square == 0.0:
            return
        share = self._product / self._square
        noise = max(self._rest / self._square - share**2, 0.0) / self._count
        if abs(share - 0.5) > _DECIDED * noise**0.5:
            self.found = share > 0.5
