"""Moving averages in recorded signals: found by their spectral zeros, and undone exactly.

The mean of the last n samples passes nothing at the frequencies k / n of the sampling rate, so a
signal that was averaged has holes in its spectrum there, and nothing brings back what was in them.
All else comes back: y[k] - y[k-1] = (x[k] - x[k-n]) / n, so x[k] = x[k-n] + n (y[k] - y[k-1]),
where the n samples before the record are known, as they are at rest.
"""

from __future__ import annotations

import numpy as np

from mr_damper_ros.signals.arrays import Array

_ENOUGH = 32_768
"""Samples of a longer record that are looked at, from its middle."""

_DEPTH = 1e-2
"""Power in the holes over that between them below which they are those of an average."""

_SLOPE = 0.1
"""The same half way up to between them, where an average leaves a half."""

_FEWEST_ROWS = 20
"""A record that begins in motion is so many times as long as its average."""

_FEWEST_HOLES = 5
_PERIODS = 40
"""A record is so many times as long as the average, for its holes to be resolved."""


def undo_average(values: Array, count: int) -> Array:
    """What was averaged over ``count`` samples, from the rest at its begin; shape (n,)."""
    steps = count * np.diff(values, prepend=values[0])
    rows = -(-steps.size // count)
    padded = np.zeros(rows * count)
    padded[: steps.size] = steps
    sums = np.cumsum(padded.reshape(rows, count), axis=0)
    return np.asarray(values[0] + sums.reshape(-1)[: steps.size])


def undo_average_in_motion(values: Array, count: int) -> Array:
    """What was averaged over ``count`` samples in a record (n,) that begins in motion.

    The samples before the record are unknown: ``count`` numbers, which go on through all of what is
    undone. They are what the average has lost, the signal at the frequencies k / count: of that
    there is taken to be none, but for the mean. Weighted over the record by a raised cosine, so
    that what is next to those frequencies stays. Raises ValueError for a record too short for that.
    """
    rows = values.size // count
    if rows < _FEWEST_ROWS:
        raise ValueError(
            f"an average over {count} samples that began before the record cannot be undone in "
            f"{values.size} samples: {_FEWEST_ROWS * count} are needed"
        )
    undone = undo_average(values, count)
    weights = np.hanning(undone.size + 2)[1:-1]
    shape, most = (rows, count), rows * count
    sums = [part[:most].reshape(shape).sum(axis=0) for part in (weights * undone, weights)]
    pattern = sums[0] / sums[1]
    level = float(np.mean(values[count:])) - float(np.mean(undone[count:]))
    without = undone - np.resize(pattern - pattern.mean(), undone.size)
    return np.asarray(without + level)


def find_average(values: Array) -> int:
    """Over how many samples a signal (n,) was averaged; 1 where it shows no sign of it.

    An average of two, three or four samples leaves too few holes to be told from chance.
    """
    middle = max(values.size - _ENOUGH, 0) // 2
    steps = np.diff(values[middle : middle + _ENOUGH])
    longest = steps.size // _PERIODS
    power = np.abs(np.fft.rfft(steps * np.hanning(steps.size))) ** 2
    for count in range(longest, 2 * _FEWEST_HOLES - 1, -1):
        spacing = steps.size / count
        holes = np.arange(1, count // 2) * spacing
        in_holes, near, between = (
            np.maximum(power[np.rint(holes + part * spacing).astype(int)], 1e-300)
            for part in (0.0, 0.25, 0.5)
        )
        # Most of the holes must be there: those of twice the average are not, at every other place.
        # What was averaged over so many samples has the holes of every part of them too. Half way
        # up there must be something as well: else these are the lines of a periodic signal.
        deep = float(np.quantile(in_holes / between, 0.7)) < _DEPTH
        if deep and float(np.median(near / between)) > _SLOPE:
            return count
    return 1
