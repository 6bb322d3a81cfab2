"""The model bank: the known sets of a damper, and the choice among them by motion and current.

A set fitted to one window often holds only at its peak velocity and current. The bank therefore
keeps previous sets, and uses one again at once where the motion returns to its range. The measured
force selects among several candidates, and shows whether this damper's force jumps at reversals.

A window at one current corrects the force at that current only. A current schedule therefore
changes the set with the current: if no window of the set in use had the new current, the set of the
newest windows at this current takes over. Without such a set, the set for all operating points
takes over, scaled to the present force of the damper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.domain import Domain, Origin, Span
from mr_damper_ros.models.parameter_set import LONGEST_NAME, ParameterSet
from mr_damper_ros.models.quantities import SAME_CURRENT
from mr_damper_ros.signals.arrays import Array, RollingRows
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.bumpless_transfer import FADE_TIME
from mr_damper_ros.tracking.operating_point import COMPARABLE_SPEED, SAME_SPEED
from mr_damper_ros.tracking.validity import DoubtKind

_MOST_SETS = 8
"""Largest number of sets in the bank; a search tries all of them. The schedule has at most twice as
many currents."""

_RECENT_NS = 60 * NANOSECONDS
"""Largest age of a set in the schedule. The force of a heating damper may change by a quarter in
ten minutes, that is by a fortieth in this time."""

_JUDGED_TIME = 2.0 * FADE_TIME
"""A set is judged over this time [s], or over this fraction of a half-cycle if that is longer.
Before that, its law settles for twice this time. Searches are at least half this time apart."""

_BETTER_RATIO = 0.6
"""A set replaces a wrong set if its error is below this multiple of the wrong set's error."""

_EVIDENCE_DECAY = 0.5
"""Factor on earlier evidence for a branch rule at each new comparison. The evidence is the
logarithm of the ratio of the errors of the two rules. A single cycle is weak evidence, so it counts
at most twice the value that changes the rule."""

_MOST_TRIED = 2000
"""Largest number of samples on which a set is tried; twenty times as many are kept."""


@dataclass(frozen=True, eq=False)
class KnownSet:
    """A set, and the stamp up to which it fits the samples (None: the set does not age).

    ``half_cycle`` [s] is the half-cycle of the motion when the set arrived, NaN if unknown.
    ``currents`` is the current range of the windows that the set fits; None (unknown) counts as all
    currents. ``whole`` marks a set for all operating points, as opposed to a window set.
    """

    parameters: ParameterSet
    confirmed_ns: int | None
    half_cycle: float = math.nan
    currents: Span | None = None
    whole: bool = False

    def replaces(self, other: KnownSet) -> bool:
        """Whether the set is for the same motions and currents as the ``other`` set."""
        if max(self.half_cycle, other.half_cycle) > COMPARABLE_SPEED * min(
            self.half_cycle, other.half_cycle
        ):
            return False
        mine, its = self.parameters, other.parameters
        speeds = zip(mine.peak_velocity_range, its.peak_velocity_range, strict=True)
        currents = zip(mine.current_range, its.current_range, strict=True)
        return all(max(pair) <= SAME_SPEED * min(pair) for pair in speeds) and all(
            a == b or abs(a - b) <= SAME_CURRENT for a, b in currents
        )

    def is_for(self, speed: float, current: float, margin: float) -> bool:
        """Whether a peak velocity [m/s] and a current [A] are in the range of the set.

        ``margin`` is the relative margin of the peak velocity.
        """
        domain = self.parameters.domain
        return domain.contains_speed(speed, margin) and domain.contains(current)

    def fits_at(self, current: float) -> bool:
        """Whether a current [A] is in the range of its windows."""
        return self.currents is None or Domain(currents=self.currents).contains(current)

    def confirmed(self, set_id: str, stamp_ns: int, currents: Span | None) -> KnownSet:
        """Return the set; a window of these currents has confirmed the set named ``set_id``."""
        if self.parameters.set_id != set_id:
            return self
        # A set that does not age gets no stamp.
        stamp = None if self.confirmed_ns is None else stamp_ns
        return replace(self, confirmed_ns=stamp, currents=_joined(self.currents, currents))

    def after_leap(self, leap_ns: int) -> KnownSet:
        """Return the set, now that the clock of the stamps leapt by this time."""
        if self.confirmed_ns is None:
            return self
        return replace(self, confirmed_ns=self.confirmed_ns + leap_ns)


