"""Moving averages in recorded signals: detection by their spectral zeros, and exact inversion.

The mean of the last n samples has no component at k / n of the sample rate. The spectrum of an
averaged signal therefore has zeros at these frequencies, where the signal cannot be recovered. All
other components can be recovered: y[k] - y[k-1] = (x[k] - x[k-n]) / n, so x[k] = x[k-n] + n (y[k] -
y[k-1]). This requires the n samples before the record: it must begin at rest.
"""

from __future__ import annotations

import numpy as np

from mr_damper_ros.signals.arrays import NEGLIGIBLE, Array

_ENOUGH = 32_768
"""Number of samples that are analysed, taken from the middle of a longer record."""

_SLOPE = 0.1
"""Lower limit of the power at half gain of an average over the power between its zeros."""

_FEWEST_ROWS = 20
"""Shortest record in which the zeros are resolved, as a multiple of the length of the average."""

_SEEN_ROWS, _NARROW_ROWS = 12, 26
"""Shortest record in which the zeros are seen, and in which they are resolved by the window of the
spectrum, as multiples of the length of the average."""

_LINE_WIDTH = 2.0
_LINE_HEIGHT = 5.0
"""Half width [bins] of a spectral line, and its least power over the power between the lines; the
ratio was at most 1.2 in undone signals, and above 10 after a wrong count."""

_LEAST_PATTERN = 0.03
"""Smallest relative amplitude of a pattern that distorts a signal."""

_FEWEST_HOLES = 5
"""Smallest number of zeros up to half the sample rate by which an average is recognised."""


def undo_average(values: Array, count: int) -> Array:
    """Signal (n,) before averaging over ``count`` samples; the record must begin at rest."""
    steps = count * np.diff(values, prepend=values[0])
    rows = -(-steps.size // count)
    padded = np.zeros(rows * count)
    padded[: steps.size] = steps
    sums = np.cumsum(padded.reshape(rows, count), axis=0)
    return np.asarray(values[0] + sums.reshape(-1)[: steps.size])


def undo_average_in_motion(values: Array, count: int) -> Array:
    """Signal before averaging over ``count`` samples, for a record (n,) that begins in motion.

    The ``count`` samples before the record are unknown, but affect the whole result, by components
    at the frequencies k / count, which the average removes. The result is defined to have no such
    components except the mean. A raised-cosine weight over the record preserves the neighbouring
    frequencies. Raises ValueError if the record is too short.
    """
    rows = values.size // count
    if rows < _FEWEST_ROWS:
        raise ValueError(
            f"a moving average over {count} samples cannot be undone in a record of {values.size} "
            f"samples that begins in motion: {_FEWEST_ROWS * count} are needed"
        )
    undone = undo_average(values, count)
    weights = np.hanning(undone.size + 2)[1:-1]
    shape, most = (rows, count), rows * count
    sums = [part[:most].reshape(shape).sum(axis=0) for part in (weights * undone, weights)]
    pattern = sums[0] / sums[1]
    level = float(np.mean(values[count:])) - float(np.mean(undone[count:]))
    without = undone - np.resize(pattern - pattern.mean(), undone.size)
    return np.asarray(without + level)


def pattern_left(values: Array, count: int) -> float:
    """Amplitude of a pattern of ``count`` samples in an undone signal (n,), relative to its RMS.

    It is the trace of an average over another count, of noise that came after the average, and of a
    start in motion. Returns 0 without such a trace, and for a record that is too short to tell.
    """
    spacing = values.size / count
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(values.size))) ** 2
    order = np.arange(power.size) / spacing
    distance = np.abs(order - np.rint(order))
    lines = power[(distance * spacing <= _LINE_WIDTH) & (order > 0.5)]
    between = power[(distance >= 0.25) & (order > 0.5)]
    if spacing < _FEWEST_ROWS or not lines.mean() > _LINE_HEIGHT * between.mean():
        return 0.0
    part = float(np.sqrt(lines.sum() / power.sum()))
    return part if part > _LEAST_PATTERN else 0.0


def find_average(values: Array) -> int:
    """Number of samples over which a signal (n,) was averaged; 1 if no average is detected.

    An average over two, three or four samples has too few zeros for a reliable decision.
    """
    middle = max(values.size - _ENOUGH, 0) // 2
    steps = np.diff(values[middle : middle + _ENOUGH])
    longest = steps.size // _SEEN_ROWS
    power = np.abs(np.fft.rfft(steps * np.hanning(steps.size))) ** 2
    for count in range(longest, 2 * _FEWEST_HOLES - 1, -1):
        spacing = steps.size / count
        holes = np.arange(1, count // 2) * spacing
        in_holes, near, between = (
            np.maximum(power[np.rint(holes + part * spacing).astype(int)], 1e-300)
            for part in (0.0, 0.25, 0.5)
        )
        # Most of the zeros must be present; at twice the true count, every second one is missing.
        # An averaged signal also has the zeros of each divisor of its count, so the longest count
        # is chosen. Beside the zeros there must be power; if not, the zeros are only the gaps
        # between the lines of a periodic signal.
        # The window of the spectrum fills narrow holes.
        least = NEGLIGIBLE * max(1.0, (_NARROW_ROWS / spacing) ** 2)
        deep = float(np.quantile(in_holes / between, 0.7)) < least
        if deep and float(np.median(near / between)) > _SLOPE:
            return count
    return 1
