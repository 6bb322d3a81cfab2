"""Watch of a live stream: whether what leaves a program corresponds to what arrives, or why not.

A watch knows neither ROS nor a clock: it is told what arrives and what leaves, with the times by a
steady clock, and names the first cause that explains why values are lost or wrong. Every cause is a
finding of the table (:mod:`mr_damper_ros.data_check.findings`).
"""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np

from mr_damper_ros.data_check.findings import Finding, Kind
from mr_damper_ros.data_check.samples import Samples, unit_findings
from mr_damper_ros.signals.arrays import Array, RollingRows
from mr_damper_ros.signals.blocks import NANOSECONDS

_SLOT, _MEMORY = 0.1, 12.0
"""Length [s] of the slots in which arrivals are counted, and time [s] for which they are kept."""

_WINDOW = 1.0
"""Time [s] of the newest arrivals that are judged."""

_ENOUGH = 5
"""Smallest number of arrivals that are judged."""

_PART = 0.05
"""Largest part of the values that may be unusable without a finding."""

_FROZEN, _GROUPED, _ADVANCES = 0.8, 0.4, 0.3
"""Time [s] after which stamps that do not change are frozen; smallest part of the values that
repeat the last stamp in groups, in a second and in the last of these times [s]."""

_SILENT, _ABSENT = 1.2, 1.7
"""Time [s] after which a channel is missing while another arrives: one that has arrived before, and
one that has not. A channel with longer intervals is missing after three of them."""

_OTHER_CLOCK, _APART = 2.0, 0.2
"""Difference of the ages of two channels [s] that only different clocks explain, and the smallest
one that explains why no values are joined."""

_BEGINS = 1.5
"""Time [s] of arrivals and of their stamps, after which their values must leave: the sample period
is estimated from the first second."""

_SHARE = 0.7
"""Smallest part of the arriving values that must leave."""

_BLOCKS = 2.5
"""The values that leave are counted over at least so many blocks."""

_PAUSE, _LEAP = 0.5, (0.1, 0.2)
"""A stream that is silent for this time [s], or for ten intervals if that is longer, begins anew.
So it does after a leap of the stamps by more than the two times [s], back and ahead."""

_LEAP_SEEN = 0.3
"""Time [s] after a leap in which other channels may leap, too."""

_MIXED_TIME, _SWINGS, _ALTERNATING = 2.0, 3, 0.4
"""Two publishers are mixed if in this time [s] so many values differ from those before and after
them, which agree, and are stamped too early, or if this part of the values differs."""

_SWING, _SHORT = 4.0, 0.75
"""A value differs if it is away from its neighbours by this multiple of their difference. A stamp
is early if its interval is shorter than this part of the mean interval."""

_MOVES, _MOVES_FAST = 2e-3, 0.01
"""Smallest span [m] and root mean square velocity [m/s] of a motion that needs a force."""

_MOST_JUDGED = 1000
"""Largest number of samples whose units are judged."""

Publishers = Callable[[str], list[str]]
"""Names of the publishers of a topic."""


def _nobody(_: str) -> list[str]:
    return []