def _joined(one: Span | None, other: Span | None) -> Span | None:
    """The range that covers both; None is an unknown range."""
    if one is None or other is None:
        return one or other
    return Domain(currents=one).joined(Domain(currents=other)).currents


def force_ratio(present: Array, whole: Array) -> float:
    """Force scale of the present set relative to the set for all operating points, (n,) [N].

    The scale is for another current, where the model error is different. It is the closer to 1 the
    less a single factor explains the difference between the two forces.
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


class JudgedSamples(NamedTuple):
    """Motion, current [A], predicted and measured force [N], each (n,), ``period`` [s] apart.

    The measured force is NaN at bridged samples.
    """

    motion: Motion
    current: Array
    predicted: Array
    measured: Array
    period: float

    def force_of(self, known: KnownSet, gradual: bool) -> Array:
        """Force (n,) [N] of a set, from a new state of its law."""
        along = self.motion, self.current, self.period
        return known.parameters.follow(*along, gradual=gradual)[0]

    def residual_of(self, force: Array, part: slice = slice(None)) -> Array:
        """Residual [N] of a ``force`` (n,) [N] at the samples of ``part`` with a measured force."""
        measured = self.measured[part]
        return np.asarray((force[part] - measured)[~np.isnan(measured)])


Choice = tuple[KnownSet, float]
"""A set to use from now on, and the error [N] of its newest forces; NaN if unknown."""


class ModelBank:
    """Keeps the sets that were in use, and the newest samples.

    ``margin`` is the relative margin by which the peak velocity may leave the range of a set.
    ``gradual`` is the branch rule: whether the branch of the hysteresis follows the velocity near
    reversals. ``measured`` says whether the force is measured.
    """

    def __init__(self, margin: float, *, gradual: bool, measured: bool = True) -> None:
        self._margin = margin
        self._measured = measured
        self.gradual = gradual
        # The set in use, then the previous ones. The set loaded by a user always stays.
        self._sets: list[KnownSet] = []
        self._given: KnownSet | None = None
        self._newest_ns: int | None = None
        # The newest samples: four rows of the motion; current, predicted and measured force.
        self._rows = RollingRows(7)
        self._period = math.nan
        self._half_cycle = 0.0
        self._since_search = math.inf
        self._since_turning = math.inf
        self._turning = 0.0  # log of (error of a jumping force / of a gradual one)
        # The current schedule: the sets of the newest windows at one current each, newest first,
        # and the set for all operating points.
        self._at_currents: list[KnownSet] = []
        self._whole: KnownSet | None = None
        # The present current [A], the newest set of the identification, and whether the schedule
        # has replaced that set.
        self._current = math.nan
        self._found: KnownSet | None = None
        self._scheduled = False
        # The last confirmation; it may arrive before the set itself.
        self._reported: tuple[str, Span | None] = ("", None)

    @property
    def present(self) -> KnownSet | None:
        """The set in use; None before the first."""
        return self._sets[0] if self._sets else None

    @property
    def uses_given(self) -> bool:
        """Whether the set in use is the one loaded by a user."""
        return self._is_given(self.present)

    # Arriving sets

    def confirm(self, set_id: str, stamp_ns: int, currents: Span | None) -> bool:
        """Note that the set with this name fits a window that ends at the stamp.

        ``currents`` is the lowest and the highest current [A] in the window, None if unknown.
        Returns whether the set replaces the set chosen by the schedule.
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

    def add(self, parameters: ParameterSet, half_cycle: float = math.nan) -> None:
        """Add a set and use it, unless the schedule has a better set for the present current.

        ``half_cycle`` is as in :class:`KnownSet`. A set loaded by a user clears the bank. A set
        that is not newer than the bank, or belongs to another law, clears it except for the loaded
        set, which no start set replaces. A set for fewer currents replaces the loaded set only if
        its force is wrong.
        """
        given, origin = self._given, parameters.origin
        stamp_ns = parameters.domain.confirmed_ns
        if given is not None and not origin.is_evidence:
            if not self.uses_given:
                self._forget(given)
            return
        aged = stamp_ns is not None and self._newest_ns is not None and stamp_ns > self._newest_ns
        same_law = all(
            each.parameters.model == parameters.model or self._is_given(each) for each in self._sets
        )
        if not (aged and same_law):
            self._forget(given if origin.is_identified else None)
        self._newest_ns = stamp_ns
        searched = origin not in (Origin.WINDOW, Origin.EARLY)
        whole = searched and parameters.law.knows_currents(parameters.observable)
        reported_id, currents = self._reported
        if whole:
            # The set holds at all currents, but the schedule may have a better set for another
            # current.
            currents = None if math.isnan(self._current) else (self._current, self._current)
        elif reported_id != parameters.set_id:
            currents = None
        found = KnownSet(parameters, stamp_ns, half_cycle, currents, whole)
        if not origin.is_identified:
            self._given = found if origin.is_evidence else None
        elif self.uses_given and not parameters.domain.covers(self._sets[0].parameters.domain):
            others = [each for each in self._sets[1:] if not found.replaces(each)]
            self._sets = [self._sets[0], found, *others][:_MOST_SETS]
            return
        self._found = found
        if whole:
            self._whole = found
        elif origin is Origin.EARLY:
            # After a sudden change the force is known at the present current only.
            self._at_currents = []
        if not whole and currents is not None:
            self._confirm_at(found, currents)
        if self._sets and self._scheduled and not self._takes_over(found):
            self._sets.insert(1, found)
            del self._sets[_MOST_SETS:]
        else:
            self._take(found)

    def is_in_use(self, parameters: ParameterSet) -> bool:
        """Whether a set is the loaded set and already in use."""
        if self._given is None or not self.uses_given:
            return False
        known = self._given.parameters
        same_name = (known.set_id, known.model) == (parameters.set_id, parameters.model)
        return same_name and np.array_equal(known.values, parameters.values)

    def _is_given(self, known: KnownSet | None) -> bool:
        given = self._given
        return given is not None and known is not None and known.parameters is given.parameters

    def _forget(self, given: KnownSet | None) -> None:
        """Clear the bank, and use the set loaded by a user if there is one."""
        self._sets = [] if given is None else [given]
        self._given, self._found = given, None
        self._scheduled = False
        self._at_currents = []
        self._whole = given if given is not None and given.whole else None

    def use(self, chosen: KnownSet) -> None:
        """Note that this set is in use now; the present current is added to its range."""
        if not (chosen.fits_at(self._current) or math.isnan(self._current)):
            here = self._current, self._current
            chosen = replace(chosen, currents=_joined(chosen.currents, here))
        self._take(chosen)

    def _take(self, chosen: KnownSet) -> None:
        others = [each for each in self._sets if not chosen.replaces(each)]
        self._sets = [chosen, *others][:_MOST_SETS]
        if self._given is not None and not any(map(self._is_given, self._sets)):
            self._sets[_MOST_SETS - 1 :] = [self._given]
        self._scheduled = False

    # The current schedule

    def _confirm_at(self, known: KnownSet, currents: Span) -> None:
        """Enter a set in the schedule if the window that it fits has a single current."""
        low, high = currents
        if high - low <= 2.0 * SAME_CURRENT:
            others = [each for each in self._at_currents if not each.fits_at(0.5 * (low + high))]
            self._at_currents = [replace(known, currents=currents), *others][: 2 * _MOST_SETS]

    def follow_leap(self, leap_ns: int) -> None:
        """Keep the age of the sets, because the clock of the stamps leapt by this time."""
        self._sets = [each.after_leap(leap_ns) for each in self._sets]
        self._at_currents = [each.after_leap(leap_ns) for each in self._at_currents]
        self._whole = self._whole and self._whole.after_leap(leap_ns)
        self._found = self._found and self._found.after_leap(leap_ns)
        if self._newest_ns is not None:
            self._newest_ns += leap_ns

    def follow_current(self, current: float, now_ns: int) -> None:
        """Apply the current schedule to a current [A] at the samples up to a stamp."""
        before, self._current = self._current, current
        if not self._sets or self._sets[0].fits_at(current):
            return
        recent = (
            each
            for each in self._at_currents
            if each.fits_at(current)
            and each.confirmed_ns is not None
            and abs(now_ns - each.confirmed_ns) <= _RECENT_NS
        )
        chosen = next(recent, None)
        if chosen is None or not self._holds_after(chosen, before, current):
            chosen = self._whole_now(current)
        if chosen is None:
            # No other set is known, so the present set also gives the force at the new current.
            self.use(self._sets[0])
            return
        self._take(chosen)
        self._scheduled = True

    def _holds_after(self, chosen: KnownSet, before: float, current: float) -> bool:
        """Whether a set holds for the present motion and ``current`` [A].

        With a law that has memory, it must also hold at the current ``before`` the change.
        """
        speed = math.nan
        if self._rows.count:
            speed = _root_mean_square(self._newest().motion.peak_velocity)
        return chosen.is_for(speed, current, self._margin) and (
            not chosen.parameters.law.remembers or chosen.parameters.domain.contains(before)
        )

    def _whole_now(self, current: float) -> KnownSet | None:
        """The set for all currents, scaled to the damper's present force; None without one."""
        whole, present = self._whole, self._sets[0]
        if whole is None or not whole.parameters.domain.contains(current):
            return None
        parameters, used = whole.parameters, present.parameters
        if present.whole:
            parameters = used  # already scaled when it took over
        elif self._rows.count:
            newest = self._newest()
            low, high = parameters.current_range
            known = (newest.current >= low - SAME_CURRENT) & (newest.current <= high + SAME_CURRENT)
            factor = force_ratio(
                *(newest.force_of(each, self.gradual)[known] for each in (present, whole))
            )
            suffix, known_speeds = f" x {factor:.3f}", parameters.peak_velocity_range
            speeds = used.peak_velocity_range
            includes = speeds[0] <= known_speeds[0] and known_speeds[1] <= speeds[1]
            parameters = parameters.times_force(
                factor,
                set_id=parameters.set_id[: LONGEST_NAME - len(suffix)] + suffix,
                peak_velocity_range=speeds if includes else known_speeds,
                dependence_range=parameters.held_range,
                largest_force=float(np.fmax(parameters.largest_force, used.largest_force)),
            )
        return replace(present, parameters=parameters, currents=(current, current), whole=True)

    def _takes_over(self, found: KnownSet) -> bool:
        """Whether the set of the newest window fits the present current better than the set in use.

        If it does not, the newest window confirms the set in use.
        """
        if found.whole or found.currents is None:
            return True
        if not found.fits_at(self._current):
            return False
        if not self._measured or not self._rows.count:
            return True
        newest = self._newest()
        elsewhere = np.flatnonzero(np.abs(newest.current - self._current) > SAME_CURRENT)
        judged = slice(int(elsewhere[-1]) + 1 if elsewhere.size else 0, None)
        if newest.current[judged].size * newest.period < _JUDGED_TIME:
            return False
        new, used = (
            _root_mean_square(newest.residual_of(newest.force_of(each, self.gradual), judged))
            for each in (found, self._sets[0])
        )
        if new < used:
            return True
        self._sets[0] = replace(self._sets[0], confirmed_ns=found.confirmed_ns)
        return False

    # Choice by the measured force

    def forget_samples(self) -> None:
        """Discard the samples, because the next samples do not continue from them."""
        self._rows.keep(0)

    def follow(
        self,
        motion: Motion,
        current: Array | float,
        forces: tuple[Array, Array],
        period: float,
        half_cycle: float,
    ) -> None:
        """Keep the newest samples: motion, current [A], predicted and measured ``forces`` [N].

        Arrays have shape (n,); a force that was not measured is NaN. The samples are ``period`` [s]
        apart. ``half_cycle`` [s] of the motion is NaN if unknown.
        """
        count = motion.velocity.size
        self._since_search += count * period
        self._since_turning += count * period
        self._period = period
        self._half_cycle = 0.0 if math.isnan(half_cycle) else half_cycle
        self._rows.add((*motion.arrays, current, *forces), count)
        self._rows.keep(max(int(min(self._kept / period, 20 * _MOST_TRIED)), count))

    def _newest(self, time: float = math.inf) -> JudgedSamples:
        """The samples of the last ``time`` [s], subsampled if there are too many."""
        whole = int(min(max(time / self._period, 1.0), self._rows.count))
        stride = whole // _MOST_TRIED + 1
        rows = self._rows.newest[:, self._rows.count - whole :: stride]
        u, v, a, v_m, current, predicted, measured = rows
        motion = Motion(u, v, a, v_m, sine=None)
        return JudgedSamples(motion, current, predicted, measured, stride * self._period)

    def choice(self, kind: DoubtKind, allowed: float) -> Choice | None:
        """The set to use from now on, possibly with the other branch rule; None for no change.

        ``kind`` is the reason code of the newest sample. Searches for a set that reproduces the
        newest forces within an ``allowed`` error [N] are limited in rate. ``allowed`` is infinite
        if no force is measured.
        """
        known = self._rows.count * self._period
        wrong = kind in (DoubtKind.WRONG, DoubtKind.DRIVING)
        unsuitable = wrong or kind in (DoubtKind.OUT_OF_RANGE, DoubtKind.TOO_LARGE)
        if unsuitable and known >= _JUDGED_TIME and self._since_search >= 0.5 * _JUDGED_TIME:
            self._since_search = 0.0
            found = self._better(allowed, wrong=wrong)
            return self.with_other_branch_rule() if found is None and wrong else found
        # A start set says nothing about reversals, and no sample counts twice.
        evident = self._measured and self._sets[0].parameters.origin.is_evidence
        if not evident or self._since_turning < self._kept:
            return None
        return self.with_other_branch_rule()

    def _better(self, allowed: float, *, wrong: bool) -> Choice | None:
        """The set that reproduces the newest forces best.

        If the force of the present set is ``wrong``, that set is also tried, restarted from a new
        state. If no force is measured, the result is the set last used for this motion.
        """
        newest = self._newest(self._judged + 2.0 * _JUDGED_TIME)
        judged = slice(-max(round(self._judged / newest.period), 1), None)
        speed = float(np.median(newest.motion.peak_velocity[judged]))
        current = float(newest.current[-1])
        candidates = [each for each in self._sets[1:] if each.is_for(speed, current, self._margin)]
        if math.isinf(allowed):
            return (candidates[0], math.nan) if candidates else None
        limit = _root_mean_square(newest.residual_of(newest.predicted, judged))
        limit *= _BETTER_RATIO if wrong else 1.0
        best: Choice | None = None
        for each in (self._sets[0], *candidates) if wrong else candidates:
            left = newest.residual_of(newest.force_of(each, self.gradual), judged)
            error = _root_mean_square(left)
            if error < limit and float(np.max(np.abs(left))) <= allowed:
                best, limit = (each, error), error
        return best

    def with_other_branch_rule(self) -> Choice | None:
        """The present set, if the other branch rule fits the newest cycle better; else None.

        The other rule is used from now on. Returns None also if there is less than a half-cycle of
        samples, or if the law has a single branch rule. The rules give the same force except near
        reversals, so each error counts in proportion to the difference between the forces.
        """
        present = self._sets[0]
        law = present.parameters.law
        if law.continuous is law or not 0.0 < self._half_cycle <= self._rows.count * self._period:
            return None
        self._since_turning = 0.0
        newest = self._newest()
        residuals = [
            newest.residual_of(newest.force_of(present, gradual)) for gradual in (False, True)
        ]
        weights = np.abs(residuals[1] - residuals[0])
        weights /= weights.max(initial=1e-9)
        errors = [max(_root_mean_square(residual * weights), 1e-9) for residual in residuals]
        decides = -math.log(_BETTER_RATIO)
        shown = float(np.clip(math.log(errors[0] / errors[1]), -2.0 * decides, 2.0 * decides))
        self._turning = _EVIDENCE_DECAY * self._turning + shown
        if not (-self._turning if self.gradual else self._turning) > decides:
            return None
        self.gradual = not self.gradual
        return present, _root_mean_square(residuals[self.gradual])

    @property
    def _kept(self) -> float:
        """Time [s] of the newest samples that are kept: at least a cycle."""
        return max(2.0 * self._half_cycle, self._judged + 2.0 * _JUDGED_TIME)

    @property
    def _judged(self) -> float:
        """Time [s] over which a set is judged."""
        return _JUDGED_TIME * max(self._half_cycle, 1.0)


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
