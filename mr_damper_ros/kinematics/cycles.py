"""Whether a stretch of motion holds a cycle, or as much as one of any motion."""

from __future__ import annotations

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.white_noise import white_noise

_TURN = 0.05
"""A way back of this part of the span is a turn of the motion, ..."""

_NOISE_TURN = 8.0
"""... if it is more than so many standard deviations of the noise, ..."""

_LARGEST_TURN = 0.25
"""... which is not told from motion near the sampling rate: no turn needs more of the span."""

_EACH_WAY = 0.75
"""Part of the span that each of the two directions must go, in all its strokes."""

_WHOLE_STROKE = 0.5
"""Part of the span that a stroke at the edge of a stretch covers at least, to be a whole one."""

_SLOWER = 0.8
"""From a turn on, the first third of a stroke is less than this part of the middle one."""

_MOST_SAMPLES = (512, 4096)
"""A longer stretch is looked at in so many averages: in few, which most motions need, then more."""

_FEWEST_SAMPLES = 8


def averages(array: Array, most: int) -> Array:
    """Averages over equal groups of the samples (n,), the last ones whole; ``most`` or fewer."""
    size = max(-(-array.size // most), 1)
    whole = array[array.size % size :]
    return whole.reshape(-1, size).mean(axis=1) if size > 1 else whole


def holds_cycle(displacement: Array) -> bool:
    """Whether a displacement (n,) turns above and below, with enough of a way each way.

    That is what it takes to see the force at both signs of the velocity and of the acceleration.
    """
    few, many = (averages(displacement, most) for most in _MOST_SAMPLES)
    return _holds_cycle(few) or (many.size > few.size and _holds_cycle(many))


def _holds_cycle(u: Array) -> bool:
    if u.size < _FEWEST_SAMPLES:
        return False
    span = float(np.ptp(u))
    noise = _NOISE_TURN * white_noise(u)
    turn = min(max(_TURN * span, noise), _LARGEST_TURN * span)
    if not turn > 0.0:
        return False
    places = _turning_points(u.tolist(), turn)
    ways = np.diff(u[places])
    up, down = float(ways[ways > 0.0].sum()), float(-ways[ways < 0.0].sum())
    turns = places.size - 2
    if turns >= 1:
        turns += _is_whole(u[places[0] : places[1] + 1], span)
        turns += _is_whole(u[places[-2] : places[-1] + 1][::-1], span)
    return turns >= 2 and min(up, down) >= _EACH_WAY * span


def _is_whole(stroke: Array, span: float) -> bool:
    """Whether a stroke (n,) begins at a turn of the motion: slowly."""
    thirds = np.abs(np.diff(stroke[[0, stroke.size // 3, 2 * stroke.size // 3]]))
    return bool(np.ptp(stroke) >= _WHOLE_STROKE * span and thirds[0] < _SLOWER * thirds[1])


def _turning_points(u: list[float], turn: float) -> np.ndarray:
    """Places of the first sample, the turns of at least this way back, and the last sample."""
    places = [0]
    low = high = 0
    sense = 0
    for place, value in enumerate(u):
        if value > u[high]:
            high = place
        if value < u[low]:
            low = place
        if sense >= 0 and u[high] - value >= turn:
            if sense:
                places.append(high)
            sense, low = -1, place
        elif sense <= 0 and value - u[low] >= turn:
            if sense:
                places.append(low)
            sense, high = 1, place
    places.append(len(u) - 1)
    return np.array(places)
