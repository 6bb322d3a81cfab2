"""The acceptance test: whether a new parameter set may replace the running one.

Both sets predict the validation samples, which the fit did not use (:class:`Evidence`). The
:class:`Gatekeeper` decides by these predictions and by the history of the damper.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from mr_damper_ros.estimation.covariance import NoiseModel
from mr_damper_ros.estimation.global_fit import error_of_set
from mr_damper_ros.estimation.window_fit import WORSE_RATIO, fit_window
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import GOOD_NRMSE, NOTICED, SAME_CURRENT
from mr_damper_ros.settings.option_table import CheckedSettings, option
from mr_damper_ros.signals.arrays import Array, Positive, span_of
from mr_damper_ros.tracking.operating_point import (
    MOST_SAMPLES,
    MOST_WINDOWS,
    KnownForce,
    KnownPoints,
    OperatingPoint,
    Residual,
    excess_residual,
)

CHUNKS = 40
_VALIDATION_EVERY = 4
"""A window is divided into 40 chunks, and every fourth chunk is validation data. A chunk has at
least one sample, so fewer than 40 new samples cannot replace the running set."""

SIGNIFICANT_LEAD = 2.5
"""Smallest lead, in standard errors, with which a new set replaces the running set.

If both sets are equally good, the lead exceeds this value in one window of 160. For a new fit this
is rarer still, because its noise increases its error on the validation samples.
"""


LARGEST_EXCESS = 0.03
"""Largest excess over the running set's NRMSE for a set that covers more operating points."""

_LARGEST_LOSS = 0.5
"""Largest increase of a window set's mean square error at the other operating points, relative to
its decrease in the window. A window set is fitted to that window alone (benchmark figure
``foreign_worse_sets``)."""

_WORTHWHILE = 1.0 - NOTICED
"""A good set is replaced only by a set with an NRMSE below this multiple of its NRMSE. A set that
is equally good at the tested operating points may be worse at others."""


@dataclass(frozen=True)
class Evidence:
    """Errors of the running and the new set on the validation samples of a window.

    The NRMSE is the RMSE over the standard deviation of the force; ``rmse_after`` is in N. The new
    set changes the force by the fraction ``force_change``; the part ``shape_change`` [1] of its
    force is not proportional to the running set's. ``lead`` is that of :func:`lead_of`. ``loss``
    [1] is the increase of the mean square error, summed over the other recent operating points,
    divided by its decrease in this window; 0 if the running set is not good there. For a search,
    ``recent`` is the NRMSE of both sets at the recent operating points, and ``newest`` that of the
    running set in the newest window.
    """

    nrmse_before: float
    nrmse_after: float
    rmse_after: float = math.nan
    force_change: float = math.nan
    lead: float = math.inf
    shape_change: float = 0.0
    loss: float = 0.0
    recent: tuple[float, float] = (math.inf, 0.0)
    newest: float = math.inf

    @property
    def better(self) -> bool:
        """Whether the new set predicts significantly better than the running set."""
        return self.nrmse_after < self.nrmse_before and self.lead > SIGNIFICANT_LEAD

    @property
    def loses_elsewhere(self) -> bool:
        """Whether the new set is much worse at other points where the running set is good."""
        return self.loss > _LARGEST_LOSS


Comparison = tuple[Array, Array, Array, np.ndarray]
"""An old, a new and the measured force (n,) [N] of a window, and the mask (n,) of the samples to
which neither force was fitted."""


def lead_of(windows: Iterable[Comparison]) -> float:
    """Lead of the new force over the old one on all samples of several windows [standard errors].

    The gain is half the decrease of the sum of squared errors, in units of the noise variance. Its
    standard deviation if both forces are equally good includes the autocorrelation of the noise,
    which is estimated from the residual of the new force.
    """
    gain, chance = 0.0, 0.0
    for old, new, measured, judges in windows:
        noise = NoiseModel.of(new - measured)
        apart = np.where(judges, new - old, 0.0)
        level = max(noise.variance, 1e-300)
        variance = float(noise.score_covariance(apart[:, np.newaxis])[0, 0])
        gain += float(apart @ (measured - 0.5 * (old + new))) / level
        chance = math.hypot(chance, math.sqrt(max(variance, 0.0)) / level)
    if chance > 0.0:
        return gain / chance
    return math.copysign(math.inf, gain) if gain else 0.0