class _Slot:
    """Counts of the arrivals in a slot of time, and the smallest age [ns] among them."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.counts: Counter[str] = Counter()
        self.age_ns: int | None = None


class _Arrivals:
    """What has arrived on a channel, ``where`` (the topic or the address)."""

    def __init__(self, where: str) -> None:
        self.where = where
        self.reason = ""
        """Why the last unusable message cannot be used."""
        self.leap = 0.0
        """The last leap of the stamps [s]."""
        self.last = -math.inf
        """Time [s] of the last arrival."""
        self.stamp_ns = 0
        self._slots: deque[_Slot] = deque()
        self._values = (math.nan, math.nan)
        # Time [s] of the last change of the stamp, and number of values since.
        self._changed, self._since_change = -math.inf, 0
        # Time [s], stamp [ns] and number of arrivals since the stream began, or began anew.
        self._begin, self._begin_ns, self._count = math.inf, 0, 0
        # Silence [s] before the stream began anew.
        self._pause = 0.0

    @property
    def interval(self) -> float:
        """Mean interval [s] of the arrivals; 0 if it is unknown."""
        if self._count < 2:
            return self._pause
        return (self.last - self._begin) / (self._count - 1)

    @property
    def stamp_interval_ns(self) -> float:
        """Mean interval [ns] of the stamps; 0 if it is unknown."""
        return (self.stamp_ns - self._begin_ns) / (self._count - 1) if self._count > 1 else 0.0

    def flows(self, time: float, since: float, *, stamped: bool = True) -> bool:
        """Whether values have arrived for so long [s], and if ``stamped`` also by their stamps."""
        by_stamps = (self.stamp_ns - self._begin_ns) / NANOSECONDS
        slow = stamped and self.stamp_ns != 0 and by_stamps < since
        return self._is_present(time) and time - self._begin >= since and not slow

    def _is_present(self, time: float) -> bool:
        return time - self.last < max(_PAUSE, 3.0 * self.interval)

    def note(self, what: str, time: float, count: int = 1) -> _Slot:
        """Count something by name; returns the slot of the time."""
        number = math.floor(time / _SLOT)
        if not self._slots or self._slots[-1].number < number:
            self._slots.append(_Slot(number))
            while self._slots[0].number < number - _MEMORY / _SLOT:
                self._slots.popleft()
        slot = self._slots[-1]
        slot.counts[what] += count
        return slot

    def add(self, time: float, stamp_ns: int | None, value: float, count: int) -> None:
        """Add values that arrived together; ``stamp_ns`` is None if they are not stamped."""
        slot = self.note("received", time, count)
        was_frozen = self.is_frozen(time)
        if stamp_ns != self.stamp_ns or stamp_ns == 0:
            self._changed, self._since_change = time, 0
        self._since_change += 1
        if not math.isfinite(value):
            slot.counts["not_finite"] += count
        if time - self.last > max(_PAUSE, 10.0 * self.interval):
            self._begin_anew(time, stamp_ns or 0)
        elif stamp_ns == 0:
            slot.counts["unstamped"] += 1
        elif stamp_ns is not None:
            self._compare(slot, time, stamp_ns, value)
            if was_frozen and stamp_ns != self.stamp_ns:
                slot.counts["leaps"] = 0  # the stamps only catch up
        self._count += 1
        self.last = time
        if stamp_ns is None:
            return
        self.stamp_ns = stamp_ns
        age_ns = round(time * NANOSECONDS) - stamp_ns
        slot.age_ns = age_ns if slot.age_ns is None else min(slot.age_ns, age_ns)

    def _begin_anew(self, time: float, stamp_ns: int) -> None:
        self._pause = time - self.last if self._count else 0.0
        self._begin, self._begin_ns, self._count = time, stamp_ns, 0
        self._values = (math.nan, math.nan)

    def _compare(self, slot: _Slot, time: float, stamp_ns: int, value: float) -> None:
        """Compare a value with the last two."""
        since_ns = stamp_ns - self.stamp_ns
        before, last = self._values
        usual_ns = self.stamp_interval_ns
        slot.counts["advanced"] += since_ns != 0
        if since_ns == 0:
            slot.counts["same"] += 1
            # The same message sent again is no fault.
            slot.counts["repeated"] += value != last
        if since_ns < _SHORT * usual_ns:
            slot.counts["early"] += 1
        if abs(last - 0.5 * (before + value)) > _SWING * abs(value - before):
            slot.counts["swings"] += 1
        self._values = (last, value)
        step = since_ns / NANOSECONDS
        passed = time - self.last
        back, ahead = _LEAP
        if step < -back or step - passed > ahead + 10.0 * usual_ns / NANOSECONDS:
            slot.counts["leaps"] += 1
            self.leap = step - passed
            self._begin_anew(time, stamp_ns)

    def is_silent(self, time: float) -> bool:
        """Whether no value has arrived for some intervals."""
        return time - self.last > max(_SLOT, 3.0 * self.interval)

    def is_frozen(self, time: float) -> bool:
        """Whether values arrive, but their stamp has not changed for some time."""
        same = self._since_change >= _ENOUGH and time - self._changed > _FROZEN
        return same and self._is_present(time)

    def is_grouped(self, time: float) -> bool:
        """Whether many values have the stamp of the value before, but the stamps advance."""
        counts, newest = self.counts(time), self.counts(time, _ADVANCES)
        many = all(each["repeated"] > _GROUPED * each["received"] for each in (counts, newest))
        return many and counts["received"] - counts["same"] >= _ENOUGH and newest["advanced"] > 0

    def counts(self, time: float, window: float = _WINDOW) -> Counter[str]:
        """The counts of the last ``window`` [s]."""
        found: Counter[str] = Counter()
        for slot in reversed(self._slots):
            if slot.number < math.floor((time - window) / _SLOT):
                break
            found.update(slot.counts)
        return found

    def age(self, time: float) -> float:
        """Smallest difference [s] between arrival and stamp in the last two slots, else NaN."""
        first = math.floor(time / _SLOT) - 2
        ages = [s.age_ns for s in self._slots if s.number >= first and s.age_ns is not None]
        return min(ages) / NANOSECONDS if ages else math.nan


class StreamWatch:
    """Watch of the ``channels`` (name and topic or address), which are joined to samples.

    Samples are made at the rate of the last channel. ``own_clocks``: each channel may have its own
    clock. ``block`` is the number of samples in a block; with 0, what leaves is not judged.
    ``publishers`` names the publishers of a topic. All times are those of a steady clock [s]. The
    methods may be called by several threads.
    """

    def __init__(
        self,
        channels: Mapping[str, str],
        *,
        own_clocks: bool = False,
        block: int = 0,
        publishers: Publishers = _nobody,
    ) -> None:
        self._arrivals = {name: _Arrivals(where) for name, where in channels.items()}
        self._own_clocks = own_clocks
        self._block = block
        self._publishers = publishers
        self._left = _Arrivals("")
        self._rows = RollingRows(2)
        self._period = math.nan
        # Callbacks, the sender and the diagnostics run in different threads.
        self._lock = threading.Lock()

    # What arrives and what leaves

    def arrive(
        self, channel: str, time: float, stamp_ns: int | None, value: float, count: int = 1
    ) -> None:
        """Note the arrival of a value, or of ``count`` values of which ``value`` is the first.

        ``stamp_ns`` is 0 if the message has no stamp, and None on a channel without stamps.
        """
        with self._lock:
            self._arrivals[channel].add(time, stamp_ns, value, count)

    def note(self, channel: str, what: str, time: float, count: int) -> None:
        """Count something by name, for :meth:`counts`."""
        with self._lock:
            self._arrivals[channel].note(what, time, count)

    def reject(self, channel: str, time: float, reason: str) -> None:
        """Note a message that cannot be used, with the ``reason`` and what to change."""
        with self._lock:
            arrivals = self._arrivals[channel]
            arrivals.note("rejected", time)
            arrivals.reason = reason

    def leave(self, time: float, period: float, displacement: Array, force: Array) -> None:
        """Note samples (n,) that leave, ``period`` [s] apart."""
        with self._lock:
            self._left.note("received", time, force.size)
            self._left.last = time
            if period != self._period:
                self._rows, self._period = RollingRows(2), period
            self._rows.add((displacement, force), force.size)
            self._rows.keep(round(max(_WINDOW / period, 2 * _ENOUGH)))

    # What is wrong

    def counts(self, channel: str, time: float) -> Counter[str]:
        """What was counted in the last second, by name, such as "received" and "rejected"."""
        with self._lock:
            return self._arrivals[channel].counts(time)

    def pace(self, channel: str, time: float) -> tuple[float, float]:
        """Values per second, and seconds of their stamps per second; NaN in the first 1.5 s."""
        with self._lock:
            arrivals = self._arrivals[channel]
            if not arrivals.flows(time, _BEGINS, stamped=False):
                return math.nan, math.nan
            rate = arrivals.counts(time, _BEGINS)["received"] / (_BEGINS + 0.5 * _SLOT)
            interval = arrivals.interval
            speed = arrivals.stamp_interval_ns / (interval * NANOSECONDS) if interval else math.nan
            return rate, speed

    def findings(self, time: float) -> list[Finding]:
        """Why what leaves does not correspond to what arrives, the first cause first."""
        with self._lock:
            return list(self._findings(time))

    def _findings(self, time: float) -> Iterator[Finding]:
        for name, arrivals in self._arrivals.items():
            yield from self._mixed(name, arrivals, time)
            yield from _unusable(name, arrivals, time)
        yield from self._missing(time)
        yield from self._other_clock(time, _OTHER_CLOCK)
        for name, arrivals in self._arrivals.items():
            leaps = arrivals.counts(time, 2.0 * _WINDOW)["leaps"]
            if self._block and leaps > arrivals.counts(time, _LEAP_SEEN)["leaps"]:
                yield Kind.CLOCK_SET.found(name, topic=arrivals.where, leap=arrivals.leap)
        if self._holds_up(time):
            yield from self._other_clock(time, _APART)
            yield self._unpublished(time)
        if time - self._left.last < _WINDOW:
            yield from self._units()

    def _mixed(self, name: str, arrivals: _Arrivals, time: float) -> Iterator[Finding]:
        counts = arrivals.counts(time, _MIXED_TIME)
        swings = counts["swings"]
        if swings < _SWINGS:
            return
        if counts["early"] < _SWINGS and swings < _ALTERNATING * counts["received"]:
            return
        names = self._publishers(arrivals.where)
        if len(names) > 1:
            yield several_publishers(arrivals.where, names)

    def _missing(self, time: float) -> Iterator[Finding]:
        """A channel that is silent while another one arrives."""
        for name, arrivals in self._arrivals.items():
            allowed = max(_SILENT, 3.0 * arrivals.interval)
            if math.isinf(arrivals.last):
                allowed = _ABSENT
            if time - arrivals.last <= allowed:
                continue
            for present in self._arrivals.values():
                if present.where != arrivals.where and present.flows(time, allowed - _SLOT):
                    other = present.where
                    yield Kind.CHANNEL_SILENT.found(name, topic=arrivals.where, other=other)
                    break

    def _other_clock(self, time: float, least: float) -> Iterator[Finding]:
        """Channels whose stamps are at least so far apart [s]."""
        if self._own_clocks or len(self._arrivals) < 2:
            return
        (first, one), *others = self._arrivals.items()
        for name, other in others:
            apart = one.age(time) - other.age(time)
            counts = [each.counts(time)["received"] for each in (one, other)]
            if abs(apart) > least and min(counts) >= _ENOUGH:
                yield Kind.CLOCKS_APART.found(name, value=apart, other=first, apart=abs(apart))

    @property
    def _leader(self) -> tuple[str, _Arrivals]:
        return list(self._arrivals.items())[-1]

    def _holds_up(self, time: float) -> bool:
        """Whether values have arrived for long enough that samples must leave, and too few do."""
        arrivals = self._leader[1]
        if not self._block:
            return False
        window = max(_WINDOW, _BLOCKS * self._block * arrivals.interval)
        if window > _MEMORY or not arrivals.flows(time, _BEGINS + window - _WINDOW):
            return False
        if any(each.is_silent(time) for each in self._arrivals.values()):
            return False  # the cause will be known soon
        arrived, left = self._arrived_and_left(arrivals, time, window)
        return arrived >= _ENOUGH and left < _SHARE * arrived

    def _arrived_and_left(self, arrivals: _Arrivals, time: float, window: float) -> tuple[int, int]:
        """Number of different values that arrived in the last ``window`` [s], and that left."""
        counts = arrivals.counts(time, window)
        arrived = counts["received"] - counts["same"] + counts["repeated"]
        return arrived, self._left.counts(time, window)["received"]

    def _unpublished(self, time: float) -> Finding:
        name, arrivals = self._leader
        window = max(_WINDOW, _BLOCKS * self._block * arrivals.interval)
        arrived, left = self._arrived_and_left(arrivals, time, window)
        share = left / arrived
        return Kind.UNPUBLISHED.found(name, value=share, share=share, topic=arrivals.where)

    def _units(self) -> Iterator[Finding]:
        displacement, force = self._rows.newest
        if force.size < 2 * _ENOUGH or not math.isfinite(float(displacement.sum() + force.sum())):
            return
        stride = -(-force.size // _MOST_JUDGED)
        moved, period = displacement[::stride], stride * self._period
        speed = math.sqrt(float(np.mean(np.diff(moved) ** 2))) / period
        moves = float(np.ptp(moved)) > _MOVES and speed > _MOVES_FAST
        samples = Samples(moved, force[::stride], np.zeros(moved.size), period)
        for found in unit_findings(samples, moves=moves):
            if found.channel != "time":
                yield found


def _unusable(name: str, arrivals: _Arrivals, time: float) -> Iterator[Finding]:
    """Findings on the values and stamps of one channel."""
    counts = arrivals.counts(time)
    received, rejected = counts["received"], counts["rejected"]
    where = arrivals.where
    # Messages of other joints on the same topic are no fault.
    if rejected >= _ENOUGH and not received:
        yield Kind.UNUSABLE.found(name, count=rejected, reason=arrivals.reason, topic=where)
    if received < _ENOUGH:
        return
    bad = counts["not_finite"]
    if bad > _PART * received:
        yield Kind.NOT_FINITE.found(name, count=bad)
    if counts["unstamped"] > _PART * received:
        yield Kind.NO_STAMPS.found(name, topic=where)
    if arrivals.is_frozen(time):
        yield Kind.FROZEN_STAMPS.found(name, topic=where)
    elif arrivals.is_grouped(time):
        size = received / max(received - counts["same"], 1)
        yield Kind.GROUPED_STAMPS.found(name, value=size, size=size, topic=where)


def several_publishers(topic: str, names: Iterable[str]) -> Finding:
    """The finding on a topic with publishers of these names, whose values are mixed."""
    return Kind.SEVERAL_PUBLISHERS.found(topic=topic, names=listed(names))


def listed(names: Iterable[str]) -> str:
    """The names of publishing nodes in words; two with the same name may be one that was killed."""
    found = sorted(names)
    repeated = len(set(found)) < len(found)
    killed = " (a killed node stays listed for up to a minute)" if repeated else ""
    return " and ".join(found) + killed


_AGAIN = 10.0
"""A finding that was absent for this time [s] is new when it appears again."""


class NewFindings:
    """Selects the findings that are new, so that each is reported once."""

    def __init__(self) -> None:
        self._seen: dict[tuple[Kind, str], float] = {}

    def of(self, findings: Iterable[Finding], time: float) -> list[Finding]:
        """The findings that have not been present recently; ``time`` [s] of a steady clock."""
        new = []
        for finding in findings:
            key = finding.kind, finding.channel
            if time - self._seen.get(key, -math.inf) > _AGAIN:
                new.append(finding)
            self._seen[key] = time
        return new
