"""What was received of a rig for a while, and what can be wrong with it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import NANOSECONDS

_BRIDGED = 0.1
"""Longest loss [s] that is bridged for a look at the whole."""


@dataclass(frozen=True, eq=False)
class HeardBlock:
    """A block as it came, whatever it holds; ``arrival_ns`` by a steady clock, -1 if unknown."""

    start_ns: int
    sequence: int
    period: float
    displacement: Array
    force: Array
    arrival_ns: int = -1


@dataclass(eq=False)
class RigRecord:
    """Blocks in the order in which they came, and stamped currents [A]: measured and commanded."""

    blocks: list[HeardBlock] = field(default_factory=list)
    measured: list[tuple[int, float]] = field(default_factory=list)
    commanded: list[tuple[int, float]] = field(default_factory=list)
    unusable: int = 0
    """Messages without samples or a period, or with more of the one than of the other."""
    saturated: dict[str, tuple[int, int]] = field(default_factory=dict)
    """By channel, how many samples its source had left out because it was at the end of its range:
    when that was first told, and when it was last told."""

    def left_out(self, channel: str) -> int:
        """Samples left out meanwhile because the channel was at the end of its range."""
        first, last = self.saturated.get(channel, (0, 0))
        return max(last - first, 0)

    @property
    def period(self) -> float:
        """The sample period [s] that most blocks state; NaN without blocks."""
        if not self.blocks:
            return math.nan
        return float(np.median([block.period for block in self.blocks]))

    @property
    def sample_count(self) -> int:
        """Samples that came."""
        return sum(block.force.size for block in self.blocks)

    def stretch(self) -> tuple[Array, Array]:
        """Displacement and force of the longest part without a long gap, each of shape (n,).

        What was lost for up to a tenth of a second lies on straight lines.
        """
        rows: list[Array] = []
        parts: list[list[Array]] = []
        expected = None
        for block in self.blocks:
            missing = None if expected is None else block.sequence - expected
            expected = block.sequence + block.force.size
            here = np.stack([block.displacement, block.force])
            if missing is None or not 0 <= missing * block.period <= _BRIDGED:
                rows = []
                parts.append(rows)
            elif missing:
                last, place = rows[-1][:, -1:], np.arange(1.0, missing + 1.0) / (missing + 1.0)
                rows.append(last + (here[:, :1] - last) * place)
            rows.append(here)
        joined = [np.concatenate(part, axis=1) for part in parts]
        longest = max(joined, key=lambda part: part.shape[1], default=np.empty((2, 0)))
        return longest[0], longest[1]

    def stamps(self) -> tuple[Array, Array]:
        """Number of the first sample of each block, and its stamp [s] since the first block."""
        first = self.blocks[0].start_ns
        numbers = np.array([block.sequence for block in self.blocks], dtype=np.float64)
        times = np.array([(b.start_ns - first) / NANOSECONDS for b in self.blocks])
        return numbers, times


class Trouble(Enum):
    """Kinds of trouble."""

    SILENT = "nothing comes"
    UNUSABLE = "messages that hold no samples"
    NOT_FINITE = "values that are no numbers"
    STUCK = "a channel that stands still"
    AT_REST = "no motion"
    SWAPPED = "channels exchanged"
    INVERTED = "a sign reversed"
    UNIT = "a wrong unit"
    OFFSET = "a zero that is off"
    SKEW = "channels apart in time"
    NOISE = "much noise"
    HUM = "mains hum"
    CLIPPED = "a channel cut off"
    COARSE = "few steps of a converter"
    SPIKES = "single wild values"
    RATE = "another sample rate than stated"
    JITTER = "stamps that jitter"
    LOST = "lost samples"
    REPEATED = "repeated or reordered samples"
    RESTARTED = "a count or a clock that was set"
    BURSTS = "samples in bursts"
    NO_CURRENT = "no current known"
    CURRENT = "another current than commanded"
    CURRENT_CLOCK = "the current by another clock"


@dataclass(frozen=True)
class RigFinding:
    """Something that is wrong with ``channel`` (empty: with the stream), and what to do."""

    trouble: Trouble
    sentence: str
    channel: str = ""
