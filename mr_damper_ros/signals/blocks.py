"""Stamped samples as they arrive: blocks, what their stamps can hold, and the held current."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array

NANOSECONDS = 1_000_000_000

LATE_NS = NANOSECONDS
"""A stamp up to this far back is late, or came before; further back, time itself was set back."""

_SHORTEST_PERIOD, _LONGEST_PERIOD = 1e-9, 1e6
"""Stamps count nanoseconds, and seconds in 31 bits."""


_LARGEST = 1e12
"""No press moves so many metres or pulls so many newtons, and squares of it are still numbers."""


MOST_SAMPLES = 5000
"""A block that a node takes in holds at most so many samples: the work on each is bounded."""

LONGEST_BLOCK = 10.0
"""And stands for at most so long [s]: from what it says, so many windows are cut at once."""

_LIVE_PERIODS = (1e-5, 1.0)
"""Sample periods [s] that a node takes in: from each, the samples of a window are reckoned."""


class BlockError(ValueError):
    """A block that cannot be used; the message says what is wrong with it."""


def check_live(block: SampleBlock) -> None:
    """Raise BlockError where a block would hold up a node that must answer meanwhile.

    Files are read without these limits.
    """
    if block.sample_count > MOST_SAMPLES:
        raise BlockError(
            f"the block holds {block.sample_count} samples: send them in blocks of at most "
            f"{MOST_SAMPLES}"
        )
    shortest, longest = _LIVE_PERIODS
    if not shortest <= block.period <= longest:
        raise BlockError(
            f"the sample period is {block.period:g} s: from {shortest:g} to {longest:g} s can be "
            "used; is it in seconds?"
        )
    duration = block.sample_count * block.period
    if duration > LONGEST_BLOCK:
        raise BlockError(
            f"the block lasts {duration:g} s: send blocks of at most {LONGEST_BLOCK:g} s"
        )


@dataclass(frozen=True, eq=False)
class SampleBlock:
    """Samples of displacement [m] and force [N], arrays of shape (n,), ``period`` [s] apart.

    ``start_ns`` is the stamp of sample 0, ``sequence`` its index since the source started.

    Raises BlockError where there are no samples, lengths differ, a value is not finite or beyond
    all measure, or the period is not positive or beyond what stamps can follow.
    """

    start_ns: int
    sequence: int
    period: float
    displacement: Array
    force: Array

    def __post_init__(self) -> None:
        n = self.displacement.size
        if n == 0:
            raise BlockError("the block holds no samples")
        if self.force.size != n:
            raise BlockError(f"the block holds {n} displacements but {self.force.size} forces")
        if not _SHORTEST_PERIOD <= self.period <= _LONGEST_PERIOD:
            raise BlockError(
                f"the sample period is {self.period} s: it must be positive, "
                f"from {_SHORTEST_PERIOD:g} to {_LONGEST_PERIOD:g} s"
            )
        for name in ("displacement", "force"):
            values = getattr(self, name)
            possible = np.abs(values) <= _LARGEST
            if np.count_nonzero(possible) != n:
                index = int(np.argmin(possible))
                what = f"is {values[index]:g}" if np.isfinite(values[index]) else "is not finite"
                raise BlockError(f"the {name} of sample {index} of the block {what}")

    @cached_property
    def sample_count(self) -> int:
        """Number of samples."""
        return int(self.displacement.size)

    @cached_property
    def end_ns(self) -> int:
        """Stamp at which the next block should start."""
        return self.start_ns + round(self.sample_count * self.period * NANOSECONDS)

    def part(self, first: int, end: int | None = None) -> SampleBlock:
        """The samples from number ``first`` on, up to the one before ``end``."""
        return replace(
            self,
            start_ns=self.start_ns + round(first * self.period * NANOSECONDS),
            sequence=self.sequence + first,
            displacement=self.displacement[first:end],
            force=self.force[first:end],
        )


def joined(blocks: Iterable[SampleBlock]) -> list[SampleBlock]:
    """The same samples in as few blocks as can hold them: one for each stretch without a break."""
    runs: list[list[SampleBlock]] = []
    for block in blocks:
        if runs and _follows(runs[-1][-1], block):
            runs[-1].append(block)
        else:
            runs.append([block])
    return [_one(run) for run in runs]


def _follows(last: SampleBlock, block: SampleBlock) -> bool:
    late = abs(block.start_ns - last.end_ns) / NANOSECONDS
    return (
        block.period == last.period
        and block.sequence == last.sequence + last.sample_count
        and late <= 0.5 * block.period
    )


def _one(run: list[SampleBlock]) -> SampleBlock:
    first = run[0]
    if len(run) == 1:
        return first
    return SampleBlock(
        first.start_ns,
        first.sequence,
        first.period,
        np.concatenate([block.displacement for block in run]),
        np.concatenate([block.force for block in run]),
    )


STAMP_LIMIT = 2**31 * NANOSECONDS
"""Nanoseconds that a stamp cannot hold any more: its seconds are a signed 32-bit number."""


def fits_a_stamp(nanoseconds: int) -> bool:
    """Whether a stamp can hold so many nanoseconds since the epoch."""
    return -STAMP_LIMIT <= nanoseconds < STAMP_LIMIT


class Moment(NamedTuple):
    """The motion of a suspension, upwards positive.

    Velocities of ``body`` and ``wheel`` [m/s], the body's ``acceleration`` [m/s²], and how far body
    and wheel are ``apart`` from where they rest [m], the wheel from the road (``tyre``) [m].
    """

    body: float
    wheel: float
    acceleration: float = 0.0
    apart: float = 0.0
    tyre: float = 0.0

    @property
    def extension(self) -> float:
        """Velocity [m/s] with which the damper extends."""
        return self.body - self.wheel


@dataclass(frozen=True, eq=False)
class RigBlock:
    """Samples that follow those before: ``displacement`` [m], ``force`` [N], ``current`` [A].

    Arrays have shape (n,), ``period`` [s] apart; ``start_ns`` is the stamp of sample 0,
    ``sequence`` its index since the start. ``temperature`` [°C] has shape (n,) too, NaN where it
    is not known; so is a current that the supply does not report. ``ahead_ns`` is how far
    a wrong clock of the samples is ahead, and ``supply_ahead_ns`` that of the supply beside it.
    ``suspension`` is the motion at the last sample where the damper is in one.
    """

    start_ns: int
    sequence: int
    period: float
    displacement: Array
    force: Array
    current: Array
    temperature: Array
    ahead_ns: int = 0
    supply_ahead_ns: int = 0
    suspension: Moment | None = None

    @property
    def sample_count(self) -> int:
        """Number of samples."""
        return self.force.size

    def stamp_ns(self, index: int) -> int:
        """Stamp [ns] of a sample."""
        return self.start_ns + round(index * self.period * NANOSECONDS)

    @property
    def due_ns(self) -> int:
        """When the last sample was measured, by a right clock [ns]; of no samples, the stamp."""
        return self.stamp_ns(max(self.sample_count - 1, 0)) - self.ahead_ns

    def without_samples(self) -> RigBlock:
        """A block with the stamp of the last sample and no samples: none of them was sent."""
        return replace(
            self,
            start_ns=self.stamp_ns(self.sample_count - 1),
            displacement=_NONE,
            force=_NONE,
            current=_NONE,
            temperature=_NONE,
        )


_NONE: Array = np.empty(0)


KEEP_CURRENT = 3600.0
"""Seconds of values that a stream keeps: where a bag is played as fast as it goes, the current may
come far ahead of the samples that it belongs to."""

_SURPLUS = 8
"""One part in so many may be older than what is kept: to let go of them moves all the others, which
takes milliseconds where an hour of a fast supply is kept."""


class CurrentError(ValueError):
    """A value of the current that cannot be used; the message says why."""


class ZeroOrderHold:
    """Stamped values of the supply current, held from each stamp to the next."""

    def __init__(self, keep: float) -> None:
        """Keep at least the last ``keep`` seconds of values; infinite: all of them."""
        self._keep_ns = round(min(keep * NANOSECONDS, 2.0**62))
        self._stamps = array("q")
        self._values = array("d")
        self._jumped = False

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the newest value; None before the first."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp_ns: int, current: float) -> None:
        """Add a value [A]; one that jumps back in time takes the place of all that came after.

        A value that is only late takes its place among the others. Raises CurrentError for one
        that is not finite.
        """
        if not math.isfinite(current):
            raise CurrentError(f"the current is {current}: it must be a finite number")
        place = bisect_left(self._stamps, stamp_ns)
        back_ns = self._stamps[-1] - stamp_ns if self._stamps else 0
        if back_ns > LATE_NS:
            self._jumped = True
            del self._stamps[place:], self._values[place:]
        elif place < len(self._stamps) and self._stamps[place] == stamp_ns:
            del self._stamps[place], self._values[place]
        self._stamps.insert(place, stamp_ns)
        self._values.insert(place, current)
        # One value older than the horizon stays: it holds up to the next.
        surplus = bisect_right(self._stamps, self._stamps[-1] - self._keep_ns) - 1
        if surplus > len(self._stamps) // _SURPLUS:
            del self._stamps[:surplus], self._values[:surplus]

    def follow_jump(self) -> None:
        """Forget the values of the time before, now that the samples have jumped back.

        If the current jumped first, its values are those of the new time already.
        """
        if not self._jumped:
            del self._stamps[:], self._values[:]
        self._jumped = False

    def known_from(self, stamp_ns: int) -> bool:
        """Whether a value is in force at the stamp."""
        return bool(self._stamps) and self._stamps[0] <= stamp_ns

    def around(self, stamp_ns: int) -> tuple[int, int | None]:
        """Stamp of the value in force at a stamp, and that of the next (None: there is none yet).

        As for :meth:`at`, the first value is taken before it is stamped; there must be one.
        """
        following = bisect_right(self._stamps, stamp_ns) or 1
        later = self._stamps[following] if following < len(self._stamps) else None
        return self._stamps[following - 1], later

    def constant(self, start_ns: int, period: float, count: int) -> float | None:
        """The one value [A] that :meth:`at` gives for these samples; None where there are more."""
        following = bisect_right(self._stamps, start_ns) or 1
        if following < len(self._stamps):
            step = _first_sample(self._stamps[following] - start_ns, period)
            if step < count:
                return None
        return self._values[following - 1]

    def span(self, start_ns: int, end_ns: int) -> tuple[float, float] | None:
        """Lowest and highest value [A] in force from one stamp to another; None if unknown then."""
        if end_ns < start_ns or not self.known_from(start_ns):
            return None
        first, last = (bisect_right(self._stamps, stamp) for stamp in (start_ns, end_ns))
        values = self._values[first - 1 : last]
        return min(values), max(values)

    def at(self, start_ns: int, period: float, count: int) -> Array:
        """Current [A] at ``count`` samples from ``start_ns``, ``period`` [s] apart, shape (n,).

        Before the first value that value is taken: ask :meth:`known_from`.
        """
        following = bisect_right(self._stamps, start_ns) or 1
        result = np.full(count, self._values[following - 1])
        for place in range(following, len(self._stamps)):
            index = _first_sample(self._stamps[place] - start_ns, period)
            if index >= count:
                break
            result[max(index, 0) :] = self._values[place]
        return result


def _first_sample(delay_ns: int, period: float) -> int:
    """The first sample that a step this much after sample 0 shows in."""
    # Rounding of the stamp to nanoseconds must not move a step by one sample.
    return math.ceil(delay_ns / (period * NANOSECONDS) - 1e-3)