def validation_mask(count: int, fresh: int | None = None) -> np.ndarray:
    """Mask (n,) of the validation samples: chunks spread over the ``fresh`` samples.

    ``fresh`` is the number of samples at the end that the running set was not fitted to. If there
    are fewer than :data:`CHUNKS`, as with a hop of a few samples, the chunks are spread over all
    samples; :func:`evidence_of` then finds no lead.
    """
    judged = count if fresh is None or not CHUNKS <= fresh < count else fresh
    chunk = np.arange(judged) * CHUNKS // max(judged, 1)
    validation = np.zeros(count, dtype=bool)
    validation[count - judged :] = chunk % _VALIDATION_EVERY == _VALIDATION_EVERY - 1
    return validation


def evidence_of(
    running: ParameterSet,
    found: ParameterSet,
    window: Window,
    validation: np.ndarray,
    *,
    fresh: int,
    elsewhere: Sequence[Window] = (),
) -> Evidence:
    """Compare the set ``found`` with the running set on the validation samples of a window.

    ``validation`` is the mask (n,) of the validation samples; ``found`` was fitted to the others.
    If the running set was identified on this damper, the lead counts only samples that neither set
    was fitted to; ``fresh`` is their number. ``elsewhere`` holds windows at other recent operating
    points.
    """
    gradual = found.turns_gradually(window)
    settled = found.settled(window, gradual=gradual)
    spread = float(np.std(window.force))
    old, new = (each.window_force(window, gradual=gradual) for each in (running, found))
    known = bool(running.observable.any() and np.isfinite(old).all())
    if not np.isfinite(old).all():
        # The running set cannot predict this window, so any finite force is better.
        old = np.full(old.size, math.inf)
    judged = validation & settled
    before, after = (
        float(np.sqrt(np.mean((force - window.force)[judged] ** 2))) for force in (old, new)
    )
    # Products of the forces: old and old, old and new, new and new.
    power, common, own = (
        float(one[settled] @ other[settled]) for one, other in ((old, old), (new, old), (new, new))
    )
    change, shape = math.inf, 1.0
    if 0.0 < power < math.inf:
        change = common / power - 1.0
        shape = math.sqrt(max(1.0 - common**2 / (power * max(own, 1e-300)), 0.0))
    evidence = Evidence(before / spread, after / spread, after, change, shape_change=shape)
    if not known:
        return evidence
    one = old[settled], new[settled], window.force[settled], judged[settled]
    evidence = replace(evidence, lead=lead_of([one] if fresh >= CHUNKS else []))
    if not elsewhere or before <= after:
        return evidence
    currents = [span_of(each.current) for each in (window, *elsewhere)]
    if before > GOOD_NRMSE * spread and np.ptp(currents) <= SAME_CURRENT:
        # The running set is wrong in this motion. The model bank uses it again in the other
        # motions.
        return evidence
    left, lost = (_mean_square(each, elsewhere) for each in (running, found))
    means = [float(np.mean(each.force)) for each in elsewhere]
    squares = [float(np.mean(each.force**2)) for each in elsewhere]
    variance = float(np.mean(squares) - np.mean(means) ** 2)
    if left > GOOD_NRMSE**2 * variance:
        return evidence
    return replace(evidence, loss=len(elsewhere) * (lost - left) / (before**2 - after**2))


