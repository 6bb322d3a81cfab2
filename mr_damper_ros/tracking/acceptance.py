"""Whether a new parameter set may replace the running one.

Samples that were held back from its fit say how well each of the two predicts (:class:`Evidence`);
the :class:`Gatekeeper` decides, with what is known of the damper.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from mr_damper_ros.estimation.covariance import NoiseModel
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.operating_point import (
    MOST_WINDOWS,
    KnownForce,
    KnownPoints,
    OperatingPoint,
    Residual,
    excess_residual,
)

CHUNKS = 40
_HELD_BACK_EVERY = 4
"""Of the chunks into which a window is cut, every fourth is held back from the fit. A chunk has at
least one sample: fewer new ones than chunks decide nothing."""

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
    ``shape_change``: part of the new set's force [1] that is no multiple of the running set's;
    ``loss``: what the mean square errors at the other operating points of late rise by in sum, over
    what that here falls by [1], and ``nrmse_elsewhere``: what the running set leaves there.
    ``recent``: of a search, NRMSE of both sets at the operating points of late.
    """

    nrmse_before: float
    nrmse_after: float
    rmse_after: float = math.nan
    force_change: float = math.nan
    lead: float = math.inf
    shape_change: float = 0.0
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
    gradual = turns_gradually(found, window)
    settled = found.law_turning(gradual=gradual).settled(window, found.values)
    spread = float(np.std(window.force))
    old, new = (each.window_force(window, gradual=gradual) for each in (running, found))
    known = bool(running.observable.any() and np.isfinite(old).all())
    if not np.isfinite(old).all():
        # Whatever was loaded there, anything is better.
        old = np.full(old.size, math.inf)
    judged = held_back & settled
    rmse_before, rmse_after = (
        float(np.sqrt(np.mean((force - window.force)[judged] ** 2))) for force in (old, new)
    )
    power = float(old[settled] @ old[settled])
    change, shape = math.inf, 1.0
    if 0.0 < power < math.inf:
        common = float(new[settled] @ old[settled])
        change = common / power - 1.0
        own = max(float(new[settled] @ new[settled]), 1e-300)
        shape = math.sqrt(max(1.0 - common**2 / (power * own), 0.0))
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
        shape,
        loss,
        left_elsewhere,
    )


def turns_gradually(found: ParameterSet, window: Window) -> bool:
    """Whether the force of a window turns gradually, as far as a set tells; see ``law_turning``.

    The prediction follows the measured force in this, too: a set is judged as it is used.
    """
    jumping, gradual = found.law, found.law.continuous
    if gradual is jumping:
        return False
    errors = []
    for law in (jumping, gradual):
        settled = law.settled(window, found.values)
        error = (law.window_force(found.held(window), found.values) - window.force)[settled]
        errors.append(float(error @ error) / error.size if error.size else math.inf)
    return errors[1] < errors[0]


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


_OTHER_SHAPE = 0.3
"""Temperature and wear move the loop of a steady motion by less than this part of the force from
one window to the next: a delay between the sensors does more."""

_FITS = 0.15
"""A running set that leaves no more than this part of the force is confirmed, whatever is usual."""

_SURPRISING = 0.2
"""Where so much of the force has another shape than the running set has it, although that holds
there, the next window must confirm it (``foreign_worse_sets``)."""

_SAME_FORCE = 0.05
_FAR_BETTER = 1.5
"""Where a set holds and the residual stays large, another force is taken for that of a sensor,
unless it is so near the known one, or the new set leaves so many times less."""


