"""What samples that are held back from a fit say of the sets before and after it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mr_damper_ros.estimation.covariance import NoiseModel
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.acceptance import Evidence
from mr_damper_ros.tracking.running_set import candidate

if TYPE_CHECKING:
    from mr_damper_ros.tracking.tasks import FitTask

_CHUNKS = 40
_HELD_BACK_EVERY = 4
"""Of the chunks into which a window is cut, every fourth is held back from the fit."""


def held_back_samples(count: int, seen: int = 0) -> np.ndarray:
    """Mask (n,) of the samples that are held back: chunks all over those not ``seen`` before."""
    chunk = np.arange(count - seen) * _CHUNKS // max(count - seen, 1)
    held_back = np.zeros(count, dtype=bool)
    held_back[seen:] = chunk % _HELD_BACK_EVERY == _HELD_BACK_EVERY - 1
    return held_back


def seen_samples(task: FitTask, window: Window) -> int:
    """How many samples at the begin of a window the running set was fitted to.

    Where nearly all of them are, as with a hop of a few samples, 0 is returned: what is held back
    then decides nothing, see :func:`evidence_of`.
    """
    new = _new_samples(task)
    return window.sample_count - new if _CHUNKS <= new < window.sample_count else 0


def _new_samples(task: FitTask) -> int:
    raw = task.window
    new = round((raw.end_ns - task.running.stamp_ns) / (raw.period * NANOSECONDS))
    # Of a later set, where time was set back, no sample is known to be in common.
    return new if new >= 0 else raw.force.size


def evidence_of(task: FitTask, held_back: np.ndarray, window: Window, after: Array) -> Evidence:
    """What the held-back samples of a window (mask, shape (n,)) say of a set (p,).

    The set was fitted to the other samples. Where the running set is of this very damper, the new
    one must be ahead of it on samples that neither has seen.
    """
    settled = task.model.settled(window, after)
    spread = float(np.std(window.force))
    old = task.running.force(window)
    found = candidate(task.running, after, window)
    new = found.force(window)
    if not np.isfinite(old).all():
        # Whatever was loaded there, anything is better.
        old = np.full(old.size, math.inf)
    judged = held_back & settled
    rmse_before, rmse_after = (
        float(np.sqrt(np.mean((force - window.force)[judged] ** 2))) for force in (old, new)
    )
    power = float(old[settled] @ old[settled])
    change = math.inf
    if 0.0 < power < math.inf:
        change = float(new[settled] @ old[settled]) / power - 1.0
    lead = math.inf
    if task.known and np.isfinite(old).all():
        noise = NoiseModel.of((new - window.force)[settled])
        one = Lead.of(old, new, window.force, judged, noise)
        lead = Lead.together([one] if _new_samples(task) >= _CHUNKS else [])
    return Evidence(
        rmse_before / spread,
        rmse_after / spread,
        rmse_after,
        change,
        lead,
        _loss(task, found, rmse_before**2 - rmse_after**2),
    )


def _loss(task: FitTask, found: ParameterSet, gain: float) -> float:
    """What the mean square error at other operating points rises by, over a ``gain`` here [N²].

    But for a factor on the force: the strength of the damper may have changed since.
    """
    if not (task.known and task.elsewhere and gain > 0.0):
        return 0.0
    before, after = (_mean_square_elsewhere(each, task.elsewhere) for each in (task.running, found))
    return (after - before) / gain


def _mean_square_elsewhere(found: ParameterSet, windows: Sequence[Window]) -> float:
    """Mean square error [N²] of a set, each window counted once, with the best factor for all."""
    with np.errstate(over="ignore", invalid="ignore"):
        forces = [found.force(window) for window in windows]
        pairs = [(force, window.force) for force, window in zip(forces, windows, strict=True)]
        power = sum(float(np.mean(force * force)) for force, _ in pairs)
        shared = sum(float(np.mean(force * measured)) for force, measured in pairs)
        factor = shared / power if power > 0.0 else 1.0
        errors = [float(np.mean((factor * force - measured) ** 2)) for force, measured in pairs]
    error = sum(errors) / len(errors)
    return error if math.isfinite(error) else math.inf


@dataclass(frozen=True)
class Lead:
    """How far a new force is ahead of an old one on samples that neither was fitted to.

    ``gain``: half of what the sum of squares falls by; ``chance``: its standard deviation where
    both are as good, both in units of the noise's variance. The difference of two sums of squares
    is linear in the noise, whose autocorrelation is known from the residual.
    """

    gain: float
    chance: float

    @classmethod
    def of(
        cls, old: Array, new: Array, measured: Array, judges: np.ndarray, noise: NoiseModel
    ) -> Lead:
        """The lead of forces [N] (n,) on the samples of a mask (n,)."""
        apart = np.where(judges, new - old, 0.0)
        level = max(noise.variance, 1e-300)
        chance = float(noise.score_covariance(apart[:, np.newaxis])[0, 0])
        gain = float(apart @ (measured - 0.5 * (old + new)))
        return cls(gain / level, math.sqrt(max(chance, 0.0)) / level)

    @staticmethod
    def together(leads: Iterable[Lead]) -> float:
        """The lead on all samples of several windows, in standard errors of chance."""
        gain, chance = 0.0, 0.0
        for lead in leads:
            gain += lead.gain
            chance = math.hypot(chance, lead.chance)
        if chance > 0.0:
            return gain / chance
        return math.copysign(math.inf, gain) if gain else 0.0