def evidence_of_search(
    running: ParameterSet,
    found: ParameterSet,
    windows: Sequence[tuple[Window, np.ndarray]],
    recent: int,
) -> Evidence:
    """Compare a set for all operating points with the running set.

    Each window comes with the mask (n,) of its validation samples. The last ``recent`` windows are
    at the recent operating points.
    """
    # A window of very few samples has no validation samples.
    judged = [window.part(judges) for window, judges in windows if judges.any()]
    before, after = (error_of_set(each, judged).nrmse for each in (running, found))
    last = judged[-max(recent, 1) :]
    compared = []
    for window, judges in windows:
        settled = found.settled(window)
        forces = running.window_force(window), found.window_force(window), window.force
        old, new, measured = (force[settled] for force in forces)
        compared.append((old, new, measured, judges[settled]))
    finite = all(np.isfinite(old).all() for old, *_ in compared)
    return Evidence(
        before,
        after,
        lead=lead_of(compared) if finite else math.inf,
        recent=(error_of_set(running, last).nrmse, error_of_set(found, last).nrmse),
        newest=error_of_set(running, judged[-1:]).nrmse,
    )


def rival_wins(
    rival: ParameterSet,
    running: ParameterSet,
    window: Window,
    *,
    fresh: int,
    maximum_nrmse: float,
    elsewhere: Sequence[Window] = (),
) -> bool:
    """Whether a rival set predicts the last ``fresh`` samples of a window better.

    Neither set was fitted to these samples. The NRMSE of a rival with a wider current range may be
    higher by :data:`LARGEST_EXCESS`. An NRMSE above ``maximum_nrmse`` never confirms the rival.
    ``elsewhere`` is as in :func:`evidence_of`.
    """
    judges = np.arange(window.sample_count) >= window.sample_count - fresh
    found = evidence_of(running, rival, window, judges, fresh=fresh, elsewhere=elsewhere)
    lows, highs = zip(rival.current_range, running.current_range, strict=True)
    if highs[0] - lows[0] > highs[1] - lows[1]:
        allowed = found.nrmse_before + LARGEST_EXCESS
    else:
        allowed = _WORTHWHILE * found.nrmse_before
    return found.nrmse_after <= min(allowed, maximum_nrmse) and not found.loses_elsewhere


