"""Blocks of stamped samples, the limits of stamps, and the zero-order hold of the current."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from mr_damper_ros.signals.arrays import Array, all_usable, samples_of, usable

NANOSECONDS = 1_000_000_000

LATE_NS = NANOSECONDS
"""A stamp that is earlier than the last one by up to this time is delayed or repeated. If it is
earlier by more, the clock was set back."""

SILENCE = 2.0
"""Time [s] without data after which a stream, a device or a node counts as silent."""

MOST_SAMPLES = 5000
"""Largest number of samples in a block that a node accepts, which bounds the work on a block."""

LONGEST_BLOCK = 10.0
"""Longest duration [s] of a block that a node accepts, which bounds the windows cut from it."""

_LIVE_PERIODS = (1e-5, 1.0)
"""Sample periods [s] that a node accepts. The number of samples in a window follows from them."""


class BlockError(ValueError):
    """A block cannot be used; the message gives the reason."""


def check_live(block: SampleBlock) -> None:
    """Raise BlockError if processing a block would block the services of a node for too long.

    These limits do not apply to files.
    """
    if block.sample_count > MOST_SAMPLES:
        raise BlockError(
            f"the block holds {block.sample_count} samples: send them in blocks of at most "
            f"{MOST_SAMPLES}"
        )
    shortest, longest = _LIVE_PERIODS
    if not shortest <= block.period <= longest:
        raise BlockError(
            f"the sample period is {block.period:g} s: it must be {shortest:g} to {longest:g} s; "
            "is it in seconds?"
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

    Raises BlockError if there are no samples, lengths differ, a value is not finite or its
    magnitude exceeds 1e12, or the period lies outside 1 ns to 2³¹ s.
    """

    start_ns: int
    sequence: int
    period: float
    displacement: Array
    force: Array

    def __post_init__(self) -> None:
        for name in ("displacement", "force"):
            values = getattr(self, name)
            if type(values) is not np.ndarray or values.dtype != np.float64:
                object.__setattr__(self, name, samples_of(values))
        n = self.displacement.size
        if self.displacement.ndim != 1 or self.force.ndim != 1:
            raise BlockError("the block holds a table: give lists of samples")
        if n == 0:
            raise BlockError("the block holds no samples")
        if self.force.size != n:
            raise BlockError(f"the block holds {n} displacements but {self.force.size} forces")
        # Stamps have a resolution of 1 ns and 31 bits for seconds.
        if not 1.0 <= self.period * NANOSECONDS <= STAMP_LIMIT:
            raise BlockError(
                f"the sample period is {self.period} s: it must be positive, "
                f"from {1.0 / NANOSECONDS:g} to {STAMP_LIMIT / NANOSECONDS:.2g} s"
            )
        for name in ("displacement", "force"):
            values = getattr(self, name)
            if not all_usable(values):
                index = int(np.argmin(usable(values)))
                what = f"is {values[index]:g}" if np.isfinite(values[index]) else "is not finite"
                raise BlockError(f"the {name} of sample {index} of the block {what}")

    @property
    def sample_count(self) -> int:
        """Number of samples."""
        return self.displacement.size

    @property
    def end_ns(self) -> int:
        """Stamp at which the next block should start."""
        return self.start_ns + round(self.sample_count * self.period * NANOSECONDS)

    def part(self, first: int, end: int | None = None) -> SampleBlock:
        """The samples with indices from ``first`` up to, but not including, ``end``."""
        return replace(
            self,
            start_ns=self.start_ns + round(first * self.period * NANOSECONDS),
            sequence=self.sequence + first,
            displacement=self.displacement[first:end],
            force=self.force[first:end],
        )


