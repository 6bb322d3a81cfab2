"""Blocks of samples as they arrive, and the one policy on time that every consumer follows.

The stamps of the data are the only clock. A block must follow the one before it by its stamp
(half a sample period is tolerated) and, where both are known, by its sequence number. What does
not is named and handled the same way everywhere:

- a *gap* (samples lost, or the source paused): whatever was being collected starts again;
- a *jump back* (a bag that loops, a clock that was set): starts again too;
- a *repeat* (a block whose samples all came before): ignored;
- a *changed period*: starts again.

Nothing that was identified is touched by any of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mr_damper_ros.signals.arrays import Array

NANOSECONDS = 1_000_000_000

_REPEAT_HORIZON = 1.0
"""A block older than the last one by less than this [s] is a repeat, by more a jump back."""


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
            f"the block stands for {duration:g} s: send blocks of at most {LONGEST_BLOCK:g} s"
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

    @property
    def sample_count(self) -> int:
        """Number of samples."""
        return int(self.displacement.size)

    @property
    def end_ns(self) -> int:
        """Stamp at which the next block should start."""
        return self.start_ns + round(self.sample_count * self.period * NANOSECONDS)


@dataclass(frozen=True)
class Continuity:
    """How a block follows its predecessor: ``kind`` is one of the words below.

    "first", "next", "gap", "jump_back", "repeat", "changed_period". ``lost`` counts the samples
    missing in a gap; ``sentence`` says it in words, empty for "first" and "next".
    """

    kind: str
    lost: int = 0
    sentence: str = ""

    @property
    def restarts(self) -> bool:
        """Whether whatever is being collected must start again."""
        return self.kind in ("gap", "jump_back", "changed_period")


_NEXT = Continuity("next")


class BlockSequence:
    """Remembers the last block of a stream and judges the next one.

    Counted since the start: samples lost, samples that came again or too late, and blocks that did
    not follow the one before, of the last of which there is a sentence.
    """

    def __init__(self) -> None:
        self._last: SampleBlock | None = None
        self.lost_samples = 0
        self.repeated_samples = 0
        self.interruptions = 0
        self.last_interruption = ""

    @property
    def last(self) -> SampleBlock | None:
        """The last block that was not a repeat."""
        return self._last

    def follow(self, block: SampleBlock) -> Continuity:
        """Judge a block and, unless it is a repeat, make it the last one."""
        verdict = self._judge(block)
        if verdict.sentence:
            self.interruptions += 1
            self.last_interruption = verdict.sentence
        if verdict.kind == "repeat":
            self.repeated_samples += block.sample_count
            return verdict
        self.lost_samples += verdict.lost
        self._last = block
        return verdict

    def _judge(self, block: SampleBlock) -> Continuity:
        last = self._last
        if last is None:
            return Continuity("first")
        if not math.isclose(block.period, last.period, rel_tol=1e-6):
            return Continuity(
                "changed_period",
                sentence=f"the sample period changed from {last.period:g} s to {block.period:g} s: "
                "what was being collected starts again",
            )
        late = (block.start_ns - last.end_ns) / NANOSECONDS
        missing = block.sequence - (last.sequence + last.sample_count)
        if abs(late) <= 0.5 * block.period:
            if missing == 0:
                return _NEXT
            # The stamps go on but the count does not: the source was started again.
            return Continuity(
                "gap",
                sentence="the sample count was set back or forward (a source that was started "
                "again?): what was being collected starts again",
            )
        if late > 0.0:
            lost = max(missing, 0)
            detail = (
                f"{lost} samples were lost (an overloaded computer or network?)"
                if lost
                else f"the samples pause for {late:.3g} s"
            )
            return Continuity("gap", lost, f"{detail}: what was being collected starts again")
        if block.end_ns <= last.end_ns and -late < _REPEAT_HORIZON and missing < 0:
            return Continuity("repeat", sentence="a block came twice or too late: it is ignored")
        return Continuity(
            "jump_back",
            sentence=f"the stamps jump back by {-late:.3g} s: what was being collected "
            "starts again",
        )
