"""What samples that were held back from a fit say of the sets before and after it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.estimation.covariance import NoiseModel
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array

CHUNKS = 40
_HELD_BACK_EVERY = 4
"""Of the chunks into which a window is cut, every fourth is held back from the fit. A chunk has at
least one sample: fewer new ones than chunks decide nothing."""

_LEAST_WEIGHT = 0.1

BEYOND_CHANCE = 2.5
"""A set is exchanged for a lead of so many standard errors.

A lead that is nothing but chance exceeds it once in 160 windows, and more rarely here: a new fit
errs by its own noise, for which it falls behind on samples that it has not seen.
"""


HARDLY = 0.03
"""A set for more operating points may leave so much more of the force than the running set at one.
"""

_MAY_LOSE = 0.5
"""A set of one window may lose so much elsewhere of what it gains there: it was fitted to that one
(``foreign_worse_sets``)."""

STILL_GOOD = 0.3
"""Where the running set leaves no more than this part of the force, there is something to lose."""

WORTH_WHILE = 0.9
"""A good set is exchanged for one that leaves less than so many times what it leaves: what is as
good where it was seen may be worse where it was not (``foreign_worse_sets``)."""


@dataclass(frozen=True)
class Evidence:
    """What a window says of the running and the new set, on samples held back from the fit.

    ``nrmse_before`` and ``nrmse_after``: RMSE/std; ``rmse_after`` [N]; ``force_change``: relative
    change of the force from the running to the new set over the window's motion; ``lead``: how far
    the new set is ahead on samples that no set was fitted to, in standard errors of chance.
    ``loss``: what the mean square errors at the other operating points of late rise by in sum, over
    what that here falls by [1], and ``nrmse_elsewhere``: what the running set leaves there.
    ``recent``: of a search, NRMSE of both sets at the operating points of late.
    """

    nrmse_before: float
    nrmse_after: float
    rmse_after: float = math.nan
    force_change: float = math.nan
    lead: float = math.inf
    loss: float = 0.0
    nrmse_elsewhere: float = math.inf
    recent: tuple[float, float] = (math.inf, 0.0)

    @property
    def better(self) -> bool:
        """Whether the new set predicts better than the running one, beyond chance."""
        return self.nrmse_after < self.nrmse_before and self.lead > BEYOND_CHANCE

    @property
    def loses_elsewhere(self) -> bool:
        """Whether the running set is good elsewhere, and the new one too much worse there."""
        return self.loss > _MAY_LOSE and self.nrmse_elsewhere <= STILL_GOOD

    @property
    def shape_change(self) -> float:
        """Part of the new set's force [1] that is no multiple of the running set's.

        It follows from the other figures where the new set explains the force and the mean of the
        force is small; NaN where it does not.
        """
        new = 1.0 - self.nrmse_after**2
        difference = self.nrmse_before**2 - self.nrmse_after**2
        factor = 1.0 + self.force_change
        weight = 2.0 * factor - 1.0
        # Near half the force the two differences cancel.
        if not (new > 0.0 and abs(weight) > _LEAST_WEIGHT):
            return math.nan
        known = (new - difference) / (weight * new)
        return math.sqrt(max(1.0 - factor**2 * known, 0.0)) if known > 0.0 else math.nan


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


def held_back_samples(count: int, fresh: int | None = None) -> np.ndarray:
    """Mask (n,) of the samples that are held back from a fit: chunks all over the ``fresh`` ones.

    ``fresh`` counts the samples at the end that the running set was not fitted to. Where these are
    too few, as with a hop of a few samples, all count: what is held back then decides nothing, see
    :func:`evidence_of`.
    """
    judged = count if fresh is None or not CHUNKS <= fresh < count else fresh
    chunk = np.arange(judged) * CHUNKS // max(judged, 1)
    held_back = np.zeros(count, dtype=bool)
    held_back[count - judged :] = chunk % _HELD_BACK_EVERY == _HELD_BACK_EVERY - 1
    return held_back


def evidence_of(
    running: ParameterSet,
    found: ParameterSet,
    window: Window,
    held_back: np.ndarray,
    *,
    fresh: int,
    elsewhere: Sequence[Window] = (),
) -> Evidence:
    """What the held-back samples of a window (mask, shape (n,)) say of a set that was ``found``.

    That was fitted to the other samples. Where the running set is of this very damper, the new one
    must be ahead of it on samples that neither has seen: there are ``fresh`` ones. ``elsewhere``:
    windows at other operating points of late.
    """
    settled = running.law.settled(window, found.values)
    spread = float(np.std(window.force))
    old, new = running.window_force(window), found.window_force(window)
    known = bool(running.observable.any() and np.isfinite(old).all())
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
    lead, loss, left_elsewhere = math.inf, 0.0, math.inf
    if known:
        noise = NoiseModel.of((new - window.force)[settled])
        one = Lead.of(old, new, window.force, judged, noise)
        lead = Lead.together([one] if fresh >= CHUNKS else [])
        gain = rmse_before**2 - rmse_after**2
        if elsewhere and gain > 0.0:
            before, after = (_mean_square(each, elsewhere) for each in (running, found))
            loss = len(elsewhere) * (after - before) / gain
            means = [float(np.mean(each.force)) for each in elsewhere]
            squares = [float(np.mean(each.force**2)) for each in elsewhere]
            variance = float(np.mean(squares) - np.mean(means) ** 2)
            left_elsewhere = math.sqrt(before / variance) if variance > 0.0 else math.inf
    return Evidence(
        rmse_before / spread,
        rmse_after / spread,
        rmse_after,
        change,
        lead,
        loss,
        left_elsewhere,
    )


def rival_wins(
    rival: ParameterSet,
    running: ParameterSet,
    window: Window,
    *,
    fresh: int,
    elsewhere: Sequence[Window] = (),
) -> bool:
    """Whether a rival of the running set predicts a window better, by its last ``fresh`` samples.

    Neither set was fitted to these. A rival that holds for more currents may leave hardly more.
    ``elsewhere`` as in :func:`evidence_of`.
    """
    judges = np.arange(window.sample_count) >= window.sample_count - fresh
    found = evidence_of(running, rival, window, judges, fresh=fresh, elsewhere=elsewhere)
    lows, highs = zip(rival.current_range, running.current_range, strict=True)
    if highs[0] - lows[0] > highs[1] - lows[1]:
        allowed = found.nrmse_before + HARDLY
    else:
        allowed = WORTH_WHILE * found.nrmse_before
    return found.nrmse_after <= allowed and not found.loses_elsewhere


def _mean_square(found: ParameterSet, windows: Sequence[Window]) -> float:
    """Mean square error [N²] of a set, each window counted once, with the best factor for all.

    But for a factor on the force: the strength of the damper may have changed since.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        forces = [found.window_force(window) for window in windows]
        pairs = [(force, window.force) for force, window in zip(forces, windows, strict=True)]
        power = sum(float(np.mean(force * force)) for force, _ in pairs)
        shared = sum(float(np.mean(force * measured)) for force, measured in pairs)
        factor = shared / power if power > 0.0 else 1.0
        errors = [float(np.mean((factor * force - measured) ** 2)) for force, measured in pairs]
    error = sum(errors) / len(errors)
    return error if math.isfinite(error) else math.inf
