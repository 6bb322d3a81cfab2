"""What was received of a rig for a while, how late its force is, and what can be wrong with it.

When the rod turns, the force of a damper crosses zero a little later: by its own hysteresis, which
is a part of the cycle (v_h is proportional to the peak velocity), and by the skew of the channels,
which is the same time in every cycle. Motion at one frequency cannot tell the two apart. Over
several, the lag is a line over the length of the cycle, and the skew is where that line begins.

What lags by the same time in the damper itself, a compliant mount or fluid, counts as skew.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from mr_damper_ros.kinematics.motion import SavitzkyGolay
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
    NOT_FINITE = "values that are not finite"
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


_FEWEST = 8
"""Pairs of turns from which on a line is drawn."""

_SMOOTHED = 40.0
"""Part of a usual cycle that the smoothing reaches to either side."""

_SMALL = 0.25
"""Part of the usual peak velocity that the rod must reach between two turns."""

_FURTHEST = 0.25
"""Part of a cycle in which the force must cross zero after the turn, or before."""

_SPREAD = 1.3
"""The longest cycles over the shortest, at least: below, there is no line."""

_OUTLIER = 4.0

_OF_THE_LAW = 4e-4
"""Standard error [s] besides that of the line: the hysteresis of a damper is no exact part of the
cycle. So far off was the skew of emulated dampers whose channels have none."""

_REMEMBERED, _EVEN = 4, 0.05
"""Cycles that the hysteresis remembers, and by how much they may differ in length."""


@dataclass(frozen=True)
class ChannelLag:
    """``skew`` [s] and its standard error; ``lag`` [s] of the force at a usual turn in all."""

    skew: float
    standard_error: float
    lag: float

    @property
    def determined(self) -> bool:
        """Whether the motion has told skew and hysteresis apart, to half a millisecond."""
        return self.standard_error <= 5e-4


def channel_lag(displacement: Array, force: Array, period: float) -> ChannelLag:
    """The lag of the force, from samples (n,) ``period`` [s] apart; NaN where none can be seen."""
    nothing = ChannelLag(math.nan, math.inf, math.nan)
    half = _half_window(displacement, period)
    if displacement.size < 8 * half + 4:
        return nothing
    smooth = SavitzkyGolay(2 * half + 1, 3)
    velocity = smooth.derivative(displacement, 1, period)
    turns = _turns(velocity)
    if turns.size < 2 * _FEWEST:
        return nothing
    pulled = smooth.derivative(force - 0.5 * (np.quantile(force, 0.99) + np.quantile(force, 0.01)))
    zeros = _crossings(pulled)
    rows: list[tuple[float, float]] = []
    for before, turn, after in zip(turns, turns[1:], turns[2:], strict=False):
        cycle = float(after - before)
        place = round(float(turn)) + half
        direction = np.sign(velocity[min(place, velocity.size - 1)])
        near = zeros[np.abs(zeros - turn) < _FURTHEST * cycle]
        if near.size:
            # The force goes through zero in the direction of the motion.
            steps = pulled[near.astype(int) + 1] - pulled[near.astype(int)]
            near = near[np.sign(steps) == direction]
        lag = float(np.median(near)) - float(turn) if near.size else math.nan
        rows.append((lag * period, cycle * period))
    # A force that goes about another value than zero shifts every other turn to the other side.
    pairs = np.array(rows[: len(rows) // 2 * 2]).reshape(-1, 2, 2).mean(axis=1)
    lags, cycles = pairs[np.isfinite(pairs[:, 0]) & _steady(pairs[:, 1])].T
    return _line(lags, cycles) if lags.size >= _FEWEST else nothing


def _steady(cycles: Array) -> np.ndarray:
    """Mask (n,) of the cycles before which the motion has been the same for as long as it matters.

    The hysteresis follows the peak velocity of the latest cycles, not that of the present one.
    """
    steady = np.ones(cycles.size, dtype=bool)
    for back in range(1, _REMEMBERED + 1):
        steady[:back] = False
        steady[back:] &= np.abs(cycles[back:] / cycles[:-back] - 1.0) < _EVEN
    return steady


def _line(lags: Array, cycles: Array) -> ChannelLag:
    """The line through lags (n,) over cycles (n,) [s], whose errors grow with the cycles."""
    usual = float(np.median(lags))
    if np.quantile(cycles, 0.9) < _SPREAD * np.quantile(cycles, 0.1):
        return ChannelLag(math.nan, math.inf, usual)
    columns = np.stack([1.0 / cycles, np.ones(cycles.size)], axis=1)
    parts = lags / cycles
    kept = np.ones(parts.size, dtype=bool)
    weights: Array = np.zeros(2)
    for _ in range(3):
        weights = np.asarray(np.linalg.lstsq(columns[kept], parts[kept], rcond=None)[0])
        rest = parts - columns @ weights
        kept = np.abs(rest) <= _OUTLIER * max(1.4826 * float(np.median(np.abs(rest))), 1e-6)
        if np.count_nonzero(kept) < _FEWEST:
            return ChannelLag(math.nan, math.inf, usual)
    left = parts[kept] - columns[kept] @ weights
    variance = float(left @ left) / (left.size - 2)
    covariance = variance * np.linalg.inv(columns[kept].T @ columns[kept])
    return ChannelLag(float(weights[0]), math.sqrt(float(covariance[0, 0]) + _OF_THE_LAW**2), usual)


def _half_window(displacement: Array, period: float) -> int:
    """Samples that the smoothing reaches to either side."""
    coarse = max(round(5e-3 / period), 1)
    means = displacement[: displacement.size // coarse * coarse].reshape(-1, coarse).mean(axis=1)
    if means.size < 3 or np.std(means) == 0.0:
        return 3
    rate = float(np.std(np.diff(means))) / (coarse * period)
    cycle = 2.0 * math.pi * float(np.std(means)) / rate
    return max(round(cycle / _SMOOTHED / period), 3)


def _turns(velocity: Array) -> Array:
    """Where the rod turns [samples]: crossings of zero with a real motion on both sides."""
    fast = _SMALL * float(np.quantile(np.abs(velocity), 0.9))
    sides = np.sign(velocity) * (np.abs(velocity) > fast)
    moving = np.flatnonzero(sides)
    changes = np.flatnonzero(np.diff(sides[moving]) != 0.0)
    crossings = _crossings(velocity)
    found = [
        float(np.median(between))
        for a, b in zip(moving[changes], moving[changes + 1], strict=True)
        if (between := crossings[(crossings >= a) & (crossings <= b)]).size
    ]
    return np.array(found)


def _crossings(values: Array) -> Array:
    """Where the line between neighbours crosses zero [samples]."""
    before = np.flatnonzero(np.sign(values[:-1]) * np.sign(values[1:]) < 0.0)
    return np.asarray(before - values[before] / (values[before + 1] - values[before]))
