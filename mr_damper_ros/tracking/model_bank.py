"""The model bank: the sets known of a damper, and which of them holds for the motion and current.

A set that a window was fitted with holds at its peak velocity and its current, and often nowhere
else. So the sets before it are kept: where the motion or the current comes back to what one of them
is for, it is used at once, without waiting for the identification. The measured force decides among
them; it also tells whether the force of this damper jumps where the motion turns.

Over the current there is a schedule. A window at one current moves the scales so that the force is
right there; what it says of other currents is only as good as the law. Where the current goes to
what no window of the set in use had, the set of the newest windows at that current takes over.
Where there is none, the set for all operating points does, times the damper's present force over
that of this set.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.parameter_set import (
    EARLY_SOURCE,
    GLOBAL_SOURCE,
    LONGEST_NAME,
    ParameterSet,
)
from mr_damper_ros.signals.arrays import Array, RollingRows
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.operating_point import SAME_CURRENT, SAME_SPEED

_SAME_TIME = 1.5
"""A set replaces one whose range of peak velocities begins and ends at its own, if the half-cycles
in which they came are within this factor."""

_MOST = 8
"""Sets that are kept; a search tries each of them."""

_MOST_CURRENTS = 16
"""Currents for which the schedule keeps a set."""

_RECENT_NS = 60 * NANOSECONDS
"""Age of a set beyond which the schedule does not use it: a damper that heats may change by a
quarter in ten minutes, so by a fortieth in this time."""

_SETTLES = 0.2
"""Seconds of motion in which the force of a set settles before it is judged ..."""

_JUDGED = 0.1
"""... over the last so many seconds, or the same part of a half-cycle, if that is more."""

_EVERY = 0.05
"""Seconds between two searches: each costs as much as some blocks of prediction."""

_TURNING_EVERY = 5.0
"""Seconds between two comparisons of how the force turns."""

_BETTER = 0.6
"""What replaces a wrong force leaves less than this part of its error."""

_MOST_SHOWN, _KEPT = 1.0, 0.5
"""A cycle may hardly show how a force turns: it counts at most so much (log of the ratio of two
errors), and this part of that at the next comparison."""

_MOST_SAMPLES, _MOST_TRIED = 40_000, 2000
"""Samples that are kept, and that a set is tried with."""

Span = tuple[float, float]
"""The lowest and the highest current [A] of one window, or of several."""


@dataclass(frozen=True, eq=False)
class KnownSet:
    """A set, and the stamp up to which it fits the samples (None: it does not age).

    ``half_cycle`` [s] of the motion in which it came, NaN where that was not known. ``currents`` of
    the windows that it fits, None where that is not known: it then counts for all. ``whole``:
    whether it is for all operating points, and no window's.
    """

    parameters: ParameterSet
    confirmed_ns: int | None
    half_cycle: float = math.nan
    currents: Span | None = None
    whole: bool = False

    def replaces(self, other: KnownSet) -> bool:
        """Whether the set is for the motions and currents of another."""
        times = self.half_cycle, other.half_cycle
        mine, its = self.parameters, other.parameters
        speeds = zip(mine.peak_velocity_range, its.peak_velocity_range, strict=True)
        currents = zip(mine.current_range, its.current_range, strict=True)
        return (
            not max(times) > _SAME_TIME * min(times)
            and all(max(pair) <= SAME_SPEED * min(pair) for pair in speeds)
            and all(a == b or abs(a - b) <= SAME_CURRENT for a, b in currents)
        )

    def covers(self, other: KnownSet) -> bool:
        """Whether the set holds at all currents that another is known to hold at."""
        return all(
            within(current, self.parameters.current_range)
            for current in other.parameters.current_range
            if math.isfinite(current)
        )

    def is_for(self, speed: float, current: float, margin: float) -> bool:
        """Whether the set was identified at a peak velocity [m/s] and a current [A]."""
        slow, fast = self.parameters.peak_velocity_range
        return bool(
            slow * (1.0 - margin) <= speed <= fast * (1.0 + margin)
            and within(current, self.parameters.current_range)
        )

    def fits_at(self, current: float) -> bool:
        """Whether a current [A] is among those of its windows."""
        return self.currents is None or within(current, self.currents)

    def confirmed(self, set_id: str, stamp_ns: int, currents: Span | None) -> KnownSet:
        """The same after a report that the set of this name fits a window of these currents."""
        if self.parameters.set_id != set_id:
            return self
        # A set that does not age stays so.
        stamp = None if self.confirmed_ns is None else stamp_ns
        return replace(self, confirmed_ns=stamp, currents=_joined(self.currents, currents))


def within(current: float, span: Span) -> bool:
    """Whether a current [A] lies in a span, but for what counts as the same."""
    return span[0] - SAME_CURRENT <= current <= span[1] + SAME_CURRENT


def _joined(one: Span | None, other: Span | None) -> Span | None:
    """The span over both; None stands for one that is not known."""
    if one is None or other is None:
        return one or other
    return min(one[0], other[0]), max(one[1], other[1])


def force_ratio(present: Array, whole: Array) -> float:
    """Present force over that of the set for all operating points, (n,) [N], for another current.

    A law that does not follow the force exactly is off by another factor at each current: the ratio
    counts as far as its change stands out of what no factor explains.
    """
    power = float(whole @ whole)
    if not power > 0.0:
        return 1.0
    factor = float(present @ whole) / power
    rest = present - factor * whole
    change, misfit = (factor - 1.0) ** 2, float(rest @ rest) / power
    if not (factor > 0.0 and change > 0.0):
        return 1.0
    return 1.0 + (factor - 1.0) * change / (change + misfit)


def _times_force(whole: ParameterSet, factor: float, present: ParameterSet) -> ParameterSet:
    """The set for all with so many times its force; it holds as fast as the ``present`` one."""
    values, errors = whole.values.copy(), whole.standard_errors.copy()
    strength = whole.law.strength_indices
    values[strength] *= factor
    errors[strength] *= factor
    slow, fast = present.peak_velocity_range
    known = whole.peak_velocity_range
    suffix = f" x {factor:.3f}"
    return replace(
        whole,
        values=values,
        standard_errors=errors,
        set_id=whole.set_id[: LONGEST_NAME - len(suffix)] + suffix,
        peak_velocity_range=(slow, fast) if slow <= known[0] and known[1] <= fast else known,
        largest_force=float(np.fmax(whole.largest_force, present.largest_force)),
    )


class JudgedSamples(NamedTuple):
    """Motion, current [A], predicted and measured force [N], each (n,), ``period`` [s] apart.

    The measured force is NaN at samples that were bridged.
    """

    motion: Motion
    current: Array
    predicted: Array
    measured: Array
    period: float

    def left_by(self, force: Array, part: slice = slice(None)) -> Array:
        """The measured less a ``force`` (n,) [N], at the measured samples of a part."""
        measured = self.measured[part]
        return np.asarray((force[part] - measured)[~np.isnan(measured)])


class RecentSamples:
    """Keeps the newest samples of a stream."""

    def __init__(self) -> None:
        # Four of the motion, current, predicted and measured force.
        self._rows = RollingRows(7)

    @property
    def count(self) -> int:
        """Number of samples that are kept."""
        return self._rows.count

    def clear(self) -> None:
        """Forget them: the next samples do not continue from them."""
        self._rows.keep(0)

    def add(
        self,
        motion: Motion,
        current: Array | float,
        forces: tuple[Array, Array],
        bridged: int,
        most: float,
    ) -> None:
        """Add samples, predicted and measured ``forces`` [N], and keep at most so many in all.

        The force of the first ``bridged`` was not measured.
        """
        count, (predicted, measured) = motion.velocity.size, forces
        if bridged:
            measured = np.concatenate([np.full(bridged, math.nan), measured[bridged:]])
        along = motion.displacement, motion.velocity, motion.acceleration, motion.peak_velocity
        self._rows.add((*along, current, predicted, measured), count)
        self._rows.keep(max(int(min(most, _MOST_SAMPLES)), count))

    def last(self, period: float, count: float = math.inf) -> JudgedSamples:
        """The last so many of those kept, ``period`` [s] apart; every n-th where they are many."""
        whole = int(min(count, self.count))
        stride = whole // _MOST_TRIED + 1
        rows = self._rows.newest[:, self.count - whole :: stride]
        u, v, a, v_m, current, predicted, measured = rows
        motion = Motion(u, v, a, v_m, sine=None)
        return JudgedSamples(motion, current, predicted, measured, stride * period)


class Choice(NamedTuple):
    """A set to use from now on, and the error [N] of its newest forces; NaN where none came."""

    chosen: KnownSet
    error: float


class ModelBank:
    """Keeps the sets that were in use, and the newest samples.

    ``margin``: part by which the peak velocity may leave the range of a set. ``gradual``: whether
    the branch of the hysteresis follows the velocity where the motion turns. ``measured``: whether
    there is a measured force to go by.
    """

    def __init__(self, margin: float, *, gradual: bool, measured: bool = True) -> None:
        self._margin = margin
        self._measured = measured
        self.gradual = gradual
        # The one in use, then those before; the one that a user gave is never forgotten.
        self._sets: list[KnownSet] = []
        self._given: KnownSet | None = None
        self._newest_ns: int | None = None
        self._samples = RecentSamples()
        self._period = math.nan
        self._half_cycle = 0.0
        self._since_search = math.inf
        self._since_turning = 0.0
        self._turning = 0.0  # log of the error of a jumping force over that of a gradual one
        # The current schedule: the sets of the newest windows at one current each, newest first,
        # and the set for all operating points.
        self._at_currents: list[KnownSet] = []
        self._whole: KnownSet | None = None
        # The present current [A], the set that the identification found last, and whether the
        # schedule has put another in its place.
        self._current = math.nan
        self._found: KnownSet | None = None
        self._scheduled = False
        # The report that a set fits a window may come before the set itself.
        self._reported: tuple[str, Span | None] = ("", None)

    @property
    def present(self) -> KnownSet | None:
        """The set in use; None before one has come."""
        return self._sets[0] if self._sets else None

    # Sets that come

    def confirm(self, set_id: str, stamp_ns: int, currents: Span | None) -> bool:
        """Take note that the set of this name fits the samples of a window up to the stamp.

        ``currents``: the lowest and the highest [A] in it, None where they are not known. Returns
        whether the set takes over from the one that the schedule has put in its place.
        """
        self._reported = set_id, currents
        self._sets = [each.confirmed(set_id, stamp_ns, currents) for each in self._sets]
        found = self._found
        if found is None or found.parameters.set_id != set_id or currents is None:
            return False
        self._found = found = found.confirmed(set_id, stamp_ns, currents)
        self._confirm_at(found, currents)
        if not self._scheduled or not self._takes_over(found):
            return False
        self._take(found)
        return True

    def add(self, parameters: ParameterSet, stamp_ns: int | None, half_cycle: float) -> None:
        """Add a set, which is in use now unless another is for the present current.

        The stamp and ``half_cycle`` are those of :class:`KnownSet`; a set that does not age was
        given by a user. All others are forgotten when one is given, and for a set that is no
        younger, of another law, or a mere start. But a set without evidence never displaces a
        given one, and one for fewer currents only once the given one is wrong.
        """
        given = self._given
        if given is not None and not parameters.has_evidence:
            if not self._is_given(self.present):
                self._forget(given)
            return
        if stamp_ns is None:
            parameters = parameters.as_given()
        aged = stamp_ns is not None and self._newest_ns is not None and stamp_ns > self._newest_ns
        same_law = all(
            each.parameters.model == parameters.model or self._is_given(each) for each in self._sets
        )
        if not (aged and same_law):
            self._forget(given if stamp_ns is not None else None)
        self._newest_ns = stamp_ns
        searched = parameters.source == GLOBAL_SOURCE or stamp_ns is None
        whole = searched and parameters.law.knows_currents(parameters.observable)
        reported_id, currents = self._reported
        if whole:
            # For all currents: the next one may have a set of its own.
            currents = None if math.isnan(self._current) else (self._current, self._current)
        elif reported_id != parameters.set_id:
            currents = None
        found = KnownSet(parameters, stamp_ns, half_cycle, currents, whole)
        if stamp_ns is None:
            self._given = found if parameters.has_evidence else None
        elif self._is_given(self.present) and not found.covers(self._sets[0]):
            others = [each for each in self._sets[1:] if not found.replaces(each)]
            self._sets = [self._sets[0], found, *others][:_MOST]
            return
        self._found = found
        if found.whole:
            self._whole = found
        else:
            if parameters.source == EARLY_SOURCE:
                # The damper has changed at once: only its force is known, and only here.
                self._at_currents = []
            if currents is not None:
                self._confirm_at(found, currents)
        if self._sets and self._scheduled and not self._takes_over(found):
            self._sets.insert(1, found)
            del self._sets[_MOST:]
        else:
            self._take(found)

    def is_in_use(self, parameters: ParameterSet) -> bool:
        """Whether a set is the given one that is in use already."""
        if self._given is None or not self._is_given(self.present):
            return False
        known = self._given.parameters
        same_name = (known.set_id, known.model) == (parameters.set_id, parameters.model)
        return same_name and np.array_equal(known.values, parameters.values)

    def _is_given(self, known: KnownSet | None) -> bool:
        given = self._given
        return given is not None and known is not None and known.parameters is given.parameters

    def _forget(self, given: KnownSet | None) -> None:
        """Forget all sets but the one that a user gave, which is in use then."""
        self._sets = [] if given is None else [given]
        self._given, self._found = given, None
        self._scheduled = False
        self._at_currents = []
        self._whole = given if given is not None and given.whole else None

    def use(self, chosen: KnownSet) -> None:
        """Take note that this set is in use now, whatever the current of its windows."""
        if not (chosen.fits_at(self._current) or math.isnan(self._current)):
            here = self._current, self._current
            chosen = replace(chosen, currents=_joined(chosen.currents, here))
        self._take(chosen)

    def _take(self, chosen: KnownSet) -> None:
        others = [each for each in self._sets if not chosen.replaces(each)]
        self._sets = [chosen, *others][:_MOST]
        if self._given is not None and not any(map(self._is_given, self._sets)):
            self._sets[_MOST - 1 :] = [self._given]
        self._scheduled = False

    # The current schedule

    def _confirm_at(self, known: KnownSet, currents: Span) -> None:
        """The set fits a window of these currents: if they are one, it is the set for that one."""
        low, high = currents
        if high - low <= 2.0 * SAME_CURRENT:
            others = [each for each in self._at_currents if not each.fits_at(0.5 * (low + high))]
            self._at_currents = [replace(known, currents=currents), *others][:_MOST_CURRENTS]

    def _at_current(self, now_ns: int) -> KnownSet | None:
        """The set of the newest windows at the present current, unless that is long ago."""
        for each in self._at_currents:
            age = math.inf if each.confirmed_ns is None else abs(now_ns - each.confirmed_ns)
            if each.fits_at(self._current) and age <= _RECENT_NS:
                return each
        return None

    def follow_current(self, current: float, now_ns: int) -> None:
        """Use what is known of a current [A] at the samples up to a stamp."""
        before, self._current = self._current, current
        if not self._sets or self._sets[0].fits_at(current):
            return
        present = self._sets[0]
        chosen = self._at_current(now_ns)
        if chosen is None or not self._holds_after(chosen, before, current):
            chosen = self._whole_now(current)
        if chosen is None:
            # Nothing better is known: the law says what the force is there.
            self.use(present)
            return
        self._take(chosen)
        self._scheduled = True

    def _holds_after(self, chosen: KnownSet, before: float, current: float) -> bool:
        """Whether a set is for the present motion, and for the current [A] before this one."""
        speed = math.nan
        if self._samples.count:
            speed = _root_mean_square(self._samples.last(self._period).motion.peak_velocity)
        return chosen.is_for(speed, current, self._margin) and (
            not chosen.parameters.law.remembers or within(before, chosen.parameters.current_range)
        )

    def _whole_now(self, current: float) -> KnownSet | None:
        """The set for all currents, with the force that the damper has now."""
        whole, present = self._whole, self._sets[0]
        if whole is None or not within(current, whole.parameters.current_range):
            return None
        parameters = whole.parameters
        if present.whole:
            parameters = present.parameters  # with the force of when it took over
        elif self._samples.count:
            newest = self._samples.last(self._period)
            low, high = parameters.current_range
            known = (newest.current >= low - SAME_CURRENT) & (newest.current <= high + SAME_CURRENT)
            forces = (self._force(each, newest, self.gradual)[known] for each in (present, whole))
            parameters = _times_force(parameters, force_ratio(*forces), present.parameters)
        return replace(present, parameters=parameters, currents=(current, current), whole=True)

    def _takes_over(self, found: KnownSet) -> bool:
        """Whether the set of the newest window is better at the present current than the one used.

        If not, that one fits the window as well.
        """
        if found.whole or found.currents is None:
            return True
        if not found.fits_at(self._current):
            return False
        if not self._measured or not self._samples.count:
            return True
        newest = self._samples.last(self._period)
        elsewhere = np.flatnonzero(np.abs(newest.current - self._current) > SAME_CURRENT)
        judged = slice(int(elsewhere[-1]) + 1 if elsewhere.size else 0, None)
        if newest.current[judged].size * newest.period < _JUDGED:
            return False
        new, used = (self._error(each, newest, judged) for each in (found, self._sets[0]))
        if new < used:
            return True
        self._sets[0] = replace(self._sets[0], confirmed_ns=found.confirmed_ns)
        return False

    # What the measured force says

    def forget_samples(self) -> None:
        """The next samples do not continue from those so far."""
        self._samples.clear()

    def follow(
        self,
        motion: Motion,
        current: Array | float,
        forces: tuple[Array, Array],
        period: float,
        half_cycle: float,
        bridged: int = 0,
    ) -> None:
        """Keep the newest samples: motion, current [A], predicted and measured ``forces`` [N].

        Each has shape (n,). They are ``period`` [s] apart; ``half_cycle`` [s] is that of the
        motion, NaN where it is not known. The force of the first ``bridged`` was not measured.
        """
        time = forces[1].size * period
        self._since_search += time
        self._since_turning += time
        self._period = period
        self._half_cycle = 0.0 if math.isnan(half_cycle) else half_cycle
        span = max(2.0 * self._half_cycle, self._judged + _SETTLES)
        self._samples.add(motion, current, forces, bridged, span / period)

    def search_is_due(self) -> bool:
        """Whether it is time to look for another set: not every time that the force is wrong."""
        enough = self._samples.count * self._period >= _JUDGED
        if not enough or self._since_search < _EVERY:
            return False
        self._since_search = 0.0
        return True

    def turning_is_due(self) -> bool:
        """Whether it is time to see how the force turns, though it is not wrong."""
        if not self._measured or self._since_turning < _TURNING_EVERY:
            return False
        self._since_turning = 0.0
        return True

    def better(self, allowed: float, *, wrong: bool) -> Choice | None:
        """The set that gives the newest forces, within an ``allowed`` error [N]; None for none.

        ``wrong``: the present one does not; else it is for other motions only. An infinite error
        is allowed where no force is measured: the set last used for the motion is then taken. Where
        the present force continues from a wrong past, it is the present set that starts again.
        """
        present = self._sets[0]
        newest = self._samples.last(self._period, (self._judged + _SETTLES) / self._period)
        judged = slice(-max(round(self._judged / newest.period), 1), None)
        speed = float(np.median(newest.motion.peak_velocity[judged]))
        current = float(newest.current[-1])
        candidates = [each for each in self._sets[1:] if each.is_for(speed, current, self._margin)]
        if math.isinf(allowed):
            return Choice(candidates[0], math.nan) if candidates else None
        limit = _root_mean_square(newest.left_by(newest.predicted, judged))
        limit *= _BETTER if wrong else 1.0
        best = None
        for each in (present, *candidates) if wrong else candidates:
            left = newest.left_by(self._force(each, newest, self.gradual), judged)
            error = _root_mean_square(left)
            if error < limit and float(np.max(np.abs(left))) <= allowed:
                best, limit = Choice(each, error), error
        return best

    def turned_otherwise(self) -> Choice | None:
        """The present set, where over a cycle the force turns otherwise than it was taken to.

        It is taken to do so from now on. None where it does not, or not enough is known.
        """
        present = self._sets[0]
        law = present.parameters.law
        if law.continuous is law or self._samples.count * self._period < self._half_cycle:
            return None
        newest = self._samples.last(self._period)
        errors = [
            max(_root_mean_square(newest.left_by(self._force(present, newest, gradual))), 1e-9)
            for gradual in (False, True)
        ]
        shown = min(max(math.log(errors[0] / errors[1]), -_MOST_SHOWN), _MOST_SHOWN)
        self._turning = _KEPT * self._turning + shown
        if not (-self._turning if self.gradual else self._turning) > -math.log(_BETTER):
            return None
        self.gradual = not self.gradual
        return Choice(present, errors[self.gradual])

    @property
    def _judged(self) -> float:
        """Seconds over which a set is judged."""
        return max(_JUDGED, _JUDGED * self._half_cycle)

    def _force(self, known: KnownSet, newest: JudgedSamples, gradual: bool) -> Array:
        along = newest.motion, newest.current, newest.period
        return known.parameters.follow(*along, gradual=gradual)[0]

    def _error(self, known: KnownSet, newest: JudgedSamples, judged: slice) -> float:
        return _root_mean_square(newest.left_by(self._force(known, newest, self.gradual), judged))


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
