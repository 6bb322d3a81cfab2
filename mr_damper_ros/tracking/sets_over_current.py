"""What is known of a damper at each current: the set of the newest windows there, and that for all.

A window at one current moves the scales so that the force is right there; what it says of other
currents is only as good as the law. So where the current goes to what no window of the set in use
had, the set of the newest windows at that current is taken up again. Where there is none, the set
for all operating points counts, times the damper's force of now over that of this set.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mr_damper_ros.models.parameter_set import EARLY_SOURCE, GLOBAL_SOURCE, ParameterSet
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS
from mr_damper_ros.tracking.known_set import KnownSet, Span, is_one, within

_MOST = 16
"""Currents at which a set is remembered."""

_RECENT_NS = 60 * NANOSECONDS
"""A damper that heats may change by a quarter in ten minutes: by a fortieth in this time."""

_LONGEST_NAME = 180
"""Characters of a name to which a factor is added."""


class SetsOverCurrent:
    """The sets of the newest windows at each current, and the set for all operating points."""

    def __init__(self) -> None:
        # The newest first.
        self._at: list[KnownSet] = []
        self._whole: KnownSet | None = None

    def add(self, found: KnownSet) -> None:
        """A set has come: one for all currents, or that of windows with its ``currents``."""
        if found.whole:
            self._whole = found
            return
        if found.parameters.source == EARLY_SOURCE:
            # The damper has changed at once: only its force is known, and only here.
            self._at.clear()
        if found.currents is not None:
            self.confirm(found, found.currents)

    def confirm(self, known: KnownSet, currents: Span) -> None:
        """The set fits a window of these currents: it is that of this current, if there is one."""
        if not is_one(currents):
            return
        middle = 0.5 * sum(currents)
        others = [each for each in self._at if not each.fits_at(middle)]
        self._at = [replace(known, currents=currents), *others][:_MOST]

    def at_current(self, current: float, now_ns: int) -> KnownSet | None:
        """The set of the newest windows at a current [A], unless that is long ago."""
        for each in self._at:
            age = math.inf if each.confirmed_ns is None else abs(now_ns - each.confirmed_ns)
            if each.fits_at(current) and age <= _RECENT_NS:
                return each
        return None

    def whole_at(self, current: float) -> KnownSet | None:
        """The set for all operating points, if a current [A] is among them."""
        whole = self._whole
        known = whole is not None and within(current, whole.parameters.current_range)
        return whole if known else None


def is_whole(parameters: ParameterSet, confirmed_ns: int | None) -> bool:
    """Whether a set is for all operating points, and no window's: searched for, or somebody's."""
    searched = parameters.source == GLOBAL_SOURCE or confirmed_ns is None
    return searched and parameters.law.knows_currents(parameters.observable)


def force_ratio(present: Array, whole: Array) -> float:
    """The force of now over that of the set for all (n,) [N], as far as this holds elsewhere, too.

    A law that does not follow the force exactly is off by another factor at each current: what the
    factor is off by is believed in as far as it stands out of what no factor explains.
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


def times_force(whole: ParameterSet, factor: float, present: ParameterSet) -> ParameterSet:
    """The set for all with so many times its force; it holds as fast as the ``present`` one."""
    values, errors = whole.values.copy(), whole.standard_errors.copy()
    strength = whole.law.strength_indices
    values[strength] *= factor
    errors[strength] *= factor
    slow, fast = present.peak_velocity_range
    known = whole.peak_velocity_range
    return replace(
        whole,
        values=values,
        standard_errors=errors,
        set_id=f"{whole.set_id[:_LONGEST_NAME]} x {factor:.3f}",
        peak_velocity_range=(slow, fast) if slow <= known[0] and known[1] <= fast else known,
        largest_force=float(np.fmax(whole.largest_force, present.largest_force)),
    )