def judge_parts(window: Window, parts: Sequence[Window], found: ParameterSet) -> tuple[float, bool]:
    """RMSE [N] of separate fits to the parts of a window, and whether one set explains them all."""
    few = [found.held(part.thinned(MOST_SAMPLES // 2)) for part in parts]
    counts = [part.sample_count for part in parts]
    own = [fit_window(found.law, part, found.values, method="least_squares").rmse for part in few]
    by_found = [error_of_set(found, [part]).rmse for part in few]
    alone, together = (
        math.sqrt(float(np.average(np.square(errors), weights=counts)))
        for errors in (own, by_found)
    )
    besides = LARGEST_EXCESS * float(np.std(window.force))
    return alone, together <= max(WORSE_RATIO * alone, math.hypot(alone, besides))


def _mean_square(found: ParameterSet, windows: Sequence[Window]) -> float:
    """Mean square error [N²] of a set over several windows of equal weight.

    One common least-squares factor scales the force of all windows, because the force scale of the
    damper may have changed since. An error that overflows is infinite.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        known = [found.settled(window) for window in windows]
        pairs = [
            (found.window_force(window)[settled], window.force[settled])
            for window, settled in zip(windows, known, strict=True)
        ]
        power = sum(float(np.mean(force * force)) for force, _ in pairs)
        shared = sum(float(np.mean(force * measured)) for force, measured in pairs)
        factor = shared / power if power > 0.0 else 1.0
        errors = [float(np.mean((factor * force - measured) ** 2)) for force, measured in pairs]
    error = sum(errors) / len(errors)
    return error if math.isfinite(error) else math.inf


LARGE_SHAPE_CHANGE = 0.2
"""A larger shape change [1] must be confirmed by the next window if the running set has been
identified at this operating point (benchmark figure ``foreign_worse_sets``). Between windows of one
steady motion, temperature and wear change the shape less than a delay between the sensors does."""


class Verdict(IntEnum):
    """Result of the acceptance test; the numbers are constants of the message FitReport."""

    UNKNOWN = 0
    """A received report has a number that is not one of these, such as that of a newer version."""
    ACCEPTED = 1
    """The new set predicts better and is now in use."""
    ACCEPTED_EARLY = 2
    """The force changed suddenly; an early fit to a few samples updated the running set."""
    NO_BETTER = 3
    """The new set does not predict better; the running set stays in use."""
    FAULT_OF_DATA = 4
    """The samples cannot be used, so nothing was fitted."""
    POOR_FIT = 5
    """The fit leaves too large an error."""
    DISTURBED = 6
    """The residual is far above the residual baseline."""
    UNCONFIRMED = 7
    """The next window must confirm a large sudden change, or a set of a global identification."""
    FAILED = 8
    """The computation failed for a reason other than the data."""
    TOO_LITTLE_MOTION = 9
    """The window contains too little motion, so nothing was fitted."""
    BEYOND_LIMITS = 10
    """The force differs from the known forces by more than a damper can change."""
    INSTRUMENT = 11
    """The load cell changed, not the damper: a factor or an offset arrived within one sample."""

    @property
    def accepted(self) -> bool:
        """Whether a new set is in use."""
        return self in (Verdict.ACCEPTED, Verdict.ACCEPTED_EARLY)

    @property
    def confirms(self) -> bool:
        """Whether the samples of the window agree with the set that is in use after the test."""
        return self.accepted or self is Verdict.NO_BETTER


@dataclass(frozen=True)
class Judgement:
    """A verdict and its reason in one sentence; the sentence is empty if none is needed.

    ``usual`` says whether the residual agrees with the residual baseline, so that the identifier
    may learn from the window.
    """

    verdict: Verdict
    sentence: str = ""
    usual: bool = True

    @property
    def teaches(self) -> bool:
        """Whether the window may update the records with which later windows are compared."""
        return self.usual and self.verdict.confirms


ACCEPTED = Judgement(Verdict.ACCEPTED)


@dataclass(frozen=True)
class AcceptanceSettings(CheckedSettings):
    """Limits of the acceptance test."""

    maximum_nrmse: float = option(
        0.5,
        "Largest error on the validation samples, RMSE / standard deviation of the force; a "
        "fit with a larger error is rejected.",
        within=(0.0, 10.0),
    )
    residual_factor: float = option(
        3.0,
        "A residual of this many times the residual baseline counts as a disturbance or "
        "sensor fault, unless it lasts for several windows.",
        within=(1.0, 1e6),
    )
    change_limit: float = option(
        3.0,
        "Largest factor, up or down, by which temperature and wear change the force. Forces "
        "that differ more from the first accepted one are always rejected (verdict "
        "BEYOND_LIMITS): check the sensors, and call the service reset if the damper was "
        "replaced.",
        within=(1.0, 1e6),
    )
    step_limit: float = option(
        0.5,
        "A larger relative change of the force must be confirmed by the next window.",
        within=(0.0, 1e6),
    )
    accept_force_steps: bool = option(
        False,
        "Whether a factor or an offset of the measured force that arrives within one sample counts "
        "as a change of the damper. false: it is one of the load cell (verdict INSTRUMENT); the "
        "sets stay as they are, and the force is invalid, until the load cell shows the force of "
        "the set again, or the service acknowledge is called.",
    )


@dataclass(eq=False)
class Experience:
    """Records of earlier windows, which the acceptance test uses and updates.

    ``points`` holds a record for each operating point. ``residuals`` are the residuals of the
    newest good windows. ``refused_for_residual`` counts the windows that were rejected in a row for
    their residual. ``level`` is the running set's force relative to the first accepted force.
    """

    points: KnownPoints = field(default_factory=KnownPoints)
    residuals: tuple[Residual, ...] = ()
    refused_for_residual: int = 0
    level: Positive = 1.0


@dataclass(eq=False)
class Gatekeeper:
    """The acceptance test: accepts or rejects new sets by the records of earlier windows."""

    settings: AcceptanceSettings
    known: Experience = field(default_factory=Experience)

    _PATIENCE = 4
    """After this many rejections in a row for the residual, the residual baseline is reset."""
    _PATIENCE_WHERE_KNOWN = 12
    """Number of these rejections that resets the baseline at an operating point where the running
    set has been identified. A faulty sensor is usually repaired within that time."""

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
        """Judge the set of a window, and update the records if the window is good.

        ``force`` is the size and the operating point of the window's force; with None they are not
        checked. ``holds`` says whether the running set has been identified at the operating point
        of the window, ``same_motion`` whether several windows in a row had this motion, and
        ``one_point`` whether the current is constant, so that the residual belongs to one operating
        point. ``objection`` returns the reason why the set is implausible, or an empty text; it is
        called only for a set that may come into use.
        """
        known = self.known
        point = force.operating_point if force is not None and one_point else None
        is_first = not known.residuals
        judgement = (
            self._refusal(evidence, force, holds=holds, same_motion=same_motion)
            or self._disturbance(evidence, point, holds=holds)
            or self._comparison(evidence, force, holds=holds, is_first=is_first)
        )
        # The next window puts an unconfirmed set into use.
        usable = judgement.verdict.accepted or judgement.verdict is Verdict.UNCONFIRMED
        if usable and (sentence := objection()):
            judgement = Judgement(Verdict.POOR_FIT, sentence)
        if judgement.teaches:
            seen = (evidence.rmse_after, evidence.nrmse_after, *(point or ()))
            known.residuals = (*known.residuals, seen)[-MOST_WINDOWS:]
        if judgement.teaches and force is not None:
            # The first force of each operating point is kept.
            here = known.points.known_force(force.operating_point)
            if here is not None:
                known.level = force.size / here.size
            elif min(force.size, force.peak_velocity, force.largest) > 0.0:
                known.points = known.points.noted(force.operating_point, force=force)
        return judgement

    def judge_global(
        self, evidence: Evidence, objection: Callable[[], str] = str, *, tentative: bool = False
    ) -> Judgement:
        """Judge the set of a global identification; the records do not change.

        ``objection`` is as in :meth:`judge`. If ``tentative`` and the running set is good at the
        recent operating points or in the newest window, the next window must confirm the new set.
        """
        maximum = self.settings.maximum_nrmse
        if not evidence.nrmse_after <= maximum:
            return Judgement(
                Verdict.POOR_FIT,
                "one set for all operating points leaves an NRMSE of "
                f"{evidence.nrmse_after:.0%}, more than maximum_nrmse ({maximum:.0%})",
            )
        worth_while = evidence.nrmse_after < _WORTHWHILE * evidence.nrmse_before
        if not (worth_while and evidence.lead > SIGNIFICANT_LEAD):
            return Judgement(Verdict.NO_BETTER, "the running set predicts the reservoir as well")
        before, after = evidence.recent
        if after > before + LARGEST_EXCESS:
            return Judgement(
                Verdict.NO_BETTER,
                f"at the recent operating points the new set leaves an NRMSE of {after:.0%}, the "
                f"running set one of {before:.0%}",
            )
        if sentence := objection():
            return Judgement(Verdict.POOR_FIT, sentence)
        if tentative and min(before, evidence.newest) <= GOOD_NRMSE:
            return Judgement(
                Verdict.UNCONFIRMED,
                "the set for all operating points must be confirmed by the next window",
            )
        return ACCEPTED

    def may_be_early(self, evidence: Evidence) -> bool:
        """Whether a fit to a few samples after a sudden change may replace the running set.

        Its residual must agree with the residual baseline, it must predict better, and its change
        of force must be within the step limit. The records do not change.
        """
        limit, level = self.settings.change_limit, self.known.level * (1.0 + evidence.force_change)
        return bool(
            self.known.residuals
            and self.is_usual(evidence.rmse_after, evidence.nrmse_after)
            and evidence.better
            and abs(evidence.force_change) <= self.settings.step_limit
            and (not self.known.points.forces or 1.0 / limit <= level <= limit)
        )

    def is_usual(self, rmse: float, nrmse: float) -> bool:
        """Whether a residual, RMSE [N] and NRMSE, agrees with the residual baseline."""
        if not nrmse <= self.settings.maximum_nrmse:
            return False
        excess = excess_residual(self.known.residuals, rmse, nrmse)
        return excess <= self.settings.residual_factor

    def _refusal(
        self, evidence: Evidence, force: KnownForce | None, *, holds: bool, same_motion: bool
    ) -> Judgement | None:
        """Reject a fit with too large an error, and a force that is impossible for this damper."""
        maximum, limit = self.settings.maximum_nrmse, self.settings.change_limit
        if not math.isfinite(evidence.nrmse_after):
            return Judgement(Verdict.POOR_FIT, "the error of the fit is not finite")
        if evidence.nrmse_after > maximum:
            return Judgement(
                Verdict.POOR_FIT,
                f"the fit leaves an NRMSE of {evidence.nrmse_after:.0%}, more than maximum_nrmse "
                f"({maximum:.0%})",
            )
        beyond = ""
        if same_motion and evidence.shape_change > LARGE_SHAPE_CHANGE:
            beyond = (
                f"the shape of the force changed by {evidence.shape_change:.0%} in the same motion"
            )
        elif force is not None:
            # Where the running set has been identified, the first accepted force follows from it.
            expected = self.known.level * (1.0 + evidence.force_change) if holds else math.nan
            objection = self.known.points.objection(force, limit, expected)
            beyond = f"{objection}, more than change_limit ({limit:g}) allows" if objection else ""
        if not beyond:
            return None
        return Judgement(
            Verdict.BEYOND_LIMITS,
            f"{beyond}: check the sensors and their clocks; if the damper was replaced, call reset",
        )

    def _disturbance(
        self, evidence: Evidence, point: OperatingPoint | None, *, holds: bool
    ) -> Judgement | None:
        """Reject a window with a residual far above the baseline, unless such residuals persist."""
        known, before, after = self.known, evidence.nrmse_before, evidence.nrmse_after
        excess = excess_residual(known.residuals, evidence.rmse_after, after, point)
        if excess <= self.settings.residual_factor:
            known.refused_for_residual = 0
            return None
        known.refused_for_residual += 1
        # The force at this operating point is known, so a sensor has changed rather than the
        # damper, unless the new set predicts much better.
        doubtful = holds and abs(evidence.force_change) > NOTICED and _WORTHWHILE * before < after
        patience = self._PATIENCE_WHERE_KNOWN if holds else self._PATIENCE
        if known.refused_for_residual > patience and not doubtful:
            # The residual has stayed large: the rig itself has become noisier.
            known.residuals, known.refused_for_residual = (), 0
            return None
        sentence = f"the residual is {excess:.1f} times the residual baseline: "
        if before <= 0.5 * GOOD_NRMSE:
            # The baseline depends on the motions and currents of earlier windows.
            sentence += f"the running set stays in use, because its NRMSE is only {before:.0%}"
            return Judgement(Verdict.NO_BETTER, sentence, usual=False)
        return Judgement(Verdict.DISTURBED, sentence + "a disturbance or a sensor fault")

    def _comparison(
        self, evidence: Evidence, force: KnownForce | None, *, holds: bool, is_first: bool
    ) -> Judgement:
        """Compare the new set with the running set; a large sudden change must be confirmed."""
        # Where the running set was not identified, a smaller error suffices to replace it.
        if not (evidence.better if holds else evidence.nrmse_after < evidence.nrmse_before):
            return Judgement(
                Verdict.NO_BETTER, "the running set predicts the validation samples as well"
            )
        if evidence.loses_elsewhere:
            return Judgement(
                Verdict.NO_BETTER,
                "the error of the new set is smaller in this window, but much larger at the other "
                "recent operating points",
            )
        change, surprise = evidence.force_change, ""
        if force is not None and not holds:
            # The earlier force at this point follows from the first accepted force, not from the
            # running set.
            here = self.known.points.known_force(force.operating_point)
            if here is not None:
                change = min(change, force.size / (here.size * self.known.level) - 1.0, key=abs)
        if abs(change) > self.settings.step_limit:
            surprise = f"the force changed by {change:+.0%} at once"
        elif holds and evidence.shape_change > LARGE_SHAPE_CHANGE:
            surprise = f"the shape of the force changed by {evidence.shape_change:.0%} at once"
        if is_first or not surprise:
            return ACCEPTED
        return Judgement(
            Verdict.UNCONFIRMED, f"{surprise}: waiting for the next window to confirm it"
        )