def joined(blocks: Iterable[SampleBlock]) -> list[SampleBlock]:
    """The same samples in as few blocks as possible, one for each uninterrupted series."""
    runs: list[list[SampleBlock]] = []
    for block in blocks:
        last = runs[-1][-1] if runs else None
        if not (
            last is not None
            and block.period == last.period
            and block.sequence == last.sequence + last.sample_count
            and abs(block.start_ns - last.end_ns) <= 0.5 * block.period * NANOSECONDS
        ):
            runs.append([])
        runs[-1].append(block)
    return [
        replace(
            run[0],
            displacement=np.concatenate([block.displacement for block in run]),
            force=np.concatenate([block.force for block in run]),
        )
        for run in runs
    ]


STAMP_LIMIT = 2**31 * NANOSECONDS
"""First time [ns] that exceeds the range of a stamp, whose seconds are a signed 32-bit integer."""


def fits_a_stamp(nanoseconds: int) -> bool:
    """Whether a stamp can represent this number of nanoseconds since the epoch."""
    return -STAMP_LIMIT <= nanoseconds < STAMP_LIMIT


class SuspensionState(NamedTuple):
    """State of a suspension, upwards positive.

    ``body`` and ``wheel`` are their velocities [m/s]; ``acceleration`` [m/s²] belongs to the body.
    ``stroke`` [m] is the suspension stroke and ``tyre`` [m] the distance between wheel and road,
    both relative to rest.
    """

    body: float
    wheel: float
    acceleration: float = 0.0
    stroke: float = 0.0
    tyre: float = 0.0

    @property
    def extension(self) -> float:
        """Extension velocity of the damper [m/s]."""
        return self.body - self.wheel


