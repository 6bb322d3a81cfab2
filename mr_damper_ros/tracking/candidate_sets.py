"""The sets that a controller may invert, predicted in the background, with the evidence about each.

The force of the set in use says nothing about another current: the set in use is the best one at
the present current, and often known nowhere else. The set loaded by a user and the widest set of
the identification are therefore always predicted beside it, and their errors are recorded by
current. The controller's licence (:mod:`mr_damper_ros.control.licence`) decides what may be
commanded on this evidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.kinematics.motion_follower import MotionCentre
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.quantities import CURRENT_READING, State
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.residual_monitor import ForceStatistics, LoadCellZero, ResidualMonitor
from mr_damper_ros.tracking.validity import ErrorLimit

_CELLS = 16
"""Number of cells into which the evidence divides the current range of a set."""

_USUAL_CELL = 0.1
"""Width [A] of a cell of a set without a finite current range."""

_MEMORY = 2.0
"""Time constant [s] with which a cell forgets its samples, counted in time at its current."""

_PROOF_TIMES = (0.3, 2.0)
"""Limits of the time [s] at a current until its error counts as evidence: at least a half-cycle."""

_EXPIRY = 60.0
"""Age [s] at which evidence expires, so that currents which were wrong are tried again."""

_SMALLEST_PART = 0.5
"""The error at a current is relative to at least this part of the recent peak of the force."""

_SETTLING_TIME = 0.5
"""Time [s] of known motion until the state of a law that was restarted has settled."""


_REFRESHED = 0.5
"""Time [s] after which the largest force of a set in the present motion is computed again."""


_RECOVERED = 0.9
"""A refuted current is right again below this part of the limit."""


@dataclass
class _Cell:
    """Samples of one cell: time [s], sums of squares of error and force [N² s], newest time [s]."""

    time: float = 0.0
    error: float = 0.0
    force: float = 0.0
    newest: float = -math.inf
    refuted: bool = False


class EvidenceCell(NamedTuple):
    """Evidence at the currents from ``low`` to ``high`` [A].

    ``error`` [N] is the RMS error of the set; ``refuted`` says whether it is too large.
    """

    low: float
    high: float
    error: float
    refuted: bool


class CurrentEvidence:
    """Errors of a set by current, relative to the largest recent force at any current.

    ``currents`` [A] is the current range of the set; ``limit`` is the largest error that is right.
    """

    def __init__(self, currents: tuple[float, float], limit: ErrorLimit) -> None:
        self._currents = currents
        span = currents[1] - currents[0]
        self._width = max(span / _CELLS, CURRENT_READING) if span < math.inf else _USUAL_CELL
        self._limit = limit
        self._cells: dict[int, _Cell] = {}
        # The cells with enough recent samples to count as evidence.
        self._proven: dict[int, _Cell] = {}
        self._now = 0.0
        self._peak = 0.0
        self._proof_time = _PROOF_TIMES[0]

    def add(
        self,
        current: Array,
        error: Array,
        force: Array,
        period: float,
        *,
        peak: float,
        half_cycle: float,
    ) -> None:
        """Add samples (n,): current [A], error and measured force [N], ``period`` [s] apart.

        Samples outside the current range of the set only pass time. ``peak`` [N] is the recent peak
        of the measured force, ``half_cycle`` [s] that of the motion (NaN if unknown).
        """
        self._now += current.size * period
        self._peak = peak
        shortest, longest = _PROOF_TIMES
        self._proof_time = min(max(shortest, half_cycle), longest)
        low, high = self._currents
        inside = abs(current - current.clip(low, high)) <= 0.5 * self._width
        places = np.round(current[inside] / self._width).astype(int)
        squares = np.stack([error[inside] ** 2, force[inside] ** 2])
        for place in set(places.tolist()):
            cell = self._cells.setdefault(place, _Cell())
            here = places == place
            time = float(np.count_nonzero(here)) * period
            if self._now - cell.newest > _EXPIRY:
                cell = self._cells[place] = _Cell()
            kept = math.exp(-time / _MEMORY)
            sums = squares[:, here].sum(axis=1) * period
            cell.time = kept * cell.time + time
            cell.error = kept * cell.error + float(sums[0])
            cell.force = kept * cell.force + float(sums[1])
            cell.newest = self._now
        self._judge()

    def _judge(self) -> None:
        """Judge the error at each current, relative to the largest force at any current."""
        self._proven = {
            place: cell
            for place, cell in self._cells.items()
            if cell.time >= self._proof_time and self._now - cell.newest <= _EXPIRY
        }
        cells = self._proven.values()
        force = max((cell.force / cell.time for cell in cells), default=0.0)
        allowed = self._limit.at(max(math.sqrt(force), _SMALLEST_PART * self._peak))
        for cell in cells:
            limit = allowed * (_RECOVERED if cell.refuted else 1.0)
            cell.refuted = cell.error / cell.time > limit**2

    def forget(self) -> None:
        """Discard the evidence."""
        self._cells, self._proven = {}, {}

    def error_at(self, current: float) -> float:
        """RMS error [N] at a current [A]; NaN without evidence."""
        cell = self._proven.get(round(current / self._width))
        return math.nan if cell is None else math.sqrt(cell.error / cell.time)

    @property
    def error(self) -> float:
        """RMS error over RMS force [1] at all currents of the evidence; NaN without evidence."""
        cells = self._proven.values()
        force = sum(cell.force for cell in cells)
        return math.sqrt(sum(cell.error for cell in cells) / force) if force > 0.0 else math.nan

    @property
    def cells(self) -> list[EvidenceCell]:
        """The currents with evidence, in ascending order."""
        return [
            EvidenceCell(
                (place - 0.5) * self._width,
                (place + 0.5) * self._width,
                math.sqrt(cell.error / cell.time),
                cell.refuted,
            )
            for place, cell in sorted(self._proven.items())
        ]


class CandidateSet:
    """A set that is predicted in the background.

    ``evidence`` holds its errors by current. ``holds`` and ``wrong`` say whether its force agrees
    with the measured force now, as for the set in use; both are False while this is unknown.
    """

    def __init__(self, parameters: ParameterSet, limit: ErrorLimit) -> None:
        self.parameters = parameters
        self.state: State | None = None
        """State of the law after the last sample; None before the first."""
        self.evidence = CurrentEvidence(parameters.current_range, limit)
        self._limit = limit
        self._known = self._now = 0.0
        # A current [A], and when [s] the error [N] that is tolerated there was computed.
        self._tolerated: tuple[float, float, float] | None = None
        self._gradual = False
        self._zero = LoadCellZero()
        self._monitor: ResidualMonitor | None = None
        # Peak velocity [m/s] and half-cycle [s] of the motion.
        self._motion = math.nan, math.nan
        self.holds = self.wrong = False
        self.sentence = ""
        """Why the force is wrong, in words."""

    def tolerated_at(self, current: float) -> float:
        """Largest error [N] that is right in the present motion at a current [A]."""
        speed, half_cycle = self._motion
        if not (speed > 0.0 and half_cycle > 0.0):
            return 0.0
        before = self._tolerated
        if before is None or before[0] != current or self._now - before[1] > _REFRESHED:
            largest = self.parameters.largest_in_sine(speed, half_cycle, current)
            self._tolerated = before = current, self._now, self._limit.at(largest)
        return before[2]

    def restart(self) -> None:
        """Restart after samples whose motion does not determine the force."""
        self.state, self._known = None, 0.0
        self._monitor = None
        self._zero.restart()
        self.holds = self.wrong = False

    def follow(
        self, motion: Motion, current: Array, period: float, half_cycle: float, *, gradual: bool
    ) -> Array:
        """Force (n,) [N] at the next samples, with the zero of the load cell."""
        if gradual is not self._gradual:
            self.state, self._gradual = None, gradual
        force, self.state = self.parameters.follow(
            motion, current, period, self.state, gradual=gradual
        )
        self._known += current.size * period
        self._now += current.size * period
        self._motion = float(motion.peak_velocity[-1]), half_cycle
        return np.asarray(force + self._zero.follow(force.size, period, counts=True))

    def compare(
        self,
        force: Array,
        measured: Array,
        current: Array,
        recent: ForceStatistics,
        period: float,
        half_cycle: float,
        reversals: int,
    ) -> None:
        """Compare a force (n,) [N] with the measured force at currents (n,) [A]."""
        if self._known < _SETTLING_TIME:
            return
        if not math.isfinite(float(force.sum())):
            self.state, self.holds, self.wrong = None, False, True
            self.sentence = f"the force of {self.parameters.set_id} overflows"
            return
        if self._monitor is None:
            self._monitor = ResidualMonitor(period, self._limit, recent)
        monitor = self._monitor
        monitor.adapt(half_cycle)
        found = monitor.judge(force, measured) or []
        self.holds = monitor.holds
        self.wrong = monitor.is_wrong or any(each.where is True or each.where[-1] for each in found)
        self.sentence = found[-1].sentence if found else ""
        self.evidence.add(
            *(current, force - measured, measured, period), peak=recent.peak, half_cycle=half_cycle
        )
        if monitor.allowed < math.inf:
            self._zero.learn(measured - force, reversals, monitor.allowed)


class CandidateSets:
    """The given set, the widest identified set and the set in use, predicted in the background.

    ``limit`` is the largest error of a right force relative to the peak; 0: no force is measured,
    and there is no evidence.
    """

    def __init__(self, limit: ErrorLimit) -> None:
        self._limit = limit
        self._given: CandidateSet | None = None
        self._widest: CandidateSet | None = None
        self._in_use: CandidateSet | None = None
        self._forces: list[tuple[CandidateSet, Array]] = []
        self.kept: CandidateSet | None = None
        """The set that the controller inverts, which stays a candidate."""

    @property
    def sets(self) -> list[CandidateSet]:
        """The different sets: the given one first, the one in use last."""
        every = self._given, self.kept, self._widest, self._in_use
        return list(dict.fromkeys(each for each in every if each is not None))

    def add(self, parameters: ParameterSet) -> None:
        """Add a set that arrives. One loaded by a user replaces all others."""
        if not parameters.origin.is_evidence:
            return
        if not parameters.origin.is_identified:
            self._given, self._widest, self.kept = self._made(parameters), None, None
        elif parameters.law.knows_currents(parameters.observable):
            widest = self._widest
            if widest is None or parameters.domain.covers(widest.parameters.domain):
                self._widest = self._made(parameters)

    def use(self, parameters: ParameterSet) -> None:
        """Note the set in use, which may be scaled."""
        if self._in_use is None or self._in_use.parameters is not parameters:
            known = (each for each in self.sets if each.parameters is parameters)
            self._in_use = next(known, None) or self._made(parameters)

    def _made(self, parameters: ParameterSet) -> CandidateSet:
        return CandidateSet(parameters, self._limit)

    def restart(self) -> None:
        """Restart the comparison after samples whose motion does not determine the force."""
        for each in self.sets:
            each.restart()

    def forget_evidence(self) -> None:
        """Discard the evidence, because a fault that has ended caused part of it."""
        for each in self.sets:
            each.evidence.forget()

    def follow(
        self, motion: Motion, current: Array, period: float, half_cycle: float, *, gradual: bool
    ) -> None:
        """Predict the sets at the next samples (n,)."""
        self._forces = [
            (each, each.follow(motion, current, period, half_cycle, gradual=gradual))
            for each in self.sets
        ]

    def compare(
        self,
        measured: Array,
        current: Array,
        recent: ForceStatistics,
        period: float,
        centre: MotionCentre,
    ) -> None:
        """Compare the last forces with the ``measured`` force (m,) [N] of the last m samples."""
        count = measured.size
        if self._limit.relative == 0.0 or count == 0:
            return
        moved = period, centre.usual_half_cycle, centre.reversals
        for each, force in self._forces:
            each.compare(force[-count:], measured, current[-count:], recent, *moved)