class Verdict(IntEnum):
    """What became of a window or a global identification; the numbers are those of FitReport."""

    ACCEPTED = 1
    """The new set predicts better: it is in use."""
    ACCEPTED_EARLY = 2
    """The force had changed: the running set was brought up to date from a few samples."""
    NO_BETTER = 3
    """The running set predicts as well: it stays in use."""
    FAULT_OF_DATA = 4
    """The samples cannot be used: nothing was fitted."""
    POOR_FIT = 5
    """The fit leaves too much of the force unexplained."""
    DISTURBED = 6
    """The residual is far above the usual one."""
    UNCONFIRMED = 7
    """The next window must confirm it: a force that changed much at once, or a set of a search."""
    FAILED = 8
    """Nothing was computed, through no fault of the data."""
    TOO_LITTLE_MOTION = 9
    """The motion does not show enough of the damper yet: nothing was fitted."""
    BEYOND_LIMITS = 10
    """The force differs from all that is known by more than a damper can change."""

    @property
    def accepted(self) -> bool:
        """Whether a new set is in use."""
        return self in (Verdict.ACCEPTED, Verdict.ACCEPTED_EARLY)

    @property
    def confirms(self) -> bool:
        """Whether the samples fit the set in use after it, a new one or the old one."""
        return self.accepted or self is Verdict.NO_BETTER


@dataclass(frozen=True)
class Judgement:
    """A verdict and, for people, why: one sentence, empty where it needs none.

    ``usual``: whether the residual is the usual one, so that there is something to learn.
    """

    verdict: Verdict
    sentence: str = ""
    usual: bool = True

    @property
    def teaches(self) -> bool:
        """Whether the samples are good enough to compare others with them."""
        return self.usual and self.verdict.confirms


ACCEPTED = Judgement(Verdict.ACCEPTED)


def _disturbed(excess: float, nrmse_before: float) -> Judgement:
    """The judgement of a residual so many times the usual one: the set in use may fit all the same.

    What is usual is a matter of the motions and currents seen, above all where these change.
    """
    sentence = f"the residual is {excess:.1f} times the residual baseline: "
    if nrmse_before <= _FITS:
        return Judgement(
            Verdict.NO_BETTER,
            sentence + f"the running set, with an NRMSE of {nrmse_before:.0%}, stays in use",
            usual=False,
        )
    return Judgement(Verdict.DISTURBED, sentence + "a disturbance or a sensor fault")


def fault_of_data(sentence: str) -> Judgement:
    """The judgement of data that cannot be used."""
    return Judgement(Verdict.FAULT_OF_DATA, sentence)


def failed(error: Exception) -> Judgement:
    """The judgement where the identification itself came to grief, whatever the data."""
    return Judgement(
        Verdict.FAILED,
        f"the identification failed ({type(error).__name__}: {error}): the running set stays",
    )


def too_little_motion(sentence: str) -> Judgement:
    """The judgement of a window that lacks motion: its data may be all right."""
    return Judgement(Verdict.TOO_LITTLE_MOTION, sentence)


@dataclass(frozen=True)
class AcceptanceSettings(CheckedSettings):
    """Limits that a fit must keep to be accepted."""

    maximum_nrmse: float = option(
        0.5,
        "Largest error on the validation samples, RMSE / standard deviation of the force; a "
        "fit with a larger error is rejected.",
        minimum=0.0,
        maximum=10.0,
    )
    residual_factor: float = option(
        3.0,
        "A residual of this many times the residual baseline counts as a disturbance or "
        "sensor fault, unless it lasts for several windows.",
        minimum=1.0,
        maximum=1e6,
    )
    change_limit: float = option(
        3.0,
        "Largest factor, up or down, by which temperature and wear change the force. Forces "
        "that differ more from the first accepted one are always rejected (verdict "
        "BEYOND_LIMITS): check the sensors, and call the service reset if the damper was "
        "replaced.",
        minimum=1.0,
        maximum=1e6,
    )
    step_limit: float = option(
        0.5,
        "A larger relative change of the force must be confirmed by the next window.",
        minimum=0.0,
        maximum=1e6,
    )


@dataclass(eq=False)
class Experience:
    """What the judgement of windows builds on, and adds to.

    ``points``: what is known at each operating point; ``residuals`` of the newest good windows, and
    how many windows have been ``refused_for_residual`` in a row since; ``level`` of the running
    set's force against that first known, 1 = as at first.
    """

    points: KnownPoints = field(default_factory=KnownPoints)
    residuals: tuple[Residual, ...] = ()
    refused_for_residual: int = 0
    level: float = 1.0