@dataclass(frozen=True, eq=False)
class RigBlock:
    """Consecutive samples of a rig: ``displacement`` [m], ``force`` [N], ``current`` [A].

    Arrays have shape (n,) and their samples are ``period`` [s] apart. ``start_ns`` is the stamp of
    sample 0 and ``sequence`` its index since the start. ``temperature`` [°C] also has shape (n,).
    An unknown temperature is NaN, and so is a current that the supply does not report. ``ahead_ns``
    is the error of the sample clock (positive: ahead), and ``supply_ahead_ns`` the error of the
    supply clock relative to the sample clock. ``suspension`` is the suspension state at the last
    sample, or None if the damper is not in a suspension.
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
    suspension: SuspensionState | None = None

    @property
    def sample_count(self) -> int:
        """Number of samples."""
        return self.force.size

    @property
    def samples(self) -> SampleBlock:
        """Displacement and force; raises BlockError like :class:`SampleBlock`."""
        return SampleBlock(self.start_ns, self.sequence, self.period, self.displacement, self.force)

    def stamp_ns(self, index: int) -> int:
        """Stamp [ns] of a sample."""
        return self.start_ns + round(index * self.period * NANOSECONDS)

    @property
    def due_ns(self) -> int:
        """True time of the last sample [ns]; for a block without samples, the true start time."""
        return self.stamp_ns(max(self.sample_count - 1, 0)) - self.ahead_ns

    def without_samples(self) -> RigBlock:
        """A block without samples, with the stamp of the last sample, as if none had been sent."""
        arrays = ("displacement", "force", "current", "temperature")
        none: dict[str, Any] = dict.fromkeys(arrays, np.empty(0))
        return replace(self, start_ns=self.stamp_ns(self.sample_count - 1), **none)


KEEP_CURRENT = 3600.0
"""Time [s] for which a stream keeps values of the current. When a bag is played fast, the current
can arrive long before its samples."""


class CurrentError(ValueError):
    """A value of the current cannot be used; the message gives the reason."""


class ZeroOrderHold:
    """Stamped values of the supply current, each held until the next stamp."""

    def __init__(self, keep: float) -> None:
        """Keep at least the last ``keep`` seconds of values; if infinite, keep all values."""
        self._keep_ns = round(min(keep * NANOSECONDS, 2.0**62))
        self._stamps = array("q")
        self._values = array("d")
        self._jumped = False
        # Time to add to stamps on the clock of the samples before its last leap.
        self._leap_ns = 0

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the newest value; None before the first."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp_ns: int, current: float) -> None:
        """Add a value [A]; a value that jumps back in time replaces all values after its stamp.

        A value that is only delayed is sorted in by its stamp. Raises CurrentError for a value that
        is not finite.
        """
        if not math.isfinite(current):
            raise CurrentError(f"the current is {current}: it must be a finite number")
        if self._leap_ns:
            away_ns = stamp_ns - self._stamps[-1]
            if abs(away_ns + self._leap_ns) < abs(away_ns):
                stamp_ns += self._leap_ns
            else:
                self._leap_ns = 0
        place = bisect_left(self._stamps, stamp_ns)
        back_ns = self._stamps[-1] - stamp_ns if self._stamps else 0
        if back_ns > LATE_NS:
            self._jumped = True
            del self._stamps[place:], self._values[place:]
        elif place < len(self._stamps) and self._stamps[place] == stamp_ns:
            del self._stamps[place], self._values[place]
        self._stamps.insert(place, stamp_ns)
        self._values.insert(place, current)
        # One value older than the horizon stays, because it holds until the next.
        surplus = bisect_right(self._stamps, self._stamps[-1] - self._keep_ns) - 1
        # Dropping a value moves all others, so many are dropped at once.
        if 2 * surplus > len(self._stamps):
            del self._stamps[:surplus], self._values[:surplus]

    def follow_jump(self) -> None:
        """Discard the values before the jump, now that the samples have jumped back.

        If the current jumped first, its values already belong to the time after the jump.
        """
        if not self._jumped:
            del self._stamps[:], self._values[:]
        self._jumped = False

    def follow_leap(self, leap_ns: int, newest_ns: int) -> None:
        """Hold the last value on, now that the clock of the samples leapt to ``newest_ns``.

        Later values may be stamped by the old clock of the samples or by the new one: the stamp
        that continues the values counts.
        """
        self._jumped = False
        if not self._stamps:
            return
        last_ns, value = self._stamps[-1], self._values[-1]
        if abs(last_ns + leap_ns - newest_ns) >= abs(last_ns - newest_ns):
            return  # the values leapt before the samples
        self._leap_ns += leap_ns
        if leap_ns < 0:
            del self._stamps[:], self._values[:]
        self._stamps.append(last_ns + leap_ns)
        self._values.append(value)

    def known_from(self, stamp_ns: int) -> bool:
        """Whether a value applies at the stamp."""
        return bool(self._stamps) and self._stamps[0] <= stamp_ns

    def around(self, stamp_ns: int) -> tuple[int, int | None]:
        """Stamp of the value that applies at a stamp, and of the next value (None without one).

        As in :meth:`at`, the first value also applies before its stamp. At least one value must
        exist.
        """
        following = bisect_right(self._stamps, stamp_ns) or 1
        later = self._stamps[following] if following < len(self._stamps) else None
        return self._stamps[following - 1], later

    def span(self, start_ns: int, end_ns: int) -> tuple[float, float] | None:
        """Lowest and highest value [A] between two stamps; None if unknown at the first stamp."""
        if end_ns < start_ns or not self.known_from(start_ns):
            return None
        first, last = (bisect_right(self._stamps, stamp) for stamp in (start_ns, end_ns))
        values = self._values[first - 1 : last]
        return min(values), max(values)

    def at(self, start_ns: int, period: float, count: int) -> Array:
        """Current [A] at ``count`` samples from ``start_ns``, ``period`` [s] apart, shape (n,).

        Samples before the first value get the first value; :meth:`known_from` detects them.
        """
        following = bisect_right(self._stamps, start_ns) or 1
        end = bisect_right(self._stamps, start_ns + round(count * period * NANOSECONDS))
        before = self._values[following - 1]
        if end <= following:
            return np.full(count, before)
        delays = np.array(self._stamps[following:end]) - start_ns
        # Rounding of the stamp to nanoseconds must not move a step by one sample.
        first = np.ceil(delays / (period * NANOSECONDS) - 1e-3).clip(0, count).astype(np.intp)
        lengths = np.diff(first, prepend=0, append=count)
        return np.repeat(np.array([before, *self._values[following:end]]), lengths)
