"""The sets known of a damper, each for its motions, and which of them gives the measured force.

A set that a window was fitted with holds at its peak velocity and its current, and often nowhere
else. So those before are remembered: where the motion, or the current
(:mod:`mr_damper_ros.tracking.sets_over_current`), comes back to what one of them is for, the force
is that set's at once, without waiting for the identification. The measured force decides; it also
tells whether the force of this damper jumps where the motion turns.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mr_damper_ros.kinematics.motion import Motion
from mr_damper_ros.models.force_model import ForceStream
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.tracking.judged_samples import JudgedSamples
from mr_damper_ros.tracking.known_set import (
    SAME_CURRENT,
    KnownSet,
    Span,
    joined,
    within,
)
from mr_damper_ros.tracking.newest_samples import NewestSamples
from mr_damper_ros.tracking.sets_over_current import (
    SetsOverCurrent,
    force_ratio,
    is_whole,
    times_force,
)

_MOST = 8
"""Sets that are remembered; each is tried out."""

_SETTLES = 0.2
"""Seconds of motion in which a set settles before it is judged ..."""

_JUDGED = 0.1
"""... in the last so many, or ..."""

_PART = 0.1
"""... this part of a half-cycle, if that is more."""

_EVERY = 0.05
"""Seconds between two searches: each costs as much as some blocks of prediction."""

_TURNING_EVERY = 5.0
"""Seconds between two looks at how the force turns."""

_BETTER = 0.6
"""What takes over from a force that is wrong leaves less than this part of its error."""

_MOST_SHOWN, _STILL = 1.0, 0.5
"""How a force turns one cycle may hardly show: it says so much at most, half at the next look."""


class Choice(NamedTuple):
    """A set to go on with, and what it leaves of the newest forces [N]; NaN where none came."""

    chosen: KnownSet
    error: float


class KnownSets:
    """Remembers the sets that were in use, and the newest samples.

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
        self._samples = NewestSamples()
        self._period = math.nan
        self._half_cycle = 0.0
        self._since_search = math.inf
        self._since_turning = 0.0
        self._turning = 0.0  # log of the error of a jumping force over that of a gradual one
        self._over_current = SetsOverCurrent()
        # The present current [A], that which the identification found last, and whether another
        # is in use for the present current.
        self._current = math.nan
        self._found: KnownSet | None = None
        self._elsewhere = False
        # What is said to fit a window may come before the set itself.
        self._said: tuple[str, Span | None] = ("", None)

    @property
    def present(self) -> KnownSet | None:
        """The set in use; None before one has come."""
        return self._sets[0] if self._sets else None

    def confirm(self, set_id: str, stamp_ns: int, currents: Span | None) -> bool:
        """Take note that the set of this name fits the samples of a window up to the stamp.

        ``currents``: the lowest and the highest [A] in it, None where they are not known. Returns
        whether it takes the place of the set in use.
        """
        self._said = set_id, currents
        self._sets = [self._confirmed(each, set_id, stamp_ns, currents) for each in self._sets]
        found = self._found
        if found is None or found.parameters.set_id != set_id or currents is None:
            return False
        self._found = found = self._confirmed(found, set_id, stamp_ns, currents)
        self._over_current.confirm(found, currents)
        if not self._elsewhere or not self._takes_over(found):
            return False
        self._take(found)
        return True

    @staticmethod
    def _confirmed(each: KnownSet, set_id: str, stamp_ns: int, currents: Span | None) -> KnownSet:
        if each.parameters.set_id != set_id:
            return each
        # One that does not age goes on so.
        stamp = None if each.confirmed_ns is None else stamp_ns
        return replace(each, confirmed_ns=stamp, currents=joined(each.currents, currents))

    def add(self, parameters: ParameterSet, stamp_ns: int | None, half_cycle: float) -> None:
        """Remember a set that has come and is in use now, unless another is for the current of now.

        The stamp and ``half_cycle`` are those of :class:`KnownSet`. One of no age was given by a
        user. What is known besides is forgotten when one is given, for one that is no younger, of
        another law, or a mere start; but a set without evidence never displaces a given one, and
        one for fewer currents only once the given one is wrong.
        """
        given = self._given
        if given is not None and not parameters.has_evidence:
            if not self._is_given(self.present):
                self._forget(given)
            return
        if stamp_ns is None:
            parameters = parameters.as_given()
        model = parameters.model
        aged = stamp_ns is not None and self._newest_ns is not None and stamp_ns > self._newest_ns
        if not aged or any(
            each.parameters.model != model for each in self._sets if not self._is_given(each)
        ):
            self._forget(given if stamp_ns is not None else None)
        self._newest_ns = stamp_ns
        set_id, currents = self._said
        whole = is_whole(parameters, stamp_ns)
        if whole:
            # For all currents: the next one may have a set of its own.
            currents = None if math.isnan(self._current) else (self._current, self._current)
        elif set_id != parameters.set_id:
            currents = None
        found = KnownSet(parameters, stamp_ns, half_cycle, currents, whole)
        if stamp_ns is None:
            self._given = found if parameters.has_evidence else None
        elif self._is_given(self.present) and not found.covers(self._sets[0]):
            others = [each for each in self._sets[1:] if not found.replaces(each)]
            self._sets = [self._sets[0], found, *others][:_MOST]
            return
        self._found = found
        self._over_current.add(found)
        if self._sets and self._elsewhere and not self._takes_over(found):
            self._sets.insert(1, found)
            del self._sets[_MOST:]
        else:
            self._take(found)

    def is_in_use(self, parameters: ParameterSet) -> bool:
        """Whether a set is the given one that is in use already."""
        known = self._given.parameters if self._is_given(self.present) and self._given else None
        return (
            known is not None
            and (known.set_id, known.model) == (parameters.set_id, parameters.model)
            and np.array_equal(known.values, parameters.values)
        )

    def _is_given(self, known: KnownSet | None) -> bool:
        given = self._given
        return given is not None and known is not None and known.parameters is given.parameters

    def _forget(self, given: KnownSet | None) -> None:
        """Forget all that is known but the set that a user gave, which is in use then."""
        self._sets = [] if given is None else [given]
        self._given, self._found = given, None
        self._elsewhere = False
        self._over_current = SetsOverCurrent()
        if given is not None and given.whole:
            self._over_current.add(given)

    def use(self, chosen: KnownSet) -> None:
        """Take note that this set is in use now, whatever the current of its windows."""
        if not (chosen.fits_at(self._current) or math.isnan(self._current)):
            here = self._current, self._current
            chosen = replace(chosen, currents=joined(chosen.currents, here))
        self._take(chosen)

    def _take(self, chosen: KnownSet) -> None:
        others = [each for each in self._sets if not chosen.replaces(each)]
        self._sets = [chosen, *others][:_MOST]
        if self._given is not None and not any(map(self._is_given, self._sets)):
            self._sets[_MOST - 1 :] = [self._given]
        self._elsewhere = False

    def is_elsewhere(self, current: float) -> bool:
        """Whether no window of the set in use had this current [A]."""
        return bool(self._sets) and not self._sets[0].fits_at(current)

    def follow_current(self, current: float, now_ns: int) -> bool:
        """Go on with what is known of a current [A]; whether another set is in use for it now."""
        before, self._current = self._current, current
        if not self.is_elsewhere(current):
            return False
        present = self._sets[0]
        chosen = self._over_current.at_current(current, now_ns)
        if chosen is None or not self._holds_after(chosen, before, current):
            chosen = self._whole_now(current)
        if chosen is None:
            # Nothing better is known: the law says what the force is there.
            self.use(present)
            return False
        self._take(chosen)
        self._elsewhere = True
        return chosen.parameters is not present.parameters

    def _holds_after(self, chosen: KnownSet, before: float, current: float) -> bool:
        """Whether a set is for the motion of now, and for the current [A] from which it goes on."""
        remembers = chosen.parameters.law.remembers
        return chosen.is_for(self._speed(), current, self._margin) and (
            not remembers or within(before, chosen.parameters.current_range)
        )

    def _whole_now(self, current: float) -> KnownSet | None:
        """The set for all currents, with the force that the damper has now."""
        whole, present = self._over_current.whole_at(current), self._sets[0]
        if whole is None:
            return None
        parameters = whole.parameters
        if present.whole:
            parameters = present.parameters  # with the force of when it took over
        elif self._samples:
            newest = self._samples.last(math.inf)
            low, high = parameters.current_range
            known = (newest.current >= low - SAME_CURRENT) & (newest.current <= high + SAME_CURRENT)
            now, all_along = (
                self._force(each, newest, self.gradual)[known] for each in (present, whole)
            )
            factor = force_ratio(now, all_along)
            parameters = times_force(parameters, factor, present.parameters)
        here = current, current
        return replace(present, parameters=parameters, currents=here, whole=True)

    def _takes_over(self, found: KnownSet) -> bool:
        """Whether a set for the newest window is better at the present current than the one chosen.

        If not, that one fits the window as well.
        """
        if found.whole or found.currents is None:
            return True
        if not found.fits_at(self._current):
            return False
        if not self._measured or not self._samples:
            return True
        newest = self._samples.last(math.inf)
        elsewhere = np.abs(newest.current - self._current) > SAME_CURRENT
        first = newest.current.size - int(np.argmax(elsewhere[::-1])) if elsewhere.any() else 0
        if (newest.current.size - first) * newest.stride * self._period < _JUDGED:
            return False
        judged = slice(first, None)
        errors = [
            _root_mean_square(newest.left_by(self._force(each, newest, self.gradual), judged))
            for each in (found, self._sets[0])
        ]
        if errors[0] < errors[1]:
            return True
        self._sets[0] = replace(self._sets[0], confirmed_ns=found.confirmed_ns)
        return False

    def _speed(self) -> float:
        """Root mean square of the peak velocity [m/s] of the newest samples; NaN without any."""
        if not self._samples:
            return math.nan
        return _root_mean_square(self._samples.last(math.inf).motion.peak_velocity)

    def forget_samples(self) -> None:
        """Others do not go on from them."""
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
        count = forces[1].size
        self._since_search += count * period
        self._since_turning += count * period
        self._period = period
        self._half_cycle = 0.0 if math.isnan(half_cycle) else half_cycle
        span = max(2.0 * self._half_cycle, self._judged + _SETTLES)
        self._samples.add(JudgedSamples.of(motion, current, forces, bridged), span / period)

    def search_is_due(self) -> bool:
        """Whether it is time to look for another set: not every time that the force is wrong."""
        if not self._samples.count or self._since_search < _EVERY:
            return False
        self._since_search = 0.0
        return True

    def look_at_turning_is_due(self) -> bool:
        """Whether it is time to look how the force turns, though it is not wrong."""
        if not self._measured or self._since_turning < _TURNING_EVERY:
            return False
        self._since_turning = 0.0
        return True

    def another(self, allowed: float, *, wrong: bool) -> Choice | None:
        """The set that gives the newest forces, within an ``allowed`` error [N]; None for none.

        ``wrong``: the present one does not; else it is for other motions only. An infinite error
        is allowed where no force is measured: the set last used for the motion is then taken. Where
        the present force goes on from a wrong past, it is the present set that starts again.
        """
        present = self._sets[0]
        newest = self._samples.last((self._judged + _SETTLES) / self._period)
        judged = slice(-max(round(self._judged / self._period / newest.stride), 1), None)
        speed = float(np.median(newest.motion.peak_velocity[judged]))
        candidates = [
            each
            for each in self._sets
            if each is not present and each.is_for(speed, float(newest.current[-1]), self._margin)
        ]
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
        newest = self._samples.last(math.inf)
        left = [
            max(_root_mean_square(newest.left_by(self._force(present, newest, gradual))), 1e-9)
            for gradual in (False, True)
        ]
        shown = min(max(math.log(left[0] / left[1]), -_MOST_SHOWN), _MOST_SHOWN)
        self._turning = _STILL * self._turning + shown
        if not (-self._turning if self.gradual else self._turning) > -math.log(_BETTER):
            return None
        self.gradual = not self.gradual
        return Choice(present, left[self.gradual])

    def settled_stream(self, chosen: KnownSet) -> ForceStream:
        """A stream of the set's force that has followed the newest samples."""
        newest = self._samples.every_one_of_the_last((self._judged + _SETTLES) / self._period)
        stream = self._stream(chosen, self._period, self.gradual)
        held = chosen.parameters.held(newest.motion)
        stream.follow(chosen.parameters.values, held, newest.current)
        return stream

    @property
    def _judged(self) -> float:
        return max(_JUDGED, _PART * self._half_cycle)

    def _stream(self, chosen: KnownSet, period: float, gradual: bool) -> ForceStream:
        law = chosen.parameters.law
        return (law.continuous if gradual else law).stream(period)

    def _force(self, chosen: KnownSet, newest: JudgedSamples, gradual: bool) -> Array:
        held = chosen.parameters.held(newest.motion)
        stream = self._stream(chosen, self._period * newest.stride, gradual)
        return stream.follow(chosen.parameters.values, held, newest.current)


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