class Gatekeeper:
    """Accepts or refuses new sets, with the reason, by the ``known`` experience."""

    _PATIENCE = 4
    """After so many refusals in a row for the residual the larger residual is the usual one, ..."""
    _PATIENCE_WHERE_KNOWN = 12
    """... and after so many, where the running set holds: a sensor is repaired sooner than that."""

    def __init__(self, settings: AcceptanceSettings, known: Experience | None = None) -> None:
        self._settings = settings
        self.known = known or Experience()

    def judge(
        self,
        evidence: Evidence,
        force: KnownForce | None = None,
        *,
        holds: bool = False,
        same_motion: bool = False,
        one_point: bool = True,
        objection: Callable[[], str] = str,
    ) -> Judgement:
        """Whether the new set is accepted, and why not.

        ``force``: size and operating point of the window's force, where they are to be judged.
        ``holds``: whether the running set has been identified where the window is;
        ``same_motion``: whether it has been confirmed in several windows of this very motion;
        ``one_point``: whether the window has one current, so that its residual is that of a point;
        ``objection``: why nobody could use the set, asked where nothing else is against it.
        """
        point = force.operating_point if force is not None and one_point else None
        judgement = self._judge(evidence, force, point, holds, same_motion)
        if judgement.verdict.accepted and (sentence := objection()):
            judgement = Judgement(Verdict.POOR_FIT, sentence)
        if judgement.teaches:
            seen = (evidence.rmse_after, evidence.nrmse_after, *(point or ()))
            self.known.residuals = (*self.known.residuals, seen)[-MOST_WINDOWS:]
            if force is not None:
                self._learn(force)
        return judgement

    def _learn(self, force: KnownForce) -> None:
        """Take in a force that was accepted; the first of its operating point is kept."""
        known, point = self.known, force.operating_point
        here = known.points.known_force(point)
        if here is not None:
            known.level = force.size / here.size
        elif min(force.size, force.peak_velocity, force.largest) > 0.0:
            known.points = known.points.noted(point, force=force)

    def judge_global(
        self, evidence: Evidence, objection: Callable[[], str] = str, *, tentative: bool = False
    ) -> Judgement:
        """Whether a set for the windows of the past is accepted: it leaves no trace.

        ``objection`` as in :meth:`judge`. ``tentative``: where the running set is still good, the
        next window must confirm the other one.
        """
        maximum = self._settings.maximum_nrmse
        if not evidence.nrmse_after <= maximum:
            return Judgement(
                Verdict.POOR_FIT,
                "one set for all operating points leaves an NRMSE of "
                f"{evidence.nrmse_after:.0%}, more than maximum_nrmse ({maximum:.0%})",
            )
        worth_while = evidence.nrmse_after < WORTH_WHILE * evidence.nrmse_before
        if not (worth_while and evidence.lead > BEYOND_CHANCE):
            return Judgement(Verdict.NO_BETTER, "the running set predicts the reservoir as well")
        before, after = evidence.recent
        if after > before + HARDLY:
            return Judgement(
                Verdict.NO_BETTER,
                f"one set for all operating points leaves a recent NRMSE of {after:.0%}, the "
                f"running set {before:.0%}",
            )
        if sentence := objection():
            return Judgement(Verdict.POOR_FIT, sentence)
        if tentative and before <= STILL_GOOD:
            return Judgement(
                Verdict.UNCONFIRMED,
                "the set for all operating points must be confirmed by the next window",
            )
        return ACCEPTED

    def may_be_early(self, evidence: Evidence) -> bool:
        """Whether a fit to a few samples after a change may replace the running set.

        It must leave no more than the usual residual, predict better, and need no confirmation.
        What it says leaves no trace: the next window judges again.
        """
        limit, level = self._settings.change_limit, self.known.level * (1.0 + evidence.force_change)
        return bool(
            self.known.residuals
            and self.is_usual(evidence.rmse_after, evidence.nrmse_after)
            and evidence.better
            and abs(evidence.force_change) <= self._settings.step_limit
            and (not self.known.points.knows_forces or 1.0 / limit <= level <= limit)
        )

    def follow_change(self, evidence: Evidence) -> None:
        """An early fit has changed the force of the running set."""
        self.known.level *= 1.0 + evidence.force_change

    def is_usual(self, rmse: float, nrmse: float) -> bool:
        """Whether a residual, RMSE [N] and NRMSE, is that of samples to identify from."""
        if not nrmse <= self._settings.maximum_nrmse:
            return False
        excess = excess_residual(self.known.residuals, rmse, nrmse)
        return excess <= self._settings.residual_factor

    def _judge(
        self,
        evidence: Evidence,
        force: KnownForce | None,
        point: OperatingPoint | None,
        holds: bool,
        same_motion: bool,
    ) -> Judgement:
        settings, experience = self._settings, self.known
        if not math.isfinite(evidence.nrmse_after):
            return Judgement(Verdict.POOR_FIT, "the fit has no finite error: the window is refused")
        if evidence.nrmse_after > settings.maximum_nrmse:
            return Judgement(
                Verdict.POOR_FIT,
                f"the fit leaves an NRMSE of {evidence.nrmse_after:.0%}, more than maximum_nrmse "
                f"({settings.maximum_nrmse:.0%})",
            )
        beyond = self._beyond(evidence, force, holds) if force is not None else ""
        if same_motion and evidence.shape_change > _OTHER_SHAPE:
            beyond = (
                f"the shape of the force changed by {evidence.shape_change:.0%} in the same motion"
            )
        if beyond:
            return Judgement(
                Verdict.BEYOND_LIMITS,
                f"{beyond}: check the sensors and their clocks; if the damper was replaced, call "
                "reset",
            )
        known = bool(experience.residuals)
        if known:
            excess = excess_residual(
                experience.residuals, evidence.rmse_after, evidence.nrmse_after, point
            )
            if excess > settings.residual_factor:
                experience.refused_for_residual += 1
                # A known force with another residual: the sensor, not the damper.
                doubtful = (
                    holds
                    and abs(evidence.force_change) > _SAME_FORCE
                    and evidence.nrmse_before < _FAR_BETTER * evidence.nrmse_after
                )
                patience = self._PATIENCE_WHERE_KNOWN if holds else self._PATIENCE
                if experience.refused_for_residual <= patience or doubtful:
                    return _disturbed(excess, evidence.nrmse_before)
                # It has lasted: the rig itself has become noisier.
                experience.residuals = ()
        experience.refused_for_residual = 0
        # Where the running set was never identified, a set that was serves better.
        if not (evidence.better if holds else evidence.nrmse_after < evidence.nrmse_before):
            return Judgement(
                Verdict.NO_BETTER, "the running set predicts the validation samples as well"
            )
        if evidence.loses_elsewhere:
            return Judgement(
                Verdict.NO_BETTER,
                "the new set loses more at the other recent operating points than it gains here",
            )
        change = evidence.force_change
        if force is not None and not holds:
            # The running set does not tell what the force was here; that accepted before does.
            here = experience.points.known_force(force.operating_point)
            if here is not None:
                change = min(change, force.size / (here.size * experience.level) - 1.0, key=abs)
        surprise = ""
        if abs(change) > settings.step_limit:
            surprise = f"the force changed by {change:+.0%} at once"
        elif holds and evidence.shape_change > _SURPRISING:
            surprise = f"the shape of the force changed by {evidence.shape_change:.0%} at once"
        if known and surprise:
            return Judgement(
                Verdict.UNCONFIRMED, f"{surprise}: waiting for the next window to confirm it"
            )
        return ACCEPTED

    def _beyond(self, evidence: Evidence, force: KnownForce, holds: bool) -> str:
        """Why the force is beyond all that this damper can give, in words; empty where it is not.

        Where the running set holds, it tells what the force was at first at a new operating point.
        """
        limit = self._settings.change_limit
        expected = self.known.level * (1.0 + evidence.force_change) if holds else math.nan
        objection = self.known.points.objection(force, limit, expected)
        return f"{objection}, more than change_limit ({limit:g}) allows" if objection else ""
