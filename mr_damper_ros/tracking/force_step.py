"""Steps of the load cell: a factor or an offset that arrives in the force within one sample.

No damper changes so fast: the coil and the fluid need milliseconds, and a lost seal longer. An
instrument does, such as an amplifier that switches its range, or a load cell that is tared. Three
pieces of evidence decide, all relative to the force of the set in use: the force jumps between two
samples by far more than the error of the set usually changes; it does not move on in the samples
beside the jump; and from then on one factor, or one offset, makes the set as good as before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.models.quantities import SAME_CURRENT
from mr_damper_ros.signals.arrays import SIGMAS, Array, Mask

_BESIDE, _ISOLATED = 2, 0.33
"""In so many samples on either side, the error moves on by less than this part of the jump. A coil
of 5 ms that is sampled every 5 ms moves on by 0.37."""

_FEWEST = 20
"""Smallest number of samples before a jump, and after it for a diagnosis."""

_OFTEN = 0.05
"""Part of the samples in which the error of the set changes more than usual."""

_EXCUSED = 0.05
"""A current that changes within this time [s] of the jump may be its cause."""

_RESOLVES = 5e-3
"""With a longer sample period [s], a coil may change the force by a factor within one sample."""

_GOOD, _AS_GOOD, _EXPLAINS = 0.25, 1.6, 0.5
"""The error of the set before the step over its force; the error that is left over the error
before; and the error that is left, or that before, over the error without the step. All are
medians, which bursts do not change."""

_CLOSE = 0.5
"""Largest difference of the jump from the one that factor or offset gives, relative to the jump."""

_OTHER_SIDE = 0.05
"""Part of the power of the force in the window, on either side of its mean, that tells a factor
from an offset."""

_MOST_TRIED = 8
"""Number of jumps that are tried, the largest ones."""


@dataclass(frozen=True)
class ForceStep:
    """A step of the measured force: times ``factor`` [1], plus ``offset`` [N], since a stamp."""

    stamp_ns: int
    factor: float = 1.0
    offset: float = 0.0

    def apply(self, force: Array) -> Array:
        """A force (n,) [N] of the damper as the load cell shows it."""
        return self.factor * force + self.offset

    @property
    def sentence(self) -> str:
        """The step and its remedy, for people."""
        if self.offset:
            what, cause = f"moved by {self.offset:+.4g} N", "was the load cell tared?"
        else:
            what = f"changed by a factor of {self.factor:.3g}"
            cause = "has its amplifier switched the range?"
        return (
            f"the measured force {what} within one sample, which no damper does: {cause} Switch it "
            "back; or if the new reading is right, call acknowledge of the identifier"
        )


class Compared(NamedTuple):
    """Predicted and measured force [N] and current [A], each (n,), ``period`` [s] apart."""

    predicted: Array
    measured: Array
    current: Array
    period: float


class Found(NamedTuple):
    """A step at the sample ``place``; factor and offset are None until they can be told apart."""

    place: int
    factor: float | None = None
    offset: float | None = None


def find_step(given: Compared) -> Found | None:
    """The step of the load cell in the samples; None without one."""
    predicted, measured, current, period = given
    if measured.size < 2 * _FEWEST:
        return None
    changes = np.diff(measured - predicted)
    usual = float(np.quantile(np.abs(changes), 1.0 - _OFTEN))
    largest = np.argsort(-np.abs(changes), kind="stable")[:_MOST_TRIED]
    for change in np.sort(largest[np.abs(changes[largest]) > SIGMAS * usual]).tolist():
        place, jump = change + 1, changes[change]
        if place < _FEWEST or measured.size - place <= _BESIDE:
            continue
        moves_on = changes[change - _BESIDE : change + _BESIDE + 1] / jump
        moves_on[_BESIDE] = 0.0
        if moves_on.max() > _ISOLATED or _has_excuse(current, place, period):
            continue
        if (found := _judged(given, place)) is not None:
            return found
    return None


def is_back(step: ForceStep, given: Compared) -> bool:
    """Whether the load cell shows the force of the set again, without the step."""
    predicted, measured, *_ = given
    without = _typical(measured - predicted)
    return bool(without < _EXPLAINS * _typical(measured - step.apply(predicted)))


def _has_excuse(current: Array, place: int, period: float) -> bool:
    beside = round(_EXCUSED / period) + 2
    return bool(np.ptp(current[max(place - beside, 0) : place + beside]) > SAME_CURRENT)


def _typical(values: Array, above: Mask | None = None) -> float:
    """Typical size of values (n,): their median, or that of the worse side of the motion."""
    size = np.abs(values)
    return float(np.median(size)) if above is None else max(_medians(size, above), default=np.inf)


def _medians(values: Array, above: Mask) -> list[float]:
    """The median of values (n,) on either side of the motion that has more than a few."""
    sides = (above, ~above)
    return [float(np.median(values[s])) for s in sides if np.count_nonzero(s) > _BESIDE]


def _judged(given: Compared, place: int) -> Found | None:
    """The step at a jump, if one factor or one offset explains the samples from there on."""
    predicted, measured, _, period = given
    residual, above = measured - predicted, predicted > np.mean(predicted)
    nearby = max(min(residual.size - place, place // 2), _FEWEST)
    error = max(
        _typical(residual[begin:place], above[begin:place]) for begin in (0, place - nearby)
    )
    p, m, above = predicted[place:], measured[place:], above[place:]
    without = _typical(m - p)
    sound = np.abs(m) <= SIGMAS * np.quantile(np.abs(m), 1.0 - _OFTEN)
    power = float(p[sound] @ p[sound])
    if not (power > 0.0 and error < min(_GOOD * _typical(predicted), _EXPLAINS * without)):
        return None
    factor = float(p[sound] @ m[sound]) / power if period <= _RESOLVES else 1.0
    offset = float(np.mean(_medians(m - p, above) or math.nan))
    jump = float(residual[place] - residual[place - 1])
    most = min(_AS_GOOD * error, _EXPLAINS * without)
    explained = [
        (left, *step)
        for left, expected, step in (
            (
                _typical(m - factor * p, above) / max(abs(factor), 1.0),
                (factor - 1.0) * float(measured[place - 1]),
                (factor, 0.0),
            ),
            (_typical(m - p - offset, above), offset, (1.0, offset)),
        )
        if left <= most and abs(jump - expected) <= _CLOSE * abs(jump)
    ]
    if not explained:
        return None
    if measured.size - place < _FEWEST or not _tells_apart(p, predicted):
        return Found(place)
    return Found(place, *min(explained)[1:])


def _tells_apart(force: Array, whole: Array) -> bool:
    """Whether enough of a force (n,) [N] lies on both sides of the mean of the ``whole`` motion."""
    mean = float(np.mean(whole))
    return all(
        _power(side * (force - mean)) >= _OTHER_SIDE * _power(side * (whole - mean))
        for side in (1.0, -1.0)
    )


def _power(force: Array) -> float:
    """Sum of the squares of the positive values (n,)."""
    above = force.clip(min=0.0)
    return float(above @ above)
