"""Blocks of samples as they arrive, which of them can be used, and what their stamps can hold."""

from __future__ import annotations

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
