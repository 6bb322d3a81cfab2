"""What can be found wrong with the signals of a rig: a kind for programs, a sentence for people."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


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
