"""The licence to act: which set the controller inverts, and which currents it may command.

Agreement with the measured force at the present current says nothing about the current that is to
be commanded. The licence is therefore apart from the validity of the present force, and asks the
candidate sets (:mod:`mr_damper_ros.tracking.candidate_sets`):

1. The permitted currents of a set are its current range, without the currents at which the
   measured force refutes it and without those behind them, as seen from the safe current.
2. The set with the widest permitted range is inverted. A range shrinks by evidence only.
3. Control needs usable inputs, a present current in the range of this set, and no evidence that
   its force is wrong now.
4. The safe current is always permitted. If only the force at the safe current prevents control, the
   return cannot wait for a right force there: see :class:`Approach`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mr_damper_ros.models.quantities import CURRENT_READING
from mr_damper_ros.tracking.candidate_sets import CandidateSet
from mr_damper_ros.tracking.validity import NO_DOUBT, Doubt, DoubtKind, current_allowance

REMEDY = (
    "by a manual run (parameter current of the bridge or the supply) or by a campaign, or set "
    "probe_step"
)
"""How to extend the identified range of currents."""

ABOUT_THE_FORCE = (
    *(DoubtKind.OUT_OF_RANGE, DoubtKind.TOO_LARGE, DoubtKind.DRIVING, DoubtKind.WRONG),
    DoubtKind.REFUSED,
)
"""Reasons that concern the set in use. All others concern the inputs, and forbid control."""

PROBED_PART = 0.25
"""Part of the permitted range, from the safe current on, in which errors are tolerated that are
small relative to the force at its end."""

_BETTER_RATIO = 0.8
"""Of two sets with equal ranges, the other one is inverted if its error is below this multiple."""


@dataclass(frozen=True)
class Limits:
    """The currents [A] that the user permits, and the safe current among them."""

    lowest: float
    highest: float
    safe: float


@dataclass(frozen=True, eq=False)
class Permit:
    """A set to invert, and the lowest and the highest current [A] that may be commanded with it.

    From the ``safe`` current to ``near`` [A], errors that are small relative to the force at
    ``near`` are tolerated, and do not limit the range.
    """

    candidate: CandidateSet
    low: float
    high: float
    safe: float
    near: float

    @property
    def tolerated(self) -> float:
        """Largest tolerated error [N]."""
        return self.candidate.tolerated_at(self.near) if self.width > 0.0 else 0.0

    @property
    def width(self) -> float:
        """Width of the permitted range [A]; not positive if there is none."""
        return self.high - self.low

    @property
    def nearest(self) -> float:
        """The permitted current that is nearest to the safe one [A]."""
        return min(max(self.safe, self.low), self.high)

    @property
    def may_be_probed(self) -> bool:
        """Whether all currents from the safe one to ``near`` are permitted."""
        return self.low <= min(self.safe, self.near) and max(self.safe, self.near) <= self.high

    def tolerates(self, current: float) -> bool:
        """Whether the error of the set at a current [A] is known and tolerated."""
        error = self.candidate.evidence.error_at(current)
        return error <= self.tolerated and self._distance(current) <= self._distance(self.near)

    def is_right_behind(self, current: float) -> bool:
        """Whether the set is known to be right at a current farther from the safe one [A]."""
        return any(
            not cell.refuted
            and min(self._distance(cell.low), self._distance(cell.high)) > self._distance(current)
            for cell in self.candidate.evidence.cells
        )

    def _distance(self, current: float) -> float:
        return abs(current - self.safe)


def permit_of(candidate: CandidateSet, limits: Limits, beyond: float = 0.0) -> Permit:
    """The permit that a set gives; ``beyond`` [A] extends its range under a watched trial."""
    lowest, highest = candidate.parameters.current_range
    low, high = max(limits.lowest, lowest), min(limits.highest, highest + beyond)
    safe, rises = limits.safe, high - limits.safe >= limits.safe - low
    near = safe + (PROBED_PART if rises else -PROBED_PART) * (high - low)
    permitted = low < high
    for cell in candidate.evidence.cells:
        if not cell.refuted:
            continue
        is_near = max(abs(cell.low - safe), abs(cell.high - safe)) <= abs(near - safe)
        if is_near and permitted and cell.error <= candidate.tolerated_at(near):
            continue
        if cell.low > safe:
            high = min(high, cell.low)
        elif cell.high < safe:
            low = max(low, cell.high)
    return Permit(candidate, low, high, safe, near)


class Licence:
    """Chooses the set to invert among the candidates, and says whether control is permitted.

    ``margin`` is that of the current, as in :class:`ValiditySettings`.
    """

    def __init__(self, limits: Limits, margin: float) -> None:
        self._limits = limits
        self._margin = margin
        self.permit: Permit | None = None
        """The present permit; None before the first set."""

    def choose(self, candidates: list[CandidateSet], beyond: float = 0.0) -> None:
        """Choose among the candidates; the set in use is the last one.

        Of equal sets without evidence, as without a load cell, the set in use is chosen.
        """
        permits = [permit_of(each, self._limits, beyond) for each in candidates]
        if not permits:
            self.permit = None
            return
        # A set that does not hold at the safe current is the last resort.
        safe = self._limits.safe
        permits = [p for p in permits if p.width > 0.0 and self._includes(p, safe)] or permits
        widest = max(each.width for each in permits)
        equal = [each for each in permits if each.width >= widest - CURRENT_READING]
        chosen = equal[-1]
        if self.permit is not None and _error(self.permit) < math.inf:
            before = self.permit.candidate
            chosen = next((each for each in equal if each.candidate is before), chosen)
        best = min(equal, key=_error)
        if _error(best) < _BETTER_RATIO * _error(chosen):
            chosen = best
        self.permit = chosen

    @property
    def refusal(self) -> Doubt:
        """Why no current may be commanded at all; no doubt if some may be."""
        permit, limits = self.permit, self._limits
        if permit is None or permit.width > 0.0:
            return NO_DOUBT
        lowest, highest = permit.candidate.parameters.current_range
        if max(limits.lowest, lowest) < min(limits.highest, highest):
            return Doubt(
                DoubtKind.WRONG,
                f"the measured force refutes set {permit.candidate.parameters.set_id} at all "
                "permitted currents: identify the damper again",
            )
        return Doubt(
            DoubtKind.OUT_OF_RANGE,
            f"the parameters hold for {lowest:.2f} to {highest:.2f} A, which leaves no range of "
            f"currents between lowest_current ({limits.lowest:g} A) and highest_current "
            f"({limits.highest:g} A): identify the damper at several currents, {REMEDY}",
        )

    def judge(self, doubt: Doubt, current: float, *, in_use: bool, in_control: bool) -> Doubt:
        """Why control is not permitted now, at a ``current`` [A] of the supply.

        ``doubt`` is that of the newest sample with the set in use; ``in_use`` says whether the set
        in use is the one that is inverted, and ``in_control`` whether control was permitted before.
        """
        if doubt and doubt.kind not in ABOUT_THE_FORCE:
            return doubt
        permit = self.permit
        if permit is None:
            return doubt
        if refusal := self.refusal:
            return refusal
        if not self._includes(permit, current):
            low, high = permit.candidate.parameters.current_range
            return Doubt(
                DoubtKind.OUT_OF_RANGE,
                f"the supply current lies outside the {low:.2f} to {high:.2f} A for which the "
                "parameters hold: set safe_current within this range, identify the damper from "
                "the safe current on, or let control cross the unknown currents (crossing_rate)",
            )
        candidate = permit.candidate
        if not in_use and not math.isnan(current):
            if candidate.wrong:
                doubt = Doubt(DoubtKind.WRONG, candidate.sentence)
            elif candidate.holds:
                doubt = NO_DOUBT
        if not in_control or doubt.kind is not DoubtKind.WRONG:
            return doubt
        usual = permit.tolerates(current) and permit.is_right_behind(current)
        return NO_DOUBT if usual else doubt

    def _includes(self, permit: Permit, current: float) -> bool:
        """Whether a current [A] is in the range of the set or of the permit, with their margin."""
        low, high = permit.candidate.parameters.current_range
        allowed = current_allowance((low, high), self._margin)
        return not (current < low - allowed or current > max(high, permit.high) + allowed)


def _error(permit: Permit) -> float:
    error = permit.candidate.evidence.error
    return math.inf if math.isnan(error) else error


_PROBE_TIME = 2.5
"""Time [s] of a whole probe."""

_WATCHED = 1.0
"""Time [s] of wrong force at the safe current until a probe begins."""

_FAULT_TIME = 1.5
"""Time [s] of wrong force at the safe current that counts as a fault at all currents."""

_PAUSES = (15.0, 60.0)
"""Time [s] until the next approach after the first one that found no right force; it doubles up to
the second time."""


class Approach:
    """Moves the current away from the safe current to find out whether control may return.

    There are two reasons. The set does not hold at the safe current: with ``crossing_rate`` [A/s],
    the current crosses to the set; without it, control does not start. Or the force is wrong at the
    safe current by less than what control tolerates at the end of a probe: the current rises slowly
    until the force is right, by at most a quarter of the permitted range, watched by the load cell.
    Any other doubt ends the approach. After a failure the next one has to wait.
    """

    def __init__(self, crossing_rate: float) -> None:
        self._rate = crossing_rate
        self._pause, self._next_pause = 0.0, _PAUSES[0]
        self.end()
        self.fault_ended = False
        """Whether the force at the safe current has just become right after it was wrong."""

    def end(self) -> None:
        """Return to the safe current."""
        self._watched = 0.0
        self.target = math.nan
        """End of the approach [A]; NaN without one."""

    def succeed(self) -> None:
        """Note that control has returned."""
        self.end()
        self._pause, self._next_pause = 0.0, _PAUSES[0]

    @property
    def under_way(self) -> bool:
        """Whether the current approaches the permitted range."""
        return not math.isnan(self.target)

    def follow(self, doubt: Doubt, permit: Permit | None, current: float, duration: float) -> float:
        """Distance [A] by which the current may move in ``duration`` [s]; 0 without an approach.

        ``current`` [A] is the present command, ``doubt`` why control is not permitted.
        """
        self._pause = max(self._pause - duration, 0.0)
        if permit is None or permit.width <= 0.0 or (doubt and doubt.kind not in _APPROACHED):
            self.end()
            return 0.0
        self.fault_ended = not (doubt or self.under_way) and self._watched >= _FAULT_TIME
        if not doubt:
            self._watched = 0.0 if self.fault_ended else self._watched
            return 0.0
        crosses = doubt.kind is DoubtKind.OUT_OF_RANGE
        if not self.under_way:
            self._watched += duration
            if self._pause > 0.0 or not (crosses or self._watched >= _WATCHED):
                return 0.0
            if crosses:
                self.target = permit.nearest if self._rate else math.nan
            elif permit.may_be_probed and permit.tolerates(permit.safe):
                self.target = permit.near
            if not self.under_way:
                return 0.0
        error = permit.candidate.evidence.error_at(current)
        refuted = not crosses and (error > permit.tolerated or not permit.may_be_probed)
        rate = self._rate if crosses else PROBED_PART * permit.width / _PROBE_TIME
        left = abs(self.target - current)
        if left <= 1e-9 or refuted:
            # The force is still wrong at the end, or its error has grown on the way.
            self.end()
            self._pause = self._next_pause
            self._next_pause = min(2.0 * self._next_pause, _PAUSES[1])
            return 0.0
        return min(rate * duration, left)


_APPROACHED = (DoubtKind.OUT_OF_RANGE, DoubtKind.WRONG)
